"""The folder of a training: its record, what each step told, and its last two states; and the cache
of the data set that a command names.

``run.json`` says what is trained on what. ``losses.csv`` has a row for each step, and
``validation.csv`` one for each time that mAP was measured. ``step_00000250.eqx`` is the state after
250 steps: the detector and the optimiser's moments, as Equinox writes them.
"""

import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import equinox as eqx
import jax
from pydantic import BaseModel

from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import (
    STRICT,
    check_model,
    csv_line,
    named,
    prepare_folder,
    read_csv,
    read_json,
    whole_file,
    write_text,
)
from inspe_jax.dataset.loading import Cache, cache, open_cache
from inspe_jax.dataset.loading.caching import CACHE, pictures_of
from inspe_jax.jobs.locks import lock_folder
from inspe_jax.perception.detector import Detector, model_of
from inspe_jax.perception.training.settings import Content, optimiser

RECORD, LOSSES, VALIDATION, LOCK = "run.json", "losses.csv", "validation.csv", ".run.lock"
TEACHER_RUN = "teacher"
"""The folder in a run of a model that is taught: that of its teacher's training."""
KEPT = 2  # states that are kept: the last, and the one before it in case the last is damaged

State = tuple[Detector, Any]  # the detector, and the moments of the optimiser


class _Record(BaseModel):
    model_config = STRICT

    format: Literal["inspe_jax run 2"] = "inspe_jax run 2"
    content: Content


@dataclass(frozen=True)
class TrainingRun:
    """A training, begun or done."""

    path: Path
    content: Content

    @property
    def states(self) -> list[tuple[int, Path]]:
        """The steps after which there are states, and their files, earliest first."""
        found = sorted(self.path.glob(f"step_{'[0-9]' * 8}.eqx"))
        return [(int(path.stem.removeprefix("step_")), path) for path in found]

    @property
    def steps(self) -> int:
        """Steps done, as of the last state."""
        return self.states[-1][0] if self.states else 0

    def rows(self, name: str) -> list[dict[str, float]]:
        """The rows of :data:`LOSSES` or of :data:`VALIDATION`."""
        path = self.path / name
        rows = read_csv(path) if path.is_file() else []
        try:
            return [{key: float(value) for key, value in row.items()} for row in rows]
        except ValueError as e:
            raise InspeError(f"{path}: not a table of numbers: {e}") from e

    def write(self, name: str, row: Mapping[str, float]) -> None:
        """Append a row; numbers are written so that they read back the same."""
        path = self.path / name
        with named(path), path.open("a", newline="", encoding="utf-8") as file:
            if not file.tell():
                file.write(csv_line(row))
            file.write(csv_line(row.values()))

    def forget(self, after: int) -> None:
        """Drop the rows of steps after ``after``: they are told again, and come out the same."""
        for name in (LOSSES, VALIDATION):
            path = self.path / name
            lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
            kept = [line for line in lines[1:] if _step(line) <= after]
            if kept:
                write_text(path, "\n".join([lines[0], *kept]) + "\n")
            else:  # a kill may have left a file without its head
                path.unlink(missing_ok=True)

    def keep(self, step: int, state: State) -> None:
        """Write the state after ``step`` steps, whole or not at all; older ones go."""
        with whole_file(self.path / f"step_{step:08}.eqx") as file:
            eqx.tree_serialise_leaves(file, state)
        for _, path in self.states[:-KEPT]:
            path.unlink()

    def restore(self) -> tuple[int, State]:
        """The last state and its step; that before the first step if there is none.

        Raises InspeError if its file is damaged.
        """
        if not self.states:
            # Compiled as one: dispatched one by one, each shape of weights would be compiled.
            return 0, eqx.filter_jit(self._first)()
        like = eqx.filter_eval_shape(self._first)
        step, path = self.states[-1]
        try:
            with path.open("rb") as file:
                found: State = eqx.tree_deserialise_leaves(file, like)
                if file.read(1):
                    raise ValueError("more bytes than the state has")
        except Exception as e:
            before = f"from step {self.states[-2][0]}" if len(self.states) > 1 else "from the start"
            raise InspeError(
                f"{path}: is damaged, or of another model: delete it, and training goes on {before}"
            ) from e
        return step, found

    def _first(self) -> State:
        """The state that training begins with."""
        settings, agents, grid = self.content.settings, self.content.agents, self.content.grid
        detector = Detector(model_of(settings.model), agents, grid, jax.random.key(settings.seed))
        weights = eqx.filter(detector, eqx.is_inexact_array)
        return detector, optimiser(settings.steps, settings.rate).init(weights)

    def last(self) -> tuple[int, Detector]:
        """The step of the last state and its detector. Raises InspeError if there is none, or it is
        damaged."""
        if not self.states:
            raise InspeError(f"{self.path}: has no state yet: train it first")
        step, (detector, _) = self.restore()
        return step, detector


@contextmanager
def begun(folder: str | os.PathLike[str], content: Content) -> Iterator[TrainingRun]:
    """A run in ``folder``, new or begun before with the same content, while it is trained.

    Meanwhile nobody else begins or trains it. What a kill left unfinished goes. Raises InspeError
    if another process trains it, or if the folder has another run, saying what is different, or
    other files.
    """
    path = prepare_folder(folder).resolve()
    if not (path / RECORD).is_file():
        _check_no_others(path)  # before a lock is written there
    lock = lock_folder(path, LOCK)
    try:
        for part in path.glob(".*.part"):
            part.unlink()
        yield _recorded(path, content)
    finally:
        lock.release()


def _recorded(path: Path, content: Content) -> TrainingRun:
    """The run of a folder, whose record is written if it has none."""
    if (path / RECORD).is_file():
        run = open_run(path)
        if run.content == content:
            return run
        here, there = (each.model_dump() for each in (run.content, content))
        had, given = ({**each, **each["settings"]} for each in (here, there))
        key = next(key for key in given if key != "settings" and had[key] != given[key])
        what = f"{key} {had[key]}, not {given[key]}"
        raise InspeError(
            f"{path}: this run has {'other scenarios' if key == 'scenarios' else what}: name "
            f"another folder, or give the same again to go on"
        )
    write_text(path / RECORD, json.dumps(_Record(content=content).model_dump(), indent=2) + "\n")
    return TrainingRun(path, content)


def _check_no_others(path: Path) -> None:
    """Raise InspeError if a folder has more than a teacher, and what a kill left."""
    others = sorted(
        child.name
        for child in path.iterdir()
        if child.name not in (LOCK, TEACHER_RUN) and child.suffix != ".part"
    )
    if others:
        raise InspeError(f"{path}: has other files, such as {others[0]}: name an empty folder")


def open_run(folder: str | os.PathLike[str]) -> TrainingRun:
    """The run in a folder. Raises InspeError if there is none, or its record is damaged or of
    another version."""
    path = Path(folder).resolve()
    if not (path / RECORD).is_file():
        raise InspeError(f"{folder}: not a training run: make one with inspe train")
    return TrainingRun(
        path, check_model(_Record, read_json(path / RECORD), str(path / RECORD)).content
    )


def _step(line: str) -> float:
    """The step of a row; beyond all of them if a kill cut the row short."""
    first, more, _ = line.partition(",")
    return int(first) if more and first.isdigit() else float("inf")


# ── The data set ────────────────────────────────────────────────────────────


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


def check_pictures(run: TrainingRun, found: Cache) -> None:
    """Raise InspeError if a run's detector takes pictures, and a cache has others or none."""
    size = None if found.pictures is None else list(found.pictures)
    if "camera" in model_of(run.content.settings.model).sensors and size != run.content.pictures:
        height, width = run.content.pictures or (0, 0)
        raise InspeError(
            f"{found.path}: has {pictures_in_words(found)}, but {run.path} was trained on "
            f"{width}x{height}: cache the set into another folder with --pictures {width}x{height}"
        )
