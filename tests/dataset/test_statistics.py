"""Statistics of small data sets, compared with counts by hand and by brute force."""

from dataclasses import replace

import numpy as np
import pytest
from frames import WORLD, car, image
from hypothesis import given, settings
from hypothesis import strategies as st

import inspe_jax.dataset as dataset
from inspe_jax.core.geometry import rotation
from inspe_jax.dataset import Frame, Scan, Station, write_frame, write_protocol
from inspe_jax.dataset.points_in_boxes import SLACK, count_inside
from inspe_jax.dataset.statistics import RANGE_EDGES, PointCounts, bands, statistics, table_row
from inspe_jax.simulation.frame import KINDS

LEVEL = np.array([0.0, 0.0, 5.0, 0.0, 0.0, 0.0])


def scan_of(world_points, pose=LEVEL) -> Scan:
    body = (np.asarray(world_points, float) - pose[:3]) @ rotation(np.asarray(pose)[3:], np)
    return Scan(np.asarray(pose), np.column_stack([body, np.zeros(len(body))]).astype(np.float32))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Two scenarios to train, of two frames and of one, and one to test. Station 1 has a camera,
    and a LiDAR 10 m from a car, with 2 of its 3 points in it; station 2 a LiDAR, with one."""
    root = tmp_path_factory.mktemp("sets") / "made"
    near, far = LEVEL + [0, 10, -4, 0, 0, 1], LEVEL + [0, -20, -4, 0, 0, 2]
    box = car(1, center=np.array([0.0, 0.0, 1.0]), size=np.array([4.0, 2.0, 2.0]))
    other = car(2, kind="truck", center=np.array([100.0, 0.0, 2.0]), size=np.array([9.0, 2.5, 4.0]))
    one = scan_of([[0, 1.9, 1], [0.9, 0, 1], [5, 0, 1]], near)
    two = scan_of([[0, -1.9, 1]], far)
    stations = (
        Station(1, "near", near, (image(layers=False),), (one,)),
        Station(2, "far", far, (), (two,)),
    )
    protocol = {"world": WORLD}
    for place, numbers in (("train/a", (0, 2)), ("train/b", (7,)), ("test/a", (3,))):
        for number in numbers:
            boxes = (box, other) if number in (2, 7) else (box,)
            write_frame(root / place, Frame(number, 0.05 * number, boxes, stations))
        write_protocol(root / place, protocol, stations)
    return root


def test_the_counts_of_each_split_and_class(made):
    told = []
    found = statistics(made, lambda done, total: told.append((done, total)))
    assert told == [(1, 4), (2, 4), (3, 4), (4, 4)]
    of = ("name", "scenarios", "frames", "agents", "images", "clouds", "points", "boxes")
    assert [tuple(getattr(split, key) for key in of) for split in (*found.splits, found.total)] == [
        ("train", 2, 3, 4, 3, 6, 12, 5), ("test", 1, 1, 2, 1, 2, 4, 1),
        ("all", 3, 4, 6, 4, 8, 16, 6),
    ]  # fmt: skip
    assert found.mean_points == 2.0
    assert sorted(found.crowd.tolist()) == [1, 1, 2, 2]
    assert (found.cameras, found.lidars) == ((1, 1), (2, 2))
    assert found.boxes == {"car": 4, "truck": 2, "cyclist": 0, "pedestrian": 0}
    assert found.tracks == {"car": 3, "truck": 2, "cyclist": 0, "pedestrian": 0}
    trucks = found.users.size[found.users.kind == KINDS.index("truck")]
    np.testing.assert_allclose(trucks, [[9, 2.5, 4]] * 2, atol=1e-6)
    assert statistics(made / "train").total.frames == 3
    assert statistics(dataset.open(made / "train" / "b")).total.frames == 1


def test_points_of_all_scans(made):
    found = statistics(made).points
    cars = found.kind == 0
    np.testing.assert_allclose(found.range[cars], 10)
    assert found.points[cars].tolist() == [3] * 4
    assert found.points[~cars].tolist() == [0, 0]


def test_a_row_of_a_table(made):
    found = statistics(made)
    assert table_row(found) == {
        "name": "made", "V2X": "I2I", "cameras": 1, "LiDARs": 2, "frames": 4, "images": 4,
        "point clouds": 8, "3D boxes": 6, "classes": 2, "scenarios": 3, "maps": 1,
    }  # fmt: skip
    bare = table_row(replace(found, towns=frozenset({None, "x"}), cameras=(4, 6)))
    assert (bare["maps"], bare["cameras"]) == (None, "4–6")
    for agents, kind in (
        ((-1, 641), "V2X"), ((641, 9), "V2V"), ((-1, -2), "I2I"), ((641,), "V"), ((-1,), "I"),
    ):  # fmt: skip
        assert table_row(replace(found, agents=(agents,)))["V2X"] == kind


def test_bands_of_range():
    """Of five boxes between 7.07 and 10 m four have points: 1, 2, 3 and 4."""
    away = np.array([8.0, 8, 8, 9, 9, 0.1, 1e4, 8])
    points = np.array([0, 1, 2, 3, 4, 0, 7, 99])
    kind = np.array([0, 0, 0, 0, 0, 0, 0, 1])
    near, middle, far = bands(PointCounts(kind, away, points), 0)
    assert (near.low, far.high) == (RANGE_EDGES[0], RANGE_EDGES[-1])
    assert (near.boxes, near.share, near.quartiles) == (1, 0.0, None)
    assert (middle.boxes, middle.share, middle.quartiles) == (5, 0.8, (1.75, 2.5, 3.25))
    assert middle.low == pytest.approx(50**0.5)
    assert middle.high == pytest.approx(10)
    assert far.quartiles == (7, 7, 7)
    assert bands(PointCounts(kind, away, points), 2) == ()


def test_points_in_a_turned_box():
    """4 m long, 2 m wide, 2 m high, turned by 30°: the ends of its axes are inside."""
    box = car(center=np.array([10.0, 5.0, 1.0]), yaw=np.pi / 6, size=np.array([4.0, 2.0, 2.0]))
    ahead, left = np.array([3**0.5 / 2, 0.5, 0]), np.array([-0.5, 3**0.5 / 2, 0])
    middle, up = box.center, np.array([0.0, 0.0, 1.0])
    within = [np.zeros(3), 1.99 * ahead, -0.99 * left, 1.9 * ahead + 0.9 * left]
    inside = [middle + at for at in within]
    outside = [middle + at for at in (2.01 * ahead, 1.01 * left, np.array([1.9, 0.9, 0]))]
    faces = [middle + 2 * ahead, middle - left, middle + up]
    road = [middle - up, middle - up + 0.0005]
    for points, count in ((inside, 4), (outside, 0), (faces, 3), (road, 0)):
        pose = np.array([3.0, -2.0, 6.0, 0.1, -0.3, 2.0])
        assert count_inside([scan_of(points, pose)], [box]).tolist() == [[count]]


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_points_in_boxes_against_every_pair(seed):
    rng = np.random.default_rng(seed)
    scans = []
    for many in (400, 0, 250):
        pose = np.array([*rng.uniform(-5, 5, 3), *rng.uniform(-0.3, 0.3, 2), rng.uniform(-4, 4)])
        scans.append(scan_of(rng.uniform([-12, -12, -2], [12, 12, 3], (many, 3)), pose))
    boxes = []
    for track in range(7):
        center, yaw = rng.uniform([-10, -10, 0], [10, 10, 2]), rng.uniform(-7, 7)
        boxes.append(car(track, center=center, yaw=yaw, size=rng.uniform(0.4, 9.0, 3)))
    expected = np.zeros((3, 7), int)
    for i, scan in enumerate(scans):
        turn = rotation(scan.pose[3:], np)
        for k, box in enumerate(boxes):
            for point in scan.points[:, :3]:
                place = turn @ point.astype(float) + scan.pose[:3]
                own = rotation(np.array([0, 0, box.yaw]), np).T @ (place - box.center)
                beyond = np.abs(own[:2]) - box.size[:2] / 2
                top, bottom = own[2] - box.size[2] / 2, own[2] + box.size[2] / 2
                expected[i, k] += (beyond <= SLACK).all() and top <= SLACK and bottom >= SLACK
    np.testing.assert_array_equal(count_inside(scans, boxes), expected)

    assert count_inside([], boxes).shape == (0, 7)
    assert count_inside(scans, []).shape == (3, 0)
