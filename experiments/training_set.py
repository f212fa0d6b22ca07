"""Claim: a data set of the ten intersections holds the road users that its densities ask for.

Records a tenth of the set of ten intersections, three densities, three lights and the paper's nine
placements: all of its scenarios at 1 Hz instead of 10, with pictures as detectors take them. By
class, density and placement, counts the road users of a frame and those asked for, those without a
LiDAR return, and the points in a box for each return of its road user. Draws the sizes of road
users with those of real vehicles. The set stays where --keep says; a run that was stopped goes on
there.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from common import (
    arguments,
    console,
    kept_folder,
    need_maps,
    on_maps,
    output,
    processes,
    progress,
    show,
    write_results,
)
from matplotlib.figure import Figure
from table2 import HERE

from inspe_jax.dataset import Dataset, generate, load_generation, open
from inspe_jax.dataset.points_in_boxes import count_inside
from inspe_jax.mounting.strategies import STRATEGIES
from inspe_jax.scene.traffic.frames import CLASSES, DENSITIES, MIXES, quota
from inspe_jax.simulation.embedded.light import LIGHTS
from inspe_jax.simulation.frame import Frame
from inspe_jax.simulation.recorder import TURN

SPLITS = dict(train=7, validate=1, test=2)
PICTURE = [352, 128]
"""Width and height that camera detectors of the paper take."""
REAL: dict[str, list[tuple[str, float, float]]] = {
    "car": [("Fiat 500", 3.57, 1.63), ("VW Golf", 4.28, 1.79), ("Ford Transit", 5.53, 2.06)],
    "truck": [
        ("long van", 7.37, 2.02),
        ("city bus", 12.0, 2.55),
        ("semi-trailer", 16.5, 2.55),
    ],
    "cyclist": [("city bicycle", 1.8, 0.6), ("cargo bicycle", 2.5, 0.8)],
    "pedestrian": [("adult", 0.5, 0.5)],
}
"""Length and width [m]: makers' data sheets; the longest that EU directive 96/53/EC allows."""


def study(given: argparse.Namespace) -> dict[str, Any]:
    """The content of a study file."""
    settings = dict(density=list(DENSITIES)[1:], light=given.lights, seconds=10, mix=given.mix)
    content: dict[str, Any] = dict(
        name="ten intersections", layouts=list(STRATEGIES), settings=settings, rate_hz=1,
        pictures="jpeg", image_size=PICTURE, splits=SPLITS,
    )  # fmt: skip
    if given.quick:
        settings |= dict(density=["low"], light=given.lights[:1], seconds=1, radius=15, voxel=1)
        scenes = [{"built_in": "four_way"}, {"built_in": "t_junction"}]
        content |= dict(scenes=scenes, layouts=["Cam-c/L-c", "L-d1"], splits=dict(train=1, test=1))
    else:
        scenes = yaml.safe_load((HERE / "intersections.yaml").read_text(encoding="utf-8"))
        content |= dict(scenes=on_maps(scenes))
    return content


def recorded(content: dict[str, Any], into: Path, workers: int | None) -> Dataset:
    """The set of a study, recorded as far as it is not there."""
    path = into.with_suffix(".yaml")
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    with progress(into.name) as report:
        made = generate(load_generation(path), into, workers=workers, progress=report)
    assert not made.failures, made.failures
    size = f"{made.size / 1e6:,.0f} MB"
    console.print(
        f"{into.name}: {made.scenarios} scenarios, {made.frames} frames, {size}; "
        f"{made.recorded} frames in {made.seconds:,.0f} s",
        highlight=False,
    )
    return open(into)


# ── What a set holds ────────────────────────────────────────────────────────


def of_frame(frame: Frame) -> np.ndarray:
    """Class, returns of its own and points inside, of each road user (B, 3)."""
    scans = [scan for station in frame.stations for scan in station.scans]
    own = sum((np.asarray(s.returns) for s in scans), np.zeros(len(frame.boxes), int))
    inside = count_inside(scans, frame.boxes).sum(0) if scans else np.zeros_like(own)
    return np.column_stack([[CLASSES.index(box.kind) for box in frame.boxes], own, inside])


def counted(data: Dataset, mix: str, light: str) -> list[dict[str, Any]]:
    """A row for each placement, density and class, of the scenarios in one light.

    In another light LiDARs return the same, but for their noise.
    """
    found: dict[tuple[str, str], list[np.ndarray]] = {}
    chosen = [s for s in data.scenarios if s.protocol["settings"]["light"] == light]
    with progress("reading scenarios") as report:
        for done, scenario in enumerate(chosen, 1):
            layout = str(scenario.protocol["layout"]["name"])
            at = layout, str(scenario.protocol["settings"]["density"])
            found.setdefault(at, []).extend(of_frame(scenario.frame(t)) for t in scenario.frames)
            report(done, len(chosen))
    rows = []
    for (placement, density), frames in found.items():
        asked = quota(MIXES[mix], [True] * len(CLASSES), DENSITIES[density])
        every = np.concatenate(frames)
        for k, name in enumerate(CLASSES):
            own = every[every[:, 0] == k]
            rows.append(
                dict(
                    placement=placement, density=density, road_user=name, frames=len(frames),
                    asked=int(asked[k]), boxes=len(own),
                    without_return=int((own[:, 1] == 0).sum()), returns=int(own[:, 1].sum()),
                    points_inside=int(own[:, 2].sum()), turn_s=TURN,
                )
            )  # fmt: skip
    return rows


def tell_placements(rows: list[dict[str, Any]]) -> None:
    """Boxes without a return, and points in a box for each return of its road user."""
    found = []
    for placement in dict.fromkeys(row["placement"] for row in rows):
        if STRATEGIES[placement].lidars:
            cells = []
            for name in CLASSES:
                own = [r for r in rows if (r["placement"], r["road_user"]) == (placement, name)]
                boxes, none, returns, inside = (
                    sum(row[key] for row in own)
                    for key in ("boxes", "without_return", "returns", "points_inside")
                )
                cells.append(f"{none / max(boxes, 1):.1%}, {inside / max(returns, 1):.2f}")
            found.append((placement, *cells))
    heads = [f"{name}s without\na return, points\na return" for name in CLASSES]
    show(("placement", *heads), found, "What LiDARs return of road users")


def draw(data: Dataset) -> Figure:
    """Length and width of the road users of each class, and those of real ones."""
    sizes: dict[str, dict[Any, np.ndarray]] = {name: {} for name in CLASSES}
    for scenario in data.scenarios:
        for box in scenario.frame(scenario.frames[0]).boxes:
            of = tuple(scenario.protocol["scene"].items()), scenario.protocol["settings"]["density"]
            sizes[box.kind][str(of), box.track] = box.size
    figure = Figure(figsize=(12, 5), layout="constrained")
    axes = figure.subplots(2, len(CLASSES))
    for column, name in enumerate(CLASSES):
        every = np.array(list(sizes[name].values())).reshape(-1, 3)
        for axis, word in enumerate(("length", "width")):
            ax = axes[axis, column]
            ax.hist(every[:, axis], bins=30, color="C0", alpha=0.8)
            for k, (label, *real) in enumerate(REAL[name]):
                ax.axvline(real[axis], color=f"C{k + 1}", ls="--", lw=1, label=label)
            ax.set_xlabel(f"{word} [m]")
            if axis == 0:
                ax.set_title(f"{name}: {len(every)}")
                ax.legend(fontsize=7)
    return figure


def main() -> None:
    """Record, count, print, draw and write."""
    given = arguments(
        __doc__,
        *("keep", "workers"),
        lights=dict(nargs="+", default=list(LIGHTS), choices=LIGHTS),
        mix=dict(default="fleet", choices=list(MIXES), help="of the road users"),
    )
    need_maps(given)
    with kept_folder(given.keep) as into:
        data = recorded(study(given), into / "set", processes(given))
        rows = counted(data, given.mix, given.lights[0])
        figure = draw(data)
    tell_placements(rows)
    settings = dict(mix=given.mix, study=study(given))
    write_results(output(given, "training_set"), rows, settings, figure)


if __name__ == "__main__":
    main()
