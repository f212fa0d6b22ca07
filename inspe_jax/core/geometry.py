"""Poses, rotations, and the two margins everything rests on; knows no sensor.

Ray against box: separations on the separating axes, in metres. Line of sight
against vertical prisms: the height below which a prism hides a column, and, to be
read softly, how deep the sight line cuts into the prism sideways and from above.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from inspe_jax.core.numerics import nonzero

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
    reach: float | Float[Array, ""],
    offset: Point,
    half: float | Float[Array, ""],
) -> Float[Array, "*n"]:
    """How deep a ray passes through a cube [m]; negative by how far it misses.

    The ray starts at 0 and goes ``reach`` metres along the unit ``direction``;
    the cube is centred at ``offset`` with half edge ``half``, axis-aligned.
    Separating axes of a segment and a box: the box's own three, and the three
    cross products of the ray with them. On each, the margin is the supports'
    sum minus the offset, over the length of the axis; unlike slab parameters it
    stays in metres when the ray runs parallel to a face.
    """
    margin = jnp.full_like(direction[0], FAR)
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


class ShadowTerms(NamedTuple):
    """A prism as one sensor sees it: what its shadow needs, made by :func:`shadow_terms`."""

    cos: Float[Array, "*b"]
    sin: Float[Array, "*b"]
    x_near: Float[Array, "*b"]
    x_far: Float[Array, "*b"]
    y_near: Float[Array, "*b"]
    y_far: Float[Array, "*b"]
    x_inside: Bool[Array, "*b"]
    y_inside: Bool[Array, "*b"]
    rise: Float[Array, "*b"]


def shadow_terms(sensor: Float[Array, "3"], prism: Prism) -> ShadowTerms:
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
    return ShadowTerms(
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
    terms: ShadowTerms,
    dx: Float[Array, " L"],
    dy: Float[Array, " L"],
    sensor_z: Float[Array, ""],
    *,
    ignore_self_occlusion: bool | Bool[Array, "*b"] = False,
) -> Float[Array, " L"]:
    """Height [m] below which one prism hides each column; :data:`NEVER` where it does not.

    (dx, dy) is column minus sensor. With t₀, t₁ the plan-view entry and exit
    (t₁ clipped to 1) and h the top: z* = z_s − (z_s − h)/t₁ for a sensor above
    the top, whose sight line is lowest where it leaves the prism, and
    z* = z_s + (h − z_s)/t₀ for one below, lowest where it enters. Nothing is
    seen beneath a prism. ``ignore_self_occlusion``: a prism does not hide the columns it
    stands on.
    """
    leaves, entry = _plan_crossings(terms, dx, dy)
    exit_ = jnp.maximum(leaves, 1.0)
    meets = exit_ < entry
    if ignore_self_occlusion is not False:
        meets &= (leaves >= 1.0) | ~jnp.asarray(ignore_self_occlusion)
    ceiling = sensor_z + terms.rise * jnp.where(terms.rise < 0, exit_, entry)
    return jnp.where(meets, ceiling, NEVER)


def _plan_crossings(
    terms: ShadowTerms, dx: Float[Array, " L"], dy: Float[Array, " L"]
) -> tuple[Float[Array, " L"], Float[Array, " L"]]:
    """(1/t₁, 1/t₀) of each sight line; 1/t₁ is less than 1 where the line ends inside."""
    ex, ey = terms.cos * dx + terms.sin * dy, terms.cos * dy - terms.sin * dx
    x_exit, x_entry = _crossings(ex * terms.x_near, ex * terms.x_far, terms.x_inside)
    y_exit, y_entry = _crossings(ey * terms.y_near, ey * terms.y_far, terms.y_inside)
    return jnp.maximum(x_exit, y_exit), jnp.minimum(x_entry, y_entry)


def _crossings(
    u: Float[Array, " L"], v: Float[Array, " L"], inside: Bool[Array, ""]
) -> tuple[Float[Array, " L"], Float[Array, " L"]]:
    """(1/exit, 1/entry) of a slab; from inside, the entry lies behind the sensor, at 1/0."""
    low, high = jnp.minimum(u, v), jnp.maximum(u, v)
    return jnp.where(inside, high, low), jnp.where(inside, FAR, high)


class Line(NamedTuple):
    """Sight lines in plan, in a rectangle's own frame: from (x, y) by (ex, ey) [m]."""

    x: Float[Array, "*n"]
    y: Float[Array, "*n"]
    ex: Float[Array, "*n"]
    ey: Float[Array, "*n"]


Half = tuple[Float[Array, "*n"], Float[Array, "*n"]]
"""Half a rectangle's sides [m]."""


def plan_margin(line: Line, half: Half) -> Float[Array, "*n"]:
    """How deep a sight line cuts a rectangle in plan [m]; negative by how far it misses.

    Separating axes of a segment and a rectangle: the rectangle's two, and the line's normal.
    """
    (x, y, ex, ey), (a, b) = line, half
    length = jnp.sqrt(jnp.maximum(ex * ex + ey * ey, 1e-12))
    support = a * jnp.abs(ey) + b * jnp.abs(ex)
    # A line without length, straight down, has no normal; the other two axes decide.
    beside = jnp.where(length < 1e-5, a + b, (support - jnp.abs(x * ey - y * ex)) / length)
    ahead = a + jnp.abs(ex) / 2 - jnp.abs(x + ex / 2)
    across = b + jnp.abs(ey) / 2 - jnp.abs(y + ey / 2)
    return jnp.minimum(beside, jnp.minimum(ahead, across))


class Cut(NamedTuple):
    """Where sight lines meet a prism in plan, made by :func:`plan_cut`.

    ``beside``: how deep they cut in sideways [m]; ``enters``, ``leaves``: t₀ and t₁ along them.
    """

    beside: Float[Array, "*n"]
    enters: Float[Array, "*n"]
    leaves: Float[Array, "*n"]


def plan_cut(line: Line, half: Half) -> Cut:
    """How sight lines cut a rectangle in plan.

    A line that misses has no t₀ and t₁: then they are held to its :func:`stretch`.
    """
    first, last = stretch(line, half)
    x_in, x_out = _slab(line.x, line.ex, half[0])
    y_in, y_out = _slab(line.y, line.ey, half[1])
    return Cut(
        plan_margin(line, half),
        jnp.clip(jnp.maximum(x_in, y_in), first, last),
        jnp.clip(jnp.minimum(x_out, y_out), first, last),
    )


def stretch(line: Line, half: Half) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """From where to where along sight lines a rectangle lies, beside them or on them, in t."""
    (x, y, ex, ey), (a, b) = line, half
    squared = jnp.maximum(ex * ex + ey * ey, 1e-9)
    middle, spread = -(x * ex + y * ey) / squared, (a * jnp.abs(ex) + b * jnp.abs(ey)) / squared
    return jnp.clip(middle - spread, 0.0, 1.0), jnp.clip(middle + spread, 0.0, 1.0)


def below_top(cut: Cut, rise: Float[Array, "*n"], drop: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """How far sight lines pass below a prism's top [m].

    ``rise`` is the top and ``drop`` the target seen from the sensor, upwards and downwards. The
    line z_s + t·(z − z_s) is lowest where it leaves the prism, at t₁, if it falls, and where it
    enters, at t₀, if it rises. Measured at the prism, in metres between line and top, this does not
    grow without bound as a prism comes near the sensor, as the height of its shadow does.
    """
    return rise + jnp.maximum(drop * cut.enters, drop * cut.leaves)


def _slab(
    start: Float[Array, "*n"], along: Float[Array, "*n"], half: Float[Array, "*n"]
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Where start + t·along enters and leaves −half … half; from far to far along the slab."""
    along = nonzero(along)
    middle, spread = -start / along, half / jnp.abs(along)
    return middle - spread, middle + spread


def solid_top(columns: Float[Array, "L 2"], prism: Prism) -> Float[Array, " L"]:
    """Top [m] of the highest prism that stands on each column; :data:`NEVER` where none does."""
    prism = jax.tree.map(lambda leaf: leaf[:, None], prism)  # (B, 1, …)
    tops = top_over(prism, columns[None, :, 0], columns[None, :, 1])
    return jnp.max(tops, axis=0, initial=NEVER)


def top_over(prism: Prism, x: Float[Array, "*n"], y: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Top [m] of a prism where it stands on a point in plan, else :data:`NEVER`."""
    dx, dy = x - prism.center[..., 0], y - prism.center[..., 1]
    cos, sin = jnp.cos(prism.yaw), jnp.sin(prism.yaw)
    x, y = jnp.abs(cos * dx + sin * dy), jnp.abs(cos * dy - sin * dx)
    margin = jnp.minimum(prism.half[..., 0] - x, prism.half[..., 1] - y)
    return jnp.where(prism.valid & (margin > 0), prism.top, NEVER)
