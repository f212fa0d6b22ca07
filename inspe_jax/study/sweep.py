"""All jobs of a study, done by Dask workers: of a cluster on this machine, or of a running one."""

import os
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any
from uuid import uuid4

from inspe_jax.errors import InspeError
from inspe_jax.study.plan import Job, Study
from inspe_jax.study.results import Results
from inspe_jax.study.sources import SceneSource
from inspe_jax.study.work import Row, build, failed, head, versions, work

AHEAD = 3
"""Jobs that are sent ahead for each worker's thread, so that none waits for the next."""


def sweep(
    study: Study,
    folder: str | os.PathLike[str],
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    retry: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> list[Row]:
    """Do every job of a study that ``folder`` has no row of yet; gives all rows, in order.

    By a cluster of ``workers`` processes on this machine, one a core if not given, or by the
    workers of the Dask ``scheduler`` at an address: of one thread each, with the same versions of
    Python, JAX, NumPy and this package, and with maps and saved scenes under the same paths. Rows
    are appended to ``results.csv`` as they come; layouts that searches found go into ``layouts/``.
    A run that is killed is taken up again by calling it again, to the same table; only searches
    by ``seconds`` do not repeat to the digit. A job that fails, or at which workers die again and
    again even when they have no other, has a row with its error; ``retry`` tries those of an
    earlier run again. ``progress`` is called with (jobs done, jobs).

    Scripts that call this need the usual ``if __name__ == "__main__":``, as workers are processes
    of their own. Raises InspeError where Dask is missing, no scheduler answers or its workers have
    other versions, or as :class:`~inspe_jax.study.results.Results` does.
    """
    if workers is not None and (workers < 1 or scheduler is not None):
        raise InspeError(
            f"workers {workers}: 1 or more, and none for a scheduler, which has its own"
        )
    with Results(study, folder) as results:
        if retry:
            results.forget_failures()
        left = [job for job in study.jobs if job.key not in results.rows]

        def tell() -> None:
            if progress:
                progress(len(results.rows), len(study.jobs))

        tell()
        if left:
            with _dask().client(scheduler, workers) as client:
                for row, layout in _done(client, left):
                    results.add(row, layout)
                    tell()
        return results.finish()


def _dask() -> Any:
    try:
        from inspe_jax.study import cluster
    except ModuleNotFoundError as e:
        if e.name not in ("dask", "distributed"):
            raise
        raise InspeError(
            "sweeps run on Dask, which is not installed: pip install 'inspe_jax[sweep]'"
        ) from e
    return cluster


def _done(client: Any, jobs: Sequence[Job]) -> Iterator[tuple[Row, str | None]]:
    """Rows, as the jobs are done.

    When a worker dies, Dask suspects all jobs that it had before it, not only the one that it was
    at. So the jobs that are given up for that are done once more at the end, one at a time.
    """
    from distributed import KilledWorker

    doubtful: list[Job] = []
    for job, found in _sent(client, jobs, AHEAD * sum(client.nthreads().values())):
        if isinstance(found, KilledWorker):
            doubtful.append(job)
        else:
            yield _row(job, found)
    for job, found in _sent(client, doubtful, 1):
        yield _row(job, found)


def _by_scene(jobs: Sequence[Job]) -> list[list[Job]]:
    """The jobs of each scene: a scene of every place first, then a second one of each, and so on.

    Scenes of one place need the same code compiled. Worked on side by side, every worker would
    compile it; one after the other, the first keeps it for the rest.
    """
    groups = [list(group) for _, group in groupby(jobs, key=lambda job: job.scene)]
    met: Counter[SceneSource] = Counter()
    turns = []
    for group in groups:
        turns.append(met[group[0].source])
        met[group[0].source] += 1
    return [groups[k] for k in sorted(range(len(groups)), key=turns.__getitem__)]


def _row(job: Job, found: Any) -> tuple[Row, str | None]:
    if isinstance(found, Exception):
        error = f"{type(found).__name__}: {found}"
        return head(job) | versions() | failed(error), None
    return found


@dataclass(eq=False)
class _Open:
    """A scene whose jobs are being done: those left, and how many of it are on their way."""

    scene: Any
    jobs: deque[Job]
    away: int = 0


def _sent(client: Any, jobs: Sequence[Job], ahead: int) -> Iterator[tuple[Job, Any]]:
    """Jobs and what came of them, a row or an exception, with so many on their way at a time.

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
    sent: dict[str, tuple[Job, _Open]] = {}
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
        future = client.submit(work, place.scene, job, versions(), key=key, pure=False)
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
