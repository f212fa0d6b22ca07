"""The limits and invariances of the scores, and an independent calculation of them."""

from dataclasses import replace

import jax
import numpy as np
import pytest
import raycast
from shapely import affinity
from worlds import (
    CAMERA,
    LIDAR,
    SMALL,
    embree_line_of_sight,
    no_traffic,
    place_sensors,
    random_layout,
    solid_voxels,
    with_boxes,
    world,
)

import inspe_jax as ij
from inspe_jax.core.errors import InspeError
from inspe_jax.scene.scene import Scene
from inspe_jax.scene.voxels import build_voxels
from inspe_jax.scoring import metrics
from inspe_jax.scoring.evaluate import evaluate, evaluate_many
from inspe_jax.sensing.sensors import LidarSpec

FEW = replace(LIDAR, azimuth_count=450)
"""Of a quarter of the rays, which are walked one by one."""
SPECS = [FEW, CAMERA, CAMERA]
FOUR = ("coverage", "occlusion", "information_gain", "surrogate")


@pytest.mark.parametrize("reference", ["roi", "covered"])
def test_scores_equal_those_of_walked_rays_and_embree(reference):
    """C, O and IG once more, in NumPy, from the two oracles; both agree to 1e-3 by design. Of all
    columns, of those within 30 m of the centre, and of the others."""
    scene = world(count=15, seed=4, radius=38.0, voxel=1.0)
    layout = random_layout(scene, SPECS, seed=4)
    f = raycast.in_view(scene, layout, "exact")
    solid = np.stack([solid_voxels(scene, k) for k in range(4)])
    w = scene.voxels.weight
    core = np.hypot(*scene.voxels.centers[:, :2].T) < 30
    everywhere = np.ones_like(core)
    shares = []
    for k in range(4):
        seen = (f & embree_line_of_sight(scene, layout, k)).any(0) & ~solid[k]
        original = ~solid[k] if reference == "roi" else ~solid[k] & f.any(0)
        shares.append([(seen & a).sum() / (original & a).sum() for a in (everywhere, core, ~core)])
    p = solid.mean(0)
    with np.errstate(divide="ignore", invalid="ignore"):
        h = np.nan_to_num(-p * np.log(p) - (1 - p) * np.log(1 - p))
    q = 1 - np.prod([1 - s.reliability * row for s, row in zip(SPECS, f, strict=True)], axis=0)

    scores = evaluate(scene, layout, occlusion_reference=reference)
    whole = {name: scores.value(name) for name in FOUR}
    found = dict(everywhere=whole) | scores.parts
    for (name, ours), share, part in zip(
        found.items(), np.mean(shares, 0), (everywhere, core, ~core), strict=True
    ):
        expected = [w[part] @ f.any(0)[part] / w[part].sum(), share]
        expected.append((q * h)[part].sum() / h[part].sum())
        assert [ours[key] for key in FOUR[:3]] == pytest.approx(expected, abs=1e-3), name
        assert ours["surrogate"] == pytest.approx(np.dot([0.3, 0.5, 0.2], expected), abs=1e-3)
        assert all(type(value) is float for value in ours.values())
    assert list(found) == ["everywhere", "core", "outside"]


def test_no_vehicles_make_occlusion_the_unweighted_coverage():
    """Without traffic there is no entropy: information gain must have no weight."""
    scene = replace(world(**SMALL), traffic=no_traffic())
    layout = place_sensors(
        (FEW, [5.0, 5.0, 6.0, 0.0, 0.0, 0.0]), (CAMERA, [-8, 0, 5, 0, -0.3, 0.0])
    )
    with pytest.raises(InspeError, match="information gain needs traffic"):
        evaluate(scene, layout)
    scores = evaluate(scene, layout, weights=(0.5, 0.5, 0.0))
    f = raycast.in_view(scene, layout, "exact").any(0)
    assert scores.occlusion == pytest.approx(f.mean(), abs=1e-3)
    assert scores.information_gain == 0


def test_a_sensor_that_sees_all_scores_one():
    """A LiDAR of many dense channels above the scene."""
    dense = LidarSpec(
        "dense", tuple(np.radians(np.linspace(-90, 10, 400)).tolist()), 1800, 2 * np.pi, 100.0
    )
    scene = world(seed=1)
    high = place_sensors((dense, [0.1, 0.1, 9.0, 0.0, 0.0, 0.0]))
    scores = evaluate(scene, high)
    assert scores.coverage == 1.0
    assert scores.information_gain == 1.0
    assert scores.region_coverage == pytest.approx(dict.fromkeys(scores.region_coverage, 1))


def test_contributions_are_leave_one_out_drops():
    """None is negative: adding a sensor never lowers a score."""
    scene = world(seed=6)
    layout = random_layout(scene, [LIDAR, CAMERA, CAMERA, LIDAR], seed=6)
    scores = evaluate(scene, layout)
    sensors = [(s.spec, p) for s, p in zip(layout.sensors, layout.poses.tolist(), strict=True)]
    for s, row in enumerate(scores.contributions):
        without = evaluate(scene, place_sensors(*sensors[:s], *sensors[s + 1 :]))
        for name in FOUR:
            drop = getattr(scores, name) - getattr(without, name)
            assert getattr(row, name) == pytest.approx(drop, abs=2e-6)
            assert getattr(row, name) >= 0


def test_targets_are_the_vehicles_own_voxels_and_do_not_hide_themselves():
    """One car in full view: every voxel of it that is in view counts as seen."""
    scene = with_boxes(world(**SMALL), (5.0, 0.0, 0.0, 4.0, 1.8, 1.5))
    scene = replace(scene, traffic=_again(scene.traffic, away=(5.0, 0.25)))
    layout = place_sensors((FEW, [0.0, 0.0, 5.0, 0.0, 0.0, 0.0]))
    scores = evaluate(scene, layout, occlusion_reference="targets")
    f = raycast.in_view(scene, layout, "exact")[0]
    shares = [f[solid_voxels(scene, k)].mean() for k in range(4)]
    assert scores.occlusion == pytest.approx(np.mean(shares), abs=1e-6)
    # A truck in between hides it.
    hidden = with_boxes(scene, (5.0, 0.0, 0.0, 4.0, 1.8, 1.5), (2.0, 0.0, 0.0, 1.0, 8.0, 4.9))
    hidden = replace(hidden, traffic=_again(hidden.traffic, away=(5.0, 0.25)))
    assert evaluate(hidden, layout, occlusion_reference="targets").occlusion < scores.occlusion


def _again(traffic, away):
    """The frame four times, its first box moved in one of them, so that there is entropy."""
    four = jax.tree.map(lambda leaf: np.repeat(leaf, 4, 0), traffic)
    four.center[1, 0, :2] += away
    return four


@pytest.mark.parametrize(
    ("visibility", "references"),
    [("line_of_sight", ("covered",)), ("past_others", ("roi", "targets"))],
)
def test_information_gain_in_sight_is_that_of_embree(visibility, references):
    """Past the others: each voxel inside a vehicle once more, with that vehicle taken away."""
    scene, frames = world(count=10, seed=5), range(4)
    layout = random_layout(scene, SPECS, seed=2, heights=(1.0, 5.0))
    solid = np.stack([solid_voxels(scene, k) for k in frames])
    p = np.clip(solid.mean(0), 1e-12, 1 - 1e-12)
    h = -p * np.log(p) - (1 - p) * np.log(1 - p)
    share = np.zeros((len(SPECS), scene.voxels.count))
    for k in frames:
        clear = embree_line_of_sight(scene, layout, k)
        assert not (clear & solid[k]).any()
        if visibility == "past_others":
            clear |= _past_others(scene, layout, k, solid[k])
        share += clear / len(frames)
    f = raycast.in_view(scene, layout, "exact")
    q = 1 - np.prod([1 - s.reliability * x for s, x in zip(SPECS, f * share, strict=True)], axis=0)
    found = set()
    for reference in references:
        scores = evaluate(scene, layout, visibility=visibility, occlusion_reference=reference)
        found.add(scores.information_gain)
        assert scores.information_gain == pytest.approx((q * h).sum() / h.sum(), abs=1e-3)
        plain = evaluate(scene, layout, occlusion_reference=reference)
        assert scores.occlusion == plain.occlusion
        assert scores.information_gain < plain.information_gain
    assert len(found) == 1


def _past_others(scene, layout, k, solid):
    """Line of sight to the voxels inside vehicles, without the vehicles that each is in."""
    traffic, clear = scene.traffic, np.zeros((len(layout), len(solid)), bool)

    def without(gone, alone):
        valid = traffic.valid.copy()
        valid[k] &= alone == gone
        return replace(scene, traffic=replace(traffic, valid=valid))

    number = np.arange(traffic.valid.shape[1])
    inside = {b: solid_voxels(without(b, number), k) for b in np.flatnonzero(traffic.valid[k])}
    owners = np.stack(list(inside.values()))
    for owner in np.unique(owners[:, solid], axis=1).T:
        own = np.array(list(inside))[owner]
        left = without(True, ~np.isin(number, own))
        these = (owners == owner[:, None]).all(0)
        clear[:, these] = embree_line_of_sight(left, layout, k)[:, these]
    return clear


def moved(scene: Scene, turn: np.ndarray, shift: np.ndarray) -> Scene:
    """The whole world under x → turn·x + shift (a rotation or a mirror), voxelised anew."""
    place, t = scene.intersection, scene.traffic
    matrix = [*turn.ravel(), *shift[:2]]
    point = lambda p: np.column_stack([p[:, :2] @ turn.T + shift[:2], p[:, 2] + shift[2]])  # noqa: E731
    heading = np.stack([np.cos(t.yaw), np.sin(t.yaw)], -1) @ turn.T
    new = replace(
        place,
        center=point(place.center[None])[0],
        regions={k: affinity.affine_transform(g, matrix) for k, g in place.regions.items()},
        ground_points=point(place.ground_points),
    )
    traffic = replace(
        t,
        center=point(t.center.reshape(-1, 3)).reshape(t.center.shape),
        yaw=np.arctan2(heading[..., 1], heading[..., 0]),
    )
    grid = build_voxels(new, radius=scene.voxels.radius, voxel=scene.voxels.size)
    return Scene(grid, traffic, new)


QUARTER = np.array([[0.0, -1.0], [1.0, 0.0]])
MIRROR = np.array([[1.0, 0.0], [0.0, -1.0]])


@pytest.mark.parametrize(
    ("turn", "shift"),
    [(QUARTER, np.zeros(3)), (MIRROR @ QUARTER, np.array([100.0, 250.0, -3.0]))],
    ids=["quarter-turn", "all"],
)
def test_moving_the_whole_world_changes_nothing(turn, shift):
    """To 2e-4: the world is rounded anew in single precision (1e-5 m on 50 m), which can flip
    the few voxels that a ray or a shadow's edge only just touches."""
    scene = world(seed=8)
    layout = random_layout(scene, SPECS, seed=8)
    poses = layout.poses.copy()
    poses[:, :3] = np.column_stack([poses[:, :2] @ turn.T, poses[:, 2]]) + shift
    heading = np.stack([np.cos(poses[:, 5]), np.sin(poses[:, 5])], -1) @ turn.T
    poses[:, 5] = np.arctan2(heading[:, 1], heading[:, 0])
    if np.linalg.det(turn) < 0:
        poses[:, 3] *= -1  # a mirror turns roll about
    before = evaluate(scene, layout)
    after = evaluate(moved(scene, turn, shift), layout.with_poses(poses))
    for name in FOUR:
        assert getattr(after, name) == pytest.approx(getattr(before, name), abs=2e-4)


def test_unknown_options():
    scene, layout = world(), place_sensors((LIDAR, [0.0, 0.0, 5.0, 0.0, 0.0, 0.0]))
    for options, words in (
        (dict(occlusion_reference="x"), "occlusion_reference 'x': one of roi"),
        (dict(visibility="x"), "visibility 'x': one of in_view"),
        (dict(weights=(1, 1, 1)), "sum to 1"),
    ):
        with pytest.raises(InspeError, match=words):
            evaluate(scene, layout, **options)


def test_settings_and_seen_share():
    scene = world()
    layout = random_layout(scene, [LIDAR], seed=0)
    scores = evaluate(scene, layout)
    assert scores.parts == {}  # it is all core
    assert metrics.weights_of(scores.settings["weights"]) == metrics.weights_of()
    assert scores.seen_share.shape == (len(scene.voxels.columns),)
    assert 0 < scores.seen_share.mean() < scores.coverage + 0.05


def test_many_layouts_score_as_they_do_one_by_one():
    scene = world(seed=6)
    layout = random_layout(scene, [LIDAR, CAMERA], seed=1)
    poses = np.stack([random_layout(scene, [LIDAR, CAMERA], seed=k).poses for k in range(5)])
    options = dict(visibility="line_of_sight", weights=(0.2, 0.2, 0.6))
    many = evaluate_many(scene, layout, poses, **options)
    alone = [evaluate(scene, layout.with_poses(row), **options) for row in poses]
    for name in FOUR:
        # The same counts; their sums may be rounded in another order.
        one_by_one = [getattr(scores, name) for scores in alone]
        np.testing.assert_allclose(getattr(many, name), one_by_one, 0, 3e-7)
    assert np.ptp(many.surrogate) > 0.01


def test_scenes_layouts_and_metrics_are_taken_by_name(tmp_path):
    scene = ij.build_scene("four_way", radius=15, voxel=2.0, frames=2, density=4)
    layout = ij.strategy(scene, "Cam-d1")
    files = tmp_path / "scene.npz", str(tmp_path / "layout.yaml")
    ij.save_scene(scene, files[0])
    ij.save_layout(layout, files[1])
    layout = ij.load_layout(files[1], scene)
    scores = evaluate(scene, layout, metrics="all")
    assert tuple(scores.metrics) == tuple(metrics.METRICS)
    assert evaluate(*files, metrics=", ".join(metrics.METRICS)) == scores
    many = evaluate_many(*files, layout.poses[None], metrics="all")
    assert {name: value.item() for name, value in many.metrics.items()} == pytest.approx(
        scores.metrics, abs=1e-6
    )
    assert ij.in_view(*files).shape == (len(layout), scene.voxels.count)
    assert ij.line_of_sight(*files, 0).shape == (len(layout), scene.voxels.count)
    assert ij.target_view(*files).found.shape == (len(layout), len(scene.voxels.columns))
    by_name = evaluate(scene, "cam-D1", metrics="all")
    assert by_name.metrics == pytest.approx(scores.metrics, abs=1e-4)  # files are rounded
    assert "P_sm 0." in repr(by_name)


@pytest.mark.parametrize(
    ("mistake", "message"),
    [
        (lambda s, w: evaluate(w, s), "scene: got <Layout: .*, of type Layout; give a Scene, or"),
        (lambda s, w: evaluate(s, s), "layout: got <Scene: .*, of type Scene; give a Layout, the"),
        (lambda s, w: evaluate("four-way", w), "no scene 'four-way'.*did you mean four_way"),
        (lambda s, w: evaluate(s, "Cam-d9"), "no layout 'Cam-d9'.*did you mean Cam-d"),
        (lambda s, w: evaluate(s, w, metrics="al"), "metric 'al': a metric is one of"),
        (lambda s, w: ij.target_view(s, w, "pedestrain"), "did you mean pedestrian"),
        (lambda s, w: ij.build_scene(s), "intersection: got <Scene: .*or an Intersection"),
        (lambda s, w: ij.build_scene("a.xodr"), "intersection: got 'a.xodr'.*read_map"),
        (lambda s, w: w.with_poses([[1.0, 2.0]]), r"poses have shape \(1, 2\), expected \(1, 6\)"),
        (lambda s, w: w.with_poses("here"), "poses: give rows of six numbers"),
        (lambda s, w: ij.optimise(s, w, objective={}), r"objective: got {}, .*Objective\(…\)"),
        (lambda s, w: ij.optimise(s, w, constraints=3), r"inspe_jax.Constraints\(…\)"),
        (lambda s, w: ij.optimise([s, "x"], w), "no scene 'x'"),
        (lambda s, w: ij.compare(s, w, objective=w), "objective: got <Layout"),
        (lambda s, w: ij.pareto(w, {"velodyne-vlp-16": [1]}), "scene: got <Layout"),
        (lambda s, w: ij.cheapest(s, {}, 0.9, objective=3), "objective: got 3"),
        (lambda s, w: ij.tolerance(w, s), "scene: got <Layout"),
        (lambda s, w: ij.sweep(s, "x"), "study: got <Scene.*; give a Study, as load_study"),
        (lambda s, w: ij.save_scene("x.npz", s), "scene: got 'x.npz', of type str; give a Scene"),
        (lambda s, w: ij.save_layout("x.yaml", w), "layout: got 'x.yaml', of type str; give a"),
        (lambda s, w: ij.strategy("Cam-d1", s), "no scene 'Cam-d1'"),
        (
            lambda s, w: evaluate(s, _with(w, reach=np.nan)),
            r"sensors\[0\].spec.reach: nan is not finite",
        ),
        (lambda s, w: evaluate(s, _with(w, reach=-2.0)), "'test-lidar': range_m: .* got -2.0"),
        (lambda s, w: evaluate(s, _with(w, azimuth_count=0)), "'test-lidar': it has no rays"),
        (lambda s, w: evaluate(s, _with(w, elevations=(0.2, 0.1))), "must ascend"),
        (lambda s, w: evaluate(s, _with(w, reliability=1.5)), "reliability: .* got 1.5"),
        (lambda s, w: evaluate(s, replace(w, units=())), "sensor 's0': there is no unit 0"),
    ],
)
def test_first_mistakes_say_what_is_wanted(mistake, message):
    scene = world(radius=10.0, voxel=2.0, frames=2, count=6)
    with pytest.raises(InspeError, match=message):
        mistake(scene, place_sensors((LIDAR, [0.0, 0.0, 5.0, 0, 0, 0])))


def _with(layout, **changed):
    """The layout with another device."""
    sensor = layout.sensors[0]
    return replace(layout, sensors=(replace(sensor, spec=replace(sensor.spec, **changed)),))


@pytest.mark.parametrize(
    ("poses", "message"),
    [
        (np.zeros((2, 6)), r"shape \(2, 6\): \(M, 2, 6\)"),
        (np.zeros((0, 2, 6)), r"shape \(0, 2, 6\)"),
        (np.full((1, 2, 6), np.nan), "not finite"),
        (np.full((1, 2, 6), -9.0), r"poses\[0\].*in the ground"),
        ([[1.0], [2.0, 3.0]], r"numbers \(M, 2, 6\) are needed"),
        ("abc", "numbers"),
    ],
)
def test_poses_of_many_layouts_are_checked(poses, message):
    scene = world()
    layout = random_layout(scene, [LIDAR, CAMERA], seed=1)
    with pytest.raises(InspeError, match=message):
        evaluate_many(scene, layout, poses)
