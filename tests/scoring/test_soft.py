"""The soft reading: its limits, its ranks, its gradients; against the exact one and differences."""

import json
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense_reference import measure
from scipy.stats import spearmanr
from worlds import (
    CAMERA,
    LIDAR,
    SMALL,
    TALL,
    TINY,
    double_precision,
    place_sensors,
    random_layout,
    with_boxes,
    world,
)

import inspe_jax
from inspe_jax.core import parallel
from inspe_jax.core.arrays import from_center, pad_rows
from inspe_jax.core.compiling import compiled
from inspe_jax.core.numerics import Softness
from inspe_jax.report.tables import scores_record
from inspe_jax.scoring import driver, metrics, soft
from inspe_jax.scoring.driver import measure_tiles
from inspe_jax.scoring.numbers import Numbers
from inspe_jax.scoring.options import ScoreOptions
from inspe_jax.scoring.tiled_scene import SceneArrays, tiled_scene_of
from inspe_jax.sensing.sensor_array import SensorSet, sensor_array
from inspe_jax.sensing.sensors import LidarSpec
from inspe_jax.visibility.centered_scene import about_center
from inspe_jax.visibility.in_view import in_view_margins, transform_of

NEAR = LidarSpec("near", tuple(np.radians([-60.0, -40.0, -25.0, -10.0])), 360, 2 * np.pi, 18.0)
DENSE = LidarSpec("dense", tuple(np.radians(np.arange(-89.0, 30.0))), 720, 2 * np.pi, 99.0)
SHARP = Softness(1e-4, 1e-4, "exact")
"""0.1 mm, and rays as they are."""


def slow(*case):
    """A case that shows more of what the others show."""
    return pytest.param(*case, marks=pytest.mark.slow)


@pytest.fixture
def double():
    """Differences of 1e-6 need double precision; everything follows the type of a float."""
    with double_precision():
        yield


@pytest.mark.parametrize(
    ("reference", "visibility"),
    [("covered", "past_others"), slow("targets", "line_of_sight"), slow("roi", "in_view")],
)
def test_softness_to_zero_under_every_option(reference, visibility):
    """In all metrics, and in what each sensor adds. A record of soft scores says how they were
    read; none are of parts, which are counts."""
    scene = world(**SMALL, count=14)
    layout = random_layout(scene, [CAMERA, LIDAR], 3, heights=(3.0, 8.0))
    options = dict(occlusion_reference=reference, visibility=visibility)
    exact = inspe_jax.evaluate(scene, layout, **options)
    soft = inspe_jax.evaluate(scene, layout, softness=SHARP, **options)
    assert soft.metrics == pytest.approx(exact.metrics, abs=1e-4)
    assert soft.surrogate == pytest.approx(exact.surrogate, abs=1e-4)
    for ours, theirs in zip(soft.contributions, exact.contributions, strict=True):
        assert ours.surrogate == pytest.approx(theirs.surrogate, abs=2e-4)
    record = json.loads(json.dumps(scores_record(soft, scene, layout)))
    assert record["settings"]["softness"] == dict(field=1e-4, shadow=1e-4, rays="exact")
    assert soft.parts == {}


def test_what_lies_level_with_a_vehicle_is_hidden_softly_too():
    """Voxels of 1 m have their middles at 1.5 m, where round vehicles end."""
    boxes = (5.0, 0.3, 0.1, 4.3, 1.8, 1.5), (-4.0, 3.0, 1.2, 4.1, 1.7, 1.5)
    scene = with_boxes(world(**SMALL), *boxes, frames=4)
    layout = random_layout(scene, [CAMERA, LIDAR], 3, heights=(3.0, 8.0))
    options = dict(weights=(0.3, 0.7, 0.0))
    exact = inspe_jax.evaluate(scene, layout, **options)
    soft = inspe_jax.evaluate(scene, layout, softness=SHARP, **options)
    assert exact.occlusion < exact.coverage  # something is hidden
    assert soft.occlusion == pytest.approx(exact.occlusion, abs=1e-6)


def two_ways(scene, layout, failures, softness, **options):
    """Measures of poses: of every vehicle against every column, and tile by tile."""
    sensor_set, voxel = SensorSet.of(layout, failures), scene.voxels.size
    softness, sensors = Softness.of(softness), sensor_array(sensor_set)
    field = SceneArrays(about_center(scene), jnp.asarray(scene.voxels.weight, float))
    tiled = tiled_scene_of(scene, whole=True, masks=False)

    def plain(poses):
        return measure(field, poses, sensor_set, voxel, softness, **options)

    def by_tiles(poses):
        at = tiled.bucketed, pad_rows(poses, len(sensors.kind)), sensors, voxel
        found = measure_tiles(Numbers(softness), *at, options=ScoreOptions.of(**options))
        return found.of_scene(tiled.tiles.place, len(failures))

    return plain, by_tiles


@pytest.mark.slow
@pytest.mark.parametrize(("shadow", "rays"), [(0.0, "density"), (0.5, "exact")])
def test_tile_by_tile_is_all_vehicles_against_all_columns(shadow, rays):
    """Values to rounding; slopes to 1e-5 of the largest, sums of thousands in another order."""
    scene = world(**SMALL)
    layout = random_layout(scene, [CAMERA, LIDAR, CAMERA], 3, heights=(3.0, 8.0))
    apart = dict(occlusion_reference="covered", visibility="line_of_sight")

    def total(way, poses):
        measures = way(poses)
        return sum(value.sum() for value in measures.values.values()), measures

    (expected_slope, expected), (slope, found) = (
        jax.grad(partial(total, way), has_aux=True)(from_center(scene.voxels.center, layout.poses))
        for way in two_ways(scene, layout, ((0, 2), (1,)), Softness(0.5, shadow, rays), **apart)
    )
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-5, atol=2e-6), found, expected)
    assert np.abs(expected_slope).max() > 1e-3
    np.testing.assert_allclose(slope, expected_slope, 0, 1e-5 * np.abs(expected_slope).max())


@pytest.mark.parametrize(
    "size",
    [
        slow(TALL | dict(count=2)),  # more levels than a word has bits
        dict(voxel=2.0, radius=12.0, frames=131, count=3),  # two runs of frames
    ],
)
def test_slabs_of_levels_and_runs_of_frames_are_put_together(double, size):
    """All vehicles against all columns again; of two vehicles both win in every slab.

    In double precision what is left is the order of sums.
    """
    scene = world(seed=3, **size)
    layout = random_layout(scene, [LIDAR, CAMERA, CAMERA], seed=6, heights=(3.0, 6.0))
    poses = np.asarray(from_center(scene.voxels.center, layout.poses)) * [0.3, 0.3, 1, 1, 1, 1]
    expected, found = (way(poses) for way in two_ways(scene, layout, ((0, 2), (1,)), 0.5))
    assert 0.05 < float(expected.values["coverage"][0]) < 1
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-12, atol=1e-12), found, expected)


def test_soft_and_exact_scores_rank_layouts_alike():
    """Spearman at least 0.95 over 100 random layouts at a working softness of 1 m."""
    scene, specs = world(**SMALL, count=16), [CAMERA] * 3 + [LIDAR]
    layouts = [random_layout(scene, specs, seed, heights=(3.0, 8.0)) for seed in range(100)]
    exact = [inspe_jax.evaluate(scene, layout).surrogate for layout in layouts]
    soft = [inspe_jax.evaluate(scene, layout, softness=1.0).surrogate for layout in layouts]
    assert np.ptp(exact) > 0.005
    assert spearmanr(exact, soft).statistic >= 0.95


@pytest.mark.parametrize(
    ("seed", "softness", "names"),
    [(0, 1.0, metrics.chosen()), slow(3, 2.0, tuple(metrics.METRICS))],
)
def test_gradients_are_those_of_differences(double, seed, softness, names):
    """In double precision, of every metric, in every coordinate of cameras and a LiDAR.

    Few voxels and tiny steps: where which ray or vehicle wins changes within the step,
    the difference has a jump that the gradient has not.
    """
    scene = world(**TINY | dict(radius=12.0), seed=seed)  # two tiles
    # None reaches far: else all is covered, and stays so.
    specs = [spec.with_performance(0.9, 12.0) for spec in (LIDAR, CAMERA, CAMERA)]
    layout = random_layout(scene, specs, seed=5, heights=(3.0, 6.0))
    poses = np.asarray(layout.poses)

    def values(poses):
        moved = layout.with_poses(poses)
        found = inspe_jax.evaluate(scene, moved, softness=softness, metrics=names).metrics
        return (jnp.stack([*found.values()]),) * 2

    both = jax.jit(jax.jacrev(values, has_aux=True))
    slopes = np.asarray(both(poses)[0])
    found = np.zeros(slopes.shape)
    for at in np.ndindex(poses.shape):
        step = np.zeros(poses.shape)
        step[at] = 1e-7
        ends = (np.asarray(both(poses + sign * step)[1]) for sign in (1, -1))
        found[(slice(None), *at)] = (next(ends) - next(ends)) / 2e-7
    for name, slope, difference in zip(names, slopes, found, strict=True):
        largest = np.abs(slope).max()
        assert largest > 1e-3, name
        np.testing.assert_allclose(slope, difference, 1e-3, 1e-3 * largest, err_msg=name)


AWAY = [0.0, 0.0, 500.0, 0.0, 0.0, 0.0]  # where it sees nothing


@pytest.mark.parametrize(
    ("spec", "pose", "coordinate", "sign"),
    [
        # At the west end looking east and a little north: turn right (yaw down).
        (CAMERA, [-14.0, 0.0, 6.0, 0.0, -0.4, 0.9], 5, -1),
        (CAMERA, [-14.0, 0.0, 6.0, 0.0, -0.4, -0.9], 5, +1),
        # Looking at the sky, look down; at its own foot, look up.
        (CAMERA, [-14.0, 0.0, 6.0, 0.0, 0.3, 0.0], 4, -1),
        (CAMERA, [-14.0, 0.0, 6.0, 0.0, -1.5, 0.0], 4, +1),
        # With its reach half outside the scene, go back in.
        (NEAR, [-17.0, 0.0, 5.0, 0.0, 0.0, 0.0], 0, +1),
        (NEAR, [0.0, 17.0, 5.0, 0.0, 0.0, 0.0], 1, -1),
    ],
)
def test_gradients_point_where_common_sense_does(spec, pose, coordinate, sign):
    """Field of view and range alone."""
    own = int(spec is NEAR)
    poses = np.array([AWAY, AWAY])
    poses[own] = pose
    slope = slope_of("coverage", world(**SMALL), NEAR, poses, 1.0)
    assert slope[own, coordinate] * sign > 1e-3


def slope_of(metric, scene, lidar, poses, softness):
    """Of a camera and a LiDAR, by their poses."""
    layout = place_sensors((CAMERA, AWAY), (lidar, AWAY))

    def value(poses):
        found = inspe_jax.evaluate(scene, layout.with_poses(poses), softness=softness)
        # With all three, what is compiled serves any P_sm.
        return found.value(metric) + 0.0 * found.surrogate

    return np.asarray(jax.grad(value)(jnp.asarray(poses, float)))


def test_a_field_of_view_far_from_all_voxels_still_calls():
    """A camera that looks away sees nothing; its gradient must not vanish with its score."""
    scene = world(**SMALL)
    pose = [-14.0, 0.5, 6.0, 0.0, -0.2, np.pi - 0.9]
    seen = inspe_jax.in_view(scene, place_sensors((CAMERA, pose)))
    assert seen.mean() < 0.05
    assert slope_of("coverage", scene, NEAR, [pose, AWAY], 3.0)[0, 5] < -1e-3


@pytest.mark.parametrize("coordinate", range(3))
def test_shadows_alone_have_the_gradient_of_the_exact_score(coordinate):
    """A LiDAR that has all in view: what it loses, it loses to traffic.

    The exact score is a fine staircase: its difference over ±0.5 m, of some scenes together,
    against the mean soft slope along the way, at a softness of 5 cm.
    """
    start = np.array([[0.0, 0.0, 9.0, 0.0, 1.4, 0.0], [-10.0, 9.0, 5.0, 0.0, 0.0, 0.0]])
    layout = place_sensors((CAMERA, start[0]), (DENSE, start[1]))  # the camera sees the sky
    shift = np.zeros_like(start)
    shift[1, coordinate] = 1.0
    exact = mean = 0.0
    for scene in (world(**SMALL, count=14, seed=seed) for seed in range(3)):
        ends = (layout.with_poses(start + far * shift) for far in (-0.5, 0.5))
        low, high = (inspe_jax.evaluate(scene, end).occlusion for end in ends)
        exact += high - low
        way = (start + far * shift for far in np.linspace(-0.5, 0.5, 11))
        slopes = [slope_of("occlusion", scene, DENSE, poses, 0.05) for poses in way]
        mean += np.mean(slopes, 0)[1, coordinate]
    assert abs(exact) > 2e-3
    assert mean == pytest.approx(exact, rel=0.06)


def test_a_gradient_in_little_room_is_the_same(monkeypatch):
    """Of a large scene, what shadows leave clear is found again instead of kept."""
    poses = [[-14.0, 0.0, 6.0, 0.0, -0.4, 0.2], [-10.0, 9.0, 5.0, 0.0, 0.0, 0.0]]
    slope = partial(slope_of, "surrogate", world(**SMALL, count=14), LIDAR, poses, 0.5)
    kept = slope()
    with monkeypatch.context() as patch:
        patch.setattr(driver, "KEPT", 0)
        measure_tiles.clear_cache()
        found = slope()
    measure_tiles.clear_cache()
    assert np.abs(kept).max(1).all()
    np.testing.assert_allclose(found, kept, rtol=1e-4, atol=1e-6)


@pytest.fixture
def by_cores(monkeypatch):
    """What finds soft scores on as many cores as it is told."""
    return lambda count: monkeypatch.setattr(soft, "cores", lambda: count)


def case_of_cores():
    """A scene, a layout, and what differentiates its scores."""
    scene = world(**SMALL, count=14)
    layout = random_layout(scene, [CAMERA, LIDAR, CAMERA], 3, heights=(3.0, 8.0))

    def score(poses):
        found = inspe_jax.evaluate(scene, layout.with_poses(poses), softness=0.5)
        return found.surrogate, (found.metrics, found.region_coverage)

    return scene, layout, score, jax.value_and_grad(score, has_aux=True)


def test_all_cores_find_what_one_program_finds(by_cores):
    """Scores and slopes, eager and compiled, of two places at once, and as later calls find them;
    and what each sensor adds."""
    scene, layout, score, slope = case_of_cores()
    two = jnp.stack([layout.poses, layout.poses + 0.1])
    by_cores(1)
    whole = jax.jit(slope)
    expected = [jax.tree.leaves(whole(poses)) for poses in two]
    added = inspe_jax.evaluate(scene, layout, softness=0.5).contributions[1].metrics
    by_cores(2)
    compiled = jax.jit(slope)
    places = jax.tree.leaves(jax.vmap(compiled)(two))
    found = [[leaf[k] for leaf in places] for k in range(2)]
    expected += expected[:1] * 3
    found += [jax.tree.leaves(way(two[0])) for way in (slope, compiled, compiled)]
    for ours, theirs in zip(found, expected, strict=True):
        for one, other in zip(ours, theirs, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-5, atol=2e-7)
    assert np.abs(expected[0][-1]).max() > 1e-3
    # Without a gradient.
    for way in (score, jax.jit(score)):
        ours = jax.tree.leaves(way(two[0]))
        np.testing.assert_allclose(ours, expected[0][:-1], rtol=1e-5, atol=2e-7)
    ours = inspe_jax.evaluate(scene, layout, softness=0.5).contributions[1].metrics
    assert ours == pytest.approx(added, abs=1e-6)


def test_a_compiled_gradient_reads_each_tile_once_with_the_programs_of_another(
    by_cores, monkeypatch
):
    """XLA may order calls that share no data as it likes, and a callback has its own settings."""
    (scene, layout, _, slope), calls, read = case_of_cores(), [], soft._read_with_slope
    by_cores(2)
    monkeypatch.setattr(soft, "_read_with_slope", lambda *at: calls.append(at) or read(*at))
    poses = jnp.asarray(layout.poses)
    _, expected = slope(poses)
    once, programs = len(calls), compiled().programs
    assert once == len(tiled_scene_of(scene, whole=True, masks=False).apart) > 1
    _, found = jax.jit(slope)(poses)
    assert len(calls) == 2 * once
    # Its own, how the summary slopes, and on a single core how a tile does.
    assert compiled().programs <= programs + 2 + (parallel.cores() == 1)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-7)


DEGENERATE = [
    [0.5, 0.5, 5.0, 0.0, 0.0, 0.0],  # straight above a voxel column
    [0.5, 0.5, 5.0, 0.0, -np.pi / 2, 0.0],  # and looking down at it
    [6.0, 0.0, 5.0, 0.0, 0.0, 0.0],  # above a vehicle
    [6.0, 0.0, 0.7, 0.0, 0.0, 0.0],  # inside it
    [8.0, -9.0, 1.0, 0.0, 0.0, np.pi / 2],  # in the plane of its front, and below its top
    [-9.0, 1.0, 1.5, 0.0, 0.0, 0.0],  # in the plane of its side, level with its top
    [0.5, 0.5, 0.5, 0.0, 0.0, 0.0],  # in the middle of a voxel
]


def test_no_nan_in_degenerate_places():
    """jax_debug_nans is on; a frame without any vehicle is among the frames."""
    cars = [(6.0, 0.0, 0.0, 4.0, 2.0, 1.5), (-4.0, 3.0, 0.0, 4.0, 2.0, 1.5)]
    scene = with_boxes(world(**SMALL), *cars)
    padded = jax.tree.map(lambda leaf: np.repeat(leaf, 4, 0), scene.traffic)
    padded.valid[1] = False
    scene = inspe_jax.Scene(scene.voxels, padded, scene.intersection)
    # Each at a place of the camera's and at another of the LiDAR's.
    for poses in zip(DEGENERATE, np.roll(DEGENERATE, 3, axis=0), strict=True):
        for softness in (0.05, 1.0):
            found = slope_of("surrogate", scene, LIDAR, poses, softness)
            assert np.isfinite(found).all(), poses
            # 3 m around: what is certain has no slope.
            assert softness < 1 or np.abs(found).max(1).all(), poses


def test_the_field_of_view_has_a_depth_in_metres():
    """By hand: 10 m before the end of its reach; on its left edge; 3 m to the left of it."""
    grid = CAMERA.grid
    left = grid.column_limits[1]
    points = np.float32([[20, 0, 0], [10, 10 * left, 0], [10, 10 * left + 3.0, 0]])
    margins = jax.jit(lambda at: in_view_margins(grid.rays, 0.5, transform_of(at), points))
    field, ray = map(np.asarray, margins(np.zeros(6, np.float32)))
    outside = 0.5 - 3.0 / np.hypot(1, left)  # square on to the edge
    np.testing.assert_allclose(field, [10.5, 0.5, outside], atol=1e-3)
    assert ray[0] > 0
