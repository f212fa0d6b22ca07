"""Statistics of small data sets, by hand and by brute force, and the figures and tables of sets."""

import json
from dataclasses import replace

import numpy as np
import pytest
from drawn import printed
from frames import AHEAD, CAMERA, LEVEL, WORLD, car, image, scan, station
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

import inspe_jax.dataset as dataset
from inspe_jax.core.geometry import rotation
from inspe_jax.core.sheet import CLASS_COLORS
from inspe_jax.dataset import Frame, Image, Scan, Station, write_frame, write_protocol
from inspe_jax.dataset.figure import statistics_view
from inspe_jax.dataset.frame_figure import frame_view
from inspe_jax.dataset.points_in_boxes import SLACK, count_inside
from inspe_jax.dataset.statistics import RANGE_EDGES, PointCounts, bands, statistics, table_row
from inspe_jax.dataset.tables import frame_table, statistics_record, statistics_table
from inspe_jax.simulation.frame import KINDS

FLAT = np.array([0.0, 0.0, 5.0, 0.0, 0.0, 0.0])


def scan_of(world_points, pose=FLAT) -> Scan:
    body = (np.asarray(world_points, float) - pose[:3]) @ rotation(np.asarray(pose)[3:], np)
    return Scan(np.asarray(pose), np.column_stack([body, np.zeros(len(body))]).astype(np.float32))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Two scenarios to train, of two frames and of one, and one to test. Station 1 has a camera,
    and a LiDAR 10 m from a car, with 2 of its 3 points in it; station 2 a LiDAR, with one."""
    root = tmp_path_factory.mktemp("sets") / "made"
    near, far = FLAT + [0, 10, -4, 0, 0, 1], FLAT + [0, -20, -4, 0, 0, 2]
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
    for i, own_scan in enumerate(scans):
        turn = rotation(own_scan.pose[3:], np)
        for k, box in enumerate(boxes):
            for point in own_scan.points[:, :3]:
                place = turn @ point.astype(float) + own_scan.pose[:3]
                own = rotation(np.array([0, 0, box.yaw]), np).T @ (place - box.center)
                beyond = np.abs(own[:2]) - box.size[:2] / 2
                top, bottom = own[2] - box.size[2] / 2, own[2] + box.size[2] / 2
                expected[i, k] += (beyond <= SLACK).all() and top <= SLACK and bottom >= SLACK
    np.testing.assert_array_equal(count_inside(scans, boxes), expected)

    assert count_inside([], boxes).shape == (0, 7)
    assert count_inside(scans, []).shape == (3, 0)


BEHIND = car(2, kind="truck", center=np.array([-20.0, 0.0, 2.0]), size=np.array([9.0, 2.5, 4.0]))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A scenario of six frames with two road users, one of them ahead of a level camera."""
    root = tmp_path_factory.mktemp("sets") / "seen"
    masts = (Station(1, "mast", LEVEL, (CAMERA,), (scan(200, LEVEL),)), station(2, layers=False))
    for number in range(6):
        write_frame(root / "test" / "a", Frame(number, 0.05 * number, (AHEAD, BEHIND), masts))
    write_protocol(root / "test" / "a", {"world": WORLD}, masts)
    return root


@pytest.fixture(scope="module")
def found(folder):
    return statistics(folder)


@pytest.fixture
def scenario(folder):
    return dataset.open(folder).scenario()


def panels(fig: Figure) -> dict[str, list]:
    by: dict[str, list] = {}
    for ax in fig.axes:
        by.setdefault(ax.get_title(loc="left"), []).append(ax)
    return by


def words(fig: Figure) -> str:
    return "\n".join(text.get_text() for text in fig.texts)


def test_counts_of_a_set_are_drawn(found):
    fig = statistics_view(found)
    (ax,) = panels(fig)["Objects per class"]
    assert [bar.get_width() for bar in ax.patches] == [6, 6, 0, 0]
    assert [to_hex(bar.get_facecolor()) for bar in ax.patches] == list(CLASS_COLORS)
    assert [text.get_text() for text in ax.texts] == ["6 (1)", "6 (1)", "0", "0"]
    (ax,) = panels(fig)["Objects per frame"]
    assert sum(bar.get_height() for bar in ax.patches) == 6
    assert "mean 2.0" in ax.get_xlabel()
    assert "1 split, 1 scenario, 6 frames, 12 boxes of 2 road users" in words(fig)
    assert "18 images, 12 point clouds of 125 points on average" in words(fig)


def test_sets_without_point_clouds_or_road_users(tmp_path):
    write_frame(tmp_path / "a", Frame(1, 0.05, (), (station(),)))
    write_frame(tmp_path / "b", Frame(1, 0.05, (AHEAD,), (station(),)))  # no point is on it
    write_frame(tmp_path / "c", Frame(1, 0.05, (AHEAD,), (station(lidars=0),)))
    empty, missed, blind = (statistics(tmp_path / name) for name in "abc")
    assert (empty.crowd.tolist(), empty.users.size.shape) == ([0], (0, 3))
    assert sum(empty.boxes.values()) == 0
    assert (blind.total.clouds, blind.total.points, blind.mean_points) == (0, 0, None)
    assert bands(blind.points, 0) == ()
    empty, missed, blind = map(statistics_view, (empty, missed, blind))
    for fig in (empty, missed, blind):
        fig.draw_without_rendering()
    assert not len(panels(empty)["Length"][0].patches)
    assert "pedestrian" in panels(missed)
    assert "car" not in panels(blind)
    assert "The data set has no point clouds" in words(blind)


def test_boxes_that_no_pixel_shows_are_dotted(tmp_path):
    instance = np.zeros((600, 800), np.int32)
    instance[300, 400] = AHEAD.track + 1
    beside = replace(AHEAD, track=4, center=np.array([10.0, 5.0, 1.0]))
    told = Image(LEVEL, CAMERA.intrinsic, CAMERA.rgb, None, instance, None)
    masts = (Station(1, "mast", LEVEL, (told,), ()),)
    write_frame(tmp_path / "a", Frame(1, 0.05, (AHEAD, beside), masts))
    fig = frame_view(dataset.open(tmp_path / "a").scenario(), 1)
    (ax,) = panels(fig)["station 1, camera 0: 1 box"]
    dotted, full = ax.collections
    assert np.concatenate(full.get_segments())[:, 0].max() == pytest.approx(412.5)
    assert np.concatenate(dotted.get_segments())[:, 0].max() == pytest.approx(400 - 100 * 4 / 12)


def test_the_plan_has_points_boxes_and_stations(scenario):
    fig = frame_view(scenario, 3)
    plan = next(ax for ax in fig.axes if ax.get_xlabel() == "x, east [m]")
    cloud, boxes, heads = plan.collections
    assert 200 <= len(cloud.get_offsets()) <= 250
    assert (np.diff(cloud.get_array()) >= 0).all()  # the highest is drawn last
    car_, truck = (path.vertices[:4] for path in boxes.get_paths())
    np.testing.assert_allclose(car_.min(0), [8, -1], atol=1e-6)
    np.testing.assert_allclose(truck.max(0) - truck.min(0), [2.5, 9], atol=1e-6)  # faces north
    np.testing.assert_allclose(heads.get_segments()[0], [[10, 0], [12, 0]], atol=1e-6)
    assert [text.get_text() for text in plan.texts] == ["1", "2"]
    low, high = plan.get_xlim()
    assert low < -21.25
    assert high > 12
    assert "0.15 s; 2 objects; 2 stations" in words(fig)


def test_tables_and_the_record_have_the_counts(found, scenario):
    text = printed(statistics_table(found))
    assert "Data set seen" in text
    assert any(row.split()[:3] == ["car", "6", "1"] for row in text.splitlines())
    record = json.loads(json.dumps(statistics_record(found)))
    assert record["classes"]["truck"]["length"] == pytest.approx([9, 9, 9])
    assert record["classes"]["cyclist"]["length"] is None
    assert record["objects_per_frame"] == {"mean": 2, "least": 2, "most": 2}
    assert record["total"]["points"] == 1500
    assert sum(band["boxes"] for band in record["points"]["car"]) == 6
    rows = [row.split() for row in printed(frame_table(scenario, 0)).splitlines()]
    (row,) = (row for row in rows if row[:2] == ["2", "truck"])
    assert row[2:9] == ["-20.0", "0.0", "90", "10.0", "9.00", "2.50", "4.00"]
