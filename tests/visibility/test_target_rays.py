"""Expected rays on road users beside rays that are cast at boxes with Embree."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import inspe_jax
from inspe_jax.core.geometry import rotation
from inspe_jax.scene.traffic.frames import ROAD_USERS
from inspe_jax.visibility.in_view import transform_of
from inspe_jax.visibility.target_rays import rays_on_target

SLABS = np.arange(0.0, 4.01, 0.5)
DISTANCES = (5.0, 10.0, 20.0, 35.0, 60.0)
FACES = [[0, 1, 2], [0, 2, 3], [4, 6, 5], [4, 7, 6], [0, 4, 5], [0, 5, 1]]
FACES += [[1, 5, 6], [1, 6, 2], [2, 6, 7], [2, 7, 3], [3, 7, 4], [3, 4, 0]]


def box(foot, size, yaw):
    """An upright box as triangles (12, 3, 3)."""
    x, y, z = size
    flat = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [x / 2, y / 2]
    corners = np.array([[*row, top] for top in (0.0, z) for row in flat])
    corners = corners @ rotation(np.array([0.0, 0.0, yaw]), np).T + foot
    return corners[np.array(FACES)]


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


def cast_at(body, pose, triangles, spread):
    """How many of the rays hit a box; those that point elsewhere are left out."""
    caster_of = pytest.importorskip("inspe_jax.simulation.embedded.embree").Caster
    to = triangles.mean((0, 1)) - pose[:3]
    turn = rotation(pose[3:], np)
    toward = body @ (turn.T @ to) / np.linalg.norm(to)
    near = body[toward > np.cos(spread)] @ turn.T
    return (caster_of(triangles).cast(pose[:3], near, 99.0).face >= 0).sum()


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
    """Boxes of four classes at five distances, any heading, 1000 poses in all for each device.

    The mean number must be within 5 %, where at least five are expected; and within four standard
    errors of what was cast, which for the rarer ones are wider than that.
    """
    pytest.importorskip("embreex")
    spec, rng = inspe_jax.device(name).spec, np.random.default_rng(3)
    body, count, checked = spec.grid.directions(), 50, 0
    rays, slabs = spec.grid.rays, jnp.asarray(SLABS, float)
    for user in ROAD_USERS:
        for distance in DISTANCES:
            at, foot = poses(spec.aimed, count, rng), np.zeros((count, 3))
            bearing = rng.uniform(-0.3, 0.3, count)
            foot[:, 0], foot[:, 1] = distance * np.cos(bearing), distance * np.sin(bearing)
            spread = min(np.arctan2(np.linalg.norm(user.size), distance - 4.5) + 0.2, 2.5)
            cast = np.array(
                [
                    cast_at(body, pose, box(one, user.size, yaw), spread)
                    for pose, one, yaw in zip(at, foot, rng.uniform(0, 7, count), strict=True)
                ],
                float,
            )
            if distance > spec.grid.reach + 5:
                cast[:] = 0.0
            number = jax.vmap(
                lambda transform, one: rays_on_target(
                    rays,
                    transform,
                    one[None],
                    slabs,
                    size=user.size,  # noqa: B023
                )
            )
            found = number(transforms(jnp.asarray(at, float)), jnp.asarray(foot, float))
            expected = np.asarray(found).sum((1, 2))
            error = 4 * cast.std() / count**0.5
            assert expected.mean() == pytest.approx(cast.mean(), rel=0.05, abs=max(error, 0.3))
            checked += expected.mean() > 5
    assert checked >= 6


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
