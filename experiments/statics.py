"""Claim: static bodies matter to placements.

P_sm of the nine placements in the open and between bodies. On a crossroads of Berlin-Neukölln from
OpenStreetMap these are its houses, trees and poles. On the built-in four-way and on a junction of a
CARLA town map, where the maps are beside the checkout, it is street furniture: parked vehicles,
trees, walls, posts and shelters. Poles stand clear of bodies, and so may move.
"""

from pathlib import Path
from typing import Any

from common import MAPS, METRICS, arguments, console, output, show, write_results
from rich.progress import track

import inspe_jax
from inspe_jax import Scene
from inspe_jax.scene.maps.registry import list_junctions, read_map

TOWN, JUNCTION, RADIUS = "Town10HD.xodr", 189, 50.0
BLOCK = Path(__file__).resolve().parents[1] / "tests" / "maps" / "neukoelln.osm.gz"


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
    names = ["L-d2"] if quick else list(inspe_jax.STRATEGIES)
    rows = placements(scenes, names)
    shown = [f"{key}_{of}" for key in ("coverage", "occlusion", "surrogate")
             for of in ("none", "bodies")]  # fmt: skip
    cells = [[row["scene"], row["placement"], *(f"{row[k]:.3f}" for k in shown)] for row in rows]
    show(("scene", "placement", "C", "", "O", "", "P_sm", ""), cells, "In the open, with bodies")
    counts = {name: len(full.statics) for name, (_, full) in scenes.items()}
    write_results(output(options, "statics"), rows, dict(seed=options.seed, bodies=counts))


if __name__ == "__main__":
    main()
