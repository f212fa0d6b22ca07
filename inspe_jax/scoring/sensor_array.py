"""The sensors of a layout as arrays.

Only the kinds of their ray grids are fixed, so one compiled program serves many layouts.
"""

from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from inspe_jax.core.arrays import bucket, on_device
from inspe_jax.core.numerics import Groups
from inspe_jax.core.pytree import pytree
from inspe_jax.sensing.layout import Layout
from inspe_jax.sensing.rays import Kind, RayTable
from inspe_jax.sensing.sensors import RayGrid, repeat_last


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


SENSORS = 4
"""Least number of places for sensors."""


@pytree
@dataclass(frozen=True)
class SensorArray:
    """A :class:`SensorSet` as arrays: a compiled program serves other sensors of these kinds.

    Of S places for sensors the first are taken. ``kind`` is the number of each sensor's kind among
    ``kinds``, or their count where the place is empty, and ``table`` has the numbers of its ray
    grid. The others are as in :class:`SensorSet`; an empty place has a unit of its own.
    """

    table: RayTable
    kind: Int[Array | np.ndarray, " S"]
    reliability: Float[Array | np.ndarray, " S"]
    unit: Int[Array | np.ndarray, " S"]
    pixels: Float[Array | np.ndarray, " S"]
    failures: Groups | None
    kinds: tuple[Kind, ...] = field(metadata={"static": True})

    def padded(self, poses: Float[Array | np.ndarray, "s 6"]) -> Any:
        """The sensors' poses, with the first one repeated for every empty place; traced or not."""
        return pad_rows(poses, len(self.kind))


@partial(jax.custom_vjp, nondiff_argnums=(1,))
def pad_rows(rows: Float[Array | np.ndarray, "s n"], count: int) -> Any:
    """``count`` rows: those given, then the first one repeated.

    In NumPy unless traced, the gradient too: JAX would compile a program for every number of rows.
    """
    if isinstance(rows, jax.core.Tracer):
        return jnp.concatenate([rows, jnp.repeat(rows[:1], count - len(rows), 0)])
    rows = np.asarray(rows)
    return np.concatenate([rows, np.repeat(rows[:1], count - len(rows), 0)])


def _pad_rows_forward(rows: Any, count: int) -> tuple[Any, Any]:
    return pad_rows(rows, count), np.zeros(len(rows), bool)


def _pad_rows_backward(count: int, rows: Any, slope: Any) -> tuple[Any]:
    number = len(rows)
    if isinstance(slope, jax.core.Tracer):
        return (slope[:number].at[0].add(slope[number:].sum(0)),)
    slope = np.array(slope)
    slope[0] += slope[number:].sum(0)
    return (on_device(slope[:number]),)


pad_rows.defvjp(_pad_rows_forward, _pad_rows_backward)


@lru_cache(maxsize=64)
def sensor_array(sensor_set: SensorSet, spare: int = 0) -> SensorArray:
    """A sensor set as arrays, with at least ``spare`` empty places."""
    kinds = tuple(sorted({grid.kind for grid, _ in sensor_set.groups}, key=lambda kind: kind.name))
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
