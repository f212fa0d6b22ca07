"""Soft scores, tile by tile: the scores that have gradients.

A soft reading is exactly 0 or 1 beyond a few widths (:func:`inspe_jax.core.numerics.step`). So a
tile that is far from a field of view or a shadow can skip it, and the result is the same.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float

from inspe_jax.core.numerics import Softness
from inspe_jax.scoring import metrics
from inspe_jax.scoring.accumulate import count_tile, join_frames
from inspe_jax.scoring.metric import TileEvidence
from inspe_jax.scoring.numbers import UNION, Numbers
from inspe_jax.scoring.options import ScoreOptions
from inspe_jax.scoring.reading import Counts, Frames
from inspe_jax.scoring.sensor_array import SensorArray
from inspe_jax.scoring.summary import MetricValues, summarise
from inspe_jax.scoring.tiled_scene import TiledScene
from inspe_jax.visibility.tiles import Tile, solid_in, unless_empty

KEPT, UNION_KEPT = 2**24, 2**27
"""Voxels × frames × rows up to which all that a gradient needs is kept, and up to which the union
of the sensors is. Of more it would be gigabytes, and is found again tile by tile."""
SIGHTS = "sights"
"""Name of an array kept for the gradient: in how many frames each voxel is in line of sight."""


@partial(jax.jit, static_argnames="options")
def read_softly(
    tiled: TiledScene,
    poses: Float[Array, "S 6"],
    sensors: SensorArray,
    voxel: float | Array,
    softness: Softness,
    *,
    options: ScoreOptions,
) -> MetricValues:
    """The metrics of poses (x, y, z [m], roll, pitch, yaw [rad]) about the scene's centre.

    ``poses`` are padded as ``sensors`` are. ``voxel`` is the edge of a voxel [m]. Every chunk of
    ``tiled`` must have all tiles; it needs no masks of solid voxels, which are found tile by tile.
    Differentiable in the poses, in reverse mode, but not in the softness.

    The result has the tiles' columns, and a row for each group of failures that there is room for.
    """
    numbers = Numbers(jax.lax.stop_gradient(softness))
    failures, positions = sensors.failures, poses[:, :3]

    def read_tile(tile: Tile, last: Array) -> tuple[Array, Array, Array, Counts, dict[str, Any]]:
        f = numbers.views(tile, poses, sensors, voxel / 2)
        past = numbers.past_statics(tile, positions, tiled.statics, f)
        f = f if past is None else f * past
        parts = []
        for chunk in tiled.chunks:
            shadows = numbers.shadows(positions, chunk.prisms)
            frames = Frames(chunk.prisms, solid_in(tile, chunk.prisms))
            given = numbers, tile, f, positions, shadows, frames, failures, options
            parts.append(count_tile(*given))
        counts, sights = join_frames(parts), None
        if counts.sights is not None:
            sights = checkpoint_name(counts.sights, SIGHTS)
            sights = sights if past is None else sights * past.swapaxes(1, 2)
        of_sensors = f, sights, tiled.frame_count, poses, sensors
        whole = tiled.tiles.slabs == 1
        at = TileEvidence(numbers, tile, *of_sensors, last, whole, options.detection)
        visible = f if options.visibility == "in_view" else at.visible
        covered = numbers.any_of(f, failures)
        return (
            covered.sum(1),
            covered[0].sum(1),
            metrics.resolved(visible, jnp.asarray(sensors.reliability, float), failures),
            counts._replace(sights=None),
            metrics.tile_terms(options.metrics, at),
        )

    tiles = tiled.tiles
    rows = 1 if failures is None else 1 + len(failures.first)
    size = rows * tiles.tile.heights.size * tiled.frame_count
    if size > KEPT:
        # Finding these again would take one more pass over all frames.
        names = (SIGHTS, UNION) if size <= UNION_KEPT else (SIGHTS,)
        only = jax.checkpoint_policies.save_only_these_names(*names)
        read_tile = jax.checkpoint(read_tile, policy=only)
    columns, by_level, resolved, counts, terms = jax.lax.map(
        lambda given: unless_empty(read_tile)(*given), (tiles.tile, tiles.last)
    )
    columns = columns.swapaxes(0, 1).reshape(columns.shape[1], tiles.slabs, -1)
    by_level = by_level.reshape(tiles.slabs, len(tiles.tile.there) // tiles.slabs, -1)
    tile, column = jnp.divmod(tiled.column, tiles.tile.there.shape[1])
    return summarise(
        tiled,
        tiles.column_shares(columns.sum(1)),
        by_level.sum(1).reshape(-1),
        metrics.entropy_terms(resolved[tile, :, tiled.level, column].T, tiled.occupancy),
        counts._replace(seen=counts.seen.sum(0), original=counts.original.sum(0)),
        terms,
        failures,
        options.metrics,
        numbers.width,
    )
