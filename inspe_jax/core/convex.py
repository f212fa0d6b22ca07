"""Sight line against upright prisms on convex outlines, and such outlines from triangles.

:func:`sight_cut` gives the margins [m] that soft scores read. :func:`convex_shadow`, for exact
scores, follows from it without a division for each sight line; of rectangles,
:func:`inspe_jax.core.geometry.shadow_ceiling` is the same and faster.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from inspe_jax.core.geometry import FAR, NEVER, Prism
from inspe_jax.core.numerics import nonzero

SEAM = 5e-5
"""Outlines count as wider by this [m], the rounding of single precision at 100 m: a line along the
seam of two pieces of a body meets both, and one that ends on a face meets what it bounds."""


class ConvexPrism(NamedTuple):
    """Upright prisms on convex outlines from ``bottom`` to ``top`` [m]. ``corners`` are
    counter-clockwise; ``normal`` and ``offset`` are those of the side from each corner to the next:
    n·p ≤ d inside. Corners and sides may be repeated. ``clear`` is the share of light that passes
    through. Prisms that are not ``valid`` are padding."""

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
    """Outward unit normals and offsets of the sides of convex outlines, in NumPy. A corner that is
    repeated has the side of the next one that is not."""
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
    """What :func:`convex_shadow` needs of one sensor and prisms: the normal (``x``, ``y``) of each
    side over the sensor's distance inside it [1/m], negative if the sensor is ``outside``; and the
    heights of top (``rise``) and bottom (``sink``) above the sensor [m]."""

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

    (dx, dy) is column minus sensor [m]. A side is crossed at u = 1/t, linear in the column: entered
    from outside, left from inside. Where the last entry does not come before the first exit and the
    column, the second height is :data:`~inspe_jax.core.geometry.NEVER`; else it is that of
    :func:`~inspe_jax.core.geometry.shadow_ceiling`. At the first the line touches the bottom.
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


def outlines(prism: Prism) -> ConvexPrism:
    """Rectangular prisms as convex ones, which they are."""
    cos, sin = jnp.cos(prism.yaw), jnp.sin(prism.yaw)
    along, across = jnp.stack([cos, sin], -1), jnp.stack([-sin, cos], -1)
    a, b = prism.half[..., :1] * along, prism.half[..., 1:] * across
    normal = jnp.stack([along, across, -along, -across], -2)
    from_center = (normal * prism.center[..., None, :]).sum(-1)
    return ConvexPrism(
        prism.center[..., None, :] + jnp.stack([a - b, a + b, b - a, -a - b], -2),
        normal,
        from_center + jnp.concatenate([prism.half, prism.half], -1),
        jnp.full_like(prism.top, -FAR),
        prism.top,
        jnp.zeros_like(prism.top),
        prism.valid,
    )


NO_LEVER = 0.02
"""Least part of a sight line that is left behind a prism. A shift of the sensor moves the line at
the prism by this part of it; nearer to the column it is taken to be so much."""


class SightCut(NamedTuple):
    """How sight lines cut a prism in plan, as far as the sensor would have to move to change it.

    ``left`` and ``right``: how far the sensor has to move aside until the line passes the prism on
    its left or right side [m]; negative where it does, by how far the sensor has to move until it
    does not. ``ahead``: how far from the sensor the line leaves the prism [m], negative behind the
    sensor. ``near`` and ``far``: the shares τ of the line from the column to where it leaves the
    prism, and to where it enters: 0 at the column, 1 at the sensor, and ``near`` is more behind it.
    ``depth``: how deep in the outline the column is [m], negative outside.

    ``of_left`` to ``of_far`` are derivatives where the sensor moves across the line, to the left as
    seen from the column. Where it moves along the line, those of the shares are −τ/L, and the
    others ``along_left`` to ``along_ahead``.
    """

    left: Float[Array, "*n"]
    right: Float[Array, "*n"]
    ahead: Float[Array, "*n"]
    near: Float[Array, "*n"]
    far: Float[Array, "*n"]
    depth: Float[Array, "*n"]
    of_left: Float[Array, "*n"]
    of_right: Float[Array, "*n"]
    along_left: Float[Array, "*n"]
    along_right: Float[Array, "*n"]
    of_ahead: Float[Array, "*n"]
    along_ahead: Float[Array, "*n"]
    of_near: Float[Array, "*n"]
    of_far: Float[Array, "*n"]


def sight_cut(
    prism: ConvexPrism,
    sx: Float[Array, ""],
    sy: Float[Array, ""],
    x: Float[Array, "*n"],
    y: Float[Array, "*n"],
) -> SightCut:
    """How sight lines from (sx, sy) to columns at (x, y) cut one convex outline in plan.

    A line turns about its column. To pass a corner at a share τ of the line from the column, the
    sensor has to move by the corner's distance from the line over τ; to pass a side of the prism,
    by the most that a corner asks for. Corners beyond the column ask for nothing, unless the line
    enters the prism before it ends. Where the line misses, ``near`` and ``far`` are at the corner
    that it passes.

    That move is L·tan φ, with φ the angle between the line and the corner. Its derivative along the
    line is tan φ, and across it 1 + tan² φ; where τ is kept at NO_LEVER, they are 0 and τ/NO_LEVER.
    """
    dx, dy = sx - x, sy - y
    squared = jnp.maximum(dx * dx + dy * dy, 1e-9)
    length = jnp.sqrt(squared)
    ux, uy = dx / length, dy / length
    depth, near, far, of_near, of_far = (jnp.full_like(dx, k) for k in (FAR, -FAR, FAR, 0.0, 0.0))
    enters = jnp.full(dx.shape, True)
    for k in range(len(prism.offset)):
        nx, ny = prism.normal[k, 0], prism.normal[k, 1]
        inside, along = prism.offset[k] - nx * x - ny * y, nx * ux + ny * uy
        at = inside / nonzero(along)
        turn = (nx * uy - ny * ux) * at / nonzero(along)
        nearer, farther = (along < 0) & (at > near), (along > 0) & (at < far)
        near, of_near = jnp.where(nearer, at, near), jnp.where(nearer, turn, of_near)
        far, of_far = jnp.where(farther, at, far), jnp.where(farther, turn, of_far)
        depth = jnp.where(inside < depth, inside, depth)
        enters &= (along <= 0) | (inside > -SEAM)
    # Made shares at the end: XLA computes the choice of a side again for all that follows from it,
    # but a quotient once.
    near, far, of_near, of_far = near / length, far / length, of_near / squared, of_far / squared
    left, right = jnp.full_like(dx, -FAR), jnp.full_like(dx, -FAR)
    at_left, at_right = jnp.zeros_like(dx), jnp.zeros_like(dx)
    for k in range(len(prism.offset)):
        cx, cy = prism.corners[k, 0] - x, prism.corners[k, 1] - y
        at, aside = cx * ux + cy * uy, cy * ux - cx * uy
        move = aside * length / jnp.maximum(at, NO_LEVER * length)
        asks = enters | (at > 0)
        wider, other = asks & (move > left), asks & (-move > right)
        left, at_left = jnp.where(wider, move, left), jnp.where(wider, at, at_left)
        right, at_right = jnp.where(other, -move, right), jnp.where(other, at, at_right)
    left, right, at_left, at_right = (a / length for a in (left, right, at_left, at_right))

    # A line straight down has no length in plan, and no sides: it is inside or not.
    straight = squared < 1e-8

    def side(tangent: Array, share: Array) -> tuple[Array, Array, Array]:
        """How far to move past a corner, and the derivatives across the line and along it."""
        move = jnp.where(straight, depth, tangent * length)
        tangent = jnp.where((share > NO_LEVER) & ~straight, tangent, 0.0)
        across = jnp.where(share > NO_LEVER, 1.0 + tangent * tangent, share / NO_LEVER)
        return move, across, tangent

    left, of_left, along_left = side(left, at_left)
    right, of_right, along_right = side(right, at_right)
    of_left = -of_left
    # The side that the line is nearer to passing, or passes.
    to_left = left < right
    pairs = (left, right), (of_left, of_right), (along_left, along_right), (at_left, at_right)
    margin, turns, grows, corner = (jnp.where(to_left, *pair) for pair in pairs)
    misses, passes = margin < 0, jnp.minimum(margin, 0.0)
    aside = jnp.where(to_left, passes, -passes) * jnp.where(corner > NO_LEVER, corner, NO_LEVER)

    def kept(at: Array, turn: Array, most: float) -> tuple[Array, Array]:
        """τ of a crossing on the line and its derivative across; of the corner if it misses."""
        at, turn = jnp.where(misses, corner, at), jnp.where(misses, aside / squared, turn)
        return jnp.clip(at, 0.0, most), jnp.where((at > 0) & (at < most), turn, 0.0)

    (near, of_near), (far, of_far) = kept(near, of_near, FAR), kept(far, of_far, 1.0)
    # Of a line that misses, the line that passes the corner counts, from where the sensor is then.
    whole = jnp.sqrt(squared + passes * passes)
    ahead = jnp.where(straight, depth, (1.0 - near) * whole)
    of_ahead = (1.0 - near) * turns * passes / whole - whole * of_near
    along_ahead = (1.0 - near) * (length + grows * passes) / whole + whole * near / length
    inside = depth > 0  # the column: then the prism is ahead from everywhere
    ahead = jnp.where(inside, FAR, ahead)
    of_ahead, along_ahead = (jnp.where(inside, 0.0, by) for by in (of_ahead, along_ahead))
    sides = of_left, of_right, along_left, along_right, of_ahead, along_ahead
    return SightCut(left, right, ahead, near, far, depth, *sides, of_near, of_far)


# ── Outlines in plan, in NumPy ──────────────────────────────────────────────

LEAST_AREA = 0.05  # pieces of ground smaller than this are left out [m²]

Corner = tuple[float, float]


def merge(
    triangles: Float[np.ndarray, "N 3 2"], least: float = LEAST_AREA
) -> list[Float[np.ndarray, "M 2"]]:
    """Convex outlines, counter-clockwise, that together cover the triangles exactly, but for pieces
    of less than ``least`` [m²]. Neighbours are joined over their longest sides first, as long as
    the union is convex: at most four times as many as possible (Hertel and Mehlhorn, 1983)."""
    pieces: dict[int, list[Corner]] = {}
    owner: dict[tuple[Corner, Corner], int] = {}
    for k, triangle in enumerate(np.asarray(triangles, float)):
        a, b, c = (tuple(corner) for corner in triangle.tolist())
        outline = [a, b, c] if _cross(a, b, c) > 0 else [a, c, b]
        pieces[k] = outline
        owner.update(dict.fromkeys(_sides(outline), k))
    shared = [side for side in owner if side < side[::-1] and side[::-1] in owner]
    for a, b in sorted(shared, key=lambda s: -np.hypot(s[0][0] - s[1][0], s[0][1] - s[1][1])):
        here, there = owner[a, b], owner[b, a]
        ours, theirs = _from(pieces[here], b), _from(pieces[there], a)
        # ours runs b … a, theirs a … b.
        joined = [*ours, *theirs[1:-1]]
        bends = _cross(ours[-2], a, theirs[1]), _cross(theirs[-2], b, ours[1])
        once = sum(owner.get(side[::-1]) == there for side in _sides(pieces[here])) == 1
        if here == there or not once or min(bends) < 0:
            continue
        pieces[here] = joined
        owner.update(dict.fromkeys(_sides(pieces.pop(there)), here))
        del owner[a, b], owner[b, a]
    found = [np.array(outline) for outline in pieces.values()]
    return [outline for outline in found if _area(outline) >= least]


def _sides(outline: list[Corner]) -> list[tuple[Corner, Corner]]:
    return list(zip(outline, outline[1:] + outline[:1], strict=True))


def _from(outline: list[Corner], first: Corner) -> list[Corner]:
    k = outline.index(first)
    return outline[k:] + outline[:k]


def _cross(a: Corner, b: Corner, c: Corner) -> float:
    """Twice the area of a triangle, positive if it turns left at b."""
    return (b[0] - a[0]) * (c[1] - b[1]) - (b[1] - a[1]) * (c[0] - b[0])


def _area(outline: np.ndarray) -> float:
    x, y = (outline - outline[0]).T
    return float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()) / 2
