"""Claim: static bodies matter to placements.

1. P_sm of the nine placements in the open and between bodies. On a crossroads of Berlin-Neukölln
   from OpenStreetMap these are its houses, trees and poles. On the built-in four-way and on a
   junction of a CARLA town map, where the maps are beside the checkout, it is street furniture:
   parked vehicles, trees, walls, posts and shelters. Poles stand clear of bodies, and so may move.
2. The time and the memory of an exact score on the default four-way with 60 houses, 2 m behind the
   regions, and 100 trees along the backs of sidewalks, against the same scene without: times by
   turns in one process, peak memory in a process each.
"""

import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from common import MAPS, METRICS, arguments, console, output, peak_memory, show, write_results
from rich.progress import track
from shapely.geometry import Point

import inspe_jax
from inspe_jax import Layout, Scene
from inspe_jax.scene.maps.registry import list_junctions, read_map
from inspe_jax.scene.statics import StaticBody, body, tree, upright_box
from inspe_jax.scene.street import room_along

TOWN, JUNCTION, RADIUS = "Town10HD.xodr", 189, 50.0
BLOCK = Path(__file__).resolve().parents[1] / "tests" / "maps" / "neukoelln.osm.gz"
HOUSES, TREES = 60, 100
ROUNDS = 15
"""Timed scores of each scene."""


def placements(scenes: dict[str, tuple[Scene, Scene]], names: list[str]) -> list[dict[str, Any]]:
    """The metrics of placements, in the open and between bodies."""
    rows = []
    for place, pair in scenes.items():
        for name in track(names, place, console=console, transient=True):
            row: dict[str, Any] = dict(scene=place, placement=name)
            for statics, scene in zip(("none", "bodies"), pair, strict=True):
                found = inspe_jax.evaluate(scene, inspe_jax.strategy(scene, name))
                row |= {f"{key}_{statics}": found.value(key) for key in METRICS}
            rows.append(row)
    return rows


def town_bodies(scene: Scene) -> list[StaticBody]:
    """:data:`HOUSES` houses, every second one L-shaped, and :data:`TREES` trees."""
    rng = np.random.default_rng(0)
    houses: list[StaticBody] = []
    for spot in room_along(scene.intersection, RADIUS, 5.0)[:HOUSES]:
        size = rng.uniform([3.5, 8.0], [4.6, 12.0])
        house = upright_box(
            "building", spot.moved(2 + size[1] / 2), (*size, rng.uniform(6, 18)), spot.yaw
        )
        if len(houses) % 2:
            a, b, c, d = house.outline
            ell = [a, b, c, (c + d) / 2, (a + c) / 2, (a + d) / 2]
            house = body("building", ell, house.height)
        houses.append(house)
    trees = [
        tree(spot.moved(-0.3), radius=1.8, height=7, base=2.5)
        for spot in room_along(scene.intersection, RADIUS, 3.0)[:TREES]
    ]
    return [*houses, *trees]


def cost(name: str, rounds: int) -> dict[str, Any]:
    """Seconds of an exact score without and with bodies, and the median of their ratios."""
    scene, full, layout = pair_of(name)
    pair, taken = (scene, full), np.zeros((2, rounds + 1))
    for k in range(rounds + 1):
        for which, of in enumerate(pair):
            begin = time.perf_counter()
            inspe_jax.evaluate(of, layout)
            taken[which, k] = time.perf_counter() - begin
    bare, full_times = taken[:, 1:]  # the first compiles
    peaks = [peak_of(name, bodies) for bodies in (False, True)]
    return dict(
        placement=name,
        bodies=len(full.statics),
        seconds_none=float(np.median(bare)),
        seconds_bodies=float(np.median(full_times)),
        ratio=float(np.median(full_times / bare)),
        peak_gib_none=round(peaks[0], 3),
        peak_gib_bodies=round(peaks[1], 3),
    )


def pair_of(name: str) -> tuple[Scene, Scene, Layout]:
    """The default four-way without bodies and with, and a placement on it."""
    scene = inspe_jax.build_scene(inspe_jax.built_in("four_way"))
    layout = inspe_jax.strategy(scene, name)
    feet = [Point(pose[:2]) for pose in np.asarray(layout.poses)]
    bodies = [
        one for one in town_bodies(scene) if not any(one.polygon.contains(foot) for foot in feet)
    ]
    return scene, scene.with_statics(bodies), layout


def score_once(name: str, bodies: bool) -> float:
    """Score in this process, and give its peak memory [GiB]."""
    bare, full, layout = pair_of(name)
    inspe_jax.evaluate(full if bodies else bare, layout)
    return peak_memory()


def peak_of(name: str, bodies: bool) -> float:
    """The peak memory of a fresh process that scores [GiB]."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(score_once, name, bodies).result()


def main() -> None:
    """Score, time, print and write."""
    options = arguments(__doc__, "seed")
    quick = options.quick
    size: dict[str, Any] = dict(radius=15, voxel=1.0, frames=3) if quick else {}
    places = {"four_way": inspe_jax.built_in("four_way")}
    if not quick and (MAPS / TOWN).is_file():
        places[f"{TOWN} {JUNCTION}"] = read_map(MAPS / TOWN, junction=JUNCTION, radius=RADIUS)
    if not quick:
        (signalled,) = [one.id for one in list_junctions(BLOCK) if one.signals]
        places["Berlin-Neukölln"] = read_map(BLOCK, junction=signalled, radius=RADIUS)
    scenes = {}
    for name, place in places.items():
        bodies = inspe_jax.build_scene(
            place, seed=options.seed, statics="map" if place.bodies else "street", **size
        )
        scenes[name] = bodies.with_statics([]), bodies
    names = ["Cam-d1", "L-d2"] if quick else list(inspe_jax.STRATEGIES)
    rows = placements(scenes, names)
    shown = [f"{key}_{of}" for key in ("coverage", "occlusion", "surrogate")
             for of in ("none", "bodies")]  # fmt: skip
    cells = [[row["scene"], row["placement"], *(f"{row[k]:.3f}" for k in shown)] for row in rows]
    show(("scene", "placement", "C", "", "O", "", "P_sm", ""), cells, "In the open, with bodies")
    counts = {name: len(full.statics) for name, (_, full) in scenes.items()}
    write_results(output(options, "statics"), rows, dict(seed=options.seed, bodies=counts))
    if not quick:
        times = [cost(name, ROUNDS) for name in ("Cam-d1/L-d1", "L-d2")]
        for row in times:
            console.print(row)
        write_results(options.out / "statics_cost", times, dict(rounds=ROUNDS))


if __name__ == "__main__":
    main()
