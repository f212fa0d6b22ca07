"""A radar's points beside what its resolution and the radial speeds of road users say."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import place_sensors, with_boxes, world

from inspe_jax.core.errors import InspeError
from inspe_jax.dataset import write_frame
from inspe_jax.sensing.radar import RadarSpec
from inspe_jax.simulation.carla.sensors import SENSOR_KINDS
from inspe_jax.simulation.embedded.recorder import EmbeddedRecorder
from inspe_jax.simulation.recorder import row_of

pytest.importorskip("embreex", reason="no wheels of Embree for this platform")

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
