"""What sensors look at, in plan."""

import numpy as np
import shapely
from jaxtyping import Float

from inspe_jax.core.geometry import rotation
from inspe_jax.sensing.sensors import Spec

FAN = 97, 33
"""Rows and columns of the rays that outline a camera's view."""


def view_outline(
    spec: Spec, pose: Float[np.ndarray, "6"], level: float
) -> Float[np.ndarray, "N 2"]:
    """Closed outline [m] in plan of what a sensor looks at, above the ground at height ``level``.

    Of a camera, which is aimed, its rays to where they meet level ground or end. Of others a sector
    of the horizontal field of view, up to the reach, that begins and ends at the sensor; or a
    circle for a sensor that looks all round.
    """
    if spec.aimed:
        points = np.vstack([pose[:2], _ray_ends(spec, pose, level)])
        return shapely.get_coordinates(shapely.convex_hull(shapely.multipoints(points)))
    (right, left), whole = spec.azimuth_limits, spec.grid.wraps
    count = max(2, int(np.ceil((left - right) / np.radians(2)))) + 1
    angle = pose[5] + np.linspace(right, left, count)
    arc = pose[:2] + spec.grid.reach * np.column_stack([np.cos(angle), np.sin(angle)])
    return arc if whole else np.vstack([pose[:2], arc, pose[:2]])


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
