"""What the tests of the viewer look at."""

import numpy as np
import pytest
from worlds import CAMERA, LIDAR, place_sensors


@pytest.fixture(scope="session")
def layout():
    """A camera in the north-east that looks south, and a LiDAR in the south-west."""
    return place_sensors(
        (CAMERA, [9.0, 9.0, 6.0, 0, -0.3, np.radians(-100)]),
        (LIDAR, [-9.0, -9.0, 5.0, 0, 0, 0]),
    )
