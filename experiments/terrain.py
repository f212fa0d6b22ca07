"""Claim: the ground hides almost nothing, not even where a road goes over a crest.

It takes most from P_sm on a raised deck in Town03: 0.004. A crest with a radius of 500 m takes
nothing, one of 250 m 0.0004: sensors at 6 m and more look over it.

P_sm of the nine placements, with the ground in the way and without, at the ten intersections, where
the maps are beside the checkout; and at the built-in four-way laid over a crest, a parabola along x
with a radius of 500 or 250 m, so that the ground falls by 10 or 20 % at 50 m. Voxels and sensors
stand at the same places in both. Beside it, the ratio of the times of an exact score.
"""

import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from common import METRICS, arguments, console, on_maps, output, show, write_results
from rich.progress import track
from table2 import places

import inspe_jax
from inspe_jax import Layout, Scene
from inspe_jax.scene.intersection import Intersection
from inspe_jax.scene.maps.registry import read_map

CRESTS = (500.0, 250.0)
"""Radius of the crest [m]: residential streets have such."""
RADIUS, ROUNDS = 50.0, 5


def over_crest(place: Intersection, radius: float) -> Intersection:
    """A place whose road along x goes over a crest of a radius [m]."""
    side = np.arange(-80.0, 81.0, 2.0)
    x, y = (part.ravel() for part in np.meshgrid(side, side, indexing="ij"))
    laid = place.standing_on(np.column_stack([x, y, -(x**2) / (2 * radius)]))
    return replace(laid, name=f"{place.name}, crest of {radius:g} m")


def intersections(given: Any) -> Iterator[Intersection]:
    """The crests, then the ten intersections."""
    for radius in CRESTS:
        yield over_crest(inspe_jax.built_in("four_way"), radius)
    for entry in () if given.quick else on_maps(places(given)):
        at = {key: entry[key] for key in ("junction", "center") if key in entry}
        yield replace(read_map(entry["map"], **at, radius=RADIUS), name=entry["name"])


def seconds(scene: Scene, layout: Layout) -> float:
    """Of an exact score."""
    begin = time.perf_counter()
    inspe_jax.evaluate(scene, layout)
    return time.perf_counter() - begin


def compared(place: Intersection, names: list[str], **size: Any) -> list[dict[str, Any]]:
    """A row for each placement; none where the ground is level."""
    hilly = inspe_jax.build_scene(place, terrain="ground", **size)
    if hilly.terrain is None:
        return []
    pair = replace(hilly, terrain=None), hilly
    rows = []
    for name in track(names, place.name, console=console, transient=True):
        layout = inspe_jax.strategy(hilly, name)
        row: dict[str, Any] = dict(scene=place.name, placement=name)
        row |= dict(steepest=hilly.terrain.steepest, range=np.ptp(hilly.terrain.heights))
        for of, scene in zip(("none", "ground"), pair, strict=True):
            found = inspe_jax.evaluate(scene, layout)
            row |= {f"{key}_{of}": found.value(key) for key in METRICS}
        taken = np.array([[seconds(scene, layout) for scene in pair] for _ in range(ROUNDS)])
        rows.append(row | dict(time_ratio=float(np.median(taken[:, 1] / taken[:, 0]))))
    return rows


def main() -> None:
    """Score, time, print and write."""
    given = arguments(__doc__, "seed")
    size: dict[str, Any] = dict(radius=RADIUS, seed=given.seed)
    if given.quick:
        size |= dict(radius=15, voxel=1.0, frames=3)
    names = ["L-d2"] if given.quick else list(inspe_jax.STRATEGIES)
    rows: list[dict[str, Any]] = []
    for place in intersections(given):
        rows += compared(place, names, **size)
    cells = []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        own = [row for row in rows if row["scene"] == scene]
        lost = {
            key: max(own, key=lambda row: row[f"{key}_none"] - row[f"{key}_ground"])
            for key in ("coverage", "occlusion", "surrogate")
        }
        told = [f"{row[f'{key}_none'] - row[f'{key}_ground']:.4f}" for key, row in lost.items()]
        ratio = np.median([row["time_ratio"] for row in own])
        cells.append((scene, *told, lost["surrogate"]["placement"], f"{ratio:.2f} ×"))
    show(("scene", "largest loss of C", "O", "P_sm", "placement", "time"), cells)
    write_results(output(given, "terrain"), rows, dict(seed=given.seed, crests=CRESTS))


if __name__ == "__main__":
    main()
