"""Claim: exact scores of a whole layout in a tenth of a second, far ahead of a ray tracer.

W1 is Town05 junction 53 (the built-in four-way where the map is not at hand): radius
50 m, 0.5 m voxels, 8 cameras and 4 LiDARs, 100 frames, 40 objects. W2 is the same in 0.2 m
voxels; W3 has radius 100 m, 24 sensors, 300 frames and 60 objects. Timed in one run on the
same cores: our exact scores, cold (with compilation) and warm; the same without masks and
culling, every prism against every column (how this package began); Embree on its best case,
the segments to the voxels that each sensor has in view, nothing else; and the paper's
Bresenham caster, which answers coverage alone. The rivals' answers are compared with ours.
Then how the time grows with sensors, frames and objects; what a soft score and its gradient take,
which fails where that is twice the usual number of exact scores; and what a gradient on a sample
takes beside what a search charges for it. Ratios are what to quote: machines differ. Ours runs on
the device that JAX runs on.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import raycast
from common import (
    arguments,
    console,
    in_fresh_process,
    machine,
    output,
    peak_memory,
    show,
    town_junction,
    write_results,
)
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

import inspe_jax
from inspe_jax import Layout, Scene
from inspe_jax.core.arrays import from_center
from inspe_jax.placement.problem import Problem

SOFTNESS = 0.5
"""Of the gradient that is timed [m]."""
SAMPLES = ((384, 3), (768, 6), (1536, 8), (2048, 8))
"""Columns and frames of the samples on which gradients are timed."""

WORKLOADS: dict[str, dict[str, Any]] = {
    "W1": dict(radius=50.0, voxel=0.5, density=40, frames=100),
    "W2": dict(radius=50.0, voxel=0.2, spacing=0.2, density=40, frames=100),
    "W3": dict(radius=100.0, voxel=0.5, density=60, frames=300),
    "quick": dict(radius=20.0, voxel=0.5, density=20, frames=10),
}
GRADIENT = {"W1": 10, "quick": 6}
"""Usual time of a gradient in all poses, in exact scores of the same layout."""


def workload(name: str, seed: int, **other: Any) -> Scene:
    """One of the workloads, some of its settings changed."""
    size: dict[str, Any] = dict(seed=seed) | WORKLOADS[name] | other
    place = town_junction("Town05", 53, size["radius"], quick=name == "quick")
    return inspe_jax.build_scene(place, **size)


def sensors(scene: Scene, times: int = 1) -> Layout:
    """8 cameras and 4 LiDARs on four units; several times over, each time turned further."""
    layout = inspe_jax.strategy(scene, "Cam-d1/L-d1")
    poses = np.asarray(layout.poses)
    all_poses = [poses + [0, 0, 0, 0, 0, np.pi / 3 * k] for k in range(times)]
    return Layout(np.concatenate(all_poses), layout.sensors * times, layout.units, layout.name)


def box_triangles(scene: Scene, frame: int) -> np.ndarray:
    """One frame's vehicles as triangles (N, 3, 3), about the scene's centre, sunk to the ground."""
    t = scene.traffic
    on = np.flatnonzero(t.valid[frame])
    sign = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2
    flat = sign * t.size[frame, on, None, :2]  # (N, 4, 2)
    cos, sin = np.cos(t.yaw[frame, on])[:, None], np.sin(t.yaw[frame, on])[:, None]
    x = cos * flat[..., 0] - sin * flat[..., 1] + t.center[frame, on, None, 0]
    y = sin * flat[..., 0] + cos * flat[..., 1] + t.center[frame, on, None, 1]
    top = t.center[frame, on, 2] + t.size[frame, on, 2] / 2
    levels = [np.broadcast_to((z)[:, None], x.shape) for z in (top - 30.0, top)]
    corners = np.concatenate([np.stack([x, y, z], -1) for z in levels], axis=1)  # (N, 8, 3)
    faces = np.array(
        [[0, 1, 2], [0, 2, 3], [4, 6, 5], [4, 7, 6], [0, 4, 5], [0, 5, 1]]
        + [[1, 5, 6], [1, 6, 2], [2, 6, 7], [2, 7, 3], [3, 7, 4], [3, 4, 0]]
    )
    return (corners[:, faces] - scene.voxels.center).reshape(-1, 3, 3)


class Embree:
    """Segment queries to the voxels in view; the segments are made beforehand, untimed."""

    def __init__(self, scene: Scene, layout: Layout, seen: np.ndarray) -> None:
        """``seen`` (S, V) is what each sensor has in view."""
        self.scene = scene
        self.origins, self.directions, self.lengths = [], [], []
        for pose, row in zip(np.asarray(layout.poses), seen, strict=True):
            to = scene.voxels.centers[row] - pose[:3]
            length = np.linalg.norm(to, axis=1)
            self.lengths.append(length.astype(np.float32))
            self.directions.append((to / length[:, None]).astype(np.float32))
            start = (pose[:3] - scene.voxels.center).astype(np.float32)
            self.origins.append(np.repeat(start[None], len(to), 0))
        self.meshes = [
            box_triangles(scene, k).astype(np.float32) for k in range(scene.traffic.frame_count)
        ]
        self.segments = sum(map(len, self.lengths)) * len(self.meshes)

    def frame(self, k: int) -> list[np.ndarray]:
        """Whether each segment of each sensor is clear in frame ``k``."""
        engine = EmbreeScene()
        TriangleMesh(engine, self.meshes[k])
        return [
            engine.run(o, d, dists=n) < 0
            for o, d, n in zip(self.origins, self.directions, self.lengths, strict=True)
        ]

    def __call__(self) -> None:
        """All frames."""
        for k in range(len(self.meshes)):
            self.frame(k)


def seconds(call: Callable[[], Any], repeats: int) -> float:
    """Median wall time of ``repeats`` calls."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def sampled_gradients(scene: Scene, quick: bool) -> list[dict[str, Any]]:
    """What the gradient of a layout on a sample takes, in hard scores of it on the same sample, and
    what a search charges for it. Both in turns, the least of several."""
    found = []
    for name in ("L-d1",) if quick else ("Cam-d1", "L-d1", "Cam-d1/L-d1"):
        layout = inspe_jax.strategy(scene, name)
        problem, poses = Problem(scene, layout), from_center(scene.voxels.center, layout.poses)
        x = problem.space.start(layout)[0][None]
        for size in SAMPLES[: 1 if quick else None]:
            drawn = problem.draw(np.random.default_rng(0), *size)
            on, sample = problem.take(drawn), problem.sample(np.random.default_rng(0), *size)
            calls = (
                partial(problem.slope, poses, on, jnp.asarray(SOFTNESS)),
                partial(problem.rough, x, sample),
            )
            soft, hard = np.min([[seconds(call, 1) for call in calls] for _ in range(9)], 0)
            charged = problem.gradient_cost(drawn) / problem.sample_cost(drawn)
            found.append(
                dict(
                    layout=name, columns=size[0], frames=size[1],
                    ratio=float(soft / hard), charged=float(charged),
                )
            )  # fmt: skip
            console.print(
                f"{name}, {size[0]} columns × {size[1]} frames: a gradient takes {soft / hard:.1f} "
                f"hard scores and is charged {charged:.1f}",
                highlight=False,
            )
    return found


def every(layout: Layout, n: int) -> Layout:
    """Every ``n``-th sensor."""
    return Layout(layout.poses[::n], layout.sensors[::n], layout.units, layout.name)


def growth(name: str, seed: int, repeats: int) -> list[dict[str, Any]]:
    """Seconds with more sensors, frames and objects; and the exponents fitted to them."""
    scene = workload(name, seed)
    whole, frames = sensors(scene), scene.traffic.frame_count
    few = 2 if name == "quick" else None

    def first(count: int) -> Scene:
        return replace(scene, traffic=jax.tree.map(lambda leaf: leaf[:count], scene.traffic))

    cases: dict[str, list[tuple[int, Scene, Layout]]] = {
        "sensors": [
            (3, scene, every(whole, 4)),
            *((len(whole) * n, scene, sensors(scene, n)) for n in (1, 2, 4)),
        ],
        "frames": [(n, first(n), whole) for n in (frames, frames // 2, frames // 4 + 1)],
        "objects": [(n, workload(name, seed, density=n), whole) for n in (10, 20, 40)[:few]],
    }
    rows = []
    for what, sizes in cases.items():
        sizes, found = sizes[:few], []
        for _, place, layout in sizes:
            inspe_jax.evaluate(place, layout)
            found.append(seconds(partial(inspe_jax.evaluate, place, layout), repeats))
        at = [size for size, _, _ in sizes]
        exponent = float(np.polyfit(np.log(at), np.log(found), 1)[0])
        for size, took in zip(at, found, strict=True):
            rows.append(dict(what=what, size=size, seconds=took, exponent=exponent))
        times = ", ".join(f"{n}: {t:.3f} s" for n, t in zip(at, found, strict=True))
        console.print(f"{what}: {times}; exponent {exponent:.2f}", highlight=False)
    return rows


def slope(scene: Scene, layout: Layout) -> dict[str, float]:
    """Seconds of a soft score and its gradient in all poses, every frame, cold and warm; and of
    exact scores of the same layout, warm."""

    def score(poses: jax.Array) -> Any:
        return inspe_jax.evaluate(scene, layout.with_poses(poses), softness=SOFTNESS).surrogate

    poses, call = jnp.asarray(layout.poses, float), jax.jit(jax.value_and_grad(score))

    def soft() -> None:
        jax.block_until_ready(call(poses))

    def hard() -> None:
        inspe_jax.evaluate(scene, layout)

    cold = seconds(soft, 1)
    hard()
    warm, exact = np.min([[seconds(soft, 1), seconds(hard, 3)] for _ in range(3)], 0).tolist()
    return dict(slope_cold=cold, slope=warm, slope_ratio=warm / exact)


def measured(name: str, seed: int) -> dict[str, Any]:
    """One workload: cold and warm seconds and the peak memory of scores, then of gradients."""
    scene = workload(name, seed)
    layout = sensors(scene, 2 if name == "W3" else 1)
    cold, warm = (seconds(lambda: inspe_jax.evaluate(scene, layout), n) for n in (1, 5))
    found: dict[str, Any] = dict(what=name, voxels=scene.voxels.count, sensors=len(layout))
    found |= dict(cold=cold, warm=warm, memory=peak_memory())
    found |= slope(scene, every(layout, 3) if name == "quick" else layout)
    return found | dict(slope_memory=peak_memory())


def main() -> None:
    """Run, print and write the table."""
    options = arguments(__doc__, "seed")
    repeats = 2 if options.quick else 5
    console.print(" · ".join(f"{k} {v}" for k, v in machine().items()), highlight=False)
    name = "quick" if options.quick else "W1"
    scene = workload(name, options.seed)
    layout = sensors(scene)
    grid, traffic = scene.voxels, scene.traffic
    size = dict(
        scene=scene.name,
        columns=len(grid.columns),
        voxels=grid.count,
        sensors=len(layout),
        frames=traffic.frame_count,
        objects=round(traffic.mean_count, 1),
    )
    console.print(" · ".join(f"{k} {v}" for k, v in size.items()), highlight=False)

    cold = seconds(lambda: inspe_jax.evaluate(scene, layout), 1)
    warm = seconds(lambda: inspe_jax.evaluate(scene, layout), 3 * repeats)
    memory = peak_memory()
    seen = inspe_jax.in_view(scene, layout)
    embree = Embree(scene, layout, seen)
    traced = seconds(embree, 1 if options.quick else 3)
    walked = seconds(lambda: raycast.in_view(scene, layout), 1)

    agree = [
        inspe_jax.line_of_sight(scene, layout, k)[s][seen[s]] == clear
        for k in range(min(5, traffic.frame_count))
        for s, clear in enumerate(embree.frame(k))
    ]
    same = float(np.concatenate(agree).mean())
    rows: list[dict[str, Any]] = [
        dict(what="exact scores, cold", seconds=cold, ratio=cold / warm),
        dict(what="exact scores, warm", seconds=warm, ratio=1.0),
        dict(what="Embree, in-view segments", seconds=traced, ratio=traced / warm),
        dict(what="Bresenham, coverage alone", seconds=walked, ratio=walked / warm),
    ]
    cells = [(row["what"], f"{row['seconds']:.3f}", f"{row['ratio']:.1f}") for row in rows]
    show(("", "seconds", "× warm"), cells, "One layout on one scene")
    console.print(
        f"{embree.segments / 1e6:.1f} million segments, {embree.segments / traced / 1e6:.1f} "
        f"million a second; line of sight agrees on {same:.6%}; peak memory of scoring "
        f"{memory:.2f} GiB",
        highlight=False,
    )
    names = [n for n in WORKLOADS if (n == "quick") == options.quick]
    others = [in_fresh_process(measured, n, options.seed) for n in names]
    for row in others:
        row["ratio"] = row["warm"] / others[0]["warm"]
    show(
        ("", "voxels", "sensors", "cold [s]", "warm [s]", "× W1", "peak GiB"),
        [
            (row["what"], *(f"{row[k]:,}" for k in ("voxels", "sensors")))
            + tuple(f"{row[k]:.2f}" for k in ("cold", "warm", "ratio", "memory"))
            for row in others
        ],
    )
    soft = ("slope_cold", "slope", "slope_ratio", "slope_memory")
    show(
        ("", "cold [s]", "warm [s]", "× score", "peak GiB"),
        [(row["what"], *(f"{row[k]:.2f}" for k in soft)) for row in others],
        "Value and gradient",
    )
    for row in others:
        usual = GRADIENT.get(row["what"], np.inf)
        if row["slope_ratio"] > 2 * usual:
            sys.exit(f"a gradient takes {row['slope_ratio']:.0f} exact scores; {usual} is usual")
    grown = growth(name, options.seed, repeats)
    gradients = sampled_gradients(scene, options.quick)

    settings = {
        **size,
        "seed": options.seed,
        "agreement": same,
        "peak_memory_gib": memory,
        "workloads": others,
        "growth": grown,
        "sampled_gradients": gradients,
        "softness": SOFTNESS,
    }
    write_results(output(options, "benchmark_speed"), rows, settings)


if __name__ == "__main__":
    main()
