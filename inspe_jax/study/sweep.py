"""Runs all jobs of a study on Dask workers: on this machine, or on a running cluster."""

import os
from collections.abc import Callable
from typing import Any

from inspe_jax.core.errors import wrong_kind
from inspe_jax.jobs.engine import check_workers, load_cluster, run_jobs
from inspe_jax.jobs.scenes import versions
from inspe_jax.study.plan import Study, StudyJob
from inspe_jax.study.results import Results
from inspe_jax.study.work import Row, failure_columns, row_head, run_job, scene_of_job


def sweep(
    study: Study,
    folder: str | os.PathLike[str],
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Row]:
    """Run every job of a study that ``folder`` has no row of yet; returns all rows, in order.

    Rows are appended to ``results.csv`` as jobs finish; layouts that searches found go into
    ``layouts/``. To resume a run that was killed, or to run again what failed, call this again: the
    table comes out the same, except for searches with a budget in ``seconds``, which do not repeat
    to the digit.

    ``scheduler``: address of a running Dask scheduler. Its workers need one thread each, the same
    versions of Python, JAX, NumPy and this package, and maps and saved scenes at the same paths.
    ``workers``: without a scheduler, number of processes on this machine; one per core by default.
    ``progress``: called with (jobs done, jobs).

    A job that fails has a row with its error; so has a job whose worker dies each time. Workers are
    processes of their own, so a script that calls this needs ``if __name__ == "__main__":``, and
    must register its metrics above that line.

    Raises InspeError if Dask is missing, if no scheduler answers or its workers have other
    versions, or as :class:`~inspe_jax.study.results.Results` does.
    """
    if not isinstance(study, Study):
        raise wrong_kind("study", study, "a Study, as load_study reads it")
    check_workers(scheduler, workers)
    with Results(study, folder) as results:
        left = [job for job in study.jobs if job.key not in results.rows]

        def report() -> None:
            if progress:
                progress(len(results.rows), len(study.jobs))

        report()
        if left:
            with load_cluster().client(scheduler, workers) as client:
                for job, found in run_jobs(client, left, scene_of_job, run_job, versions()):
                    results.add(*_row(job, found))
                    report()
        return results.finish()


def _row(job: StudyJob, found: Any) -> tuple[Row, str | None]:
    if isinstance(found, Exception):
        error = f"{type(found).__name__}: {found}"
        return row_head(job) | versions() | failure_columns(error), None
    return found
