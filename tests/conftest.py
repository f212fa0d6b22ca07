"""Strict promotion and no NaN, for every test."""

from pathlib import Path

import jax
import pytest
from worlds import MAPS

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_debug_nans", True)


@pytest.fixture(scope="session")
def maps() -> Path:
    """The folder of town maps beside the checkout; tests that need it skip where it is absent."""
    if not MAPS.is_dir():
        pytest.skip("the town maps are not beside this checkout")
    pytest.importorskip("carla", reason="reading OpenDRIVE needs the CARLA client")
    return MAPS
