"""The range of points and boxes that readers of OPV2V data sets should keep.

The readers' defaults, 3 m below the LiDAR to 1 m above it, are for one on the roof of a car: of a
LiDAR on a pole they keep no road user.
"""

from collections.abc import Sequence

import numpy as np

from inspe_jax.core.geometry import rotation
from inspe_jax.dataset.formats.agents import frame_of
from inspe_jax.scene.voxels import VoxelGrid
from inspe_jax.simulation.frame import Station

HIGHEST = 5.0
"""No road user is higher [m]: vehicles are limited to 4 m in most of Europe, 4.9 m in Britain."""
BEYOND = 9.5
"""How far a road user in the region may reach out of it [m]: half the diagonal of a road train,
18.75 m × 2.55 m, the longest vehicle of directive 96/53/EC."""
BELOW = 0.5
"""How far the ground out there may lie below the region's lowest [m]: 5 % over that length."""
STEP = 6.4
"""Limits along x and y are multiples of this [m]: 16 pillars of 0.4 m, so that networks can halve
their grid four times."""


def lidar_range(agents: Sequence[Station], voxels: VoxelGrid) -> list[float]:
    """The range that holds every road user of the region as a whole, seen from any agent.

    It is [x, y, z, x, y, z] [m], lower and upper limits in the frame of an agent's first LiDAR, or
    of its unit where it has none, the same on all four sides: what readers call
    ``cav_lidar_range``. They drop a box unless all of its corners lie inside, and may take any
    agent as the one in whose frame the boxes are.
    """
    ground = np.column_stack([voxels.columns, voxels.ground])
    around = np.concatenate([ground - [0.0, 0.0, BELOW], ground + [0.0, 0.0, HIGHEST]])
    side, low, high = 0.0, np.inf, -np.inf
    for agent in agents:
        pose = frame_of(agent)
        turn = rotation(pose[3:], np)
        at = (around - pose[:3]) @ turn  # (N, 3)
        tilted = BEYOND * float(np.hypot(*turn[:2, 2]))  # what BEYOND in plan is along z
        side = max(side, float(np.abs(at[:, :2]).max()) + BEYOND)
        low, high = min(low, at[:, 2].min() - tilted), max(high, at[:, 2].max() + tilted)
    side = round(float(np.ceil(side / STEP) * STEP), 1)
    return [-side, -side, float(np.floor(low)), side, side, float(np.ceil(high))]
