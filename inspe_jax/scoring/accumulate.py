"""What sensors see of a tile, frame by frame: the one place that goes through traffic.

Over the sets of :mod:`inspe_jax.scoring.reading`, so that an exact score, a soft one and a picture
are of the same lines of code.
"""

from typing import Any

from jaxtyping import Array, Float

from inspe_jax.core.numerics import Groups
from inspe_jax.scoring import metrics
from inspe_jax.scoring.reading import Asked, Counts, Frames, Reading, Row
from inspe_jax.visibility.tiles import Tile


def sees(reading: Reading, row: Row, tile: Tile, frames: Frames, asked: Asked) -> tuple[Any, Any]:
    """The sets of voxels that one sensor sees in each frame: f and in line of sight.

    For occlusion, and for information gain, which may count what is inside a vehicle otherwise.
    """
    sensor, shadows, view = row
    clear, in_sight = reading.line_of_sight(sensor, shadows, tile, frames, asked)
    view = reading.in_frames(view)
    return reading.both(view, clear), reading.both(view, in_sight)


def seen_in_tile(
    reading: Reading, rows: Row, tile: Tile, frames: Frames, failures: Groups | None, asked: Asked
) -> tuple[Any, Any]:
    """What some sensor sees in each frame, a union that can be counted; and, where it is asked for,
    in how many frames each sensor sees each voxel (S, C, Z).

    ``rows`` of all sensors: positions (S, 3), their shadows, and views, a set each.
    """

    def look(row: Row) -> tuple[Any, Any]:
        visible, in_sight = sees(reading, row, tile, frames, asked)
        if not asked.counts_sight:
            return visible, None
        return visible, reading.level_sums(in_sight, frames, len(tile.heights))

    return reading.over_sensors(look, rows, frames, failures)


def count_tile(
    reading: Reading,
    tile: Tile,
    views: Any,
    sensors: Float[Array, "S 3"],
    shadows: Any,
    frames: Frames,
    failures: Groups | None,
    asked: Asked,
) -> Counts:
    """Count what sensors at positions ``sensors`` see of one tile in some frames.

    ``views`` are the sets that each has in view, ``shadows`` what ``reading.shadows`` gives.
    """
    covered = reading.any_of(views, failures)

    def count(frames: Frames) -> Counts:
        solid = reading.solid(frames, len(tile.heights))
        free = reading.outside(reading.in_frames(reading.voxels(tile)), solid)
        rows = sensors, shadows, views
        union, sights = seen_in_tile(reading, rows, tile, frames, failures, asked)
        seen, original = metrics.occlusion_terms(
            reading, union, covered, free, solid, asked.occlusion_reference
        )
        columns = reading.column_sums(reading.both(union.all, free), frames)
        return Counts(seen, original, columns, sights)

    return reading.in_parts(count, frames)
