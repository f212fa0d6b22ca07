"""What a training depends on, and its folder: ``run.json``, ``losses.csv``, ``validation.csv``, and
the last two states (detector and moments of the optimiser), as ``step_00000250.eqx``."""

import functools
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import equinox as eqx
import jax
import numpy as np
import optax
from pydantic import Field

from inspe_jax.core import files
from inspe_jax.core.errors import InspeError, error_at
from inspe_jax.core.files import check_model, prepare_folder, read_json, write_text
from inspe_jax.dataset.loading import Augment, Cache
from inspe_jax.jobs.locks import lock_folder
from inspe_jax.jobs.settings import Count, Length, Strict
from inspe_jax.perception.detector import Detector, model_of
from inspe_jax.perception.inputs import Agents, BevGrid

RECORD, LOSSES, VALIDATION, LOCK = "run.json", "losses.csv", "validation.csv", ".run.lock"
TEACHER_RUN = "teacher"
"""The folder in a run of a model that is taught: that of its teacher's training."""
KEPT = 2  # states that are kept: the last, and the one before it in case the last is damaged

Positive = Annotated[int, Field(ge=1)]
State = tuple[Detector, Any]  # the detector, and the moments of the optimiser

AUGMENT = Augment(flip=0.5, turn=np.pi, scale=(0.95, 1.05))
"""Intersections have arms in any direction, so they are turned by any angle."""

Optimiser: TypeAlias = optax.GradientTransformation

RISE = 0.3  # share of the steps in which the learning rate rises; as in OneCycle's usual setting
FEWEST = 4
"""Steps of the shortest schedule: of fewer, three tenths are none, and a rise has no length."""
DECAY = 0.01  # AdamW's weight decay (Loshchilov and Hutter 2019)
MOST_GRADIENT = 10.0
"""Norm to which gradients are cut. A first step has 30 to 100; later ones are below it."""


class TrainingSettings(Strict):
    """How a detector is trained: ``steps`` of ``batch`` frames at the highest learning ``rate`` of
    AdamW, which rises for three tenths of the steps and falls for the rest (Smith and Topin 2019).
    After every ``every`` steps the state is kept, and mAP measured on ``validate_frames`` frames of
    the split ``validate``. ``targets``: road users that no sensor of the detector sees have no loss
    ("seen"), or all are to be found. The defaults take two cores an hour."""

    model: str
    steps: Positive = 1500
    batch: Positive = 2
    rate: Length = 2e-3
    seed: Count = 0
    every: Positive = 250
    validate_frames: Count = 60
    augment: bool = True
    targets: Literal["seen", "all"] = "seen"


class Content(Strict):
    """What a run depends on: its settings, and what of the data set decides shapes and samples."""

    settings: TrainingSettings
    frames: dict[str, int]
    scenarios: str
    pictures: list[int] | None
    lidars: int
    cameras: int
    half: float
    cell: float
    low: float
    high: float

    @property
    def agents(self) -> Agents:
        """The agents that the detector is made for."""
        return Agents(self.lidars, self.cameras)

    @property
    def grid(self) -> BevGrid:
        """The cells that the detector is made for."""
        return BevGrid(half=self.half, cell=self.cell, low=self.low, high=self.high)


@functools.cache  # equal ones are the same, so that a step is compiled once for all of them
def optimiser(steps: int, rate: float) -> Optimiser:
    """AdamW on cut gradients; its rate rises and falls once in ``steps`` (Smith and Topin 2019)."""
    rates = optax.cosine_onecycle_schedule(max(steps, FEWEST), rate, RISE)
    cut = optax.clip_by_global_norm(MOST_GRADIENT)
    return optax.chain(cut, optax.adamw(rates, weight_decay=DECAY))


class _Record(Strict):
    format: Literal["inspe_jax run 3"] = "inspe_jax run 3"
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
        rows = files.read_csv(path) if path.is_file() else []
        with error_at(f"{path}: not a table of numbers", ValueError):
            return [{key: float(value) for key, value in row.items()} for row in rows]

    def write(self, name: str, row: Mapping[str, float]) -> None:
        """Append a row; numbers are written so that they read back the same."""
        path = self.path / name
        with files.named(path), path.open("a", newline="", encoding="utf-8") as file:
            if not file.tell():
                file.write(files.csv_line(row))
            file.write(files.csv_line(row.values()))

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
        with files.whole_file(self.path / f"step_{step:08}.eqx") as file:
            eqx.tree_serialise_leaves(file, state)
        for _, path in self.states[:-KEPT]:
            path.unlink()

    def restore(self) -> tuple[int, State]:
        """The last state and its step, or the first one. Raises InspeError if it is damaged."""
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
        settings, agents, grid = self.content.settings, self.content.agents, self.content.grid
        detector = Detector(model_of(settings.model), agents, grid, jax.random.key(settings.seed))
        weights = eqx.filter(detector, eqx.is_inexact_array)
        return detector, optimiser(settings.steps, settings.rate).init(weights)

    def last(self) -> tuple[int, Detector]:
        """Step and detector of the last state. Raises InspeError if it is damaged or not there."""
        if not self.states:
            raise InspeError(f"{self.path}: has no state yet: train it first")
        step, (detector, _) = self.restore()
        return step, detector


@contextmanager
def begun(folder: str | os.PathLike[str], content: Content) -> Iterator[TrainingRun]:
    """A run in ``folder``, new or begun with the same content, locked while it is trained. Raises
    InspeError if another process trains it, or the folder has another run or other files."""
    path = prepare_folder(folder).resolve()
    if not (path / RECORD).is_file():  # a new one, but for a teacher, and what a kill left
        names = (child.name for child in path.iterdir() if child.suffix != ".part")
        if others := sorted({*names} - {LOCK, TEACHER_RUN}):
            raise InspeError(f"{path}: has other files, such as {others[0]}: name an empty folder")
    with lock_folder(path, LOCK):
        for part in path.glob(".*.part"):
            part.unlink()
        if not (path / RECORD).is_file():
            record = _Record(content=content).model_dump()
            write_text(path / RECORD, json.dumps(record, indent=2) + "\n")
        run = open_run(path)
        if run.content != content:
            here, there = (each.model_dump() for each in (run.content, content))
            had, given = ({**each, **each["settings"]} for each in (here, there))
            key = next(key for key in given if key != "settings" and had[key] != given[key])
            what = f"{key} {had[key]}, not {given[key]}"
            raise InspeError(
                f"{path}: this run has {'other scenarios' if key == 'scenarios' else what}: name "
                f"another folder, or give the same again to go on"
            )
        yield run


def open_run(folder: str | os.PathLike[str]) -> TrainingRun:
    """The run in a folder. Raises InspeError if it is missing, damaged or of another version."""
    path = Path(folder).resolve()
    if not (path / RECORD).is_file():
        raise InspeError(f"{folder}: not a training run: make one with inspe train")
    record = check_model(_Record, read_json(path / RECORD), str(path / RECORD))
    return TrainingRun(path, record.content)


def _step(line: str) -> float:
    """The step of a row; beyond all of them if a kill cut the row short."""
    first, more, _ = line.partition(",")
    return int(first) if more and first.isdigit() else float("inf")


def agents_of(cache: Cache) -> Agents:
    """The most units with LiDARs, and with cameras, that a scenario of a cache has."""
    lidars = max(each.record.lidar_units for each in cache.scenarios)
    each_units = (each.index["camera_unit"] for each in cache.scenarios)
    cameras = max(len(np.unique(units[units > 0])) for units in each_units)
    return Agents(lidars, cameras if cache.pictures else 0)


def check_sensors(name: str, cache: Cache) -> None:
    """Raise InspeError if a model needs sensors that a cache has no data of."""
    model, agents = model_of(name), agents_of(cache)
    if "lidar" in model.sensors and not agents.lidars:
        raise InspeError(f"{cache.path}: {name} needs LiDARs, and no scenario has one")
    if "camera" in model.sensors and not agents.cameras:
        why = "no scenario has a camera"
        if not cache.pictures:
            why = "the cache was made without pictures: cache the set again, with pictures"
        raise InspeError(f"{cache.path}: {name} needs pictures, and {why}")


def check_pictures(run: TrainingRun, found: Cache) -> None:
    """Raise InspeError if a run's detector takes pictures, and a cache has others or none."""
    size = None if found.pictures is None else list(found.pictures)
    if "camera" in model_of(run.content.settings.model).sensors and size != run.content.pictures:
        height, width = run.content.pictures or (0, 0)
        has = f"pictures of {size[1]}x{size[0]}" if size else "no pictures"
        raise InspeError(
            f"{found.path}: has {has}, but {run.path} was trained on "
            f"{width}x{height}: cache the set into another folder with --pictures {width}x{height}"
        )
