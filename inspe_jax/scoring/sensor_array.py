"""The sensors of a layout as arrays, their kinds apart: one compiled program serves many
layouts."""

from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from inspe_jax.core.arrays import bucket, on_device
from inspe_jax.core.numerics import Groups
from inspe_jax.sensing.layout import Layout
from inspe_jax.sensing.rays import Kind, RayTable
from inspe_jax.sensing.sensors import RayGrid, longer


class SensorSet(NamedTuple):
    """The sensors' fixed side: ``groups`` of one ray grid, ``reliability`` (S,), and the
    ``failures``, groups of sensors that are left out in turn."""

    groups: tuple[tuple[RayGrid, tuple[int, ...]], ...]
    reliability: tuple[float, ...]
    failures: tuple[tuple[int, ...], ...] = ()

    @classmethod
    def of(cls, layout: Layout, failures: tuple[tuple[int, ...], ...] = ()) -> "SensorSet":
        """The sensors of a layout."""
        return cls(layout.groups(), tuple(layout.reliability.tolist()), failures)


SENSORS = 4
"""Sensors that there is room for, at least."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SensorArray:
    """The sensors' fixed side as arrays: what is compiled serves other sensors of these kinds.

    There is room for S sensors, the first ones being those of a :class:`SensorSet`. ``kind`` (S,)
    is the number of each one's kind among ``kinds``; where it is none of them, there is no sensor.
    ``table`` are the numbers of each one's grid of rays.
    """

    table: RayTable
    kind: Int[Array | np.ndarray, " S"]
    reliability: Float[Array | np.ndarray, " S"]
    failures: Groups | None
    kinds: tuple[Kind, ...] = field(metadata={"static": True})

    def filled(self, poses: Float[Array | np.ndarray, "s 6"]) -> Any:
        """Poses of the sensors, and the first one's again where there is none; traced or not."""
        return filled_up(poses, len(self.kind))


@partial(jax.custom_vjp, nondiff_argnums=(1,))
def filled_up(rows: Float[Array | np.ndarray, "s n"], count: int) -> Any:
    """So many rows, the first one repeated at the end.

    A function of its own, with a slope of its own, to be worked out in NumPy unless it is traced:
    else a program would be compiled for every number of rows.
    """
    if isinstance(rows, jax.core.Tracer):
        return jnp.concatenate([rows, jnp.repeat(rows[:1], count - len(rows), 0)])
    rows = np.asarray(rows)
    return np.concatenate([rows, np.repeat(rows[:1], count - len(rows), 0)])


def _filled_up_forward(rows: Any, count: int) -> tuple[Any, Any]:
    return filled_up(rows, count), np.zeros(len(rows), bool)


def _filled_up_backward(count: int, kept: Any, slope: Any) -> tuple[Any]:
    number = len(kept)
    if isinstance(slope, jax.core.Tracer):
        return (slope[:number].at[0].add(slope[number:].sum(0)),)
    slope = np.array(slope)
    slope[0] += slope[number:].sum(0)
    return (on_device(slope[:number]),)


filled_up.defvjp(_filled_up_forward, _filled_up_backward)


@lru_cache(maxsize=64)
def sensor_array(crew: SensorSet, spare: int = 0) -> SensorArray:
    """The arrays of a crew, with room for ``spare`` sensors more at least."""
    kinds = tuple(sorted({grid.kind for grid, _ in crew.groups}, key=lambda kind: kind.name))
    grids = {s: grid for grid, index in crew.groups for s in index}
    count, room = len(grids), bucket(len(grids) + spare, SENSORS)
    tables = [grids[min(s, count - 1)].table for s in range(room)]
    lengths = [max(len(table[k]) for table in tables) for k in range(2)]
    tables = [
        table._replace(
            rows=longer(table.rows, lengths[0]), nearest=longer(table.nearest, lengths[1])
        )
        for table in tables
    ]
    kind = [kinds.index(grids[s].kind) for s in range(count)] + [len(kinds)] * (room - count)
    reliability = np.pad(np.array(crew.reliability, float), (0, room - count))
    each = len(crew.failures) == count
    groups = room if each else bucket(len(crew.failures), SENSORS)
    return SensorArray(
        RayTable(*(np.stack(column) for column in zip(*tables, strict=True))),
        np.array(kind, np.int32),
        reliability,
        Groups.of_rows(crew.failures, room, groups),
        kinds,
    )
