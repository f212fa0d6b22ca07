"""Static bodies on the ground of a place: their convex parts, and what is inside them."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int
from shapely.geometry import Point, Polygon

from inspe_jax.core.errors import InspeError
from inspe_jax.scene.intersection import Intersection
from inspe_jax.scene.statics import CORNERS, StaticBody, octagon
from inspe_jax.scene.voxels import VoxelGrid

AT_SURFACE = 1e-3  # a sensor so near a side of a body is in it [m], for single precision
SWALLOWED = 0.5  # a body on more than this share of the region of interest is taken for an error


class ConvexParts(NamedTuple):
    """P convex prisms that bodies consist of, in world metres. ``corners`` are counter-clockwise,
    the last repeated. ``bottom`` is −∞ for what stands on the ground. ``body`` is the body's
    index."""

    corners: Float[np.ndarray, "P K 2"]
    bottom: Float[np.ndarray, " P"]
    top: Float[np.ndarray, " P"]
    transmittance: Float[np.ndarray, " P"]
    body: Int[np.ndarray, " P"]


def convex_parts(bodies: Sequence[StaticBody], place: Intersection) -> ConvexParts:
    """The bodies as convex prisms on the ground of a place."""
    rows: list[tuple[np.ndarray, float, float, float, int]] = []
    ground = grounds(bodies, place)
    for k, (one, level) in enumerate(zip(bodies, ground, strict=True)):
        bottom = level + one.base if one.base > 0 else -np.inf
        for piece in one.pieces:
            rows.append((piece, bottom, level + one.height, one.transmittance, k))
        if one.trunk > 0:
            rows.append((octagon(one.middle, one.trunk), -np.inf, level + one.base, 0.0, k))
    corners = [row[0][np.minimum(np.arange(CORNERS), len(row[0]) - 1)] for row in rows]
    bottom, top, through, number = np.array([row[1:] for row in rows], float).reshape(-1, 4).T
    rings = np.array(corners, float).reshape(-1, CORNERS, 2)
    return ConvexParts(rings, bottom, top, through, number.astype(int))


def grounds(bodies: Sequence[StaticBody], place: Intersection) -> Float[np.ndarray, " N"]:
    """The height of the ground in the middle of each body [m]."""
    return place.ground(np.array([one.middle for one in bodies]).reshape(-1, 2))


def _solids(one: StaticBody, ground: float) -> Iterator[tuple[Polygon, float, float]]:
    """The prisms (outline, bottom, top) of a body whole: on a seam of its pieces is inside it."""
    yield one.polygon, ground + one.base if one.base > 0 else -np.inf, ground + one.height
    if one.trunk > 0:
        yield Polygon(octagon(one.middle, one.trunk)), -np.inf, ground + one.base


def inside_bodies(
    bodies: Sequence[StaticBody], place: Intersection, grid: VoxelGrid
) -> Bool[np.ndarray, "L Z"]:
    """Whether each voxel's centre is in a body. Raises InspeError if one swallows the region."""
    found = np.zeros((len(grid.columns), grid.level_count), bool)
    heights = grid.ground[:, None] + grid.levels  # (L, Z)
    x, y = grid.columns.T
    for one, ground in zip(bodies, grounds(bodies, place), strict=True):
        for shape, bottom, top in _solids(one, float(ground)):
            west, south, east, north = shape.bounds
            at = np.flatnonzero((x > west) & (x < east) & (y > south) & (y < north))
            at = at[shapely.contains_xy(shape, x[at], y[at])]
            found[at] |= (heights[at] > bottom) & (heights[at] < top)
            if len(at) > SWALLOWED * len(x):
                raise InspeError(
                    f"{one.words} stands on {len(at) / len(x):.0%} of the region of interest of "
                    f"{place.name}; is it in the same coordinates, and meant in metres?"
                )
    if found.all():
        raise InspeError(f"{place.name}: its bodies leave nothing of the region of interest")
    return found


def body_at(
    bodies: Sequence[StaticBody], place: Intersection, point: Float[np.ndarray, "3"]
) -> StaticBody | None:
    """The body that a point [m] is inside of, or less than :data:`AT_SURFACE` beside, if any."""
    here = Point(point[0], point[1])
    outlines = np.array([one.polygon for one in bodies], object)
    found = np.flatnonzero(shapely.dwithin(outlines, here, AT_SURFACE))
    near = [bodies[n] for n in found.tolist()]
    for one, ground in zip(near, grounds(near, place), strict=True):
        for shape, bottom, top in _solids(one, float(ground)):
            if bottom < point[2] < top and shape.dwithin(here, AT_SURFACE):
                return one
    return None
