"""Grids of rays inside compiled programs: their numbers are arrays, only their kind is fixed.

A camera's grid is regular in tangents of angles, a LiDAR's in angles. :class:`Rays` is all that
visibility knows of a sensor: where a point lies among the rows and columns, and which way the ray
of a row and a column points. Points and directions are in the body frame.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from inspe_jax.core.geometry import FAR, Point, dot3
from inspe_jax.core.numerics import arctan2
from inspe_jax.core.pytree import pytree
from inspe_jax.sensing.signals import LidarNoise, Signal

MIN_DISTANCE = 1e-6  # least distance from an axis on which an angle has no derivative [m]
ANGLE_ERROR = 1e-6  # largest error of an angle in single precision [rad]


class Edges(NamedTuple):
    """The edges of a field of view, the first and the last row and column: their coordinates, and
    the cosines and sines of their angles."""

    row: Float[Array | np.ndarray, "*S 2"]
    column: Float[Array | np.ndarray, "*S 2"]
    row_turn: Float[Array | np.ndarray, "*S 2 2"]
    column_turn: Float[Array | np.ndarray, "*S 2 2"]


class RayTable(NamedTuple):
    """The numbers of a grid of rays as arrays, so that one compiled program serves every grid.

    ``rows`` (R,) are the coordinates of the rows, ascending and padded with the last one.
    ``nearest`` (K,) is the number of the nearest row at each of K even steps from the first row on;
    there are ``steps`` of them to a unit. ``reach`` is in metres. ``edges`` are the first and the
    last rows and columns of rays; ``outer`` lie half a spacing further out, and there are
    ``column_count`` column spacings between them. ``counts`` (N,) are numbers of row spacings, from
    the outer first row to each of N even steps on the way to the outer last one; there are
    ``count_steps`` steps to a unit. ``wide``: the columns take up more than half a turn. ``own`` is
    what else rays of a class know, as in :class:`~inspe_jax.sensing.ray_grid.RayGrid`.
    """

    rows: Float[Array | np.ndarray, "*S R"]
    nearest: Int[Array | np.ndarray, "*S K"]
    steps: Float[Array | np.ndarray, "*S"]
    row_count: Int[Array | np.ndarray, "*S"]
    column_step: Float[Array | np.ndarray, "*S"]
    columns_per_unit: Float[Array | np.ndarray, "*S"]
    column_count: Int[Array | np.ndarray, "*S"]
    reach: Float[Array | np.ndarray, "*S"]
    edges: Edges
    outer: Edges
    counts: Float[Array | np.ndarray, "*S N"]
    count_steps: Float[Array | np.ndarray, "*S"]
    wide: Bool[Array | np.ndarray, "*S"]
    own: Float[Array | np.ndarray, "*S 12"]


class Kind(NamedTuple):
    """Kind of a grid: its class of rays, and whether the columns go all the way round."""

    of: "type[Rays]"
    wraps: bool

    def rays(self, table: RayTable) -> "Rays":
        """Rays of this kind."""
        return self.of(table, self.wraps)


@dataclass(frozen=True)
class Rays:
    """A grid of rays inside a compiled program: its numbers are arrays, traced or not."""

    table: RayTable
    wraps: bool = field(metadata={"static": True})

    def zoomed(self, zoom: Float[Array, ""]) -> "Rays":
        """The grid at so many times its focal length; of what has no lens, as it is."""
        return self

    def nearest_row(self, row: Float[Array, "*n"]) -> Int[Array, "*n"]:
        """Index of the row nearest to a row coordinate, an end row beyond the ends; from a table
        with steps of an eighth of the least row spacing, so that midway it may be either."""
        index = jnp.round((row - self.table.edges.row[0]) * self.table.steps)
        last = self.table.nearest.shape[0] - 1
        found = jnp.asarray(self.table.nearest)[jnp.clip(index, 0, last).astype(jnp.int32)]
        return found.astype(jnp.int32)

    def row_at(self, index: Int[Array, "*n"]) -> Float[Array, "*n"]:
        """Coordinate of row ``index``; that of the last row beyond it."""
        return jnp.asarray(self.table.rows, float)[index]

    def column_index(self, column: Float[Array, "*n"]) -> Int[Array, "*n"]:
        """Index of the column at or before a column coordinate; it may lie outside the grid."""
        first = self.table.edges.column[0]
        return jnp.floor((column - first) * self.table.columns_per_unit).astype(jnp.int32)

    def column_at(self, index: Int[Array, "*n"]) -> Float[Array, "*n"]:
        """Coordinate of column ``index``: clipped to the edge columns; or, if the columns wrap
        round, wrapped once."""
        count = self.table.column_count
        if self.wraps:
            index = jnp.where(index < 0, index + count, index)
            index = jnp.where(index >= count, index - count, index)
        else:
            index = jnp.clip(index, 0, count - 1)
        return self.table.edges.column[0] + index.astype(float) * self.table.column_step

    def field_margin(self, q: Point, edges: Edges) -> Float[Array, "*n"]:
        """How deep points lie in the field of view within ``edges`` [m], negative outside: the
        least distance to an edge row, an edge column and the end of the reach."""
        above, below = (self.square_row(q, edges, k) for k in range(2))
        distance = jnp.sqrt(jnp.maximum(dot3(q, q), MIN_DISTANCE**2))
        margin = jnp.minimum(jnp.minimum(self.table.reach - distance, above), -below)
        return margin if self.wraps else jnp.minimum(margin, self.column_margin(q, edges))

    def column_margin(self, q: Point, edges: Edges) -> Float[Array, "*n"]:
        """How far points lie between the sides of the field within ``edges`` [m]."""
        after, before, *others = self.sides(q, edges)
        # A field of more than half a turn is the union of the two half-spaces, else their overlap.
        both = jnp.minimum(after, before)
        if self.slants:
            return both
        for other in others:
            both = jnp.minimum(both, other)
        return jnp.where(self.table.wide, jnp.maximum(after, before), both)

    def sides(self, q: Point, edges: Edges) -> tuple[Float[Array, "*n"], ...]:
        """How far points lie to the left of the first column, to the right of the last, and inside
        of any further side of a field of view that does not wrap round [m]."""
        return self.square_column(q, edges, 0), -self.square_column(q, edges, 1)

    def toward_sides(self, q: Point, way: Point, edges: Edges) -> tuple[Float[Array, "*n"], ...]:
        """How much of vectors at points leads inward from each of the :meth:`sides`."""
        return self.sides(way, edges)  # which are planes

    def surely_outside(self, q: Point, edges: Edges, radius: Any) -> Bool[Array, "*n"]:
        """Whether all within ``radius`` [m] of points is outside of the field within ``edges``."""
        return self.field_margin(q, edges) < -radius

    def exist(self, row: Any, column: Any) -> Any:
        """Whether there are rays at rows and columns of the grid."""
        return True

    def shown(self, row: Any, column: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Column coordinates, or the nearest up to which there are rays at these rows."""
        return column

    def existing(self, row: Any, column: Any, margin: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """The margins of rays at rows and columns [m]; negative where there are none."""
        return margin

    def square_column(self, q: Point, edges: Edges, edge: int) -> Float[Array, "*n"]:
        """Perpendicular distance of points to the left of the first column (0) or the last (1) [m]:
        of the half-plane of its azimuth, or of the plane through it."""
        cos, sin = edges.column_turn
        return q[1] * cos[edge] - q[0] * sin[edge]

    def beyond_edge(self, q: Point, edge: int) -> Float[Array, "*n"]:
        """How far points lie left of the first column (0) or the last (1) [m]; linear."""
        return self.square_column(q, self.table.edges, edge)

    def rows_below(self, row: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """How many row spacings lie between the outer first row and a row coordinate: linear
        between the rows, and beyond the outer ones as far as the end spacing goes on."""
        table = self.table
        counts = jnp.asarray(table.counts, float)
        at = (row - table.outer.row[0]) * table.count_steps
        last = counts.shape[0] - 1
        before = jax.lax.stop_gradient(jnp.clip(jnp.floor(at), 0, last - 1)).astype(jnp.int32)
        low, high = counts[before], counts[before + 1]
        return low + (at - before.astype(at.dtype)) * (high - low)

    # Each kind defines the following in its own coordinates.

    signal: ClassVar[Signal]  # what they bring a detector
    bends: ClassVar[bool] = False
    """Whether straight lines are curves in rows and columns."""
    slants: ClassVar[bool] = False
    """Whether coordinates are tangents; then :meth:`beyond_row` measures along an axis."""

    def direction(self, row: Any, column: Any, xp: Any = jnp) -> tuple[Any, Any, Any]:
        """Unit direction of the ray at a row and a column coordinate."""
        raise NotImplementedError

    def row(self, q: Point) -> Float[Array, "*n"]:
        """Row coordinate of points."""
        raise NotImplementedError

    def column(self, q: Point) -> Float[Array, "*n"]:
        """Column coordinate of points."""
        raise NotImplementedError

    def beyond_row(self, q: Point, row: Any) -> Float[Array, "*n"]:
        """How far points lie beyond a row [m]; linear in the point, or nearly so."""
        raise NotImplementedError

    def square_row(self, q: Point, edges: Edges, edge: int) -> Float[Array, "*n"]:
        """Perpendicular distance of points beyond the first row (0) or the last (1) [m]."""
        raise NotImplementedError

    def row_normal(self, q: Point) -> Point:
        """A direction in which the row coordinate of points grows."""
        raise NotImplementedError

    def column_normal(self, q: Point) -> Point:
        """A direction in which the column coordinate of points grows."""
        raise NotImplementedError

    def slopes(self, q: Point, near: Any) -> tuple[Point, Point]:
        """Gradients of the row and of the column coordinate with respect to the point [1/m]. Points
        nearer than ``near`` [m] to a LiDAR's axis or a camera's picture plane, where gradients have
        no bound, have those at that distance."""
        raise NotImplementedError

    # For most voxels the ray nearest to the centre decides whether any ray passes through.

    def to_ray(self, q: Point) -> tuple[Point, Any]:
        """(vectors from points to a point on a ray near each, its largest error [m]), FAR where
        there is no such ray."""
        raise NotImplementedError

    def between(self, q: Point, half: Any, extent: Callable[[Point], Any]) -> Bool[Array, "*n"]:
        """Whether cubes around points surely lie between two neighbouring rows or columns, or
        beyond an end row, and touch neither. ``half`` is half a cube's edge [m]; ``extent`` gives
        how far a cube reaches along a direction, times the direction's length."""
        raise NotImplementedError

    def _neighbour(self, row: Float[Array, "*n"]) -> tuple[Any, Any, Any]:
        """(the nearest row, the nearest one on the other side of ``row``, whether that exists)."""
        index = self.nearest_row(row)
        nearest = self.row_at(index)
        index = index + jnp.where(row > nearest, 1, -1)
        exists = (index >= 0) & (index < self.table.row_count)
        return nearest, self.row_at(jnp.clip(index, 0, self.table.row_count - 1)), exists

    def apart(
        self,
        row: Float[Array, "*n"],
        column: Float[Array, "*n"],
        above: Callable[[Any], Any],
        left_of: Callable[[Any], Any],
    ) -> Bool[Array, "*n"]:
        """Whether cubes at rows and columns lie between two rows or columns, or beyond an end;
        ``above`` and ``left_of`` are how far beyond a row or a column they lie, in extents."""

        def clear(gap: Callable[[Any], Any], nearest: Any, other: Any, exists: Any) -> Any:
            near, far = gap(nearest), gap(other)
            return (jnp.abs(near) > 1) & (~exists | ((jnp.abs(far) > 1) & (near * far < 0)))

        nearest, (first, last) = self.nearest_column(column), self.table.edges.column
        step = self.table.column_step
        other = nearest + jnp.where(column > nearest, 1.0, -1.0) * step
        exists = (other > first - step / 2) & (other < last + step / 2)
        either = clear(above, *self._neighbour(row))
        return either | clear(left_of, nearest, other, exists)

    def nearest_column(self, column: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Coordinate of the nearest column, not wrapped."""
        table = self.table
        first, count = table.edges.column[0], jnp.asarray(table.column_count)
        index = jnp.round((column - first) * table.columns_per_unit)
        if not self.wraps:
            index = jnp.clip(index, 0, (count - 1).astype(index.dtype))
        return first + index * table.column_step


@pytree
@dataclass(frozen=True)
class SphericalRays(Rays):
    """A LiDAR's rays: rows are elevations ψ, columns azimuths θ [rad]."""

    signal = Signal("lidar", LidarNoise())

    def direction(self, row: Any, column: Any, xp: Any = jnp) -> tuple[Any, Any, Any]:
        """(cos ψ cos θ, cos ψ sin θ, sin ψ)."""
        cos = xp.cos(row)
        return cos * xp.cos(column), cos * xp.sin(column), xp.sin(row)

    def row(self, q: Point) -> Float[Array, "*n"]:
        """Elevation."""
        return arctan2(q[2], _plan(q))

    def column(self, q: Point) -> Float[Array, "*n"]:
        """Azimuth."""
        return arctan2(q[1], q[0])

    def beyond_row(self, q: Point, row: Any) -> Float[Array, "*n"]:
        """Distance above the cone of elevation ``row``."""
        return q[2] * jnp.cos(row) - _plan(q) * jnp.sin(row)

    def square_row(self, q: Point, edges: Edges, edge: int) -> Float[Array, "*n"]:
        """Distance above the cone of that row's elevation."""
        cos, sin = edges.row_turn
        return q[2] * cos[edge] - _plan(q) * sin[edge]

    def row_normal(self, q: Point) -> Point:
        """Upward along the meridian."""
        plan = _plan(q)
        return -q[2] * q[0], -q[2] * q[1], plan * plan

    def column_normal(self, q: Point) -> Point:
        """Leftward along the parallel."""
        return -q[1], q[0], jnp.zeros_like(q[0])

    def slopes(self, q: Point, near: Any) -> tuple[Point, Point]:
        """Of elevation and azimuth."""
        plan = _plan(q)
        at = jnp.maximum(plan, near)
        x, y = q[0] / plan, q[1] / plan
        across = 1.0 / (at * at + q[2] * q[2])
        up = -q[2] * x * across, -q[2] * y * across, at * across
        return up, (-y / at, x / at, jnp.zeros_like(at))

    def to_ray(self, q: Point) -> tuple[Point, Any]:
        """Along the meridian to the nearest row, and along the parallel to the nearest column, both
        as straight lines: the error is at most half the squared angle times the range. Right above
        and below the sensor there is no meridian, and so no ray."""
        elevation, azimuth = self.row(q), self.column(q)
        up = self.row_at(self.nearest_row(elevation)) - elevation
        left = self.nearest_column(azimuth) - azimuth
        plan, distance = _plan(q), jnp.sqrt(_plan(q) ** 2 + q[2] * q[2])
        inward = up * q[2] / plan
        bend = (jnp.abs(up) + jnp.abs(left)) ** 2 / 2
        to = -inward * q[0] - left * q[1], -inward * q[1] + left * q[0], up * plan
        return to, jnp.where(plan > 2 * MIN_DISTANCE, distance * (bend + ANGLE_ERROR), FAR)

    def between(self, q: Point, half: Any, extent: Callable[[Point], Any]) -> Bool[Array, "*n"]:
        """Whether cubes lie between the cones of two rows. A cube's extent across a cone is that
        across its tangent plane, plus how far the cone bends away from the plane."""
        plan, distance = _plan(q), jnp.sqrt(_plan(q) ** 2 + q[2] * q[2])
        elevation, span = self.row(q), 3.0**0.5 * half
        across = extent((-q[2] * q[0] / plan, -q[2] * q[1] / plan, plan)) / distance
        bend = span * span / (2.0 * jnp.maximum(plan - span, 1e-3))

        def clear(row: Any) -> Bool[Array, "*n"]:
            away = jnp.abs(elevation - row)
            turned = across + away * span + bend * (jnp.abs(q[2]) / distance + away)
            return distance * (away - away**3 / 6 - ANGLE_ERROR) > turned

        nearest, other, exists = self._neighbour(elevation)
        opposite = (elevation - nearest) * (elevation - other) < 0
        return clear(nearest) & (~exists | (clear(other) & opposite))


@pytree
@dataclass(frozen=True)
class PinholeRays(Rays):
    """A camera's rays: rows and columns are the tangents z/x and y/x."""

    signal = Signal("camera")
    slants = True

    def direction(self, row: Any, column: Any, xp: Any = jnp) -> tuple[Any, Any, Any]:
        """(1, column, row), scaled to unit length."""
        scale = 1.0 / xp.sqrt(1.0 + row * row + column * column)
        return scale, column * scale, row * scale

    def zoomed(self, zoom: Float[Array, ""]) -> "PinholeRays":
        """All tangents are so many times smaller."""
        table = self.table

        def within(edges: Edges) -> Edges:
            row, column = jnp.asarray(edges.row) / zoom, jnp.asarray(edges.column) / zoom
            turns = (jnp.stack([t * 0 + 1, t]) / jnp.sqrt(1 + t * t)[None] for t in (row, column))
            return Edges(row, column, *turns)

        smaller = ("rows", "column_step")
        larger = ("steps", "columns_per_unit", "count_steps")
        changed: dict[str, Any] = {name: getattr(table, name) / zoom for name in smaller}
        changed |= {name: getattr(table, name) * zoom for name in larger}
        changed |= dict(edges=within(table.edges), outer=within(table.outer))
        return type(self)(table._replace(**changed), self.wraps)

    def row(self, q: Point) -> Float[Array, "*n"]:
        """z/x, the tangent of the angle above the optical axis; very large behind the sensor."""
        return q[2] / jnp.maximum(q[0], MIN_DISTANCE)

    def column(self, q: Point) -> Float[Array, "*n"]:
        """y/x, the tangent of the angle to the left of the optical axis."""
        return q[1] / jnp.maximum(q[0], MIN_DISTANCE)

    def beyond_row(self, q: Point, row: Any) -> Float[Array, "*n"]:
        """Height above the plane through row ``row``, along z."""
        return q[2] - row * q[0]

    def beyond_edge(self, q: Point, edge: int) -> Float[Array, "*n"]:
        """Distance to the left of the plane through that column, along y."""
        return q[1] - self.table.edges.column[edge] * q[0]

    def square_row(self, q: Point, edges: Edges, edge: int) -> Float[Array, "*n"]:
        """Distance above the plane through that row."""
        cos, sin = edges.row_turn
        return q[2] * cos[edge] - q[0] * sin[edge]

    def row_normal(self, q: Point) -> Point:
        """Gradient of z/x, times x²."""
        return -q[2], jnp.zeros_like(q[0]), jnp.maximum(q[0], MIN_DISTANCE)

    def column_normal(self, q: Point) -> Point:
        """Gradient of y/x, times x²."""
        return -q[1], jnp.maximum(q[0], MIN_DISTANCE), jnp.zeros_like(q[0])

    def slopes(self, q: Point, near: Any) -> tuple[Point, Point]:
        """Of the tangents z/x and y/x."""
        each = 1.0 / jnp.maximum(q[0], near)
        square, none = each * each, jnp.zeros_like(each)
        return (-q[2] * square, none, each), (-q[1] * square, each, none)

    def to_ray(self, q: Point) -> tuple[Point, Any]:
        """Within the plane x = const through the point; behind the sensor there is no ray."""
        row = self.row_at(self.nearest_row(self.row(q)))
        column = self.nearest_column(self.column(q))
        to = jnp.zeros_like(q[0]), column * q[0] - q[1], row * q[0] - q[2]
        return to, jnp.where(q[0] > 0, 0.0, FAR)

    def between(self, q: Point, half: Any, extent: Callable[[Point], Any]) -> Bool[Array, "*n"]:
        """Whether cubes lie between the planes of two rows, or of two columns."""
        x, y, z = q
        zero, one = jnp.zeros_like(x), jnp.ones_like(x)

        def above(row: Any) -> Any:
            return (z - row * x) / extent((-row * one, zero, one))

        def left_of(column: Any) -> Any:
            return (y - column * x) / extent((-column * one, one, zero))

        either = self.apart(self.row(q), self.column(q), above, left_of)
        return either & (x > 2 * half)


def _plan(q: Point) -> Float[Array, "*n"]:
    """Distance from the z axis [m], at least :data:`MIN_DISTANCE`."""
    return jnp.sqrt(jnp.maximum(q[0] * q[0] + q[1] * q[1], MIN_DISTANCE**2))
