"""A place that several files search."""

import pytest
from worlds import world


@pytest.fixture(scope="session")
def scene():
    return world(radius=20.0, voxel=1.0, frames=5, count=12, seed=3)
