"""The ground as a surface of triangles that hides what is behind its brows."""

import math
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy
import shapely
from jaxtyping import Float, Int

from inspe_jax.core.errors import InspeError, nearest
from inspe_jax.scene.intersection import Intersection

TERRAINS = ("none", "ground")  # what of the ground hides in a scene: nothing, or its map's
LOWEST, HIGHEST = -450.0, 8900.0  # heights above the sea that land can have [m]
STEP = 1.0  # edge of the cells that are cut into two triangles each [m]
MARGIN = 15.0  # the surface reaches so far beyond the region of interest [m]: units stand there


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class Terrain:
    """A surface of triangles over a square lattice: its first point (``corner``), the edge of its
    cells (``step``), and its ``heights`` [m]. Cells are cut from their first point to the opposite
    one."""

    corner: Float[np.ndarray, "2"]
    step: float
    heights: Float[np.ndarray, "X Y"]

    def height(self, xy: Float[np.ndarray, "N d"]) -> Float[np.ndarray, " N"]:
        """The height of the surface [m] at plan points; beyond its edge, that of the edge."""
        most = np.array(self.heights.shape) - 1
        at = np.clip((np.asarray(xy, float)[:, :2] - self.corner) / self.step, 0, most)
        first = np.minimum(at.astype(int), most - 1)
        (i, j), (u, v) = first.T, (at - first).T
        low, high = self.heights[i, j], self.heights[i + 1, j + 1]
        side = np.where(u > v, self.heights[i + 1, j], self.heights[i, j + 1])
        long, short = np.maximum(u, v), np.minimum(u, v)
        return low + long * (side - low) + short * (high - side)

    @cached_property
    def steepest(self) -> float:
        """The slope of the steepest triangle, in metres for a metre."""
        h = self.heights
        lower = np.hypot(h[1:, :-1] - h[:-1, :-1], h[1:, 1:] - h[1:, :-1])
        upper = np.hypot(h[:-1, 1:] - h[:-1, :-1], h[1:, 1:] - h[:-1, 1:])
        return float(max(lower.max(), upper.max()) / self.step)

    @property
    def points(self) -> Float[np.ndarray, "XY 3"]:
        """The points of the lattice [m]."""
        at = np.indices(self.heights.shape).reshape(2, -1).T
        return np.column_stack([self.corner + self.step * at, self.heights.ravel()])

    @property
    def faces(self) -> Int[np.ndarray, "F 3"]:
        """The triangles, as numbers of :attr:`points`."""
        return lattice_faces(*self.heights.shape)


def lattice_faces(wide: int, deep: int) -> Int[np.ndarray, "F 3"]:
    """The triangles of a lattice of ``wide`` × ``deep`` points by number, cut as in
    :class:`Terrain`, counter-clockwise from above."""
    index = np.arange(wide * deep).reshape(wide, deep)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    return np.concatenate([np.stack(of, -1).reshape(-1, 3) for of in ((a, b, c), (a, c, d))])


def check_terrain(name: str) -> None:
    """Raise InspeError where there is no terrain of that name."""
    if name not in TERRAINS:
        raise InspeError(
            f"terrain '{name}': {' or '.join(TERRAINS)}{nearest(name, TERRAINS)}; a place takes "
            "its heights from an elevation model with --elevation FILE"
        )


def lattice(
    center: Sequence[float] | np.ndarray, radius: float
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "N 2"]]:
    """A lattice of :data:`STEP` to :data:`MARGIN` beyond a radius: its first point, and all."""
    half = int(np.ceil((radius + MARGIN) / STEP))
    corner = np.asarray(center, float)[:2] - half * STEP
    return corner, corner + STEP * np.indices((2 * half + 1,) * 2).reshape(2, -1).T


def terrain_of(place: Intersection, radius: float) -> Terrain | None:
    """The ground of a place to :data:`MARGIN` beyond ``radius`` [m]; None where it is level."""
    given = place.ground_points
    if not len(given) or np.ptp(given[:, 2]) < 1e-6:
        return None
    corner, at = lattice(place.center, radius)
    side = math.isqrt(len(at))
    return Terrain(corner, STEP, between(given, at).reshape(side, side))


def laid_on(place: Intersection, points: Float[np.ndarray, "G 3"], radius: float) -> Intersection:
    """A place on the surface :func:`between` points, to :data:`MARGIN` beyond ``radius`` [m]."""
    _, at = lattice(place.center, radius)
    return place.standing_on(np.column_stack([at, between(points, at)]))


def between(given: Float[np.ndarray, "G 3"], at: Float[np.ndarray, "N 2"]) -> np.ndarray:
    """Heights (N,) of a surface through given points, linear in Delaunay triangles; beyond their
    hull that of the nearest place on its rim. Points at one place have their mean height."""
    # Here, because their import takes a tenth of a second.
    from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

    plan, same = np.unique(np.round(given[:, :2], 3), axis=0, return_inverse=True)
    known = np.bincount(same.ravel(), given[:, 2]) / np.bincount(same.ravel())
    try:
        surface = LinearNDInterpolator(plan, known)
    except (scipy.spatial.QhullError, ValueError):  # fewer than three, or all on one line
        return np.asarray(NearestNDInterpolator(plan, known)(at))
    # It solves two equations for each triangle, at each of which OpenBLAS's threads wait for each
    # other, also while another process has their cores.
    with _one_thread():
        heights = surface(at)
    out = np.flatnonzero(np.isnan(heights))
    if len(out):
        rim = shapely.MultiPoint(plan).convex_hull.exterior.simplify(0.0)
        along = shapely.line_locate_point(rim, shapely.points(at[out]))
        ends = shapely.get_coordinates(shapely.line_interpolate_point(rim, along))
        # A little inward, where it is known.
        heights[out] = surface(ends + 1e-6 * (plan.mean(0) - ends))
    missing = np.isnan(heights)
    heights[missing] = NearestNDInterpolator(plan, known)(at[missing])
    return np.asarray(heights)


def _one_thread() -> AbstractContextManager[object]:
    """For BLAS in the block; threadpoolctl comes with the extras ``geo`` and ``sumo``."""
    try:
        from threadpoolctl import threadpool_limits
    except ImportError:
        return nullcontext()
    return threadpool_limits(1, user_api="blas")
