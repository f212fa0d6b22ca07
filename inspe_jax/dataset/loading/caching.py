"""The decoded cache of a data set: ``cache.json``, and a folder for each scenario."""

import json
import multiprocessing
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from inspe_jax.core.errors import InspeError, check_known
from inspe_jax.core.files import check_model, prepare_folder, read_json, write_text
from inspe_jax.core.parallel import cores
from inspe_jax.dataset.folders import Dataset, Scenario, open_dataset, split_folders, subfolders
from inspe_jax.dataset.loading import stored as storage
from inspe_jax.dataset.loading.stored import StoredScenario, decode
from inspe_jax.jobs.locks import lock_folder
from inspe_jax.jobs.settings import Strict

CACHE = "cache.json"
FORMAT = "inspe_jax cache 3"
LOCK = f".{CACHE}.lock"

PICTURES = (300, 400)
"""Height and width of pictures: a cyclist has about 50 pixels; a dozen at half is too few."""

Job = tuple[Scenario, Path, str, tuple[int, int] | None]
"""The arguments of :func:`~inspe_jax.dataset.loading.stored.decode`."""


class _Record(Strict):
    format: str
    pictures: list[int] | None


@dataclass(frozen=True)
class Cache:
    """A decoded data set. ``pictures`` is their size (height, width), None without pictures."""

    path: Path
    pictures: tuple[int, int] | None
    scenarios: tuple[StoredScenario, ...]

    @property
    def splits(self) -> dict[str, tuple[StoredScenario, ...]]:
        """The scenarios of each split."""
        names = dict.fromkeys(scenario.split for scenario in self.scenarios)
        return {name: tuple(s for s in self.scenarios if s.split == name) for name in names}

    @property
    def size(self) -> int:
        """Bytes of all arrays."""
        return sum(sum(scenario.record.files.values()) for scenario in self.scenarios)

    def split(self, name: str) -> tuple[StoredScenario, ...]:
        """The scenarios of a split. Raises InspeError, which lists the splits, for another name."""
        check_known(name, self.splits, f"{self.path}: split")
        return self.splits[name]


def cache(
    dataset: Dataset | str | os.PathLike[str],
    folder: str | os.PathLike[str],
    *,
    pictures: tuple[int, int] | None = PICTURES,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Cache:
    """Decode a data set into ``folder``, as far as it is not there yet, also after a kill.

    A scenario appears when it is complete. Scripts that call this need the usual ``if __name__ ==
    "__main__":``, because workers are processes.

    Args:
        dataset: A data set, or its folder.
        folder: Where the cache is.
        pictures: Size (height, width) [px] that they get; None leaves them out.
        workers: Processes that share the scenarios, one per core if None; with 1, this one.
        progress: Called with (frames done, all frames).

    Raises:
        InspeError: The folder holds anything else, such as the cache of another state of the set or
            with pictures of another size; another run uses it; or a file of the set is broken. What
            was decoded until then stays.
    """
    data = dataset if isinstance(dataset, Dataset) else open_dataset(dataset)
    if pictures is not None and not all(isinstance(n, int) and n >= 1 for n in pictures):
        raise InspeError(f"pictures {pictures}: (height, width), whole numbers of 1 or more")
    if workers is not None and workers < 1:
        raise InspeError(f"workers {workers}: 1 or more")
    total = sum(len(scenario.frames) for scenario in data.scenarios)
    if not total:
        raise InspeError(f"{data.path}: no scenario has a frame")
    path = prepare_folder(folder).resolve()
    with lock_folder(path, LOCK):
        _claim(path, pictures)
        there = {(each.split, each.name): each for each in _stored(path)}
        todo, done = list[Job](), 0
        each = ((split, one) for split, scenarios in data.splits.items() for one in scenarios)
        for split, scenario in each:
            if not scenario.frames:
                continue
            source = storage.digest_of_scenario(scenario)
            stored = there.get((split, scenario.name))
            if stored is None:
                todo.append((scenario, path / split / scenario.name, source, pictures))
            elif stored.record.source != source:
                raise InspeError(
                    f"{stored.path}: was not decoded from {scenario.path} as it is now: name "
                    f"another folder, or delete this scenario to decode it again"
                )
            else:
                done += stored.record.frames
        for frames in chain([0], _decode_all(todo, cores() if workers is None else workers)):
            done += frames
            if progress:
                progress(done, total)
    return open_cache(path)


def open_cache(folder: str | os.PathLike[str]) -> Cache:
    """Open a cache that :func:`cache` made. Raises InspeError if it is none, or is damaged."""
    path = Path(folder).resolve()
    if not (path / CACHE).is_file():
        raise InspeError(f"{folder}: not a cache: make one with inspe dataset cache")
    pictures = pictures_of(path)
    scenarios = tuple(_stored(path))
    if not scenarios:
        raise InspeError(f"{folder}: the cache has no scenario yet: cache the set again")
    return Cache(path, pictures, scenarios)


def pictures_of(folder: str | os.PathLike[str]) -> tuple[int, int] | None:
    """The size (height, width) of the pictures of a cache, which may have no scenario yet."""
    path = Path(folder) / CACHE
    record = check_model(_Record, read_json(path), str(path))
    if record.format != FORMAT:
        raise InspeError(
            f"{path}: format '{record.format}', not '{FORMAT}': it was made by another version: "
            f"name another folder"
        )
    return None if record.pictures is None else (record.pictures[0], record.pictures[1])


def _decode_all(todo: list[Job], workers: int) -> Iterator[int]:
    workers = min(workers, len(todo))
    if workers <= 1:
        yield from (decode(*job) for job in todo)
        return
    # Not forked: a process with threads, such as JAX's, may lock up after a fork.
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"))
    try:
        for each in as_completed([pool.submit(decode, *job) for job in todo]):
            yield each.result()
    finally:
        pool.shutdown(cancel_futures=True)


def _claim(path: Path, pictures: tuple[int, int] | None) -> None:
    """Make the folder a cache, unless it is one already."""
    if not (path / CACHE).exists():
        others = sorted(child.name for child in path.iterdir() if child.name != LOCK)
        if others:
            raise InspeError(
                f"{path}: has other files, such as {others[0]}, and is no cache: name an empty or "
                f"a new folder"
            )
        write_text(path / CACHE, json.dumps({"format": FORMAT, "pictures": pictures}) + "\n")
        return
    size = pictures_of(path)
    if size != (None if pictures is None else tuple(pictures)):
        has = "no pictures" if size is None else f"pictures of {list(size)}"
        raise InspeError(
            f"{path}: this cache has {has}, not {pictures}: name another folder for another size"
        )


def _stored(path: Path) -> Iterator[StoredScenario]:
    for split in split_folders(path):
        for place in subfolders(split):
            if not (place.name.startswith(".") and place.name.endswith(storage.PART)):
                if not (place / storage.RECORD).is_file():
                    raise InspeError(f"{place}: is no part of a cache: move it away")
                yield StoredScenario(place, split.name)
