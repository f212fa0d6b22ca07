"""Claim: exact scores of a whole layout in about a second, ahead of a ray tracer.

W1 is Town05 junction 53 (the built-in four-way where the map is not at hand):
radius 50 m, 0.5 m voxels, 8 cameras and 4 LiDARs, 100 frames, 40 objects. Timed
in one run on the same cores: our exact scores, cold (with compilation) and warm;
Embree on its best case, the segments to the voxels that each sensor has in view,
nothing else; and the paper's Bresenham caster, which answers coverage alone.
The rivals' answers are compared with ours. Ratios are what to quote: machines
differ.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from common import MAPS, arguments, machine, peak_memory, write_results
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

import inspe_jax
from inspe_jax import Layout, Scene
from inspe_jax.sensing import raycast

console = Console()


def workload(quick: bool, seed: int) -> Scene:
    """W1, or a small one with ``quick``."""
    size: dict[str, Any] = dict(radius=50.0, voxel=0.5, density=40, frames=100)
    if quick:
        size = dict(radius=25.0, voxel=0.5, density=10, frames=5)
    if not quick and (MAPS / "Town05.xodr").is_file():
        from inspe_jax.scene.opendrive import read_opendrive

        place = read_opendrive(MAPS / "Town05.xodr", junction=53, radius=size["radius"])
    else:
        place = inspe_jax.built_in("four_way")
    return inspe_jax.build_scene(place, **size, seed=seed)


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


def main() -> None:
    """Run, print and write the table."""
    options = arguments(__doc__)
    repeats = 2 if options.quick else 5
    console.print(" · ".join(f"{k} {v}" for k, v in machine().items()), highlight=False)
    scene = workload(options.quick, options.seed)
    layout = inspe_jax.strategy(scene, "Cam-d1/L-d1")
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
    warm = seconds(lambda: inspe_jax.evaluate(scene, layout), repeats)
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
    table = Table("", "seconds", "× warm", title="One layout on one scene")
    for row in rows:
        table.add_row(row["what"], f"{row['seconds']:.3f}", f"{row['ratio']:.1f}")
    console.print(table)
    console.print(
        f"{embree.segments / 1e6:.1f} million segments, {embree.segments / traced / 1e6:.1f} "
        f"million a second; line of sight agrees on {same:.6%}; "
        f"peak memory of scoring {memory:.2f} GiB",
        highlight=False,
    )
    stem = options.out / ("benchmark_speed_quick" if options.quick else "benchmark_speed")
    settings = {**size, "seed": options.seed, "agreement": same, "peak_memory_gib": memory}
    write_results(stem.with_suffix(".csv"), rows, settings)
    draw(rows, size).savefig(stem.with_suffix(".png"), dpi=150)
    console.print(f"wrote {stem}.csv, .json and .png", highlight=False)


def draw(rows: list[dict[str, Any]], size: dict[str, Any]) -> Figure:
    """Seconds as bars."""
    figure = Figure(figsize=(6.4, 2.6), layout="constrained")
    axes = figure.subplots()
    bars = axes.barh([r["what"] for r in rows], [r["seconds"] for r in rows], color="#0072B2")
    axes.bar_label(bars, [f"{r['seconds']:.2f} s" for r in rows], padding=3)
    axes.set(xlabel="seconds", xlim=(0, 1.2 * max(r["seconds"] for r in rows)))
    axes.invert_yaxis()
    figure.suptitle(
        f"{size['scene']}: {size['voxels']:,} voxels, {size['sensors']} sensors, "
        f"{size['frames']} frames, {size['objects']} objects",
        fontsize=9,
    )
    return figure


if __name__ == "__main__":
    main()
