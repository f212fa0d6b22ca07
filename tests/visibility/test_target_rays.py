"""Expected rays on road users beside rays that are cast at boxes with Embree."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from worlds import box_triangles

import inspe_jax
from inspe_jax.core.geometry import rotation
from inspe_jax.scene.traffic.frames import ROAD_USERS
from inspe_jax.visibility.in_view import transform_of
from inspe_jax.visibility.target_rays import rays_on_target

SLABS = np.arange(0.0, 4.01, 0.5)
DISTANCES = (1.0, 3.0, 6.0, 10.0, 20.0, 35.0, 49.0)


def poses(aimed, count, rng):
    """A mast's height, a little tilted; a camera looks down and a little aside."""
    z, roll = rng.uniform(4, 8, count), rng.uniform(-0.03, 0.03, count)
    pitch = rng.uniform(-0.3, -0.1, count) if aimed else rng.uniform(-0.05, 0.05, count)
    yaw = rng.uniform(-0.4, 0.4, count) if aimed else rng.uniform(-np.pi, np.pi, count)
    none = np.zeros(count)
    return np.column_stack([none, none, z, roll, pitch, yaw])


@jax.jit
def transforms(poses):
    return jax.vmap(transform_of)(poses)


def cast_at(body, pose, triangles, spread, reach):
    """How many of the rays hit a box; those that point elsewhere are left out."""
    caster_of = pytest.importorskip("inspe_jax.simulation.embedded.embree").Caster
    to = triangles.mean((0, 1)) - pose[:3]
    turn = rotation(pose[3:], np)
    toward = body @ (turn.T @ to) / np.linalg.norm(to)
    near = body[toward > np.cos(min(spread, np.pi))] @ turn.T
    return (caster_of(triangles).cast(pose[:3], near, reach).face >= 0).sum()


@pytest.mark.parametrize(
    "name",
    [
        "paper-camera",
        "hesai-pandar64",
        pytest.param("paper-lidar-32", marks=pytest.mark.slow),
        pytest.param("velodyne-vlp-32c", marks=pytest.mark.slow),
        pytest.param("livox-mid-360", marks=pytest.mark.slow),
    ],
)
def test_the_expected_number_is_the_mean_of_what_is_cast(name):
    """Boxes of four classes at seven distances, five for a camera: any heading, 50 poses each.

    The mean ratio of all where five or more are expected is within 3 %, and each of them within 5 %
    and three standard errors of the difference, pose by pose: a pose has one heading and one phase
    of the grid.
    """
    pytest.importorskip("embreex")
    spec, rng = inspe_jax.device(name).spec, np.random.default_rng(3)
    body, count, ratios = spec.grid.directions(), 50, []
    rays, slabs = spec.grid.rays, jnp.asarray(SLABS, float)
    for user in ROAD_USERS:
        number = jax.vmap(
            lambda transform, foot: rays_on_target(
                rays,
                transform,
                foot[None],
                slabs,
                size=user.size,  # noqa: B023
            )
        )
        for distance in DISTANCES[2 * spec.aimed :]:
            at, foot = poses(spec.aimed, count, rng), np.zeros((count, 3))
            bearing = rng.uniform(-0.3, 0.3, count)
            foot[:, 0], foot[:, 1] = distance * np.cos(bearing), distance * np.sin(bearing)
            spread = np.arctan2(np.linalg.norm(user.size), max(distance - 4.5, 0.1)) + 0.2
            headings = rng.permutation(count) * 2 * np.pi / count
            cast = np.array(
                [
                    cast_at(body, pose, box_triangles(one, user.size, yaw), spread, spec.grid.reach)
                    for pose, one, yaw in zip(at, foot, headings, strict=True)
                ],
                float,
            )
            found = number(transforms(jnp.asarray(at, float)), jnp.asarray(foot, float))
            expected = np.asarray(found).sum((1, 2))
            if expected.mean() < 5:
                continue
            error = (cast - expected).std() / count**0.5
            least, most = (cast.mean() + sign * 3 * error for sign in (-1, 1))
            assert 0.95 * least < expected.mean() < 1.05 * most, (user.name, distance)
            ratios.append(expected.mean() / cast.mean())
    assert len(ratios) >= 6
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.03)


def test_a_pedestrian_by_hand():
    """20 m ahead of a level comb of 0.5° by 0.2°: 1.72 m by the mean width of 0.5 m squares.

    At this distance the top takes another sin(elevation) of its 0.25 m².
    """
    spec = inspe_jax.LidarSpec(
        "comb", tuple(np.radians(np.arange(-40.0, 10.0, 0.5))), 1800, 2 * np.pi, 50.0
    )
    pose, foot = jnp.array([0.0, 0, 5, 0, 0, 0]), jnp.array([[20.0, 0, 0], [60.0, 0, 0]])
    found = rays_on_target(
        spec.grid.rays, transform_of(pose), foot, jnp.asarray(SLABS, float), size=(0.5, 0.5, 1.72)
    )
    wide = 2 / np.pi * (0.5 + 0.5) / 20  # Cauchy: the mean width is the perimeter over π
    tall = np.arctan2(5.0, 19.8) - np.arctan2(5.0 - 1.72, 20.2)
    by_hand = wide * tall / np.radians(0.5) / np.radians(0.2)
    assert float(found[0].sum()) == pytest.approx(by_hand, rel=0.02)
    assert not found[0, 4:].any()  # above the head
    assert found[0, :4].all()
    assert not found[1].any()  # out of reach


def test_one_straight_below_is_as_one_a_little_beside():
    """Under a LiDAR that sees all that is below it."""
    elevations = tuple(np.radians(np.arange(-90.0, 0.0, 0.5)).tolist())
    spec = inspe_jax.LidarSpec("dome", elevations, 720, 2 * np.pi, 50.0)
    foot = jnp.array([[0.0, 0.0, 0.0], [1e-3, 0.0, 0.0], [0.0, -1e-3, 0.0]])
    at = spec.grid.rays, transform_of(jnp.array([0.0, 0.0, 5.0, 0.0, 0.0, 0.0])), foot
    found = rays_on_target(*at, jnp.asarray(SLABS, float), size=(0.5, 0.5, 1.72)).sum(1)
    assert float(found[0]) > 100
    np.testing.assert_allclose(found, found[0], rtol=0.02)


def test_the_number_has_a_slope():
    spec, size = inspe_jax.device("paper-lidar-32").spec, (0.5, 0.5, 1.72)
    foot = jnp.array([[20.0, 3.0, 0.0], [2.0, 0.0, 0.0]])

    @jax.jit
    def number(pose):
        at = spec.grid.rays, transform_of(pose), foot, jnp.asarray(SLABS, float)
        return rays_on_target(*at, size=size).sum()

    pose = jnp.array([0.0, 0.0, 5.0, 0.01, -0.02, 0.3])
    slope = jax.jit(jax.grad(number))(pose)
    for k, step in ((0, 0.1), (2, 0.05), (4, 2e-3)):
        ahead, back = (float(number(pose.at[k].add(sign * step))) for sign in (1, -1))
        assert float(slope[k]) == pytest.approx((ahead - back) / (2 * step), rel=0.05)
