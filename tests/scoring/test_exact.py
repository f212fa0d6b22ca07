"""Scores counted in bit masks against the same measures with a number for every voxel."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense_reference import measure
from dense_reference import views as dense_views
from worlds import (
    CAMERA,
    LIDAR,
    TALL,
    no_traffic,
    random_layout,
    random_traffic,
    slow_but,
    solid_voxels,
    world,
)

from inspe_jax.core.arrays import from_center, pad_rows
from inspe_jax.core.numerics import Softness
from inspe_jax.core.parallel import run
from inspe_jax.placement.sampled_objective import one_tile_a_slab, view_jobs
from inspe_jax.scoring import exact
from inspe_jax.scoring import tiled_scene as made
from inspe_jax.scoring.driver import measure_tiles
from inspe_jax.scoring.options import ScoreOptions
from inspe_jax.scoring.reading import BITS
from inspe_jax.scoring.tiled_scene import SceneArrays
from inspe_jax.sensing.sensor_array import SensorSet, sensor_array
from inspe_jax.visibility import bitmask
from inspe_jax.visibility.centered_scene import CenteredScene, about_center

SPECS = [LIDAR, CAMERA, CAMERA, LIDAR]


UNITS = ((0, 2), (1,), (3,))  # as failures: several sensors in a group, not in order
LOW, MIDDLE, HIGH = (0.3, 1.2), (1.0, 4.0), (1.0, 8.0)  # the sensors' heights
SCENES = {
    "all references": (dict(count=16), MIDDLE, "covered", "past_others"),
    "sight apart": (dict(count=16), MIDDLE, "targets", "line_of_sight"),
    "own voxels": (dict(count=16), MIDDLE, "targets", "in_view"),
    "own voxels, all the way": (dict(count=16), MIDDLE, "targets", "past_others"),
    # The upper levels' columns stand in vehicles, without a solid voxel.
    "more levels than a word has bits": (TALL | dict(count=2), LOW, "roi", "past_others"),
    "steep": (dict(slope=0.3, count=20), LOW, "roi", "line_of_sight"),
    "two words of vehicles, sloping, off centre": (
        dict(count=45, slope=0.08, center=(812.0, -455.0, 31.0)), HIGH, "covered", "line_of_sight"
    ),
    "two parts of frames": (
        dict(frames=131, count=3, voxel=1.0, radius=10.0), HIGH, "covered", "in_view"
    ),
}  # fmt: skip
"""Every occlusion reference with every visibility but for the usual ones, which a sample has below;
and what is special of the world."""


def both(scene, layout, failures=(), **options):
    """(dense, by masks)."""
    sensor_set = SensorSet.of(layout, failures)
    poses, voxel = from_center(scene.voxels.center, layout.poses), scene.voxels.size
    field = SceneArrays(about_center(scene), jnp.asarray(scene.voxels.weight, float))
    dense = measure(field, poses, sensor_set, voxel, **options)
    return dense, exact.measure_exactly(
        made.tiled_scene_of(scene), poses, sensor_set, voxel, ScoreOptions.of(**options)
    )


def assert_same(dense, counted):
    """Counts are the same; sums of floats in another order to a few roundings.

    H(Ω) is a plain sum of thousands: of n additions, roundings grow as √n · 6e-8.
    """
    for name in (*dense.values, *dense._fields[1:-1]):  # the last are parts
        ours, theirs = (
            m.values[name] if name in m.values else getattr(m, name) for m in (counted, dense)
        )
        rtol = 1e-5 if name == "entropy" else 0
        np.testing.assert_allclose(ours, theirs, rtol, 2e-6, err_msg=name)


QUICK = (
    "own voxels, all the way",
    "two words of vehicles, sloping, off centre",
    "two parts of frames",
)


@pytest.mark.parametrize("name", slow_but(SCENES, *QUICK))
def test_masks_count_what_numbers_add_up_to(name):
    """With all sensors, and without those of each unit."""
    size, heights, reference, visibility = SCENES[name]
    scene = world(seed=7, **size)
    assert (scene.voxels.level_count > bitmask.WORD) == ("levels" in name)
    x, y = scene.voxels.center[:2]
    layout = random_layout(scene, SPECS, seed=8, heights=heights)
    if scene.voxels.radius <= 10:  # nearer, so that something is seen
        poses = np.asarray(layout.poses)
        poses[:, :2] = [x, y] + (poses[:, :2] - [x, y]) / 2
        layout = layout.with_poses(poses)
    options = dict(occlusion_reference=reference, visibility=visibility)
    dense, counted = both(scene, layout, UNITS, **options)
    assert 0.05 < np.asarray(dense.values["coverage"])[0] < 1
    assert_same(dense, counted)


def test_a_sensor_in_every_awkward_place():
    """In a vehicle, in the plane of a side, at a voxel's centre, above the scene's centre."""
    scene = world(seed=2, count=15)
    t = scene.traffic
    inside = t.center[0, 0] - [0, 0, 0.1]
    beside = t.center[1, 1, :2] + t.size[1, 1, 1] / 2 * np.array(
        [-np.sin(t.yaw[1, 1]), np.cos(t.yaw[1, 1])]
    )
    voxel = scene.voxels.centers[len(scene.voxels.centers) // 2]
    layout = random_layout(scene, SPECS, seed=1)
    poses = np.array(layout.poses)
    poses[0, :3], poses[1, :3] = inside, (*beside, 1.2)
    poses[2, :3], poses[3, :3] = voxel, (0.0, 0.0, 3.0)
    poses[3, 3:] = 0.0
    options = dict(occlusion_reference="targets", visibility="line_of_sight")
    assert_same(*both(scene, layout.with_poses(poses), UNITS, **options))


def test_any_number_of_cores_gives_the_same_bits(monkeypatch):
    scene = world(seed=4)
    layout = random_layout(scene, SPECS, seed=4)
    sensor_set = SensorSet.of(layout, UNITS)
    found = []
    for number in (1, 8):
        monkeypatch.setattr(made, "cores", lambda number=number: number)
        shared = made._tile_scene(scene)
        assert len(shared.chunks) == number
        poses = from_center(scene.voxels.center, layout.poses)
        found.append(exact.measure_exactly(shared, poses, sensor_set, scene.voxels.size))
    jax.tree.map(np.testing.assert_array_equal, *found)


def test_a_sample_is_counted_as_a_scene_of_its_own():
    """Some columns and frames, traced, against numbers; p̂ is that of all frames."""
    scene = world(seed=6, count=15)
    layout = random_layout(scene, SPECS, seed=6)
    full, levels = jax.tree.map(np.asarray, about_center(scene)), scene.voxels.level_count
    rng = np.random.default_rng(0)
    at = np.sort(rng.choice(len(full.columns), 77, replace=False))
    prisms = jax.tree.map(lambda leaf: leaf[np.array([3, 1])], full.prisms)
    field = SceneArrays(
        CenteredScene(full.columns[at], full.heights[at], full.ground[at], prisms),
        jnp.asarray(np.repeat(scene.voxels.column_weight[at], levels), float),
        jnp.asarray(rng.uniform(size=77 * levels), float),
    )
    sensor_set = SensorSet.of(layout, UNITS)
    poses, voxel = from_center(scene.voxels.center, layout.poses), scene.voxels.size
    sample = made.tiled_sample(field)
    sensors = sensor_array(sensor_set, exact.ONE_MORE)
    padded, asked = pad_rows(poses, len(sensors.kind)), ScoreOptions.of()
    traced = measure_tiles(BITS, sample.bucketed, padded, sensors, voxel, options=asked)
    found = traced.of_scene(sample.tiles.place, len(sensor_set.failures))
    assert_same(measure(field, poses, sensor_set, voxel), found)

    grid, s = layout.sensors[0].spec.grid, np.asarray(poses)[[0, 3, 0]]
    (together,) = run(view_jobs(grid, voxel / 2, s, sample, ScoreOptions()))
    tiles = replace(one_tile_a_slab(sample).tiles, place=sample.tiles.place)
    views, seen = (tiles.by_voxel(x[:3]) for x in (together.view, together.seen.swapaxes(1, 2)))
    assert views.shape == (3, 77 * levels)
    assert seen.shape == (3, 2, 77 * levels)
    np.testing.assert_array_equal(views[0], views[2])
    assert not (seen & ~views[:, None]).any()
    assert seen[0].any()
    plain = dense_views(poses, field.centered, sensor_set.groups, voxel / 2, Softness())
    np.testing.assert_array_equal(views[0], np.asarray(plain)[0] > 0)


def test_a_world_is_kept_as_long_as_its_scene():
    scene = world(seed=1)
    first = made.tiled_scene_of(scene)
    assert made.tiled_scene_of(scene) is first
    other = replace(scene, traffic=random_traffic(scene.intersection, 2, 3, 20.0, seed=1))
    assert made.tiled_scene_of(other) is not first
    kept = len(made._kept_scenes)
    del scene, other
    assert len(made._kept_scenes) <= kept - 2
    assert made.tiled_scene_of(replace(world(), traffic=no_traffic())).occupancy.size == 0


@pytest.mark.parametrize("voxel", slow_but([TALL["voxel"], 0.5], 0.5))
def test_occupancy_is_the_share_of_frames_in_which_a_voxel_is_in_a_vehicle(voxel):
    """Each centre against each box, by hand; where it always is, 0 does as well as 1."""
    scene = world(voxel=voxel, radius=10.0 if voxel < 0.5 else 20.0, slope=0.05)
    share = np.mean([solid_voxels(scene, k) for k in range(scene.traffic.frame_count)], 0)
    assert 0.01 < ((share > 0) & (share < 1)).mean() < 0.5
    np.testing.assert_allclose(made.tiled_scene_of(scene).voxel_occupancy, share % 1, atol=1e-6)
