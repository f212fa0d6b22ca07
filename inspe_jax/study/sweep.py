"""All jobs of a study, done by Dask workers: of a cluster on this machine, or of a running one."""

import os
from collections.abc import Callable
from typing import Any

from inspe_jax.core.errors import InspeError
from inspe_jax.study.engine import dask, done
from inspe_jax.study.plan import Job, Study
from inspe_jax.study.results import Results
from inspe_jax.study.work import Row, build, failed, head, versions, work


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
            with dask().client(scheduler, workers) as client:
                for job, found in done(client, left, build, work, versions()):
                    results.add(*_row(job, found))
                    tell()
        return results.finish()


def _row(job: Job, found: Any) -> tuple[Row, str | None]:
    if isinstance(found, Exception):
        error = f"{type(found).__name__}: {found}"
        return head(job) | versions() | failed(error), None
    return found
