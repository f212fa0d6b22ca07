"""Rotations, and the two geometric tests of visibility: ray against cube, sight line against prism.

Ray against cube: :func:`ray_cube_margin`, the separation on the separating axes, in metres.

Sight line against prism: in plan the line from sensor s to column c is s + t·(c − s), 0 ≤ t ≤ 1. It
cuts the prism's rectangle from t₀ to t₁, or misses it. The prism hides the column below the height
at which the line touches its top: z* = z_s + rise/t, with rise the top's height above the sensor,
t = t₁ for a sensor above the top and t = t₀ for one below. This module has that cut in two forms,
which ``tests/core/test_geometry.py`` compares:

- :func:`shadow_ceiling`, for exact scores, works in u = 1/t (:func:`_plan_crossings`). Each u is
  linear in the column, so a sight line costs no division, and t₀ and t₁ are compared but never
  computed. It gives z* itself, :data:`NEVER` where the line misses.
- :func:`plan_cut` with :func:`below_top`, for soft scores, gives margins in metres: how deep the
  line cuts in sideways, also where it misses, and how far it passes below the top at t₀ or t₁.
  ``plan_cut(…).beside > 0`` exactly where the ceiling of a valid prism is not :data:`NEVER`.

They stay two: exact scores need the speed of the first, gradients need the metres of the second.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from inspe_jax.core.numerics import nonzero

NEVER = -1e9
"""Ceiling [m] of a prism that hides nothing: below every voxel, but finite."""
FAR = 1e9
"""Stands for infinity: large, but finite, so that 0 × FAR is 0."""

Point = tuple[Float[Array, "*n"], Float[Array, "*n"], Float[Array, "*n"]]
"""x, y and z of many points or directions, as three arrays."""


class Prism(NamedTuple):
    """Vertical prisms that stand on the ground: rectangles in plan, with a top.

    ``center`` x and y [m]; ``yaw`` [rad]; ``half`` of length and width [m]; ``top`` height [m].
    Prisms that are not ``valid`` are padding.
    """

    center: Float[Array, "*b 2"]
    yaw: Float[Array, "*b"]
    half: Float[Array, "*b 2"]
    top: Float[Array, "*b"]
    valid: Bool[Array, "*b"]


def rotation(angles: Any, xp: Any = jnp) -> Any:
    """The rotation from the body frame to the world, Rz(yaw) Ry(−pitch) Rx(roll), as a (3, 3).

    ``angles`` (3,) are roll, pitch and yaw [rad]. Pitch is positive nose-up. The body's y axis
    points left, so pitch is a rotation about −y. ``xp`` is the array module: jax.numpy, or numpy,
    which computes in double precision but cannot be traced.
    """
    (cr, cp, cy), (sr, sp, sy) = xp.cos(angles), xp.sin(angles)
    return xp.array(
        [
            [cy * cp, -sy * cr - cy * sp * sr, sy * sr - cy * sp * cr],
            [sy * cp, cy * cr - sy * sp * sr, -cy * sr - sy * sp * cr],
            [sp, cp * sr, cp * cr],
        ]
    )


def dot3(a: Point, b: Point) -> Float[Array, "*n"]:
    """Scalar product of vectors given by their components."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross_matrix(w: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """[w]×, the matrix whose product with a vector v is w × v."""
    zero = jnp.zeros_like(w[0])
    return jnp.array([[zero, -w[2], w[1]], [w[2], zero, -w[0]], [-w[1], w[0], zero]])


def ray_cube_margin(
    direction: Point,
    reach: float | Float[Array, ""],
    offset: Point,
    half: float | Float[Array, ""],
) -> Float[Array, "*n"]:
    """How deep a ray passes through a cube [m]; negative by how far it misses.

    The ray starts at 0 and goes ``reach`` metres along the unit ``direction``. The cube is aligned
    with the axes, centred at ``offset``, with half edge ``half`` [m]. The separating axes of a
    segment and a box are the box's three and the cross products of the ray with them. On each, the
    margin is the sum of the supports minus the offset, divided by the axis's length. Unlike slab
    parameters, it stays in metres when the ray is parallel to a face.
    """
    margin = jnp.full_like(direction[0], FAR)
    for k in range(3):
        along = reach / 2 * direction[k]  # half the segment, as a vector on axis k
        margin = jnp.minimum(margin, half + jnp.abs(along) - jnp.abs(offset[k] - along))
        a, b = direction[k - 1], direction[k - 2]
        length = jnp.sqrt(jnp.maximum(a * a + b * b, 1e-12))
        across = jnp.abs(offset[k - 2] * a - offset[k - 1] * b)
        support = half * (jnp.abs(a) + jnp.abs(b))
        # A ray along axis k has no cross product with it, and nothing is separated.
        margin = jnp.minimum(margin, jnp.where(length < 1e-5, half, (support - across) / length))
    return margin


class ShadowTerms(NamedTuple):
    """What :func:`shadow_ceiling` needs of one sensor and a prism, made by :func:`shadow_terms`.

    ``cos`` and ``sin`` of the prism's yaw. ``x_near`` and the next three are one over the distances
    [1/m] from the sensor to the planes of the front, back, left and right side, in the prism's
    frame. ``x_inside`` and ``y_inside``: the sensor is between front and back, between left and
    right. ``rise``: the top's height above the sensor [m].
    """

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
    """The terms of a sensor's sight lines against a prism, with the divisions done once for all.

    In the prism's frame, the sight line s + t·(c − s) crosses the slab −a ≤ x ≤ a at
    t = (±a − s_x)/d_x, with d = c − s. In u = 1/t that is d_x/(±a − s_x): linear in the column, and
    divided by a number that depends on sensor and prism only. A sight line parallel to a side has
    u = 0, t = ∞, and needs no special case. An invalid prism gets u = 0 throughout and hides
    nothing.
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
        # From the same numbers, so that a sensor in the plane of a side is on one side of it.
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

    (dx, dy) is column minus sensor [m], ``sensor_z`` is z_s. With h the top, and t₀ and t₁ the
    entry and exit in plan (t₁ clipped to 1): z* = z_s − (z_s − h)/t₁ for a sensor above the top,
    whose sight line is lowest where it leaves the prism; z* = z_s + (h − z_s)/t₀ for a sensor
    below, whose sight line is lowest where it enters. Nothing is seen beneath a prism. With
    ``ignore_self_occlusion`` a prism does not hide the columns it stands on. The soft form of the
    same cut is :func:`plan_cut`.
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
    """(1/t₁, 1/t₀) of each sight line, with t₁ not clipped: 1/t₁ < 1 where the line ends inside.

    The line misses where 1/t₁ ≥ 1/t₀ or 1/t₀ ≤ 1. :func:`plan_cut` has t₀ and t₁ themselves.
    """
    ex, ey = terms.cos * dx + terms.sin * dy, terms.cos * dy - terms.sin * dx
    x_exit, x_entry = _crossings(ex * terms.x_near, ex * terms.x_far, terms.x_inside)
    y_exit, y_entry = _crossings(ey * terms.y_near, ey * terms.y_far, terms.y_inside)
    return jnp.maximum(x_exit, y_exit), jnp.minimum(x_entry, y_entry)


def _crossings(
    u: Float[Array, " L"], v: Float[Array, " L"], inside: Bool[Array, ""]
) -> tuple[Float[Array, " L"], Float[Array, " L"]]:
    """(1/exit, 1/entry) of a slab; for a sensor inside it, entry is at t = 0 and 1/entry is FAR."""
    low, high = jnp.minimum(u, v), jnp.maximum(u, v)
    return jnp.where(inside, high, low), jnp.where(inside, FAR, high)


class Line(NamedTuple):
    """Sight lines in plan, in a rectangle's own frame: from (x, y) to (x + ex, y + ey) [m]."""

    x: Float[Array, "*n"]
    y: Float[Array, "*n"]
    ex: Float[Array, "*n"]
    ey: Float[Array, "*n"]


Half = tuple[Float[Array, "*n"], Float[Array, "*n"]]
"""Half of a rectangle's length and width [m]."""


def plan_margin(line: Line, half: Half) -> Float[Array, "*n"]:
    """How deep a sight line cuts into a rectangle in plan [m]; negative by how far it misses.

    The separating axes of a segment and a rectangle are the rectangle's two and the line's normal.
    """
    (x, y, ex, ey), (a, b) = line, half
    length = jnp.sqrt(jnp.maximum(ex * ex + ey * ey, 1e-12))
    support = a * jnp.abs(ey) + b * jnp.abs(ex)
    # A line straight down has no length in plan and no normal: the other two axes decide.
    beside = jnp.where(length < 1e-5, a + b, (support - jnp.abs(x * ey - y * ex)) / length)
    ahead = a + jnp.abs(ex) / 2 - jnp.abs(x + ex / 2)
    across = b + jnp.abs(ey) / 2 - jnp.abs(y + ey / 2)
    return jnp.minimum(beside, jnp.minimum(ahead, across))


class Cut(NamedTuple):
    """Where sight lines cut a prism in plan, made by :func:`plan_cut`.

    ``beside``: how deep a line cuts in sideways [m], negative where it misses. ``enters`` and
    ``leaves``: t₀ and t₁ along the line, from 0 at the sensor to 1 at the column.
    """

    beside: Float[Array, "*n"]
    enters: Float[Array, "*n"]
    leaves: Float[Array, "*n"]


def plan_cut(line: Line, half: Half) -> Cut:
    """How sight lines cut a rectangle in plan, in the rectangle's frame.

    t₀ and t₁ are clipped to the rectangle's :func:`stretch` along the line, because a line that
    misses has none of its own. The exact form of the same cut is :func:`shadow_ceiling`.
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
    """The first and last t at which a rectangle lies beside a sight line or on it, in 0 … 1.

    These are the projections of the rectangle's outermost corners onto the line.
    """
    (x, y, ex, ey), (a, b) = line, half
    squared = jnp.maximum(ex * ex + ey * ey, 1e-9)
    middle, spread = -(x * ex + y * ey) / squared, (a * jnp.abs(ex) + b * jnp.abs(ey)) / squared
    return jnp.clip(middle - spread, 0.0, 1.0), jnp.clip(middle + spread, 0.0, 1.0)


def below_top(cut: Cut, rise: Float[Array, "*n"], drop: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """How far sight lines pass below a prism's top [m]; negative where they pass above.

    ``rise`` is the top's height above the sensor, ``drop`` the target's depth below it [m]. The
    line z_s + t·(z − z_s) is lowest where it leaves the prism, at t₁, if it falls, and where it
    enters, at t₀, if it rises. The margin is measured at the prism, between line and top. So it
    stays bounded as a prism comes near the sensor, where the height of the shadow does not.
    """
    return rise + jnp.maximum(drop * cut.enters, drop * cut.leaves)


class SensorCut(NamedTuple):
    """How sight lines cut a prism in plan, as far as the sensor would have to move to change it.

    ``left`` and ``right``: how far the sensor has to move aside until the line passes the prism on
    its left or right side [m]; negative where it does, by how far the sensor has to move until it
    does not. ``ahead``: how far along the line the prism's far end is [m], negative behind the
    sensor.
    """

    left: Float[Array, "*n"]
    right: Float[Array, "*n"]
    ahead: Float[Array, "*n"]


_NO_LEVER = 0.02
"""Least part of a sight line that is left behind a prism. A shift of the sensor moves the line at
the prism by this part of it; nearer to the column it is taken to be so much."""


def lever(t: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """How far a sight line moves at t, from 0 at the sensor to 1 at the column, where the sensor
    moves by 1: 1 − t, and at least a little."""
    return jnp.maximum(1.0 - t, _NO_LEVER)


def sensor_cut(line: Line, half: Half) -> SensorCut:
    """How sight lines cut a rectangle in plan, in its own frame, as margins at the sensor.

    A line turns about the column where it ends. So to pass a corner at t along the line, the sensor
    has to move by the corner's distance from it over 1 − t; and to pass a side of the prism, by the
    most that a corner asks for. Corners beyond the column ask for nothing, unless the line enters
    the prism before it ends. The line meets the prism where all three margins are positive, as
    :func:`shadow_ceiling` has it.
    """
    (x, y, ex, ey), (a, b) = line, half
    squared = jnp.maximum(ex * ex + ey * ey, 1e-9)
    length = jnp.sqrt(squared)
    middle, aside = -(x * ex + y * ey), x * ey - y * ex
    enters = jnp.maximum(_slab(x, ex, a)[0], _slab(y, ey, b)[0]) < 1.0
    right, left = jnp.full_like(length, -FAR), jnp.full_like(length, -FAR)
    for k, m in ((1, 1), (1, -1), (-1, 1), (-1, -1)):  # the corner (k·a, m·b)
        t = (middle + (k * a * ex + m * b * ey)) / squared
        move = ((k * a * ey - m * b * ex) - aside) / (length * lever(jnp.maximum(t, 0.0)))
        asks = enters | (t < 1.0)
        right = jnp.where(asks, jnp.maximum(right, move), right)
        left = jnp.where(asks, jnp.maximum(left, -move), left)
    ahead = (middle + a * jnp.abs(ex) + b * jnp.abs(ey)) / length
    # A line straight down has no length in plan, and no sides: it is inside or not.
    point, within = squared < 1e-8, jnp.minimum(a - jnp.abs(x), b - jnp.abs(y))
    return SensorCut(*(jnp.where(point, within, margin) for margin in (left, right, ahead)))


def top_at_sensor(
    cut: Cut, rise: Float[Array, "*n"], drop: Float[Array, "*n"]
) -> Float[Array, "*n"]:
    """:func:`below_top` at the sensor: how far it has to rise for the line to touch the top [m]."""
    return below_top(cut, rise, drop) / lever(jnp.where(drop > 0, cut.leaves, cut.enters))


def _slab(
    start: Float[Array, "*n"], along: Float[Array, "*n"], half: Float[Array, "*n"]
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """The t at which start + t·along enters and leaves −half … half; far out if parallel to it."""
    along = nonzero(along)
    middle, spread = -start / along, half / jnp.abs(along)
    return middle - spread, middle + spread


def solid_top(columns: Float[Array, "L 2"], prism: Prism) -> Float[Array, " L"]:
    """Top [m] of the highest prism that stands on each column; :data:`NEVER` where none does."""
    prism = jax.tree.map(lambda leaf: leaf[:, None], prism)  # (B, 1, …)
    tops = top_over(prism, columns[None, :, 0], columns[None, :, 1])
    return jnp.max(tops, axis=0, initial=NEVER)


def top_over(prism: Prism, x: Float[Array, "*n"], y: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Top [m] of a prism at the points (x, y) that it stands on, else :data:`NEVER`."""
    dx, dy = x - prism.center[..., 0], y - prism.center[..., 1]
    cos, sin = jnp.cos(prism.yaw), jnp.sin(prism.yaw)
    x, y = jnp.abs(cos * dx + sin * dy), jnp.abs(cos * dy - sin * dx)
    margin = jnp.minimum(prism.half[..., 0] - x, prism.half[..., 1] - y)
    return jnp.where(prism.valid & (margin > 0), prism.top, NEVER)
