"""Schedules jobs on Dask workers, each a future of its own at a worker that holds its scene: a
killed run loses what was running, and a job that kills its worker takes no other with it."""

from collections import deque
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby, zip_longest
from typing import Any, Protocol, TypeVar
from uuid import uuid4

from inspe_jax.core.errors import InspeError, needs


class Schedulable(Protocol):
    """A job that can be scheduled. Jobs of one scene must follow each other in their list."""

    @property
    def key(self) -> str:
        """A short text that identifies the job."""

    @property
    def scene(self) -> str:
        """A short text that identifies its scene."""

    @property
    def source(self) -> Hashable:
        """The place of the scene; scenes of one place need the same compiled programs."""


J = TypeVar("J", bound=Schedulable)


def check_workers(scheduler: str | None, workers: int | None) -> None:
    """Raise InspeError unless workers are given by number, by a scheduler's address, or not."""
    if workers is not None and (workers < 1 or scheduler is not None):
        raise InspeError(
            f"workers {workers}: give 1 or more; with a scheduler give none, since it has its own"
        )


def load_cluster() -> Any:
    """Import and return :mod:`inspe_jax.jobs.cluster`. Raises InspeError if Dask is missing."""
    with needs("this needs Dask", "sweep"):
        from inspe_jax.jobs import cluster
    return cluster


class Messages:
    """What jobs send to the ``topic``: ``heard`` gets each message, in a thread of the client."""

    def __init__(self, client: Any, heard: Callable[[Any], None]) -> None:
        self.topic = f"inspe-{uuid4().hex[:8]}"
        client.subscribe_topic(self.topic, lambda event: heard(event[1]))

    @staticmethod
    def send(topic: str, message: Any) -> None:
        """Send from a job; a message is of numbers, texts and lists."""
        from distributed import get_worker

        get_worker().log_event(topic, message)


def run_jobs(
    client: Any,
    jobs: Sequence[J],
    build: Callable[[J], Any],
    work: Callable[..., Any],
    *given: Any,
    ahead: int = 3,
) -> Iterator[tuple[J, Any]]:
    """Run all jobs; yields each with its result or with its exception, as they finish.

    A result is ``work(scene, job, *given)``, with the ``scene`` that ``build`` makes of its first
    job. ``ahead`` jobs wait at each thread of a worker; with 1, workers get jobs in order. What a
    dying worker held runs once more at the end, one at a time. Raises InspeError without a
    scheduler.
    """
    from distributed import KilledWorker

    doubtful: list[J] = []
    at_once = ahead * sum(client.nthreads().values())
    for job, found in _run_jobs(client, jobs, at_once, build, work, given):
        if isinstance(found, KilledWorker):
            doubtful.append(job)
        else:
            yield job, found
    yield from _run_jobs(client, doubtful, 1, build, work, given)


def _by_scene(jobs: Sequence[J]) -> list[list[J]]:
    """The jobs of each scene: first one scene of every place, then a second one of each, …"""
    # Side by side, every worker would compile the programs of a place; one after the other, the
    # first compiles them and the rest read them from the cache.
    turns: dict[Hashable, list[list[J]]] = {}
    for _, group in groupby(jobs, key=lambda job: job.scene):
        own = list(group)
        turns.setdefault(own[0].source, []).append(own)
    each = zip_longest(*turns.values())
    return [group for turn in each for group in turn if group is not None]


@dataclass(eq=False)
class _OpenScene:
    """A scene whose jobs are being run: those left, and the number that is at workers now."""

    scene: Any
    jobs: deque[Any]
    running: int = 0


def _run_jobs(
    client: Any,
    jobs: Sequence[J],
    ahead: int,
    build: Callable[[J], Any],
    work: Callable[..., Any],
    given: Sequence[Any] = (),
) -> Iterator[tuple[J, Any]]:
    """Run jobs, ``ahead`` of them at workers at a time, of as many scenes as there are workers.
    Dask sends jobs to the worker that holds their scene; one of the same scene follows each."""
    from distributed import CancelledError, as_completed

    run = uuid4().hex[:8]  # others may use the same scheduler, so keys must differ
    groups = deque(map(deque, _by_scene(jobs)))
    opened: list[_OpenScene] = []
    # Each job's scene is kept until its result is here: if a worker dies with the result, Dask
    # needs the scene to compute it again.
    sent: dict[str, tuple[J, _OpenScene]] = {}
    futures = as_completed(loop=client.loop)

    def next_scene(last: _OpenScene | None) -> _OpenScene | None:
        """The same scene while it has jobs; then a new one; then the one with most jobs left."""
        if last is not None and last.jobs:
            return last
        if groups and (last is not None or len(opened) < max(len(client.nthreads()), 1)):
            group = groups.popleft()
            key = f"inspe-scene-{run}-{group[0].scene}"
            opened.append(_OpenScene(client.submit(build, group[0], key=key, pure=False), group))
            return opened[-1]
        return max(opened, key=lambda one: len(one.jobs) - one.running, default=None)

    def send(last: _OpenScene | None = None) -> None:
        place = next_scene(last)
        if place is None:
            return
        job = place.jobs.popleft()
        key = f"inspe-job-{run}-{job.key}"
        future = client.submit(work, place.scene, job, *given, key=key, pure=False)
        sent[future.key] = job, place
        place.running += 1
        if not place.jobs:
            opened.remove(place)
        futures.add(future)

    for _ in range(ahead):
        send()
    for future in futures:
        job, place = sent.pop(future.key)
        place.running -= 1
        try:
            found = future.result()  # waits if its worker has died since
        except CancelledError:
            lost = "the scheduler was lost; give the same command again to resume"
            raise InspeError(lost) from None
        except Exception as e:
            found = e
        send(place)
        yield job, found
