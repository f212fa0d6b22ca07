"""Generates a data set with worker processes on this machine."""

import errno
import os
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from inspe_jax.core.errors import InspeError
from inspe_jax.dataset.chunk import Chunk, Outcome, build, close, work
from inspe_jax.dataset.manifest import Fault
from inspe_jax.dataset.plan import Generation, ScenarioPlan
from inspe_jax.dataset.writer import DatasetWriter
from inspe_jax.jobs.engine import load_cluster, run_jobs
from inspe_jax.jobs.sources import message_of
from inspe_jax.simulation.backends import BACKENDS, check_backend, server_of
from inspe_jax.simulation.recorder import Server

CONTINUE = "give the same command again to resume"


@dataclass(frozen=True)
class GenerationResult:
    """The result of a run.

    ``scenarios`` and ``frames`` are the numbers of those that are complete now; ``size`` is that of
    all files [bytes]. ``recorded`` is the number of frames of this run, and ``seconds`` the time
    that it took. By the name of the scenario, ``failures`` says why it could not be generated,
    ``notes`` what was not recorded in this run as its layout has it, and ``repaired`` what was
    wrong with its files, if it was complete before.
    """

    folder: Path
    scenarios: int
    frames: int
    size: int
    recorded: int
    seconds: float
    failures: dict[str, str]
    notes: dict[str, tuple[str, ...]]
    repaired: dict[str, list[Fault]]


def generate(
    generation: Generation,
    folder: str | os.PathLike[str],
    backend: str | None = None,
    *,
    workers: int | None = None,
    server: Server | None = None,
    deep: bool = True,
    progress: Callable[[int, int], None] | None = None,
    checking: Callable[[int, int], None] | None = None,
) -> GenerationResult:
    """Generate the scenarios of a data set that ``folder`` does not have yet.

    A scenario appears as ``folder/SPLIT/SCENARIO`` when it is complete. ``backend`` is one of
    :data:`~inspe_jax.simulation.backends.BACKENDS`, that of the generation if not given. The work
    is divided among ``workers`` processes, a few frames at a time: one per core if not given, or
    as many as the backend allows. ``server`` is the address of the server if the backend needs one,
    the usual one if not given. ``progress`` is called with (frames done, all frames).

    After a run was killed, call this again: it continues, and gives the same bytes. Scenarios that
    are there are compared with their manifests, by digests if ``deep``, otherwise by the sizes of
    files, and those that are damaged are recorded again; ``checking`` is called with (scenarios
    compared, all). If a scenario cannot be generated, its error is in the result's ``failures``,
    and the others are generated.

    Scripts that call this need the usual ``if __name__ == "__main__":``, because workers are
    processes. Raises InspeError if Dask is missing, no server answers, the disk is full or cannot
    be written to, or the folder contains something else. The files written until then are valid.
    """
    began = time.monotonic()
    backend = generation.backend if backend is None else backend
    workers = _checked(backend, workers)
    server = server_of(backend, server)
    try:
        with DatasetWriter(generation, folder, backend, deep, checking) as writer:
            had = writer.frames
            failures, notes = _record(writer, generation, backend, workers, server, progress)
            if not failures:
                writer.clear()
            placed = [plan.frames for plan in generation.scenarios if writer.place(plan).exists()]
            return GenerationResult(
                folder=writer.folder,
                scenarios=len(placed),
                frames=sum(placed),
                size=writer.size,
                recorded=writer.frames - had,
                seconds=time.monotonic() - began,
                failures=failures,
                notes=notes,
                repaired=writer.damage,
            )
    except OSError as e:
        if e.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise InspeError(f"{folder}: the disk is full; {CONTINUE}") from e


def _checked(backend: str, workers: int | None) -> int | None:
    """The number of workers to use. Raises InspeError if ``workers`` is not allowed."""
    check_backend(backend)
    most = BACKENDS[backend].most_workers
    if workers is not None and (workers < 1 or (most is not None and workers > most)):
        allowed = "1 or more" if most is None else f"{most} with backend {backend}"
        raise InspeError(f"workers {workers}: {allowed}")
    return most if workers is None else workers


def _record(
    writer: DatasetWriter,
    generation: Generation,
    backend: str,
    workers: int | None,
    server: Server | None,
    progress: Callable[[int, int], None] | None,
) -> tuple[dict[str, str], dict[str, tuple[str, ...]]]:
    """Record what is missing. Gives the failures and the notes, see :class:`GenerationResult`."""
    chunks = {plan.name: _chunks(writer, plan, backend, server) for plan in generation.scenarios}
    unsettled = {name: len(own) for name, own in chunks.items()}
    recorded, failures, notes = writer.frames, dict[str, str](), dict[str, tuple[str, ...]]()

    def report() -> None:
        if progress:
            progress(recorded, generation.frames)

    def settle(plan: ScenarioPlan) -> None:
        if not unsettled[plan.name] and plan.name not in failures and not writer.finish(plan):
            failures[plan.name] = "some of its files were deleted; give the same command again"

    report()
    for plan in generation.scenarios:
        if not writer.place(plan).exists():
            settle(plan)
    todo = [chunk for own in chunks.values() for chunk in own]
    if not todo:
        return failures, notes
    if server is not None:
        server.reach()  # else every scenario would fail on its own
    with load_cluster().client(None, workers) as client:
        try:
            for chunk, found in run_jobs(client, todo, build, work, ahead=1):
                plan = chunk.plan
                outcome = Outcome(message_of(found)) if isinstance(found, Exception) else found
                if outcome.fault:
                    raise InspeError(f"{outcome.fault}; {CONTINUE}")
                unsettled[plan.name] -= 1
                if outcome.error:
                    failures.setdefault(plan.name, outcome.error)
                else:
                    recorded += chunk.missing
                    if outcome.notes:
                        notes[plan.name] = outcome.notes
                settle(plan)
                report()
        finally:
            with suppress(Exception):
                client.run(close, on_error="ignore")
    names = [plan.name for plan in generation.scenarios if plan.name not in failures]
    return failures, {name: notes[name] for name in names if name in notes}


def _chunks(
    writer: DatasetWriter, plan: ScenarioPlan, backend: str, server: Server | None
) -> list[Chunk]:
    """The chunks of a scenario that have missing frames."""
    folder, format = writer.unfinished(plan), writer.format_name
    return [
        Chunk(plan, backend, folder, writer.lock(plan, part.start), part, missing, server, format)
        for part in plan.chunks
        if (missing := len({*part} - writer.there[plan.name]))
    ]
