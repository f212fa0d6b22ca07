"""What the tests of the viewer look at."""

import numpy as np
import pytest
from matplotlib.figure import Figure
from worlds import CAMERA, LIDAR, place_sensors, world


@pytest.fixture(scope="session")
def scene():
    return world(radius=14.0, voxel=1.0, frames=3, count=4)


@pytest.fixture(scope="session")
def layout():
    """A camera in the north-east that looks south, and a LiDAR in the south-west."""
    return place_sensors(
        (CAMERA, [9.0, 9.0, 6.0, 0, -0.3, np.radians(-100)]), (LIDAR, [-9.0, -9.0, 5.0, 0, 0, 0])
    )


@pytest.fixture
def plain_plan(monkeypatch):
    """Plan views are empty: each takes longer to draw than all else that follows a change."""
    picture = "inspe_jax.viewer.blind_spot_panel.plan_picture"
    monkeypatch.setattr(picture, lambda *_: Figure((0.1, 0.1)))
