"""Rays as a density: against the mean over many phases of the grid, read exactly."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from phases import in_phase
from worlds import CAMERA, LIDAR, double_precision, slow_but, world

import inspe_jax
from inspe_jax.sensing.sensors import LidarSpec
from inspe_jax.visibility.centered_scene import about_center
from inspe_jax.visibility.in_view import (
    RigidTransform,
    density_view,
    density_view_by_motions,
    transform_of,
)
from inspe_jax.visibility.ray_density import footprint
from inspe_jax.visibility.tiles import tiles_of
from inspe_jax.visibility.view_masks import view_masks

DEVICES = slow_but(inspe_jax.devices(), "paper-lidar-32", "paper-camera", "velodyne-vlp-32c")


@pytest.fixture(scope="module")
def scene():
    return inspe_jax.build_scene(
        inspe_jax.built_in("four_way"), radius=30, voxel=0.4, spacing=1.5, frames=2, density=4
    )


def pose_of(spec, seed):
    """Somewhere at a corner, looking inward; a LiDAR a little tilted."""
    rng = np.random.default_rng(seed)
    around, pitch = rng.uniform(-np.pi, np.pi), rng.uniform(-0.5, -0.1) if spec.aimed else 0.05
    turned = around + np.pi + rng.uniform(-0.3, 0.3)
    return [12 * np.cos(around), 12 * np.sin(around), rng.uniform(4, 8), 0.02, pitch, turned]


compiled_view, compiled_footprint = jax.jit(density_view), jax.jit(footprint)
compiled_transform = jax.jit(transform_of)
LEVEL = RigidTransform(np.zeros(3, np.float32), np.eye(3, dtype=np.float32))


@pytest.mark.parametrize("name", DEVICES)
def test_coverage_is_that_of_the_mean_over_phases(scene, name):
    """64 phases; within 0.006, the largest found for any device and voxels of 0.2 to 1 m.

    Of a coverage of 0.5 and phases that are spread evenly over the rows, the mean itself is
    uncertain by less than 0.001.
    """
    spec, half = inspe_jax.device(name).spec, scene.voxels.size / 2
    centered = about_center(scene)
    tiles, weight = tiles_of(centered), scene.voxels.weight / scene.voxels.weight.sum()
    pose, rng = np.array(pose_of(spec, 1), np.float32), np.random.default_rng(2)
    mean = np.zeros(len(weight))
    for k in range(64):
        rays = in_phase(spec.grid, (k + rng.uniform()) / 64, rng.uniform()).rays
        mean += tiles.by_voxel(np.asarray(view_masks(rays, pose, tiles.tile, half))) / 64
    centers, transform = np.asarray(centered.centers), compiled_transform(pose)
    chance = np.asarray(compiled_view(spec.grid.rays, half, transform, centers, 0.0))
    assert 0.05 < mean @ weight < 0.98
    assert chance @ weight == pytest.approx(mean @ weight, abs=0.006)
    # Voxel by voxel: the mean of 64 draws has a deviation of up to 1/16.
    assert np.abs(chance - mean) @ weight < 0.03


def test_the_chance_by_hand():
    """A row spacing of 2° at 20 m is 0.70 m: a voxel of 0.3 m has a chance of 0.43 between rows,
    one of 1 m is always hit; the expected number is the solid angle times the density."""
    elevations = np.radians(np.arange(-20.0, 21.0, 2.0))
    spec = LidarSpec("comb", tuple(elevations), 3600, 2 * np.pi, 50.0)
    at = np.array([[20.0, 0.0, 0.0]], np.float32)
    for size, chance in ((0.3, 0.3 / (20 * np.radians(2))), (1.0, 1.0)):
        found = compiled_view(spec.grid.rays, size / 2, LEVEL, at, None)
        assert found.tolist()[0] == pytest.approx(chance, abs=2e-3)
        edges = np.eye(3, dtype=np.float32) * np.float32(size)
        of = compiled_footprint(spec.grid.rays, tuple(at.T), tuple(tuple(e) for e in edges))
        expected = (size / 20 / np.radians(2)) * (size / 20 / np.radians(0.1))
        assert of.area.tolist()[0] == pytest.approx(expected, rel=2e-3)
    # Of a camera: its pixels are even in tangents, 1/f apart.
    spec, across = CAMERA, 2 * np.tan(np.radians(50)) / 80
    edges = np.eye(3, dtype=np.float32) / 2
    of = compiled_footprint(spec.grid.rays, tuple(at.T), tuple(tuple(e) for e in edges))
    assert of.area.tolist()[0] == pytest.approx((0.5 / 20 / across) ** 2, rel=1e-3)


def test_rays_nowhere_near_have_no_chance():
    """Behind a camera, beyond the reach, above the highest channel by more than a voxel."""
    at = np.array([[-5.0, 0.0, 0.0], [31.0, 0.0, 0.0], [10.0, 0.0, 9.5]], np.float32)
    found = compiled_view(CAMERA.grid.rays, 0.25, LEVEL, at, None)
    assert found.tolist() == [0.0, 0.0, 0.0]
    at = np.array([[51.0, 0.0, 0.0], [10.0, 0.0, 2.0], [10.0, 0.0, -1.0]], np.float32)
    found = compiled_view(LIDAR.grid.rays, 0.25, LEVEL, at, None)
    assert found.tolist()[:2] == [0.0, 0.0]
    assert found.tolist()[2] == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("spec", [CAMERA, LIDAR])
def test_the_gradient_by_motions_is_that_of_reverse_mode(spec):
    scene = world(radius=10.0, voxel=2.0, count=0)
    centers = np.asarray(about_center(scene).centers, float)
    with double_precision():
        pose, at = jnp.asarray(pose_of(spec, 3)), jnp.asarray(centers)
        rays, weight = spec.grid.rays, np.sin(np.arange(len(centers), dtype=float))

        def weighed(view):
            return jax.jit(lambda pose: view(rays, 1.0, transform_of(pose), at, 0.4) @ weight)

        ours, plain = weighed(density_view_by_motions), weighed(density_view)
        slope = jax.jit(jax.grad(ours))(pose)
        assert np.abs(slope).min() > 1e-3
        np.testing.assert_allclose(slope, jax.jit(jax.grad(plain))(pose), rtol=1e-9, atol=1e-9)
