"""Grids of rays: rows × columns, with the tables by which compiled programs know them."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int

from inspe_jax.core.arrays import on_host, wide_bucket
from inspe_jax.sensing.rays import Edges, Kind, Rays, RayTable

ROWS, STEPS = 128, 1024
"""Smallest lengths of a grid's tables of rows. Longer tables have 4, 16, … times that."""
COUNTS = 1024  # length of the table that counts rows
OWN = 12  # most further numbers of a class of rays


@dataclass(frozen=True)
class RayGrid:
    """Rows at given coordinates and evenly spaced columns, with a ray at each crossing.

    ``rows`` ascend. Column j lies at ``first_column + j · column_step``. If ``wraps``, the first
    column follows the last. ``reach`` is in metres. Coordinates are those of the class ``of`` rays:
    angles [rad] on the sphere, or tangents on a plane. ``own`` are further numbers of that class:
    the table of a lens that bends lines (:meth:`~inspe_jax.sensing.lens.Lens.table`), with no ray
    beyond its image circle; a radar's resolution in range [m], azimuth [rad] and radial speed
    [m/s], and the least radial speed that it finds.
    """

    rows: tuple[float, ...]
    first_column: float
    column_step: float
    column_count: int
    wraps: bool
    reach: float
    of: type[Rays]
    own: tuple[float, ...] = ()

    @property
    def column_limits(self) -> tuple[float, float]:
        """Coordinates of the first and the last column."""
        last = self.first_column + (self.column_count - 1) * self.column_step
        return self.first_column, last

    def directions(self) -> Float[np.ndarray, "R 3"]:
        """Unit directions of all rays in the body frame, row by row."""
        columns = self.first_column + np.arange(self.column_count) * self.column_step
        row, column = np.meshgrid(np.asarray(self.rows), columns, indexing="ij")
        rays = self.kind.rays(self.table)  # in double precision
        found = np.stack(rays.direction(row.ravel(), column.ravel(), np), axis=-1)
        return found[rays.exist(row.ravel(), column.ravel())] if self.of.bends else found

    @property
    def kind(self) -> Kind:
        """The kind that code is compiled for; grids of one kind differ only in numbers."""
        return Kind(self.of, self.wraps)

    @property
    def rays(self) -> Rays:
        """The grid in the form that scores use, in JAX's precision at the moment."""
        return self.kind.rays(jax.tree.map(on_host, self.table))

    @cached_property
    def table(self) -> RayTable:
        """The grid's numbers, in tables of a few fixed lengths."""
        rows, (first, last) = np.asarray(self.rows, float), self.column_limits
        nearest, steps = self._nearest
        ends = self.outer_rows
        at = np.linspace(ends[0], ends[1], COUNTS)
        # Halfway between rows a spacing ends: there the count is whole.
        counts = np.interp(
            at, [ends[0], *rows, ends[1]], [0.0, *(np.arange(len(rows)) + 0.5), len(rows)]
        )
        half = self.column_step / 2
        return RayTable(
            repeat_last(rows, wide_bucket(len(rows), ROWS)),
            repeat_last(nearest, wide_bucket(len(nearest), STEPS)),
            np.array(steps),
            np.array(len(rows), np.int32),
            np.array(self.column_step),
            np.array(1.0 / self.column_step),
            np.array(self.column_count, np.int32),
            np.array(self.reach),
            self._edges(rows[[0, -1]], np.array([first, last])),
            self._edges(ends, np.array([first - half, last + half])),
            counts,
            np.array((COUNTS - 1) / (ends[1] - ends[0])),
            np.array(not (self.of.slants or self.of.bends) and last - first > np.pi),
            np.pad(np.array(self.own, float), (0, OWN - len(self.own))),
        )

    @property
    def outer_rows(self) -> Float[np.ndarray, "2"]:
        """Coordinates half a spacing beyond the first and the last row. A single row has no
        spacing; that of the columns is taken for it."""
        rows = np.asarray(self.rows, float)
        if len(rows) == 1:
            return rows[[0, 0]] + np.array([-0.5, 0.5]) * self.column_step
        return np.array([rows[0] - (rows[1] - rows[0]) / 2, rows[-1] + (rows[-1] - rows[-2]) / 2])

    def _edges(self, row: Float[np.ndarray, "2"], column: Float[np.ndarray, "2"]) -> Edges:
        return Edges(row, column, self._turn(row), self._turn(column))

    def _turn(self, coordinate: Float[np.ndarray, " n"]) -> Float[np.ndarray, "2 n"]:
        """Cosines and sines of the angles at coordinates."""
        angle = np.arctan(coordinate) if self.of.slants else coordinate
        return np.array([np.cos(angle), np.sin(angle)])

    @property
    def _nearest(self) -> tuple[Int[np.ndarray, " K"], float]:
        """(row nearest to each of many even steps between the end rows, steps per unit)."""
        rows = np.asarray(self.rows)
        if len(rows) == 1:
            return np.zeros(1, np.uint8), 0.0
        span = rows[-1] - rows[0]
        steps = int(min(4 * STEPS - 1, np.ceil(8 * span / np.diff(rows).min())))
        at = rows[0] + np.arange(steps + 1) * span / steps
        nearest = np.abs(at[:, None] - rows).argmin(1)
        # Loops copy the table, so it is kept small.
        return nearest.astype(np.uint8 if len(rows) <= 2**8 else np.uint16), steps / span


def repeat_last(x: Any, length: int) -> np.ndarray:
    """A table with its last entry repeated up to a length."""
    return np.concatenate([x, np.repeat(x[-1:], length - len(x))])
