"""Sight line against an upright prism on any convex outline, which may begin above the ground.

The general form of :mod:`inspe_jax.core.geometry`, which is for rectangles, and as there it has two
forms, which ``tests/core/test_convex.py`` compares:

- :func:`convex_shadow`, for exact scores: the heights between which a prism hides a column, in
  u = 1/t, without a division for each sight line.
- :func:`prism_margins`, for soft scores, three margins in metres: how deep the line cuts in
  sideways, how far it passes below the top, and how far above the bottom. The line meets the prism
  exactly where all three are positive.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from inspe_jax.core.geometry import FAR, NEVER, Cut, Line, below_top
from inspe_jax.core.numerics import nonzero

SEAM = 5e-5
"""Outlines count as wider by this [m], the rounding of single precision at 100 m: a line along the
seam of two pieces of a body meets both."""


class ConvexPrism(NamedTuple):
    """Upright prisms on convex outlines, in metres.

    ``corners`` are counter-clockwise; ``normal`` and ``offset`` are those of the side from each
    corner to the next: n·p ≤ d inside. Corners and sides may be repeated, as padding is. The prism
    reaches from ``bottom`` to ``top``. ``clear`` is the share of light that passes through it.
    Prisms that are not ``valid`` are padding.
    """

    corners: Float[Array, "*b K 2"]
    normal: Float[Array, "*b K 2"]
    offset: Float[Array, "*b K"]
    bottom: Float[Array, "*b"]
    top: Float[Array, "*b"]
    clear: Float[Array, "*b"]
    valid: Bool[Array, "*b"]


def sides(
    corners: Float[np.ndarray, "P K 2"],
) -> tuple[Float[np.ndarray, "P K 2"], Float[np.ndarray, "P K"]]:
    """Outward unit normals and offsets of the sides of convex outlines, in NumPy.

    A corner that is repeated has the side of the next one that is not.
    """
    step = np.roll(corners, -1, 1) - corners
    length = np.hypot(step[..., 0], step[..., 1])
    # From the last corner back, each side of no length takes the one after it.
    for k in reversed(range(2 * corners.shape[1])):
        k %= corners.shape[1]
        none, after = length[:, k] == 0, (k + 1) % corners.shape[1]
        step[none, k], length[none, k] = step[none, after], length[none, after]
    normal = np.stack([step[..., 1], -step[..., 0]], -1) / np.maximum(length, 1e-12)[..., None]
    return normal, np.einsum("pkd,pkd->pk", normal, corners)


class ConvexTerms(NamedTuple):
    """What :func:`convex_shadow` needs of one sensor and prisms, made by :func:`convex_terms`.

    ``x`` and ``y`` are the normal of each side over the sensor's distance inside it [1/m], negative
    if the sensor is outside (``outside``). ``rise`` and ``sink`` are the heights of top and bottom
    above the sensor [m].
    """

    x: Float[Array, "*b K"]
    y: Float[Array, "*b K"]
    outside: Bool[Array, "*b K"]
    rise: Float[Array, "*b"]
    sink: Float[Array, "*b"]


def convex_terms(sensor: Float[Array, "3"], prism: ConvexPrism) -> ConvexTerms:
    """The terms of a sensor's sight lines against prisms, with the divisions done once for all."""
    x, y = prism.normal[..., 0], prism.normal[..., 1]
    inside = nonzero(prism.offset + SEAM - x * sensor[0] - y * sensor[1])
    return ConvexTerms(
        x / inside, y / inside, inside < 0, prism.top - sensor[2], prism.bottom - sensor[2]
    )


def convex_shadow(
    terms: ConvexTerms, dx: Float[Array, " C"], dy: Float[Array, " C"], sensor_z: Float[Array, ""]
) -> tuple[Float[Array, "B C"], Float[Array, "B C"]]:
    """Heights [m] between which B prisms hide each column: from the first up to the second.

    (dx, dy) is column minus sensor [m]. Along the line, a side is crossed at t = 1/u, with u linear
    in the column: from outside it is an entry, from inside an exit. The prism is met where the last
    entry comes before the first exit, and before the column; else the second height is
    :data:`~inspe_jax.core.geometry.NEVER`. It is that of
    :func:`~inspe_jax.core.geometry.shadow_ceiling`. The first is the height at which the line
    touches the bottom, where it is highest in the prism.
    """
    terms = jax.tree.map(lambda leaf: leaf[..., None], terms)  # (B, K, 1), (B, 1)
    dx, dy = dx[None], dy[None]
    entry, exit_ = jnp.full_like(dx, FAR), jnp.ones_like(dx)
    for k in range(terms.x.shape[1]):
        u = terms.x[:, k] * dx + terms.y[:, k] * dy
        outside = terms.outside[:, k]
        entry = jnp.minimum(entry, jnp.where(outside, u, FAR))
        exit_ = jnp.maximum(exit_, jnp.where(outside, 1.0, u))
    ceiling = sensor_z + terms.rise * jnp.where(terms.rise < 0, exit_, entry)
    floor = sensor_z + terms.sink * jnp.where(terms.sink > 0, exit_, entry)
    return floor, jnp.where(exit_ < entry, ceiling, NEVER)


def convex_cut(prism: ConvexPrism, line: Line) -> Cut:
    """How sight lines cut one convex outline in plan; the line starts at (x, y) in the same frame.

    ``beside`` is the least overlap on the separating axes of a segment and a convex outline: the
    normals of its sides and that of the line. t₀ and t₁ are clipped to the outline's stretch along
    the line, as in :func:`~inspe_jax.core.geometry.plan_cut`.
    """
    x, y, ex, ey = line
    squared = ex * ex + ey * ey
    length = jnp.sqrt(jnp.maximum(squared, 1e-12))
    inner = jnp.full_like(ex, FAR)
    enters, leaves = jnp.zeros_like(ex), jnp.ones_like(ex)
    left, right = jnp.full_like(ex, -FAR), jnp.full_like(ex, -FAR)
    first, last = jnp.full_like(ex, FAR), jnp.full_like(ex, -FAR)
    for k in range(prism.offset.shape[-1]):
        nx, ny = prism.normal[k, 0], prism.normal[k, 1]
        start, along = nx * x + ny * y - prism.offset[k], nx * ex + ny * ey
        inner = jnp.minimum(inner, -jnp.minimum(start, start + along))
        t = -start / nonzero(along)
        enters = jnp.where(along < 0, jnp.maximum(enters, t), enters)
        leaves = jnp.where(along < 0, leaves, jnp.minimum(leaves, t))
        cx, cy = prism.corners[k, 0] - x, prism.corners[k, 1] - y
        across = (ex * cy - ey * cx) / length
        left, right = jnp.maximum(left, across), jnp.maximum(right, -across)
        t = (cx * ex + cy * ey) / jnp.maximum(squared, 1e-9)
        first, last = jnp.minimum(first, t), jnp.maximum(last, t)
    # A line straight down has no length in plan and no normal: the sides decide, for all of it.
    straight = squared < 1e-9
    beside = jnp.where(straight, FAR, jnp.minimum(left, right))
    first = jnp.where(straight, 0.0, jnp.clip(first, 0.0, 1.0))
    last = jnp.where(straight, 1.0, jnp.clip(last, 0.0, 1.0))
    return Cut(
        jnp.minimum(beside, inner) + SEAM,
        jnp.clip(enters, first, last),
        jnp.clip(leaves, first, last),
    )


def above_bottom(
    cut: Cut, sink: Float[Array, "*n"], drop: Float[Array, "*n"]
) -> Float[Array, "*n"]:
    """How far sight lines pass above a prism's bottom [m]; negative where they pass beneath.

    ``sink`` is the bottom's depth below the sensor, ``drop`` the target's [m]. As
    :func:`~inspe_jax.core.geometry.below_top`, at the highest point of the line in the prism.
    """
    return sink - jnp.minimum(drop * cut.enters, drop * cut.leaves)


def prism_margins(
    prism: ConvexPrism,
    sensor: Float[Array, "3"],
    columns: Float[Array, "2 C"],
    heights: Float[Array, "Z C"],
) -> tuple[Float[Array, " C"], Float[Array, "Z C"], Float[Array, "Z C"]]:
    """The margins [m] of sight lines to columns of voxels: sideways, below the top, above the
    bottom of one prism."""
    x, y, z = sensor
    line = Line(x, y, columns[0] - x, columns[1] - y)
    beside, enters, leaves = convex_cut(prism, line)
    cut, drop = Cut(beside, enters[None], leaves[None]), z - heights  # (Z, C)
    below = below_top(cut, prism.top - z, drop)
    return beside, below, above_bottom(cut, z - prism.bottom, drop)
