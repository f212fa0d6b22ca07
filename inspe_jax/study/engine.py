"""Jobs shared out among Dask workers: each is sent where its scene is, and given up for last.

What a scene and a job are, and what is done with them, is for those who share them out to say.
"""

from collections import Counter, deque
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any, Protocol, TypeVar
from uuid import uuid4

from inspe_jax.core.errors import InspeError

AHEAD = 3
"""Jobs that are sent ahead for each worker's thread, so that none waits for the next."""


class Schedulable(Protocol):
    """What can be sent: a ``key`` of its own, that of its ``scene``, and where that comes from.

    Jobs of one scene follow each other.
    """

    @property
    def key(self) -> str:
        """A short text that is this job's own."""

    @property
    def scene(self) -> str:
        """The same for the scene that it is on."""

    @property
    def source(self) -> Hashable:
        """The place: its scenes need the same code compiled."""


J = TypeVar("J", bound=Schedulable)


def dask() -> Any:
    """The module of clusters. Raises InspeError where Dask is missing."""
    try:
        from inspe_jax.study import cluster
    except ModuleNotFoundError as e:
        if e.name not in ("dask", "distributed"):
            raise
        raise InspeError(
            "work is shared out by Dask, which is not installed: pip install 'inspe_jax[sweep]'"
        ) from e
    return cluster


def done(
    client: Any,
    jobs: Sequence[J],
    build: Callable[[J], Any],
    work: Callable[..., Any],
    *given: Any,
    ahead: int = AHEAD,
) -> Iterator[tuple[J, Any]]:
    """Jobs and what ``work(scene, job, *given)`` gives, or the exception that came of it.

    As they are done; ``scene`` is what ``build`` gives of the first job of a scene. With one job
    ``ahead`` workers wait a moment for each, but have them in order and of one scene. When a worker
    dies, Dask suspects all jobs that it had before it, not only the one that it was at. So the
    jobs that are given up for that are done once more at the end, one at a time. Raises InspeError
    where the scheduler is lost.
    """
    from distributed import KilledWorker

    doubtful: list[J] = []
    at_once = ahead * sum(client.nthreads().values())
    for job, found in _sent(client, jobs, at_once, build, work, given):
        if isinstance(found, KilledWorker):
            doubtful.append(job)
        else:
            yield job, found
    yield from _sent(client, doubtful, 1, build, work, given)


def _by_scene(jobs: Sequence[J]) -> list[list[J]]:
    """The jobs of each scene: a scene of every place first, then a second one of each, and so on.

    Scenes of one place need the same code compiled. Worked on side by side, every worker would
    compile it; one after the other, the first keeps it for the rest.
    """
    groups = [list(group) for _, group in groupby(jobs, key=lambda job: job.scene)]
    met: Counter[Hashable] = Counter()
    turns = []
    for group in groups:
        turns.append(met[group[0].source])
        met[group[0].source] += 1
    return [groups[k] for k in sorted(range(len(groups)), key=turns.__getitem__)]


@dataclass(eq=False)
class _Open:
    """A scene whose jobs are being done: those left, and how many of it are on their way."""

    scene: Any
    jobs: deque[Any]
    away: int = 0


def _sent(
    client: Any,
    jobs: Sequence[J],
    ahead: int,
    build: Callable[[J], Any],
    work: Callable[..., Any],
    given: Sequence[Any] = (),
) -> Iterator[tuple[J, Any]]:
    """Jobs and what came of them, a result or an exception, with so many on their way at a time.

    As many scenes are open as there are workers: Dask builds each at the one that has least to
    do, and sends jobs where their scene is. A job that is done is followed by one of the same
    scene, so that its worker, which has compiled for it, goes on with it and lends no hand
    elsewhere while there is any.
    """
    from distributed import CancelledError, as_completed

    run = uuid4().hex[:8]  # a scheduler that others use as well has their keys
    groups = deque(map(deque, _by_scene(jobs)))
    opened: list[_Open] = []
    # A job's scene is held on to until its result is here: were that lost with its worker before,
    # it could not be found again without.
    sent: dict[str, tuple[J, _Open]] = {}
    running = as_completed(loop=client.loop)

    def next_scene(last: _Open | None) -> _Open | None:
        """The same as long as it has jobs; then a new one; then what has most left to do."""
        if last is not None and last.jobs:
            return last
        if groups and (last is not None or len(opened) < max(len(client.nthreads()), 1)):
            group = groups.popleft()
            key = f"inspe-scene-{run}-{group[0].scene}"
            opened.append(_Open(client.submit(build, group[0], key=key, pure=False), group))
            return opened[-1]
        return max(opened, key=lambda one: len(one.jobs) - one.away, default=None)

    def send(last: _Open | None = None) -> None:
        place = next_scene(last)
        if place is None:
            return
        job = place.jobs.popleft()
        key = f"inspe-job-{run}-{job.key}"
        future = client.submit(work, place.scene, job, *given, key=key, pure=False)
        sent[future.key] = job, place
        place.away += 1
        if not place.jobs:
            opened.remove(place)
        running.add(future)

    for _ in range(ahead):
        send()
    for future in running:
        job, place = sent.pop(future.key)
        place.away -= 1
        try:
            found = future.result()  # waits, where its worker died after it was done
        except CancelledError:
            raise InspeError("the scheduler was lost; the same command goes on from here") from None
        except Exception as e:
            found = e
        send(place)
        yield job, found
