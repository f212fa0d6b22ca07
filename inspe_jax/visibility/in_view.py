"""In view: does some ray of the sensor pass through the voxel? Traffic does not matter."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from inspe_jax.core.geometry import Point, cross_matrix, ray_cube_margin, rotation
from inspe_jax.core.numerics import Softness, Width, certain_beyond, step
from inspe_jax.sensing.lens_rays import DistortedRays
from inspe_jax.sensing.rays import Kind, Rays, RayTable
from inspe_jax.visibility.ray_density import in_view_chance
from inspe_jax.visibility.tiles import Tile

Scalar = float | Float[Array, ""]
"""A length [m], traced or not."""

TOUCH = 2e-5
"""A ray this near to a voxel touches it [m]: the rounding of single precision at 100 m."""

SLACK = 2e-4
"""Tests without the six rays decide by at least this margin [m]: ten times that rounding."""

INSIDE = 1e-3
"""A voxel that a ray meets is in the field of view by at least this margin [m]."""

DEEP = 0.7
"""Ray margins are cut off at this fraction of half a voxel's edge. Where rays are dense, every
voxel has a ray at least as deep, and which is the deepest changes with every move."""


class RigidTransform(NamedTuple):
    """A sensor's ``position``, and the rotation ``to_world`` from body axes to world axes. ``lens``
    is the logarithm of how many times its usual focal length a camera has; None if as usual."""

    position: Float[Array, "3"]
    to_world: Float[Array, "3 3"]
    lens: Float[Array, ""] | None = None

    def through(self, rays: Rays) -> Rays:
        """A sensor's usual rays, through the lens."""
        return rays if self.lens is None else rays.zoomed(jnp.exp(self.lens))


def transform_of(pose: Float[Array, "*p"]) -> RigidTransform:
    """The transform of a pose (x, y, z [m], roll, pitch, yaw [rad]), and of a lens behind these."""
    return RigidTransform(pose[:3], rotation(pose[3:6]), *pose[6:])


def _to_voxels(transform: RigidTransform, centers: Float[Array, "V 3"]) -> Point:
    r = centers - transform.position[None]  # (V, 3)
    return r[:, 0], r[:, 1], r[:, 2]


@jax.checkpoint
def _field_margin(
    rays: Rays, half: Scalar, transform: RigidTransform, centers: Float[Array, "V 3"]
) -> Float[Array, " V"]:
    rays, q = transform.through(rays), to_body(transform.to_world, _to_voxels(transform, centers))
    return rays.field_margin(q, rays.table.edges) + half


def in_view_margins(
    rays: Rays, half: Scalar, transform: RigidTransform, centers: Float[Array, "V 3"]
) -> tuple[Float[Array, " V"], Float[Array, " V"]]:
    """Two margins [m] of each voxel: in a sensor's field of view, and against its best ray.

    A voxel is in view, f(V_i) = 1, where both margins are positive. The paper walks every ray; here
    six rays are found for each voxel (:func:`_candidates`), and the best margin is taken. If any
    ray passes through the voxel, one of the six does, except for a few voxels in very wide cameras
    and on rows with a steep elevation.

    The first margin is the depth in the field of view, from its edges and the end of its reach;
    where a ray just meets a voxel, by a corner or by rounding, it is made positive. The second is
    that of the best ray; a voxel outside the field is first moved to the edge. Read softly, the
    first has a slope also for voxels far outside the field. The second is no larger than a voxel
    and tells apart voxels on rows from voxels between them.

    ``half`` is half a voxel's edge [m]. Voxels are closed: a ray along a face of two voxels passes
    through both. :data:`TOUCH` ensures this in single precision.
    """
    ray = jnp.minimum(_best_margin(rays, half, transform, centers), DEEP * half)
    field = _field_margin(rays, half, transform, centers)
    field = jnp.where(ray > 0, jnp.maximum(field, INSIDE), field)
    return field, ray - jnp.minimum(field, 0.0)


def to_body(to_world: Float[Array, "3 3"], offset: Point) -> Point:
    """A vector in world axes, in body axes; ``to_world`` rotates from body to world."""
    a, b, c = offset
    x, y, z = (to_world[0, m] * a + to_world[1, m] * b + to_world[2, m] * c for m in range(3))
    return x, y, z


@jax.custom_jvp
def _best_margin(
    rays: Rays, half: Scalar, transform: RigidTransform, centers: Float[Array, "V 3"]
) -> Float[Array, " V"]:
    return best_ray(rays, half, transform, centers)[0]


@_best_margin.defjvp
def _best_margin_jvp(primals, tangents):  # type: ignore[no-untyped-def]
    """The derivative of a maximum is that of the ray with the largest margin (an envelope)."""
    # Only the pose has a derivative: the rays and the voxels are fixed.
    (rays, half, transform, centers), (_, _, d_transform, _) = primals, tangents
    margin, row, column = best_ray(rays, half, transform, centers)

    @jax.checkpoint  # the intermediates are 30 numbers a voxel, the winning ray is two
    def winning_margin(at):  # type: ignore[no-untyped-def]
        wider = 1.0 if at.lens is None else jnp.exp(jax.lax.stop_gradient(at.lens) - at.lens)
        return _ray_margin(rays, half, at, centers, row * wider, column * wider)

    return margin, jax.jvp(winning_margin, (transform,), (d_transform,))[1]


def best_ray(
    rays: Rays, half: Scalar, transform: RigidTransform, centers: Float[Array, "V 3"]
) -> tuple[Float[Array, " V"], Float[Array, " V"], Float[Array, " V"]]:
    """(margin [m], row, column) of the ray that passes deepest through each voxel."""
    rays = transform.through(rays)
    of_row = _candidates(rays, transform.to_world, _to_voxels(transform, centers), half)

    def try_row(neighbour: Array, best: tuple[Array, ...]) -> tuple[Array, ...]:
        row, *columns = of_row(neighbour - 1)
        for column in columns:
            margin = _ray_margin(rays, half, transform, centers, row, column)
            won = margin > best[0]
            found = margin, row, column
            best = tuple(jnp.where(won, new, old) for new, old in zip(found, best, strict=True))
        return best

    # A loop, because unrolled the three rows would be compiled three times.
    nothing = jnp.full(len(centers), -jnp.inf, centers.dtype)
    zero = jnp.zeros_like(nothing)
    return jax.lax.fori_loop(0, 3, try_row, (nothing, zero, zero))


def _ray_margin(
    rays: Rays,
    half: Scalar,
    transform: RigidTransform,
    centers: Float[Array, "V 3"],
    row: Float[Array, "*k V"],
    column: Float[Array, "*k V"],
) -> Float[Array, "*k V"]:
    """How deep the ray at ``row`` and ``column`` passes through each voxel [m]."""
    to_world, d = transform.to_world, rays.direction(row, column)
    world = tuple(sum(to_world[k, m] * d[m] for m in range(3)) for k in range(3))
    offset = tuple(
        x.reshape((1,) * (row.ndim - 1) + x.shape) for x in _to_voxels(transform, centers)
    )
    margin = ray_cube_margin(world, rays.table.reach, offset, half + TOUCH)  # type: ignore[arg-type]
    return rays.existing(row, column, margin)


def _candidates(
    rays: Rays, to_world: Float[Array, "3 3"], offset: Point, half: Scalar
) -> Callable[[Array], tuple[Array, Array, Array]]:
    """The six rays of which one passes through each voxel, if any ray does, with few exceptions.

    Returns a function of the row: −1, 0 and 1 are the row below the nearest one, the nearest, and
    the one above. It gives the row's coordinate and those of two columns.

    Where rows lie further apart than columns, a row may clip one corner of the cube, many columns
    away from the centre. So take the chord from the centre to the point of the cube that lies
    furthest towards the row. The point p where the chord meets the row is in the cube. A row
    crosses a cube in one interval. If that holds any ray, it holds the one just before or after p.

    Three rows are enough. If a cube reaches further rows, it is large compared with their spacing,
    and the nearest row crosses its middle. Where the cube is partly beyond the reach or the edge
    columns, the chord starts not from the centre but from a point inside them, the aim. At the edge
    of the grid the nearest ray is the edge ray.
    """
    q = to_body(to_world, offset)

    def corner(q: Point, normal: Point, outward: Float[Array, "*n"]) -> Point:
        """The corner of the cube furthest along ``normal``, or against it where outward < 0."""
        x, y, z = q
        for k in range(3):
            side = sum(to_world[k, m] * normal[m] for m in range(3)) * outward
            side = jnp.where(side < 0, -half, half)
            x, y, z = (at + side * to_world[k, m] for m, at in enumerate((x, y, z)))
        return x, y, z

    def extreme(normal: Point, outward: float) -> Point:
        """The point of the cube whose row is highest (outward = 1) or lowest (−1).

        The best of three: the corner furthest along the row's normal at the aim, that along the
        normal at the first corner, and the middle between them. Near the sensor the corners differ.
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
            # Inside is left of the first column's plane and right of the last one's. But a field
            # of view of more than half a turn reaches behind those planes.
            outside = (rays.column(aim) - rays.table.edges.column[edge]) * outward < 0
            beyond = jnp.where(outside, jnp.minimum(rays.beyond_edge(aim, edge) * outward, 0), 0)
            inner = corner(q, rays.column_normal(aim), jnp.full_like(beyond, outward))
            aim = _to_edge(aim, beyond, inner, rays.beyond_edge(inner, edge) * outward)
    if isinstance(rays, DistortedRays):
        beyond = jnp.minimum(rays.cone_margin(aim), 0.0)
        inner = corner(q, rays.inward(aim), jnp.ones_like(beyond))
        aim = _to_edge(aim, beyond, inner, rays.cone_margin(inner))

    here = rays.row(aim)
    normal = rays.row_normal(aim)
    above, below = extreme(normal, 1.0), extreme(normal, -1.0)
    nearest = rays.nearest_row(here)

    def of_row(neighbour: Array) -> tuple[Array, Array, Array]:
        """The row ``neighbour`` rows above the nearest one, and its two columns."""
        row = rays.row_at(jnp.clip(nearest + neighbour, 0, rays.table.row_count - 1))
        up = row > here
        far = tuple(jnp.where(up, a, b) for a, b in zip(above, below, strict=True))
        start, end = rays.beyond_row(aim, row), rays.beyond_row(far, row)  # type: ignore[arg-type]
        crossing = start / jnp.where(jnp.abs(start - end) < 1e-9, 1e-9, start - end)
        p = _between(aim, far, crossing)  # type: ignore[arg-type]
        before = rays.column_index(rays.shown(row, rays.column(p)))
        return row, rays.column_at(before), rays.column_at(before + 1)

    return of_row


def _within_reach(rays: Rays, q: Point, corner) -> Point:  # type: ignore[no-untyped-def]
    """The point to aim at: a voxel's centre ``q``, or, if that is beyond the reach, the middle of
    that part of the line from the nearest corner to it which is within reach."""
    near = corner(q, q, -jnp.ones_like(q[0]))
    far_range, near_range = (
        jnp.sqrt(jnp.maximum(x * x + y * y + z * z, 1e-12)) for x, y, z in (q, near)
    )
    beyond = jnp.maximum(far_range - rays.table.reach, 0.0)
    meets = beyond / jnp.maximum(far_range - near_range, 1e-9)
    return _between(q, near, jnp.where(beyond > 0, (1 + meets) / 2, 0.0))


def _to_edge(aim: Point, beyond: Array, inner: Point, inside: Array) -> Point:
    """A point that is ``beyond`` an edge, by a negative margin [m], or is not, with 0: moved as far
    toward one that is ``inside`` [m] as it takes."""
    gain = inside - beyond
    return _between(aim, inner, jnp.where(gain > 0, -beyond / jnp.maximum(gain, 1e-9), 1.0))


def _between(a: Point, b: Point, t: Float[Array, " V"]) -> Point:
    """a + t·(b − a), with t clipped to 0 … 1."""
    t = jnp.clip(t, 0.0, 1.0)
    return a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1]), a[2] + t * (b[2] - a[2])


def soft_view(
    kinds: tuple[Kind, ...],
    kind: Int[Array, ""],
    table: RayTable,
    half: Scalar,
    softness: Softness,
    pose: Float[Array, "6"],
    tile: Tile,
) -> Float[Array, "Z C"]:
    """The chance that one sensor has each voxel of a tile in view: both margins, read softly.

    ``kind`` is the number of its kind among ``kinds``; their count is that of no sensor.
    """
    levels, columns = tile.heights.shape
    dense = softness.rays == "density"

    def view(kind: Kind, table: RayTable, pose: Array) -> Array:
        rays, transform = kind.rays(table), transform_of(pose)
        xy = jnp.broadcast_to(tile.columns.T, (levels, columns, 2))
        centers = jnp.concatenate([xy, tile.heights[:, :, None]], -1).reshape(-1, 3)
        if dense:
            f = density_view_by_motions(rays, half, transform, centers, softness.field)
        else:
            field, ray = in_view_margins(rays, half, transform, centers)
            f = step(field, softness.field) * step(ray)
        z = jnp.arange(levels, dtype=tile.there.dtype)[:, None]
        return f.reshape(levels, columns) * ((tile.there[None] >> z) & 1).astype(f.dtype)

    def nothing(table: RayTable, pose: Array) -> Array:
        return jnp.zeros((levels, columns))

    wide = half + certain_beyond(softness.field)
    transform = transform_of(jax.lax.stop_gradient(pose))
    by_kind = jnp.stack(
        [may_touch_field(each.rays(table), wide, transform, tile, dense) for each in kinds]
    )
    touched = (by_kind & (kind == np.arange(len(kinds), dtype=np.int32))).any()
    branches: list[Any] = [*(partial(view, each) for each in kinds), nothing]
    return jax.lax.switch(jnp.where(touched, kind, len(kinds)), branches, table, pose)


def density_view(
    rays: Rays,
    half: Scalar,
    transform: RigidTransform,
    centers: Float[Array, "V 3"],
    softness: Width,
) -> Float[Array, " V"]:
    """The chance that some ray passes through each voxel, under a random phase of the grid.

    ``softness`` [m] is that of the field's edges. Only the transform has a gradient.
    """
    rays = transform.through(rays)
    to_world = transform.to_world
    x, y, z = (
        (2 * half * to_world[k, 0], 2 * half * to_world[k, 1], 2 * half * to_world[k, 2])
        for k in range(3)
    )
    q = to_body(to_world, _to_voxels(transform, centers))
    return in_view_chance(rays, q, (x, y, z), softness)


density_view_by_motions = jax.custom_vjp(density_view)
"""The same; its gradient is found in forward mode, from the sensor's six motions and its lens.

Each motion is one pass over the voxels. In reverse mode XLA finds each of a dozen slopes in a pass
that begins anew, which takes twice to three times as long."""


def _by_motions_forward(
    rays: Rays, half: Scalar, transform: RigidTransform, centers: Array, softness: Width
) -> tuple[Array, tuple[Array, Array]]:
    to_world = transform.to_world
    view = partial(density_view, rays, half, centers=centers, softness=softness)

    seen, along = jax.linearize(view, transform)

    def slope(motion: Float[Array, " m"]) -> Float[Array, " V"]:
        """Along a shift [m] and a turn [rad] about the body's axes, and along the lens."""
        turned = to_world @ cross_matrix(motion[3:6])
        return along(RigidTransform(to_world @ motion[:3], turned, *motion[6:]))

    motions = 6 if transform.lens is None else 7
    slopes = jax.lax.map(slope, jnp.eye(motions, dtype=to_world.dtype))
    return seen, (slopes, to_world)


def _by_motions_backward(kept: tuple[Array, Array], wanted: Float[Array, " V"]) -> tuple:
    """Of a turn by w, ``to_world`` changes by to_world·[w]×, whose scalar product with the
    gradient to_world·[g]×/2 is w·g."""
    slopes, to_world = kept
    along = slopes @ wanted
    turned = to_world @ cross_matrix(along[3:6]) / 2
    return None, None, RigidTransform(to_world @ along[:3], turned, *along[6:]), None, None


density_view_by_motions.defvjp(_by_motions_forward, _by_motions_backward)


def may_touch_field(
    rays: Rays, half: Scalar, transform: RigidTransform, tile: Tile, outer: bool = False
) -> Bool[Array, ""]:
    """Whether a sphere around a tile's voxels touches the field of view.

    ``outer``: of rays as a density, whose field ends half a spacing beyond the outermost rays.
    """
    middle = (tile.low + tile.high) / 2
    radius = jnp.hypot(tile.radius, middle - tile.low) + 3.0**0.5 * half + SLACK
    rays, (x, y, z) = transform.through(rays), transform.position
    offset = tile.center[0] - x, tile.center[1] - y, middle - z
    edges = rays.table.outer if outer else rays.table.edges
    return ~rays.surely_outside(to_body(transform.to_world, offset), edges, radius)
