"""Small frames of a data set, by hand and at random, and a comparison of two frames."""

import numpy as np
from hypothesis import strategies as st

from inspe_jax.dataset import Frame, Image, RoadUserBox, Scan, Station
from inspe_jax.simulation.frame import KINDS, MOST_TRACK

WORLD = dict(fixed_delta_seconds=0.05, client_port=2000, seed=7, town="four_way")
WORLD["weather"] = {"cloudiness": 10.0}
"""The keys that a protocol must have."""

UNIT = np.array([12.0, 8.0, 6.0, 0.0, 0.0, np.radians(-150)])
"""The pose of a unit, 6 m up and looking south-west."""


LEVEL = np.array([0.0, 0.0, 6.0, 0.0, 0.0, 0.0])
INTRINSIC = np.array([[100.0, 0, 400], [0, 100.0, 300], [0, 0, 1]])
CAMERA = Image(LEVEL, INTRINSIC, np.zeros((600, 800, 3), np.uint8))
"""A level camera 6 m up that looks east, of 800 × 600 pixels and a focal length of 100."""


def car(track: int = 3, **changes) -> RoadUserBox:
    """A car on the ground at (10, 20), facing north at 10 m/s."""
    values = dict(track=track, kind="car", name="vehicle.audi.tt", yaw=np.pi / 2)
    values |= dict(center=np.array([10.0, 20.0, 0.75]), size=np.array([4.2, 1.8, 1.5]))
    values |= dict(velocity=np.array([0.0, 10.0, 0.0]))
    return RoadUserBox(**values | changes)


AHEAD = car(1, center=np.array([10.0, 0.0, 1.0]), yaw=0.0, size=np.array([4.0, 2.0, 2.0]))
"""A car from 8 m to 12 m before :data:`CAMERA`, 1 m to each side, 2 m high."""


def image(
    width: int = 8, height: int = 6, pose=UNIT, layers: bool = True, seed: int = 0, **counts
) -> Image:
    """A picture of noise, with every layer or none; depth in whole centimetres, some infinite."""
    rng = np.random.default_rng(seed)
    shape = (height, width)
    depth = (rng.integers(0, 20_000, shape) / 100).astype(np.float32)
    depth[0, 0] = np.inf
    extra = {
        "depth": depth,
        "instance": rng.integers(0, MOST_TRACK + 2, shape).astype(np.int32),
        "semantic": rng.integers(0, 256, shape).astype(np.uint8),
    }
    intrinsic = np.array([[5.0, 0, width / 2], [0, 5.0, height / 2], [0, 0, 1]])
    rgb = rng.integers(0, 256, (*shape, 3)).astype(np.uint8)
    return Image(np.asarray(pose), intrinsic, rgb, **(extra if layers else {}), **counts)


def scan(count: int = 50, pose=UNIT, seed: int = 0) -> Scan:
    """Points below and around a LiDAR; one byte holds each intensity exactly."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-20, -20, -7, 0], [20, 20, -1, 1], (count, 4))
    points[:, 3] = np.rint(points[:, 3] * 255) / 255
    return Scan(np.asarray(pose), points.astype(np.float32))


def station(number: int = 1, cameras: int = 2, lidars: int = 1, layers: bool = True) -> Station:
    """A station whose cameras and LiDARs are close to its pose."""
    poses = UNIT + np.linspace(0.1, 0.4, cameras + lidars + 1)[:, None]
    images = tuple(image(pose=poses[i], layers=layers, seed=i) for i in range(cameras))
    scans = tuple(scan(pose=poses[cameras + i], seed=i) for i in range(lidars))
    return Station(number, f"mast {number}", UNIT, images, scans)


def frame(number: int = 68, boxes=None, stations=None) -> Frame:
    """A car, a truck, a cyclist and a pedestrian, seen by two stations."""
    if boxes is None:
        kinds = {"car": 3, "truck": 40, "cyclist": 7, "pedestrian": 0}
        boxes = [car(track, kind=kind, name=f"a {kind}") for kind, track in kinds.items()]
    stations = (station(1), station(2)) if stations is None else stations
    return Frame(number, number * 0.05, tuple(boxes), tuple(stations))


def assert_same(read: Frame, given: Frame) -> None:
    """Two frames agree as far as files can tell: lengths to 1e-6 m and angles to 1e-6 °; speeds,
    but not their directions; intensities to half of 1/255, depths to half a centimetre."""
    assert read.number == given.number
    assert read.time == given.number * 0.05
    ordered = sorted(given.boxes, key=lambda box: box.track)
    assert [t.track for t in read.boxes] == [t.track for t in ordered]
    for a, b in zip(read.boxes, ordered, strict=True):
        assert (a.kind, a.name) == (b.kind, b.name)
        np.testing.assert_allclose(a.center, b.center, atol=1e-6, rtol=0)
        np.testing.assert_allclose(a.size, b.size, atol=1e-6, rtol=0)
        assert abs(a.yaw - b.yaw) <= np.radians(1e-6)
        assert abs(np.linalg.norm(a.velocity) - np.linalg.norm(b.velocity)) <= 1e-6
    stations = sorted(given.stations, key=lambda station: station.number)
    assert [s.number for s in read.stations] == [s.number for s in stations]
    for a, b in zip(read.stations, stations, strict=True):
        assert_same_pose(a.pose, b.pose)
        assert len(a.images) == len(b.images)
        assert len(a.scans) == len(b.scans)
        for x, y in zip(a.images, b.images, strict=True):
            assert_same_image(x, y)
        for x, y in zip(a.scans, b.scans, strict=True):
            assert_same_pose(x.pose, y.pose)
            np.testing.assert_array_equal(x.points[:, :3], y.points[:, :3])
            np.testing.assert_allclose(x.points[:, 3], y.points[:, 3], atol=0.501 / 255, rtol=0)


def assert_same_pose(read, given) -> None:
    np.testing.assert_allclose(read[:3], given[:3], atol=1e-6, rtol=0)
    np.testing.assert_allclose(read[3:], given[3:], atol=np.radians(1e-6), rtol=0)


def assert_same_image(read: Image, given: Image) -> None:
    assert_same_pose(read.pose, given.pose)
    np.testing.assert_allclose(read.intrinsic, given.intrinsic, atol=1e-9, rtol=0)
    np.testing.assert_array_equal(read.rgb, given.rgb)
    for layer in ("depth", "instance", "semantic"):
        a, b = getattr(read, layer), getattr(given, layer)
        assert (a is None) == (b is None), layer
        if b is not None:
            np.testing.assert_allclose(a, b, atol=0.00501 if layer == "depth" else 0, rtol=1e-6)


def vectors(low: list[float], high: list[float]) -> st.SearchStrategy[np.ndarray]:
    each = [st.floats(a, b) for a, b in zip(low, high, strict=True)]
    return st.tuples(*each).map(np.array)


POSES = vectors([-2000, -2000, -50, -4, -1.5, -7], [2000, 2000, 50, 4, 1.5, 7])
"""Poses anywhere on a map, with any angles, also of more than a full turn."""

BOXES = st.builds(
    RoadUserBox,
    track=st.integers(0, MOST_TRACK),
    kind=st.sampled_from(KINDS),
    name=st.text(max_size=12),
    center=vectors([-2000, -2000, -50], [2000, 2000, 50]),
    yaw=st.floats(-7, 7),
    size=vectors([0.1, 0.1, 0.1], [30, 5, 5]),
    velocity=vectors([-40, -40, -5], [40, 40, 5]),
)
IMAGES = st.builds(image, st.integers(1, 5), st.integers(1, 5), POSES, st.booleans())
SCANS = st.builds(scan, st.integers(0, 5), POSES, st.integers(0, 99))
STATIONS = st.builds(
    Station,
    number=st.integers(1, 12),
    name=st.text(max_size=12),
    pose=POSES,
    images=st.lists(IMAGES, max_size=2).map(tuple),
    scans=st.lists(SCANS, max_size=2).map(tuple),
)
FRAMES = st.builds(
    frame,
    st.integers(0, 999_999),
    st.lists(BOXES, max_size=4, unique_by=lambda box: box.track),
    st.lists(STATIONS, min_size=1, max_size=2, unique_by=lambda station: station.number),
)
