"""Claim: where road users stand depends on the model that moves them, and the scores less so.

One junction, the same number of road users from the paper's waypoint model and from SUMO: occupancy
p̂ side by side, how much of the entropy lies where, and what changes in C, O, IG and P_sm of the
paper's nine placements, over several seeds of the traffic. Town10HD's signalled four-way where the
map is at hand; with --quick, or without, RiLSA's that comes with SUMO.
"""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import sumo
from common import MAPS, METRICS, arguments, console, output, show, write_results
from matplotlib.figure import Figure
from rich.progress import track

import inspe_jax
from inspe_jax import STRATEGIES, Intersection, Scene
from inspe_jax.report.figures import column_raster
from inspe_jax.scene.maps.registry import read_map
from inspe_jax.scene.traffic.frames import TRAFFIC_MODELS
from inspe_jax.scoring.metrics import entropy
from inspe_jax.scoring.viewshed import viewshed

LEVEL = 1.0
"""Height above the ground at which p̂ is drawn [m]."""
NAMES = {"waypoints": "waypoint model", "sumo": "SUMO"}
COLORS = {"waypoints": "#0072B2", "sumo": "#D55E00"}


def intersection(quick: bool) -> tuple[Intersection, float]:
    """Where, and the radius [m]."""
    radius = 25.0 if quick else 50.0
    if not quick and (MAPS / "Town10HD.xodr").is_file():
        return read_map(MAPS / "Town10HD.xodr", junction=189, radius=radius), radius
    net = Path(sumo.SUMO_HOME) / "tools/sumolib/scenario/scenarios/RiLSA1/rilsa1.net.xml"
    return read_map(net, junction="0", radius=radius), radius


def occupancy(scene: Scene) -> tuple[np.ndarray, float]:
    """p̂ of each voxel (L, Z), and the entropy of them all [bit]."""
    shed = viewshed(scene, inspe_jax.strategy(scene, "Cam-c"))
    share = shed.occupied / shed.frame_count
    bits = np.asarray(entropy(jnp.asarray(share, float))) / np.log(2.0)
    return share.reshape(-1, scene.voxels.level_count), float(bits.sum())


def main() -> None:
    """Build, score, print and write."""
    options = arguments(__doc__, "seed")
    place, radius = intersection(options.quick)
    quick = dict(voxel=1.0, density="low", frames=20)
    whole = dict(voxel=0.5, density="medium", frames=200)
    settings: dict[str, Any] = dict(
        profile="ideal", radius=radius, **(quick if options.quick else whole)
    )
    seeds = range(options.seed, options.seed + (1 if options.quick else 3))
    layouts = ["L-d1"] if options.quick else list(STRATEGIES)

    rows: list[dict[str, Any]] = []
    drawn: dict[str, tuple[Scene, np.ndarray]] = {}
    runs = [(source, seed) for seed in seeds for source in TRAFFIC_MODELS]
    for source, seed in track(runs, "scoring", console=console, transient=True):
        scene = inspe_jax.build_scene(place, **settings, traffic=source, seed=seed)
        share, bits = occupancy(scene)
        drawn.setdefault(source, (scene, share))
        facts = dict(
            objects=scene.traffic.mean_count,
            entropy=bits,
            voxels_ever_occupied=float((share > 0).mean()),
        )
        for name in layouts:
            scores = inspe_jax.evaluate(scene, inspe_jax.strategy(scene, name))
            found = {metric: scores.value(metric) for metric in METRICS}
            rows.append(dict(traffic=source, seed=seed, layout=name, **facts, **found))

    shown = []
    for name in layouts:
        cells = [
            mean(rows, source, name, key)
            for key in ("occlusion", "information_gain", "surrogate")
            for source in TRAFFIC_MODELS
        ]
        shown.append((name, *(f"{x:.3f}" for x in cells), f"{cells[5] - cells[4]:+.3f}"))
    show(
        ("placement", "O", "O\nSUMO", "IG", "IG\nSUMO", "P_sm", "P_sm\nSUMO", "change"),
        shown,
        f"{place.name}: waypoint model and SUMO, mean of {len(seeds)}",
    )
    for source in TRAFFIC_MODELS:
        own = [r for r in rows if r["traffic"] == source and r["layout"] == layouts[0]]
        console.print(
            f"{NAMES[source]}: {np.mean([r['objects'] for r in own]):.1f} objects, "
            f"H(Ω) {np.mean([r['entropy'] for r in own]):,.0f} bits, "
            f"{np.mean([r['voxels_ever_occupied'] for r in own]):.1%} of the voxels ever occupied",
            highlight=False,
        )
    figure = draw(drawn, rows, layouts)
    write_results(
        output(options, "traffic_sources"), rows, settings | dict(place=place.name), figure
    )


def mean(rows: list[dict[str, Any]], source: str, layout: str, key: str) -> float:
    """A score, mean over the seeds."""
    own = [r[key] for r in rows if (r["traffic"], r["layout"]) == (source, layout)]
    return float(np.mean(own))


def draw(
    drawn: dict[str, tuple[Scene, np.ndarray]], rows: list[dict[str, Any]], layouts: list[str]
) -> Figure:
    """p̂ at one height by both, and IG and P_sm of each placement."""
    figure = Figure(figsize=(12.5, 4.4), layout="constrained")
    panels = figure.subplots(1, 3, width_ratios=[1, 1, 1.05])
    for panel, (source, (scene, share)) in zip(panels, drawn.items(), strict=False):
        level = min(int(LEVEL / scene.voxels.size), scene.voxels.level_count - 1)
        raster, (x0, x1, y0, y1) = column_raster(scene.voxels, share[:, level])
        image = panel.imshow(
            raster, extent=(x0, x1, y0, y1), origin="lower", cmap="magma", vmin=0, vmax=0.5
        )
        panel.set_title(f"{NAMES[source]}, {scene.traffic.mean_count:.0f} objects", fontsize=10)
        panel.set(xlabel="x, east [m]", ylabel="y, north [m]", aspect="equal")
        panel.set_facecolor("0.92")
    label = f"occupancy p̂ of the voxels {LEVEL:g} m above the ground"
    bar = figure.colorbar(image, ax=panels[:2], location="bottom", shrink=0.5, extend="max")
    bar.set_label(label)
    axes, at = panels[2], np.arange(len(layouts))
    for key, marker, label in (("information_gain", "s", "IG"), ("surrogate", "o", "P_sm")):
        for shift, source in zip((-0.12, 0.12), TRAFFIC_MODELS, strict=True):
            for k, name in enumerate(layouts):
                own = [r[key] for r in rows if (r["traffic"], r["layout"]) == (source, name)]
                axes.plot(
                    own, np.full(len(own), at[k] + shift), marker, ms=5, alpha=0.8, mfc="none",
                    color=COLORS[source],
                    label=f"{label}, {NAMES[source]}" if k == 0 else None,
                )  # fmt: skip
    axes.set_yticks(at, layouts)
    axes.set(xlabel="score, one mark a seed", xlim=(0, 1.02))
    axes.invert_yaxis()
    axes.grid(axis="x", alpha=0.3)
    axes.legend(fontsize=8, loc="lower left")
    return figure


if __name__ == "__main__":
    main()
