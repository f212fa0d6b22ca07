"""Through lenses that bend lines: in view against walked rays, slopes, limits and densities."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import raycast
import worlds
from phases import in_phase
from worlds import BARREL, CEILING, CIRCULAR, place_sensors, random_layout, world

import inspe_jax
from inspe_jax.core.numerics import step
from inspe_jax.scoring.targets import pixel_density_at
from inspe_jax.visibility.in_view import density_view, in_view_margins, transform_of
from inspe_jax.visibility.queries import in_view

LENSES = [BARREL, CEILING, CIRCULAR]


def poses(spec, seed):
    """Somewhere near the centre, the ceiling's looking down."""
    layout = random_layout(world(count=0), [spec] * 2, seed=seed, heights=(2.0, 8.0))
    turned = np.array(layout.poses)
    turned[:, 4] -= (np.pi / 2 - 0.2) * (spec is CEILING)
    return layout.with_poses(turned)


@pytest.mark.parametrize("spec", LENSES, ids=lambda spec: spec.name)
def test_in_view_agrees_with_every_ray_walked(spec):
    """At least 99.95 % of voxels: others are clipped at a corner, or by the circle's last rays."""
    scene = world(count=0, slope=0.04)
    for seed in (1, 2):
        layout = poses(spec, seed)
        ours, walked = in_view(scene, layout), raycast.in_view(scene, layout, "exact")
        assert 0.05 < walked.mean() < 0.95
        assert (ours == walked).mean(axis=1).min() >= 0.9995
        assert (ours & ~walked).sum() <= 1e-4 * ours.size


@pytest.mark.parametrize("spec", LENSES, ids=lambda spec: spec.name)
def test_slopes_are_those_of_the_coordinates_and_edges_have_depth(spec):
    """In double precision, to the error of the arc tangent's series."""
    rng = np.random.default_rng(0)
    with worlds.double_precision():
        rays = spec.grid.rays
        off, around = rng.uniform(0.01, rays.table.own[10], 200), rng.uniform(0, 2 * np.pi, 200)
        aside = np.sin(off) * [np.cos(around), np.sin(around)]
        q = tuple(jnp.asarray(x) for x in rng.uniform(1, 30, 200) * [np.cos(off), *aside])
        slopes = jax.jit(lambda rays, q: rays.slopes(q, 1e-6))(rays, q)
        total = lambda name: lambda q, rays: getattr(rays, name)(q).sum()  # noqa: E731
        for slope, name in zip(slopes, ("row", "column"), strict=True):
            expected = jax.jit(jax.grad(total(name)))(q, rays)
            np.testing.assert_allclose(slope, expected, atol=1e-6)


@pytest.mark.parametrize("spec", [BARREL, CEILING], ids=lambda spec: spec.name)
def test_a_centimetre_beyond_the_last_row_is_one_outside(spec):
    with worlds.double_precision():
        rays = spec.grid.rays

        @jax.jit
        def found(rays, away):
            way = rays.direction(rays.table.outer.row[1], jnp.array([0.1]))
            at = tuple(20.0 * x for x in way)
            up, _ = rays.slopes(at, 1e-6)
            length = jnp.sqrt(sum(x**2 for x in up))
            moved = tuple(a + away * b / length for a, b in zip(at, up, strict=True))
            return rays.square_row(moved, rays.table.outer, 1)

        for away in (0.0, 0.01):
            np.testing.assert_allclose(found(rays, away), away, atol=2e-5)


def test_read_softly_in_view_tends_to_exact():
    scene, layout = world(radius=10.0, voxel=0.5, count=0), poses(CIRCULAR, 1)
    exact, half = in_view(scene, layout)[0].astype(float), scene.voxels.size / 2
    of = jax.jit(lambda pose: in_view_margins(CIRCULAR.grid.rays, half, transform_of(pose), at))
    at, pose = np.float32(scene.voxels.centers), np.float32(layout.poses[0])
    field, ray = of(pose)
    soft = (np.asarray(step(field, width) * step(ray)) for width in (1.0, 0.1, 1e-4))
    off = [np.abs(one - exact).mean() for one in soft]
    assert off[0] > off[1] > off[2]
    assert off[2] < 1e-3  # where the nearest ray decides, and the six do not


@pytest.mark.slow
@pytest.mark.parametrize("spec", LENSES, ids=lambda spec: spec.name)
def test_as_a_density_rays_cover_what_they_do_in_the_mean_over_phases(spec):
    scene, layout = world(radius=15.0, voxel=0.5, count=0), poses(spec, 1)
    weight, mean = scene.voxels.weight / scene.voxels.weight.sum(), 0.0
    for k in range(32):
        grid, one = in_phase(spec.grid, (k + 0.5) / 32, (k * 0.618) % 1), layout.rays(0)
        seen = np.zeros(scene.voxels.count, bool)
        ways = grid.directions() @ np.linalg.lstsq(spec.grid.directions(), one[1], rcond=None)[0]
        raycast.exact(scene.voxels, one[0], ways, one[2], seen)
        mean += seen @ weight / 32
    at, pose = np.float32(scene.voxels.centers), np.float32(layout.poses[0])
    of = jax.jit(lambda pose: density_view(spec.grid.rays, 0.25, transform_of(pose), at, 0.0))
    assert np.asarray(of(pose)) @ weight == pytest.approx(mean, abs=0.01)


def test_a_metre_under_a_ceiling_has_the_focal_length_over_the_distance():
    """340 px on a radian: 34 px/m straight below and also aside, where a metre is square on."""
    pose = np.array([0.0, 0.0, 10.0, 0.0, -np.pi / 2, 0.0])
    at = np.array([[0.1, 0.0, 0.0], [6.0, 0.0, 2.0], [0.0, 30.0, 10.5]])
    found = pixel_density_at(CEILING, pose, at)
    turn = np.arctan2(6, 8)
    assert found[:2] == pytest.approx([CEILING.focal / 10, CEILING.focal * turn / 6], rel=1e-3)
    assert found[2] == 0  # beyond the reach


@pytest.mark.slow
@pytest.mark.parametrize("spec", LENSES, ids=lambda spec: spec.name)
def test_gradients_are_those_of_differences(spec):
    scene, step_of = world(**worlds.TINY), np.array([1, 1, 1, 0.1, 0.1, 0.1]) * 1e-4
    pitch = -1.4 if spec is CEILING else -0.5
    layout = place_sensors((spec, [4.3, -5.2, 5.1, 0.03, pitch, 2.1]))
    with worlds.double_precision():

        @jax.jit
        def score(pose):
            return inspe_jax.evaluate(scene, layout.with_poses(pose[None]), softness=0.5).surrogate

        pose = np.array(layout.poses[0])
        slope = np.asarray(jax.grad(score)(pose)) * step_of
        ends = [score(pose + way) - score(pose - way) for way in np.diag(step_of)]
        found = np.array(ends) / 2
    assert slope @ found / np.linalg.norm(slope) / np.linalg.norm(found) > 0.99
