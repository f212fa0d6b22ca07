"""A data set, made by worker processes on this machine."""

import os
import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from inspe_jax.core.errors import InspeError
from inspe_jax.dataset.chunk import FULL, SIZE, Chunk, Outcome, build, close, work
from inspe_jax.dataset.plan import Generation, ScenarioPlan
from inspe_jax.dataset.writer import DatasetWriter
from inspe_jax.simulation.backends import check_backend, server_of
from inspe_jax.simulation.recorder import Server
from inspe_jax.study.engine import load_cluster, run_jobs
from inspe_jax.study.work import message_of

MB = 1e6
MOST_WORKERS = {"carla": 1}
"""By how many workers a backend can record, where that is limited: a CARLA server has one world."""
GO_ON = "make room, and the same command goes on from here"


@dataclass(frozen=True)
class GenerationResult:
    """What a run came to.

    ``scenarios`` and ``frames`` that are there now, and the ``size`` of all files [bytes];
    ``recorded`` frames of this run and the ``seconds`` it took; ``failures``, what is wrong with
    each scenario that could not be made, by name; ``notes``, what of each scenario could not be
    recorded as asked, of those recorded in this run.
    """

    folder: Path
    scenarios: int
    frames: int
    size: int
    recorded: int
    seconds: float
    failures: dict[str, str]
    notes: dict[str, tuple[str, ...]]


def generate(
    generation: Generation,
    folder: str | os.PathLike[str],
    backend: str | None = None,
    *,
    workers: int | None = None,
    server: Server | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> GenerationResult:
    """Make every scenario of a data set that ``folder`` does not have yet.

    As ``folder/SPLIT/SCENARIO``, each of which appears when it is whole. ``backend`` records:
    ``embedded`` or ``carla``; that of the generation, if not given. The work is shared out, a few
    frames at a time, among ``workers`` processes, one a core if not given; with ``carla`` one,
    which records at ``server``, CARLA's usual address if not given. A run that is killed is taken
    up again by calling it again, to the same bytes. A scenario that cannot be made is told in
    ``failures``, while the others are. ``progress`` is called with (frames done, frames).

    Scripts that call this need the usual ``if __name__ == "__main__":``, as workers are processes
    of their own. Raises InspeError where Dask is missing, no server answers, the disk is full or
    cannot be written to, or the folder has anything else in it; what is there is valid, and can
    be gone on from.
    """
    began = time.monotonic()
    backend = generation.backend if backend is None else backend
    workers = _checked(backend, workers)
    server = server_of(backend, server)
    try:
        with DatasetWriter(generation, folder, backend) as making:
            had = making.frames
            failures, notes = _record(making, generation, backend, workers, server, progress)
            if not failures:
                making.clear()
            placed = [plan.frames for plan in generation.scenarios if making.place(plan).exists()]
            return GenerationResult(
                folder=making.folder,
                scenarios=len(placed),
                frames=sum(placed),
                size=making.size,
                recorded=making.frames - had,
                seconds=time.monotonic() - began,
                failures=failures,
                notes=notes,
            )
    except OSError as e:
        if e.errno not in FULL:
            raise
        raise InspeError(f"{folder}: the disk is full; {GO_ON}") from e


def _checked(backend: str, workers: int | None) -> int | None:
    """How many workers there are to be. Raises InspeError where there cannot be so many."""
    check_backend(backend)
    most = MOST_WORKERS.get(backend)
    if workers is not None and (workers < 1 or (most is not None and workers > most)):
        allowed = "1 or more" if most is None else f"{most} with backend {backend}"
        raise InspeError(f"workers {workers}: {allowed}")
    return most if workers is None else workers


def _record(
    making: DatasetWriter,
    generation: Generation,
    backend: str,
    workers: int | None,
    server: Server | None,
    progress: Callable[[int, int], None] | None,
) -> tuple[dict[str, str], dict[str, tuple[str, ...]]]:
    """Do what is left to do; gives what is wrong with each scenario that cannot be made, and the
    notes of those that are."""
    chunks = {plan.name: _chunks(making, plan, backend, server) for plan in generation.scenarios}
    left = {name: len(own) for name, own in chunks.items()}
    recorded, failures, notes = making.frames, dict[str, str](), dict[str, tuple[str, ...]]()

    def tell() -> None:
        if progress:
            progress(recorded, generation.frames)

    def settle(plan: ScenarioPlan) -> None:
        if not left[plan.name] and plan.name not in failures and not making.finish(plan):
            failures[plan.name] = "some of its files are gone again; give the same command again"

    tell()
    for plan in generation.scenarios:
        if not making.place(plan).exists():
            settle(plan)
    todo = [chunk for own in chunks.values() for chunk in own]
    if not todo:
        return failures, notes
    if server is not None:
        server.reach()  # or every scenario would fail by itself
    with load_cluster().client(None, workers) as client:
        try:
            for chunk, found in run_jobs(client, todo, build, work, ahead=1):
                plan = chunk.plan
                outcome = Outcome(message_of(found)) if isinstance(found, Exception) else found
                if outcome.fault:
                    raise InspeError(_room(making, generation) if outcome.full else outcome.fault)
                left[plan.name] -= 1
                if outcome.error:
                    failures.setdefault(plan.name, outcome.error)
                else:
                    recorded += chunk.left
                    if outcome.notes:
                        notes[plan.name] = outcome.notes
                settle(plan)
                tell()
        finally:
            with suppress(Exception):
                client.run(close, on_error="ignore")
    made = [plan.name for plan in generation.scenarios if plan.name not in failures]
    return failures, {name: notes[name] for name in made if name in notes}


def _chunks(
    making: DatasetWriter, plan: ScenarioPlan, backend: str, server: Server | None
) -> list[Chunk]:
    """Chunks of a scenario with a frame that is not there."""
    found = []
    for first in range(0, plan.frames, SIZE):
        last = min(first + SIZE, plan.frames) - 1
        left = len(set(range(first, last + 1)) - making.there[plan.name])
        if left:
            files = making.unfinished(plan), making.lock(plan, first)
            found.append(Chunk(plan, backend, *files, first, last, left, server))
    return found


def _room(making: DatasetWriter, generation: Generation) -> str:
    """That the disk is full, and how much more the set will need."""
    there = making.take_stock(generation)
    told = f"{making.folder}: the disk is full: {there} of {generation.frames} frames are there"
    if there:
        needed = making.size / there * (generation.frames - there)
        free = shutil.disk_usage(making.folder).free
        told += f", about {needed / MB:.1f} MB more are needed, and {free / MB:.1f} MB are free"
    return f"{told}; {GO_ON}"
