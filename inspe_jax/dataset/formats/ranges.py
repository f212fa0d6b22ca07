"""The range of points that readers of OPV2V data sets should keep, in the frame of each LiDAR.

The readers' defaults, 3 m below the LiDAR to 1 m above it, are for one on the roof of a car: of a
LiDAR on a pole they keep no road user.
"""

from collections.abc import Sequence

import numpy as np

from inspe_jax.core.geometry import rotation
from inspe_jax.scene.voxels import VoxelGrid
from inspe_jax.simulation.frame import Station

HIGHEST = 5.0
"""No road user is higher [m]: vehicles are limited to 4 m in most of Europe, 4.9 m in Britain."""
STEP = 6.4
"""Limits along x and y are multiples of this [m]: 16 pillars of 0.4 m, so that networks can halve
their grid four times."""


def lidar_ranges(agents: Sequence[Station], voxels: VoxelGrid) -> dict[int, list[float]]:
    """The range that holds every road user of the region, by the id of each agent.

    Each is [x, y, z, x, y, z] [m], lower and upper limits in the frame of the agent's first LiDAR,
    or of its unit where it has none, the same on all four sides. What readers call
    ``cav_lidar_range`` should hold that of the agent which is the ego.
    """
    found = {}
    ground = np.column_stack([voxels.columns, voxels.ground])
    around = np.concatenate([ground, ground + [0.0, 0.0, HIGHEST]])
    for agent in agents:
        pose = np.asarray(agent.scans[0].pose if agent.scans else agent.pose, float)
        at = (around - pose[:3]) @ rotation(pose[3:], np)
        side = float(np.ceil(np.abs(at[:, :2]).max() / STEP) * STEP)
        low, high = np.floor(at[:, 2].min()), np.ceil(at[:, 2].max())
        found[-agent.number] = [-side, -side, float(low), side, side, float(high)]
    return found
