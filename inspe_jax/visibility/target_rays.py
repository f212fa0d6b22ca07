"""Rays on road users: how many meet an upright face, and how large it is in a picture.

Rays are a density (:mod:`inspe_jax.visibility.ray_density`), so a number is the mean over random
phases of the grid. It has a slope in the sensor's pose.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from inspe_jax.core.geometry import Point, dot3
from inspe_jax.sensing.rays import Rays
from inspe_jax.visibility.in_view import RigidTransform, to_body

ASIDE = 4.0
"""Half as wide as the widest road user, and a little [m]: beyond, none is in view."""
NEAR = 0.5
"""Faces nearer than this in plan [m] are taken to be so far off."""
_LEAST = 1e-9  # what numbers that are divided by are at least, in whatever unit they have
_SLANT = 0.02  # least cosine of the angle to a camera's axis, or sine of that to a LiDAR's
_DEEP = 0.1  # least depth ahead of a camera [m]
_SMALL = 3e-5  # the least part of a grid, in its coordinates, in which rays are counted


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
    return _rays_within(rays, transform.to_world, bearing, elevation, tall, 1.0 / away), distance


def share_between_sides(
    rays: Rays,
    transform: RigidTransform,
    to: Point,
    width: Float[Array, "K 1"],
    tall: Float[Array, "K 1"],
) -> Float[Array, "K C"]:
    """How much of upright faces, square on in plan, is between the sides of the field of view.

    ``to`` are their middles from the sensor, ``width`` and ``tall`` their sizes [m]. A side is a
    plane through the sensor; a face is taken as spread evenly along the plane's normal.
    """
    if rays.wraps:
        return jnp.ones((len(width), len(to[0])), to[0].dtype)
    q, aside, up = jax.tree.map(lambda x: x[None], _face_axes(transform, to))
    across, along = (rays.toward_sides(q, way, rays.table.outer) for way in (aside, up))
    margins, inside = rays.sides(q, rays.table.outer), []
    for margin, level, upright in zip(margins, across, along, strict=True):
        spread = jnp.maximum(jnp.abs(level) * width + jnp.abs(upright) * tall, _SMALL)
        inside.append(jnp.clip(0.5 + margin / spread, 0.0, 1.0))
    # A field of more than half a turn is what is inside of either side.
    total = inside[0] + inside[1]
    share = jnp.clip(jnp.where(rays.table.wide, total, total - 1.0), 0.0, 1.0)
    for other in inside[2:]:
        share *= other
    return share


def _face_axes(transform: RigidTransform, to: Point) -> tuple[Point, Point, Point]:
    """Places, the directions aside there in plan, and upward, in the body frame."""
    plan = jnp.sqrt(jnp.maximum(to[0] ** 2 + to[1] ** 2, NEAR**2))
    zero = jnp.zeros_like(plan)
    parts = to, (-to[1] / plan, to[0] / plan, zero), (zero, zero, zero + 1.0)
    q, aside, up = (to_body(transform.to_world, part) for part in parts)
    return q, aside, up


def _shift_inside(rays: Rays, transform: RigidTransform, to: Point) -> Float[Array, " C"]:
    """How far faces go aside [m], to :data:`ASIDE`, to have their middles between the sides."""
    q, aside, _ = _face_axes(transform, to)
    found, out = [], []
    sides = rays.sides(q, rays.table.outer), rays.toward_sides(q, aside, rays.table.outer)
    for margin, across in zip(sides[0][:2], sides[1][:2], strict=True):
        slope = jnp.where(jnp.abs(across) > _SLANT, across, _SLANT)
        out.append(margin < 0)
        found.append(jnp.where(margin < 0, jnp.clip(-margin / slope, -ASIDE, ASIDE), 0.0))
    nearer = jnp.where(jnp.abs(found[0]) < jnp.abs(found[1]), found[0], found[1])
    either = jnp.where(out[0] & out[1], nearer, 0.0)
    return jnp.where(rays.table.wide, either, jnp.clip(found[0] + found[1], -ASIDE, ASIDE))


def scale_at(
    rays: Rays, transform: RigidTransform, to: Point
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """How long a metre across a target is in a picture [1/m], and its depth in the field [m].

    Targets are at points ``to`` from the sensor, also outside of the picture. The metre is level,
    and square on to the line of sight in plan. In a camera's tangents it is 1 / depth along the
    optical axis in the middle of the picture, and more towards its sides; times the focal length in
    pixels, it is pixels per metre.
    """
    plan = jnp.sqrt(jnp.maximum(to[0] ** 2 + to[1] ** 2, _LEAST))
    q = to_body(transform.to_world, to)
    aside = to_body(transform.to_world, (-to[1] / plan, to[0] / plan, jnp.zeros_like(plan)))
    row, column = (dot3(slope, aside) for slope in rays.slopes(q, _DEEP))
    return jnp.sqrt(row * row + column * column + _LEAST), rays.field_margin(q, rays.table.outer)


def _rays_within(
    rays: Rays,
    to_world: Float[Array, "3 3"],
    bearing: tuple[Float[Array, "..."], Float[Array, "..."]],
    elevation: tuple[Float[Array, "*n"], Float[Array, "*n"]],
    tall: Float[Array, "*n"],
    wide: Float[Array, "..."],
) -> Float[Array, "*n"]:
    """The expected number of rays within ``tall`` by ``wide`` radians about directions.

    ``bearing`` is x and y of a unit vector in plan, ``elevation`` the cosine and the sine of that
    angle. The part of the angles that is beyond the outer rows is left out.
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
    return jnp.where(ahead[0] > 0, number, 0.0) if rays.slants else number
