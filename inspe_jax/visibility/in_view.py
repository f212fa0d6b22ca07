"""In view: does a ray of the sensor pass through the voxel? Traffic does not matter."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from inspe_jax.core.geometry import Point, ray_cube_margin, rotation
from inspe_jax.core.numerics import REACH, Softness, step
from inspe_jax.sensing.rays import Kind, Rays, RayTable
from inspe_jax.sensing.sensors import RayGrid
from inspe_jax.visibility.tiles import Tile

Scalar = float | Float[Array, ""]
"""A length [m], traced or not."""

TOUCH = 2e-5
"""A ray this near to a voxel touches it [m]: the rounding of single precision at 100 m."""


SLACK = 2e-4
"""Where a few rays tell for sure, they tell by this much [m], ten times the rounding at 100 m."""

TOGETHER = 2**20
"""Sensors × voxels whose margins are found together: XLA's loops are slower than its arrays, and
all at once would not fit in memory."""

INSIDE = 1e-3
"""A voxel that a ray meets is in the field of view, by at least this much [m]."""

DEEP = 0.7
"""Where rays are dense, voxels are this share of half an edge deep in one at least; no margin
counts as deeper, since which of the rays is deepest changes with every move and means nothing."""


def in_view_margins(
    grid: RayGrid, poses: Float[Array, "S 6"], centers: Float[Array, "V 3"], half: float
) -> tuple[Float[Array, "S V"], Float[Array, "S V"]]:
    """How deep each voxel lies in each sensor's field of view, and how deep its best ray goes [m].

    Coverage's f(V_i) = 1 if some ray passes through the voxel, the other way
    round: for each voxel the six rays are found that can pass through it if any
    does (:func:`_candidates`), and the best margin is kept. A voxel is in view where both margins
    are positive. The first is that of the field of view, from its edge and its reach; the second
    that of the rays, as if a voxel outside had been moved to the edge: so read softly the first
    draws the field over voxels far outside it, and the second, which is no larger than a voxel,
    tells rows apart. ``half`` is half a voxel's edge [m]. Voxels are closed: a ray along a face
    they share passes through both, which :data:`TOUCH` makes sure of in single precision.
    """
    return _in_view_margins(grid.rays, poses, centers, half)


@jax.jit
def _in_view_margins(
    rays: Rays, poses: Float[Array, "S 6"], centers: Float[Array, "V 3"], half: float
) -> tuple[Float[Array, "S V"], Float[Array, "S V"]]:
    margins = jax.vmap(partial(_margins, rays, half), in_axes=(0, None))
    stances = jax.vmap(stance_at)(poses)
    parts = -(-len(poses) * len(centers) // TOGETHER)
    size = -(-len(centers) // parts)
    padded = jnp.pad(centers, ((0, parts * size - len(centers)), (0, 0))).reshape(parts, size, 3)
    found = jax.lax.map(lambda part: margins(stances, part), padded)  # (parts, S, size) each
    field, ray = (x.swapaxes(0, 1).reshape(len(poses), -1)[:, : len(centers)] for x in found)
    return field, ray


class Stance(NamedTuple):
    """Where a sensor is, and how it is turned from its body to the world: a pose, ready for use."""

    position: Float[Array, "3"]
    turn: Float[Array, "3 3"]


def stance_at(pose: Float[Array, "6"]) -> Stance:
    """The stance of a pose (x, y, z [m], roll, pitch, yaw [rad])."""
    return Stance(pose[:3], rotation(pose[3:]))


def _to_voxels(stance: Stance, centers: Float[Array, "V 3"]) -> Point:
    """From the sensor to each voxel, world axes."""
    r = centers - stance.position[None]  # (V, 3)
    return r[:, 0], r[:, 1], r[:, 2]


@jax.checkpoint
def _field_margin(
    rays: Rays, half: Scalar, stance: Stance, centers: Float[Array, "V 3"]
) -> Float[Array, " V"]:
    return rays.field_margin(to_body(stance.turn, _to_voxels(stance, centers))) + half


def _margins(
    rays: Rays, half: Scalar, stance: Stance, centers: Float[Array, "V 3"]
) -> tuple[Float[Array, " V"], Float[Array, " V"]]:
    """:func:`in_view_margins` of one sensor.

    Where a ray meets a voxel by a corner or by rounding, the field's margin is not below 0 either.
    """
    ray = jnp.minimum(_best_margin(rays, half, stance, centers), DEEP * half)
    field = _field_margin(rays, half, stance, centers)
    field = jnp.where(ray > 0, jnp.maximum(field, INSIDE), field)
    return field, ray - jnp.minimum(field, 0.0)


def to_body(turn: Float[Array, "3 3"], offset: Point) -> Point:
    """World axes to the body's."""
    a, b, c = offset
    x, y, z = (turn[0, m] * a + turn[1, m] * b + turn[2, m] * c for m in range(3))
    return x, y, z


@jax.custom_jvp
def _best_margin(
    rays: Rays, half: Scalar, stance: Stance, centers: Float[Array, "V 3"]
) -> Float[Array, " V"]:
    return best_ray(rays, half, stance, centers)[0]


@_best_margin.defjvp
def _best_margin_jvp(primals, tangents):  # type: ignore[no-untyped-def]
    """A maximum is an envelope: its derivative is that of the ray that won."""
    # The rays are bought as they are, and the voxels stand still.
    (rays, half, stance, centers), (_, _, d_stance, _) = primals, tangents
    margin, row, column = best_ray(rays, half, stance, centers)

    @jax.checkpoint  # kept, the intermediates would be 30 numbers a voxel; the winner is two
    def won(stance):  # type: ignore[no-untyped-def]
        return _ray_margin(rays, half, stance, centers, row, column)

    return margin, jax.jvp(won, (stance,), (d_stance,))[1]


def best_ray(
    rays: Rays, half: Scalar, stance: Stance, centers: Float[Array, "V 3"]
) -> tuple[Float[Array, " V"], Float[Array, " V"], Float[Array, " V"]]:
    """(margin, row, column) of the ray that passes deepest through each voxel."""
    of_row = _candidates(rays, stance.turn, _to_voxels(stance, centers), half)

    def look(neighbour: Array, best: tuple[Array, ...]) -> tuple[Array, ...]:
        row, *columns = of_row(neighbour - 1)
        for column in columns:
            margin = _ray_margin(rays, half, stance, centers, row, column)
            won = margin > best[0]
            found = margin, row, column
            best = tuple(jnp.where(won, new, old) for new, old in zip(found, best, strict=True))
        return best

    # A loop: one after the other, they would be compiled three times.
    nothing = jnp.full(len(centers), -jnp.inf, centers.dtype)
    zero = jnp.zeros_like(nothing)
    best, row, column = jax.lax.fori_loop(0, 3, look, (nothing, zero, zero))
    return best, row, column


def _ray_margin(
    rays: Rays,
    half: Scalar,
    stance: Stance,
    centers: Float[Array, "V 3"],
    row: Float[Array, "*k V"],
    column: Float[Array, "*k V"],
) -> Float[Array, "*k V"]:
    turn, d = stance.turn, rays.direction(row, column)
    world = tuple(sum(turn[k, m] * d[m] for m in range(3)) for k in range(3))
    offset = tuple(x.reshape((1,) * (row.ndim - 1) + x.shape) for x in _to_voxels(stance, centers))
    return ray_cube_margin(world, rays.table.reach, offset, half + TOUCH)  # type: ignore[arg-type]


def _candidates(
    rays: Rays, turn: Float[Array, "3 3"], offset: Point, half: Scalar
) -> Callable[[Array], tuple[Array, Array, Array]]:
    """Row and columns of the rays that can pass through each voxel, if any does.

    By the number of the row: −1, 0, 1 from the one below the nearest to the one above.

    The rays nearest to the voxel's centre are not enough: where rows lie
    further apart than columns, a row may clip one corner of the cube, many
    columns away from the centre. So walk from the centre to the point of the cube that
    lies furthest towards the row; the point p where that chord meets the row is in
    the cube. A row crosses a cube in one interval, so if it holds any ray, it
    holds the one just before or just after p. Rows: the nearest one and its two
    neighbours; if a cube reaches further rows than these, it is large against
    their spacing and the nearest row crosses its middle. Before that, the aim is
    moved from the centre into the reach and between the edge columns, where the
    cube is partly beyond them. At the edge of the grid the nearest ray is the
    edge ray.
    """
    q = to_body(turn, offset)

    def corner(q: Point, normal: Point, outward: Float[Array, "*n"]) -> Point:
        """The corner of the cube furthest along ``normal``, or against it where outward < 0."""
        x, y, z = q
        for k in range(3):
            side = sum(turn[k, m] * normal[m] for m in range(3)) * outward
            side = jnp.where(side < 0, -half, half)
            x, y, z = x + side * turn[k, 0], y + side * turn[k, 1], z + side * turn[k, 2]
        return x, y, z

    def extreme(normal: Point, outward: float) -> Point:
        """The corner, or the middle of an edge, whose row is highest (outward = 1) or lowest.

        The corner furthest along the normal at the aim, and from there along the
        normal at that corner: near the sensor the two differ, and the best may lie
        between them.
        """
        sign = jnp.full_like(q[0], outward)
        one = corner(q, normal, sign)
        two = corner(q, rays.row_normal(one), sign)
        middle = _between(one, two, jnp.full_like(q[0], 0.5))
        best, value = one, rays.row(one) * outward
        for point in (two, middle):
            other = rays.row(point) * outward
            best = tuple(jnp.where(other > value, a, b) for a, b in zip(point, best, strict=True))  # type: ignore[assignment]
            value = jnp.maximum(value, other)
        return best

    aim = _within_reach(rays, q, corner)
    if not rays.wraps:
        for edge, outward in enumerate((1.0, -1.0)):
            # Left of the first column's plane is inside, right of the last one's; but a field
            # of view of more than half a turn reaches behind those planes.
            outside = (rays.column(aim) - rays.table.column_edges[edge]) * outward < 0
            beyond = jnp.where(outside, jnp.minimum(rays.beyond_edge(aim, edge) * outward, 0), 0)
            inner = corner(q, rays.column_normal(aim), jnp.full_like(beyond, outward))
            gain = rays.beyond_edge(inner, edge) * outward - beyond
            aim = _between(aim, inner, jnp.where(gain > 0, -beyond / jnp.maximum(gain, 1e-9), 1.0))

    here = rays.row(aim)
    normal = rays.row_normal(aim)
    above, below = extreme(normal, 1.0), extreme(normal, -1.0)
    nearest = rays.nearest_row(here)

    def of_row(neighbour: Array) -> tuple[Array, Array, Array]:
        """The row so many rows above the nearest one, and its two columns."""
        row = rays.row_at(jnp.clip(nearest + neighbour, 0, rays.table.row_count - 1))
        up = row > here
        far = tuple(jnp.where(up, a, b) for a, b in zip(above, below, strict=True))
        start, end = rays.beyond_row(aim, row), rays.beyond_row(far, row)  # type: ignore[arg-type]
        crossing = start / jnp.where(jnp.abs(start - end) < 1e-9, 1e-9, start - end)
        p = _between(aim, far, crossing)  # type: ignore[arg-type]
        before = rays.column_index(rays.column(p))
        return row, rays.column_at(before), rays.column_at(before + 1)

    return of_row


def _within_reach(rays: Rays, q: Point, corner) -> Point:  # type: ignore[no-untyped-def]
    """The centre; or, beyond the reach, the middle of what is within it towards the near corner."""
    near = corner(q, q, -jnp.ones_like(q[0]))
    far_range, near_range = (
        jnp.sqrt(jnp.maximum(x * x + y * y + z * z, 1e-12)) for x, y, z in (q, near)
    )
    beyond = jnp.maximum(far_range - rays.table.reach, 0.0)
    meets = beyond / jnp.maximum(far_range - near_range, 1e-9)
    return _between(q, near, jnp.where(beyond > 0, (1 + meets) / 2, 0.0))


def _between(a: Point, b: Point, t: Float[Array, " V"]) -> Point:
    """a + t·(b − a), t held between 0 and 1."""
    t = jnp.clip(t, 0.0, 1.0)
    return a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1]), a[2] + t * (b[2] - a[2])


def view_margins(
    poses: Float[Array, "S 6"],
    centers: Float[Array, "V 3"],
    groups: tuple[tuple[RayGrid, tuple[int, ...]], ...],
    half: float,
) -> tuple[Float[Array, "S V"], Float[Array, "S V"]]:
    """:func:`in_view_margins` of all sensors; ``groups`` says which share a grid of rays."""
    margins = [in_view_margins(grid, poses[jnp.array(s)], centers, half) for grid, s in groups]
    field, ray = (in_order(part, groups) for part in zip(*margins, strict=True))
    return field, ray


def in_order(found: Sequence[Array], groups: tuple[tuple[RayGrid, tuple[int, ...]], ...]) -> Array:
    """What was found of one group of sensors after the other, (s, ...) each, in their order."""
    order = np.concatenate([index for _, index in groups])
    whole = jnp.concatenate(found)
    return whole if (order[1:] > order[:-1]).all() else whole[np.argsort(order)]


def soft_view(
    kinds: tuple[Kind, ...],
    kind: Int[Array, ""],
    table: RayTable,
    half: Scalar,
    softness: Softness,
    pose: Float[Array, "6"],
    tile: Tile,
) -> Float[Array, "Z C"]:
    """How surely one sensor has each voxel of a tile in view: both margins, read softly.

    ``kind`` is the number of the sensor's kind; beyond the last one there is no sensor, and
    nothing is in view.
    """
    levels, columns = tile.heights.shape

    def look(kind: Kind, table: RayTable, pose: Array) -> Array:
        stance = stance_at(pose)
        xy = jnp.broadcast_to(tile.columns.T, (levels, columns, 2))
        centers = jnp.concatenate([xy, tile.heights[:, :, None]], -1).reshape(-1, 3)
        field, ray = _margins(kind.rays(table), half, stance, centers)
        f = step(field, softness.field) * step(ray, softness.ray)
        z = jnp.arange(levels, dtype=tile.there.dtype)[:, None]
        return f.reshape(levels, columns) * ((tile.there[None] >> z) & 1).astype(f.dtype)

    def nothing(table: RayTable, pose: Array) -> Array:
        return jnp.zeros((levels, columns))

    wide = half + (0.0 if softness.field is None else REACH * softness.field)
    stance = stance_at(jax.lax.stop_gradient(pose))
    by_kind = jnp.stack([touches(each.rays(table), wide, stance, tile) for each in kinds])
    touched = (by_kind & (kind == np.arange(len(kinds), dtype=np.int32))).any()
    branches: list[Any] = [*(partial(look, each) for each in kinds), nothing]
    return jax.lax.switch(jnp.where(touched, kind, len(kinds)), branches, table, pose)


def touches(rays: Rays, half: Scalar, stance: Stance, tile: Tile) -> Bool[Array, ""]:
    """Whether a tile's voxels may lie in the field of view: the ball about them does."""
    middle = (tile.low + tile.high) / 2
    radius = jnp.hypot(tile.radius, middle - tile.low) + 3.0**0.5 * half + SLACK
    x, y, z = stance.position
    offset = tile.center[0] - x, tile.center[1] - y, middle - z
    return rays.field_margin(to_body(stance.turn, offset)) > -radius
