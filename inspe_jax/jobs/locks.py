"""One run at a time in a folder."""

from pathlib import Path
from typing import TYPE_CHECKING

from inspe_jax.core.errors import InspeError, needs

if TYPE_CHECKING:
    from filelock import FileLock


def lock_folder(folder: Path, name: str) -> "FileLock":
    """Take the lock ``name`` of a folder, until its ``release``.

    A killed process leaves no lock. Raises InspeError if another run has it, or filelock is
    missing.
    """
    with needs("sweeps, data sets and trainings lock their folders by filelock", "sweep"):
        from filelock import FileLock, Timeout
    lock = FileLock(folder / name)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise InspeError(f"{folder}: is in use by another run; wait until it is done") from None
    return lock
