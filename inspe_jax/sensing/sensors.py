"""What you buy (CameraSpec, LidarSpec), apart from where you put it (a pose).

Both kinds of sensor are a grid of rays, rows × columns: a camera's downsampled
pixels in the plane of tangents, a LiDAR's channels × azimuths on the sphere. The
two grids share one interface, which is all that visibility knows of a sensor:
where a point lies among the rows and columns, and which way ray (i, j) points.
All in the body frame: x forward, y left, z up.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from inspe_jax.geometry import FAR, Point
from inspe_jax.numerics import arctan2

_LEAST = 1e-6  # keeps a point off the axis where its angle has no derivative [m]
_ANGLE = 1e-6  # what an angle in single precision may be off by [rad]


class Pose(NamedTuple):
    """Where a sensor is and how it is turned, in world metres and radians.

    Yaw is counter-clockwise from +x, pitch positive nose-up, roll about the
    forward axis: a row of ``Layout.poses``.
    """

    x: float
    y: float
    z: float
    roll: float = 0.0
    pitch: float = 0.0
    yaw: float = 0.0


@dataclass(frozen=True)
class RayGrid:
    """Rows at given coordinates and evenly spaced columns, each crossing one ray.

    ``rows`` ascend; column j lies at ``first_column + j · column_step``; with
    ``wraps`` the last column is followed by the first. ``reach`` in metres.
    """

    rows: tuple[float, ...]
    first_column: float
    column_step: float
    column_count: int
    wraps: bool
    reach: float

    @property
    def endless(self) -> "RayGrid":
        """The same rays without an end."""
        return replace(self, reach=np.inf)

    @cached_property
    def _row_table(self) -> tuple[np.ndarray, float]:
        """(row nearest to each of many even steps between the end rows, steps per unit)."""
        rows = np.asarray(self.rows)
        if len(rows) == 1:
            return np.zeros(1, np.int32), 0.0
        span = rows[-1] - rows[0]
        steps = int(min(16384, np.ceil(8 * span / np.diff(rows).min())))
        at = rows[0] + np.arange(steps + 1) * span / steps
        nearest = np.abs(at[:, None] - rows).argmin(1)
        return nearest.astype(np.int32), steps / span

    def nearest_row(self, row: Float[Array, "*n"]) -> Int[Array, "*n"]:
        """Index of the row nearest to a row coordinate; an end row beyond the ends.

        From a table eight steps finer than the closest rows: a point midway
        between two rows may get either.
        """
        table, scale = self._row_table
        index = jnp.round((row - self.rows[0]) * scale)
        return jnp.asarray(table)[jnp.clip(index, 0, len(table) - 1).astype(jnp.int32)]

    def row_at(self, index: Int[Array, "*n"]) -> Float[Array, "*n"]:
        """Coordinate of row ``index``."""
        return jnp.asarray(np.asarray(self.rows), float)[index]

    def column_index(self, column: Float[Array, "*n"]) -> Int[Array, "*n"]:
        """Index of the column at or before a column coordinate, not yet within the grid."""
        return jnp.floor((column - self.first_column) / self.column_step).astype(jnp.int32)

    def column_at(self, index: Int[Array, "*n"]) -> Float[Array, "*n"]:
        """Coordinate of column ``index``, wrapped round or held at the edge column."""
        last = self.column_count - 1
        index = index % self.column_count if self.wraps else jnp.clip(index, 0, last)
        return self.first_column + index.astype(float) * self.column_step

    @property
    def column_limits(self) -> tuple[float, float]:
        """Coordinates of the first and the last column."""
        last = self.first_column + (self.column_count - 1) * self.column_step
        return self.first_column, last

    def directions(self) -> Float[np.ndarray, "R 3"]:
        """Unit directions of all rays in the body frame, row by row."""
        columns = self.first_column + np.arange(self.column_count) * self.column_step
        row, column = np.meshgrid(np.asarray(self.rows), columns, indexing="ij")
        return np.stack(self.direction(row.ravel(), column.ravel(), np), axis=-1)

    def field_margin(self, q: Point) -> Float[Array, "*n"]:
        """How deep points lie in the field of view [m]: from the nearest edge row, edge column or
        the end of the reach; negative outside."""
        distance = jnp.sqrt(jnp.maximum(q[0] * q[0] + q[1] * q[1] + q[2] * q[2], _LEAST**2))
        low, high = self.rows[0], self.rows[-1]
        margin = jnp.minimum(self.reach - distance, self.beyond_row(q, low) / self.slant(low))
        margin = jnp.minimum(margin, -self.beyond_row(q, high) / self.slant(high))
        if self.wraps:
            return margin
        first, last = self.column_limits
        after = self.beyond_column(q, first) / self.slant(first)
        before = -self.beyond_column(q, last) / self.slant(last)
        # A field of more than half a turn is the union of the two sides, else their overlap.
        wide = last - first > np.pi and not self.slants
        both = jnp.maximum(after, before) if wide else jnp.minimum(after, before)
        return jnp.minimum(margin, both)

    # What the two kinds of grid define, each for its own coordinates.

    slants = False
    """Whether coordinates are tangents, so that :meth:`beyond_row` measures along an axis."""

    def slant(self, coordinate: float) -> float:
        """What to divide :meth:`beyond_row` and :meth:`beyond_column` by to measure square on."""
        return float(np.hypot(1.0, coordinate)) if self.slants else 1.0

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
        """How far points lie beyond a row, in metres across it; linear or nearly so."""
        raise NotImplementedError

    def beyond_column(self, q: Point, column: float) -> Float[Array, "*n"]:
        """How far points lie beyond a column, in metres across it."""
        raise NotImplementedError

    def row_normal(self, q: Point) -> Point:
        """A direction in which the row coordinate of points grows."""
        raise NotImplementedError

    def column_normal(self, q: Point) -> Point:
        """A direction in which the column coordinate of points grows."""
        raise NotImplementedError

    # For most voxels the ray nearest to the centre tells already whether any passes through.

    def to_ray(self, q: Point) -> tuple[Point, Any]:
        """From points to a point on a ray near each, and how far off that may be [m]: far, where
        there is none."""
        raise NotImplementedError

    def between(self, q: Point, half: float, extent: Callable[[Point], Any]) -> Bool[Array, "*n"]:
        """Whether cubes about points surely lie between two rows or two columns that follow each
        other, or beyond an end row, clear of both; false is no answer.

        ``half`` is half a cube's edge [m], ``extent`` how far it reaches along a direction, times
        the direction's length.
        """
        raise NotImplementedError

    def _neighbour(self, row: Float[Array, "*n"]) -> tuple[Any, Any, Any]:
        """(the nearest row, the next one on the other side, whether there is one)."""
        index = self.nearest_row(row)
        nearest = self.row_at(index)
        index = index + jnp.where(row > nearest, 1, -1)
        exists = (index >= 0) & (index < len(self.rows))
        return nearest, self.row_at(jnp.clip(index, 0, len(self.rows) - 1)), exists

    def _nearest_column(self, column: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Coordinate of the nearest column, not wrapped round."""
        index = jnp.round((column - self.first_column) / self.column_step)
        if not self.wraps:
            index = jnp.clip(index, 0, self.column_count - 1)
        return self.first_column + index * self.column_step


@dataclass(frozen=True)
class SphericalGrid(RayGrid):
    """A LiDAR's rays: rows are elevations ψ, columns azimuths θ [rad]."""

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

    def beyond_column(self, q: Point, column: float) -> Float[Array, "*n"]:
        """Distance to the left of the half-plane of azimuth ``column``."""
        return q[1] * np.cos(column) - q[0] * np.sin(column)

    def row_normal(self, q: Point) -> Point:
        """Upward along the meridian."""
        plan = _plan(q)
        return -q[2] * q[0], -q[2] * q[1], plan * plan

    def column_normal(self, q: Point) -> Point:
        """Leftward along the parallel."""
        return -q[1], q[0], jnp.zeros_like(q[0])

    def to_ray(self, q: Point) -> tuple[Point, Any]:
        """Along the meridian to the nearest row and along the parallel to the nearest column.

        Both as if straight: off by no more than the square of the angle, halved, times the range.
        Right above and below there is no meridian.
        """
        elevation, azimuth = self.row(q), self.column(q)
        up = self.row_at(self.nearest_row(elevation)) - elevation
        left = self._nearest_column(azimuth) - azimuth
        plan, distance = _plan(q), jnp.sqrt(_plan(q) ** 2 + q[2] * q[2])
        inward = up * q[2] / plan
        bend = (jnp.abs(up) + jnp.abs(left)) ** 2 / 2
        to = -inward * q[0] - left * q[1], -inward * q[1] + left * q[0], up * plan
        return to, jnp.where(plan > 2 * _LEAST, distance * (bend + _ANGLE), FAR)

    def between(self, q: Point, half: float, extent: Callable[[Point], Any]) -> Bool[Array, "*n"]:
        """Between two cones. A cube's extent across a cone is that across its tangent plane, and
        what the cone bends away from it."""
        plan, distance = _plan(q), jnp.sqrt(_plan(q) ** 2 + q[2] * q[2])
        elevation, span = self.row(q), np.sqrt(3.0) * half
        across = extent((-q[2] * q[0] / plan, -q[2] * q[1] / plan, plan)) / distance
        bend = span * span / (2.0 * jnp.maximum(plan - span, 1e-3))

        def clear(row: Any) -> Bool[Array, "*n"]:
            away = jnp.abs(elevation - row)
            turned = across + away * span + bend * (jnp.abs(q[2]) / distance + away)
            return distance * (away - away**3 / 6 - _ANGLE) > turned

        nearest, other, exists = self._neighbour(elevation)
        opposite = (elevation - nearest) * (elevation - other) < 0
        return clear(nearest) & (~exists | (clear(other) & opposite))


@dataclass(frozen=True)
class PinholeGrid(RayGrid):
    """A camera's rays: rows and columns are the tangents z/x and y/x."""

    slants = True

    def direction(self, row: Any, column: Any, xp: Any = jnp) -> tuple[Any, Any, Any]:
        """(1, column, row), scaled to unit length."""
        scale = 1.0 / xp.sqrt(1.0 + row * row + column * column)
        return scale, column * scale, row * scale

    def row(self, q: Point) -> Float[Array, "*n"]:
        """Tangent of the angle above the optical axis; from behind, as from far aside."""
        return q[2] / jnp.maximum(q[0], _LEAST)

    def column(self, q: Point) -> Float[Array, "*n"]:
        """Tangent of the angle to the left of the optical axis."""
        return q[1] / jnp.maximum(q[0], _LEAST)

    def beyond_row(self, q: Point, row: Any) -> Float[Array, "*n"]:
        """Height above the plane through row ``row``, along z."""
        return q[2] - row * q[0]

    def beyond_column(self, q: Point, column: float) -> Float[Array, "*n"]:
        """Distance to the left of the plane through column ``column``, along y."""
        return q[1] - column * q[0]

    def row_normal(self, q: Point) -> Point:
        """Gradient of z/x, times x²."""
        return -q[2], jnp.zeros_like(q[0]), jnp.maximum(q[0], _LEAST)

    def column_normal(self, q: Point) -> Point:
        """Gradient of y/x, times x²."""
        return -q[1], jnp.maximum(q[0], _LEAST), jnp.zeros_like(q[0])

    def to_ray(self, q: Point) -> tuple[Point, Any]:
        """Within the plane that is as far ahead as the point; none is behind."""
        row = self.row_at(self.nearest_row(self.row(q)))
        column = self._nearest_column(self.column(q))
        to = jnp.zeros_like(q[0]), column * q[0] - q[1], row * q[0] - q[2]
        return to, jnp.where(q[0] > 0, 0.0, FAR)

    def between(self, q: Point, half: float, extent: Callable[[Point], Any]) -> Bool[Array, "*n"]:
        """Between two planes."""
        x, y, z = q
        zero, one = jnp.zeros_like(x), jnp.ones_like(x)

        def clear(gap: Callable[[Any], Any], nearest: Any, other: Any, exists: Any) -> Any:
            near, far = gap(nearest), gap(other)  # in extents of the cube
            return (jnp.abs(near) > 1) & (~exists | ((jnp.abs(far) > 1) & (near * far < 0)))

        def above(row: Any) -> Any:
            return (z - row * x) / extent((-row * one, zero, one))

        def left_of(column: Any) -> Any:
            return (y - column * x) / extent((-column * one, one, zero))

        column, (first, last) = self._nearest_column(self.column(q)), self.column_limits
        other = column + jnp.where(self.column(q) > column, 1.0, -1.0) * self.column_step
        exists = (other > first - self.column_step / 2) & (other < last + self.column_step / 2)
        either = clear(above, *self._neighbour(self.row(q)))
        either |= clear(left_of, column, other, exists)
        return either & (x > 2 * half)


def _plan(q: Point) -> Float[Array, "*n"]:
    return jnp.sqrt(jnp.maximum(q[0] * q[0] + q[1] * q[1], _LEAST**2))


@dataclass(frozen=True)
class CameraSpec:
    """A pinhole camera: one ray per downsampled pixel, to its effective depth.

    ``width``, ``height`` [pixel]; ``focal`` length and ``principal`` point
    [pixel]; ``downsample`` is λ, so the rays are ⌊λ·height⌋ × ⌊λ·width⌋ and pass
    through the centres of the enlarged pixels; ``depth`` [m], measured along the
    ray; ``reliability`` is the chance that what is in view is perceived.
    """

    name: str
    width: int
    height: int
    focal: float
    principal: tuple[float, float]
    downsample: float
    depth: float
    reliability: float = 1.0

    kind = "camera"

    @cached_property
    def grid(self) -> RayGrid:
        """Rays r_ij = O + μ·((w_j − c_x)/f, (h_i − c_y)/f, 1), turned to the body frame."""
        columns = max(1, int(self.width * self.downsample + 1e-9))
        rows = max(1, int(self.height * self.downsample + 1e-9))
        pitch = self.width / columns / self.focal
        pixel = (np.arange(rows) + 0.5) * self.height / rows
        tangents = (self.principal[1] - pixel[::-1]) / self.focal  # pixel rows run downward
        leftmost = (self.principal[0] - self.width) / self.focal + pitch / 2
        return PinholeGrid(tuple(tangents), leftmost, pitch, columns, False, self.depth)


@dataclass(frozen=True)
class LidarSpec:
    """A LiDAR: channels at the elevations of a table, each fired at even azimuths.

    ``elevations`` ascend [rad]; ``azimuth_count`` is J; ``azimuth_fov`` is θ₀
    [rad], 2π for one that spins; ``reach`` is t_max [m]. Azimuths are
    θ_j = −θ₀/2 + j·θ₀/J (paper, section 3). ``reliability`` as for a camera.
    """

    name: str
    elevations: tuple[float, ...]
    azimuth_count: int
    azimuth_fov: float
    reach: float
    reliability: float = 1.0

    kind = "lidar"

    @cached_property
    def grid(self) -> RayGrid:
        """Rays (cos ψ_i cos θ_j, cos ψ_i sin θ_j, sin ψ_i)."""
        return SphericalGrid(
            self.elevations,
            -self.azimuth_fov / 2,
            self.azimuth_fov / self.azimuth_count,
            self.azimuth_count,
            bool(np.isclose(self.azimuth_fov, 2 * np.pi)),
            self.reach,
        )


Spec = CameraSpec | LidarSpec
