"""Claim: detectability tells apart layouts that nearly all score 1 in P_sm, and a search raises it.

On the built-in four-way, under both profiles: detectability D and P_sm of the paper's nine
placements, and of 100 random layouts that can be mounted for each of several numbers of LiDARs and
cameras, apart and all together. What is compared is the interquartile range. Then a search for D
with LiDARs and cameras, and maps before and after it of how many LiDAR returns a pedestrian gets
and how many pixels per metre there are.
"""

from typing import Any

import numpy as np
from common import arguments, console, output, show, write_results
from rich.progress import track

import inspe_jax
from inspe_jax import Layout, Scene
from inspe_jax.core.sheet import save_figure
from inspe_jax.mounting.mixes import mix_name, starting_layout
from inspe_jax.placement.objective import Objective
from inspe_jax.placement.problem import Problem
from inspe_jax.report.targets import targets_change

NINE = [*(f"{kind}-{how}" for kind in ("Cam", "L") for how in ("c", "d1", "d2"))]
NINE += [f"Cam-{how}/L-{how}" for how in ("c", "d1", "d2")]
BY_HAND, AT_RANDOM = "the nine placements", "all at random"
MIXES: tuple[dict[str, int], ...] = (
    {"lidar-32": 1},
    {"lidar-32": 2},
    {"lidar-32": 4},
    {"lidar-32": 1, "camera": 4},
    {"lidar-32": 2, "camera": 2},
)
"""Numbers of each profile's own devices, and all have LiDARs."""
SEARCHED = {"paper-lidar-32": 1, "paper-camera": 3}
"""The sensors of the search that is drawn: few, so that much is left to gain."""


def spread(values: list[float]) -> dict[str, float]:
    """Least, median, greatest and interquartile range."""
    low, middle, high = np.percentile(values, [25, 50, 75])
    return dict(least=min(values), median=middle, most=max(values), iqr=high - low)


def scores(scene: Scene, layouts: list[Layout]) -> dict[str, list[float]]:
    """D and P_sm of layouts."""
    found = [inspe_jax.evaluate(scene, of, metrics=("detectability",)) for of in layouts]
    return {
        "D": [of.metrics["detectability"] for of in found],
        "P_sm": [of.surrogate for of in found],
    }


def main() -> None:
    """Measure, print and draw."""
    given = arguments(__doc__, "seed")
    size: dict[str, Any] = dict(frames=40, seed=given.seed)
    if given.quick:
        size |= dict(radius=15, voxel=1.0, frames=3, density=8)
    number = 2 if given.quick else 100
    rows: list[dict[str, Any]] = []
    place = inspe_jax.built_in("four_way")
    for profile in ("ideal", "paper")[given.quick :]:
        scene = inspe_jax.build_scene(place, profile=profile, **size)
        by_hand = NINE[-1:] if given.quick else NINE
        groups = {BY_HAND: [inspe_jax.strategy(scene, name) for name in by_hand]}
        for mix in MIXES[:1] if given.quick else MIXES:
            own = {f"{profile}-{name}": count for name, count in mix.items()}
            problem = Problem(scene, starting_layout(scene, own))
            points = problem.space.random(np.random.default_rng(given.seed), number)
            groups[mix_name(mix)] = [problem.space.layout(x) for x in points]
        found = {
            name: scores(scene, layouts)
            for name, layouts in track(groups.items(), profile, console=console)
        }
        at_random = [own for name, own in found.items() if name != BY_HAND]
        found[AT_RANDOM] = {
            metric: [v for own in at_random for v in own[metric]] for metric in at_random[0]
        }
        rows += [
            dict(profile=profile, layouts=name, number=len(values), metric=metric) | spread(values)
            for name, own in found.items()
            for metric, values in own.items()
        ]
    names, numbers = ("profile", "layouts", "metric"), ("least", "median", "most", "iqr")
    cells = [[*(r[key] for key in names), *(f"{r[key]:.3f}" for key in numbers)] for r in rows]
    show((*names, *numbers), cells)

    start = starting_layout(scene, SEARCHED)
    budget: dict[str, Any] = dict(evaluations=8) if given.quick else dict(seconds=120)
    objective = Objective(weights={"detectability": 1.0})
    result = inspe_jax.optimise(scene, start, seed=given.seed, objective=objective, **budget)
    console.print(f"{start.name}: D {result.objective_before:.3f} to {result.objective:.3f}")
    pairs = [(of, inspe_jax.target_view(scene, of)) for of in (result.start, result.layout)]
    stem, settings = output(given, "detectability"), size | dict(number=number)
    save_figure(targets_change(scene, *pairs), stem.with_suffix(".png"))
    write_results(stem, rows, settings | dict(search=result.settings))


if __name__ == "__main__":
    main()
