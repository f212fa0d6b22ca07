"""What sensors look at, in plan."""

import numpy as np
import shapely
from jaxtyping import Float

from inspe_jax.core.geometry import rotation
from inspe_jax.scene.placed_bodies import convex_parts
from inspe_jax.scene.scene import Scene
from inspe_jax.sensing.sensors import Spec

FAN = 97, 33  # rows and columns of the rays that outline a camera's view
HIDING = ("building", "wall", "solid")
"""Kinds of bodies that a drawn view ends at. The others are small, or let light through."""
FARTHEST = 100.0  # a shadow on the ground ends at most this many times as far away as what casts it


def view_outline(
    spec: Spec, pose: Float[np.ndarray, "6"], level: float
) -> Float[np.ndarray, "N 2"]:
    """Closed outline [m] in plan of what a sensor looks at, above level ground at ``level``: of
    one that is aimed, its rays to where they meet level ground or end; of others a sector from the
    sensor up to the reach, or a circle."""
    if spec.aimed:
        points = np.vstack([pose[:2], _ray_ends(spec, pose, level)])
        return shapely.get_coordinates(shapely.convex_hull(shapely.multipoints(points)))
    (right, left), whole = spec.azimuth_limits, spec.grid.wraps
    count = max(2, int(np.ceil((left - right) / np.radians(2)))) + 1
    angle = pose[5] + np.linspace(right, left, count)
    arc = pose[:2] + spec.grid.reach * np.column_stack([np.cos(angle), np.sin(angle)])
    return arc if whole else np.vstack([pose[:2], arc, pose[:2]])


def clear_outlines(
    scene: Scene, spec: Spec, pose: Float[np.ndarray, "6"]
) -> list[Float[np.ndarray, "N 2"]]:
    """:func:`view_outline` less the ground that houses and walls hide, below the sight lines over
    their tops, as closed rings [m]. A body beneath the sensor hides nothing here."""
    level = float(scene.intersection.ground(pose[None, :2])[0])
    ring, high = view_outline(spec, pose, level), pose[2] - level
    bodies = [one for one in scene.statics if one.kind in HIDING and one.base == 0]
    if len(ring) < 4 or high <= 0 or not bodies:
        return [ring]
    view = shapely.make_valid(shapely.Polygon(ring))
    parts = convex_parts(bodies, scene.intersection)
    beyond = high / np.maximum(high - (parts.top - level), high / FARTHEST)  # of a shadow's end
    ends = pose[:2] + beyond[:, None, None] * (parts.corners - pose[:2])
    corners = np.concatenate([parts.corners, ends], 1)
    shadows = shapely.convex_hull(shapely.multipoints(list(corners)))
    hides = (parts.top > level) & shapely.intersects(shadows, view)
    hides &= ~shapely.contains_xy(shadows, *pose[:2])
    left = shapely.difference(view, shapely.union_all(shadows[hides]))
    return [shapely.get_coordinates(ring) for ring in shapely.get_rings(shapely.get_parts(left))]


def _ray_ends(spec: Spec, pose: Float[np.ndarray, "6"], level: float) -> Float[np.ndarray, "N 2"]:
    """Where rays all over the field of view end in plan [m]: at their reach or on the ground."""
    grid, half = spec.grid, spec.grid.column_step / 2
    first, last = grid.column_limits
    low, high = grid.outer_rows
    rows = np.linspace(low, high, FAN[0])
    row, column = np.meshgrid(rows, np.linspace(first - half, last + half, FAN[1]), indexing="ij")
    ways = np.stack(grid.rays.direction(row.ravel(), column.ravel(), np), -1)
    ways = ways @ rotation(pose[3:], np).T
    down = np.maximum(-ways[:, 2], 1e-9)
    far = np.minimum(grid.reach, np.maximum(pose[2] - level, 0.0) / down)
    return pose[:2] + far[:, None] * ways[:, :2]
