"""Claim: a sensor that is let go has exact scores on 20 frames within 0.3 s, on all within 2 s.

W1 of `benchmark_speed.py`: 152 520 voxels, 12 sensors, 100 frames of 40 road users. Sensors are
dragged as a browser drags them, by events of the handle: a start, an event every 50 ms, an end.
Timed from the end to the scores on the page's board, of 20 frames and of all, with mounting, the
shown frame's voxels and all that is drawn; once without a browser, and once, where there is
Chromium, with one that draws it in software on the same cores.
"""

import tempfile
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
from benchmark_speed import sensors, workload
from common import CHROMIUM, arguments, browser_on, machine, write_results
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from inspe_jax.geometry import rotation
from inspe_jax.placement.problem import Case
from inspe_jax.viewer.app import Viewer
from inspe_jax.viewer.handle import Pull

console = Console()

STEPS, EVERY = 5, 0.05
"""Events of one drag, and the time between two [s]."""


def drag(viewer: Viewer, s: int, rng: np.random.Generator) -> dict[str, float]:
    """Drag one sensor some metres and turn it; seconds to the scores of few and of all frames."""
    heard: dict[bool, float] = {}
    told = viewer.panel.board

    viewer.select(s)
    pose = np.array(viewer.layout.poses[s], float)
    turn, at = rotation(np.array([0.0, 0.0, pose[5]]), np), pose[:3] - viewer.stage.shift
    away = np.append(rng.uniform(-3, 3, 2), rng.uniform(-1, 1))
    viewer._hear_pull(Pull("start", at, turn))
    for k in range(1, STEPS + 1):
        viewer._hear_pull(Pull("update", at + away * k / STEPS, turn))
        time.sleep(EVERY)
    before, began = viewer.layout, time.monotonic()
    viewer._hear_pull(Pull("end", at + away, turn))
    while len(heard) < 2:
        time.sleep(0.002)
        scored = viewer._scored
        if viewer.layout is before or scored is None or scored.layout is not viewer.layout:
            continue
        assert scored.scores is not None
        whole = scored.frames == viewer.frames
        if whole not in heard and f'data-score="{scored.scores.surrogate}"' in told.content:
            heard[whole] = time.monotonic() - began
            if whole:
                heard.setdefault(False, heard[True])
    return {"few": heard[False], "all": heard[True]}


def figure(rows: list[dict[str, Any]]) -> Figure:
    """Every drag's two times."""
    fig = Figure(figsize=(6.4, 2.8), layout="constrained")
    ax = fig.subplots()
    names = list(dict.fromkeys((row["browser"], key) for row in rows for key in ("few", "all")))
    for y, (browser, key) in enumerate(names):
        times = [row[key] for row in rows if row["browser"] == browser]
        ax.plot(times, np.full(len(times), y), "|", ms=14, color="#0072b2")
        ax.plot(np.median(times), y, "o", color="#d55e00", zorder=3)
    frames = {"few": "20 frames", "all": "all frames"}
    ax.set_yticks(range(len(names)), [f"{frames[key]}, {browser}" for browser, key in names])
    ax.set(xlabel="from the end of a drag to its scores [s]", xlim=(0, None))
    ax.margins(y=0.2)
    ax.invert_yaxis()
    return fig


def main() -> None:
    """Run and report."""
    given = arguments(__doc__)
    scene = workload("quick" if given.quick else "W1", given.seed)
    layout, drags = sensors(scene), 3 if given.quick else 30
    rows = []
    for browser in ("no browser", "a browser"):
        if browser == "a browser" and (CHROMIUM is None or given.quick):
            console.print("no browser" if CHROMIUM is None else "left out when quick: a browser")
            continue
        rng = np.random.default_rng(given.seed)
        with tempfile.TemporaryDirectory() as folder:
            viewer = Viewer(Case(scene), layout, Path(folder) / "w1.yaml", port=0)
            try:
                looking = browser == "a browser"
                with browser_on(viewer.url) if looking else nullcontext():
                    drag(viewer, 0, rng)  # compiles
                    for k in range(drags):
                        found = drag(viewer, k % len(layout), rng)
                        rows.append({"browser": browser, "drag": k, **found})
            finally:
                viewer.close()
    table = Table("", "20 frames [s]", "all frames [s]", title="from the end of a drag")
    for shown in dict.fromkeys(row["browser"] for row in rows):
        times = np.array([[r["few"], r["all"]] for r in rows if r["browser"] == shown])
        middle, most = np.median(times, axis=0), times.max(0)
        cells = (f"{m:.2f} (most {x:.2f})" for m, x in zip(middle, most, strict=True))
        table.add_row(str(shown), *cells)
    console.print(table)
    console.print(" · ".join(f"{key} {value}" for key, value in machine().items()))
    path = given.out / "benchmark_view.csv"
    write_results(path, rows, {"seed": given.seed, "quick": given.quick, "drags": drags})
    figure(rows).savefig(path.with_suffix(".png"), dpi=160)
    console.print(f"wrote {path}, .json and .png")


if __name__ == "__main__":
    main()
