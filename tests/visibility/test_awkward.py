"""Masks against margins and ceilings voxel by voxel, where a short cut could go wrong."""

import jax
import numpy as np
import pytest
import raycast
from dense_reference import shadow_ceilings, view_margins
from worlds import CAMERA, LIDAR, TALL, place_sensors, slow_but, with_boxes, world

from inspe_jax.sensing.sensors import CameraSpec, LidarSpec
from inspe_jax.visibility.centered_scene import about_center, poses_about_center
from inspe_jax.visibility.queries import in_view, line_of_sight


def camera(width, height, degrees, depth=30.0, principal=0.5):
    focal = width / 2 / np.tan(np.radians(degrees) / 2)
    return CameraSpec("camera", width, height, focal, (width * principal, height / 2), 1.0, depth)


def lidar(rows, azimuths, degrees=360.0, reach=40.0):
    return LidarSpec("lidar", tuple(np.radians(rows)), azimuths, np.radians(degrees), reach)


DEVICES = {
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


@pytest.mark.parametrize("name", slow_but(DEVICES, "camera", "lidar"))
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
    layout = place_sensors(*((DEVICES[name], pose) for pose in poses))
    groups, half = layout.groups(), scene.voxels.size / 2
    margins = jax.jit(lambda poses, ground: view_margins(poses, ground.centers, groups, half))
    at = poses_about_center(scene, layout), about_center(scene)
    field, ray = map(np.asarray, margins(*at))
    masks = in_view(scene, layout)
    assert masks.any()
    differ = masks != ((field > 0) & (ray > 0))
    assert differ.sum() <= 2
    if differ.any():
        walked = raycast.in_view(scene, layout, "exact")
        np.testing.assert_array_equal(masks[differ], walked[differ])


@pytest.mark.parametrize("voxel", [TALL["voxel"], 0.5])
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
    sensors = poses_about_center(scene, layout)[:, :3]
    ceilings = np.asarray(jax.jit(shadow_ceilings)(sensors, prisms, ground.columns))
    clear = (np.asarray(ground.heights) > ceilings[:, :, None]).reshape(len(places), -1)
    masks = line_of_sight(scene, layout, 0)
    assert 0 < masks.mean() < 1
    np.testing.assert_array_equal(masks, clear)
