"""What sensors record of each road user: never beyond the reach, and counted per road user."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import CAMERA, place_sensors, with_boxes, world

from inspe_jax.core.geometry import rotation
from inspe_jax.dataset.points_in_boxes import count_inside
from inspe_jax.scene.traffic.frames import CLASSES
from inspe_jax.sensing.conditions import Conditions
from inspe_jax.sensing.sensors import LidarSpec
from inspe_jax.sensing.signals import LidarNoise
from inspe_jax.simulation.embedded.recorder import EmbeddedRecorder
from inspe_jax.simulation.embedded.road_users import boxes_of
from inspe_jax.simulation.recorder import Recording

pytest.importorskip("embreex", reason="no wheels of Embree for this platform")

DENSE = LidarSpec(
    "dense", tuple(np.radians(np.linspace(-12, 4, 64)).tolist()), 900, 2 * np.pi, 40.0
)
SMALL = replace(CAMERA, width=320, height=240, focal=140.0, principal=(160.0, 120.0))
EXACT = Recording(noise=LidarNoise(range=0.0, lost=0.0, weak=0.0), turn=0.0)
SIZES = {
    "car": (4.6, 1.85, 1.5),
    "truck": (10.0, 2.5, 3.6),
    "cyclist": (1.8, 0.65, 1.75),
    "pedestrian": (0.6, 0.6, 1.75),
}


@pytest.fixture(scope="module")
def empty():
    return world(count=0, radius=80.0, voxel=2.0)


def standing(empty, kind, *at, velocity=(0.0, 0.0, 0.0)):
    """Road users of a class at (x, y) each, across the line of sight along x."""
    scene = with_boxes(empty, *((x, y, np.pi / 2, *SIZES[kind]) for x, y in at))
    kinds = np.full_like(scene.traffic.kind, CLASSES.index(kind))
    moving = np.broadcast_to(np.asarray(velocity, float), (*kinds.shape, 3)).copy()
    return replace(scene, traffic=replace(scene.traffic, kind=kinds, velocity=moving))


def lidar(height=1.5, spec=DENSE):
    return place_sensors((spec, [0.0, 0.0, height, 0.0, 0.0, 0.0]))


def scan_of(scene, layout, conditions="clear", recording=EXACT):
    around = Conditions.of("midday", conditions)
    recorder = EmbeddedRecorder(scene, layout, around, recording)
    return recorder.frame(0).stations[0].scans[0]


@pytest.mark.parametrize(("kind", "weather"), [
    ("car", "clear"), ("truck", "rain:50"), ("cyclist", "fog:50"), ("pedestrian", "rain:50"),
])  # fmt: skip
def test_road_users_beyond_the_reach_have_no_return(empty, kind, weather):
    """Rain and fog shorten the reach. The static world is as far away."""
    layout = lidar()
    reach = Conditions.of("midday", weather).layout(layout).sensors[0].spec.reach
    assert reach < 0.9 * DENSE.reach or weather == "clear"
    beyond = min(reach + 6.0, (reach + DENSE.reach) / 2 + SIZES[kind][1] / 2)
    beyond = reach + 6.0 if weather == "clear" else beyond
    scene = standing(empty, kind, (reach - 3.0, 0.0), (-beyond, 0.0))
    scan = scan_of(scene, layout, weather)
    assert scan.returns[0] > 3
    assert scan.returns[1] == 0
    assert np.linalg.norm(scan.points[:, :3], axis=1).max() <= reach + 1e-3
    if weather != "clear":
        assert (scan_of(scene, layout).returns > 3).all()


def test_the_seed_of_the_noise_leaves_shapes_and_colours(empty):
    scene = standing(empty, "car", *((x, y) for x in (8.0, 14.0, 20.0) for y in (-9.0, 0.0, 9.0)))
    layout = place_sensors((SMALL, [0.0, 0.0, 5.0, 0.0, -0.2, 0.0]))
    given = layout, Conditions.of("midday"), Recording(layers=("instance",))
    frames = [
        EmbeddedRecorder(scene, *given, seed=seed, appearance_seed=looks).frame(0)
        for seed, looks in ((0, 0), (1, 0), (0, 1))
    ]
    names = [[box.name for box in frame.boxes] for frame in frames]
    assert names[0] == names[1]
    assert names[0] != names[2]
    images = [frame.stations[0].images[0] for frame in frames]
    one, noisy, other = (image.rgb[images[0].instance > 0].astype(int) for image in images)
    assert not np.array_equal(images[0].rgb, images[1].rgb)
    assert np.abs(one - noisy).mean() < 4  # noise alone: no car has another colour
    assert np.abs(one - other).mean() > 15


def test_returns_are_counted_where_the_rays_end(empty):
    """A pedestrian close before a truck: points are its own, not those of the truck behind it."""
    scene = standing(empty, "truck", (20.0, 0.0), (17.0, 0.0))
    users = scene.traffic
    size, kind, center = (x.copy() for x in (users.size, users.kind, users.center))
    size[0, 1], kind[0, 1] = SIZES["pedestrian"], CLASSES.index("pedestrian")
    center[0, 1, 2] = size[0, 1, 2] / 2
    scene = replace(scene, traffic=replace(users, size=size, kind=kind, center=center))
    scan = scan_of(scene, lidar())
    assert scan.returns.min() > 10
    boxes = boxes_of(scene.traffic.at(0), 0)
    np.testing.assert_array_equal(scan.returns, count_inside([scan], boxes)[0])
    half = replace(EXACT, noise=LidarNoise(range=0.0, lost=0.5, weak=0.0))
    left = scan_of(scene, lidar(), recording=half).returns
    assert left.sum() == pytest.approx(scan.returns.sum() / 2, rel=0.1)


def test_pictures_of_any_size_show_the_same(empty):
    """As wide and as high a view, with other pixels: a road user covers the same share of it, and
    the calibration says where the middle of its box is."""
    scene = standing(empty, "truck", (18.0, 3.0))
    layout = place_sensors((SMALL, [0.0, 0.0, 5.0, 0.0, -0.2, 0.1]))
    shares, middles, conditions = [], [], Conditions.of("night", "rain")
    for given in ((320, 240), (37, 211)):
        recording = Recording(layers=("instance",), image_size=given)
        frame = EmbeddedRecorder(scene, layout, conditions, recording).frame(0)
        image, (box,) = frame.stations[0].images[0], frame.boxes
        assert image.rgb.shape == (given[1], given[0], 3)
        on = np.argwhere(image.instance > 0) + 0.5
        shares.append(len(on) / image.instance.size)
        middles.append(on.mean(0) / image.instance.shape)
        body = (box.center - image.pose[:3]) @ rotation(image.pose[3:], np)
        u, v, w = image.intrinsic @ [-body[1], -body[2], body[0]]
        assert np.abs(on[:, 1] - u / w).min() < 1
        assert np.abs(on[:, 0] - v / w).min() < 1
    assert shares[0] == pytest.approx(shares[1], rel=0.05)
    np.testing.assert_allclose(middles[0], middles[1], atol=0.005)


def test_pixels_and_visible_share_of_each_road_user(empty):
    """Two cars in a row, seen from the front one's height, and one behind the camera."""
    scene = standing(empty, "car", (10.0, 0.0), (16.0, 1.5), (-10.0, 0.0))
    layout = place_sensors((SMALL, [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))
    recorder = EmbeddedRecorder(scene, layout, recording=Recording(layers=("instance",)))
    (image,) = recorder.frame(0).stations[0].images
    tracks = [box.track for box in recorder.frame(0).boxes]
    assert image.pixels.tolist() == [(image.instance == t + 1).sum() for t in tracks]
    front, behind, out = image.share
    assert front == 1.0
    assert out == 0.0
    alone = EmbeddedRecorder(standing(empty, "car", (16.0, 1.5)), layout)
    only = alone.frame(0).stations[0].images[0]
    assert only.share[0] == 1.0
    assert 0.05 < behind < 0.6
    assert behind == pytest.approx(image.pixels[1] / only.pixels[0], rel=0.15)  # another shape
