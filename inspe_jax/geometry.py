"""Poses, rotations, and the two margins everything rests on; knows no sensor.

Ray against box: separations on the separating axes, in metres. Line of sight
against vertical prisms: the height below which a prism hides a column.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from inspe_jax.numerics import nonzero

NEVER = -1e9
"""Ceiling [m] of a prism that hides nothing: below every voxel, yet finite."""
FAR = 1e9
"""Stands for an unbounded slab: large, yet finite, so that 0 × FAR is 0."""

Point = tuple[Float[Array, "*n"], Float[Array, "*n"], Float[Array, "*n"]]
"""x, y, z of many points or directions, apart: the kernels take one coordinate at a time."""


class Prism(NamedTuple):
    """Vertical prisms on solid ground: an oriented rectangle each, and a top [m, rad]."""

    center: Float[Array, "*b 2"]
    yaw: Float[Array, "*b"]
    half: Float[Array, "*b 2"]
    top: Float[Array, "*b"]
    valid: Bool[Array, "*b"]


def rotation(angles: Any, xp: Any = jnp) -> Any:
    """Body-to-world rotation Rz(yaw) Ry(−pitch) Rx(roll) of (roll, pitch, yaw) [rad]:
    (3,) to (3, 3).

    Pitch is positive nose-up in a frame whose y points left, hence its sign.
    ``xp`` is jax.numpy, or numpy for double precision outside a trace.
    """
    (cr, cp, cy), (sr, sp, sy) = xp.cos(angles), xp.sin(angles)
    return xp.array(
        [
            [cy * cp, -sy * cr - cy * sp * sr, sy * sr - cy * sp * cr],
            [sy * cp, cy * cr - sy * sp * sr, -cy * sr - sy * sp * cr],
            [sp, cp * sr, cp * cr],
        ]
    )


def ray_cube_margin(
    direction: Point,
    reach: float,
    offset: Point,
    half: float,
) -> Float[Array, "*n"]:
    """How deep a ray passes through a cube [m]; negative by how far it misses.

    The ray starts at 0 and goes ``reach`` metres along the unit ``direction``;
    the cube is centred at ``offset`` with half edge ``half``, axis-aligned.
    Separating axes of a segment and a box: the box's own three, and the three
    cross products of the ray with them. On each, the margin is the supports'
    sum minus the offset, over the length of the axis; unlike slab parameters it
    stays in metres when the ray runs parallel to a face.
    """
    margin = jnp.full_like(offset[0], FAR)
    for k in range(3):
        along = reach / 2 * direction[k]  # half the segment, as a vector on axis k
        margin = jnp.minimum(margin, half + jnp.abs(along) - jnp.abs(offset[k] - along))
        a, b = direction[k - 1], direction[k - 2]
        length = jnp.sqrt(jnp.maximum(a * a + b * b, 1e-12))
        across = jnp.abs(offset[k - 2] * a - offset[k - 1] * b)
        support = half * (jnp.abs(a) + jnp.abs(b))
        # Along e_k itself the cross product vanishes and separates nothing.
        margin = jnp.minimum(margin, jnp.where(length < 1e-5, half, (support - across) / length))
    return margin


class Shade(NamedTuple):
    """A prism as one sensor sees it: what its shadow needs, made by :func:`shade`."""

    cos: Float[Array, "*b"]
    sin: Float[Array, "*b"]
    x_near: Float[Array, "*b"]
    x_far: Float[Array, "*b"]
    y_near: Float[Array, "*b"]
    y_far: Float[Array, "*b"]
    x_inside: Bool[Array, "*b"]
    y_inside: Bool[Array, "*b"]
    rise: Float[Array, "*b"]


def shade(sensor: Float[Array, "3"], prism: Prism) -> Shade:
    """Turn a sensor into each prism's frame and divide once, so that no sight line has to.

    Along the sight line s + t·(c − s) the slab −a ≤ x ≤ a of the prism's own
    frame is crossed at t = (±a − s_x)/d_x. In u = 1/t that is d_x/(±a − s_x):
    linear in the column, the division being by a number of the prism alone. A
    sight line parallel to a side has u = 0, t = ∞, and needs no special case.
    An invalid prism gets u = 0 throughout and shades nothing.
    """
    dx, dy = sensor[0] - prism.center[..., 0], sensor[1] - prism.center[..., 1]
    cos, sin = jnp.cos(prism.yaw), jnp.sin(prism.yaw)
    x, y = cos * dx + sin * dy, cos * dy - sin * dx
    a, b = prism.half[..., 0], prism.half[..., 1]
    on = prism.valid.astype(x.dtype)
    front, back = nonzero(a - x), nonzero(-a - x)
    left, right = nonzero(b - y), nonzero(-b - y)
    return Shade(
        cos,
        sin,
        on / front,
        on / back,
        on / left,
        on / right,
        # By the same numbers, so that a sensor in the plane of a side is on one side of it.
        prism.valid & (front > 0) & (back < 0),
        prism.valid & (left > 0) & (right < 0),
        prism.top - sensor[2],
    )


def shadow_ceiling(
    shade: Shade,
    dx: Float[Array, " L"],
    dy: Float[Array, " L"],
    sensor_z: Float[Array, ""],
    *,
    spare_own: bool = False,
) -> Float[Array, " L"]:
    """Height [m] below which one prism hides each column; :data:`NEVER` where it does not.

    (dx, dy) is column minus sensor. With t₀, t₁ the plan-view entry and exit
    (t₁ clipped to 1) and h the top: z* = z_s − (z_s − h)/t₁ for a sensor above
    the top, whose sight line is lowest where it leaves the prism, and
    z* = z_s + (h − z_s)/t₀ for one below, lowest where it enters. Nothing is
    seen beneath a prism. ``spare_own``: a prism does not hide the columns it
    stands on.
    """
    ex, ey = shade.cos * dx + shade.sin * dy, shade.cos * dy - shade.sin * dx
    x_exit, x_entry = _crossings(ex * shade.x_near, ex * shade.x_far, shade.x_inside)
    y_exit, y_entry = _crossings(ey * shade.y_near, ey * shade.y_far, shade.y_inside)
    leaves = jnp.maximum(x_exit, y_exit)  # 1/t₁, less than 1 where the line ends inside
    exit_, entry = jnp.maximum(leaves, 1.0), jnp.minimum(x_entry, y_entry)
    meets = exit_ < entry
    if spare_own:
        meets &= leaves >= 1.0
    ceiling = sensor_z + shade.rise * jnp.where(shade.rise < 0, exit_, entry)
    return jnp.where(meets, ceiling, NEVER)


def _crossings(
    u: Float[Array, " L"], v: Float[Array, " L"], inside: Bool[Array, ""]
) -> tuple[Float[Array, " L"], Float[Array, " L"]]:
    """(1/exit, 1/entry) of a slab; from inside, the entry lies behind the sensor, at 1/0."""
    low, high = jnp.minimum(u, v), jnp.maximum(u, v)
    return jnp.where(inside, high, low), jnp.where(inside, FAR, high)


def solid_top(columns: Float[Array, "L 2"], prism: Prism) -> Float[Array, " L"]:
    """Top [m] of the highest prism that stands on each column; :data:`NEVER` where none does."""
    prism = jax.tree.map(lambda leaf: leaf[:, None], prism)  # (B, 1, …)
    dx, dy = columns[None, :, 0] - prism.center[..., 0], columns[None, :, 1] - prism.center[..., 1]
    cos, sin = jnp.cos(prism.yaw), jnp.sin(prism.yaw)
    x, y = jnp.abs(cos * dx + sin * dy), jnp.abs(cos * dy - sin * dx)  # (B, L)
    margin = jnp.minimum(prism.half[..., 0] - x, prism.half[..., 1] - y)
    stands = prism.valid & (margin > 0)
    return jnp.max(jnp.where(stands, prism.top, NEVER), axis=0, initial=NEVER)
