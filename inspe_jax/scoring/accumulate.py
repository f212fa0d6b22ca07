"""What sensors see of a tile in each frame: the one pass over traffic.

It is written over the sets of :mod:`inspe_jax.scoring.reading`, so exact scores, soft scores and
pictures share what is counted here; their geometry differs.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from inspe_jax.core.numerics import Groups
from inspe_jax.scoring import metrics
from inspe_jax.scoring.numbers import Reading
from inspe_jax.scoring.options import ScoreOptions
from inspe_jax.scoring.reading import Counts, Frames, SensorRow
from inspe_jax.visibility.tiles import Tile


def seen_by_sensor(
    reading: Reading, row: SensorRow, tile: Tile, frames: Frames, options: ScoreOptions
) -> tuple[Any, Any, Any]:
    """The voxels that one sensor sees in each frame: those in view (f = 1) and in line of sight.

    The second set is of the voxels in line of sight, in view or not, as information gain counts
    those inside vehicles. The third result is what the reading needs for a gradient.
    """
    clear, in_sight, read = reading.line_of_sight(row, tile, frames, options.line_of_sight)
    return reading.both(reading.in_frames(row[2]), clear), in_sight, read


def seen_in_tile(
    reading: Reading,
    rows: SensorRow,
    tile: Tile,
    frames: Frames,
    failures: Groups | None,
    options: ScoreOptions,
) -> tuple[Any, Any]:
    """What some sensor sees in each frame, and how often each has each voxel in line of sight.

    The first is a union that can be counted, of all sensors and without each group of
    ``failures``. The second is the number of frames (S, C, Z), in view or not, or None unless it is
    asked for; it is 0 from a sensor that has nothing of the tile in view.
    ``rows`` are of all sensors: positions (S, 3), shadows, and one set in view each.
    """

    def see_from(row: SensorRow, reading: Reading, tile: Tile, frames: Frames) -> tuple:
        visible, in_sight, read = seen_by_sensor(reading, row, tile, frames, options)
        sight = reading.level_sums(in_sight, len(tile.heights)) if options.sight else None
        return visible, sight, read

    return reading.over_sensors(see_from, rows, (reading, tile, frames), failures)


def count_tile(
    reading: Reading,
    tile: Tile,
    rows: SensorRow,
    frames: Frames,
    failures: Groups | None,
    options: ScoreOptions,
    core: Any = None,
) -> Counts:
    """Count what sensors see of one tile in F frames.

    ``rows`` as of :func:`seen_in_tile`, with shadows as ``reading.shadows`` gives them; ``core`` is
    the set of voxels in the core, None to count nothing there.
    """
    covered = reading.any_of(rows[2], failures)
    solid = reading.solid(frames, len(tile.heights))
    free = reading.outside(reading.in_frames(reading.voxels(tile)), solid)
    reference = options.occlusion_reference
    union, sights = seen_in_tile(reading, rows, tile, frames, failures, options)
    seen, original = metrics.occlusion_terms(reading, union, covered, free, solid, reference)
    columns = reading.column_sums(reading.both(union.all, free))
    near = None
    if core is not None:  # few tiles are cut by its edge
        whole = jnp.stack([seen[0], original[0]])
        of = union.all, reading.in_frames(covered[0]), free, solid, reference
        cut = partial(metrics.occlusion_terms_within, reading, reading.in_frames(core), *of)
        number = tile.core.any().astype(int) + tile.core.all().astype(int)
        near = jax.lax.switch(number, (lambda: jnp.zeros_like(whole), cut, lambda: whole))
    return Counts(seen, original, columns, sights, near)


def join_frames(parts: list[Counts]) -> Counts:
    """The counts of consecutive runs of frames as those of all their frames; none of the core."""
    seen, original, columns, sights, _ = zip(*parts, strict=True)
    in_sight = None if sights[0] is None else sum(map(_widened, sights[1:]), _widened(sights[0]))
    total = sum(columns[1:], columns[0])
    return Counts(jnp.concatenate(seen, 1), jnp.concatenate(original, 1), total, in_sight)


def _widened(counts: Array) -> Array:
    """Counts as wider integers, so that sums do not overflow; sums of chances as they are."""
    return counts.astype(int) if jnp.issubdtype(counts.dtype, jnp.integer) else counts
