"""The scores of a scene or of a sample of one, tile by tile; and the metrics from all counts.

Read as bits, scores are exact; read as chances, they are soft and have gradients.
:mod:`inspe_jax.scoring.exact` and :mod:`inspe_jax.scoring.soft` divide the same stages of one score
among the cores.

A soft reading is exactly 0 or 1 beyond a few widths (:func:`inspe_jax.core.numerics.step`). So a
tile that is far from a field of view or a shadow can skip it, and the result is the same.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float, Num

from inspe_jax.core.numerics import Groups, Width
from inspe_jax.scoring import metrics
from inspe_jax.scoring.accumulate import count_tile, join_frames
from inspe_jax.scoring.metric import Evidence, Metric, TileEvidence
from inspe_jax.scoring.numbers import SIGHTS_READ, Reading
from inspe_jax.scoring.options import ScoreOptions
from inspe_jax.scoring.reading import Counts, Frames
from inspe_jax.scoring.tiled_scene import TiledScene
from inspe_jax.sensing.sensor_array import SensorArray
from inspe_jax.visibility.tiles import Tile, Tiles, solid_in, unless_empty

KEPT, SENSORS_KEPT, SIGHTS_KEPT = 2**24, 2**26, 2**27
"""Voxels × frames × rows up to which all that a gradient needs is kept, with at most so many
× sensors; and up to which the union of the sensors is, with what is read of each one's sight lines
in little room. More would be gigabytes: it is found again tile by tile."""
SIGHTS = "sights"
"""Name of an array kept for the gradient: in how many frames each voxel is in line of sight."""


class MetricValues(NamedTuple):
    """Every metric by name: of all sensors in row 0, without group g of the failures in row 1 + g.

    ``column_coverage`` is the share of each column's voxels that are in view. ``seen_share`` is the
    share of frames and levels in which each column is seen. ``entropy`` is H(Ω) in nats. ``parts``
    has all metrics of the core and outside.
    """

    values: dict[str, Float[Array, " 1+G"]]
    column_coverage: Float[Array, " L"]
    entropy: Float[Array, ""]
    seen_share: Float[Array, " L"]
    parts: dict[str, Float[Array, " 2"]] | None = None

    def of_scene(self, place: Any, failures: int) -> "MetricValues":
        """The values of a scene's own columns, at ``place``, and of so many failures."""
        if not isinstance(self.column_coverage, jax.core.Tracer):
            place, self = jax.tree.map(np.asarray, (place, self))
        rows = slice(1 + failures)
        return self._replace(
            values={name: value[rows] for name, value in self.values.items()},
            column_coverage=self.column_coverage[place],
            seen_share=self.seen_share[place],
        )


class TileReadings(NamedTuple):
    """What is read of N tiles: how many voxels ``columns`` have in view, the chance that each voxel
    is ``resolved``, the ``counts``, and the further ``terms`` of the metrics."""

    columns: Num[Array, "N 1+G C"]
    resolved: Float[Array, "N 1+G Z C"]
    counts: Counts
    terms: dict[str, Any]


@partial(jax.jit, static_argnames="options")
def measure_tiles(
    reading: Reading,
    tiled: TiledScene,
    poses: Float[Array, "S 6"],
    sensors: SensorArray,
    voxel: float | Array,
    *,
    options: ScoreOptions,
) -> MetricValues:
    """The metrics of poses (x, y, z [m], roll, pitch, yaw [rad]) about the scene's centre.

    ``poses`` are padded as ``sensors`` are. ``voxel`` is the edge of a voxel [m]. Every chunk of
    ``tiled`` must have all tiles; masks of solid voxels that it does not have are found tile by
    tile. Read softly, the metrics are differentiable in the poses alone, in reverse mode.

    The result has the tiles' columns, a row for each place of a group of failures, and no parts.
    """
    reading, kept = jax.lax.stop_gradient(reading), kept_for_gradient(tiled, sensors)
    found = read_tiles(reading, tiled, poses, sensors, voxel, kept, options)
    return summarise_readings(found, tiled, sensors.failures, reading.width, options)


def kept_for_gradient(tiled: TiledScene, sensors: SensorArray) -> tuple[str, ...] | None:
    """Names of what is kept for a gradient; None for all. Finding it again takes a pass over all
    frames; of large scenes there is not the room for it."""
    size = tiled.tiles.tile.heights.size * tiled.frame_count
    size *= 1 if sensors.failures is None else 1 + len(sensors.failures.first)
    if size <= KEPT and size * len(sensors.kind) <= SENSORS_KEPT:
        return None
    return (SIGHTS, SIGHTS_READ) if size <= SIGHTS_KEPT else (SIGHTS,)


def read_tiles(
    reading: Reading,
    tiled: TiledScene,
    poses: Float[Array, "S 6"],
    sensors: SensorArray,
    voxel: float | Array,
    kept: tuple[str, ...] | None,
    options: ScoreOptions,
) -> TileReadings:
    """What is read of tiles. ``kept`` is what :func:`kept_for_gradient` gives; the other arguments
    are as of :func:`measure_tiles`."""
    failures, positions, tiles = sensors.failures, poses[:, :3], tiled.tiles
    seen_by = poses, sensors, voxel / 2
    views = reading.views(tiles.tile, *seen_by)
    shadows = [reading.shadows(positions, chunk.prisms) for chunk in tiled.chunks]

    def read_tile(tile: Tile, last: Array, views: Any, *solids: Any) -> TileReadings:
        f = reading.view_of_tile(views, tile, *seen_by)
        past = reading.past_statics(tile, positions, tiled.statics, f)
        f = f if past is None else reading.both(f, past)
        parts = []
        for chunk, shadow, solid in zip(tiled.chunks, shadows, solids, strict=True):
            solid = solid_in(tile, chunk.prisms) if solid is None else solid
            frames, rows = Frames(chunk.prisms, solid), (positions, shadow, f)
            parts.append(count_tile(reading, tile, rows, frames, failures, options))
        counts, sights = join_frames(parts), None
        if counts.sights is not None:
            sights = checkpoint_name(counts.sights.astype(tile.heights.dtype), SIGHTS)
            if past is not None:
                sights = sights * reading.chances(past, len(tile.heights)).swapaxes(1, 2)
        of_sensors = f, sights, tiled.frame_count, poses, sensors
        whole, fields = tiles.slabs == 1, options.target_fields
        at = TileEvidence(reading, tile, *of_sensors, last, whole, options.detection, fields=fields)
        return readings_of_tile(at, counts, options)

    if kept is not None:
        reading = reading.in_little_room()
        only = jax.checkpoint_policies.save_only_these_names(*kept)
        read_tile = jax.checkpoint(read_tile, policy=only)
    by_tile = tiles.tile, tiles.last, views, *(chunk.solid for chunk in tiled.chunks)
    return jax.lax.map(lambda given: unless_empty(read_tile)(*given), by_tile)


def readings_of_tile(at: TileEvidence, counts: Counts, options: ScoreOptions) -> TileReadings:
    """What is read of one tile, from what each sensor has of it and what all together see."""
    reading, failures, levels = at.reading, at.failures, len(at.tile.heights)
    visible = reading.chances(at.views, levels) if options.visibility == "in_view" else at.visible
    covered = reading.any_of(at.views, failures)
    return TileReadings(
        reading.column_counts(covered),
        metrics.resolved(visible, jnp.asarray(at.sensors.reliability, float), failures),
        counts._replace(sights=None),
        metrics.tile_terms(options.metrics, at),
    )


def summarise_readings(
    found: TileReadings,
    tiled: TiledScene,
    failures: Groups | None,
    width: Width,
    options: ScoreOptions,
) -> MetricValues:
    """The metrics from what :func:`read_tiles` gives of all tiles of a scene."""
    tiles, counts = tiled.tiles, found.counts
    columns = found.columns.swapaxes(0, 1).reshape(found.columns.shape[1], tiles.slabs, -1)
    resolved = found.resolved.swapaxes(0, 1)  # (1 + G, N, Z, C)
    if tiled.occupancy.ndim == 1:
        tile, column = jnp.divmod(tiled.column, tiles.tile.there.shape[1])
        resolved = found.resolved[tile, :, tiled.level, column].T
    return summarise(
        tiled,
        tiles.column_shares(columns.sum(1).astype(float)),
        metrics.entropy_terms(resolved.reshape(len(resolved), -1), tiled.occupancy.reshape(-1)),
        counts._replace(seen=counts.seen.sum(0), original=counts.original.sum(0)),
        found.terms,
        failures,
        options.metrics,
        width,
    )


def summarise(
    tiled: TiledScene,
    shares: Float[Array, "1+G MC"],
    entropy: tuple[Float[Array, " 1+G"], Float[Array, ""]],
    counts: Counts,
    terms: dict[str, Any],
    failures: Groups | None,
    metrics: tuple[Metric, ...],
    width: Width = None,
    entropy_of_parts: Float[Array, "2 2"] | None = None,
) -> MetricValues:
    """The metrics of a scene, and the shares that pictures show; columns in the tiles' order.

    ``shares`` are the shares of each column's levels in view; ``entropy`` is (H(Ω|P), H(Ω)), and
    ``entropy_of_parts`` that of all sensors, a column each for the core and outside; ``counts`` are
    those of all tiles, ``terms`` and ``width`` as in :class:`~inspe_jax.scoring.metric.Evidence`.
    """
    slabs = tiled.tiles.slabs
    seen = counts.columns.reshape(slabs, -1).sum(0)
    own_levels = tiled.tiles.column_levels
    frames, whole = (jnp.asarray(x, float).T for x in (counts.seen, counts.original))
    evidence = Evidence(
        shares, tiled.weight, frames, whole, *entropy, terms, failures, own_levels, slabs, width
    )
    values, parts = {metric.name: metric.of(evidence) for metric in metrics}, None
    if entropy_of_parts is not None:
        parts = _of_parts(evidence, tiled.tiles, counts, entropy_of_parts, metrics)
    return MetricValues(
        values,
        column_coverage=shares[0],
        entropy=entropy[1],
        seen_share=seen.astype(float) / (tiled.frame_count * own_levels),
        parts=parts,
    )


def _of_parts(
    whole: Evidence,
    tiles: Tiles,
    counts: Counts,
    entropy: Float[Array, "2 2"],
    metrics: tuple[Metric, ...],
) -> dict[str, Float[Array, " 2"]]:
    """Every metric of all sensors in the core and outside: sums over their own columns alone."""
    core = tiles.tile.core.reshape(tiles.slabs, -1)[0]
    frames = jnp.stack([whole.seen[:, 0], whole.original[:, 0]])
    near = jnp.asarray(counts.core, float)
    found = []
    for part, (inside, within) in enumerate(((core, near), (~core, frames - near))):
        weight = jnp.where(inside, whole.weight, 0.0)
        counted = weight.any()  # else, as 0/0 is no number, it is the whole
        seen, original = jnp.where(counted, within, frames)[:, :, None]
        one = whole._replace(
            covered=whole.covered[:1],
            weight=jnp.where(counted, weight, whole.weight),
            seen=seen,
            original=original,
            remaining=entropy[0, part],
            entropy=entropy[1, part],
        )
        values = {metric.name: (metric, metric.value(one).reshape(-1)[0]) for metric in metrics}
        found.append(
            {k: jnp.where(counted | (not m.by_region), x, 0.0) for k, (m, x) in values.items()}
        )
    return {name: jnp.stack([of[name] for of in found]) for name in found[0]}
