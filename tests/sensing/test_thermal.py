"""A thermal camera: a camera in all that is geometry; depth, losses and curves are its own."""

from dataclasses import fields, replace

import jax
import numpy as np
import pytest
from worlds import place_sensors, world

import inspe_jax
from inspe_jax.core.errors import InspeError
from inspe_jax.mounting.strategies import strategy
from inspe_jax.report.handover import calibration_json
from inspe_jax.scoring.detection import DetectionCurve, detection_curves
from inspe_jax.sensing.catalogue import device, spec_of, table_of
from inspe_jax.sensing.conditions import Conditions
from inspe_jax.sensing.sensors import CameraSpec
from inspe_jax.sensing.thermal import ThermalSpec
from inspe_jax.simulation.backends import recorder_of

TABLE = dict(kind="thermal", width=384, height=288, hfov_deg=55.0, downsample=0.25)
LENSES = {
    "pinhole": dict(depth_m=15.0),
    "distorted": dict(depth_m=15.0, distortion=[-0.2, 0.02]),
    "fisheye": dict(depth_m=15.0, lens="fisheye", hfov_deg=150.0),
}
POSE = [-12.0, 3.0, 5.0, 0.05, -0.4, -0.3]


def as_camera(spec: ThermalSpec) -> CameraSpec:
    return CameraSpec(**{field.name: getattr(spec, field.name) for field in fields(spec)})


@pytest.mark.parametrize("lens", LENSES)
def test_scores_and_slopes_are_those_of_a_camera(lens):
    scene, spec = world(radius=16.0, voxel=1.0, frames=2), spec_of(TABLE | LENSES[lens], "t", "t")

    def score(spec, poses=None, softness=None):
        layout = place_sensors((spec, POSE))
        layout = layout if poses is None else layout.with_poses(poses)
        return inspe_jax.evaluate(scene, layout, softness=softness).surrogate

    assert spec_of(table_of(spec), "t", "t") == spec
    assert score(spec) == score(as_camera(spec)) > 0.1
    if lens == "pinhole":
        slope = jax.grad(lambda p, spec: score(spec, p, 0.5))
        poses = np.array([POSE], np.float32)
        np.testing.assert_array_equal(slope(poses, spec), slope(poses, as_camera(spec)))


def test_a_search_moves_it_as_a_camera():
    scene, spec = (
        world(radius=16.0, voxel=1.0, frames=2),
        spec_of(TABLE | LENSES["pinhole"], "t", "t"),
    )
    warm, light = (
        inspe_jax.optimise(scene, place_sensors((of, POSE)), evaluations=20, seed=0)
        for of in (spec, as_camera(spec))
    )
    np.testing.assert_array_equal(warm.layout.poses, light.layout.poses)
    assert warm.scores.surrogate > warm.scores_before.surrogate + 0.03


def test_depth_light_and_weather():
    """8 px per metre: 6 across the 0.75 m of a person. Weather takes what it takes of light."""
    spec = spec_of(TABLE, "t", "t")
    assert spec.depth == pytest.approx(192 / np.tan(np.radians(27.5)) / 8, abs=0.05)
    assert "depth_m" not in table_of(spec)
    assert Conditions.of("night").spec(spec) == spec
    for weather in ("rain:10", "fog:100"):
        one = Conditions.of("night", weather).spec(spec)
        assert one.depth == Conditions.of(weather=weather).spec(as_camera(spec)).depth < spec.depth


def test_at_night_it_finds_what_a_camera_does_not_by_curves_of_its_own():
    scene, night = world(radius=16.0, voxel=1.0, frames=2), Conditions.of("night")
    spec = spec_of(TABLE | dict(depth_m=25.0), "t", "t")
    layouts = [place_sensors((of, POSE)) for of in (spec, as_camera(spec))]
    none = DetectionCurve(most=1e-6, half=36.0, slope=1.5)
    cold = detection_curves().with_curves(
        {("thermal", name): none for name in ("car", "truck", "cyclist", "pedestrian")}
    )

    def found(layout, curves=None):
        asked = dict(metrics=("detectability",), detection=curves)
        return inspe_jax.evaluate(inspe_jax.Case(scene, night), layout, **asked).metrics[
            "detectability"
        ]

    thermal, camera = map(found, layouts)
    assert thermal > 2 * camera > 0
    assert found(layouts[0], cold) < 1e-5
    assert found(layouts[1], cold) == camera


def test_placements_have_it_for_cameras_and_calibrations_bring_it_back(tmp_path):
    scene = inspe_jax.build_scene("four_way", voxel=2.0, frames=1)
    layout = strategy(scene, "Cam-d1", camera="axis-q1951-e")
    assert {sensor.spec.kind for sensor in layout.sensors} == {"thermal"}
    path = tmp_path / "calibration.json"
    path.write_text(calibration_json(layout, scene.intersection))
    again = inspe_jax.layouts_from(path).layout
    assert [one.spec for one in again.sensors] == [one.spec for one in layout.sensors]
    np.testing.assert_allclose(again.poses, layout.poses, atol=1e-6)


def test_a_profile_takes_from_it_what_it_takes_from_a_camera():
    scene = inspe_jax.build_scene("four_way", voxel=2.0, frames=2)
    spec = replace(device("axis-q1951-e").spec, reliability=0.9)
    scores = [
        inspe_jax.evaluate(scene, place_sensors((of, POSE))).information_gain
        for of in (spec, as_camera(spec))
    ]
    assert scores[0] == scores[1] > 0


def test_it_is_not_recorded():
    scene = world(radius=16.0, voxel=2.0, count=0)
    with pytest.raises(InspeError, match="cannot simulate a sensor of kind 'thermal'"):
        recorder_of("embedded", scene, place_sensors((device("axis-q1951-e").spec, POSE)))
