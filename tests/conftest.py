"""Strict promotion and no NaN, for every test; what one compiled, others need not."""

import atexit
import shutil
import tempfile
from pathlib import Path

import jax
import pytest
from worlds import MAPS

from inspe_jax.cores import compiled

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_debug_nans", True)

# Every search compiles its own functions, and most of them are of the same shapes.
COMPILED = tempfile.mkdtemp()
atexit.register(shutil.rmtree, COMPILED, ignore_errors=True)
jax.config.update("jax_compilation_cache_dir", COMPILED)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


@pytest.fixture(scope="session")
def maps() -> Path:
    """The folder of town maps beside the checkout; tests that need it skip where it is absent."""
    if not MAPS.is_dir():
        pytest.skip("the town maps are not beside this checkout")
    pytest.importorskip("carla", reason="reading OpenDRIVE needs the CARLA client")
    return MAPS


@pytest.fixture(scope="module", autouse=True)
def _forget_what_was_compiled():
    """After each file: all the tests' code together takes more memory maps than Linux allows."""
    yield
    jax.clear_caches()
    compiled.clear()
