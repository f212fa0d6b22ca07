"""Claim: other readings of the paper bring the metrics nearer to its Table 2, but none meets it.

At one setting (where ``calibrate.py`` begins, or what it found: ``--setting FILE``) facts are
gathered once, of every voxel and sensor, by a caster in NumPy that shares no code with the scores:
how many rays pass through, at what distance, and in which frames the line of sight is clear. Every
reading is then worked out from the same facts: what "a ray passes through a voxel" means (any part
of the voxel, Bresenham's lines, two or three rays), how reliability falls with range, how the
sensors that have a voxel in view are fused, and how far LiDARs perceive.

Each reading is fitted to the table, as it needs numbers of its own: its reliabilities (with the
scale of their range, or the share of dependence) to IG, and the cameras' depth and the LiDARs'
azimuth step and lowest channel to C and O. Readings are compared by the mean absolute difference
that is left.

``--paper FILE`` is the paper's table as in ``table2.py``; its numbers are not in this repository.
Without it, or with ``--quick``, the model's own table under a reading drawn by ``--seed`` stands
in, and the claim is that this reading then meets it. Before that, the facts, read as the scores
read them, must give the numbers of ``inspe_jax.evaluate``.
"""

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import raycast
from calibrate import START, jobs
from common import (
    METRICS,
    arguments,
    console,
    markdown,
    need_maps,
    output,
    progress,
    read_rows,
    say,
    write_results,
)
from jaxtyping import Bool, Float, UInt8
from matplotlib.figure import Figure
from scipy.optimize import minimize
from scipy.stats import spearmanr
from table2 import LIGHTS, Stats, read_paper

import inspe_jax
from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import write_text
from inspe_jax.core.geometry import Prism, rotation, solid_top
from inspe_jax.core.numerics import step
from inspe_jax.jobs.scenes import place_layout
from inspe_jax.mounting.strategies import STRATEGIES
from inspe_jax.scene.scene import Scene
from inspe_jax.scoring.metrics import weights_of
from inspe_jax.sensing.layout import Layout
from inspe_jax.sensing.sensors import CameraSpec, LidarSpec, PinholeGrid, RayGrid, Spec
from inspe_jax.study.work import scene_of_job
from inspe_jax.visibility.centered_scene import about_center
from inspe_jax.visibility.queries import in_view
from inspe_jax.visibility.shadows import shadow_ceilings

Table = Float[np.ndarray, "P 3"]
"""C, O and IG of every placement, a mean over the intersections."""
NAMES = list(STRATEGIES)
FUSED = [name for name in NAMES if "/" in name]
SYMBOLS = list(METRICS.values())


# ── Readings ────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class Reading:
    """What is read otherwise than the scores do; everything that is not named is as they do."""

    name: str
    why: str
    walk: str = "exact"
    least: int = 1
    curve: str = "constant"
    fusion: str = "independent"
    lidar_range: bool = False

    @property
    def seen_as(self) -> tuple[Any, ...]:
        """What decides C and O."""
        return self.walk, self.least, self.lidar_range

    @property
    def numbers(self) -> tuple[str, ...]:
        """What is fitted to IG."""
        scales = ("camera scale [m]", "LiDAR scale [m]") if self.curve != "constant" else ()
        share = ("dependence",) if self.fusion == "in part" else ()
        return ("camera r", "LiDAR r", *scales, *share)


CURVES: dict[str, Callable[[Any, Any], Any]] = {
    "constant": lambda d, scale: 1.0,
    "exponential": lambda d, scale: np.exp(-d / scale),
    "linear": lambda d, scale: np.clip(1.0 - d / scale, 0.0, 1.0),
}
"""How reliability falls with the distance d [m]."""

READINGS = (
    Reading("as scored", "any ray meets any part of the voxel; constant r; independent sensors"),
    Reading("Bresenham", "the paper names this walk: it skips what a ray only clips", "bresenham"),
    Reading("2 rays", "one return is noise to most detectors", least=2),
    Reading("3 rays", "the same", least=3),
    Reading("Bresenham, 2 rays", "both", "bresenham", 2),
    Reading("r exponential", "what is far away has fewer points and pixels", curve="exponential"),
    Reading("r linear", "the same", curve="linear"),
    Reading("max of all", "what one sensor misses, all miss", fusion="max"),
    Reading("max in a modality", "sensors of a kind miss alike", fusion="max in a modality"),
    Reading("max of modalities", "kinds of sensor miss alike", fusion="max of modalities"),
    Reading("dependent in part", "between independent and max, by a share", fusion="in part"),
    Reading("LiDAR range", "LiDARs perceive less far than they reach", lidar_range=True),
)
"""The first is what the scores do; every other one is that but for one thing, with its reason."""

DEPTHS = tuple(np.linspace(20.0, 50.0, 7))
"""Depths of cameras that are tried [m], beside the given one."""
STEPS = (0.2, 0.275, 0.355, 0.475, 0.6)
"""Azimuth steps of 64 channels that are tried [degrees], beside the given one."""
LOWEST = (-25.0, -20.0, -15.0, -10.0)
"""Elevations of the lowest channel [degrees], likewise."""
RANGES = (25.0, 30.0, 35.0, 40.0, 45.0, 50.0)
"""Ranges of LiDARs [m], where the reading is that they see less far."""
FIRST = {"camera scale [m]": 40.0, "LiDAR scale [m]": 60.0, "dependence": 0.5}
"""Where the search for a number begins; reliabilities begin as given."""
LIMITS = {"camera r": (0.0, 1.0), "LiDAR r": (0.0, 1.0), "dependence": (0.0, 1.0)}
SCALES = (5.0, 1000.0)
SMALL: dict[str, Any] = dict(radius=20.0, voxel=0.3, spacing=1.6, frames=3)
"""Size of a quick run."""
QUICKLY = 7
"""Of so many variants of LiDARs, one is tried in a quick run."""
ROUNDING = 2e-4
"""The scores may differ by this from the same facts: they are summed in single precision."""
AGREEMENT = 0.999
"""The least share of (sensor, voxel) on which the caster here and the scores' margins agree."""
FOUND = 0.005
"""A table of the model's own is met if nothing is further off in the mean."""


# ── Rays through voxels ─────────────────────────────────────────────────────


PIECE = 400_000
"""(Voxel, ray) pairs looked at together."""
NEAR = 1.6
"""Bresenham's lines pass through no voxel whose centre is further off the ray, in its edges."""


def cast(
    grid: RayGrid,
    pose: Float[np.ndarray, "6"],
    centers: Float[np.ndarray, "V 3"],
    edge: float,
    reaches: Sequence[float],
    walk: str = "exact",
) -> UInt8[np.ndarray, "D V"]:
    """How many rays pass through each voxel, by ``walk``, where they end at each of the reaches.

    From voxels to rays: of each voxel those rays are tried that may be near enough to its centre.
    """
    turn = rotation(pose[3:], np)
    rays = (grid.directions() @ turn.T).reshape(len(grid.rows), grid.column_count, 3)
    apart = centers - pose[:3]
    near = edge * (NEAR if walk == "bresenham" else 3**0.5 / 2)
    first_row, rows, first_column, columns = _windows(grid, apart @ turn, near)
    tried = rows * columns * (np.linalg.norm(apart, axis=1) - near <= max(reaches))
    found = np.zeros((len(reaches), len(centers)))
    ends = np.cumsum(tried)
    begin_ = 0
    while begin_ < len(centers):
        done = ends[begin_ - 1] if begin_ else 0
        end = max(begin_ + 1, int(np.searchsorted(ends, done + PIECE)))
        voxel = np.repeat(np.arange(begin_, end), tried[begin_:end])
        number = np.arange(len(voxel)) - np.repeat(
            ends[begin_:end] - tried[begin_:end] - done, tried[begin_:end]
        )
        row = first_row[voxel] + number // columns[voxel]
        column = (first_column[voxel] + number % columns[voxel]) % grid.column_count
        hits = PASSES[walk](apart[voxel], rays[row, column], edge, reaches)
        for k, hit in enumerate(hits):
            found[k, begin_:end] = np.bincount(voxel[hit] - begin_, minlength=end - begin_)
        begin_ = end
    return np.minimum(found, 255).astype(np.uint8)


def _windows(
    grid: RayGrid, q: Float[np.ndarray, "V 3"], near: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of points in the body frame: the first row within ``near`` of each and how many, and of
    columns the same; columns past the last of a grid that wraps begin anew."""
    x, y, z = q.T
    plan, straight = np.hypot(x, y), np.linalg.norm(q, axis=1)
    if isinstance(grid, PinholeGrid):
        rows, columns = _tangents(x, z, near), _tangents(x, y, near)
    else:
        rows, columns = _angles(plan, z, straight, near), _angles(x, y, plan, near)
    first = np.searchsorted(grid.rows, rows[0])
    count = np.searchsorted(grid.rows, rows[1], "right") - first
    low, high = (np.asarray(side) - grid.first_column for side in columns)
    begin_ = np.ceil(low / grid.column_step).astype(int)
    end = np.floor(high / grid.column_step).astype(int) + 1
    if not grid.wraps:
        begin_, end = (np.clip(side, 0, grid.column_count) for side in (begin_, end))
    return first, count, begin_, np.clip(end - begin_, 0, grid.column_count)


def _angles(x: Any, y: Any, away: Any, near: float) -> tuple[Any, Any]:
    """Between which angles a ball lies that is so far away; all round where it is upon us."""
    middle, half = np.arctan2(y, x), np.arcsin(np.minimum(near / np.maximum(away, near), 1.0))
    half = np.where(away > near, half, 2 * np.pi)
    return middle - half, middle + half


def _tangents(x: Any, y: Any, near: float) -> tuple[Any, Any]:
    """Between which tangents y / x a ball lies; nowhere behind."""
    limit = np.pi / 2 - 1e-6
    angles = _angles(x, y, np.hypot(x, y), near)
    low, high = (np.tan(np.clip(angle, -limit, limit)) for angle in angles)
    return low, high


def _exactly(
    apart: Float[np.ndarray, "N 3"],
    along: Float[np.ndarray, "N 3"],
    edge: float,
    reaches: Sequence[float],
) -> Iterator[Bool[np.ndarray, " N"]]:
    """Whether rays meet any part of voxels so far apart from where they begin, before they end."""
    slope = np.where(along == 0, 1e-30, along)
    one, two = (apart - edge / 2) / slope, (apart + edge / 2) / slope
    enter, leave = np.minimum(one, two).max(1), np.maximum(one, two).min(1)
    meets = (enter <= leave + raycast.TIE) & (leave >= 0)
    return (meets & (enter <= reach) for reach in reaches)


def _by_lines(
    apart: Float[np.ndarray, "N 3"],
    along: Float[np.ndarray, "N 3"],
    edge: float,
    reaches: Sequence[float],
) -> Iterator[Bool[np.ndarray, " N"]]:
    """Whether Bresenham's lines pass voxels, each on the lattice that the voxel is cell 0 of."""
    first = np.floor(0.5 - apart / edge).astype(int)
    rows = np.arange(len(apart))
    for reach in reaches:
        change = np.floor(0.5 + (reach * along - apart) / edge).astype(int) - first
        axis = np.abs(change).argmax(1)
        steps = np.abs(change[rows, axis])
        n = -first[rows, axis] * np.sign(change[rows, axis])
        total = np.maximum(steps, 1)[:, None]
        cell = first + (2 * n[:, None] * change + total) // (2 * total)
        yield (n >= 0) & (n <= steps) & (cell == 0).all(1)


PASSES: dict[str, Callable[..., Iterator[np.ndarray]]] = {
    "exact": _exactly,
    "bresenham": _by_lines,
}
"""What \"a ray passes through a voxel\" means."""


# ── Facts ───────────────────────────────────────────────────────────────────


@dataclass(frozen=True, eq=False)
class Facts:
    """What is known of one intersection: of every voxel, every sensor and every frame.

    Sensors are those of all placements, cameras first; ``own`` (P, S) says whose they are.
    ``rays`` counts them by what is varied: (depth, camera, voxel) by walk and camera, and
    (variant, LiDAR, voxel) by walk; ``clear`` (S, T, V/8) has a bit where no other vehicle hides
    a voxel, ``free`` (T, V/8) one where no vehicle is.
    """

    name: str
    own: Bool[np.ndarray, "P S"]
    cameras: int
    poses: Float[np.ndarray, "S 6"]
    weight: Float[np.ndarray, " V"]
    occupancy: Float[np.ndarray, " V"]
    distance: Float[np.ndarray, "S V"]
    rays: Mapping[tuple[str, str], UInt8[np.ndarray, "K s V"]]
    clear: UInt8[np.ndarray, "S T W"]
    free: UInt8[np.ndarray, "T W"]
    settings: Mapping[str, Any]

    def in_view(self, reading: Reading, numbers: "Numbers") -> Bool[np.ndarray, "S V"]:
        """f of every sensor."""
        return np.concatenate([self.seen(reading, k)[at] for k, at in enumerate(numbers)])

    def seen(self, reading: Reading, kind: int) -> Bool[np.ndarray, "K s V"]:
        """f of cameras (0) or LiDARs (1) at all that is tried."""
        if kind == 0:
            rays = self.rays[reading.walk, "camera"]
        else:
            rays = self.rays[reading.walk, "LiDAR range" if reading.lidar_range else "LiDAR"]
        return rays >= reading.least


Numbers = tuple[int, int]
"""Which of the cameras' depths, and of the LiDARs' variants; the first ones are as given."""


@dataclass(frozen=True)
class Variants:
    """All that is tried of cameras and of LiDARs, the given first."""

    depths: tuple[float, ...]
    lidars: tuple[tuple[float, float], ...]
    ranges: tuple[float, ...]

    @classmethod
    def of(cls, setting: Mapping[str, Any], quick: bool = False) -> "Variants":
        """Those about a setting; fewer in a quick run."""
        given = float(setting["azimuth_step"]), float(setting["lidar_lowest"])
        depth = float(setting["camera_depth"])
        tried = [pair for pair in product(STEPS, LOWEST) if pair != given]
        tried = tried[::QUICKLY] if quick else tried
        depths = [float(d) for d in DEPTHS if d != depth]
        return cls((depth, *depths), (given, *tried), (np.inf, *RANGES))

    def lidar(self, reading: Reading, at: int) -> dict[str, float]:
        """What a variant of LiDARs is, in words; it is a range with every step and lowest."""
        ranges = len(self.ranges) if reading.lidar_range else 1
        step_, lowest = self.lidars[at // ranges]
        return dict(azimuth_step=step_, lidar_lowest=lowest, lidar_range=self.ranges[at % ranges])


def lidar_at(spec: LidarSpec, share: float, lowest: float) -> LidarSpec:
    """A LiDAR of another azimuth step, as a share of its own, and another lowest channel."""
    channels = np.linspace(np.radians(lowest), spec.elevations[-1], len(spec.elevations))
    count = round(spec.azimuth_count / share)
    return replace(spec, elevations=tuple(channels.tolist()), azimuth_count=count)


def gather(
    scene: Scene, layouts: Mapping[str, Layout], settings: Mapping[str, Any], variants: Variants
) -> Facts:
    """The facts of an intersection."""
    members = {
        (sensor.spec, tuple(np.round(np.asarray(pose, float), 9).tolist())): None
        for kind in (CameraSpec, LidarSpec)
        for layout in layouts.values()
        for sensor, pose in zip(layout.sensors, layout.poses, strict=True)
        if isinstance(sensor.spec, kind)
    }
    specs, poses = [spec for spec, _ in members], np.array([pose for _, pose in members])
    number: dict[tuple[Spec, tuple[float, ...]], int] = {m: s for s, m in enumerate(members)}
    own = np.zeros((len(NAMES), len(members)), bool)
    for p, name in enumerate(NAMES):
        layout = layouts[name]
        for sensor, pose in zip(layout.sensors, layout.poses, strict=True):
            at = tuple(np.round(np.asarray(pose, float), 9).tolist())
            own[p, number[sensor.spec, at]] = True
    cameras = sum(isinstance(spec, CameraSpec) for spec in specs)
    centers, edge = scene.voxels.centers, scene.voxels.size
    clear, solid = _sights(scene, poses)
    return Facts(
        name=scene.name,
        own=own,
        cameras=cameras,
        poses=poses,
        weight=scene.voxels.weight,
        occupancy=solid.mean(0),
        distance=np.linalg.norm(centers - poses[:, None, :3], axis=-1).astype(np.float32),
        rays=_rays(specs, poses, centers, edge, variants),
        clear=np.packbits(clear, -1),
        free=np.packbits(~solid, -1),
        settings=settings,
    )


def _rays(
    specs: Sequence[Spec], poses: np.ndarray, centers: np.ndarray, edge: float, variants: Variants
) -> dict[tuple[str, str], UInt8[np.ndarray, "K s V"]]:
    """Rays through every voxel, of each sensor in all that is tried."""

    def camera(walk: str, s: int) -> np.ndarray:
        grid = replace(specs[s].grid, reach=max(variants.depths))
        return cast(grid, poses[s], centers, edge, variants.depths, walk)

    def lidar(walk: str, s: int) -> np.ndarray:
        spec, (given, _) = specs[s], variants.lidars[0]
        assert isinstance(spec, LidarSpec)
        ends = variants.ranges if walk == "exact" else (np.inf,)
        reaches = [min(spec.reach, end) for end in ends]
        tried = [spec, *(lidar_at(spec, x / given, low) for x, low in variants.lidars[1:])]
        found = [cast(x.grid, poses[s], centers, edge, reaches, walk) for x in tried]
        return np.concatenate(found)

    kinds = [isinstance(spec, CameraSpec) for spec in specs]
    todo: dict[tuple[str, str], Callable[[int], np.ndarray]] = {
        ("exact", "camera"): partial(camera, "exact"),
        ("bresenham", "camera"): partial(camera, "bresenham"),
        ("exact", "LiDAR range"): partial(lidar, "exact"),
        ("bresenham", "LiDAR"): partial(lidar, "bresenham"),
    }
    with ThreadPoolExecutor() as pool:  # NumPy lets go of the lock
        found = {
            key: pool.map(
                one, [s for s, is_camera in enumerate(kinds) if is_camera != ("LiDAR" in key[1])]
            )
            for key, one in todo.items()
        }
        rays = {key: np.stack(list(parts), 1) for key, parts in found.items()}
    rays["exact", "LiDAR"] = rays["exact", "LiDAR range"][:: len(variants.ranges)]
    return rays


def _sights(scene: Scene, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(S, T, V) where no vehicle but its own hides a voxel, and (T, V) where there is one."""
    ground = about_center(scene)
    sensors = jnp.asarray(poses[:, :3] - scene.voxels.center, ground.columns.dtype)

    @jax.jit
    def look(prisms: Prism) -> tuple[jax.Array, jax.Array]:
        solid = step(solid_top(ground.columns, prisms)[:, None] - ground.heights) > 0
        line, others = (
            ground.heights[None]
            > shadow_ceilings(sensors, prisms, ground.columns, ignore_self_occlusion=own)[..., None]
            for own in (False, True)
        )
        return jnp.where(solid[None], others, line).reshape(len(sensors), -1), solid.ravel()

    frames = [jax.tree.map(lambda x: x[k], ground.prisms) for k in range(len(ground.prisms.top))]  # noqa: B023
    clear, solid = zip(*(map(np.asarray, look(prisms)) for prisms in frames), strict=True)
    return np.stack(clear, 1), np.stack(solid)


# ── Metrics of a reading ────────────────────────────────────────────────────


BITS = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1).sum(1, dtype=np.uint8)


def coverage_and_occlusion(
    facts: Facts, reading: Reading
) -> tuple[Float[np.ndarray, "P K L"], Float[np.ndarray, "P K L"]]:
    """C and O of every placement at all that is tried of cameras (K) and of LiDARs (L)."""
    kinds = slice(0, facts.cameras), slice(facts.cameras, None)
    seen = [facts.seen(reading, kind) for kind in range(2)]
    counts = len(seen[0]), len(seen[1])
    reference = facts.settings["occlusion_reference"]
    everywhere = np.packbits(np.ones(facts.weight.shape, bool))
    counted = everywhere & ~facts.free if reference == "targets" else facts.free
    c, o = np.zeros((2, len(NAMES), *counts))
    for p, own in enumerate(facts.own):
        parts: list[tuple[np.ndarray, np.ndarray]] = []
        for kind, f in zip(kinds, seen, strict=True):
            mine = f[:, own[kind]]
            bits, sights = np.packbits(mine, -1), facts.clear[kind][own[kind]]
            visible = np.zeros((len(f), *facts.free.shape), np.uint8)
            for s, sight_ in enumerate(sights):
                visible |= bits[:, s, None] & sight_
            parts.append((np.asarray(mine.any(1)), visible & counted))
        (covered, visible), (covered_too, visible_too) = parts
        for k in range(counts[0]):
            either = covered[k] | covered_too  # (L, V)
            c[p, k] = either @ facts.weight / facts.weight.sum()
            hits = BITS[visible[k] | visible_too].sum(-1)  # (L, T)
            original = counted[None]
            if reference == "covered":
                original = np.packbits(either, -1)[:, None] & counted
            some = BITS[original].sum(-1)
            share = np.divide(hits, some, out=np.zeros(hits.shape), where=some > 0)
            o[p, k] = share.sum(-1) / np.maximum((some > 0).sum(-1), 1)
    return c, o


def entropy(p: np.ndarray) -> np.ndarray:
    """Binary entropy."""
    x = np.stack([p, 1.0 - p])
    return -(x * np.log(np.where(x > 0, x, 1.0))).sum(0)


@dataclass(frozen=True, eq=False)
class Part:
    """What IG is made of on one intersection, at one choice of numbers: voxels with entropy only.

    ``share`` (V,) of all entropy; ``seen`` (S, V) is f times the share of frames with a line of
    sight.
    """

    own: Bool[np.ndarray, "P S"]
    cameras: int
    share: Float[np.ndarray, " V"]
    distance: Float[np.ndarray, "S V"]
    seen: Float[np.ndarray, "S V"]

    @classmethod
    def of(cls, facts: Facts, reading: Reading, numbers: Numbers) -> "Part":
        """Of one intersection."""
        h = entropy(facts.occupancy)
        some = np.flatnonzero(h)
        share = h[some] / h.sum()
        f = facts.in_view(reading, numbers)[:, some]
        count = len(facts.weight)
        visibility = facts.settings["visibility"]
        clear = facts.clear if visibility == "past_others" else facts.clear & facts.free
        sights = np.unpackbits(clear, -1, count=count)[..., some].astype(bool)  # (S, T, V)
        if visibility == "in_view":
            sights = np.ones_like(sights[:, :1])
        return cls(
            facts.own,
            facts.cameras,
            share,
            facts.distance[:, some],
            (f * sights.mean(1)).astype(np.float32),
        )

    def gain(self, reading: Reading, at: Mapping[str, float]) -> Float[np.ndarray, " P"]:
        """IG of every placement."""
        r = at["camera r"], at["LiDAR r"]
        kinds = slice(self.cameras), slice(self.cameras, None)
        curve = CURVES[reading.curve]
        scales = at.get("camera scale [m]"), at.get("LiDAR scale [m]")
        q = np.concatenate(
            [
                r[k] * curve(self.distance[kind], scales[k]) * self.seen[kind]
                for k, kind in enumerate(kinds)
            ]
        )
        return np.array(
            [
                fused([q[kind][own[kind]] for kind in kinds], reading.fusion, at) @ self.share
                for own in self.own
            ]
        )


def fused(
    q: Sequence[Float[np.ndarray, "s V"]], fusion: str, at: Mapping[str, float]
) -> Float[np.ndarray, " V"]:
    """The chance that a voxel is resolved, of the chances of each camera and each LiDAR."""
    independent = [1.0 - (1.0 - each).prod(0) for each in q]
    most = [each.max(0, initial=0.0) for each in q]

    def either(pair: Sequence[np.ndarray]) -> np.ndarray:
        return 1.0 - (1.0 - pair[0]) * (1.0 - pair[1])

    if fusion == "independent":
        return either(independent)
    if fusion == "max":
        return np.maximum(*most)
    if fusion == "max in a modality":
        return either(most)
    if fusion == "max of modalities":
        return np.maximum(*independent)
    return (1.0 - at["dependence"]) * either(independent) + at["dependence"] * np.maximum(*most)


# ── Fitting ─────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class Fitted:
    """A reading with numbers, and what it gives."""

    reading: Reading
    numbers: Numbers
    at: Mapping[str, float]
    table: Table


@dataclass(eq=False)
class World:
    """All intersections, and what was worked out of them."""

    facts: list[Facts]
    variants: Variants
    reliability: Mapping[str, float]
    known: dict[tuple[Any, ...], np.ndarray] = field(default_factory=dict)

    def tables(self, reading: Reading) -> Float[np.ndarray, "2 P K L"]:
        """C and O at all that is tried, a mean over the intersections."""
        if reading.seen_as not in self.known:
            each = [coverage_and_occlusion(facts, reading) for facts in self.facts]
            self.known[reading.seen_as] = np.mean(each, 0)
        return self.known[reading.seen_as]

    def at(self, reading: Reading, numbers: Numbers, values: Sequence[float], parts: Any) -> Fitted:
        """A reading at some numbers; ``parts`` are those of the intersections."""
        at, both = dict(zip(reading.numbers, values, strict=True)), self.tables(reading)
        gain = np.mean([part.gain(reading, at) for part in parts], 0)
        table = np.column_stack([both[0, :, *numbers], both[1, :, *numbers], gain])
        return Fitted(reading, numbers, at, table)

    def fit(self, reading: Reading, paper: np.ndarray | None) -> Fitted:
        """A reading at its best for a table; as given if there is none."""
        numbers: Numbers = (0, 0)
        if paper is not None:
            off = np.abs(self.tables(reading) - paper.T[:2, :, None, None]).mean((0, 1))
            k, lidar = np.unravel_index(off.argmin(), off.shape)
            numbers = int(k), int(lidar)
        parts = [Part.of(facts, reading, numbers) for facts in self.facts]
        begun = dict(FIRST) | dict(self.reliability)
        values = [begun[name] for name in reading.numbers]
        if paper is not None:
            values = minimize(
                lambda x: np.abs(
                    self.at(reading, numbers, x, parts).table[:, 2] - paper[:, 2]
                ).mean(),
                values,
                method="Nelder-Mead",
                bounds=[LIMITS.get(name, SCALES) for name in reading.numbers],
                options=dict(xatol=1e-3, fatol=1e-5, maxiter=80 * len(values)),
            ).x.tolist()
        return self.at(reading, numbers, values, parts)


def differences(table: Table, paper: np.ndarray) -> Float[np.ndarray, " 4"]:
    """Mean absolute differences of C, O, IG and P_sm."""
    return np.abs(with_surrogate(table) - paper).mean(0)


def loss(table: Table, paper: np.ndarray) -> float:
    """The mean absolute difference of C, O and IG, which is made small."""
    return float(differences(table, paper)[:3].mean())


def with_surrogate(table: Table) -> Float[np.ndarray, "P 4"]:
    """C, O, IG and P_sm."""
    return np.column_stack([table, table @ np.array(list(weights_of().values())[:3])])


def ranks(table: Table, paper: np.ndarray) -> list[float]:
    """Spearman's of C, O, IG and P_sm."""
    ours = with_surrogate(table)
    return [float(spearmanr(ours[:, k], paper[:, k]).statistic) for k in range(4)]


# ── The facts agree with the scores ─────────────────────────────────────────


def check(facts: Facts, scene: Scene, layouts: Mapping[str, Layout], world: "World") -> None:
    """Stop where facts, read as the scores read them, give other numbers than the scores; or where
    the rays counted here are not those of the scores and, if voxels touch, of literal walks."""
    plain = READINGS[0]
    rays = {key: counts.copy() for key, counts in facts.rays.items()}
    same: dict[str, list[float]] = {"inspe_jax": []}
    for p, name in enumerate(NAMES):
        if name not in FUSED:  # these have every sensor
            continue
        layout = layouts[name]
        poses = np.round(np.asarray(layout.poses, float), 9)
        views = {"inspe_jax": in_view(scene, layout)}
        if scene.voxels.spacing == scene.voxels.size:
            views |= {walk: raycast.in_view(scene, layout, walk) for walk in raycast.WALKS}
        for s in np.flatnonzero(facts.own[p]):
            at = int(np.flatnonzero((poses == facts.poses[s]).all(1))[0])
            kind, number = ("camera", s) if s < facts.cameras else ("LiDAR", s - facts.cameras)
            for by, view in views.items():
                ours = facts.rays["bresenham" if by == "bresenham" else "exact", kind][0, number]
                same.setdefault(by, []).append(float(((ours > 0) == view[at]).mean()))
            rays["exact", kind][0, number] = views["inspe_jax"][at]
    one = World([replace(facts, rays=rays)], world.variants, world.reliability)
    mine = with_surrogate(one.fit(plain, None).table)
    options_ = {key: facts.settings[key] for key in ("occlusion_reference", "visibility")}
    scores = [inspe_jax.evaluate(scene, layouts[name], **options_) for name in NAMES]
    rows = np.array([[score.value(metric) for metric in METRICS] for score in scores])
    if (off := np.abs(mine - rows).max()) > ROUNDING:
        raise SystemExit(f"{facts.name}: these facts give scores that are {off:.5f} off")
    worst = {by: min(shares) for by, shares in same.items()}
    if min(worst.values()) < AGREEMENT:
        raise SystemExit(f"{facts.name}: voxels in view agree only as {worst}")
    words = ", ".join(f"{by} {share:.3%}" for by, share in worst.items())
    console.print(f"{facts.name}: scores agree within {off:.1e}; in view with {words}")


# ── What is told ────────────────────────────────────────────────────────────


Rows = list[dict[str, Any]]


def row_of(fitted: Fitted, paper: np.ndarray, world: World) -> dict[str, Any]:
    """A row of the results."""
    table = fitted.table
    row: dict[str, Any] = dict(reading=fitted.reading.name, stage="all fitted")
    row |= dict(camera_depth=world.variants.depths[fitted.numbers[0]])
    row |= world.variants.lidar(fitted.reading, fitted.numbers[1])
    names = ("camera r", "LiDAR r", *FIRST)
    row |= {name: round(fitted.at[name], 4) if name in fitted.at else "" for name in names}
    row |= dict(loss=loss(table, paper))
    off, rank = differences(table, paper), ranks(table, paper)
    row |= {f"difference {symbol}": x for symbol, x in zip(SYMBOLS, off, strict=True)}
    row |= {f"Spearman {symbol}": x for symbol, x in zip(SYMBOLS, rank, strict=True)}
    values = with_surrogate(table)
    for p, name in enumerate(NAMES):
        row |= {f"{name} {symbol}": values[p, k] for k, symbol in enumerate(SYMBOLS)}
    return row


def results(rows: Rows) -> str:
    """Readings with their numbers, differences and rank correlations, in Markdown."""
    head = ["reading", "depth", "step", "lowest", "range", "r", "other", "loss"]
    head += [f"{mark} {symbol}" for mark in "Δρ" for symbol in SYMBOLS]
    lines = []
    for row in rows:
        cells = [row["reading"], f"{row['camera_depth']:g}"]
        cells += [f"{row['azimuth_step']:g}", f"{row['lidar_lowest']:g}"]
        cells += ["" if np.isinf(row["lidar_range"]) else f"{row['lidar_range']:g}"]
        cells += [f"{row['camera r']:.2f}, {row['LiDAR r']:.2f}"]
        cells += [", ".join(f"{name} {row[name]:.3g}" for name in FIRST if row[name] != "")]
        cells += [f"{row['loss']:.4f}"]
        cells += [f"{row[f'difference {s}']:.4f}" for s in SYMBOLS]
        cells += [f"{row[f'Spearman {s}']:.3f}" for s in SYMBOLS]
        lines.append(cells)
    return markdown(head, lines) + "\n"


def draw(rows: Rows) -> Figure:
    """What every reading leaves."""
    figure = Figure(figsize=(7.0, 1.2 + 0.28 * len(rows)), layout="constrained")
    axes = figure.subplots()
    axes.barh([row["reading"] for row in rows], [row["loss"] for row in rows], color="#0072b2")
    axes.invert_yaxis()
    axes.set_xlabel("mean absolute difference of C, O and IG to the table")
    return figure


# ── The run ─────────────────────────────────────────────────────────────────


def options() -> argparse.Namespace:
    """The command line."""
    given = arguments(
        __doc__,
        *("seed", "paper"),
        setting=dict(type=Path, metavar="FILE",
                     help="calibrate.csv; where calibrate.py begins if not given"),
        frames=dict(type=int, default=20),
        spacing=dict(type=float, default=1.0, help="of voxels [m]"),
        scenes=dict(type=int, default=10, help="only the first so many of the ten"),
        checked=dict(type=int, default=2, help="scenes on which facts are held against the scores"),
    )  # fmt: skip
    need_maps(given)
    given.lights = LIGHTS[:1]
    if given.quick:
        given.paper = None
    return given


def setting_of(path: Path | None) -> dict[str, Any]:
    """What ``calibrate.py`` found with all placements; or what it begins with."""
    if path is None:
        return dict(START)
    found = next((row for row in read_rows(path) if not row["fitted_without"]), None)
    if found is None or set(START) - set(found):
        raise SystemExit(f"{path}: no row of calibrate.py's that is fitted to all placements")
    return {key: type(value)(found[key]) for key, value in START.items()}


def read_world(given: argparse.Namespace, setting: Mapping[str, Any]) -> World:
    """Facts of all intersections."""
    by_scene: dict[str, list[Any]] = {}
    for job in jobs(dict(setting), given):
        if given.quick:
            job = replace(job, settings=dict(job.settings) | SMALL)
        by_scene.setdefault(job.scene, []).append(job)
    reliability = {
        "camera r": float(setting["camera_reliability"]),
        "LiDAR r": float(setting["lidar_reliability"]),
    }
    world = World([], Variants.of(setting, given.quick), reliability)
    with progress("intersections") as tell:
        for number, group in enumerate(by_scene.values()):
            scene = scene_of_job(group[0])
            if isinstance(scene, str):
                raise SystemExit(scene)
            layouts = {job.layout.name: place_layout(job.layout, scene) for job in group}
            facts = gather(scene, layouts, group[0].settings, world.variants)
            if number < given.checked:
                check(facts, scene, layouts, world)
            world.facts.append(facts)
            if tell is not None:
                tell(number + 1, len(by_scene))
    return world


def target(given: argparse.Namespace, world: World) -> tuple[np.ndarray, Reading | None]:
    """The table to be met (P, 4); and if it is the model's own, the reading that it is of."""
    if given.paper:
        stats: Stats = read_paper(given.paper)
        if missing := [(n, m) for n in NAMES for m in METRICS if (n, m) not in stats]:
            raise SystemExit(f"{given.paper}: no {missing[0][1]} of {missing[0][0]}")
        return np.array([[stats[name, metric][0] for metric in METRICS] for name in NAMES]), None
    truth = READINGS[np.random.default_rng(given.seed).integers(len(READINGS))]
    return with_surrogate(world.fit(truth, None).table), truth


def main() -> None:
    """Facts, readings, and what is told of them."""
    given = options()
    stem = output(given, "readings")
    setting = setting_of(given.setting)
    world = read_world(given, setting)
    paper, truth = target(given, world)
    rows: Rows = []
    for reading in READINGS:
        rows.append(row_of(world.fit(reading, paper), paper, world))
        console.print(f"{reading.name}: {rows[-1]['loss']:.4f} off")
    text = results(rows)
    say(f"{len(world.facts)} intersections, one voxel every {given.spacing:g} m\n\n{text}")
    write_text(stem.with_suffix(".md"), text)
    write_results(stem, rows, vars(given) | dict(setting_values=setting), draw(rows))
    best = min(rows, key=lambda row: row["loss"])
    met = best["loss"] <= FOUND
    say(
        f"a reading meets the table: {'yes' if met else 'no'}; {best['reading']} {best['loss']:.4f}"
    )
    if truth:
        off = next(row["loss"] for row in rows if row["reading"] == truth.name)
        if off > FOUND:
            raise SystemExit(f"the table of '{truth.name}' was missed by {off:.4f}")


if __name__ == "__main__":
    try:
        main()
    except InspeError as e:
        raise SystemExit(f"Error: {e}") from e
