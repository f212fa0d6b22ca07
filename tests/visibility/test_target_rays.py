"""Expected rays on road users beside rays that are cast at boxes with Embree."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from worlds import CAMERA, box_triangles

import inspe_jax
from inspe_jax.core.geometry import rotation
from inspe_jax.scene.traffic.frames import ROAD_USERS
from inspe_jax.sensing.sensors import LidarSpec
from inspe_jax.visibility.in_view import transform_of
from inspe_jax.visibility.target_rays import rays_on_face, rays_on_target, share_between_sides

singles = partial(np.array, dtype=np.float32)
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


@jax.jit
def on_pedestrians(rays, pose, feet, slabs):
    """Rays on a pedestrian at each foot, (N, Z) by slab."""
    return rays_on_target(rays, transform_of(pose), feet, slabs, size=(0.5, 0.5, 1.72))


@jax.jit
def on_faces(rays, pose, to, edges, middle, wide, tall):
    """Rays on faces between edges, and which share of a face is between the sides of the view."""
    transform = transform_of(pose)
    share = share_between_sides(rays, transform, middle, wide, tall)
    return rays_on_face(rays, transform, to, edges[:-1], edges[1:])[0], share


def cast_at(body, pose, triangles, radius, reach):
    """How many of the rays hit a box; those that miss the sphere about it are left out."""
    caster_of = pytest.importorskip("inspe_jax.simulation.embedded.embree").Caster
    to = triangles.mean((0, 1)) - pose[:3]
    turn = rotation(pose[3:], np)
    away = np.linalg.norm(to)
    toward = body @ (turn.T @ to) / away
    tangent = (1 - (radius / away) ** 2) ** 0.5 if radius < away else -1.0
    near = body[toward > tangent - 1e-6] @ turn.T
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
        to_each = partial(rays_on_target, slabs=slabs, size=user.size)
        number = jax.vmap(lambda transform, foot: to_each(rays, transform, foot[None]))  # noqa: B023
        for distance in DISTANCES[2 * spec.aimed :]:
            at, foot = poses(spec.aimed, count, rng), np.zeros((count, 3))
            bearing = rng.uniform(-0.3, 0.3, count)
            foot[:, 0], foot[:, 1] = distance * np.cos(bearing), distance * np.sin(bearing)
            radius = np.linalg.norm(user.size) / 2
            headings = rng.permutation(count) * 2 * np.pi / count
            cast = np.array(
                [
                    cast_at(body, pose, box_triangles(one, user.size, yaw), radius, spec.grid.reach)
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
    pose, foot = singles([0, 0, 5, 0, 0, 0]), singles([[20, 0, 0], [60, 0, 0]])
    found = np.asarray(on_pedestrians(spec.grid.rays, pose, foot, singles(SLABS)))
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
    foot = singles([[0, 0, 0], [1e-3, 0, 0], [0, -1e-3, 0]])
    at = spec.grid.rays, singles([0, 0, 5, 0, 0, 0]), foot, singles(SLABS)
    found = np.asarray(on_pedestrians(*at)).sum(1)
    assert float(found[0]) > 100
    np.testing.assert_allclose(found, found[0], rtol=0.02)


def on_boxes(spec, pose, foot, size, headings=6):
    """Rays of a grid that meet an upright box, mean over headings: each ray against its slabs."""
    origin, turned = np.asarray(pose[:3]), rotation(np.asarray(pose[3:], float), np)
    rays, found = spec.grid.directions() @ turned.T, []
    to = np.asarray(foot) + [0, 0, size[2] / 2] - origin
    near = rays @ to / np.linalg.norm(to) > np.cos(min(np.pi, 6.0 / np.linalg.norm(to)))
    for yaw in (np.arange(headings) + 0.3) * np.pi / headings:
        cos, sin = np.cos(yaw), np.sin(yaw)
        axes = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
        start, along = axes @ -to, rays[near] @ axes.T
        with np.errstate(divide="ignore"):
            ends = (np.array([-1, 1])[:, None, None] * np.asarray(size) / 2 - start) / along
        first, last = ends.min(0).max(1), ends.max(0).min(1)
        found.append(((first < last) & (last > 0) & (first < spec.grid.reach)).sum())
    return np.mean(found)


UPSIDE_DOWN = np.pi
STEEP = [
    ("camera", (0.0, -np.radians(60), 0.4)),
    ("camera", (0.0, -np.radians(80), 0.4)),
    ("camera", (0.0, -np.radians(90), 0.4)),
    ("camera", (UPSIDE_DOWN, -0.2, 0.4)),
    ("camera", (2.6, -0.2, 0.4)),
    ("camera", (0.3, -0.4, 3.0)),
    ("sector", (UPSIDE_DOWN, -0.25, 0.4)),
    ("sector", (0.2, -0.2, -3.0)),
    ("nearly round", (0.15, 0.0, 0.4)),
    ("nearly round", (0.0, 0.1, 3.0)),
]


@pytest.mark.parametrize(
    ("kind", "turns"),
    [
        row if k in (2, 3, 4, 6, 8) else pytest.param(*row, marks=pytest.mark.slow)
        for k, row in enumerate(STEEP)
    ],
)
def test_a_field_of_view_ends_at_its_sides_however_it_is_turned(kind, turns):
    """The share of places where a pedestrian has rays, and their number there, of rays that are
    walked one by one: on boxes for maps, and on faces for scores."""
    rows = tuple(np.radians(np.linspace(-30, 20, 40)).tolist())
    spec = {
        "camera": CAMERA.with_performance(1.0, 30.0),
        "sector": LidarSpec("sector", rows, 400, np.radians(80), 30.0),
        "nearly round": LidarSpec("nearly round", rows, 900, np.radians(355), 30.0),
    }[kind]
    pose, size = [0.0, 0.0, 7.0, *turns], (0.5, 0.5, 1.72)
    rng = np.random.default_rng(3)
    away, bearing = rng.uniform(4, 14, 60), rng.uniform(-np.pi, np.pi, 60)
    feet = np.column_stack([away * np.cos(bearing), away * np.sin(bearing), np.zeros(60)])
    walked = np.array([on_boxes(spec, pose, foot, size) for foot in feet])
    slabs, rays = singles([0.0, 0.5, 1.0, 1.5, 2.0]), spec.grid.rays
    boxes = np.asarray(on_pedestrians(rays, singles(pose), singles(feet), slabs)).sum(1)
    to = singles(feet[:, 0]), singles(feet[:, 1])
    edges = np.minimum(slabs, singles(size[2]))[:, None] - singles(np.full((1, 60), pose[2]))
    wide, tall = (singles([[x]]) for x in (2 * 1.0 / np.pi, size[2]))
    middle = (*to, singles(np.full(60, size[2] / 2 - pose[2])))
    on_face, share = map(np.asarray, on_faces(rays, singles(pose), to, edges, middle, wide, tall))
    faces = on_face.sum(0) * share[0] * float(wide[0, 0])
    assert 0.03 < (walked > 0).mean() < 1
    for found in (boxes, faces):
        assert (found > 0.5).mean() == pytest.approx((walked > 0.5).mean(), abs=0.07)
        assert found.sum() == pytest.approx(walked.sum(), rel=0.25)
        assert np.corrcoef(np.sqrt(found), np.sqrt(walked))[0, 1] > 0.95
