"""Runs all jobs of a study on Dask workers: on this machine, or on a running cluster.

``results.csv`` has one row for each job, which is flushed to disk as the job ends; at the end rows
are put in the study's order. A run that is killed leaves whole rows and at most one incomplete row,
which is dropped when the run is resumed. Jobs that failed are then run again.
"""

import os
from collections.abc import Callable, Sequence
from typing import IO, Any

from inspe_jax.core.errors import InspeError, wrong_kind
from inspe_jax.core.files import csv_line, csv_text, named, parse_csv, prepare_folder, write_text
from inspe_jax.jobs.engine import check_workers, load_cluster, run_jobs
from inspe_jax.jobs.locks import ADVICE, check_versions, lock_folder
from inspe_jax.jobs.scenes import versions
from inspe_jax.study.plan import Study, StudyJob
from inspe_jax.study.work import (
    LAYOUTS,
    Row,
    columns,
    failure_columns,
    row_head,
    run_job,
    scene_of_job,
    tag_columns,
)

TABLE = "results.csv"


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
    versions, or as :class:`Results` does.
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


class Results:
    """The results of one study in a folder, which only one run at a time may have open.

    ``rows`` are the rows so far, by the keys of their jobs; without those of earlier failures.
    """

    def __init__(self, study: Study, folder: str | os.PathLike[str]) -> None:
        """Open the folder, and read the rows that it has.

        Raises InspeError if it cannot be written, another run uses it, or it has results of
        another study or version.
        """
        self.study = study
        self.columns = columns(study)
        self.folder = prepare_folder(folder)
        self.path = self.folder / TABLE
        self._lock = lock_folder(self.folder, f".{TABLE}.lock")
        self._file: IO[str] | None = None
        try:
            self.rows = self._taken_up()
        except BaseException:
            self._lock.release()
            raise

    def __enter__(self) -> "Results":
        return self

    def __exit__(self, *_: object) -> None:
        if self._file:
            self._file.close()
        self._lock.release()

    def add(self, row: Row, layout: str | None = None) -> None:
        """Append a row, after the layout that a search found, if any, as ``layouts/KEY.yaml``."""
        if layout is not None:
            (self.folder / LAYOUTS).mkdir(exist_ok=True)
            write_text(self.folder / LAYOUTS / f"{row['key']}.yaml", layout)
        if self._file is None:
            new = not self.path.exists()
            self._file = self.path.open("a", newline="", encoding="utf-8")
            if new:
                self._file.write(csv_line(self.columns))
        with named(self.path):
            self._file.write(csv_line(row.get(name, "") for name in self.columns))
            self._file.flush()
            os.fsync(self._file.fileno())
        self.rows[row["key"]] = {name: row.get(name, "") for name in self.columns}

    def finish(self) -> list[Row]:
        """Write the rows in the order of the study; returns them."""
        if self._file:
            self._file.close()
            self._file = None
        rows = [self.rows[job.key] for job in self.study.jobs if job.key in self.rows]
        write_text(self.path, csv_text(rows))
        return rows

    def _taken_up(self) -> dict[str, Row]:
        if not self.path.exists():
            return {}
        content, head = self.path.read_bytes(), csv_line(self.columns).encode("utf-8")
        if head.startswith(content):  # only a part of the header, or nothing after it
            self.path.unlink()
            return {}
        if not content.startswith(head):
            raise InspeError(f"{self.path}: its columns are not those of this study; {ADVICE}")
        whole = content[: content.rfind(b"\n") + 1]
        rows = parse_csv(whole, str(self.path))
        self._check(rows)
        if len(whole) < len(content):
            write_text(self.path, whole.decode("utf-8"))
        found = {row["key"]: row for row in rows if row["status"] == "done"}
        for job in self.study.jobs:  # tags may have been changed since
            if job.key in found:
                found[job.key] |= tag_columns(job)
        return found

    def _check(self, rows: Sequence[Row]) -> None:
        known = {job.key for job in self.study.jobs}
        strange = [row for row in rows if row["key"] not in known]
        if strange:
            raise InspeError(
                f"{self.path}: {len(strange)} of its {len(rows)} rows are not jobs of this study, "
                f"such as {strange[0]['layout']} on {strange[0]['scene']}; {ADVICE}"
            )
        for row in rows:
            check_versions(row, versions(), self.path)
