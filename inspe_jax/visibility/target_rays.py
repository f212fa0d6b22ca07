"""Rays on a target: how many a road user gets where it stands, slab by slab of its height.

A target is an upright box whose heading is not known: results are means over headings. Rays are a
density (:mod:`inspe_jax.visibility.ray_density`), so a number is the mean over random phases of the
grid. It has a slope in the sensor's pose, except where a plane of the target passes out of reach or
its top comes into sight.
"""

import functools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from inspe_jax.core.geometry import Point, dot3
from inspe_jax.core.numerics import arctan2
from inspe_jax.sensing.lidar_returns import LidarNoise
from inspe_jax.sensing.rays import Rays
from inspe_jax.visibility.in_view import RigidTransform, to_body

HEADINGS = 12
"""Headings of a target, evenly spread over half a turn, that a number is the mean of."""
OFFSET = 0.5 - 12**-0.5
"""Where in its part of the half turn each heading is. Widths have kinks at quarter turns. With this
offset they bring no error to first order, and in the middle of each part about 1 %."""
PLANES = 6
"""Upright planes through the sensor that cut a target, at the nodes of Gauss and Legendre."""
ASIDE = 4.0
"""Half as wide as the widest road user, and a little [m]: beyond, none is in view."""
NEAR = 0.5
"""Faces nearer than this in plan [m] are taken to be so far off."""
_LEAST = 1e-9  # what numbers that are divided by are at least, in whatever unit they have
_SLANT = 0.02  # least cosine of the angle to a camera's axis, or sine of that to a LiDAR's
_DEEP = 0.1  # least depth ahead of a camera [m]
_SMALL = 3e-5  # the least part of a grid, in its coordinates, in which rays are counted


@partial(jax.jit, static_argnames=("size", "noise"))
def rays_on_target(
    rays: Rays,
    transform: RigidTransform,
    feet: Float[Array, "L 3"],
    slabs: Float[Array, " Z+1"],
    *,
    size: tuple[float, float, float],
    noise: LidarNoise | None = None,
) -> Float[Array, "L Z"]:
    """The expected number of rays on each slab of a target that stands at each of L feet.

    ``size`` is length, width and height [m]. ``slabs`` are the heights above the foot [m] between
    which the slabs lie, ascending; what is above the target has no rays. Those on its top belong to
    the highest slab. Traffic does not matter. With ``noise``, only the rays that come back count.

    Upright planes through the sensor cut the target. In each, rays on a slab have elevations from
    its lower to its upper edge at the front, or to the far edge of the top where the sensor is
    higher than that. Their number is this angle, times the angle between planes, times the density
    of rays there in the middle. So a camera's pixels on a target as near as it is large, which
    fills much of the picture, are not counted well.
    """
    half = np.array(size[:2]) / 2
    to = feet - transform.position[None]
    square = to[:, 0] ** 2 + to[:, 1] ** 2
    away = jnp.sqrt(jnp.maximum(square, _LEAST))
    # The bearing of the target; any, for one straight below.
    cos, sin = jnp.where(square > _LEAST, to[:, 0] / away, 1.0), to[:, 1] / away
    edges = jnp.minimum(slabs, size[2])
    low, high = to[:, 2:] + edges[None, :-1], to[:, 2:] + edges[None, 1:]  # (L, Z)
    on_top = (edges[:-1] < size[2]) & (edges[1:] >= size[2])

    def in_plane(plane: tuple[Array, Array, Array]) -> Float[Array, "L Z"]:
        heading, node, weight = plane
        left, right = _sides(away, half, heading)
        turn = (left + right) / 2 + node * (left - right) / 2
        wide = weight * (left - right) / 2
        front, back = _chord(away, half, heading, turn)
        x = cos * jnp.cos(turn) - sin * jnp.sin(turn)
        y = sin * jnp.cos(turn) + cos * jnp.sin(turn)
        over = on_top[None] & (high < 0)
        far = jnp.where(over, back[:, None], front[:, None])
        least, most = arctan2(low, jnp.broadcast_to(front[:, None], low.shape)), arctan2(high, far)
        middle = (least + most) / 2
        up = jnp.where(over, high, (low + high) / 2)
        distance = jnp.sqrt(((front[:, None] + far) / 2) ** 2 + up * up)
        bearing, elevation = (x[:, None], y[:, None]), (jnp.cos(middle), jnp.sin(middle))
        number = _rays_within(
            rays, transform.to_world, bearing, elevation, most - least, wide[:, None]
        )
        number = jnp.where((distance <= rays.table.reach) & (most > least), number, 0.0)
        return number if noise is None else number * noise.share_returned(distance, jnp)

    turns = (np.arange(HEADINGS) + OFFSET) * np.pi / HEADINGS
    nodes, weights = np.polynomial.legendre.leggauss(PLANES)
    planes = np.repeat(turns, PLANES), np.tile(nodes, HEADINGS), np.tile(weights, HEADINGS)
    found = jax.lax.map(in_plane, tuple(jnp.asarray(part, float) for part in planes))
    return found.sum(0) / HEADINGS


def rays_on_face(
    rays: Rays,
    transform: RigidTransform,
    to: tuple[Float[Array, " C"], Float[Array, " C"]],
    low: Float[Array, "Z C"],
    high: Float[Array, "Z C"],
) -> tuple[Float[Array, "Z C"], Float[Array, "Z C"]]:
    """(the expected number of rays, the distance [m]) of slabs of upright faces at C places.

    A face is one metre wide, and square on to the line of sight in plan. ``to`` are x and y from
    the sensor to its middle, ``low`` and ``high`` the heights above the sensor between which the
    slabs lie [m]. Neither the reach nor the sides of the field of view matter: where the middle is
    beyond a side, rays are counted as far aside as it takes to be inside, and
    :func:`share_between_sides` tells how much of a face is there. Faces are taken as small beside
    their distance, which is at least :data:`NEAR`.
    """
    if not rays.wraps:
        shift = _shift_inside(rays, transform, (*to, (low[0] + high[-1]) / 2))
        plan = jnp.sqrt(jnp.maximum(to[0] ** 2 + to[1] ** 2, NEAR**2))
        to = to[0] - shift * to[1] / plan, to[1] + shift * to[0] / plan
    away = jnp.sqrt(jnp.maximum(to[0] ** 2 + to[1] ** 2, NEAR**2))[None]
    middle = (low + high) / 2
    distance = jnp.sqrt(away * away + middle * middle)
    bearing = to[0][None] / away, to[1][None] / away
    elevation = away / distance, middle / distance
    tall = away * (high - low) / (distance * distance)
    given = rays, transform.to_world, bearing, elevation, tall, 1.0 / away
    return _rays_within(*given, sides=False), distance


def share_between_sides(
    rays: Rays,
    transform: RigidTransform,
    to: Point,
    width: Float[Array, "K 1"],
    tall: Float[Array, "K 1"],
) -> Float[Array, "K C"]:
    """How much of upright faces, square on in plan, is between the sides of the field of view.

    ``to`` are their middles from the sensor, ``width`` and ``tall`` their sizes [m].
    """
    if rays.wraps:
        return jnp.ones((len(width), len(to[0])), to[0].dtype)
    q, aside, up = jax.tree.map(lambda x: x[None], _face_axes(transform, to))
    return _between_sides(rays, q, aside, up, width, tall)


def _face_axes(transform: RigidTransform, to: Point) -> tuple[Point, Point, Point]:
    """Places, the directions aside there in plan, and upward, in the body frame."""
    plan = jnp.sqrt(jnp.maximum(to[0] ** 2 + to[1] ** 2, NEAR**2))
    zero = jnp.zeros_like(plan)
    parts = to, (-to[1] / plan, to[0] / plan, zero), (zero, zero, zero + 1.0)
    q, aside, up = (to_body(transform.to_world, part) for part in parts)
    return q, aside, up


def _between_sides(
    rays: Rays, q: Point, aside: Point, up: Point, wide: Array, tall: Array
) -> Float[Array, "*n"]:
    """How much of a patch about each point ``q`` is between the sides of the field of view.

    A side is a plane through the sensor. A patch is ``wide`` along ``aside`` and ``tall`` along
    ``up``; a plane cuts it as though all of it were spread evenly along the plane's normal.
    """
    inside = []
    for k, sign in enumerate((1.0, -1.0)):  # to the left of the right side, and the other way
        margin, across, along = (rays.square_column(x, rays.table.outer, k) for x in (q, aside, up))
        spread = jnp.maximum(jnp.abs(across) * wide + jnp.abs(along) * tall, _SMALL)
        inside.append(jnp.clip(0.5 + sign * margin / spread, 0.0, 1.0))
    # A field of more than half a turn is what is inside of either side.
    total = inside[0] + inside[1]
    return jnp.clip(jnp.where(rays.table.wide, total, total - 1.0), 0.0, 1.0)


def _shift_inside(rays: Rays, transform: RigidTransform, to: Point) -> Float[Array, " C"]:
    """How far faces must go aside [m], at most :data:`ASIDE`, to have their middles between the
    sides of the field of view."""
    q, aside, _ = _face_axes(transform, to)
    found, out = [], []
    for k, sign in enumerate((1.0, -1.0)):
        margin, across = (sign * rays.square_column(x, rays.table.outer, k) for x in (q, aside))
        slope = jnp.where(jnp.abs(across) > _SLANT, across, _SLANT)
        out.append(margin < 0)
        found.append(jnp.where(margin < 0, jnp.clip(-margin / slope, -ASIDE, ASIDE), 0.0))
    nearer = jnp.where(jnp.abs(found[0]) < jnp.abs(found[1]), found[0], found[1])
    either = jnp.where(out[0] & out[1], nearer, 0.0)
    return jnp.where(rays.table.wide, either, jnp.clip(found[0] + found[1], -ASIDE, ASIDE))


@partial(jax.jit, static_argnames="height")
def picture_scale(
    rays: Rays, transform: RigidTransform, feet: Float[Array, "L 3"], *, height: float
) -> Float[Array, " L"]:
    """How far a metre across a target is in the picture, ``height`` metres above each foot [1/m].

    The metre is level, and square on to the line of sight in plan. In a camera's tangents it is
    1 / depth along the optical axis in the middle of the picture, and more towards its sides; times
    the focal length in pixels, it is pixels per metre. It is 0 where the point is outside of the
    field of view or the reach.
    """
    to = feet + jnp.array([[0.0, 0.0, height]], feet.dtype) - transform.position[None]
    scale, margin = scale_at(rays, transform, (to[:, 0], to[:, 1], to[:, 2]))
    return jnp.where(margin > 0, scale, 0.0)


def scale_at(
    rays: Rays, transform: RigidTransform, to: Point
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """:func:`picture_scale` [1/m] of points ``to`` from the sensor, also outside of the picture;
    and how deep they lie in the field of view [m]."""
    plan = jnp.sqrt(jnp.maximum(to[0] ** 2 + to[1] ** 2, _LEAST))
    q = to_body(transform.to_world, to)
    aside = to_body(transform.to_world, (-to[1] / plan, to[0] / plan, jnp.zeros_like(plan)))
    row, column = (dot3(slope, aside) for slope in rays.slopes(q, _DEEP))
    return jnp.sqrt(row * row + column * column + _LEAST), rays.field_margin(q, rays.table.outer)


def _sides(
    away: Float[Array, " L"], half: np.ndarray, heading: Float[Array, ""]
) -> tuple[Float[Array, " L"], Float[Array, " L"]]:
    """Bearings of the left and the right end of a rectangle ``away`` metres ahead [rad].

    Around a sensor that is inside, it takes up the whole turn.
    """
    cos, sin = jnp.cos(heading), jnp.sin(heading)
    inside = (jnp.abs(away * cos) < half[0]) & (jnp.abs(away * sin) < half[1])
    ends = [
        arctan2(
            jnp.full_like(away, i * half[0]) * sin + j * half[1] * cos,
            away + i * half[0] * cos - j * half[1] * sin,
        )
        for i, j in ((1, 1), (1, -1), (-1, 1), (-1, -1))
    ]
    left = functools.reduce(jnp.maximum, ends)
    right = functools.reduce(jnp.minimum, ends)
    return jnp.where(inside, np.pi, left), jnp.where(inside, -np.pi, right)


def _chord(
    away: Float[Array, " L"],
    half: np.ndarray,
    heading: Float[Array, ""],
    bearing: Float[Array, " L"],
) -> tuple[Float[Array, " L"], Float[Array, " L"]]:
    """Where a line at a bearing enters and leaves a rectangle ``away`` metres ahead [m]."""
    enters, leaves = jnp.zeros_like(away), jnp.full_like(away, jnp.inf)
    turned = bearing - heading
    for start, along, side in (
        (-away * jnp.cos(heading), jnp.cos(turned), half[0]),
        (away * jnp.sin(heading), jnp.sin(turned), half[1]),
    ):
        safe = jnp.where(jnp.abs(along) < _LEAST, _LEAST, along)
        one, other = (-side - start) / safe, (side - start) / safe
        enters = jnp.maximum(enters, jnp.minimum(one, other))
        leaves = jnp.minimum(leaves, jnp.maximum(one, other))
    return enters, jnp.maximum(leaves, enters)


def _rays_within(
    rays: Rays,
    to_world: Float[Array, "3 3"],
    bearing: tuple[Float[Array, "..."], Float[Array, "..."]],
    elevation: tuple[Float[Array, "*n"], Float[Array, "*n"]],
    tall: Float[Array, "*n"],
    wide: Float[Array, "..."],
    sides: bool = True,
) -> Float[Array, "*n"]:
    """The expected number of rays within ``tall`` by ``wide`` radians about directions.

    ``bearing`` is x and y of a unit vector in plan, ``elevation`` the cosine and the sine of that
    angle. The part of the angles that is outside of the grid is left out; without ``sides``, only
    that beyond the outer rows.
    """
    x, y = bearing
    cos, sin = elevation
    ahead = to_body(to_world, (x * cos, y * cos, sin))
    aside = to_body(to_world, (-y * cos, x * cos, jnp.zeros_like(sin)))
    upward = to_body(to_world, (-x * sin, -y * sin, cos))
    row_slope, column_slope = rays.slopes(ahead, _SLANT)
    row_up, row_aside = dot3(row_slope, upward), dot3(row_slope, aside)
    column_up, column_aside = dot3(column_slope, upward), dot3(column_slope, aside)
    # Rows and columns, in their coordinates, for each unit of solid angle.
    dense = jnp.abs(row_up * column_aside - row_aside * column_up)
    row, table = rays.row(ahead), rays.table
    reach = jnp.maximum(jnp.abs(row_up) * tall + jnp.abs(row_aside) * wide, _SMALL) / 2
    count = jnp.asarray(table.row_count).astype(row.dtype)
    rows = jnp.clip(rays.rows_below(row + reach), 0.0, count)
    rows = (rows - jnp.clip(rays.rows_below(row - reach), 0.0, count)) / (2 * reach)
    number = dense * rows * jnp.asarray(table.columns_per_unit) * tall * wide
    if sides and not rays.wraps:
        number *= _between_sides(rays, ahead, aside, upward, wide, tall)
    return jnp.where(ahead[0] > 0, number, 0.0) if rays.slants else number
