"""The three metrics read exactly: voxels counted in bit masks.

The same measures as :func:`inspe_jax.scoring.reference.measure` with softness 0, from the same
geometry. A voxel is a bit, so a union of sensors is OR, and a count is exact in any order:
tiles are shared out among the cores, and the scores are the same to the last bit.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num, UInt

from inspe_jax.core import sharding
from inspe_jax.core.geometry import Prism
from inspe_jax.core.numerics import Groups, leave_one_out
from inspe_jax.core.parallel import Job, run
from inspe_jax.scoring import metrics
from inspe_jax.scoring.reference import (
    MetricValues,
    SensorArray,
    SensorSet,
    ignores_self_occlusion,
    sensor_array,
)
from inspe_jax.scoring.tiled_scene import UNSURE, TiledScene, dealt
from inspe_jax.sensing.rays import Kind, RayTable
from inspe_jax.visibility import bitmask
from inspe_jax.visibility.shadows import clear_masks, shadow_bounds
from inspe_jax.visibility.tiles import Tile, nothing_of
from inspe_jax.visibility.view_masks import view_masks


def measure_exactly(
    world: TiledScene,
    poses: Float[Array, "S 6"],
    crew: SensorSet,
    voxel: float,
    *,
    occlusion_reference: str = "roi",
    visibility: str = "in_view",
) -> MetricValues:
    """The three metrics of poses about the scene's centre, in the paper's order.

    As :func:`~inspe_jax.scoring.reference.measure`. Works on all cores; traced, on one, and on a
    world whose shares have all tiles.
    """
    sensors = sensor_array(crew, ONE_MORE)
    options = dict(occlusion_reference=occlusion_reference, visibility=visibility)
    measured = count_exactly(world, sensors.filled(poses), sensors, voxel, **options)
    return measured.of_scene(world.tiles.place, len(crew.failures))


def count_exactly(
    world: TiledScene,
    poses: Float[Array | np.ndarray, "S 6"],
    sensors: SensorArray,
    voxel: float | Array,
    *,
    occlusion_reference: str,
    visibility: str,
) -> MetricValues:
    """:func:`measure_exactly` of arrays that are filled up: of the tiles' columns, and with a row
    for each group of failures that there is room for."""
    views = in_view_of(world, poses, sensors, voxel / 2)
    options = occlusion_reference, visibility
    watched = watch_all(world, views, poses[:, :3], sensors.failures, *options)
    bare = replace(world.bucketed, shares=())
    return _measures(bare, views, watched, sensors.reliability, sensors.failures)


def in_view_of(
    world: TiledScene,
    poses: Float[Array | np.ndarray, "S 6"],
    sensors: SensorArray,
    half: float | Array,
) -> UInt[Array | np.ndarray, "S N C"]:
    """Masks of what each sensor has in view."""
    tile = world.tiles.tile
    if isinstance(poses, jax.core.Tracer):
        return _traced_views(tile, poses, sensors, half)
    jobs: list[Job] = []
    present = np.flatnonzero(sensors.kind < len(sensors.kinds))
    for s in present:
        kind = sensors.kinds[sensors.kind[s]]
        rays = kind.rays(jax.tree.map(lambda numbers: numbers[s], sensors.table))  # noqa: B023
        lengths = rays.table.rows.shape + rays.table.nearest.shape
        if world.split is None:
            work = partial(view_masks, rays, poses[s], tile, half)
        else:
            work = partial(_split_view(), rays, poses[s], world.split, half)
        jobs.append(((view_masks, kind, lengths, tile.heights.shape), work))
    views = np.zeros((len(poses), *tile.there.shape), tile.there.dtype)
    order = slice(None) if world.split is None else dealt(views.shape[1])
    for s, view in zip(present, run(jobs), strict=True):
        views[s, order] = view
    return views


def _traced_views(
    tile: Tile, poses: Float[Array, "S 6"], sensors: SensorArray, half: float | Array
) -> UInt[Array, "S N C"]:
    def look(kind: Kind, table: RayTable, pose: Array) -> Array:
        return view_masks(kind.rays(table), pose, tile, half)

    def nothing(table: RayTable, pose: Array) -> Array:
        return jnp.zeros_like(tile.there)

    branches: list[Any] = [*(partial(look, kind) for kind in sensors.kinds), nothing]
    return jax.lax.map(
        lambda one: jax.lax.switch(one[0], branches, *one[1:]),
        (jnp.asarray(sensors.kind), jax.tree.map(jnp.asarray, sensors.table), poses),
    )


@cache
def _split_view() -> Callable[..., Any]:
    """:func:`view_masks`, every device for its tiles."""
    whole, first = sharding.along(None), sharding.along(0)
    return sharding.split(view_masks, (whole, whole, first, whole), first)


ONE_MORE = 1
"""Sensors more that there is always room for: here they cost next to nothing."""


class VisibilityCounts(NamedTuple):
    """Voxels counted over the frames; or, softly, readings summed.

    |V_orig| − |V_occ| in row 0 of ``seen``, less what is lost without group g in row 1 + g, and
    |V_orig| likewise in ``original``; in how many frames each voxel of a column is seen outside
    vehicles, summed over the column (``columns``), and in how many each sensor sees it
    (``sights``, or None).
    """

    seen: Num[Array | np.ndarray, "1+G T"]
    original: Num[Array | np.ndarray, "1+G T"]
    columns: Num[Array | np.ndarray, "*N C"]
    sights: Num[Array | np.ndarray, "S *N C Z"] | None


def watch_all(
    world: TiledScene,
    views: UInt[Array | np.ndarray, "S N C"],
    sensors: Float[Array | np.ndarray, "S 3"],
    failures: Groups | None,
    reference: str,
    visibility: str,
) -> VisibilityCounts:
    """Go through the frames, tile by tile."""
    options: dict[str, Any] = dict(reference=reference, visibility=visibility)
    sighted = visibility != "in_view"
    if isinstance(views, jax.core.Tracer):
        return joined(
            [
                _watch(share.tile, views, share.solid, share.prisms, sensors, failures, **options)
                for share in world.shares
            ]
        )
    jobs: list[Job] = []
    groups = 0 if failures is None else len(failures.first)
    for share in world.shares:
        few = views[:, share.tiles]
        watch: Callable[..., VisibilityCounts] = partial(_watch, **options)
        if share.split:
            watch = _split_watch(reference, visibility)
        work = partial(watch, share.tile, few, share.solid, share.prisms, sensors, failures)
        shapes = few.shape, share.prisms.top.shape, groups, share.split
        jobs.append(((_watch, *options.values(), *shapes), work))
    seen = np.zeros((2, 1 + groups, world.frame_count), np.int32)
    columns = np.zeros(views.shape[1:], np.int32)
    levels = world.tiles.tile.heights.shape[1] if sighted else 0
    kind = np.uint16 if world.frame_count < 2**16 else np.int32
    sights = np.zeros((*views.shape, levels), kind)
    for share, part in zip(world.shares, run(jobs), strict=True):
        seen[:, :, share.frames] += np.stack([part.seen, part.original])
        _add(columns[share.tiles], part.columns)
        if sighted:
            _add(sights[:, share.tiles], part.sights)
    return VisibilityCounts(seen[0], seen[1], columns, sights if sighted else None)


def joined(parts: list[VisibilityCounts]) -> VisibilityCounts:
    """What was counted in one run of frames after the other."""
    seen, original, columns, sights = zip(*parts, strict=True)
    return VisibilityCounts(
        jnp.concatenate(seen, 1),
        jnp.concatenate(original, 1),
        sum(columns[1:], columns[0]),
        None if sights[0] is None else sum((_wide(part) for part in sights[1:]), _wide(sights[0])),
    )


def _wide(counts: Array) -> Array:
    """Counts with room for more of them; soft ones as they are."""
    return counts.astype(int) if jnp.issubdtype(counts.dtype, jnp.integer) else counts


def _add(total: np.ndarray, counts: Any) -> None:
    """Add counts to a total; those of several devices stand one after another."""
    total += np.asarray(counts).reshape(-1, *total.shape).sum(0, dtype=total.dtype)


@cache
def _split_watch(reference: str, visibility: str) -> Callable[..., VisibilityCounts]:
    """:func:`_watch`, every device for its frames."""
    watch = partial(_watch, reference=reference, visibility=visibility)
    sighted = visibility != "in_view"
    whole, first, second = (sharding.along(axis) for axis in (None, 0, 1))
    gives: Any = VisibilityCounts(second, second, first, first if sighted else None)  # type: ignore[arg-type]
    return sharding.split(watch, (whole, whole, second, first, whole, whole), gives)


@partial(jax.jit, static_argnames=("reference", "visibility"))
def _watch(
    tile: Tile,
    views: UInt[Array, "S n C"],
    solid: UInt[Array, "n F C"],
    prisms: Prism,
    sensors: Float[Array, "S 3"],
    failures: Groups | None,
    *,
    reference: str,
    visibility: str,
) -> VisibilityCounts:
    """Go through some of the tiles and of the frames; tiles that are empty are skipped.

    In a tile only the sensors that have some of it in view are gone through, one group after the
    other. What ``once`` has is seen by a sensor, what ``twice`` has by two groups; so a group alone
    sees what it sees of the rest, and that is lost without it. Where somebody asks for what is
    inside vehicles, others alone hide it; in how many frames a voxel is seen or in sight is counted
    without it, unless ``visibility`` is ``past_others``.
    """
    count, frames = len(sensors), len(prisms.top)
    spare, sighted = ignores_self_occlusion(reference, visibility), visibility != "in_view"
    kind = jnp.uint8 if frames <= bitmask.BYTE else jnp.int32
    cast = jax.vmap(shadow_bounds, (0, None))(sensors, prisms)
    # Sensors group by group; without failures all are one.
    groups = 0 if failures is None else len(failures.first)
    order = jnp.arange(count) if failures is None else jnp.asarray(failures.order)
    group = jnp.zeros(count, int) if failures is None else jnp.asarray(failures.of)

    def step(kept: Array, part: tuple[Tile, Array, Array]) -> tuple[Array, tuple]:
        tile, views, solid = part
        has = (views != 0).any(1)[order]
        listed = order[jnp.argsort(~has, stable=True)]
        number = has.sum()
        counted = solid if reference == "targets" else tile.there[None] & ~solid

        def opens(i: Array) -> Array:
            """Whether the sensor is the first of its group."""
            return (i == 0) | (group[listed[i]] != group[listed[i - 1]])

        def look(i: Array, state: tuple) -> tuple:
            once, twice, before, kept, sights = state
            s = listed[i]
            own = jax.tree.map(lambda leaf: leaf[s], cast)
            clear = clear_masks(sensors[s], own, tile, solid if spare else None)
            visible = views[s][None] & clear
            before = jnp.where(opens(i), once, before)
            if groups:
                kept = kept.at[i].set(visible)
            if sighted:
                in_sight = visible if visibility == "past_others" else visible & ~solid
                sights = sights.at[s].set(bitmask.count_levels(in_sight, len(tile.heights)))
            return once | visible, twice | (before & visible), before, kept, sights

        none = jnp.zeros((frames, views.shape[1]), views.dtype)
        sights = jnp.zeros((count, views.shape[1], len(tile.heights)) if sighted else (0,), kind)
        once, twice, _, kept, sights = jax.lax.fori_loop(
            0, number, look, (none, none, none, kept, sights)
        )

        def lose(i: Array, state: tuple) -> tuple:
            lost, taken = state
            taken = jnp.where(opens(i), jnp.zeros_like(taken), taken)
            alone = kept[i] & ~twice & counted & ~taken
            return lost.at[group[listed[i]]].add(bitmask.count(alone).sum(1)), taken | alone

        lost = jnp.zeros((groups, frames), int)
        if groups:
            lost, _ = jax.lax.fori_loop(0, number, lose, (lost, none))
        seen = bitmask.count(once & counted).sum(1)
        if reference == "covered":
            covered = bitmask.without_one(views, failures)  # (1 + G, C)
            original = jax.lax.map(lambda row: bitmask.count(row[None] & counted).sum(1), covered)
        else:
            original = jnp.broadcast_to(bitmask.count(counted).sum(1), (1 + groups, frames))
        rows = jnp.concatenate([seen[None], seen[None] - lost])
        return kept, (rows, original, bitmask.count(once & ~solid).sum(0), sights)

    kept = jnp.zeros((count if groups else 0, frames, views.shape[2]), views.dtype)
    by_tile = (tile, views.swapaxes(0, 1), solid)

    def skip(kept: Array, part: tuple[Tile, Array, Array]) -> tuple[Array, tuple]:
        return kept, nothing_of(step, kept, part)[1]

    def unless_empty(kept: Array, part: tuple[Tile, Array, Array]) -> tuple[Array, tuple]:
        return jax.lax.cond((part[0].there != 0).any(), step, skip, kept, part)

    seen, original, columns, sights = jax.lax.scan(unless_empty, kept, by_tile)[1]
    return VisibilityCounts(
        seen.sum(0), original.sum(0), columns, sights.swapaxes(0, 1) if sighted else None
    )


@jax.jit
def _measures(
    world: TiledScene,
    views: UInt[Array, "S N C"],
    watched: VisibilityCounts,
    reliability: Float[Array, " S"],
    failures: Groups | None,
) -> MetricValues:
    """From masks and counts to the metrics."""
    slabs, levels = world.tiles.slabs, world.tiles.level_count
    covered = bitmask.without_one(views, failures)
    counts = bitmask.count(covered).reshape(len(covered), slabs, -1).sum(1)  # (1 + G, M·C)
    shares = counts.astype(float) / levels
    by_level = bitmask.count_levels(covered[0].reshape(slabs, -1).T, -(-levels // slabs)).reshape(
        -1
    )

    terms = _entropy_terms(world, views, watched.sights, reliability, failures)
    return summed_up(world, shares, by_level, terms, watched)


def _entropy_terms(
    world: TiledScene,
    views: UInt[Array, "S N C"],
    sights: Num[Array | np.ndarray, "S *N C Z"] | None,
    reliability: Float[Array, " S"],
    failures: Groups | None,
) -> tuple[Float[Array, " 1+G"], Float[Array, ""]]:
    """:func:`~inspe_jax.scoring.metrics.entropy_terms` of all voxels: as many parts as there are
    some in, not as many as there is room for."""
    sensors, number = len(views), len(world.occupancy)
    together = UNSURE if number and number % UNSURE == 0 else number
    last = jnp.where(world.occupancy > 0, jnp.arange(number), -1).max(initial=-1)
    words = views.reshape(sensors, -1)
    counts = None if sights is None else sights.reshape(sensors, -1, sights.shape[-1])

    def add(part: Array, sums: tuple[Array, Array]) -> tuple[Array, Array]:
        column, level, occupancy = (
            jax.lax.dynamic_slice_in_dim(of_voxels, part * together, together)
            for of_voxels in (world.column, world.level, world.occupancy)
        )
        if counts is None:
            bit = words[:, column] >> level.astype(words.dtype)[None]
            q = (bit & words.dtype.type(1)).astype(float)
        else:
            q = counts[:, column, level].astype(float) / world.frame_count
        resolved = leave_one_out(q * reliability[:, None], failures)
        remaining, total = metrics.entropy_terms(resolved, occupancy)
        return sums[0] + remaining, sums[1] + total

    groups = 0 if failures is None else len(failures.first)
    nothing = jnp.zeros(1 + groups), jnp.zeros(())
    return jax.lax.fori_loop(0, last // max(together, 1) + 1, add, nothing)


def summed_up(
    world: TiledScene,
    shares: Float[Array, "1+G MC"],
    by_level: Num[Array, " Z"],
    terms: tuple[Float[Array, " 1+G"], Float[Array, ""]],
    watched: VisibilityCounts,
) -> MetricValues:
    """The metrics, of what is in view of each column and level, and of what is seen.

    ``shares`` of each tile column's levels, ``by_level`` in columns, ``terms`` of all voxels as
    :func:`~inspe_jax.scoring.metrics.entropy_terms` gives them. Columns stay those of the tiles.
    """
    slabs, levels = world.tiles.slabs, world.tiles.level_count
    seen = watched.columns.reshape(slabs, -1).sum(0)
    there = world.tiles.tile.there.reshape(slabs, -1)[0] != 0
    return MetricValues(
        dict(
            coverage=metrics.coverage(shares, world.weight),
            occlusion=metrics.occlusion(
                *(jnp.asarray(x, float).T for x in (watched.seen, watched.original))
            ),
            information_gain=metrics.information_gain(*terms),
        ),
        column_coverage=shares[0],
        level_coverage=by_level[:levels].astype(float) / there.astype(float).sum(),
        entropy=terms[1],
        seen_share=seen.astype(float) / (world.frame_count * levels),
    )


def measure_many(
    world: TiledScene,
    poses: Float[np.ndarray, "M S 6"],
    crew: SensorSet,
    voxel: float,
    *,
    occlusion_reference: str = "roi",
    visibility: str = "in_view",
) -> dict[str, Float[np.ndarray, " M"]]:
    """Every metric of M layouts, on a world whose shares have all tiles: layouts side by side.

    On several devices each works on a layout of its own, on one each core.
    """
    sensors, options = sensor_array(crew, ONE_MORE), (occlusion_reference, visibility)
    data = world.bucketed, sensors, voxel
    shapes = tuple(leaf.shape for leaf in jax.tree.leaves(data[:2]))
    each = sharding.devices()
    one = partial(_one, reference=occlusion_reference, visibility=visibility)
    work = one if each == 1 else _one_each(*options)
    # A layout for a core, or one for every device: the first ones again where some would be idle.
    whole = np.stack([sensors.filled(row) for row in poses])
    rows = np.resize(whole, (-(-len(whole) // each), each, *whole.shape[1:]))
    jobs: list[Job] = [
        (
            (measure_many, *options, sensors.kinds, shapes),
            partial(work, row[0] if each == 1 else row, *data),
        )
        for row in rows
    ]
    found = np.stack(run(jobs)).reshape(-1, len(metrics.METRICS))[: len(poses)]
    return dict(zip(metrics.METRICS, found.T, strict=True))


@partial(jax.jit, static_argnames=("reference", "visibility"))
def _one(
    poses: Float[Array, "S 6"],
    world: TiledScene,
    sensors: SensorArray,
    voxel: Float[Array, ""],
    *,
    reference: str,
    visibility: str,
) -> Float[Array, " K"]:
    m = count_exactly(
        world, poses, sensors, voxel, occlusion_reference=reference, visibility=visibility
    )
    return jnp.stack([m.values[name][0] for name in metrics.METRICS])


@cache
def _one_each(reference: str, visibility: str) -> Callable[..., Array]:
    """:func:`_one`, every device for a layout."""
    one = partial(_one, reference=reference, visibility=visibility)
    whole, first = sharding.along(None), sharding.along(0)
    return sharding.split(
        lambda poses, *data: one(poses[0], *data)[None], (first, whole, whole, whole), first
    )
