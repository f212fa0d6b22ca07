"""Which voxels each sensor has in view, and which of them traffic leaves visible.

Two questions, kept apart: does a ray of the sensor pass through the voxel (the
frame does not matter), and does a vehicle cut the line of sight to its centre
(the rays do not matter).
"""

import operator
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from inspe_jax.errors import InspeError
from inspe_jax.geometry import (
    NEVER,
    Point,
    Prism,
    cut_margins,
    ray_cube_margin,
    rotation,
    shade,
    shadow_ceiling,
    shadow_height,
)
from inspe_jax.numerics import Width, exact, step
from inspe_jax.scene.scene import Scene
from inspe_jax.scene.voxels import ROI_HEIGHT
from inspe_jax.sensing.layout import Layout
from inspe_jax.sensing.sensors import RayGrid

TOUCH = 2e-5
"""A ray this near to a voxel touches it [m]: the rounding of single precision at 100 m."""


DEEP = 0.7
"""Where rays are dense, voxels are this share of half an edge deep in one at least; no margin
counts as deeper, since which of the rays is deepest changes with every move and means nothing."""


@partial(jax.jit, static_argnames=("grid", "half"))
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

    def margins(pose: Float[Array, "6"]) -> tuple[Float[Array, " V"], Float[Array, " V"]]:
        ray = jnp.minimum(_best_margin(grid, half, pose, centers), DEEP * half)
        # A ray in the voxel is in the field of view, whatever the rounding.
        field = jnp.maximum(_field_margin(grid, half, pose, centers), ray)
        return field, ray - jnp.minimum(field, 0.0)

    return jax.lax.map(margins, poses)


def _to_voxels(pose: Float[Array, "6"], centers: Float[Array, "V 3"]) -> Point:
    """From the sensor to each voxel, world axes."""
    r = centers - pose[None, :3]  # (V, 3)
    return r[:, 0], r[:, 1], r[:, 2]


@partial(jax.checkpoint, static_argnums=(0, 1))
def _field_margin(
    grid: RayGrid, half: float, pose: Float[Array, "6"], centers: Float[Array, "V 3"]
) -> Float[Array, " V"]:
    return grid.field_margin(_to_body(rotation(pose[3:]), _to_voxels(pose, centers))) + half


def _to_body(turn: Float[Array, "3 3"], offset: Point) -> Point:
    """World axes to the body's."""
    a, b, c = offset
    x, y, z = (turn[0, m] * a + turn[1, m] * b + turn[2, m] * c for m in range(3))
    return x, y, z


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _best_margin(
    grid: RayGrid, half: float, pose: Float[Array, "6"], centers: Float[Array, "V 3"]
) -> Float[Array, " V"]:
    return _best_ray(grid, half, pose, centers)[0]


@_best_margin.defjvp
def _best_margin_jvp(grid, half, primals, tangents):  # type: ignore[no-untyped-def]
    """A maximum is an envelope: its derivative is that of the ray that won."""
    (pose, centers), (d_pose, _) = primals, tangents  # the voxels stand still
    margin, row, column = _best_ray(grid, half, pose, centers)

    @jax.checkpoint  # kept, the intermediates would be 30 numbers a voxel; the winner is two
    def won(pose, row, column):  # type: ignore[no-untyped-def]
        return _ray_margin(grid, half, pose, centers, row, column)

    still = jnp.zeros_like(row)
    return margin, jax.jvp(won, (pose, row, column), (d_pose, still, still))[1]


def _best_ray(
    grid: RayGrid, half: float, pose: Float[Array, "6"], centers: Float[Array, "V 3"]
) -> tuple[Float[Array, " V"], Float[Array, " V"], Float[Array, " V"]]:
    """(margin, row, column) of the ray that passes deepest through each voxel."""
    candidates = _candidates(grid, rotation(pose[3:]), _to_voxels(pose, centers), half)
    best = jnp.full(len(centers), -jnp.inf, centers.dtype)
    best_row, best_column = candidates[0]
    for row, column in candidates:
        margin = _ray_margin(grid, half, pose, centers, row, column)
        won = margin > best
        best = jnp.where(won, margin, best)
        best_row = jnp.where(won, row, best_row)
        best_column = jnp.where(won, column, best_column)
    return best, best_row, best_column


def _ray_margin(
    grid: RayGrid,
    half: float,
    pose: Float[Array, "6"],
    centers: Float[Array, "V 3"],
    row: Float[Array, " V"],
    column: Float[Array, " V"],
) -> Float[Array, " V"]:
    turn, d = rotation(pose[3:]), grid.direction(row, column)
    world = tuple(sum(turn[k, m] * d[m] for m in range(3)) for k in range(3))
    return ray_cube_margin(world, grid.reach, _to_voxels(pose, centers), half + TOUCH)


def _candidates(
    grid: RayGrid, turn: Float[Array, "3 3"], offset: Point, half: float
) -> list[tuple[Float[Array, " V"], Float[Array, " V"]]]:
    """(row, column) of the rays that can pass through each voxel, if any does.

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
    q = _to_body(turn, offset)

    def corner(normal: Point, outward: Float[Array, " V"]) -> Point:
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
        one = corner(normal, sign)
        two = corner(grid.row_normal(one), sign)
        middle = _between(one, two, jnp.full_like(q[0], 0.5))
        best, value = one, grid.row(one) * outward
        for point in (two, middle):
            other = grid.row(point) * outward
            best = tuple(jnp.where(other > value, a, b) for a, b in zip(point, best, strict=True))  # type: ignore[assignment]
            value = jnp.maximum(value, other)
        return best

    aim = _within_reach(grid, q, corner)
    if not grid.wraps:
        for edge, outward in zip(grid.column_limits, (1.0, -1.0), strict=True):
            # Left of the first column's plane is inside, right of the last one's; but a field
            # of view of more than half a turn reaches behind those planes.
            outside = (grid.column(aim) - edge) * outward < 0
            beyond = jnp.where(outside, jnp.minimum(grid.beyond_column(aim, edge) * outward, 0), 0)
            inner = corner(grid.column_normal(aim), jnp.full_like(beyond, outward))
            gain = grid.beyond_column(inner, edge) * outward - beyond
            aim = _between(aim, inner, jnp.where(gain > 0, -beyond / jnp.maximum(gain, 1e-9), 1.0))

    here = grid.row(aim)
    nearest = grid.nearest_row(here)
    normal = grid.row_normal(aim)
    above, below = extreme(normal, 1.0), extreme(normal, -1.0)
    found = []
    for neighbour in (-1, 0, 1):
        row = grid.row_at(jnp.clip(nearest + neighbour, 0, len(grid.rows) - 1))
        up = row > here
        far = tuple(jnp.where(up, a, b) for a, b in zip(above, below, strict=True))
        start, end = grid.beyond_row(aim, row), grid.beyond_row(far, row)  # type: ignore[arg-type]
        crossing = start / jnp.where(jnp.abs(start - end) < 1e-9, 1e-9, start - end)
        p = _between(aim, far, crossing)  # type: ignore[arg-type]
        before = grid.column_index(grid.column(p))
        found += [(row, grid.column_at(before)), (row, grid.column_at(before + 1))]
    return found


def _within_reach(grid: RayGrid, q: Point, corner) -> Point:  # type: ignore[no-untyped-def]
    """The centre; or, beyond the reach, the middle of what is within it towards the near corner."""
    near = corner(q, -jnp.ones_like(q[0]))
    far_range, near_range = (
        jnp.sqrt(jnp.maximum(x * x + y * y + z * z, 1e-12)) for x, y, z in (q, near)
    )
    beyond = jnp.maximum(far_range - grid.reach, 0.0)
    meets = beyond / jnp.maximum(far_range - near_range, 1e-9)
    return _between(q, near, jnp.where(beyond > 0, (1 + meets) / 2, 0.0))


def _between(a: Point, b: Point, t: Float[Array, " V"]) -> Point:
    """a + t·(b − a), t held between 0 and 1."""
    t = jnp.clip(t, 0.0, 1.0)
    return a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1]), a[2] + t * (b[2] - a[2])


def shadow_ceilings(
    sensors: Float[Array, "S 3"],
    prisms: Prism,
    columns: Float[Array, "L 2"],
    *,
    spare_own: bool = False,
) -> Float[Array, "S L"]:
    """Height [m] below which the prisms (B,) of one frame hide each column from each sensor.

    A voxel whose centre is higher is in line of sight. The cost is columns ×
    prisms, not voxels × prisms. The scan over prisms keeps one number a column;
    unrolled by 8 it runs from registers.
    """

    def one(sensor: Float[Array, "3"]) -> Float[Array, " L"]:
        dx, dy = columns[:, 0] - sensor[0], columns[:, 1] - sensor[1]

        def lift(ceiling, prism_shade):  # type: ignore[no-untyped-def]
            new = shadow_ceiling(prism_shade, dx, dy, sensor[2], spare_own=spare_own)
            return jnp.maximum(ceiling, new), None

        start = jnp.full(len(columns), NEVER, columns.dtype)
        return jax.lax.scan(lift, start, shade(sensor, prisms), unroll=8)[0]

    return jax.vmap(one)(sensors)


WINNERS = 2
"""Prisms a column that soft sight lines are read against: those that hide most of it."""


def sight(
    sensors: Float[Array, "S 3"],
    prisms: Prism,
    columns: Float[Array, "L 2"],
    heights: Float[Array, "L Z"],
    width: Width = None,
    *,
    spare_own: bool = False,
) -> Float[Array, "S L Z"]:
    """Chance that the prisms (B,) of one frame leave each sensor's sight line to a voxel clear.

    Read exactly, the highest ceiling over a column decides. Softly, 1 − p of the
    :data:`WINNERS` prisms that hide most of the column are multiplied, p being the reading of how
    deep the line cuts in sideways times that of how far below the top; prisms that narrowly miss
    count. Who wins is found without differentiation.
    """
    if exact(width):
        ceilings = shadow_ceilings(sensors, prisms, columns, spare_own=spare_own)
        return step(heights[None] - ceilings[:, :, None])

    def one(sensor: Float[Array, "3"]) -> Float[Array, "L Z"]:
        clear = jnp.ones_like(heights)
        fixed, soft = jax.lax.stop_gradient((sensor, jnp.asarray(width, sensor.dtype)))
        for winner, mass in _winners(fixed, prisms, columns, heights[:, 0], soft, spare_own):
            won = jax.tree.map(lambda leaf: leaf[winner], prisms)  # noqa: B023
            beside, below = cut_margins(sensor, won, columns, heights)
            hidden = step(beside, width)[:, None] * step(below, width)
            clear *= 1.0 - jnp.where((mass > 0)[:, None], hidden, 0.0)
        return clear

    return jax.vmap(one)(sensors)


def _winners(
    sensor: Float[Array, "3"],
    prisms: Prism,
    columns: Float[Array, "L 2"],
    lowest: Float[Array, " L"],
    width: Float[Array, ""],
    spare_own: bool,
) -> list[tuple[Int[Array, " L"], Float[Array, " L"]]]:
    """The prisms that hide most of each column, and how much [m]: the height of the shadow over
    the lowest voxel, times how deep the line cuts in, both read in a cheap soft way. Only a prism
    that is none hides nothing: if those far from the line were cut off, each that comes near would
    add a jump, and the gradient would miss what the jumps add up to.
    """
    dx, dy = columns[:, 0] - sensor[0], columns[:, 1] - sensor[1]
    per_metre = jax.lax.rsqrt(jnp.maximum(dx * dx + dy * dy, 1e-9))

    def enter(best, prism):  # type: ignore[no-untyped-def]
        number, prism, cast = prism
        sx, sy = sensor[0] - prism.center[0], sensor[1] - prism.center[1]
        x, y = cast.cos * sx + cast.sin * sy, cast.cos * sy - cast.sin * sx
        ex, ey = cast.cos * dx + cast.sin * dy, cast.cos * dy - cast.sin * dx
        a, b = prism.half
        support = a * jnp.abs(ey) + b * jnp.abs(ex)
        beside = (support - jnp.abs(x * ey - y * ex)) * per_metre
        beside = jnp.minimum(beside, a + jnp.abs(ex) / 2 - jnp.abs(x + ex / 2))
        beside = jnp.minimum(beside, b + jnp.abs(ey) / 2 - jnp.abs(y + ey / 2))
        u = beside / width
        cuts = 0.5 * (1.0 + u * jax.lax.rsqrt(4.0 + u * u))
        ceiling, stands = shadow_height(cast, dx, dy, sensor[2])
        height = jnp.clip(ceiling - lowest, -20.0, 20.0)
        mass = cuts * (height + jnp.sqrt(height * height + 4.0 * width * width))
        mass = jnp.where(prism.valid & ~(stands & spare_own), mass, 0.0)
        for k, (held, index) in enumerate(best):
            more = mass > held
            best[k] = jnp.where(more, mass, held), jnp.where(more, number, index)
            mass, number = jnp.where(more, held, mass), jnp.where(more, index, number)
        return best, None

    count = len(prisms.top)
    none = (jnp.zeros_like(dx), jnp.zeros(len(dx), int))
    numbers = jnp.arange(count)
    table = (numbers, prisms, shade(sensor, prisms))
    best = jax.lax.scan(enter, [none] * min(WINNERS, count), table, unroll=4)[0]
    return [(index, mass) for mass, index in best]


class Ground(NamedTuple):
    """A scene's arrays about its centre, where single precision is finest.

    ``columns`` (L, 2), ``heights`` (L, Z) of the voxel centres, ``prisms`` (T, B).
    """

    columns: Float[Array, "L 2"]
    heights: Float[Array, "L Z"]
    prisms: Prism

    @property
    def centers(self) -> Float[Array, "V 3"]:
        """Voxel centres, column by column."""
        z = self.heights.reshape(-1, 1)
        return jnp.concatenate([jnp.repeat(self.columns, self.heights.shape[1], 0), z], axis=1)


def about_center(scene: Scene) -> Ground:
    """The scene's columns, heights and prisms, relative to its centre."""
    grid, traffic = scene.voxels, scene.traffic
    x, y, z = grid.center
    return Ground(
        columns=jnp.asarray(grid.columns - [x, y], float),
        heights=jnp.asarray(grid.ground[:, None] - z + grid.levels, float),
        prisms=Prism(
            center=jnp.asarray(traffic.center[..., :2] - [x, y], float),
            yaw=jnp.asarray(traffic.yaw, float),
            half=jnp.asarray(traffic.size[..., :2] / 2, float),
            top=jnp.asarray(traffic.center[..., 2] + traffic.size[..., 2] / 2 - z, float),
            valid=jnp.asarray(traffic.valid),
        ),
    )


def poses_about_center(scene: Scene, layout: Layout) -> Float[Array, "S 6"]:
    """The layout's poses relative to the scene's centre, traced or not."""
    shift = np.concatenate([scene.voxels.center, np.zeros(3)])
    return jnp.asarray(layout.poses - shift[None], float)


def view_margins(
    poses: Float[Array, "S 6"],
    centers: Float[Array, "V 3"],
    groups: tuple[tuple[RayGrid, tuple[int, ...]], ...],
    half: float,
) -> tuple[Float[Array, "S V"], Float[Array, "S V"]]:
    """:func:`in_view_margins` of all sensors; ``groups`` says which share a grid of rays."""
    margins = [in_view_margins(grid, poses[jnp.array(s)], centers, half) for grid, s in groups]
    order = np.argsort(np.concatenate([index for _, index in groups]))
    field, ray = (jnp.concatenate(part)[order] for part in zip(*margins, strict=True))
    return field, ray


def in_view(scene: Scene, layout: Layout) -> Bool[np.ndarray, "S V"]:
    """Whether some ray of each sensor passes through each voxel; traffic does not matter."""
    check_layout(scene, layout)
    field, ray = view_margins(
        poses_about_center(scene, layout),
        about_center(scene).centers,
        layout.groups(),
        scene.voxels.size / 2,
    )
    return np.asarray((field > 0) & (ray > 0))


def line_of_sight(scene: Scene, layout: Layout, frame: int) -> Bool[np.ndarray, "S V"]:
    """Whether the segment from each sensor to each voxel's centre clears one frame's traffic.

    The rays and the reach do not matter. A voxel inside a vehicle is not in line
    of sight. Raises InspeError where there is no such frame.
    """
    check_layout(scene, layout)
    frame = operator.index(frame)
    last = scene.traffic.frame_count - 1
    if not 0 <= frame <= last:
        raise InspeError(f"frame {frame}: the scene has frames 0 to {last}")
    ground = about_center(scene)
    prisms = jax.tree.map(lambda leaf: leaf[frame], ground.prisms)
    ceilings = _ceilings(poses_about_center(scene, layout)[:, :3], prisms, ground.columns)
    clear = ground.heights[None] > ceilings[:, :, None]
    return np.asarray(clear.reshape(len(layout), -1))


_ceilings = jax.jit(shadow_ceilings)


def check_layout(scene: Scene, layout: Layout) -> None:
    """Raise InspeError where a pose is not finite, or a sensor is in the ground or out of reach.

    Traced poses have no value to check yet and pass.
    """
    if isinstance(layout.poses, jax.core.Tracer):
        return
    grid, poses = scene.voxels, np.asarray(layout.poses, float)
    for pose, sensor in zip(poses, layout.sensors, strict=True):
        where = f"{layout.name}: sensor '{sensor.name}' at ({pose[0]:.2f}, {pose[1]:.2f})"
        if not np.isfinite(pose).all():
            raise InspeError(f"{where}: its pose has a value that is not finite")
        away, reach = np.hypot(*(pose[:2] - grid.center[:2])), sensor.spec.grid.reach
        ground = float(scene.intersection.ground(pose[None, :2])[0])
        gap = np.hypot(max(away - grid.radius, 0.0), max(pose[2] - ground - ROI_HEIGHT, 0.0))
        if gap > reach:
            raise InspeError(
                f"{where}, {pose[2] - ground:.0f} m up, is {gap:.0f} m from the region of interest "
                f"of {scene.name} and reaches {reach:g} m; is this layout for another scene?"
            )
        if not pose[2] > ground:
            raise InspeError(
                f"{where} is in the ground: its height is {pose[2]:.2f} m and the ground's "
                f"{ground:.2f} m"
            )
