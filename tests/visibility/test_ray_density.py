"""Rays as a density: against the mean over many phases of the grid, read exactly; and on road
users, against rays that are walked at boxes one by one."""

import jax
import numpy as np
import pytest
import worlds
from phases import in_phase
from worlds import CAMERA, LIDAR, place_sensors, world

import inspe_jax
from inspe_jax.scene.traffic.frames import ROAD_USERS
from inspe_jax.scoring.detection import detection_curves
from inspe_jax.scoring.targets import target_view
from inspe_jax.sensing.sensors import LidarSpec
from inspe_jax.sensing.signals import LidarNoise
from inspe_jax.visibility import in_view
from inspe_jax.visibility.centered_scene import about_center
from inspe_jax.visibility.ray_density import footprint
from inspe_jax.visibility.target_rays import rays_on_face, share_between_sides
from inspe_jax.visibility.tiles import tiles_of
from inspe_jax.visibility.view_masks import views_of_sensor

DEVICES = worlds.slow_but(inspe_jax.devices(), "paper-lidar-32", "paper-camera", "velodyne-vlp-32c")


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


compiled_view, compiled_footprint = jax.jit(in_view.density_view), jax.jit(footprint)
compiled_transform = jax.jit(in_view.transform_of)
LEVEL = in_view.RigidTransform(np.zeros(3, np.float32), np.eye(3, dtype=np.float32))


@pytest.mark.parametrize("name", DEVICES)
def test_coverage_is_that_of_the_mean_over_phases(scene, name):
    """64 phases; within 0.006, the largest found for any device and voxels of 0.2 to 1 m.

    Of a coverage of 0.5 and phases that are spread evenly over the rows, the mean itself is
    uncertain by less than 0.001.
    """
    spec, half = inspe_jax.device(name).spec, scene.voxels.size / 2
    tiles, weight = tiles_of(about_center(scene)), scene.voxels.weight / scene.voxels.weight.sum()
    pose, rng = np.array(pose_of(spec, 1), np.float32), np.random.default_rng(2)
    mean = np.zeros(len(weight))
    for k in range(64):
        rays = in_phase(spec.grid, (k + rng.uniform()) / 64, rng.uniform()).rays
        mean += tiles.by_voxel(np.asarray(views_of_sensor(rays, pose, tiles.tile, half))) / 64
    centers = np.float32(scene.voxels.centers - scene.voxels.center)
    chance = compiled_view(spec.grid.rays, half, compiled_transform(pose), centers, 0.0)
    chance = np.asarray(chance)
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
    at = world(radius=10.0, voxel=2.0, count=0).voxels.centers
    with worlds.double_precision():
        pose, rays = np.array(pose_of(spec, 3)), spec.grid.rays
        weight = np.sin(np.arange(len(at), dtype=float))

        def slope(view):
            of = lambda pose: view(rays, 1.0, in_view.transform_of(pose), at, 0.4) @ weight  # noqa: E731
            return np.asarray(jax.jit(jax.grad(of))(pose))

        ours = slope(in_view.density_view_by_motions)
        assert np.abs(ours).min() > 1e-3
        np.testing.assert_allclose(ours, slope(in_view.density_view), rtol=1e-9, atol=1e-9)


# ── On road users ───────────────────────────────────────────────────────────

KEPT = 1.0 - LidarNoise().lost
"""Share of a LiDAR's returns that come back from where none is weak, up to 89 m."""


@pytest.fixture(scope="module")
def empty():
    return worlds.emptied(world(radius=32.0, voxel=0.5))


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
    worlds.slow_but(
        ["paper-camera", "hesai-pandar64", "paper-lidar-32", "velodyne-vlp-32c", "livox-mid-360"],
        "paper-camera",
        "hesai-pandar64",
    ),
)
def test_the_expected_number_is_the_mean_of_what_is_cast(empty, name):
    """Boxes of four classes in four rings, from several poses: a pose has one phase of the grid.

    The mean ratio of all rings where five or more are expected is within 3 %, and each of them
    within 5 % and three standard errors of the difference, place by place. Cameras: from two
    lengths on, as nearer a vehicle fills much of the picture.
    """
    spec, rng, ratios = inspe_jax.device(name).spec, np.random.default_rng(3), []
    columns = empty.voxels.columns
    poses = np.zeros((6, 6))
    poses[:, 2:4] = np.column_stack([rng.uniform(4, 8, 6), rng.uniform(-0.03, 0.03, 6)])
    poses[:, 4] = rng.uniform(-0.3, -0.1, 6) if spec.aimed else rng.uniform(-0.05, 0.05, 6)
    poses[:, 5] = rng.uniform(-np.pi, np.pi, 6)
    away = np.hypot(*columns.T)
    bearing = np.arctan2(*columns.T[::-1])
    for user in ROAD_USERS:
        expected = [rays_on(empty, spec, pose, user) for pose in poses.tolist()]
        for least, most in ((6, 10), (10, 18), (18, 25), (25, 31)):
            if spec.aimed and least < 2 * user.size[0]:
                continue
            found = []
            for pose, of in zip(poses, expected, strict=True):
                ahead = np.abs((bearing - pose[5] + np.pi) % (2 * np.pi) - np.pi) < 0.4
                there = (away > least) & (away < most) & (ahead if spec.aimed else True)
                for k in rng.choice(np.flatnonzero(there), 10):
                    walked = worlds.rays_on_box(spec, pose, [*columns[k], 0.0], user.size)[0]
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


def test_a_pedestrian_by_hand(empty):
    """20 m from a level comb of 0.5° by 0.2°: 1.72 m by the mean width of 0.5 m squares.

    At this distance the top takes another sin(elevation) of its 0.25 m².
    """
    elevations = tuple(np.radians(np.arange(-40.0, 10.0, 0.5)).tolist())
    spec = LidarSpec("comb", elevations, 1800, 2 * np.pi, 25.0)
    found = rays_on(empty, spec, [0.25, 0.25, 5.0, 0, 0, 0], ROAD_USERS[-1])
    columns = empty.voxels.columns - 0.25
    wide = 2 / np.pi * (0.5 + 0.5) / 20  # Cauchy: the mean width is the perimeter over π
    tall = np.arctan2(5.0, 19.8) - np.arctan2(5.0 - 1.72, 20.2)
    by_hand = wide * tall / np.radians(0.5) / np.radians(0.2)
    assert found[(columns == [20, 0]).all(1)] == pytest.approx(by_hand, rel=0.02)
    assert not found[np.hypot(*columns.T) > 28].any()  # out of reach
    assert np.isfinite(found).all()  # straight below too


@jax.jit
def on_faces(rays, pose, to, edges, middle, wide, tall):
    """Rays on faces between edges, and which share of a face is between the sides of the view."""
    transform = in_view.transform_of(pose)
    share = share_between_sides(rays, transform, middle, wide, tall)
    return rays_on_face(rays, transform, to, edges[:-1], edges[1:])[0], share


@pytest.mark.parametrize(("kind", "turns"), [
    ("camera", (0.0, -np.pi / 2, 0.4)),
    ("camera", (np.pi, -0.2, 0.4)),
    ("camera", (2.6, -0.2, 0.4)),
    ("sector", (np.pi, -0.25, 0.4)),
    ("sector", (0.2, -0.2, -3.0)),
    ("nearly round", (0.15, 0.0, 0.4)),
])  # fmt: skip
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
    walked = np.array([worlds.rays_on_box(spec, pose, foot, size)[0] for foot in feet])
    slabs, rays = np.float32([0.0, 0.5, 1.0, 1.5, 2.0]), spec.grid.rays
    to = np.float32(feet[:, 0]), np.float32(feet[:, 1])
    edges = np.minimum(slabs, np.float32(size[2]))[:, None] - np.float32(np.full((1, 60), pose[2]))
    wide, tall = (np.float32([[x]]) for x in (2 * 1.0 / np.pi, size[2]))
    middle = (*to, np.float32(np.full(60, size[2] / 2 - pose[2])))
    on_face, share = map(
        np.asarray, on_faces(rays, np.float32(pose), to, edges, middle, wide, tall)
    )
    found = on_face.sum(0) * share[0] * float(wide[0, 0])
    assert 0.03 < (walked > 0).mean() < 1
    assert (found > 0.5).mean() == pytest.approx((walked > 0.5).mean(), abs=0.07)
    assert found.sum() == pytest.approx(walked.sum(), rel=0.25)
    assert np.corrcoef(np.sqrt(found), np.sqrt(walked))[0, 1] > 0.95
