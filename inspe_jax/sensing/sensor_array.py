"""The sensors of a layout as arrays.

Only the kinds of their ray grids are fixed, so one compiled program serves many layouts.
"""

from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from inspe_jax.core.arrays import bucket
from inspe_jax.core.numerics import Groups
from inspe_jax.core.pytree import pytree
from inspe_jax.sensing.layout import Layout
from inspe_jax.sensing.ray_grid import RayGrid, repeat_last
from inspe_jax.sensing.rays import Kind, RayTable


class SensorSet(NamedTuple):
    """What is fixed of a layout's sensors as their poses change.

    ``groups`` are the sensors of each ray grid, by number; ``reliability``, ``unit`` and ``pixels``
    (S,) are each sensor's, the last the number of pixels that a ray of a camera stands for, and 1
    for other kinds; ``failures`` are groups of sensors that are left out in turn.
    """

    groups: tuple[tuple[RayGrid, tuple[int, ...]], ...]
    reliability: tuple[float, ...]
    unit: tuple[int, ...]
    pixels: tuple[float, ...]
    failures: tuple[tuple[int, ...], ...] = ()

    @classmethod
    def of(cls, layout: Layout, failures: tuple[tuple[int, ...], ...] = ()) -> "SensorSet":
        """The sensors of a layout."""
        return cls(
            layout.groups(),
            tuple(layout.reliability.tolist()),
            # Numbered anew: some units may have no sensor.
            tuple(np.unique([s.unit for s in layout.sensors], return_inverse=True)[1].tolist()),
            tuple(sensor.spec.pixels_per_ray for sensor in layout.sensors),
            failures,
        )


SENSORS = 4  # least number of places for sensors


@pytree
@dataclass(frozen=True)
class SensorArray:
    """A :class:`SensorSet` as arrays: a compiled program serves other sensors of these kinds.

    Of S places for sensors the first are taken. ``kind`` is the number of each sensor's kind among
    ``kinds``, or their count where the place is empty, and ``table`` has the numbers of its ray
    grid. The others are as in :class:`SensorSet`; empty places have own units, and the first pose.
    """

    table: RayTable
    kind: Int[Array | np.ndarray, " S"]
    reliability: Float[Array | np.ndarray, " S"]
    unit: Int[Array | np.ndarray, " S"]
    pixels: Float[Array | np.ndarray, " S"]
    failures: Groups | None
    kinds: tuple[Kind, ...] = field(metadata={"static": True})


@lru_cache(maxsize=64)
def sensor_array(sensor_set: SensorSet, spare: int = 0) -> SensorArray:
    """A sensor set as arrays, with at least ``spare`` empty places."""
    kinds = tuple(sorted({grid.kind for grid, _ in sensor_set.groups}, key=str))
    grids = {s: grid for grid, index in sensor_set.groups for s in index}
    count, room = len(grids), bucket(len(grids) + spare, SENSORS)
    tables = [grids[min(s, count - 1)].table for s in range(room)]
    lengths = [max(len(table[k]) for table in tables) for k in range(2)]
    tables = [
        table._replace(
            rows=repeat_last(table.rows, lengths[0]), nearest=repeat_last(table.nearest, lengths[1])
        )
        for table in tables
    ]
    kind = [kinds.index(grids[s].kind) for s in range(count)] + [len(kinds)] * (room - count)
    reliability = np.pad(np.array(sensor_set.reliability, float), (0, room - count))
    units = np.concatenate([sensor_set.unit, np.arange(count, room)])
    pixels = np.pad(np.array(sensor_set.pixels, float), (0, room - count))
    each = len(sensor_set.failures) == count
    groups = room if each else bucket(len(sensor_set.failures), SENSORS)
    return SensorArray(
        jax.tree.map(lambda *numbers: np.stack(numbers), *tables),
        np.array(kind, np.int32),
        reliability,
        units.astype(np.int32),
        pixels,
        Groups.of_rows(sensor_set.failures, room, groups),
        kinds,
    )
