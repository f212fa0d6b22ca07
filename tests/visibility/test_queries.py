"""In view against walked rays and margins, line of sight against Embree and ceilings; and the walks
against boxes."""

import jax
import numpy as np
import pytest
import raycast
import worlds
from dense_reference import shadow_ceilings, view_margins
from scipy.spatial import cKDTree
from worlds import CAMERA, LIDAR, place_sensors, random_layout, slow_but, with_boxes, world

from inspe_jax.core.arrays import from_center
from inspe_jax.core.errors import InspeError
from inspe_jax.sensing.catalogue import devices
from inspe_jax.sensing.sensors import CameraSpec, LidarSpec
from inspe_jax.visibility.centered_scene import about_center
from inspe_jax.visibility.in_view import in_view_margins, transform_of
from inspe_jax.visibility.queries import in_view, line_of_sight

DEVICES = devices()


@pytest.mark.parametrize("name", slow_but(DEVICES, "paper-camera", "velodyne-vlp-16"))
def test_in_view_agrees_with_every_ray_walked(name):
    """At least 99.9 % of voxels for every device, and C within 0.001.

    The disagreements are cubes that a ray clips within centimetres of a corner or
    at the edge of the reach; those seen without a ray it passes within 0.02 mm.
    """
    scene = world(count=0, slope=0.04)
    seed = sorted(DEVICES).index(name)
    layout = random_layout(scene, [DEVICES[name].spec] * 2, seed=seed, heights=(2.0, 8.0))
    ours, walked = in_view(scene, layout), raycast.in_view(scene, layout, "exact")
    assert (ours == walked).mean(axis=1).min() >= 0.999
    w = scene.voxels.weight
    for a, b in zip(ours, walked, strict=True):
        assert w @ a / w.sum() == pytest.approx(w @ b / w.sum(), abs=1e-3)
    assert not (ours & ~walked).sum() > 1e-4 * ours.size  # nothing is seen without a ray


def test_voxels_that_stand_apart_are_those_among_all():
    """Of every third in each direction the same is in view and in sight as in the midst of all."""
    size = dict(voxel=0.2, radius=12.0, slope=0.03, count=9)
    scene, apart = (world(spacing=spacing, **size) for spacing in (None, 0.6))
    assert (scene.voxels.level_count, apart.voxels.level_count) == (20, 7)
    layout = random_layout(scene, [LIDAR, CAMERA], seed=3, heights=(2.0, 6.0))
    gap, among = cKDTree(scene.voxels.centers).query(apart.voxels.centers)
    same = gap < 1e-9  # on a region's border rounding decides which column there is
    assert same.mean() > 0.95
    for seen in (in_view, lambda *given: line_of_sight(*given, frame=1)):
        few, all_ = seen(apart, layout)[:, same], seen(scene, layout)[:, among[same]]
        assert 0.05 < few.mean() < 0.98
        assert (few == all_).mean() > 0.999
    walked = raycast.in_view(apart, layout, "exact")
    assert (in_view(apart, layout) == walked).mean() > 0.999
    assert in_view(apart, layout).mean() == pytest.approx(in_view(scene, layout).mean(), abs=0.01)
    with pytest.raises(InspeError, match="voxels that touch"):
        raycast.in_view(apart, layout, "bresenham")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["velodyne-vlp-16", "hesai-pandar64", "livox-mid-360"])
def test_in_view_of_large_voxels(name):
    """Of 1 m, beside the sensor: there the corner nearest to a row changes across the cube."""
    scene = world(radius=30.0, voxel=1.0, count=0, slope=0.05)
    layout = random_layout(scene, [DEVICES[name].spec] * 4, seed=7)
    ours, walked = in_view(scene, layout), raycast.in_view(scene, layout, "exact")
    assert (ours == walked).mean(axis=1).min() >= 0.999


@pytest.mark.parametrize("turn", [(0.8, 0.0), (-0.5, -1.2), (0.2, 0.4)])
@pytest.mark.parametrize("fov", slow_but([80.0, 200.0, 340.0], 200.0))
def test_in_view_of_a_tilted_lidar_with_part_of_a_turn(fov, turn):
    """Also where the field of view reaches behind the planes of its edge columns."""
    spec = LidarSpec("part", LIDAR.elevations, int(4 * fov), np.radians(fov), 40.0)
    scene = world(count=0)
    layout = place_sensors((spec, [1.3, 2.1, 5.2, *turn, 0.7]))
    ours, walked = in_view(scene, layout), raycast.in_view(scene, layout, "exact")
    assert (ours == walked).mean() >= 0.999


@pytest.mark.parametrize("pose", [
    [9.3, 9.3, 3.0, 0, 0, 0.1],  # a level channel along a face of the voxels
    [2.0, 1.5, 4.3, 0, 0, 0],  # azimuths along faces
    [0.0, 0.0, 5.0, 0, 0, np.pi / 2],
])  # fmt: skip
def test_a_ray_along_a_face_touches_the_voxels_on_both_sides(pose):
    """Ties are many where poses are round numbers; both sides read them as touching."""
    level = LidarSpec(
        "level", tuple(np.radians(np.arange(-16.0, 16.0)).tolist()), 720, 2 * np.pi, 40.0
    )
    scene = world(count=0)
    layout = place_sensors((level, pose))
    ours, walked = in_view(scene, layout), raycast.in_view(scene, layout, "exact")
    assert (ours == walked).mean() >= 0.999
    w = scene.voxels.weight / scene.voxels.weight.sum()
    assert w @ ours[0] == pytest.approx(w @ walked[0], abs=1e-3)


def test_one_ray_lights_the_voxels_it_passes_through():
    """A camera of one pixel 1.25 m up looks along +x at y = 0.25: level 2, one row, to 10 m."""
    pencil = CameraSpec("pencil", 1, 1, 1.0, (0.5, 0.5), 1.0, 10.0)
    scene = world(count=0)
    layout = place_sensors((pencil, [-3.1, 0.25, 1.25, 0.0, 0.0, 0.0]))
    seen = scene.voxels.centers[in_view(scene, layout)[0]]
    assert sorted(seen[:, 0]) == pytest.approx(np.arange(-3.25, 7.0, 0.5))
    assert set(seen[:, 1]) == {0.25}
    assert set(seen[:, 2]) == {1.25}


def test_a_sensor_straight_above_a_voxel_and_level_rays_give_no_nan():
    """The voxel column under the sensor has no azimuth; a level ray is parallel to two faces."""
    scene = world(count=0)
    layout = place_sensors(
        (LIDAR, [0.25, 0.25, 5.0, 0.0, 0.0, 0.0]),
        (CAMERA, [0.25, 0.25, 3.75, 0.0, -np.pi / 2, 0.0]),
    )
    assert in_view(scene, layout)[1].any()
    centers, half = scene.voxels.centers.astype(np.float32), scene.voxels.size / 2
    of = jax.jit(lambda rays, pose: in_view_margins(rays, half, transform_of(pose), centers))
    for sensor, pose in zip(layout.sensors, layout.poses, strict=True):
        assert np.isfinite(of(sensor.spec.grid.rays, np.float32(pose))).all()


@pytest.mark.parametrize(("seed", "slope", "heights", "center"), [
    (0, 0.0, (1.0, 3.0), (0, 0, 0)),  # below and among the tops
    (1, 0.0, (4.0, 9.0), (0, 0, 0)),  # above them
    (2, 0.08, (1.0, 9.0), (0, 0, 0)),
    (3, -0.12, (1.0, 9.0), (1873.2, -951.7, 41.0)),  # far from the origin, sloping
])  # fmt: skip
def test_line_of_sight_agrees_with_embree(seed, slope, heights, center):
    """At least 99.99 % of (sensor, voxel, frame); both round in single precision at an edge."""
    scene = world(count=16, seed=seed, slope=slope, center=center)
    layout = random_layout(scene, [LIDAR] * 3 + [CAMERA] * 3, seed=seed, heights=heights)
    ours, embree = (
        np.stack([of(scene, layout, frame) for frame in range(4)])
        for of in (line_of_sight, worlds.embree_line_of_sight)
    )
    shares = embree.mean((1, 2))
    assert 0.05 < shares.min() < shares.max() < 0.999
    assert (ours != embree).mean() <= 1e-4


def test_line_of_sight_behind_a_car_by_hand():
    """From 5 m, a 1.5 m car 8..12 m away hides what lies below 5 − 3.5·x/12 behind it."""
    scene = with_boxes(world(), (10.0, 0.0, 0.0, 4.0, 1.8, 1.5))
    layout = place_sensors((LIDAR, [0.0, 0.0, 5.0, 0.0, 0.0, 0.0]))
    clear = line_of_sight(scene, layout, 0)[0]
    at = {tuple(c): v for v, c in enumerate(scene.voxels.centers.round(3).tolist())}
    assert clear[at[(7.75, 0.25, 0.25)]]  # before it
    assert not clear[at[(10.25, 0.25, 1.25)]]  # in it
    assert clear[at[(10.25, 0.25, 1.75)]]  # over it
    assert not clear[at[(14.25, 0.25, 0.75)]]  # 5 − 3.5·14.25/12 = 0.84
    assert clear[at[(15.25, 0.25, 0.75)]]  # 0.55
    assert clear[at[(14.25, 2.25, 0.25)]]  # beside the shadow


@pytest.mark.parametrize(("pose", "message"), [
    ([5.0, 0, 5, 0, 0, np.nan], "not finite"),
    ([np.inf, 0, 5, 0, 0, 0], "not finite"),
    ([8000.0, 0, 15, 0, 0, 0], "7980 m from the region of interest of test crossing"),
    ([10.0, 0, 0.9, 0, 0, 0], r"'s0' at \(10.00, 0.00\) is in the ground"),
    ([0.0, 0, 5, 0, 0, 0], r"frame 9 is out of range: .* has frames 0 to 3"),
])  # fmt: skip
def test_poses_and_frames_that_cannot_be_meant(pose, message):
    layout = place_sensors((LIDAR, [0.0, 0.0, 5.0, 0.0, 0.0, 0.0]))
    with pytest.raises(InspeError, match=message):
        line_of_sight(world(slope=0.1), layout.with_poses(np.array([pose])), 9)


# ── Where a short cut could go wrong: against margins and ceilings ──────────


def camera(width, height, degrees, depth=30.0, principal=0.5):
    focal = width / 2 / np.tan(np.radians(degrees) / 2)
    return CameraSpec("camera", width, height, focal, (width * principal, height / 2), 1.0, depth)


def lidar(rows, azimuths, degrees=360.0, reach=40.0):
    return LidarSpec("lidar", tuple(np.radians(rows)), azimuths, np.radians(degrees), reach)


AWKWARD = {
    "camera": CAMERA,
    "narrow camera": camera(40, 30, 8.0),
    "camera of 165°": camera(160, 120, 165.0, depth=9.0),
    "camera that looks past its axis": camera(40, 30, 40.0, principal=-0.3),
    "camera of one pixel": camera(1, 1, 20.0),
    "lidar": LIDAR,
    "lidar with a steep row": lidar((-85.0, -30.0, 0.0), 720),
    "lidar of 120°": lidar((-20.0, -10.0, -5.0, 0.0), 300, 120.0),
    "lidar of one row": lidar((-10.0,), 900),
}
ANGLES = [(0, 0), (0, 90), (0, 180), (0, -90), (-45, 0), (-90, 0), (-30, 37)]
"""Pitch and yaw [degrees]."""


@pytest.mark.parametrize("name", slow_but(AWKWARD, "camera", "lidar"))
def test_in_view_by_masks_is_in_view_by_margins(name):
    """Above a column's centre, level with a voxel's, and anywhere; along the axes and not.

    Where the two differ, the walk of every ray must be with the masks: very wide cameras and steep
    rows clip a few voxels that the margins' six rays miss, and the nearest ray tells.
    """
    scene = world(count=0, slope=0.03)
    x, y, z = scene.voxels.centers[len(scene.voxels.centers) // 2]
    poses = [
        [*place, 0.0, np.radians(pitch), np.radians(yaw)]
        for place in ((x, y, z + 6.0), (x - 3.0, y + 2.0, z), (0.1, -2.3, 4.7))
        for pitch, yaw in ANGLES
    ]
    layout = place_sensors(*((AWKWARD[name], pose) for pose in poses))
    groups, half = layout.groups(), scene.voxels.size / 2
    margins = jax.jit(lambda poses, ground: view_margins(poses, ground.centers, groups, half))
    at = from_center(scene.voxels.center, layout.poses), about_center(scene)
    field, ray = map(np.asarray, margins(*at))
    masks = in_view(scene, layout)
    assert masks.any()
    differ = masks != ((field > 0) & (ray > 0))
    assert differ.sum() <= 2
    if differ.any():
        walked = raycast.in_view(scene, layout, "exact")
        np.testing.assert_array_equal(masks[differ], walked[differ])


@pytest.mark.parametrize("voxel", [worlds.TALL["voxel"], 0.5])
def test_line_of_sight_by_masks_is_that_of_all_ceilings(voxel):
    """Just above and below a top, beside and inside a vehicle, lower than the lowest voxel."""
    scene = world(radius=10.0, voxel=voxel, count=0)
    scene = with_boxes(
        scene, (0, 0, 0.4, 5, 2, 2.1), (6, 3, 1.0, 5, 2, 1.5), (-5, -4, 0.0, 9, 2.5, 3.4)
    )
    places = [(1.0 + d, 0.0, 2.1 + h) for d in (0.0, 3.0) for h in (-1e-3, 1e-3, 5e-3, 0.02, 2.0)]
    places += [(0.0, 0.0, 1.0), (-5.0, -2.75, 1.2), (2.0, -3.0, voxel / 4), (0.3, 8.0, 6.0)]
    layout = place_sensors(*((LIDAR, [*place, 0.0, 0.0, 0.0]) for place in places))
    ground = about_center(scene)
    prisms = jax.tree.map(lambda leaf: np.asarray(leaf)[0], ground.prisms)
    sensors = from_center(scene.voxels.center, layout.poses)[:, :3]
    ceilings = np.asarray(jax.jit(shadow_ceilings)(sensors, prisms, ground.columns))
    clear = (np.asarray(ground.heights) > ceilings[:, :, None]).reshape(len(places), -1)
    masks = line_of_sight(scene, layout, 0)
    assert 0 < masks.mean() < 1
    np.testing.assert_array_equal(masks, clear)


# ── The walks, on paper and against a slab test of every box ────────────────


def test_exact_walk_agrees_with_a_slab_test_of_every_box():
    """Brute force: every ray against every voxel's box, on sloping ground."""
    scene = world(radius=10.0, count=0, slope=0.1)
    layout = random_layout(scene, [CAMERA], seed=5)
    origin, directions, reach = layout.rays(0)
    centers, half = scene.voxels.centers, scene.voxels.size / 2
    expected = np.zeros(len(centers), bool)
    for d in directions[::7]:
        low, high = (centers - half - origin) / d, (centers + half - origin) / d
        entry = np.minimum(low, high).max(1).clip(0)
        expected |= entry < np.minimum(np.maximum(low, high).min(1), reach)
    walked = np.zeros_like(expected)
    raycast.exact(scene.voxels, origin, directions[::7], reach, walked)
    assert (walked == expected).mean() >= 0.9999
    assert 0.01 < expected.mean() < 0.95


def test_bresenham_by_hand():
    """From cell (0, 0, 2) to (6, 3, 2): steps of one in x, halves in y rounded up."""
    scene = world(radius=10.0, count=0)
    seen = np.zeros(scene.voxels.count, bool)
    origin = np.array([0.25, 0.25, 1.25])
    to = np.array([3.0, 1.5, 0.0])
    reach = float(np.linalg.norm(to))
    raycast.bresenham(scene.voxels, origin, to[None] / reach, reach, seen)
    cells = np.round((scene.voxels.centers[seen] - 0.25) / 0.5).astype(int)
    assert cells[:, 2].tolist() == [2] * 7
    assert sorted(map(tuple, cells[:, :2].tolist())) == [
        (0, 0), (1, 1), (2, 1), (3, 2), (4, 2), (5, 3), (6, 3)
    ]  # fmt: skip


def test_unknown_walk():
    layout = place_sensors((LIDAR, [0.0, 0.0, 5.0, 0.0, 0.0, 0.0]))
    with pytest.raises(InspeError, match="walk 'dda': one of bresenham, exact"):
        raycast.in_view(world(count=0), layout, "dda")
