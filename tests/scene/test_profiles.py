"""Profiles: what a scene says of itself decides what is placed on it and what is scored."""

from dataclasses import fields, replace

import numpy as np
import pytest

from inspe_jax import evaluate, evaluate_many, strategy
from inspe_jax.core.errors import InspeError
from inspe_jax.placement.problem import Problem
from inspe_jax.scene.profiles import BEFORE_PROFILES, DEFAULT_PROFILE, Profile, profile_of, profiles
from inspe_jax.scene.scene import build_scene, load_scene, save_scene
from inspe_jax.scoring.evaluate import check_options
from inspe_jax.sensing.catalogue import device
from inspe_jax.sensing.layout import load_layout, save_layout

SIZE = dict(radius=15.0, voxel=1.0, frames=4, density=10)


@pytest.fixture(scope="module")
def scene():
    return build_scene("four_way", **SIZE)


@pytest.fixture(scope="module")
def ideal():
    return build_scene("four_way", profile="ideal", **SIZE)


@pytest.mark.parametrize("name", profiles())
def test_every_value_has_a_reason_and_can_be_had(name):
    profile = profile_of(name)
    words = {"name", "title", "reasons"}
    given = {f.name for f in fields(Profile)} - words
    assert set(profile.reasons) == {key for key in given if getattr(profile, key) is not None}
    assert all(len(reason) > 10 for reason in profile.reasons.values())
    check_options(None, profile.occlusion_reference, profile.visibility)
    assert device(profile.camera).kind == "camera"
    for beams, lidar in ((32, profile.lidar_32), (64, profile.lidar_64)):
        assert len(device(lidar).spec.elevations) == beams
    assert all(0 < share <= 1 for share in profile.reliability.values())


def test_a_scene_is_built_as_its_profile_says():
    assert next(iter(profiles())) == DEFAULT_PROFILE
    own = profile_of("paper")
    assert own.of_scene(voxel=own.voxel)["spacing"] == own.spacing
    assert own.of_scene(voxel=2 * own.voxel)["spacing"] is None
    assert own.of_scene(voxel=1.0, spacing=2.0)["spacing"] == 2.0
    built = build_scene("t_junction", radius=10.0, density="none", frames=1)
    said = dict(built.settings)
    assert said["profile"] == "paper"
    assert (built.voxels.size, built.voxels.spacing) == (own.voxel, own.spacing)
    assert (float(said["voxel"]), float(said["spacing"])) == (own.voxel, own.spacing)


def test_sensors_are_placed_as_the_profile_says(scene, ideal):
    here, there = (strategy(on, "Cam-d1/L-d1") for on in (scene, ideal))
    own = scene.profile
    assert (here.profile, there.profile) == ("paper", "ideal")
    assert {s.spec.name for s in here.sensors} == {own.camera, own.lidar_32}
    assert {s.spec.name for s in there.sensors} == {"ideal-camera", "ideal-lidar-32"}
    assert {s.spec.name for s in strategy(scene, "L-d2").sensors} == {own.lidar_64}
    cameras = [s.spec.kind == "camera" for s in here.sensors]
    np.testing.assert_allclose(np.degrees(here.poses[cameras, 4]), own.camera_pitch_deg, atol=1e-6)
    height = here.poses[:, 2] - scene.intersection.ground(here.poses[:, :2])
    np.testing.assert_allclose(height[cameras], own.camera_height, atol=1e-6)
    np.testing.assert_allclose(height[np.invert(cameras)], own.lidar_height, atol=1e-6)
    given = strategy(scene, "Cam-d1", camera_pitch_deg=-30.0, camera_height=7.0)
    np.testing.assert_allclose(np.degrees(given.poses[:, 4]), -30.0, atol=1e-6)


def test_what_is_scored_is_what_the_profile_says(scene, ideal):
    """As on the same voxels and traffic of the ideal profile, with everything said by hand."""
    layout = strategy(scene, "Cam-c/L-c")
    own, scores = scene.profile, evaluate(scene, layout)

    def less_reliable(sensor):
        share = sensor.spec.reliability * own.reliability[sensor.spec.kind]
        return replace(sensor, spec=replace(sensor.spec, reliability=share))

    by_hand = evaluate(
        ideal,
        replace(layout, sensors=tuple(map(less_reliable, layout.sensors))),
        visibility=own.visibility,
        occlusion_reference=own.occlusion_reference,
    )
    assert scores.settings["profile"] == "paper"
    for name in ("coverage", "occlusion", "information_gain", "surrogate"):
        assert getattr(scores, name) == getattr(by_hand, name)
    assert scores.information_gain < evaluate(ideal, layout).information_gain - 0.1
    assert evaluate(scene, layout, visibility="in_view").information_gain > scores.information_gain
    many = evaluate_many(scene, layout, layout.poses[None])
    assert many.surrogate[0] == pytest.approx(scores.surrogate, abs=1e-6)
    problem = Problem(scene, layout)
    assert problem.exact_of(layout) == pytest.approx(scores.surrogate, abs=1e-6)
    assert problem.objective.visibility == own.visibility


def test_files_say_their_profile(tmp_path, scene, ideal):
    for on in (scene, ideal):
        path = tmp_path / f"{on.profile.name}.npz"
        save_scene(on, path)
        assert load_scene(path).profile is on.profile
        assert load_scene(path, on.profile.name).profile is on.profile
        save_layout(strategy(on, "L-c"), tmp_path / "layout.yaml")
        assert load_layout(tmp_path / "layout.yaml", on).profile == on.profile.name
    assert "profile: ideal" in (tmp_path / "layout.yaml").read_text()
    with pytest.raises(InspeError, match=r"paper.npz: .*profile paper, not ideal; build it again"):
        load_scene(tmp_path / "paper.npz", "ideal")
    before = replace(scene, settings=tuple((k, v) for k, v in scene.settings if k != "profile"))
    save_scene(before, tmp_path / "before.npz")
    assert load_scene(tmp_path / "before.npz").profile.name == BEFORE_PROFILES
    save_scene(replace(scene, settings=(("profile", "parer"),)), tmp_path / "other.npz")
    with pytest.raises(InspeError, match=r"other.npz: no profile 'parer': one of paper"):
        load_scene(tmp_path / "other.npz")
    text = (tmp_path / "layout.yaml").read_text().replace("profile: ideal", "profile: idael")
    (tmp_path / "layout.yaml").write_text(text)
    with pytest.raises(InspeError, match=r"layout.yaml: profile: no profile 'idael'.*ideal"):
        load_layout(tmp_path / "layout.yaml")


def test_profiles_are_not_mixed(scene, ideal):
    with pytest.raises(InspeError, match=r"profiles ideal and paper: scenes searched together"):
        Problem([scene, ideal], strategy(scene, "L-c"))
    with pytest.raises(InspeError, match=r"no profile 'papre'.*paper"):
        build_scene("four_way", profile="papre")
    with pytest.raises(InspeError, match=r"no profile 'papre'.*paper"):
        load_scene("four_way", "papre")
