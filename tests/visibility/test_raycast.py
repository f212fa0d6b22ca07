"""The literal walks, against answers on paper and against a slab test of every box."""

import numpy as np
import pytest
import raycast
from worlds import CAMERA, LIDAR, place_sensors, random_layout, world

from inspe_jax.core.errors import InspeError


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
