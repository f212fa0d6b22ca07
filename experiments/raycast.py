"""Walks of every ray, in NumPy and double precision: the test oracle of what is in view.

There are two walks. ``bresenham`` is the paper's: integer steps along the ray's longest axis, which
skip voxels that the ray only clips. ``exact`` visits every voxel that the ray passes through
(Amanatides and Woo, *A fast voxel traversal algorithm for ray tracing*, Eurographics 1987) and is
what the scores mean. Neither shares code with :mod:`inspe_jax.visibility.queries`.
"""

from collections.abc import Callable
from itertools import product

import numpy as np
from jaxtyping import Bool, Float, Int

from inspe_jax.core.errors import InspeError
from inspe_jax.scene.placed_bodies import convex_parts
from inspe_jax.scene.scene import Scene
from inspe_jax.scene.voxels import VoxelGrid
from inspe_jax.sensing.layout import Layout

TIE = 1e-9
"""Places nearer to each other than this are the same [m]."""


def in_view(scene: Scene, layout: Layout, walk: str = "bresenham") -> Bool[np.ndarray, "S V"]:
    """Which voxels some ray of each sensor passes through, by walking every ray.

    ``walk`` is ``bresenham`` or ``exact``; with the latter, rays end where they meet a static body
    of which less than half of the light passes through. Raises InspeError where it is another, or
    where there are bodies and it is ``bresenham``, or where the scene has terrain: rays know no
    ground.
    """
    if walk not in WALKS:
        raise InspeError(f"walk '{walk}': one of {', '.join(WALKS)}")
    if scene.terrain is not None:
        raise InspeError(f"{scene.name} has terrain, and walked rays do not end at the ground")
    if scene.statics and walk != "exact":
        raise InspeError(f"{scene.name} has static bodies: only the walk 'exact' ends at them")
    seen = np.zeros((len(layout), scene.voxels.count), bool)
    for s in range(len(layout)):
        origin, directions, reach = layout.rays(s)
        for part in np.array_split(directions, max(1, len(directions) // 20_000)):
            end = reach if not scene.statics else ray_ends(scene, origin, part, reach)
            WALKS[walk](scene.voxels, origin, part, end, seen[s])
    if scene.inside_statics is not None:
        seen &= ~scene.inside_statics.ravel()
    return seen


def ray_ends(
    scene: Scene,
    origin: Float[np.ndarray, "3"],
    directions: Float[np.ndarray, "R 3"],
    reach: float,
) -> Float[np.ndarray, " R"]:
    """How far each ray comes [m]: to the first static body in its way, or to its reach."""
    ends = np.full(len(directions), float(reach))
    parts = convex_parts(scene.statics, scene.intersection)
    for corners, bottom, top, through, _ in zip(*parts, strict=True):
        if through >= 0.5:
            continue
        sides = np.roll(corners, -1, 0) - corners
        normals = np.column_stack([sides[:, 1], -sides[:, 0], np.zeros(len(sides))])
        planes = [*zip(normals, np.einsum("kd,kd->k", normals[:, :2], corners), strict=True)]
        planes.append((np.array([0.0, 0.0, 1.0]), top))
        if np.isfinite(bottom):
            planes.append((np.array([0.0, 0.0, -1.0]), -bottom))
        enters, leaves = np.zeros(len(ends)), np.full(len(ends), np.inf)
        for normal, offset in planes:
            inside, along = offset - normal @ origin, directions @ normal
            with np.errstate(divide="ignore", invalid="ignore"):
                t = inside / along
            enters = np.where(along < 0, np.maximum(enters, t), enters)
            leaves = np.where(along > 0, np.minimum(leaves, t), leaves)
            leaves = np.where((along == 0) & (inside < 0), -np.inf, leaves)
        ends = np.where(enters < leaves, np.minimum(ends, enters), ends)
    return ends


def exact(
    grid: VoxelGrid,
    origin: Float[np.ndarray, "3"],
    directions: Float[np.ndarray, "R 3"],
    reach: float | Float[np.ndarray, " R"],
    seen: Bool[np.ndarray, " V"],
) -> None:
    """Mark in ``seen`` every voxel that a ray passes through; voxels are closed.

    ``reach`` [m] is one number for all rays, or one for each ray.

    The walk is in plan, from column to column. The ray's heights at entry and exit give the levels,
    as every column has its own ground. If the sensor is on a border between columns, the rays are
    walked on both sides of it, because a ray along the border touches both.
    """
    from_border = (origin[:2] - grid.center[:2]) / grid.spacing
    on_border = np.abs(from_border - np.round(from_border)) * grid.spacing < TIE
    sides = [(-TIE, TIE) if on else (0.0,) for on in on_border]
    for dx, dy in product(*sides):
        _walk(grid, origin + [dx, dy, 0.0], directions, reach, seen)


def _walk(
    grid: VoxelGrid,
    origin: Float[np.ndarray, "3"],
    directions: Float[np.ndarray, "R 3"],
    reach: float | Float[np.ndarray, " R"],
    seen: Bool[np.ndarray, " V"],
) -> None:
    """:func:`exact` from a sensor that is not on a border."""
    h = grid.spacing
    start = (origin[:2] - grid.center[:2]) / h
    slope = directions[:, :2] / h
    cell = np.repeat(np.floor(start)[None].astype(int), len(directions), 0)
    forward = np.where(slope >= 0, 1, -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        per_cell = np.abs(1 / slope)
        border = (cell + (slope > 0) - start) / slope
    border = np.where(slope == 0, np.inf, border)
    entry = np.zeros(len(directions))
    alive, far = np.arange(len(directions)), np.broadcast_to(reach, (len(directions),))
    column_at, half = _lookup(grid)
    while len(alive):
        leaving = np.minimum(border.min(1), far)
        first, last = _within(grid, origin, directions[alive], cell, entry, leaving)
        met = last >= first
        z_in, z_out = (origin[2] + t[met] * directions[alive[met], 2] for t in (first, last))
        low, high = np.minimum(z_in, z_out) - TIE, np.maximum(z_in, z_out) + TIE
        _mark(grid, column_at, half, cell[met], low, high, seen)
        axis = border.argmin(1)
        rows = np.arange(len(alive))
        cell[rows, axis] += forward[rows, axis]
        entry = leaving
        border[rows, axis] += per_cell[rows, axis]
        # A ray ends past its reach, or outside the square and heading away from it.
        away = ((cell >= half) & (forward > 0)) | ((cell < -half) & (forward < 0))
        on = (entry < far) & ~away.any(1)
        alive, cell, forward = alive[on], cell[on], forward[on]
        border, per_cell, entry, far = border[on], per_cell[on], entry[on], far[on]


def _within(
    grid: VoxelGrid,
    origin: Float[np.ndarray, "3"],
    directions: Float[np.ndarray, "R 3"],
    cell: Int[np.ndarray, "R 2"],
    entry: Float[np.ndarray, " R"],
    leaving: Float[np.ndarray, " R"],
) -> tuple[Float[np.ndarray, " R"], Float[np.ndarray, " R"]]:
    """The distances [m] at which each ray begins and ceases to be over the voxels of its cell.

    Voxels that fill their cells are under the ray all the way. If the second is less than the
    first, the ray passes between the voxels.
    """
    if grid.size == grid.spacing:
        return entry, leaving
    middle = grid.center[:2] + (cell + 0.5) * grid.spacing
    along = np.abs(middle - origin[:2]) <= grid.size / 2
    parallel = directions[:, :2] == 0
    slope = np.where(parallel, 1.0, directions[:, :2])
    one, two = ((middle + side * grid.size / 2 - origin[:2]) / slope for side in (-1, 1))
    low = np.where(parallel, np.where(along, -np.inf, np.inf), np.minimum(one, two))
    high = np.where(parallel, np.where(along, np.inf, -np.inf), np.maximum(one, two))
    return np.maximum(entry, low.max(1) - TIE), np.minimum(leaving, high.min(1) + TIE)


def bresenham(
    grid: VoxelGrid,
    origin: Float[np.ndarray, "3"],
    directions: Float[np.ndarray, "R 3"],
    reach: float,
    seen: Bool[np.ndarray, " V"],
) -> None:
    """Mark in ``seen`` the voxels on each ray's Bresenham line, end point included.

    The lattice is level, through the scene's centre. The height of a cell's centre above its
    column's ground gives the level. Raises InspeError where voxels stand apart.
    """
    if grid.spacing != grid.size:
        raise InspeError("Bresenham's lines need voxels that touch: leave out the spacing")
    h = grid.size
    first = np.floor((origin - grid.center) / h).astype(int)
    last = np.floor((origin + reach * directions - grid.center) / h).astype(int)
    delta = last - first
    steps = np.abs(delta).max(1)
    column_at, half = _lookup(grid)
    for n in range(int(steps.max(initial=0)) + 1):
        on = n <= steps
        # Rounded to the nearest cell, halves upward, as the integer error term does.
        total = np.maximum(steps[on], 1)[:, None]
        cell = first + (2 * n * delta[on] + total) // (2 * total)
        z = grid.center[2] + (cell[:, 2] + 0.5) * h
        _mark(grid, column_at, half, cell[:, :2], z, z, seen)


WALKS: dict[str, Callable[..., None]] = {"bresenham": bresenham, "exact": exact}


def _lookup(grid: VoxelGrid) -> tuple[Int[np.ndarray, "N N"], int]:
    """The column's number in each lattice cell, −1 where there is none; and half the square's edge
    in cells."""
    half = int(np.ceil(grid.radius / grid.spacing))
    cell = np.floor((grid.columns - grid.center[:2]) / grid.spacing).astype(int) + half
    table = np.full((2 * half, 2 * half), -1)
    table[cell[:, 0], cell[:, 1]] = np.arange(len(cell))
    return table, half


def _mark(
    grid: VoxelGrid,
    column_at: Int[np.ndarray, "N N"],
    half: int,
    cell: Int[np.ndarray, "R 2"],
    low: Float[np.ndarray, " R"],
    high: Float[np.ndarray, " R"],
    seen: Bool[np.ndarray, " V"],
) -> None:
    """Mark the levels between two heights in each cell's column."""
    inside = ((cell >= -half) & (cell < half)).all(1)
    column = column_at[tuple(cell[inside].T + half)]
    there = column >= 0
    column, low, high = column[there], low[inside][there], high[inside][there]
    for level, height in enumerate(grid.levels):
        middle = grid.ground[column] + height
        hit = (low < middle + grid.size / 2) & (high >= middle - grid.size / 2)
        seen[column[hit] * grid.level_count + level] = True
