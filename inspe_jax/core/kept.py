"""Compiled programs are kept on disk for the next process, from when this is imported, and what is
compiled is counted: all that has JAX compile imports this."""

import atexit
import contextlib
import os
from pathlib import Path

import jax
import jax.monitoring
from platformdirs import user_cache_path

from inspe_jax.core.compiling import hear
from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import check_writable

KEPT = 512 * 2**20
"""Size of the folder of compiled programs [bytes]. The least recently used go as a process ends."""
NOTHING = ("0", "false", "f", "no", "n", "off")  # values of INSPE_CACHE that keep nothing
CACHE_SETTINGS = (
    "jax_enable_compilation_cache",
    "jax_compilation_cache_dir",
    "jax_compilation_cache_max_size",
    "jax_persistent_cache_min_compile_time_secs",
)
"""JAX's settings of its cache of compiled programs."""


def keep_programs() -> None:
    """Keep all programs that this process compiles in the user's cache folder for the next one. A
    folder that the user sets for JAX stays. If no folder can be written, nothing is kept."""
    if jax.config.jax_compilation_cache_dir is not None:  # type: ignore[attr-defined]
        return
    try:
        folder = user_cache_path("inspe_jax", appauthor=False)
        if not folder.is_absolute():  # there is no home folder
            return
        folder.mkdir(parents=True, exist_ok=True)
        check_writable(folder)
    except (InspeError, OSError, RuntimeError):
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    atexit.register(prune, folder)


def kept_in() -> Path | None:
    """The folder that programs are kept in; None if they are not."""
    on = jax.config.jax_enable_compilation_cache  # type: ignore[attr-defined]
    folder = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    return Path(folder) if on and folder else None


def prune(folder: Path, most: int = KEPT) -> None:
    """Remove programs of a folder, the least recently used first, down to so many bytes. JAX's own
    limit locks all processes out of the folder for every program."""
    found: list[tuple[float, int, Path]] = []
    for path in folder.glob("*-cache"):
        with contextlib.suppress(OSError):  # another process removes some too
            stat = path.stat()
            found.append((max(stat.st_atime, stat.st_mtime), stat.st_size, path))
    size = 0
    for _, own, path in sorted(found, reverse=True):
        size += own
        if size > most:
            with contextlib.suppress(OSError):
                path.unlink()


jax.monitoring.register_event_duration_secs_listener(hear)
if os.environ.get("INSPE_CACHE", "").lower() not in NOTHING:
    keep_programs()
