"""The three metrics read exactly: voxels counted in bit masks.

The same measures as :func:`inspe_jax.measures.measure` with softness 0, from the same
geometry. A voxel is a bit, so a union of sensors is OR, and a count is exact in any order:
tiles are shared out among the cores, and the scores are the same to the last bit.
"""

from collections.abc import Callable
from functools import cache, lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Num, UInt

from inspe_jax import masks, metrics, sharding
from inspe_jax.cores import Job, parts_of, run
from inspe_jax.geometry import Prism
from inspe_jax.measures import Crew, Measures
from inspe_jax.numerics import leave_one_out
from inspe_jax.sensing.in_view import in_order, in_view_masks
from inspe_jax.sensing.sensors import RayGrid
from inspe_jax.sensing.shadows import casts, clear_masks
from inspe_jax.sensing.tiles import Tile
from inspe_jax.world import Share, World

Groups = tuple[tuple[int, ...], ...]


def measure_exactly(
    world: World,
    poses: Float[Array, "S 6"],
    crew: Crew,
    voxel: float,
    *,
    occlusion_reference: str = "roi",
    visibility: str = "in_view",
) -> Measures:
    """The three metrics of poses about the scene's centre, in the paper's order.

    As :func:`~inspe_jax.measures.measure`. Works on all cores; traced, on one, and on a world
    whose shares have all tiles.
    """
    views = in_view_of(world, poses, crew, voxel / 2)
    sighted = visibility == "line_of_sight"
    watched = _watch_all(world, views, poses[:, :3], crew.failures, occlusion_reference, sighted)
    return _measures(world, views, watched, jnp.asarray(crew.reliability, float), crew.failures)


def in_view_of(
    world: World, poses: Float[Array, "S 6"], crew: Crew, half: float
) -> UInt[Array, "S N C"]:
    """Masks of what each sensor has in view."""
    tile = world.tiles.tile
    if isinstance(poses, jax.core.Tracer):
        found = [
            jax.lax.map(lambda pose: in_view_masks(grid, pose, tile, half), poses[jnp.array(index)])  # noqa: B023
            for grid, index in crew.groups
        ]
        return in_order(found, crew.groups)
    grids = {s: grid for grid, index in crew.groups for s in index}
    jobs: list[Job] = []
    for s, pose in enumerate(poses):
        if world.split is None:
            work = partial(in_view_masks, grids[s], pose, tile, half)
        else:
            work = partial(_split_view(grids[s], half), pose, world.split)
        jobs.append(((in_view_masks, grids[s].endless, half, tile.heights.shape), work))
    views = run(jobs)
    # Of tiles on several devices: together again.
    return jnp.stack(views if world.split is None else [np.asarray(view) for view in views])


@cache
def _split_view(grid: RayGrid, half: float) -> Callable[..., Any]:
    """:func:`in_view_masks`, every device for its tiles."""

    def view(pose: Array, tile: Tile) -> Array:
        return in_view_masks(grid, pose, tile, half)

    return sharding.split(view, (sharding.along(None), sharding.along(0)), sharding.along(0))


class Watched(NamedTuple):
    """Voxels counted over the frames; or, softly, readings summed.

    |V_orig| − |V_occ| in row 0 of ``seen``, less what is lost without group g in row 1 + g, and
    |V_orig| likewise in ``original``; in how many frames each voxel of a column is seen, summed
    over the column (``columns``), and in how many each sensor sees it (``sights``, or None).
    """

    seen: Num[Array, "1+G T"]
    original: Num[Array, "1+G T"]
    columns: Num[Array, "*N C"]
    sights: Num[Array, "S *N C Z"] | None


def _watch_all(
    world: World,
    views: UInt[Array, "S N C"],
    sensors: Float[Array, "S 3"],
    failures: Groups,
    reference: str,
    sighted: bool,
) -> Watched:
    """Go through the frames, tile by tile."""
    options = dict(failures=failures, reference=reference, sighted=sighted)
    if isinstance(views, jax.core.Tracer):
        return joined(
            [
                _watch(share.tile, views, share.solid, share.prisms, sensors, **options)
                for share in world.shares
            ]
        )
    jobs: list[Job] = []
    for share in world.shares:
        few = views[:, share.tiles]
        watch: Callable[..., Watched] = partial(_watch, **options)
        if share.split:
            watch = _split_watch(failures, reference, sighted)
        work = partial(watch, share.tile, few, share.solid, share.prisms, sensors)
        jobs.append(((_watch, *options.values(), few.shape, share.prisms.top.shape), work))
    seen = np.zeros((2, 1 + len(failures), world.frame_count), np.int32)
    columns = np.zeros(views.shape[1:], np.int32)
    levels = world.tiles.tile.heights.shape[1] if sighted else 0
    sights = np.zeros((*views.shape, levels), np.int32)
    for share, part in zip(world.shares, run(jobs), strict=True):
        seen[:, :, share.frames] += np.stack([part.seen, part.original])
        _add(columns[share.tiles], part.columns)
        if sighted:
            _add(sights[:, share.tiles], part.sights)
    return Watched(
        jnp.asarray(seen[0]),
        jnp.asarray(seen[1]),
        jnp.asarray(columns),
        jnp.asarray(sights) if sighted else None,
    )


def joined(parts: list[Watched]) -> Watched:
    """What was counted in one run of frames after the other."""
    seen, original, columns, sights = zip(*parts, strict=True)
    return Watched(
        jnp.concatenate(seen, 1),
        jnp.concatenate(original, 1),
        sum(columns[1:], columns[0]),
        None if sights[0] is None else sum(sights[1:], sights[0]),
    )


def _add(total: np.ndarray, counts: Array) -> None:
    """Add counts to a total; those of several devices stand one after another."""
    total += np.asarray(counts).reshape(-1, *total.shape).sum(0)


@cache
def _split_watch(failures: Groups, reference: str, sighted: bool) -> Callable[..., Watched]:
    """:func:`_watch`, every device for its frames."""
    watch = partial(_watch, failures=failures, reference=reference, sighted=sighted)
    whole, first, second = (sharding.along(axis) for axis in (None, 0, 1))
    gives: Any = Watched(second, second, first, first if sighted else None)  # type: ignore[arg-type]
    return sharding.split(watch, (whole, whole, second, first, whole), gives)


@partial(jax.jit, static_argnames=("failures", "reference", "sighted"))
def _watch(
    tile: Tile,
    views: UInt[Array, "S n C"],
    solid: UInt[Array, "n F C"],
    prisms: Prism,
    sensors: Float[Array, "S 3"],
    *,
    failures: Groups,
    reference: str,
    sighted: bool,
) -> Watched:
    """Go through some of the tiles and of the frames.

    In a tile only the sensors that have some of it in view are gone through, one group after the
    other. What ``once`` has is seen by a sensor, what ``twice`` has by two groups; so a group alone
    sees what it sees of the rest, and that is lost without it.
    """
    count, frames = len(sensors), len(prisms.top)
    spare_own = reference == "targets"
    cast = jax.vmap(casts, (0, None))(sensors, prisms)
    # Sensors group by group; without failures all are one.
    order = jnp.array([s for members in failures for s in members] or range(count))
    group_of = {s: number for number, members in enumerate(failures) for s in members}
    group = jnp.array([group_of.get(s, 0) for s in range(count)])

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
            clear = clear_masks(
                sensors[s], jax.tree.map(lambda leaf: leaf[s], cast), tile, spare_own=spare_own
            )
            visible = views[s][None] & clear
            before = jnp.where(opens(i), once, before)
            if failures:
                kept = kept.at[i].set(visible)
            if sighted:
                sights = sights.at[s].set(masks.tally(visible, len(tile.heights)))
            return once | visible, twice | (before & visible), before, kept, sights

        none = jnp.zeros((frames, views.shape[1]), views.dtype)
        sights = jnp.zeros((count, views.shape[1], len(tile.heights)) if sighted else (0,), int)
        once, twice, _, kept, sights = jax.lax.fori_loop(
            0, number, look, (none, none, none, kept, sights)
        )

        def lose(i: Array, state: tuple) -> tuple:
            lost, taken = state
            taken = jnp.where(opens(i), jnp.zeros_like(taken), taken)
            alone = kept[i] & ~twice & counted & ~taken
            return lost.at[group[listed[i]]].add(masks.count(alone).sum(1)), taken | alone

        lost = jnp.zeros((len(failures), frames), int)
        if failures:
            lost, _ = jax.lax.fori_loop(0, number, lose, (lost, none))
        seen = masks.count(once & counted).sum(1)
        covered = masks.without_one(views, failures)  # (1 + G, C)
        if reference == "covered":
            original = jax.lax.map(lambda row: masks.count(row[None] & counted).sum(1), covered)
        else:
            original = jnp.broadcast_to(masks.count(counted).sum(1), (1 + len(failures), frames))
        rows = jnp.concatenate([seen[None], seen[None] - lost])
        return kept, (rows, original, masks.count(once).sum(0), sights)

    kept = jnp.zeros((count if failures else 0, frames, views.shape[2]), views.dtype)
    by_tile = (tile, views.swapaxes(0, 1), solid)
    seen, original, columns, sights = jax.lax.scan(step, kept, by_tile)[1]
    return Watched(
        seen.sum(0), original.sum(0), columns, sights.swapaxes(0, 1) if sighted else None
    )


@partial(jax.jit, static_argnames="failures")
def _measures(
    world: World,
    views: UInt[Array, "S N C"],
    watched: Watched,
    reliability: Float[Array, " S"],
    failures: Groups,
) -> Measures:
    """From masks and counts to the metrics."""
    slabs, levels = world.tiles.slabs, world.tiles.level_count
    covered = masks.without_one(views, failures)
    counts = masks.count(covered).reshape(len(covered), slabs, -1).sum(1)  # (1 + G, M·C)
    shares = counts.astype(float) / levels
    by_level = masks.tally(covered[0].reshape(slabs, -1).T, -(-levels // slabs)).reshape(-1)

    if watched.sights is None:
        words = views.reshape(len(views), -1)[:, world.column]
        one = words.dtype.type(1)
        q = ((words >> world.level.astype(words.dtype)[None]) & one).astype(float)
    else:
        at = watched.sights.reshape(len(views), -1, watched.sights.shape[-1])
        q = at[:, world.column, world.level].astype(float) / world.frame_count
    resolved = leave_one_out(q * reliability[:, None], failures)
    return summed_up(world, shares, by_level, resolved, watched)


def summed_up(
    world: World,
    shares: Float[Array, "1+G MC"],
    by_level: Num[Array, " Z"],
    resolved: Float[Array, "1+G U"],
    watched: Watched,
) -> Measures:
    """The metrics, of what is in view of each column and level, and of what is seen.

    ``shares`` of each tile column's levels, ``by_level`` in columns, ``resolved`` of the voxels
    that may have entropy.
    """
    place, levels = world.tiles.place, world.tiles.level_count
    seen = watched.columns.reshape(world.tiles.slabs, -1).sum(0)[place]
    return Measures(
        metrics.coverage(shares, world.weight),
        metrics.occlusion(watched.seen.T.astype(float), watched.original.T.astype(float)),
        metrics.information_gain(resolved, world.occupancy),
        column_coverage=shares[0][place],
        level_coverage=by_level[:levels].astype(float) / len(place),
        information_gain_literal=metrics.information_gain_literal(resolved[0], world.occupancy),
        entropy=metrics.entropy(world.occupancy).sum(),
        seen_share=seen.astype(float) / (world.frame_count * levels),
    )


def measure_many(
    world: World,
    poses: Float[np.ndarray, "M S 6"],
    crew: Crew,
    voxel: float,
    *,
    occlusion_reference: str = "roi",
    visibility: str = "in_view",
) -> Float[np.ndarray, "3 M"]:
    """C, O and IG of M layouts, on a world whose shares have all tiles: layouts side by side.

    On several devices each works on a layout of its own, on one each core.
    """
    kind = (crew, voxel, occlusion_reference, visibility)
    shapes = tuple(leaf.shape for leaf in jax.tree.leaves(world))
    each = sharding.devices()
    work = _one(*kind) if each == 1 else _one_each(*kind)
    # A layout for a core, or one for every device: the first ones again where some would be idle.
    rows = np.resize(poses, (-(-len(poses) // each), each, *poses.shape[1:]))
    jobs: list[Job] = [
        ((measure_many, kind, shapes), partial(work, row[0] if each == 1 else row, world))
        for row in rows
    ]
    return np.stack(run(jobs)).reshape(-1, 3)[: len(poses)].T


@lru_cache(maxsize=8)
def _one(crew: Crew, voxel: float, reference: str, visibility: str) -> Callable[..., Array]:
    def measure(poses: Array, world: World) -> Array:
        m = measure_exactly(
            world, poses, crew, voxel, occlusion_reference=reference, visibility=visibility
        )
        return jnp.stack([m.coverage[0], m.occlusion[0], m.information_gain[0]])

    return jax.jit(measure)


@lru_cache(maxsize=8)
def _one_each(crew: Crew, voxel: float, reference: str, visibility: str) -> Callable[..., Array]:
    """:func:`_one`, every device for a layout."""
    one = _one(crew, voxel, reference, visibility)
    whole, first = sharding.along(None), sharding.along(0)
    return sharding.split(lambda poses, world: one(poses[0], world)[None], (first, whole), first)


# ── One sensor at many poses ────────────────────────────────────────────────

TOGETHER = 8
"""Poses in one compiled call: one shape for any number of them, and the same bits."""


def see(
    grid: RayGrid,
    half: float,
    poses: Float[Array, "K 6"],
    world: World,
    *,
    spare_own: bool = False,
) -> tuple[Bool[np.ndarray, "K V"], Bool[np.ndarray, "K T V"]]:
    """What one sensor has in view and what it sees in each frame, from each of K poses.

    For a world of one share. With ``spare_own`` a vehicle does not hide its own voxels.
    """
    (share,) = world.shares
    assert share.solid is not None  # it is not bare
    key = (_see, grid, half, share.solid.shape, spare_own)
    jobs: list[Job] = [
        (key, partial(_see, grid, half, part, share, spare_own=spare_own))
        for part in parts_of(np.asarray(poses), TOGETHER)
    ]
    views, seen = (np.concatenate(found)[: len(poses)] for found in zip(*run(jobs), strict=True))
    return world.tiles.by_voxel(views), world.tiles.by_voxel(seen)


@partial(jax.jit, static_argnames=("grid", "half", "spare_own"))
def _see(
    grid: RayGrid, half: float, poses: Float[Array, "K 6"], share: Share, *, spare_own: bool
) -> tuple[UInt[Array, "K N C"], UInt[Array, "K T N C"]]:
    def one(pose: Array) -> tuple[Array, Array]:
        views = in_view_masks(grid, pose, share.tile, half)
        cast = casts(pose[:3], share.prisms)

        def look(part: tuple[Tile, Array]) -> Array:
            tile, view = part
            return view[None] & clear_masks(pose[:3], cast, tile, spare_own=spare_own)

        def none(part: tuple[Tile, Array]) -> Array:
            return jnp.zeros((len(share.prisms.top), len(part[1])), part[1].dtype)

        seen = jax.lax.map(
            lambda part: jax.lax.cond((part[1] != 0).any(), look, none, part), (share.tile, views)
        )
        return views, seen.swapaxes(0, 1)

    return jax.lax.map(one, poses)
