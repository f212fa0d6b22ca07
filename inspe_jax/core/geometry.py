"""Rotations, pictures, and the two tests of visibility: ray against cube, sight line against prism.

In plan the line from sensor s to column c is s + t·(c − s), 0 ≤ t ≤ 1. A prism whose rectangle it
cuts from t₀ to t₁ hides the column below the height at which the line touches its top: z* = z_s +
rise/t, with rise the top's height above the sensor, t = t₁ for a sensor above the top and t₀ for
one below. :func:`shadow_ceiling` works in u = 1/t, which is linear in the column, so a sight line
costs no division. It follows from :func:`inspe_jax.core.convex.sight_cut`.
"""

from typing import Any, NamedTuple, Protocol

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from inspe_jax.core.numerics import nonzero

NEVER = -1e9  # ceiling [m] of a prism that hides nothing: below every voxel, but finite
FAR = 1e9  # stands for infinity: large, but finite, so that 0 × FAR is 0

Point = tuple[Float[Array, "*n"], Float[Array, "*n"], Float[Array, "*n"]]
"""x, y and z of many points or directions, as three arrays."""


class Prism(NamedTuple):
    """Vertical prisms that stand on the ground: rectangles in plan, with a top. ``center`` x and y
    [m]; ``yaw`` [rad]; ``half`` of length and width [m]; ``top`` height [m]. Prisms that are not
    ``valid`` are padding."""

    center: Float[Array, "*b 2"]
    yaw: Float[Array, "*b"]
    half: Float[Array, "*b 2"]
    top: Float[Array, "*b"]
    valid: Bool[Array, "*b"]


def rotation(angles: Any, xp: Any = jnp) -> Any:
    """The rotation from the body frame to the world, Rz(yaw) Ry(−pitch) Rx(roll), as a (3, 3).

    ``angles`` (3,) are roll, pitch and yaw [rad]; pitch is positive nose-up. ``xp`` is jax.numpy,
    or numpy, which computes in double precision but cannot be traced.
    """
    (cr, cp, cy), (sr, sp, sy) = xp.cos(angles), xp.sin(angles)
    rows = [
        [cy * cp, -sy * cr - cy * sp * sr, sy * sr - cy * sp * cr],
        [sy * cp, cy * cr - sy * sp * sr, -cy * sr - sy * sp * cr],
        [sp, cp * sr, cp * cr],
    ]
    return xp.array(rows)


def pose_matrix(pose: Any) -> Float[np.ndarray, "4 4"]:
    """The matrix of a pose (6,) [m, rad]: from the body's frame to the world."""
    pose = np.asarray(pose, float)
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = rotation(pose[3:], np), pose[:3]
    return found


class Pinhole(Protocol):
    """A camera, such as an :class:`~inspe_jax.simulation.frame.Image` is of."""

    @property
    def pose(self) -> Float[np.ndarray, "6"]:
        """Its pose in the world."""

    @property
    def intrinsic(self) -> Float[np.ndarray, "3 3"]:
        """Its calibration matrix, in pixels."""


def pixels(image: Pinhole, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Points of the world in a picture: column and row in pixels from the outer corner of the
    first, and depth in metres: negative behind the camera, where column and row mean nothing."""
    pose = np.asarray(image.pose, float)
    body = (points - pose[:3]) @ rotation(pose[3:], np)
    seen = np.stack([-body[..., 1], -body[..., 2], body[..., 0]], -1) @ image.intrinsic.T
    return np.concatenate([seen[..., :2] / seen[..., 2:], seen[..., 2:]], -1)


def dot3(a: Point, b: Point) -> Float[Array, "*n"]:
    """Scalar product of vectors given by their components."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross_matrix(w: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """[w]×, the matrix whose product with a vector v is w × v."""
    zero = jnp.zeros_like(w[0])
    return jnp.array([[zero, -w[2], w[1]], [w[2], zero, -w[0]], [-w[1], w[0], zero]])


def ray_cube_margin(
    direction: Point, reach: float | Float[Array, ""], offset: Point, half: float | Float[Array, ""]
) -> Float[Array, "*n"]:
    """How deep a ray passes through a cube [m]; negative by how far it misses.

    The ray goes ``reach`` metres from 0 along the unit ``direction``. The cube is aligned with the
    axes, centred at ``offset``, with half edge ``half`` [m]. On each separating axis, the box's
    three and their cross products with the ray, the margin is the sum of the supports minus the
    offset: it stays in metres when the ray is parallel to a face.
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
    """What :func:`shadow_ceiling` needs of one sensor and a prism: ``cos`` and ``sin`` of the
    prism's yaw; in its frame, one over the distances [1/m] from the sensor to the planes of the
    front, back, left and right side; whether it is between front and back (``x_inside``), between
    left and right (``y_inside``); and the top's height above it [m]."""

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

    In the prism's frame, the line s + t·d, with d = c − s, crosses the slab −a ≤ x ≤ a at u = 1/t =
    d_x/(±a − s_x): linear in the column. A line parallel to a side, and an invalid prism, has u =
    0.
    """
    dx, dy = sensor[0] - prism.center[..., 0], sensor[1] - prism.center[..., 1]
    cos, sin = jnp.cos(prism.yaw), jnp.sin(prism.yaw)
    x, y = cos * dx + sin * dy, cos * dy - sin * dx
    a, b = prism.half[..., 0], prism.half[..., 1]
    on = prism.valid.astype(x.dtype)
    front, back = nonzero(a - x), nonzero(-a - x)
    left, right = nonzero(b - y), nonzero(-b - y)
    over = on / front, on / back, on / left, on / right
    # From the same numbers, so that a sensor in the plane of a side is on one side of it.
    inside = prism.valid & (front > 0) & (back < 0), prism.valid & (left > 0) & (right < 0)
    return ShadowTerms(cos, sin, *over, *inside, prism.top - sensor[2])


def shadow_ceiling(
    terms: ShadowTerms,
    dx: Float[Array, " L"],
    dy: Float[Array, " L"],
    sensor_z: Float[Array, ""],
    *,
    ignore_self_occlusion: bool | Bool[Array, "*b"] = False,
) -> Float[Array, " L"]:
    """Height [m] below which one prism hides each column; :data:`NEVER` where it does not.

    (dx, dy) is column minus sensor [m], ``sensor_z`` is z_s. Nothing is seen beneath a prism. With
    ``ignore_self_occlusion`` a prism does not hide the columns it stands on.
    """
    ex, ey = terms.cos * dx + terms.sin * dy, terms.cos * dy - terms.sin * dx
    x_exit, x_entry = _crossings(ex * terms.x_near, ex * terms.x_far, terms.x_inside)
    y_exit, y_entry = _crossings(ey * terms.y_near, ey * terms.y_far, terms.y_inside)
    # 1/t₁, less than 1 where the line ends inside, and 1/t₀.
    leaves, entry = jnp.maximum(x_exit, y_exit), jnp.minimum(x_entry, y_entry)
    exit_ = jnp.maximum(leaves, 1.0)
    meets = exit_ < entry
    if ignore_self_occlusion is not False:
        meets &= (leaves >= 1.0) | ~jnp.asarray(ignore_self_occlusion)
    ceiling = sensor_z + terms.rise * jnp.where(terms.rise < 0, exit_, entry)
    return jnp.where(meets, ceiling, NEVER)


def _crossings(
    u: Float[Array, " L"], v: Float[Array, " L"], inside: Bool[Array, ""]
) -> tuple[Float[Array, " L"], Float[Array, " L"]]:
    """(1/exit, 1/entry) of a slab; for a sensor inside it, entry is at t = 0 and 1/entry is FAR."""
    low, high = jnp.minimum(u, v), jnp.maximum(u, v)
    return jnp.where(inside, high, low), jnp.where(inside, FAR, high)


def top_over(prism: Prism, x: Float[Array, "*n"], y: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Top [m] of a prism at the points (x, y) that it stands on, else :data:`NEVER`."""
    dx, dy = x - prism.center[..., 0], y - prism.center[..., 1]
    cos, sin = jnp.cos(prism.yaw), jnp.sin(prism.yaw)
    x, y = jnp.abs(cos * dx + sin * dy), jnp.abs(cos * dy - sin * dx)
    margin = jnp.minimum(prism.half[..., 0] - x, prism.half[..., 1] - y)
    return jnp.where(prism.valid & (margin > 0), prism.top, NEVER)
