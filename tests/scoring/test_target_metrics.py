"""What a detector gets, as metrics and as maps: against Embree, walked rays, and by hand."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from worlds import (
    CAMERA,
    LIDAR,
    TALL,
    box_triangles,
    embree_line_of_sight,
    emptied,
    place_sensors,
    rays_on_box,
    triangles,
    with_boxes,
    world,
)

import inspe_jax
from inspe_jax import Softness, evaluate
from inspe_jax.core.arrays import from_center, pad_rows
from inspe_jax.core.errors import InspeError
from inspe_jax.core.geometry import rotation
from inspe_jax.report.targets import PIXELS, banded, targets_change, targets_record, targets_view
from inspe_jax.scene.regions import PAPER_WEIGHTS
from inspe_jax.scene.statics import body, octagon
from inspe_jax.scene.traffic.frames import CLASSES, ROAD_USERS
from inspe_jax.scoring.detection import BANDS, FEW, detection_curves
from inspe_jax.scoring.exact import ONE_MORE, evidence_of_tiles
from inspe_jax.scoring.metrics import chosen
from inspe_jax.scoring.options import ScoreOptions
from inspe_jax.scoring.target_evidence import TargetEvidence, _look
from inspe_jax.scoring.target_metrics import UNKNOWN, position_error, redundancy
from inspe_jax.scoring.targets import target_view
from inspe_jax.scoring.tiled_scene import tiled_scene_of
from inspe_jax.sensing.layout import Sensor, Unit, make_layout
from inspe_jax.sensing.sensor_array import SensorSet, sensor_array
from inspe_jax.sensing.signals import LidarNoise

FURTHER = ("detectability", "points_on_target", "pixel_density", "localisation", "redundancy")
UNWEIGHTED = dict(metrics=FURTHER, weights=(0.5, 0.5, 0.0))
"""Without traffic there is no information gain."""
KEPT = 1.0 - LidarNoise().lost
"""Share of returns that come back from so near that none is weak."""
AWAY = (LIDAR, [0.0, 0.0, 40.0, 0.0, 0.0, 0.0])
"""It sees nothing; cameras beside it are served by what serves the layout."""


@pytest.fixture(scope="module")
def scene():
    return world(frames=6, count=10, seed=7)


@pytest.fixture(scope="module")
def empty(scene):
    return emptied(scene)


@pytest.fixture(scope="module")
def layout():
    """Two units: a LiDAR and a camera on one pole, and a LiDAR on another."""
    sensors = [
        (LIDAR, 0, [9.0, 9.0, 5.0, 0.0, 0.0, 0.3]),
        (CAMERA, 0, [9.0, 9.0, 4.5, 0.0, -0.25, -2.4]),
        (LIDAR, 1, [-11.0, -8.0, 4.0, 0.0, 0.03, 1.0]),
    ]
    units = [Unit("a", (9.0, 9.0, 0.0)), Unit("b", (-11.0, -8.0, 0.0))]
    made = [Sensor(f"s{k}", spec, unit) for k, (spec, unit, _) in enumerate(sensors)]
    return make_layout(made, units, np.array([pose for *_, pose in sensors], float))


@pytest.fixture(scope="module")
def scores(scene, layout):
    return evaluate(scene, layout, metrics=FURTHER)


def weighted(scene, values):
    """The mean of a value of each column, weighted by region."""
    weight = scene.voxels.column_weight
    return float(values @ weight / weight.sum())


def on_slabs(scene, layout, user, columns):
    """Returns or pixels (S, L, Z) on each slab of a road user at some columns, of rays that are
    walked one by one."""
    grid = scene.voxels
    edges, found = np.arange(grid.level_count + 1) * grid.spacing, []
    edges[-1] = np.inf
    for pose, sensor in zip(np.asarray(layout.poses, float), layout.sensors, strict=True):
        spec = sensor.spec
        share = spec.pixels_per_ray if spec.focal_pixels else KEPT
        feet = np.column_stack([grid.columns, grid.ground])[columns]
        rays = [rays_on_box(spec, pose, foot, user.size, edges) for foot in feet]
        found.append(np.stack(rays) * share)
    return np.stack(found)


@pytest.fixture(scope="module")
def clear(scene, layout):
    """Line of sight (T, S, L, Z) to the voxels by Embree; and the columns that stay free."""
    frames = range(scene.traffic.frame_count)
    seen = np.stack([embree_line_of_sight(scene, layout, k) for k in frames])
    traffic, columns = scene.traffic, scene.voxels.columns
    away = np.linalg.norm(columns[:, None, None] - traffic.center[None, ..., :2], axis=-1)
    free = np.where(traffic.valid[None], away, 99.0).min((1, 2)) > 5.0
    return seen.reshape(*seen.shape[:2], len(columns), -1), free


def chance(curve, number):
    """The chance of detection in NumPy, by its definition."""
    with np.errstate(divide="ignore"):
        return curve.most / (1 + (curve.half / number) ** curve.slope)


def test_the_chance_of_detection_is_that_of_every_frame(scene, layout, clear):
    """One sensor: exact, up to how rays on a target are counted. Several: they are independent.

    From 8 m on: nearer, a car or a truck is longer than it is far away, and some of it is in view
    where its middle is not. There the score is too low, never too high.
    """
    seen, free = clear
    places = np.asarray(layout.poses)[:, :2]
    away = np.linalg.norm(scene.voxels.columns[:, None] - places[None], axis=-1)
    free = np.flatnonzero(free & (away.min(1) > 8.0))
    columns = np.sort(np.random.default_rng(0).choice(free, 120, replace=False))
    region = np.full_like(scene.voxels.region, 4)
    region[columns] = scene.voxels.region[columns]
    only = replace(
        scene, voxels=replace(scene.voxels, region=region, region_weight=(*PAPER_WEIGHTS[:4], 0.0))
    )
    weight = only.voxels.column_weight[columns]
    on_users = [on_slabs(scene, layout, user, columns) for user in ROAD_USERS]
    for sensors in ([0], [1], [0, 1, 2]):
        joint = []
        for k, on_user in enumerate(on_users):
            number, missed = on_user[None] * seen[:, :, columns], 1.0
            for s in sensors:
                curve = detection_curves().of(layout.sensors[s].spec.kind)[k]
                missed = missed * (1 - chance(curve, number[:, s].sum(-1)))
            joint.append((1 - missed).mean(0))
        expected = np.mean(joint, 0) @ weight / weight.sum()
        found = evaluate(only, blinded(layout, sensors), metrics=FURTHER).metrics["detectability"]
        assert 0.2 < expected < 0.99
        assert found == pytest.approx(expected, abs=0.01), sensors


def blinded(layout, sensors):
    """The layout with all but these sensors blind beyond 3 m; what serves the layout serves it."""
    blind = [
        sensor if s in sensors else replace(sensor, spec=sensor.spec.with_performance(1.0, 3.0))
        for s, sensor in enumerate(layout.sensors)
    ]
    return replace(layout, sensors=tuple(blind))


def replace_sensors(layout, sensors):
    members = [layout.sensors[s] for s in sensors]
    used = sorted({sensor.unit for sensor in members})
    moved = [replace(sensor, unit=used.index(sensor.unit)) for sensor in members]
    return make_layout(moved, [layout.units[u] for u in used], np.asarray(layout.poses)[sensors])


def test_metrics_are_means_of_the_maps(scene, layout, scores):
    """Returns of all LiDARs together, pixels per metre of the best camera, and chances."""
    views = [target_view(scene, layout, name) for name in CLASSES]
    enough = np.mean([view.points_on_target >= FEW for view in views], 0)
    assert scores.metrics["points_on_target"] == pytest.approx(weighted(scene, enough), abs=1e-6)
    sharp = views[CLASSES.index("pedestrian")].pixel_density >= 25.0
    assert 0.02 < sharp.mean() < 0.9
    assert scores.metrics["pixel_density"] == pytest.approx(weighted(scene, sharp), abs=0.002)
    found = weighted(scene, np.mean([view.detectability for view in views], 0))
    assert scores.metrics["detectability"] == pytest.approx(found, abs=1e-6)


def test_two_units_see_a_voxel(scene, layout, scores):
    """As often as chance has it from what each of their sensors sees; two on one pole are one."""
    seen = sight_of(scene, layout)
    unit = np.array([sensor.unit for sensor in layout.sensors])
    each = np.stack([seen[unit == u].max(0) for u in range(2)])
    expected = weighted(scene, each.prod(0).reshape(len(scene.voxels.columns), -1).mean(1))
    assert 0.05 < expected < 0.95
    assert scores.metrics["redundancy"] == pytest.approx(expected, abs=1e-5)
    by_hand = jax.jit(redundancy)(np.array([[0.5, 1.0, 0.0]]), np.array([1.0, 1.0, 2.0]))
    assert float(by_hand[0]) == pytest.approx(0.375)
    alone = evaluate(scene, replace_sensors(layout, [0, 1]), metrics=FURTHER)
    assert alone.metrics["redundancy"] == pytest.approx(0, abs=1e-9)


def sight_of(scene, layout):
    """The share of frames in which each sensor sees each voxel (S, V), from the lines of sight that
    scores count, which have tests of their own. Embree does not look past a road user itself."""
    tiled, sensors = tiled_scene_of(scene), sensor_array(SensorSet.of(layout), ONE_MORE)
    poses = pad_rows(from_center(scene.voxels.center, layout.poses), len(sensors.kind))
    asked = ScoreOptions.of(visibility="past_others")
    counts = evidence_of_tiles(tiled, poses, sensors, scene.voxels.size, asked)[1]
    share = tiled.tiles.of_voxels(np.asarray(counts.sights)) / scene.traffic.frame_count
    return inspe_jax.in_view(scene, layout) * share[: len(layout)]


def test_what_a_sensor_adds_is_what_the_layout_lacks_without_it(scene, layout, scores):
    for s in (0, 2):
        rest = [k for k in range(len(layout)) if k != s]
        without = evaluate(scene, replace_sensors(layout, rest), metrics=FURTHER)
        for name in scores.metrics:
            expected = scores.metrics[name] - without.metrics[name]
            part = scores.contributions[s].metrics[name]
            assert part == pytest.approx(expected, abs=2e-6), name


def test_asking_for_more_changes_no_other_number(scene, layout, scores):
    usual = evaluate(scene, layout)
    assert list(usual.metrics) == ["coverage", "occlusion", "information_gain"]
    assert {name: scores.metrics[name] for name in usual.metrics} == usual.metrics
    assert scores.surrogate == usual.surrogate
    past = evaluate(scene, layout, visibility="past_others", metrics=FURTHER)
    assert past.information_gain < scores.information_gain
    for name in FURTHER:
        assert past.metrics[name] == scores.metrics[name]


def test_weights_bring_a_metric_with_them(scene, layout, scores):
    weights = {"detectability": 1.0}
    found = evaluate(scene, layout, weights=weights, metrics=FURTHER)
    assert found.surrogate == pytest.approx(scores.metrics["detectability"], abs=1e-6)
    assert chosen((), weights) == (*chosen(), "detectability")
    with pytest.raises(InspeError, match="did you mean detectability"):
        evaluate(scene, layout, metrics=("detectabilty",))


def test_classes_of_road_users_count_alone(scene, layout, scores):
    """The mean over all classes is that over some of the means of each."""
    parts = ("pedestrian",), ("car", "cyclist", "truck")
    of = [detection_curves().for_road_users(names) for names in parts]
    found = [evaluate(scene, layout, metrics=FURTHER, detection=curves) for curves in of]
    for name in ("detectability", "points_on_target"):
        few, many = (one.metrics[name] for one in found)
        assert name != "detectability" or abs(few - many) > 1e-3
        assert (few + 3 * many) / 4 == pytest.approx(scores.metrics[name], abs=1e-6), name
    assert [one.settings["road_users"] for one in found] == [["pedestrian"], list(CLASSES[:3])]
    for name in ("coverage", "pixel_density", "redundancy"):
        assert [one.metrics[name] for one in found] == [scores.metrics[name]] * 2, name
    with pytest.raises(InspeError, match="road user 'dog': one of car"):
        detection_curves().for_road_users(["dog"])


@pytest.mark.slow
def test_columns_in_slabs_of_levels_are_whole(layout):
    """Columns of more levels than a word has bits give what those of fewer give."""
    fine, coarse = world(**TALL), world(**TALL | dict(voxel=0.25))
    assert fine.voxels.level_count > 32
    far = place_sensors((LIDAR, [30.0, 5.0, 6.0, 0.0, 0.0, 0.0]), (CAMERA, [-22, 0, 5, 0, -0.1, 0]))
    a, b = (evaluate(of, far, metrics=FURTHER).metrics for of in (fine, coarse))
    for name in ("detectability", "points_on_target", "pixel_density", "localisation"):
        assert a[name] == pytest.approx(b[name], abs=0.015), name


def test_an_error_of_place_by_hand():
    """Nothing seen leaves what is unknown; one bearing removes half; two cross."""
    compiled = jax.jit(position_error)

    def error(*information):
        return np.asarray(compiled(np.float32(information)[None, :, None])).item()

    assert error(0, 0, 0) == pytest.approx(2**0.5 * UNKNOWN, rel=1e-6)
    assert error(1e6, 0, 0) == pytest.approx(UNKNOWN, rel=1e-3)
    assert error(1e6, 0, 1e6) == pytest.approx(2e-3**0.5 / 1e3**0.5, rel=0.1)
    assert error(5e5, 5e5, 5e5) == pytest.approx(UNKNOWN, rel=1e-2)  # one bearing at 45°


def test_two_cameras_measure_where_one_does_not(empty):
    """From far off and low, one picture hardly tells the distance; a second, square to it, does."""
    far = CAMERA.with_performance(1.0, 80.0)
    west, south = (
        (far, [*at, 3.0, 0.0, -0.1, yaw]) for at, yaw in (((-35.0, 0.0), 0.0), ((0.0, -35.0), 1.57))
    )
    alone, crossed = (
        evaluate(empty, place_sensors(AWAY, *cameras), **UNWEIGHTED).metrics["localisation"]
        for cameras in ([west], [west, south])
    )
    assert 0.2 < alone < crossed
    assert 1 - crossed < 0.6 * (1 - alone)


def test_a_camera_knows_nothing_of_what_is_behind_it(empty):
    """Nor is anything found there, nor pixels counted, however the scene is cut into tiles."""
    behind = empty.voxels.columns[:, 0] < -3
    only = replace(empty.voxels, region=np.where(behind, 0, 1), region_weight=(1.0, 0, 0, 0, 0))
    layout = place_sensors(AWAY, (CAMERA, [0.0, 0.0, 6.0, 0.0, -0.2, 0.0]))
    found = evaluate(replace(empty, voxels=only), layout, **UNWEIGHTED).metrics
    assert [found[name] for name in FURTHER] == pytest.approx([0] * 5, abs=1e-6)


def test_units_without_sensors_do_not_matter(scene, layout, scores):
    """Sensors on the first and the last of five units are on two units."""
    first, last = layout.units
    spare = tuple(Unit(f"spare {k}", (0.0, 0.0, 0.0)) for k in range(3))
    sensors = tuple(replace(s, unit=4 * s.unit) for s in layout.sensors)
    apart = replace(layout, units=(first, *spare, last), sensors=sensors)
    assert evaluate(scene, apart, metrics=FURTHER).metrics == scores.metrics


def test_softly_they_become_the_exact_ones(scene, layout, scores):
    sharp = Softness(1e-4, 1e-4, "exact")
    soft = evaluate(scene, layout, metrics=FURTHER, softness=sharp).metrics
    for name in FURTHER:
        assert soft[name] == pytest.approx(scores.metrics[name], abs=2e-3), name
        assert scores.metrics[name] > 0


@pytest.mark.slow
@pytest.mark.parametrize("s", [0, 1])
def test_slopes_in_the_pose_are_those_of_reverse_mode(scene, layout, s):
    """With random wishes of all that a sensor has on road users, some of them behind traffic."""
    sensors = sensor_array(SensorSet.of(layout))
    tile = jax.tree.map(lambda leaf: leaf[0], tiled_scene_of(scene).tiles.tile)
    table, pixels = jax.tree.map(lambda leaf: jnp.asarray(leaf[s]), (sensors.table, sensors.pixels))
    pose = jnp.asarray(from_center(scene.voxels.center, layout.poses)[s], float)
    sight = np.random.default_rng(s).uniform(size=tile.heights.shape).clip(0.3) - 0.3
    look = sensors.kinds[sensors.kind[s]], detection_curves(), TargetEvidence._fields
    given = table, pixels, tile, jnp.array(True), jnp.array(0.5)

    @partial(jax.jit, static_argnums=0)
    def slopes(of):
        rng = np.random.default_rng(s)
        found, back = jax.vjp(lambda *at: of(*look, *at, given), pose, jnp.asarray(sight, float))
        return back(jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape), float), found))

    for ours, theirs in zip(slopes(_look), slopes(_look.fun), strict=True):
        assert jnp.abs(theirs).max() > 0
        np.testing.assert_allclose(ours, theirs, 0, 2e-5 * jnp.abs(theirs).max())


# ── Maps ────────────────────────────────────────────────────────────────────


@pytest.fixture(scope="module")
def lidars():
    return place_sensors(
        (LIDAR, [9.0, 9.0, 5.0, 0.0, 0.0, 0.3]), (LIDAR, [-9.0, -9.0, 4.0, 0.0, 0.03, 1.0])
    )


@pytest.mark.parametrize("name", ["pedestrian", "car"])
def test_returns_behind_traffic_are_those_of_rays_that_are_cast(scene, empty, lidars, name):
    """Some columns, six frames, eight headings: rays that meet the target before any vehicle.

    In the mean over these columns within 5 %, and each within 15 % and three returns: traffic hides
    whole slabs here, by the line to the middle of the column, and parts of slabs there.
    """
    caster = pytest.importorskip("inspe_jax.simulation.embedded.embree").Caster
    pytest.importorskip("embreex")
    user = ROAD_USERS[CLASSES.index(name)]
    view, open_ = (target_view(of, lidars, name) for of in (scene, empty))
    traffic, columns = scene.traffic, scene.voxels.columns
    away = np.abs(columns[:, None, None] - traffic.center[None, ..., :2]).max(-1)
    free = np.where(traffic.valid[None], away, 99.0).min((1, 2)) > 4.0
    rng = np.random.default_rng(0)
    chosen = rng.choice(np.flatnonzero(free), 8, replace=False)
    body, found = LIDAR.grid.directions(), np.zeros(len(chosen))
    headings = np.arange(8) * np.pi / 8 + 0.1
    for k in range(traffic.frame_count):
        around = triangles(scene, k)
        for i, column in enumerate(chosen):
            for yaw in headings:
                target = box_triangles((*columns[column], 0.0), user.size, yaw)
                world_of = caster(np.concatenate([target, around]))
                for pose in np.asarray(lidars.poses):
                    to = [*columns[column], 1.0] - pose[:3]
                    toward = body @ (rotation(pose[3:], np).T @ to) / np.linalg.norm(to)
                    near = body[toward > np.cos(min(2.5, 4.0 / np.linalg.norm(to[:2]) + 0.3))]
                    hits = world_of.cast(pose[:3], near @ rotation(pose[3:], np).T, 50.0)
                    found[i] += ((hits.face >= 0) & (hits.face < 12)).sum()
    found /= traffic.frame_count * len(headings)
    expected = view.points_on_target[chosen] / KEPT
    assert (expected < 0.98 * open_.points_on_target[chosen] / KEPT).sum() >= 3
    assert expected.mean() == pytest.approx(found.mean(), rel=0.05)
    np.testing.assert_allclose(expected, found, rtol=0.15, atol=3.0)


def test_pixels_per_metre_by_hand(empty):
    """f / depth in the middle of the picture, however the camera rolls; nothing behind it or out of
    reach."""
    columns, near = empty.voxels.columns, CAMERA.with_performance(0.9, 15.0)
    row = (columns[:, 1] == 0.25) & (columns[:, 0] > 1)
    depth = columns[row, 0] - 0.25
    expected = np.where(depth < 15.0, CAMERA.focal / depth, 0.0)
    level, *rolled = (
        target_view(empty, place_sensors(AWAY, (near, [0.25, 0.25, 0.86, roll, 0.0, 0.0])))
        for roll in (0.0, 0.6, np.pi / 2)
    )
    np.testing.assert_allclose(level.pixel_density[row], expected, rtol=1e-4)
    assert not level.pixel_density[columns[:, 0] < 0].any()
    assert not level.points_on_target.any()
    # Aside it is more: a metre square on to the line of sight is further across the picture.
    aside = (columns == [10.25, 5.25]).all(1)
    away = np.hypot(10.0, 5.0)
    across = CAMERA.focal * away / 10.0**2  # d(y/x) over a metre along (−5, 10)/away
    assert level.pixel_density[aside] == pytest.approx(across, rel=1e-4)
    ahead = (columns == [10.25, 0.25]).all(1)
    for view in rolled:
        assert view.pixel_density[ahead] == pytest.approx(CAMERA.focal / 10.0, rel=1e-4)


def test_who_is_higher_than_the_region_is_not_cut(empty, lidars):
    """Levels of 3 m end below a truck's roof of 3.4 m."""
    low = emptied(world(frames=6, spacing=3.0))
    fine, cut = (target_view(of, lidars, "truck").points_on_target for of in (empty, low))
    assert cut.mean() == pytest.approx(fine.mean(), rel=0.05)


def test_fog_takes_what_is_far(scene, lidars):
    fog = inspe_jax.Conditions.of(weather="fog:50")
    clear, dim = target_view(scene, lidars), target_view(scene, lidars, conditions=fog)
    assert dim.points_on_target.sum() < 0.9 * clear.points_on_target.sum()
    assert (dim.returns <= clear.returns + 1e-4).all()


def test_bands_and_records():
    """Of EN 62676-4, in both editions."""
    density = np.array([0.0, 12.4, 12.5, 62.5, 249.0, 1e3])
    found = [banded(n * density, PIXELS[year], ()).values for n, year in ((1, "2015"), (2, "2025"))]
    assert np.array(found).tolist() == [[0, 0, 1, 3, 4, 5], [0, 1, 1, 4, 5, 7]]
    assert list(BANDS["2015"].values()) == [12.5, 25.0, 62.5, 125.0, 250.0]
    assert list(BANDS["2025"].values()) == [20.0, 40.0, 80.0, 125.0, 250.0, 500.0, 1500.0]


def test_the_map_has_one_panel_for_each_kind_of_sensor(scene, lidars):
    """And one for the chance of detection where there is only one kind."""
    view = target_view(scene, lidars)
    assert len(targets_view(scene, lidars, view).axes) == 2
    assert "pixels_per_metre" not in targets_record(scene, lidars, view)
    with pytest.raises(InspeError, match="frame 99 is out of range"):
        targets_view(scene, lidars, view, frame=99)
    blind = place_sensors((CAMERA, [9.0, 9.0, 5.0, 0, 0.5, 0.8]))
    view = target_view(scene, blind)
    assert not view.pixel_density.any()
    assert view.detectability.mean() < 0.01
    assert len(targets_view(scene, blind, view).axes) == 2
    both = place_sensors((LIDAR, [9.0, 9.0, 5.0, 0, 0, 0]), (CAMERA, [9.0, -9.0, 5.0, 0, -0.2, 2]))
    view = target_view(scene, both)
    assert len(targets_view(scene, both, view).axes) == 2
    record = targets_record(scene, both, view)
    shares = record["lidar_returns"]["all"]["shares"]
    values = view.points_on_target
    assert shares["at least 5"] == pytest.approx((values >= 5).mean())
    assert set(record["pixels_per_metre"]["all"]["shares"]) == set(BANDS["2025"])
    record = targets_record(scene, both, view, edition="2015")
    assert set(record["pixels_per_metre"]["all"]["shares"]) == set(BANDS["2015"])
    assert len(targets_view(scene, both, view, edition="2015").axes) == 2
    assert record["detectability"]["all"] == pytest.approx(view.detectability.mean())
    assert len(targets_change(scene, (both, view), (both, view)).axes) == 4


def test_a_target_is_found_by_what_is_in_sight_of_it(empty):
    """Behind a truck all of a pedestrian is hidden; behind a car, what is above it is found."""
    layout = place_sensors((LIDAR, [-15.0, 0.25, 4.0, 0.0, 0.0, 0.0]))
    place = (empty.voxels.columns == [6.25, 0.25]).all(1)
    car, truck = (
        with_boxes(empty, (3.5, 0.25, 0, 3.0, 2.5, height), frames=6) for height in (1.2, 3.6)
    )
    views = [target_view(of, layout, "pedestrian") for of in (empty, car, truck)]
    found = [view.detectability[place] for view in views]
    assert found[0] > found[1] > 0.1
    assert found[2] == 0
    returns = [view.returns[0, place] for view in views]
    assert returns[0] > 10 * KEPT
    assert returns[2] == 0


def test_what_is_in_sight_below_a_crown_counts_for_itself(empty):
    """A beam hides all but the feet of a pedestrian from a low LiDAR in all frames."""
    beam = body("building", octagon(np.array([-6.0, 0.25]), 2.5), 4.0, base=1.0)
    layout = place_sensors((LIDAR, [-15.0, 0.25, 1.2, 0.0, 0.0, 0.0]))
    place = (empty.voxels.columns == [3.25, 0.25]).all(1)
    open_, below = (target_view(of, layout) for of in (empty, replace(empty, statics=(beam,))))
    returns = below.points_on_target[place]
    assert 0.2 < returns / open_.points_on_target[place] < 0.8
    curve = detection_curves().of("lidar")[CLASSES.index("pedestrian")]
    assert below.detectability[place] == pytest.approx(chance(curve, returns), rel=1e-5)
