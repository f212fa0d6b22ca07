"""Adding a kind of sensor: a spec, and one row in the table of a backend."""

from dataclasses import dataclass

import numpy as np
import pytest
from worlds import CAMERA, place_sensors, with_boxes, world

from inspe_jax.core.errors import InspeError
from inspe_jax.core.geometry import rotation
from inspe_jax.sensing.sensors import Spec
from inspe_jax.simulation.backends import recorder_of
from inspe_jax.simulation.embedded.recorder import SENSORS
from inspe_jax.simulation.frame import Scan
from inspe_jax.simulation.recorder import Recording

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
