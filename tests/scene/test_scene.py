"""Scenes are built, saved, loaded; bad input is told. What a scene says of its profile decides what
is placed on it and what is scored."""

from dataclasses import fields, replace

import numpy as np
import pytest
import shapely
from worlds import LIDAR, crossing, place_sensors, world

from inspe_jax import evaluate, evaluate_many, strategy
from inspe_jax.core.digest import digest
from inspe_jax.core.errors import InspeError
from inspe_jax.placement.problem import Problem
from inspe_jax.scene.profiles import BEFORE_PROFILES, DEFAULT_PROFILE, Profile, profile_of, profiles
from inspe_jax.scene.regions import PAPER_WEIGHTS, PRECEDENCE, Region
from inspe_jax.scene.scene import build_scene, load_scene, save_scene
from inspe_jax.scene.voxels import build_voxels
from inspe_jax.scoring.evaluate import check_options
from inspe_jax.scoring.targets import target_view
from inspe_jax.sensing.catalogue import device
from inspe_jax.sensing.layout import load_layout, save_layout
from inspe_jax.visibility.queries import in_view


def test_columns_are_labelled_by_precedence_and_stand_on_the_ground():
    place = crossing(slope=0.1)
    grid = build_voxels(place, radius=20, voxel=0.5)
    labels = {tuple(c): r for c, r in zip(grid.columns.tolist(), grid.region, strict=True)}
    assert labels[(0.25, 0.25)] == Region.JUNCTION  # over driveway
    assert labels[(10.25, 0.25)] == Region.DRIVEWAY
    assert labels[(10.25, 8.25)] == Region.SIDEWALK
    assert (12.25, 12.25) not in labels  # off the map
    at = np.flatnonzero((grid.columns == [10.25, 0.25]).all(1))[0]
    assert grid.ground[at] == pytest.approx(1.025, abs=0.05)  # within the 5 m of ground points
    assert np.hypot(*grid.columns.T).max() <= 20


def test_columns_on_a_border_are_not_lost():
    """14 m roads and 4 m sidewalks end on lattice points of 2 m voxels, at ±7 and ±11."""
    grid = build_voxels(crossing(), radius=30, voxel=2.0)
    assert sorted(set(grid.columns[grid.columns[:, 0] == 21, 1])) == [*range(-11, 12, 2)]


def test_voxels_run_from_the_ground_to_four_metres():
    grid = build_voxels(crossing(), radius=15, voxel=0.5)
    assert grid.level_count == 8
    assert grid.centers.shape == (grid.count, 3)
    assert sorted(set(grid.centers[:, 2])) == pytest.approx(np.arange(0.25, 4, 0.5))
    # Voxel v is column v // Z, level v % Z.
    assert grid.centers[8 * 5 + 3].tolist() == [*grid.columns[5], 1.75]
    assert grid.weight[8 * 5] == PAPER_WEIGHTS[grid.region[5]]
    assert set(PRECEDENCE) == set(Region)
    assert sum(PAPER_WEIGHTS) == pytest.approx(1)  # as the paper has them


def test_regions_have_weights_of_ones_own(tmp_path):
    """In the scene, its file and its coverage; those that are not named count for nothing."""
    own = dict(crosswalk=3.0, sidewalk=1.0)
    made = build_scene("four_way", radius=20, voxel=1.0, frames=2, region_weight=own)
    save_scene(made, tmp_path / "s.npz")
    scene = load_scene(tmp_path / "s.npz")
    assert scene.voxels == made.voxels
    label = scene.voxels.region
    weight = np.where(label == Region.CROSSWALK, 3.0, 1.0 * (label == Region.SIDEWALK))
    np.testing.assert_array_equal(scene.voxels.column_weight, weight)
    found = evaluate(scene, strategy(scene, "Cam-c"))
    area = np.array([weight[label == Region[key.upper()]].sum() for key in own])
    covered = [found.region_coverage[key] for key in own]
    assert found.coverage == pytest.approx(covered @ area / area.sum(), abs=1e-6)
    assert found.settings["region_weight"] == own
    unknown = {"pavement": 1}, "region 'pavement': one of"
    for bad, message in (unknown, ({"sidewalk": -1}, "sidewalk: must be 0, or")):
        with pytest.raises(InspeError, match=message):
            build_scene("four_way", region_weight=bad)


def test_a_saved_scene_loads_the_same(tmp_path):
    scene = build_scene("t_junction", radius=20, spacing=1.25, frames=3, density=5)
    assert dict(scene.settings)["spacing"] == "1.25"
    save_scene(scene, tmp_path / "t.npz")
    again = load_scene(tmp_path / "t.npz")
    assert digest(again) == digest(scene)
    assert again.settings == scene.settings


@pytest.mark.parametrize(("options", "message"), [
    (dict(radius=5), "radius 5 m is out of range: between 10 and 200 m"),
    (dict(radius=float("nan")), "radius nan m is out of range"),
    (dict(voxel=0), "voxel 0 m is out of range: between 0.05 and 2 m"),
    (dict(voxel=0.5, spacing=0.4), "spacing 0.4 m is out of range: between 0.5 and 4 m"),
    (dict(radius=200, voxel=0.05), r"too large for memory: .* million voxels .* about [\d,]+ G"),
    (dict(density="heavy"), "density 'heavy': none, low, medium, high"),
    (dict(density=-3), "density '-3'"),
])  # fmt: skip
def test_values_out_of_range(options, message):
    with pytest.raises(InspeError, match=message):
        build_scene("four_way", **{"frames": 2, **options})


@pytest.mark.parametrize(("name", "message"), [
    ("for_way", "no scene 'for_way': .*did you mean four_way"),
    ("none.npz", "none.npz: no such file"),
    ("bad.npz", "bad.npz: not a scene saved by this package"),
    ("town.xodr", "inspe scene .*--junction"),
    ("own.yaml", "own.yaml: is a layout or a study, not a scene: inspe score SCENE own.yaml"),
    (".", "is a folder; its layout is layout.yaml"),
])  # fmt: skip
def test_what_cannot_be_loaded(tmp_path, monkeypatch, name, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bad.npz").write_bytes(b"PK\x03\x04 not really")
    (tmp_path / "layout.yaml").touch()
    with pytest.raises(InspeError, match=message):
        load_scene(name)


def test_no_array_of_a_saved_scene_may_have_a_value_that_is_not_finite(tmp_path):
    path, size = tmp_path / "bad.npz", dict(radius=15, voxel=1.0, frames=2, density=4)
    save_scene(build_scene("four_way", statics="street", **size), path)
    with np.load(path) as data:
        saved = dict(data)
    for name, words in (
        ("route_points", r"routes\[0\].waypoints"), ("grid_columns", "voxels.columns"),
        ("statics_numbers", r"statics\[0\].height"),
    ):  # fmt: skip
        bad = saved[name].copy()
        bad.flat[0] = np.nan
        np.savez(path, **saved | {name: bad})
        with pytest.raises(InspeError, match=rf"bad.npz: four_way: .*{words}.*: nan is not finite"):
            load_scene(path)
    np.savez(path, **saved | dict(poles=np.array("x" * 60_000)))
    with pytest.raises(InspeError, match=r"poles: must be numbers, got 'x+\.\.\.x+'") as caught:
        load_scene(path)
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize(("name", "change", "message"), [
    ("yaw", lambda x: x[:, :-1], r"traffic.yaw: shape \(2, \d+\), expected \(2, \d+\)"),
    ("kind", lambda x: x + 9, r"traffic.kind\[0, 0\]: 9 is out of range: from 0 to 3"),
    ("kind", lambda x: x + 0.5, "traffic.kind: must be whole numbers, got an array of float64"),
    ("size", lambda x: x * 0, r"traffic.size\[0, 0, 0\]: 0 is out of range: at least 0.01"),
    ("time", lambda x: x.astype(str), "traffic.time: must be numbers, got an array of str"),
])  # fmt: skip
def test_traffic_of_ones_own_is_checked(name, change, message):
    scene = world(radius=10.0, voxel=2.0, frames=2, count=6)
    wrong = change(getattr(scene.traffic, name))
    bad = replace(scene, traffic=replace(scene.traffic, **{name: wrong}))
    with pytest.raises(InspeError, match=message):
        bad.check()


def test_the_first_function_that_takes_a_scene_checks_it(tmp_path):
    scene = world(radius=10.0, voxel=2.0, frames=2, count=6)
    layout = place_sensors((LIDAR, [0.0, 0.0, 5.0, 0, 0, 0]))
    bad = replace(scene, traffic=replace(scene.traffic, yaw=scene.traffic.yaw[:, :-1]))
    for function in (evaluate, in_view, target_view, Problem):
        with pytest.raises(InspeError, match=r"traffic\.yaw: shape"):
            function(bad, layout)
    with pytest.raises(InspeError, match=r"traffic\.yaw: shape"):
        save_scene(bad, tmp_path / "bad.npz")
    padding = replace(scene.traffic, kind=np.where(scene.traffic.valid, scene.traffic.kind, -1))
    assert replace(scene, traffic=padding).check().traffic is padding


def test_scenes_are_shown_in_one_line():
    scene = build_scene("four_way", radius=15, voxel=1.0, frames=2, density=4)
    scene = replace(scene, intersection=replace(scene.intersection, name="<b>four</b>"))
    assert "\n" not in repr(scene)
    assert len(repr(scene)) < 150
    assert len(repr(scene.intersection)) < 150
    assert "<td>15 m</td>" in scene._repr_html_()
    assert "<td>&lt;b&gt;four&lt;/b&gt;</td>" in scene._repr_html_()


def test_a_scene_whose_shapes_are_nested_deep_is_refused(tmp_path):
    """GEOS would end the process: it reads them by recursion."""
    scene, path = build_scene("t_junction", radius=15, frames=2, density=2), tmp_path / "a.npz"
    high, flat = shapely.force_3d(shapely.box(0, 0, 1, 1)), shapely.box(0, 0, 1, 1)
    parts = (shapely.Point(0, 0), shapely.LineString([(0, 0), (1, 1)]), high)
    mixed = shapely.GeometryCollection(parts)
    for area in (shapely.MultiPolygon([flat]), high, shapely.Polygon(), mixed):
        save_scene(replace(scene, intersection=replace(scene.intersection, mounting=area)), path)
        assert load_scene(path).intersection.mounting.wkb == area.wkb
    with np.load(path) as data:
        arrays = dict(data)
    deep = b"\1\7\0\0\0\1\0\0\0" * 100_000
    np.savez(path, **arrays | {"shape_0": np.frombuffer(deep, "u1")})
    with pytest.raises(InspeError, match="not a scene saved by this package"):
        load_scene(path)


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
    (name,) = {s.spec.name for s in strategy(scene, "Cam-d1", camera="basler-aca1600-60gc").sensors}
    assert name == "basler-aca1600-60gc"


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
