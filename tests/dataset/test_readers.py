"""What HEAL's, CoAlign's and OpenCOOD's readers need of a set, by their own rules."""

import numpy as np
import pytest
from frames import WORLD, car, frame, image, scan, station
from opv2v_validator import box_in_lidar, check_scenario, corners_in_lidar, load
from PIL import Image

from inspe_jax.core.carla_frame import to_carla
from inspe_jax.dataset import FileOptions, Station, write_frame, write_protocol
from inspe_jax.dataset.formats.other_readers import lidar_range
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


def readers_pixel(thing: dict, lidar_pose) -> tuple[int, int]:
    x, y, _ = box_in_lidar(thing, lidar_pose)[1]
    return 127 - int(x / 0.39), 127 + int(y / 0.39)


def test_visibility_maps(tmp_path):
    """A box is kept where one camera of the agent shows it, and only there. The first agent's
    cameras show every third box, the other's did not count pixels."""
    places = [(x, y) for x in range(-30, 60, 11) for y in range(-30, 50, 9)]
    boxes = [
        car(k, center=np.array([*place, 0.75]), yaw=0.3 * k, size=np.array([3.6, 1.65, 1.5]))
        for k, place in enumerate(places)
    ]
    shown = np.arange(len(boxes)) % 3 == 0
    first = station(1, cameras=0, layers=False)
    counted = [np.where(shown & (np.arange(len(boxes)) % 2 == i), 5, 0) for i in (0, 1)]
    looks = tuple(image(layers=False, pixels=pixels, share=pixels / 5) for pixels in counted)
    other = Station(2, "not counted", first.pose, (image(layers=False),), ())
    stations = [Station(1, "counted", first.pose, looks, first.scans), other]
    given = frame(boxes=boxes, stations=stations)
    write_protocol(tmp_path, {"world": WORLD})
    paths = write_frame(tmp_path, given, options=FileOptions(visibility_maps=True))
    maps = [path for path in paths if path.name == "000068_bev_visibility.png"]
    assert len(maps) == 2
    check_scenario(tmp_path, lidar_range=(-200, -200, -8, 200, 200, 0))
    for path, seen in zip(maps, (shown, np.ones(len(boxes), bool)), strict=True):
        content = load(path.with_name("000068.yaml"))
        with Image.open(path) as picture:
            found = np.array(picture)
        things = [content["vehicles"][k] for k in range(len(boxes))]
        at = np.array([readers_pixel(thing, content["lidar_pose"]) for thing in things])
        inside = ((at >= 0) & (at < 256)).all(1)
        assert inside.sum() > 60
        white = found[tuple(at[inside].T)] > 0
        np.testing.assert_array_equal(white, seen[inside])
        assert 15 < found.astype(bool).sum() / white.sum() < 60  # 3.6 × 1.65 m are 39 pixels
