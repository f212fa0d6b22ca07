"""Kinds of sensors: one that is added as a row of a table, radars, and cameras behind lenses."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from worlds import BARREL, CAMERA, CEILING, place_sensors, with_boxes, world

from inspe_jax.core.errors import InspeError
from inspe_jax.core.geometry import pose_matrix, rotation
from inspe_jax.core.rigid import CONVENTIONS
from inspe_jax.dataset import write_frame
from inspe_jax.sensing.radar import RadarSpec
from inspe_jax.sensing.sensors import Spec
from inspe_jax.simulation.backends import recorder_of
from inspe_jax.simulation.carla.sensors import SENSOR_KINDS, CarlaCamera
from inspe_jax.simulation.embedded.recorder import SENSORS, EmbeddedRecorder
from inspe_jax.simulation.frame import Scan
from inspe_jax.simulation.projection import corners
from inspe_jax.simulation.recorder import Recording, row_of

pytest.importorskip("embreex", reason="no wheels of Embree for this platform")


@dataclass(frozen=True)
class FanSpec(Spec):
    """A flat fan of ``count`` rays ahead, as of a radar, across ``fov`` [rad], to ``reach`` [m]."""

    name: str
    count: int
    fov: float
    reach: float
    reliability: float = 1.0

    kind = "fan"
    title = "fan"


class Fan:
    def __init__(self, spec, pose, surroundings):
        turn = np.linspace(-spec.fov / 2, spec.fov / 2, spec.count)
        self.body = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(spec.count)])
        self.pose, self.reach, self.surroundings = pose, spec.reach, surroundings

    def record(self, actors, rng):
        static, (_, caster) = self.surroundings.static_world, actors.at(0.0)
        origin, to = self.pose[:3] - static.center, self.body @ rotation(self.pose[3:], np).T
        casters = static.caster, caster
        far = np.min([one.cast(origin, to, self.reach).distance for one in casters], 0)
        met = np.isfinite(far)
        points = np.column_stack([self.body[met] * far[met, None], np.ones(met.sum())])
        return Scan(self.pose, points.astype(np.float32))


FAN = FanSpec("a fan", 41, np.radians(40), 60.0)
"""A ray for every degree."""


def test_a_fan_of_rays_is_recorded_next_to_a_camera(monkeypatch):
    """A car 10 m ahead, seen from the side, which is 4.6 m long, at y = 10 − 0.925."""
    monkeypatch.setitem(SENSORS, "fan", Fan)
    scene = with_boxes(world(count=0, radius=40.0, voxel=2.0), (0, 10, 0, 4.6, 1.85, 1.5))
    layout = place_sensors(
        (FAN, [0, 0, 0.6, 0, 0, np.pi / 2]), (CAMERA, [0, 0, 5, 0, -0.3, np.pi / 2])
    )
    recording = Recording(image_size=(80, 60))
    with recorder_of("embedded", scene, layout, recording=recording) as recorder:
        fan, camera = recorder.frame(0).stations
    assert (len(fan.images), len(camera.images), len(camera.scans)) == (0, 1, 0)
    (scan,) = fan.scans
    on_car = scan.points[scan.points[:, 0] < 11]
    assert on_car[:, 0] == pytest.approx(9.1, abs=0.15)
    half = np.degrees(np.arctan(2.3 / 9.075))
    assert len(on_car) == pytest.approx(2 * np.floor(half) + 1, abs=2)
    assert np.abs(on_car[:, 1]).max() == pytest.approx(2.3, abs=0.3)


def test_a_kind_without_a_row_is_an_error():
    scene, layout = world(count=0, radius=20.0, voxel=2.0), place_sensors((FAN, [0, 0, 3, 0, 0, 0]))
    words = "a fan: backend {} cannot simulate a sensor of kind 'fan', only camera and lidar"
    for backend in ("embedded", "carla"):
        with pytest.raises(InspeError, match=words.format(backend)):
            recorder_of(backend, scene, layout)


SPEC = RadarSpec("radar", 60.0, np.radians(90), np.radians(20), 1.0, np.radians(2), 0.5, 1.5)
POSE = [-20.0, 0.0, 2.0, 0.0, 0.0, 0.0]
CAR = (4.6, 1.85, 1.55)


def recorded(cars, velocity, spec=SPEC, seed=0):
    """The scan of the first frame; ``cars`` are x, y and yaw, ``velocity`` theirs."""
    scene = with_boxes(world(count=0, radius=40.0, voxel=2.0), *[(*car, *CAR) for car in cars])
    moving = np.zeros_like(scene.traffic.velocity)
    moving[:, : len(cars), :2] = velocity
    scene = replace(scene, traffic=replace(scene.traffic, velocity=moving))
    recorder = EmbeddedRecorder(scene, place_sensors((spec, POSE)), seed=seed)
    frame = recorder.frame(0)
    return frame, frame.stations[0].scans[0]


def test_points_are_on_the_car_with_its_radial_speed():
    scans = [recorded([(10.0, 0.0, 0.0)], (8.0, 0.0), seed=seed)[1] for seed in range(40)]
    points = np.concatenate([scan.points for scan in scans])
    speeds = np.concatenate([scan.speeds for scan in scans])
    far = np.linalg.norm(points[:, :3], axis=1)
    assert len(points) >= 40
    # The body begins at 27.7 m, and its noise is that of cells of 1 m, 2° and 0.5 m/s.
    assert np.median(far) == pytest.approx(28, abs=0.6)
    assert speeds.mean() == pytest.approx(8.0, abs=0.1)
    assert speeds.std() == pytest.approx(0.5 / 12**0.5, rel=0.3)
    assert np.abs(np.degrees(np.arctan2(points[:, 1], points[:, 0]))).max() < 4
    assert (points[:, 3] > 0.9).all()
    assert sum(scan.returns[0] for scan in scans) == len(points)
    again = recorded([(10.0, 0.0, 0.0)], (8.0, 0.0), seed=3)[1]
    assert (again.points == scans[3].points).all()


def test_what_stands_or_crosses_is_left_out():
    assert len(recorded([(10.0, 0.0, 0.0)], (0.0, 0.0))[1].points) == 0
    assert (
        len(recorded([(10.0, 0.0, np.pi / 2)], (0.0, 8.0))[1].points) == 0
    )  # ±0.6 m/s at its ends
    present = replace(SPEC, min_speed=0.0)
    assert len(recorded([(10.0, 0.0, 0.0)], (0.0, 0.0), present)[1].points) > 0


def test_neighbours_in_one_cell_are_one_but_for_their_speeds():
    """Two cars abreast, in a beam of one cell of azimuth, 25 to 29 m away."""
    wide = replace(SPEC, azimuth_resolution=np.radians(80), range_resolution=100.0)
    cars = [(10.0, 1.5, 0.0), (10.0, -1.5, 0.0)]
    assert (
        len(recorded(cars, [(8.0, 0.0), (8.0, 0.0)], wide)[1].points) == 2
    )  # left, and right of 0
    both = [(10.0, 1.5, 0.0), (10.0, 4.5, 0.0)]
    assert len(recorded(both, [(8.0, 0.0), (8.0, 0.0)], wide)[1].points) == 1
    assert len(recorded(both, [(8.0, 0.0), (4.0, 0.0)], wide)[1].points) == 2


def test_a_pedestrians_echo_is_weaker_and_data_sets_and_carla_refuse_a_radar(tmp_path):
    frame, scan = recorded([(10.0, 0.0, 0.0)], (8.0, 0.0))
    assert scan.points.dtype == scan.speeds.dtype == np.float32
    with pytest.raises(InspeError, match=r"station u0 has scans of a radar.*without radars"):
        write_frame(tmp_path, frame)
    assert not any(tmp_path.iterdir())
    with pytest.raises(InspeError, match="carla cannot simulate a sensor of kind 'radar'"):
        row_of(SENSOR_KINDS, SPEC, "carla")


@pytest.mark.parametrize(("spec", "pose"), [
    (BARREL, [-6.0, 1.0, 5.0, 0.02, -0.4, 0.1]), (CEILING, [3.0, -6.0, 8.0, 0.0, -1.5, 0.7]),
], ids=["barrel", "ceiling"])  # fmt: skip
def test_a_car_is_seen_at_its_pixels_and_nothing_beyond_the_circle(spec, pose):
    """A box of 1.5 m at the side of the picture; pixels are four times as large as the camera's."""
    at = np.array([4.0, 4.0, 0.75])
    scene = with_boxes(world(count=0, radius=40.0, voxel=2.0), (*at[:2], 0.3, 1.5, 1.5, 1.5))
    layout = place_sensors((spec, pose))
    size = spec.width // 4, spec.height // 4
    how = Recording(layers=("instance", "depth"), image_size=size)
    with recorder_of("embedded", scene, layout, recording=how) as recorder:
        (image,) = recorder.frame(0).stations[0].images
    rows, columns = np.nonzero(image.instance)
    to_optical = np.linalg.inv(pose_matrix(pose) @ np.linalg.inv(CONVENTIONS["optical"][1]))
    (box,) = corners([recorder.surroundings.actors(0).boxes[0]])
    seen = spec.optics.pixels(np.column_stack([box, np.ones(8)]) @ to_optical[:3].T) / 4
    found = np.array([[columns.min(), rows.min()], [columns.max() + 1, rows.max() + 1]])
    off = found - [seen.min(0), seen.max(0)]
    assert np.abs(off).max() < 0.25 * np.ptp(seen, axis=0).max()  # a car fills its box but for
    assert (off[0] > -1.1).all()  # its hood, and is not beyond it
    assert (off[1] < 1.1).all()
    assert image.depth[rows, columns].mean() == pytest.approx((to_optical @ [*at, 1])[2], abs=1.0)
    u, v = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    dark = spec.optics.beyond_circle(4 * np.column_stack([u.ravel(), v.ravel()])).reshape(u.shape)
    assert dark.any() == (spec is CEILING)
    assert np.isinf(image.depth[dark]).all()
    assert (image.rgb[dark] < 30).all()
    assert image.rgb[~dark].mean() > 60


def test_carla_refuses_lenses_that_are_not_its_own():
    with pytest.raises(InspeError, match=r"ceiling: CARLA's cameras are pinholes here, .*embedded"):
        CarlaCamera(CEILING, Recording())
