"""Claim: the exact scores are what rays and triangles say, voxel by voxel.

For every device of the catalogue, at random poses on the built-in four-way (or on
sloping Town03 junction 222 where the map is at hand): the share of voxels on which
in view agrees with an exact walk of every ray, and coverage C by our kernel, by the
exact walk and by the paper's Bresenham lines. The default scores mean the exact
walk. Then the share of (sensor, voxel, frame) on which line of sight agrees with
Embree.
"""

from typing import Any

import numpy as np
import raycast
from benchmark_speed import Embree
from common import arguments, console, output, show, town_junction, write_results
from rich.progress import track

import inspe_jax
from inspe_jax import Layout, Scene, Sensor, Unit
from inspe_jax.sensing.sensors import Spec


def world(quick: bool, seed: int) -> Scene:
    """A scene with slopes where the map is at hand, else the built-in four-way."""
    radius, frames = (20.0, 2) if quick else (30.0, 5)
    place = town_junction("Town03", 222, radius, quick)
    return inspe_jax.build_scene(place, profile="ideal", radius=radius, frames=frames, seed=seed)


def random_layout(scene: Scene, specs: list[Spec], rng: np.random.Generator) -> Layout:
    """Each sensor alone at a random place 1 to 8 m above the ground, turned at random."""
    xy = scene.voxels.center[:2] + rng.uniform(-15, 15, (len(specs), 2))
    z = scene.intersection.ground(xy) + rng.uniform(1, 8, len(specs))
    angles = rng.uniform([-0.1, -0.6, -np.pi], [0.1, 0.1, np.pi], (len(specs), 3))
    sensors = [Sensor(f"{spec.name} {i}", spec, i) for i, spec in enumerate(specs)]
    units = [Unit(f"unit {i}", (x, y, h)) for i, ((x, y), h) in enumerate(zip(xy, z, strict=True))]
    return inspe_jax.make_layout(sensors, units, np.column_stack([xy, z, angles]))


def main() -> None:
    """Compare, print and write."""
    options = arguments(__doc__, "seed")
    rng = np.random.default_rng(options.seed)
    scene = world(options.quick, options.seed)
    weight = scene.voxels.weight / scene.voxels.weight.sum()
    catalogue = inspe_jax.devices()
    names = ["paper-lidar-32", "paper-camera"] if options.quick else list(catalogue)
    poses = 2 if options.quick else 3

    rows: list[dict[str, Any]] = []
    for name in track(names, "walking rays", console=console, transient=True):
        layout = random_layout(scene, [catalogue[name].spec] * poses, rng)
        ours = inspe_jax.in_view(scene, layout)
        exact = raycast.in_view(scene, layout, "exact")
        paper = raycast.in_view(scene, layout, "bresenham")
        rows.append(
            dict(
                device=name,
                agreement=float((ours == exact).mean(1).min()),
                agreement_bresenham=float((paper == exact).mean(1).min()),
                coverage=float((ours @ weight).mean()),
                coverage_exact=float((exact @ weight).mean()),
                coverage_bresenham=float((paper @ weight).mean()),
                largest_difference=float(np.abs(ours @ weight - exact @ weight).max()),
            )
        )
    layout = random_layout(scene, [catalogue[name].spec for name in names], rng)
    everything = np.ones((len(layout), scene.voxels.count), bool)
    embree = Embree(scene, layout, everything)
    differ = [
        inspe_jax.line_of_sight(scene, layout, k) != np.stack(embree.frame(k))
        for k in range(scene.traffic.frame_count)
    ]
    sight = 1.0 - float(np.mean(differ))

    show(
        ("device", "agrees", "Bresenham\nagrees", "C", "C\nexact", "C\nBresenham"),
        [
            (r["device"], f"{r['agreement']:.5%}", f"{r['agreement_bresenham']:.2%}")
            + tuple(f"{r[k]:.4f}" for k in ("coverage", "coverage_exact", "coverage_bresenham"))
            for r in rows
        ],
        f"In view on {scene.name}, worst of {poses} random poses; C is their mean",
    )
    total = np.size(differ)
    console.print(f"line of sight agrees with Embree on {sight:.6%} of {total:,} triples")
    settings = dict(scene.settings, seed=options.seed, poses=poses, line_of_sight=sight)
    write_results(output(options, "agreement"), rows, settings)


if __name__ == "__main__":
    main()
