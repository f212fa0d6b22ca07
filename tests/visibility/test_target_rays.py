"""Expected rays on road users beside rays that are walked at boxes one by one."""

import jax
import numpy as np
import pytest
from worlds import CAMERA, emptied, place_sensors, rays_on_box, slow_but, world

import inspe_jax
from inspe_jax.scene.traffic.frames import ROAD_USERS
from inspe_jax.scoring.detection import detection_curves
from inspe_jax.scoring.targets import target_view
from inspe_jax.sensing.lidar_returns import LidarNoise
from inspe_jax.sensing.sensors import LidarSpec
from inspe_jax.visibility.in_view import transform_of
from inspe_jax.visibility.target_rays import rays_on_face, share_between_sides

singles = np.float32
KEPT = 1.0 - LidarNoise().lost
"""Share of a LiDAR's returns that come back from where none is weak, up to 89 m."""


@pytest.fixture(scope="module")
def scene():
    return emptied(world(radius=32.0, voxel=0.5))


def rays_on(scene, spec, pose, user):
    """The expected number of rays on a road user at each column, from a map."""
    view = target_view(scene, place_sensors((spec, pose)), user.name)
    if spec.focal_pixels is None:
        return view.returns[0] / KEPT
    curve = dict(zip((u.name for u in ROAD_USERS), detection_curves().of("camera"), strict=True))
    curve, chance = curve[user.name], view.found[0]
    return curve.half * (chance / (curve.most - chance)) ** (1 / curve.slope) / spec.pixels_per_ray


@pytest.mark.parametrize(
    "name",
    slow_but(
        ["paper-camera", "hesai-pandar64", "paper-lidar-32", "velodyne-vlp-32c", "livox-mid-360"],
        "paper-camera",
        "hesai-pandar64",
    ),
)
def test_the_expected_number_is_the_mean_of_what_is_cast(scene, name):
    """Boxes of four classes in four rings, from several poses: a pose has one phase of the grid.

    The mean ratio of all rings where five or more are expected is within 3 %, and each of them
    within 5 % and three standard errors of the difference, place by place. Cameras: from two
    lengths on, as nearer a vehicle fills much of the picture.
    """
    spec, rng, ratios = inspe_jax.device(name).spec, np.random.default_rng(3), []
    columns = scene.voxels.columns
    poses = np.zeros((6, 6))
    poses[:, 2:4] = np.column_stack([rng.uniform(4, 8, 6), rng.uniform(-0.03, 0.03, 6)])
    poses[:, 4] = rng.uniform(-0.3, -0.1, 6) if spec.aimed else rng.uniform(-0.05, 0.05, 6)
    poses[:, 5] = rng.uniform(-np.pi, np.pi, 6)
    away = np.hypot(*columns.T)
    bearing = np.arctan2(*columns.T[::-1])
    for user in ROAD_USERS:
        expected = [rays_on(scene, spec, pose, user) for pose in poses.tolist()]
        for least, most in ((6, 10), (10, 18), (18, 25), (25, 31)):
            if spec.aimed and least < 2 * user.size[0]:
                continue
            found = []
            for pose, of in zip(poses, expected, strict=True):
                ahead = np.abs((bearing - pose[5] + np.pi) % (2 * np.pi) - np.pi) < 0.4
                there = (away > least) & (away < most) & (ahead if spec.aimed else True)
                for k in rng.choice(np.flatnonzero(there), 10):
                    walked = rays_on_box(spec, pose, [*columns[k], 0.0], user.size)[0]
                    found.append((of[k], walked))
            of, walked = np.array(found).T
            if of.mean() < 5:
                continue
            error = (walked - of).std() / len(of) ** 0.5
            low, high = (walked.mean() + sign * 3 * error for sign in (-1, 1))
            assert 0.95 * low < of.mean() < 1.05 * high, (user.name, least)
            ratios.append(of.mean() / walked.mean())
    assert len(ratios) >= 6
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.03)


def test_a_pedestrian_by_hand(scene):
    """20 m from a level comb of 0.5° by 0.2°: 1.72 m by the mean width of 0.5 m squares.

    At this distance the top takes another sin(elevation) of its 0.25 m².
    """
    elevations = tuple(np.radians(np.arange(-40.0, 10.0, 0.5)).tolist())
    spec = LidarSpec("comb", elevations, 1800, 2 * np.pi, 25.0)
    found = rays_on(scene, spec, [0.25, 0.25, 5.0, 0, 0, 0], ROAD_USERS[-1])
    columns = scene.voxels.columns - 0.25
    wide = 2 / np.pi * (0.5 + 0.5) / 20  # Cauchy: the mean width is the perimeter over π
    tall = np.arctan2(5.0, 19.8) - np.arctan2(5.0 - 1.72, 20.2)
    by_hand = wide * tall / np.radians(0.5) / np.radians(0.2)
    assert found[(columns == [20, 0]).all(1)] == pytest.approx(by_hand, rel=0.02)
    assert not found[np.hypot(*columns.T) > 28].any()  # out of reach
    assert np.isfinite(found).all()  # straight below too


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


@jax.jit
def on_faces(rays, pose, to, edges, middle, wide, tall):
    """Rays on faces between edges, and which share of a face is between the sides of the view."""
    transform = transform_of(pose)
    share = share_between_sides(rays, transform, middle, wide, tall)
    return rays_on_face(rays, transform, to, edges[:-1], edges[1:])[0], share


@pytest.mark.parametrize(
    ("kind", "turns"),
    [
        row if k in (2, 3, 4, 6, 8) else pytest.param(*row, marks=pytest.mark.slow)
        for k, row in enumerate(STEEP)
    ],
)
def test_a_field_of_view_ends_at_its_sides_however_it_is_turned(kind, turns):
    """The share of places where a pedestrian has rays, and their number there."""
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
    walked = np.array([rays_on_box(spec, pose, foot, size)[0] for foot in feet])
    slabs, rays = singles([0.0, 0.5, 1.0, 1.5, 2.0]), spec.grid.rays
    to = singles(feet[:, 0]), singles(feet[:, 1])
    edges = np.minimum(slabs, singles(size[2]))[:, None] - singles(np.full((1, 60), pose[2]))
    wide, tall = (singles([[x]]) for x in (2 * 1.0 / np.pi, size[2]))
    middle = (*to, singles(np.full(60, size[2] / 2 - pose[2])))
    on_face, share = map(np.asarray, on_faces(rays, singles(pose), to, edges, middle, wide, tall))
    found = on_face.sum(0) * share[0] * float(wide[0, 0])
    assert 0.03 < (walked > 0).mean() < 1
    assert (found > 0.5).mean() == pytest.approx((walked > 0.5).mean(), abs=0.07)
    assert found.sum() == pytest.approx(walked.sum(), rel=0.25)
    assert np.corrcoef(np.sqrt(found), np.sqrt(walked))[0, 1] > 0.95
