"""Strict promotion and no NaN, for every test; what one compiled, others need not."""

import atexit
import os
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

# What one process compiles, the others of this run need not, nor those that tests start: the
# environment is theirs too. With a limit to its size JAX locks the folder.
if "INSPE_TESTS" not in os.environ:
    compiled_here = tempfile.mkdtemp()
    atexit.register(shutil.rmtree, compiled_here, ignore_errors=True)
    os.environ |= {
        "INSPE_TESTS": "1",
        "JAX_COMPILATION_CACHE_DIR": compiled_here,
        "JAX_COMPILATION_CACHE_MAX_SIZE": str(4 * 2**30),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.2",
    }
jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])
jax.config.update(
    "jax_compilation_cache_max_size", int(os.environ["JAX_COMPILATION_CACHE_MAX_SIZE"])
)
jax.config.update(
    "jax_persistent_cache_min_compile_time_secs",
    float(os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"]),
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files with slow tests first: what a process is left with at the end is then short."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


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
