"""Adding a kind of sensor: its spec with its ray grid, and its catalogue keys with a row.

Here the kind is a fan: rays of one plane, as of a radar or a single-plane scanner.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pytest
import raycast
from worlds import LIDAR, emptied, world

import inspe_jax
from inspe_jax.core.errors import InspeError
from inspe_jax.core.pytree import pytree
from inspe_jax.placement.constraints import Constraints
from inspe_jax.scene.traffic.frames import CLASSES
from inspe_jax.scoring.detection import DetectionCurve, detection_curves
from inspe_jax.sensing import kinds
from inspe_jax.sensing.catalogue import spec_of, table_of
from inspe_jax.sensing.conditions import FAIR, Conditions
from inspe_jax.sensing.kinds import DeviceKeys, Positive
from inspe_jax.sensing.layout import load_layout, save_layout
from inspe_jax.sensing.ray_grid import RayGrid
from inspe_jax.sensing.rays import SphericalRays
from inspe_jax.sensing.sensors import Spec
from inspe_jax.sensing.signals import LidarNoise, Signal
from inspe_jax.visibility.queries import in_view

# ── First file: the spec ────────────────────────────────────────────────────


@pytree
@dataclass(frozen=True)
class FanRays(SphericalRays):
    signal = Signal("fan", LidarNoise(range=0.1, lost=0.0))


@dataclass(frozen=True)
class FanSpec(Spec):
    """``count`` rays at even azimuths over ``fov`` [rad], all in the plane of the sensor."""

    name: str
    count: int
    fov: float
    reach: float
    reliability: float = 1.0

    kind = "fan"
    title = "fan of rays"

    @cached_property
    def grid(self):
        step = self.fov / (self.count - 1)
        return RayGrid((0.0,), -self.fov / 2, step, self.count, False, self.reach, FanRays)


# ── Second file: what a catalogue says of it ────────────────────────────────


class FanKeys(DeviceKeys):
    rays: int
    fov_deg: Positive
    range_m: Positive

    spec_type = FanSpec

    def spec(self, name, where):
        fov = float(np.radians(self.fov_deg))
        return FanSpec(name, self.rays, fov, self.range_m, self.reliability)

    @classmethod
    def table(cls, spec):
        return dict(
            kind="fan",
            rays=spec.count,
            fov_deg=float(np.degrees(spec.fov)),
            range_m=spec.reach,
            reliability=spec.reliability,
        )


@pytest.fixture
def fan(monkeypatch):
    monkeypatch.setitem(kinds.SENSOR_KINDS, "fan", FanKeys)


# ── What follows from them ──────────────────────────────────────────────────

LAYOUT = """\
devices:
  my-fan: {kind: fan, rays: 241, fov_deg: 120, range_m: 30, reliability: 0.9}
units:
  - base: [9.0, 9.0]
    sensors:
      - {device: my-fan, height: 5.0, yaw_deg: -130, pitch_deg: -14}
  - base: [-9.0, 9.0]
    sensors:
      - {device: my-fan, height: 4.0, yaw_deg: -40, pitch_deg: -9, roll_deg: 6}
      - {device: paper-lidar-32, height: 4.5, yaw_deg: 0}
"""


@pytest.fixture(scope="module")
def scene():
    return world(radius=20.0, voxel=0.5, frames=3, count=12, seed=4)


@pytest.fixture
def layout(fan, scene, tmp_path):
    path = tmp_path / "fans.yaml"
    path.write_text(LAYOUT)
    return load_layout(path, scene)


def test_a_fan_sees_the_voxels_that_its_rays_pass_through(scene, layout):
    """And coverage is the weighted share of voxels that a walk of every ray meets."""
    ours, walked = in_view(scene, layout), raycast.in_view(scene, layout, "exact")
    assert (ours[:2] == walked[:2]).all()
    assert 0.01 < ours[0].mean() < 0.5
    assert (ours == walked).mean() > 0.999
    scores, weight = inspe_jax.evaluate(scene, layout), scene.voxels.weight
    assert scores.coverage == pytest.approx(weight @ walked.any(0) / weight.sum(), abs=1e-3)
    assert scores.contributions[0].coverage > 0


def test_a_detector_finds_road_users_by_its_own_curves_and_noise(scene, layout):
    """Curves of another kind say nothing of it: without its own, it is named."""
    with pytest.raises(InspeError, match="no curves for sensors of kind 'fan'; give one for each"):
        inspe_jax.target_view(scene, layout)
    with pytest.raises(InspeError, match="fan: it has no curve for truck, cyclist, pedestrian"):
        detection_curves().with_curves({("fan", "car"): DetectionCurve(0.5, 1.0, 1.0)})
    own = {("fan", name): DetectionCurve(0.5, 1.0, 1.0) for name in CLASSES}
    curves = detection_curves().with_curves(own)
    view = inspe_jax.target_view(emptied(scene), layout, detection=curves)
    few = 1.0 / (1.0 + 1.0 / np.maximum(view.returns[:2], 1e-9))
    assert view.returns[:2].max() > 1
    np.testing.assert_allclose(view.found[:2], 0.5 * few, atol=1e-4)


def test_a_search_places_it(scene, layout):
    found = inspe_jax.optimise(scene, layout, method="random", evaluations=8)
    assert found.objective > found.objective_before
    assert [sensor.spec.kind for sensor in found.layout.sensors] == ["fan", "fan", "lidar"]
    low, high = np.radians(FanSpec.pitch_limits_deg)
    assert Constraints().pitch["fan"] == (low, high)
    pitches = np.asarray(found.layout.poses)[:2, 4]
    assert ((pitches > low - 1e-3) & (pitches < high + 1e-3)).all()


def test_its_keys_and_layouts_are_read_and_written(scene, layout, tmp_path):
    save_layout(layout, tmp_path / "again.yaml")
    again = load_layout(tmp_path / "again.yaml", scene)
    assert again.sensors == layout.sensors
    np.testing.assert_allclose(again.poses, layout.poses, atol=1e-9)
    table = dict(kind="fan", rays=3, fov_deg=90.0, range_m=20.0)
    spec = spec_of(table, "my-fan", "here")
    assert spec == FanSpec("my-fan", 3, float(np.pi / 2), 20.0)
    assert spec_of(table_of(spec), "my-fan", "here") == spec
    with pytest.raises(InspeError, match=r"my-fan: beams: unknown key; allowed: .*rays"):
        spec_of(table | dict(beams=3), "my-fan", "my-fan")


def test_weather_without_figures_for_it_takes_nothing(fan, layout):
    spec = layout.sensors[0].spec
    assert Conditions.of("night", "fog:50").spec(spec) == spec
    assert Conditions.of("night", "fog:50").spec(LIDAR) != LIDAR
    assert spec.with_performance(0.5, reach=10.0) == FanSpec("my-fan", 241, spec.fov, 10.0, 0.5)
    assert FAIR.layout(layout) is layout
