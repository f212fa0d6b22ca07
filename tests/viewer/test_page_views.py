"""The picture of a layout in its place: its marks are where the sensors are in the picture."""

from unittest.mock import Mock

import numpy as np
import pytest
from worlds import CAMERA, LIDAR, place_sensors, with_boxes, world

from inspe_jax.core.errors import InspeError
from inspe_jax.sensing.layout import Sensor, Unit, make_layout
from inspe_jax.viewer import page_views
from inspe_jax.viewer.page_views import BACK, BEYOND, FOCAL, HEIGHT, UP, WIDTH, still_view

RADIUS = 14.0


@pytest.fixture(scope="module")
def scene():
    pytest.importorskip("embreex", reason="no wheels of Embree for this platform")
    return world(radius=RADIUS, voxel=1.0, frames=1, count=0)


def seen_at(scene, point, size=RADIUS):
    """Column and row by hand: the camera looks north and down."""
    eye = scene.voxels.center + size * np.array([0.0, -BACK, UP])
    away = np.asarray(point) - eye
    down = np.arctan2(UP, BACK - BEYOND)
    ahead = np.array([0.0, np.cos(down), -np.sin(down)])
    above = np.array([0.0, np.sin(down), np.cos(down)])
    scale = FOCAL * WIDTH / (away @ ahead)
    return WIDTH / 2 + scale * away[0], HEIGHT / 2 - scale * (away @ above)


def test_numbers_stand_at_the_highest_sensor_of_each_unit(scene, layout):
    size = (page_views._eye_on(scene, layout).pose[2] - scene.voxels.center[2]) / UP
    assert size > RADIUS  # a sensor of 6 m would stick out at the top
    (ax,) = still_view(scene, layout).axes
    assert [mark.get_text() for mark in ax.texts] == ["1", "2"]
    for mark, pose in zip(ax.texts, layout.poses, strict=True):
        np.testing.assert_allclose(mark.xy, seen_at(scene, pose[:3], size), atol=1e-3)


def test_a_pole_is_upright_and_arms_are_level(scene):
    x, y = scene.voxels.center[:2] + [5.0, -4.0]
    poses = np.array([[x, y, 5.0, 0, 0, 0], [x - 1.5, y, 6.0, 0, -0.2, 0]])
    sensors = [Sensor("a", LIDAR, 0), Sensor("b", CAMERA, 0)]
    layout = make_layout(sensors, [Unit("corner", (x, y, 0.0))], poses)
    size = (page_views._eye_on(scene, layout).pose[2] - scene.voxels.center[2]) / UP
    (ax,) = still_view(scene, layout).axes
    drawn = [line.get_xydata() for line in ax.lines if len(line.get_xydata()) == 2]
    ends = [[[x, y, 0.0], [x, y, 6.0]], [[x, y, 5.0]] * 2, [[x, y, 6.0], [x - 1.5, y, 6.0]]]
    wanted = [[seen_at(scene, point, size) for point in line] for line in ends]
    for line in wanted:
        assert any(np.allclose(line, found, atol=1e-3) for found in drawn)


@pytest.mark.parametrize("azimuth", [190, 270])
def test_every_sensor_is_in_the_picture(scene, azimuth):
    x, y = RADIUS * np.array([np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth))])
    (ax,) = still_view(scene, place_sensors((LIDAR, [x, y, 9.0, 0, 0, 0]))).axes
    column, row = ax.texts[0].xy
    assert 0 < column < WIDTH
    assert 0 < row < HEIGHT


def test_a_road_user_is_where_it_should_be_in_the_picture(scene, layout):
    def picture(of):
        (image,) = still_view(of, layout).axes[0].images
        return np.asarray(image.get_array(), int)

    at = scene.voxels.center[:2] + [4.0, -3.0]
    car = with_boxes(scene, (*at, 0.0, 4.5, 1.8, 1.5))
    changed = np.abs(picture(car) - picture(scene)).max(-1) > 60  # its body, beyond the noise
    rows, columns = np.nonzero(changed)
    level = scene.intersection.ground(at[None])[0]
    size = (page_views._eye_on(scene, layout).pose[2] - scene.voxels.center[2]) / UP
    column, row = seen_at(scene, [*at, level + 0.75], size)
    metre = seen_at(scene, [*at + [1.0, 0.0], level + 0.75], size)[0] - column
    assert changed.sum() > metre**2
    assert abs(np.median(columns) - column) < metre
    assert abs(np.median(rows) - row) < metre


def test_without_embree_there_is_none(layout, monkeypatch):
    none = Mock(side_effect=InspeError("recording needs Embree"))
    monkeypatch.setattr(page_views, "Surroundings", none)
    assert still_view(world(radius=RADIUS, voxel=1.0, frames=1, count=0), layout) is None
