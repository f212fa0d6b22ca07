"""One run at a time in a folder, and one that began it with the same versions."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from inspe_jax.core.errors import InspeError, needs

if TYPE_CHECKING:
    from filelock import AcquireReturnProxy

ADVICE = "name another folder, or delete this one to start again"


def lock_folder(folder: Path, name: str) -> "AcquireReturnProxy":
    """Take the lock ``name`` of a folder for a ``with`` block; raises InspeError if a run has
    it."""
    with needs("sweeps, data sets and trainings lock their folders by filelock", "sweep"):
        from filelock import FileLock, Timeout
    try:
        return FileLock(folder / name).acquire(timeout=0)
    except Timeout:
        raise InspeError(f"{folder}: is in use by another run; wait until it is done") from None


def check_versions(had: Mapping[str, Any], now: Mapping[str, str], where: object) -> None:
    """Raise InspeError where what is there was begun with other versions."""
    for name, version in now.items():
        if had.get(name) != version:
            raise InspeError(
                f"{where}: was begun with {name} {had.get(name)}, but this is {version}; {ADVICE}"
            )
