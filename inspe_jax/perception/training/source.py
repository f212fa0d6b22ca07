"""The cache of a data set that a command names."""

import os
from collections.abc import Callable
from pathlib import Path

from inspe_jax.core.errors import InspeError
from inspe_jax.dataset.loading import Cache, cache, open_cache
from inspe_jax.dataset.loading.caching import CACHE, pictures_of
from inspe_jax.perception.detector import model_of
from inspe_jax.perception.training.run import Run


def cache_of(
    source: str | os.PathLike[str],
    *,
    pictures: tuple[int, int] | None,
    any_size: bool = False,
    folder: str | os.PathLike[str] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Cache:
    """A data set as a cache; ``source`` may be one.

    What of the set is not decoded yet is decoded into ``folder``, or else into a folder beside the
    set, which has its name and ``_cache``. ``pictures`` are resized to (height, width). A cache
    that is given has the size that it has; so has one that is there already, if ``any_size`` will
    do. Raises InspeError if a cache is given with a ``folder``.
    """
    source = Path(source)
    if (source / CACHE).is_file():
        if folder is not None:
            raise InspeError(
                f"{source}: is a cache already: leave --cache {folder} out, or give the set itself"
            )
        return open_cache(source)
    beside = source.resolve()
    into = beside.with_name(f"{beside.name}_cache") if folder is None else Path(folder)
    if any_size and (into / CACHE).is_file():
        pictures = pictures_of(into)
    return cache(source, into, pictures=pictures, progress=progress)


def pictures_in_words(found: Cache) -> str:
    """What pictures a cache has."""
    if found.pictures is None:
        return "no pictures"
    height, width = found.pictures
    return f"pictures of {width}x{height}"


def check_pictures(run: Run, found: Cache) -> None:
    """Raise InspeError if a run's detector takes pictures, and a cache has others or none."""
    size = None if found.pictures is None else list(found.pictures)
    if "camera" in model_of(run.content.settings.model).sensors and size != run.content.pictures:
        height, width = run.content.pictures or (0, 0)
        raise InspeError(
            f"{found.path}: has {pictures_in_words(found)}, but {run.path} was trained on "
            f"{width}x{height}: cache the set into another folder with --pictures {width}x{height}"
        )
