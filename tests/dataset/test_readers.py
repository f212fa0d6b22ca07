"""What HEAL's, CoAlign's and OpenCOOD's readers need of a set, by their own rules."""

import numpy as np
import pytest
from frames import car, scan
from opv2v_validator import corners_in_lidar

from inspe_jax.core.carla_frame import to_carla
from inspe_jax.dataset import Station
from inspe_jax.dataset.formats.ranges import lidar_range
from inspe_jax.scene.voxels import VoxelGrid

TILTED = np.array([14.0, -11.0, 6.2, np.radians(4), np.radians(-12), np.radians(-150)])
AGENTS = (
    Station(1, "LiDAR", TILTED, (), (scan(pose=TILTED),)),
    Station(2, "camera alone", np.array([-12.0, 9.0, -0.3, 0, 0, 2.0]), (), ()),
)
"""A LiDAR that leans, 6 m up, and a unit on the ground."""


def region(radius: float = 50.0, slope: float = 0.03) -> VoxelGrid:
    """Columns 1 m apart over a disc whose ground rises along x."""
    line = np.arange(-radius, radius) + 0.5
    columns = np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)
    columns = columns[np.hypot(*columns.T) <= radius]
    kinds = np.zeros(len(columns), int)
    ground = slope * columns[:, 0]
    return VoxelGrid(columns, ground, kinds, np.zeros(3), 1.0, radius, 4, 1.0)


def kept(box, agent: Station, limits) -> bool:
    """Whether readers keep a box: all its corners are in range, in the frame of ``lidar_pose``."""
    cords = to_carla([*box.center, 0.0, 0.0, box.yaw])
    thing = dict(location=cords[:3], center=[0, 0, 0], angle=cords[3:], extent=box.size / 2)
    pose = agent.scans[0].pose if agent.scans else agent.pose
    at = corners_in_lidar(thing, to_carla(pose))
    return bool(((at >= limits[:3]) & (at <= limits[3:])).all())


def test_the_range_holds_the_longest_road_users_as_a_whole():
    """Road trains on every 40th column, in all directions, half of each beyond the region's rim."""
    voxels, rng = region(), np.random.default_rng(0)
    limits = lidar_range(AGENTS, voxels)
    size = np.array([18.75, 2.55, 4.0])
    for (x, y), ground in zip(voxels.columns[::40], voxels.ground[::40], strict=True):
        middle = np.array([x, y, ground + size[2] / 2])
        train = car(size=size, center=middle, yaw=rng.uniform(0, 2 * np.pi))
        assert all(kept(train, agent, limits) for agent in AGENTS)
    assert not kept(car(center=np.array([90.0, 0, 0.75])), AGENTS[0], limits)


def test_the_range_is_one_grid_for_all_agents():
    """As wide as the agents need together, the same on four sides, in steps of 16 pillars."""
    voxels = region(slope=0.0)
    each, both = [lidar_range([agent], voxels) for agent in AGENTS], lidar_range(AGENTS, voxels)
    assert both == [*np.min(each, 0)[:3], *np.max(each, 0)[3:]]
    assert both[3] == both[4] == -both[0] == -both[1]
    assert both[3] / 6.4 == pytest.approx(round(both[3] / 6.4))
    assert each[1][2:6:3] == [-1.0, 6.0]  # ground 0.3 m above the unit, half a metre spare; 5 m
    upright = Station(3, "upright", np.array([0, 0, 6.2, 0, 0, 0.0]), (), ())
    assert lidar_range([upright], voxels) == [-64.0, -64.0, -7.0, 64.0, 64.0, -1.0]
