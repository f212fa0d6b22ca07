"""The picture of a layout in its place: its marks are where the sensors are in the picture."""

import numpy as np
import pytest
from worlds import CAMERA, LIDAR, place_sensors, with_boxes, world

from inspe_jax.core.errors import InspeError
from inspe_jax.report import still
from inspe_jax.report.still import BACK, BEYOND, FOCAL, HEIGHT, UP, WIDTH, size_of, still_view

RADIUS = 14.0


@pytest.fixture(scope="module")
def scene():
    pytest.importorskip("embreex", reason="no wheels of Embree for this platform")
    return world(radius=RADIUS, voxel=1.0, frames=1, count=0)


@pytest.fixture(scope="module")
def layout():
    return place_sensors(
        (CAMERA, [9.0, 9.0, 6.0, 0, -0.3, -1.8]), (LIDAR, [-9.0, -9.0, 5.0, 0, 0, 0])
    )


def seen_at(scene, layout, point):
    """Column and row by hand: the camera looks north and down."""
    away = (
        np.asarray(point)
        - scene.voxels.center
        - size_of(scene, layout) * np.array([0.0, -BACK, UP])
    )
    down = np.arctan2(UP, BACK - BEYOND)
    ahead = np.array([0.0, np.cos(down), -np.sin(down)])
    above = np.array([0.0, np.sin(down), np.cos(down)])
    scale = FOCAL * WIDTH / (away @ ahead)
    return WIDTH / 2 + scale * away[0], HEIGHT / 2 - scale * (away @ above)


def test_numbers_stand_at_the_highest_sensor_of_each_unit(scene, layout):
    (ax,) = still_view(scene, layout).axes
    assert [mark.get_text() for mark in ax.texts] == ["1", "2"]
    for mark, pose in zip(ax.texts, layout.poses, strict=True):
        np.testing.assert_allclose(mark.xy, seen_at(scene, layout, pose[:3]), atol=1e-3)
        assert 0 < mark.xy[0] < WIDTH
        assert 0 < mark.xy[1] < HEIGHT


def test_a_road_user_is_where_it_should_be_in_the_picture(scene, layout):
    def picture(of):
        (image,) = still_view(of, layout).axes[0].images
        return np.asarray(image.get_array(), int)

    at = scene.voxels.center[:2] + [4.0, -3.0]
    car = with_boxes(scene, (*at, 0.0, 4.5, 1.8, 1.5))
    changed = np.abs(picture(car) - picture(scene)).max(-1) > 60  # its body, beyond the noise
    rows, columns = np.nonzero(changed)
    level = scene.intersection.ground(at[None])[0]
    column, row = seen_at(scene, layout, [*at, level + 0.75])
    metre = seen_at(scene, layout, [*at + [1.0, 0.0], level + 0.75])[0] - column
    assert changed.sum() > metre**2
    assert abs(np.median(columns) - column) < metre
    assert abs(np.median(rows) - row) < metre


def test_without_embree_there_is_none(scene, layout, monkeypatch):
    def none(*_):
        raise InspeError("recording needs Embree")

    monkeypatch.setattr(still, "surroundings_of", none)
    assert still_view(scene, layout) is None
