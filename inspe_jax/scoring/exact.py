"""Exact scores: voxels are counted as bits, and the cores divide the tiles and frames.

Counts are exact in any order: scores are the same bits on any number of cores.
"""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Num, UInt

from inspe_jax.core.arrays import pad_rows
from inspe_jax.core.geometry import Prism
from inspe_jax.core.numerics import Groups
from inspe_jax.core.parallel import Job, cores, jit_job, run, shapes_of
from inspe_jax.scoring.accumulate import count_tile
from inspe_jax.scoring.detection import DetectionCurves
from inspe_jax.scoring.driver import MetricValues, measure_tiles, summarise
from inspe_jax.scoring.metric import Metric, TileEvidence
from inspe_jax.scoring.metrics import entropy, entropy_terms, resolved, tile_terms
from inspe_jax.scoring.options import ScoreOptions
from inspe_jax.scoring.reading import BITS, Counts, Frames
from inspe_jax.scoring.tiled_scene import ENTROPIC, TiledScene
from inspe_jax.sensing.sensor_array import SensorArray, SensorSet, sensor_array
from inspe_jax.visibility import bitmask
from inspe_jax.visibility.statics import past_statics_of_sensor
from inspe_jax.visibility.tiles import CHUNKS, Tile, unless_empty
from inspe_jax.visibility.view_masks import views_of_sensor

ONE_MORE = 1
"""Spare places in an array of sensors. Here they cost next to nothing."""


def measure_exactly(
    tiled: TiledScene,
    poses: Float[np.ndarray, "S 6"],
    sensor_set: SensorSet,
    voxel: float,
    options: ScoreOptions | None = None,
) -> MetricValues:
    """The metrics of poses (x, y, z [m], roll, pitch, yaw [rad]) about the scene's centre.

    ``voxel`` is the edge of a voxel [m]. All cores work on it.
    """
    sensors, options = sensor_array(sensor_set, ONE_MORE), options or ScoreOptions.of()
    poses = pad_rows(poses, len(sensors.kind))
    found = count_exactly(tiled, poses, sensors, voxel, options)
    return found.of_scene(tiled.tiles.place, len(sensor_set.failures))


def count_exactly(
    tiled: TiledScene,
    poses: Float[Array | np.ndarray, "S 6"],
    sensors: SensorArray,
    voxel: float | Array,
    options: ScoreOptions,
) -> MetricValues:
    """:func:`measure_exactly` of padded arrays: in the tiles' columns, and of spare groups."""
    views, counts, terms = evidence_of_tiles(tiled, poses, sensors, voxel, options)
    if options.visibility == "in_view":
        counts = counts._replace(sights=None)
    columns_only, metrics = replace(tiled.bucketed, chunks=()), options.metrics
    reliability, failures = sensors.reliability, sensors.failures
    return _summarise(columns_only, views, counts, terms, reliability, failures, metrics=metrics)


def evidence_of_tiles(
    tiled: TiledScene,
    poses: Float[Array | np.ndarray, "S 6"],
    sensors: SensorArray,
    voxel: float | Array,
    options: ScoreOptions,
) -> tuple[UInt[Array | np.ndarray, "S N C"], Counts, dict[str, Any]]:
    """Masks of what is in view, the counts, and the further terms of the metrics, by metric."""
    views = in_view_of(tiled, poses, sensors, voxel / 2)
    counts = count_all(tiled, views, poses[:, :3], sensors.failures, options)
    return views, counts, _terms(tiled, views, counts.sights, poses, sensors, options)


def in_view_of(
    tiled: TiledScene,
    poses: Float[Array | np.ndarray, "S 6"],
    sensors: SensorArray,
    half: float | Array,
) -> UInt[Array | np.ndarray, "S N C"]:
    """Masks of what each sensor has in view, past static bodies. ``half`` of a voxel's edge [m]."""
    tile = tiled.tiles.tile
    views = np.zeros((len(poses), *tile.there.shape), tile.there.dtype)
    jobs: list[Job] = []
    present = np.flatnonzero(sensors.kind < len(sensors.kinds))
    for s in present:
        kind = sensors.kinds[sensors.kind[s]]
        rays = kind.rays(jax.tree.map(lambda numbers: numbers[s], sensors.table))  # noqa: B023
        key = views_of_sensor, kind, shapes_of(rays.table.rows, rays.table.nearest, tile.heights)
        jobs.append((key, partial(views_of_sensor, rays, poses[s], tile, half)))
    for s, view in zip(present, run(jobs), strict=True):
        views[s] = view
    return views & _past_statics(tiled, views, poses[:, :3])


def _past_statics(
    tiled: TiledScene,
    views: UInt[Array | np.ndarray, "S N C"],
    sensors: Float[Array | np.ndarray, "S 3"],
) -> Any:
    """Masks (S, N, C) of the voxels that neither bodies nor the ground hide from ``sensors``.

    Tiles of which a sensor has nothing in view are left out.
    """
    statics, tile = tiled.statics, tiled.tiles.tile
    if statics is None:
        return views
    present = np.flatnonzero(np.asarray(views).any((1, 2)))
    key = past_statics_of_sensor, tile.heights.shape, statics.shapes
    jobs: list[Job] = [
        (key, partial(past_statics_of_sensor, sensors[s], statics, tile, views[s])) for s in present
    ]
    found = np.zeros_like(views)
    for s, mask in zip(present, run(jobs), strict=True):
        found[s] = mask
    return found


def _sights_past_statics(
    tiled: TiledScene,
    sights: Num[Array | np.ndarray, "S N C Z"],
    views: UInt[Array | np.ndarray, "S N C"],
    sensors: Float[Array | np.ndarray, "S 3"],
) -> Any:
    """In how many frames each sensor has each voxel in line of sight, past what stands in all."""
    if tiled.statics is None:
        return sights
    masks, levels = _past_statics(tiled, views, sensors), sights.shape[-1]
    return sights * bitmask.unpack(np.asarray(masks)[..., None], levels)


def count_all(
    tiled: TiledScene,
    views: UInt[Array | np.ndarray, "S N C"],
    sensors: Float[Array | np.ndarray, "S 3"],
    failures: Groups | None,
    options: ScoreOptions,
) -> Counts:
    """Counts of what sensors at ``sensors`` with ``views`` of :func:`in_view_of` see."""
    jobs: list[Job] = []
    options = options.counted
    groups = 0 if failures is None else len(failures.first)
    for chunk in tiled.chunks:
        few = views[:, chunk.tiles]
        given = chunk.tile, few, chunk.solid, chunk.prisms, sensors, failures
        key = _count, options, shapes_of(few, chunk.prisms.top), groups
        jobs.append((key, partial(_count, *given, options=options)))
    seen = np.zeros((2, 1 + groups, tiled.frame_count), np.int32)
    core = np.zeros((2, tiled.frame_count), np.int32)
    columns = np.zeros(views.shape[1:], np.int32)
    levels = tiled.tiles.tile.heights.shape[1] if options.sight else 0
    kind = np.uint16 if tiled.frame_count < 2**16 else np.int32
    sights = np.zeros((*views.shape, levels), kind)
    for chunk, part in zip(tiled.chunks, run(jobs), strict=True):
        seen[:, :, chunk.frames] += np.stack([part.seen, part.original])
        core[:, chunk.frames] += np.asarray(part.core)
        columns[chunk.tiles] += np.asarray(part.columns)
        if options.sight:
            sights[:, chunk.tiles] += np.asarray(part.sights, kind)
    counts: Any = *seen, columns, sights if options.sight else None, core
    return Counts(*counts)


@partial(jit_job, static_argnames="options")
def _count(
    tile: Tile,
    views: UInt[Array, "S n C"],
    solid: UInt[Array, "n F C"],
    prisms: Prism,
    sensors: Float[Array, "S 3"],
    failures: Groups | None,
    *,
    options: ScoreOptions,
) -> Counts:
    shadows = BITS.shadows(sensors, prisms)

    @unless_empty
    def count(tile: Tile, views: Array, solid: Array) -> Counts:
        rows, frames = (sensors, shadows, views), Frames(prisms, solid)
        core = jnp.where(tile.core, tile.there, tile.there.dtype.type(0))
        return count_tile(BITS, tile, rows, frames, failures, options, core)

    seen, original, columns, sights, core = jax.lax.map(
        lambda part: count(*part), (tile, views.swapaxes(0, 1), solid)
    )
    sights = sights.swapaxes(0, 1) if options.sight else None
    return Counts(seen.sum(0), original.sum(0), columns, sights, core.sum(0))


@partial(jax.jit, static_argnames="metrics")
def _summarise(
    tiled: TiledScene,
    views: UInt[Array, "S N C"],
    counts: Counts,
    terms: dict[str, Any],
    reliability: Float[Array, " S"],
    failures: Groups | None,
    *,
    metrics: tuple[Metric, ...],
) -> MetricValues:
    slabs = tiled.tiles.slabs
    covered = BITS.any_of(views, failures)
    columns = bitmask.count(covered).reshape(len(covered), slabs, -1).sum(1)  # (1 + G, M·C)
    *entropy, parts = _entropy_terms(tiled, views, counts.sights, reliability, failures)
    return summarise(
        tiled,
        tiled.tiles.column_shares(columns.astype(float)),
        (entropy[0], entropy[1]),
        counts,
        terms,
        failures,
        metrics,
        entropy_of_parts=parts,
    )


def _terms(
    tiled: TiledScene,
    views: UInt[Array | np.ndarray, "S N C"],
    sights: Num[Array | np.ndarray, "S N C Z"] | None,
    poses: Float[Array | np.ndarray, "S 6"],
    sensors: SensorArray,
    options: ScoreOptions,
) -> dict[str, Any]:
    """The further terms that metrics ask for, by metric, one row for each tile."""
    if all(metric.terms is None for metric in options.metrics):
        return {}
    tiles = tiled.tiles
    static: dict[str, Any] = dict(metrics=options.metrics, detection=options.detection)
    work = partial(_tile_terms, **static, whole=tiles.slabs == 1)
    if not any(metric.sight for metric in options.metrics):
        sights = None
    if sights is not None:
        sights = _sights_past_statics(tiled, sights, views, poses[:, :3])
    # In NumPy: JAX would compile every slice of another shape.
    by_tile, by_sensor = jax.tree.map(np.asarray, ((tiles.tile, tiles.last), (views, sights)))
    of_all = jax.tree.map(np.asarray, (float(tiled.frame_count), poses, sensors))

    def job(some: slice) -> Job:
        part = jax.tree.map(lambda leaf: leaf[some], by_tile)
        given = *part, *jax.tree.map(lambda leaf: leaf[:, some], by_sensor), *of_all
        return (_tile_terms, options, sensors.kinds, shapes_of(given)), partial(work, *given)

    step = min(cores(), CHUNKS)
    parts = run([job(slice(first, None, step)) for first in range(step)])

    def joined(*part: Array) -> np.ndarray:
        whole = np.zeros((len(tiles.last), *part[0].shape[1:]), part[0].dtype)
        for first, rows in enumerate(part):
            whole[first::step] = rows
        return whole

    return jax.tree.map(joined, *parts)


@partial(jit_job, static_argnames=("metrics", "detection", "whole"))
def _tile_terms(
    tiles: Tile,
    last: Bool[Array, " N"],
    views: UInt[Array, "S N C"],
    sights: Num[Array, "S N C Z"] | None,
    frames: Float[Array, ""],
    poses: Float[Array, "S 6"],
    sensors: SensorArray,
    *,
    metrics: tuple[Metric, ...],
    detection: DetectionCurves | None,
    whole: bool,
) -> dict[str, Any]:
    """:func:`_terms` of some tiles. ``whole``: they have whole columns."""

    @unless_empty
    def terms(tile: Tile, *given: Any) -> dict[str, Any]:
        last, views, sights = given
        of_sensors = views, sights, frames, poses, sensors
        return tile_terms(metrics, TileEvidence(BITS, tile, *of_sensors, last, whole, detection))

    by_tile = (tiles, last, *(x if x is None else x.swapaxes(0, 1) for x in (views, sights)))
    return jax.lax.map(lambda given: terms(*given), by_tile)


def _entropy_terms(
    tiled: TiledScene,
    views: UInt[Array, "S N C"],
    sights: Num[Array | np.ndarray, "S *N C Z"] | None,
    reliability: Float[Array, " S"],
    failures: Groups | None,
) -> tuple[Float[Array, " 1+G"], Float[Array, ""], Float[Array, "2 2"]]:
    """H(Ω|P) and H(Ω) of all voxels; and the two of all sensors, columns for core and outside.

    They are summed in parts; parts of nothing but padding are left out.
    """
    sensors, number = len(views), len(tiled.occupancy)
    together = ENTROPIC if number and number % ENTROPIC == 0 else number
    last = jnp.where(tiled.occupancy > 0, jnp.arange(number), -1).max(initial=-1)
    words = views.reshape(sensors, -1)
    counts = None if sights is None else sights.reshape(sensors, -1, sights.shape[-1])
    core = tiled.tiles.tile.core.reshape(-1)

    def add_part(part: Array, sums: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        column, level, occupancy = (
            jax.lax.dynamic_slice_in_dim(of_voxels, part * together, together)
            for of_voxels in (tiled.column, tiled.level, tiled.occupancy)
        )
        bit = words[:, column] >> level.astype(words.dtype)[None]
        visible = (bit & words.dtype.type(1)).astype(float)
        if counts is not None:
            visible *= counts[:, column, level].astype(float) / tiled.frame_count
        q = resolved(visible, reliability, failures)
        remaining, total = entropy_terms(q, occupancy)
        near, h = core[column], entropy(occupancy)
        within = jnp.stack([jnp.where(near, h, 0.0), jnp.where(near, 0.0, h)])
        of_parts = jnp.stack([(within * (1.0 - q[0])[None]).sum(1), within.sum(1)])
        return sums[0] + remaining, sums[1] + total, sums[2] + of_parts

    groups = 0 if failures is None else len(failures.first)
    nothing = jnp.zeros(1 + groups), jnp.zeros(()), jnp.zeros((2, 2))
    return jax.lax.fori_loop(0, last // max(together, 1) + 1, add_part, nothing)


def measure_many(
    tiled: TiledScene,
    poses: Float[np.ndarray, "M S 6"],
    sensor_set: SensorSet,
    voxel: float,
    options: ScoreOptions,
) -> dict[str, Float[np.ndarray, " M"]]:
    """Every metric of M layouts of the same sensors, one for each core at a time; every chunk of
    ``tiled`` has all tiles."""
    sensors = sensor_array(sensor_set, ONE_MORE)
    data = tiled.bucketed, sensors, voxel
    key = measure_many, options, sensors.kinds, shapes_of(*data[:2])
    rows = [pad_rows(row, len(sensors.kind)) for row in poses]
    jobs: list[Job] = [(key, partial(_one_layout, row, *data, options=options)) for row in rows]
    found = np.stack(run(jobs))
    return {metric.name: column for metric, column in zip(options.metrics, found.T, strict=True)}


@partial(jit_job, static_argnames="options")
def _one_layout(
    poses: Float[Array, "S 6"],
    tiled: TiledScene,
    sensors: SensorArray,
    voxel: Float[Array, ""],
    *,
    options: ScoreOptions,
) -> Float[Array, " K"]:
    found = measure_tiles(BITS, tiled, poses, sensors, voxel, options=options).values
    return jnp.stack([found[metric.name][0] for metric in options.metrics])
