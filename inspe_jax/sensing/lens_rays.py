"""Rays through lenses that bend straight lines: distorted pinholes and fisheyes.

Rows and columns are those of the picture, even over the focal length: points come to them by the
lens's projection, and rays back from them (:mod:`inspe_jax.sensing.lens`). All that shows lies in
a cone about the optical axis; beyond it coordinates go on outward, and mean no ray.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from inspe_jax.core.geometry import FAR, Point, dot3
from inspe_jax.core.numerics import arctan2
from inspe_jax.core.pytree import pytree
from inspe_jax.sensing.lens import bend, project, ray
from inspe_jax.sensing.rays import ANGLE_ERROR, MIN_DISTANCE, Edges, PinholeRays, Rays

_NO_RAY = -1e-3  # margins of rays that there are none of are at most this [m]


@pytree
@dataclass(frozen=True)
class DistortedRays(Rays):
    """A camera's rays: rows up and columns to the left of the principal point, in focal lengths."""

    signal = PinholeRays.signal
    bends = True
    fisheye: ClassVar[bool] = False

    def direction(self, row: Any, column: Any, xp: Any = jnp) -> tuple[Any, Any, Any]:
        """Of the lens; beyond the image circle that of its rim."""
        circle = self.table.own[9]
        right, down, ahead = ray(-column, -row, self.table.own, self.fisheye, circle, xp)
        return ahead, -right, -down

    def exist(self, row: Any, column: Any) -> Any:
        """Whether rays are within the image circle."""
        return row * row + column * column <= self.table.own[9] ** 2

    def shown(self, row: Any, column: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Up to the chord of the image circle along the row."""
        half = jnp.sqrt(jnp.maximum(self.table.own[9] ** 2 - row * row, 0.0))
        return jnp.clip(column, -half, half)

    def existing(self, row: Any, column: Any, margin: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Negative for rays beyond the image circle."""
        return jnp.where(self.exist(row, column), margin, jnp.minimum(margin, _NO_RAY))

    def row(self, q: Point) -> Float[Array, "*n"]:
        """Focal lengths above the principal point."""
        return self._seen(q, self.table.own[10])[0]

    def column(self, q: Point) -> Float[Array, "*n"]:
        """Focal lengths to the left of the principal point."""
        return self._seen(q, self.table.own[10])[1]

    def _seen(self, q: Point, far: Any) -> tuple[Any, Any]:
        """(row, column) of points, by the projection up to the angle ``far`` [rad]."""
        right, down = project(-q[1], -q[2], q[0], self.table.own, self.fisheye, far, jnp)
        return -down, -right

    def slopes(self, q: Point, near: Any) -> tuple[Point, Point]:
        """Of the picture by the plane, of that by the angle θ to the axis and the one about it, and
        of these by the point, which is first moved into the cone of view."""
        distance, off, angle = _polar(q)
        distance, within = jnp.maximum(distance, near), jnp.minimum(angle, self.table.own[10])
        cos, sin = -q[1] / off, -q[2] / off  # to the right, and downward
        out = within if self.fisheye else jnp.tan(within)
        _, (along, across, down) = bend(out * cos, out * sin, self.table.own)
        longer = 1.0 if self.fisheye else 1.0 + out * out  # for each radian of θ
        around = out / jnp.sin(within)
        found = []
        for a, b in ((across, down), (along, across)):
            outward, aside = longer * (a * cos + b * sin), around * (b * cos - a * sin)
            ahead = outward * jnp.cos(within)
            right, lower = ahead * cos - aside * sin, ahead * sin + aside * cos
            slope = outward * jnp.sin(within), right, lower
            found.append(tuple(x / distance for x in slope))
        return found[0], found[1]

    def row_normal(self, q: Point) -> Point:
        """The gradient of the row."""
        return self.slopes(q, MIN_DISTANCE)[0]

    def column_normal(self, q: Point) -> Point:
        """The gradient of the column."""
        return self.slopes(q, MIN_DISTANCE)[1]

    def beyond_row(self, q: Point, row: Any) -> Float[Array, "*n"]:
        """In the picture, times the distance."""
        return (self.row(q) - row) * _polar(q)[0]

    def beyond_edge(self, q: Point, edge: int) -> Float[Array, "*n"]:
        """In the picture, times the distance."""
        return (self.column(q) - self.table.edges.column[edge]) * _polar(q)[0]

    def square_row(self, q: Point, edges: Edges, edge: int) -> Float[Array, "*n"]:
        """In the picture, over the slope there."""
        up, _ = self.slopes(q, MIN_DISTANCE)
        return (self.row(q) - edges.row[edge]) / jnp.sqrt(dot3(up, up))

    def square_column(self, q: Point, edges: Edges, edge: int) -> Float[Array, "*n"]:
        """In the picture, over the slope there."""
        _, left = self.slopes(q, MIN_DISTANCE)
        return (self.column(q) - edges.column[edge]) / jnp.sqrt(dot3(left, left))

    def sides(self, q: Point, edges: Edges) -> tuple[Float[Array, "*n"], ...]:
        """And how deep points lie in the cone of view."""
        return *super().sides(q, edges), self.cone_margin(q)

    def toward_sides(self, q: Point, way: Point, edges: Edges) -> tuple[Float[Array, "*n"], ...]:
        """Along the normals of the sides at the points."""
        _, left = self.slopes(q, MIN_DISTANCE)
        inward = self.inward(q)
        across = dot3(left, way) / jnp.sqrt(dot3(left, left))
        return across, -across, dot3(inward, way) / jnp.sqrt(dot3(inward, inward))

    def cone_margin(self, q: Point) -> Float[Array, "*n"]:
        """How deep points lie in the cone of view [m], along an arc about the camera."""
        distance, _, angle = _polar(q)
        return distance * (self.table.own[10] - angle)

    def inward(self, q: Point) -> Point:
        """Toward the axis of the cone."""
        _, off, _ = _polar(q)
        return off, -q[0] * q[1] / off, -q[0] * q[2] / off

    def surely_outside(self, q: Point, edges: Edges, radius: Any) -> Bool[Array, "*n"]:
        """By the cone of view and the reach."""
        distance, _, angle = _polar(q)
        away = jnp.clip(angle - self.table.own[10], 0.0, np.pi / 2)
        return jnp.maximum(distance * jnp.sin(away), distance - self.table.reach) > radius

    def to_ray(self, q: Point) -> tuple[Point, Any]:
        """To the foot of the perpendicular on the ray of the nearest row and column."""
        row, column = (
            self.row_at(self.nearest_row(self.row(q))),
            self.nearest_column(self.column(q)),
        )
        way = self.direction(row, column)
        along = dot3(way, q)
        to = tuple(along * a - b for a, b in zip(way, q, strict=True))
        there = (along > 0) & self.exist(row, column)
        return to, jnp.where(there, along * ANGLE_ERROR, FAR)

    def between(self, q: Point, half: Any, extent: Callable[[Point], Any]) -> Bool[Array, "*n"]:
        """Whether cubes lie between two rows, or two columns: to either side coordinates change by
        the slope at the middle, and by what second derivatives add at most."""
        distance, _, angle = _polar(q)
        span = 3.0**0.5 * half
        spread = span / jnp.maximum(distance - span, MIN_DISTANCE)
        up, left = self.slopes(q, MIN_DISTANCE)
        row, column = self._seen(q, self.table.own[10])
        bent = self.table.own[11] * spread * spread / 2
        tall, wide = extent(up) + bent, extent(left) + bent
        clear = self.apart(
            row, column, lambda at: (row - at) / tall, lambda at: (column - at) / wide
        )
        return clear & (angle + spread < self.table.own[10])


@pytree
@dataclass(frozen=True)
class FisheyeRays(DistortedRays):
    """The same of an equidistant fisheye, which may see behind its picture plane."""

    fisheye = True


def _polar(q: Point) -> tuple[Any, Any, Any]:
    """Distance, distance from the optical axis [m], both at least a little, and angle to it."""
    off = jnp.sqrt(jnp.maximum(q[1] * q[1] + q[2] * q[2], MIN_DISTANCE**2))
    return jnp.sqrt(q[0] * q[0] + off * off), off, arctan2(off, q[0])
