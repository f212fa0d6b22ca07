"""Runs all jobs of a study on Dask workers: on this machine, or on a running cluster. Each job's
row is flushed to ``results.csv`` as it ends; a killed run leaves at most one incomplete row."""

import os
from collections.abc import Callable, Mapping
from typing import Any

from inspe_jax.core.errors import InspeError, wrong_kind
from inspe_jax.core.files import csv_line, csv_text, named, parse_csv, prepare_folder, write_text
from inspe_jax.jobs.engine import check_workers, load_cluster, run_jobs
from inspe_jax.jobs.locks import ADVICE, check_versions, lock_folder
from inspe_jax.jobs.sources import message_of, place_layout, release_compiled, scene_of, versions
from inspe_jax.placement import optimise
from inspe_jax.placement.objective import Objective
from inspe_jax.placement.problem import Case
from inspe_jax.scene.scene import Scene
from inspe_jax.scoring.evaluate import Scores, evaluate
from inspe_jax.scoring.metrics import listed
from inspe_jax.sensing.conditions import Conditions
from inspe_jax.sensing.layout import Layout, layout_text
from inspe_jax.study.plan import SCORE_ONLY, SCORE_SETTINGS, SETTINGS, Study, StudyJob

Row = dict[str, str]

TABLE = "results.csv"
FACTS = ("sensors", "voxels", "objects")
"""Columns: number of sensors, of voxels, and mean number of objects in a frame."""
BEFORE = "surrogate_before"  # column of P_sm before a search; empty where nothing was searched
LAYOUTS = "layouts"  # folder of the layouts that searches found, by the keys of their jobs


def sweep(
    study: Study,
    folder: str | os.PathLike[str],
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Row]:
    """Run every job of a study that ``folder`` has no row of yet.

    Rows are appended to ``results.csv`` as jobs finish; layouts that searches found go into
    ``layouts/``. To resume a run that was killed, or to run again what failed, call this again: the
    table comes out the same, except for searches with a budget in ``seconds``, which do not repeat
    to the digit. A job that fails has a row with its error; so has a job whose worker dies each
    time. Workers are processes of their own, so a script that calls this needs ``if __name__ ==
    "__main__":``, and must register its metrics above that line.

    Args:
        study: The jobs, as of :func:`load_study`.
        folder: Where results go.
        scheduler: Address of a running Dask scheduler. Its workers need one thread each, the same
            versions of Python, JAX, NumPy and this package, and maps and saved scenes at the same
            paths.
        workers: Without a scheduler, number of processes on this machine; one per core if None.
        progress: Called with (jobs done, jobs).

    Returns:
        All rows, in order.

    Raises:
        InspeError: Dask is missing, no scheduler answers or its workers have other versions, or as
            :class:`Results`.
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
                    failed = isinstance(found, Exception)
                    results.add(*(failed_row(job, found), None) if failed else found)
                    report()
        return results.finish()


class Results:
    """The results of a study in a folder, open for one run; ``rows`` by key, without failures."""

    def __init__(self, study: Study, folder: str | os.PathLike[str]) -> None:
        """Raises InspeError if another run uses the folder, or it has other results."""
        self.study = study
        self.columns = columns(study)
        self.folder = prepare_folder(folder)
        self.path = self.folder / TABLE
        self._lock = lock_folder(self.folder, f".{TABLE}.lock").lock
        try:
            self.rows = self._taken_up()
        except BaseException:
            self._lock.release()
            raise

    def __enter__(self) -> "Results":
        return self

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def add(self, row: Row, layout: str | None = None) -> None:
        """Append a row, after the layout that a search found, if any, as ``layouts/KEY.yaml``."""
        if layout is not None:
            (self.folder / LAYOUTS).mkdir(exist_ok=True)
            write_text(self.folder / LAYOUTS / f"{row['key']}.yaml", layout)
        whole, new = {name: row.get(name, "") for name in self.columns}, not self.path.exists()
        with named(self.path), self.path.open("a", newline="", encoding="utf-8") as file:
            file.write(csv_text([whole]) if new else csv_line(whole.values()))
            file.flush()
            os.fsync(file.fileno())
        self.rows[row["key"]] = whole

    def finish(self) -> list[Row]:
        """Write the rows in the order of the study; returns them."""
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
        known = {job.key for job in self.study.jobs}
        strange = [row for row in rows if row["key"] not in known]
        if strange:
            raise InspeError(
                f"{self.path}: {len(strange)} of its {len(rows)} rows are not jobs of this study, "
                f"such as {strange[0]['layout']} on {strange[0]['scene']}; {ADVICE}"
            )
        for row in rows:
            check_versions(row, versions(), self.path)
        if len(whole) < len(content):
            write_text(self.path, whole.decode("utf-8"))
        found = {row["key"]: row for row in rows if row["status"] == "done"}
        for job in self.study.jobs:  # tags may have been changed since
            if job.key in found:
                found[job.key] |= tag_columns(job)
        return found


# ── What a worker runs, and its row of the results ──────────────────────────


def columns(study: Study) -> tuple[str, ...]:
    """The columns of a study's results."""
    first = ("key", "scene", "layout", *(f"tag_{name}" for name in study.tags))
    names = (m.name for m in listed(study.metrics))
    return (*first, *SETTINGS, *FACTS, *names, BEFORE, "status", "error", *versions())


def scene_of_job(job: StudyJob) -> Scene:
    """The scene of a job. An error in it is that of every job on the scene."""
    return scene_of(job.source, job.build)


def run_job(scene: Scene, job: StudyJob, wanted: Row) -> tuple[Row, str | None]:
    """Run a job: (its row of the results, the layout that a search found as YAML text or None)."""
    if versions() != wanted:
        raise InspeError(f"this worker has other versions: {versions()}")
    release_compiled(job.scene)
    layout = place_layout(job.layout, scene)
    scores, before, found = _scored(scene, layout, job)
    facts = (len(layout), scene.voxels.count, round(scene.traffic.mean_count, 2))
    row = row_head(job) | wanted
    row |= dict(zip(FACTS, map(str, facts), strict=True))
    row |= {m.name: f"{scores.value(m.name):.7f}" for m in listed(job.metrics)}
    row |= {BEFORE: "" if before is None else f"{before:.7f}", "status": "done", "error": ""}
    return row, None if found is None else layout_text(found)


def row_head(job: StudyJob) -> Row:
    """The columns of a row that are known before the job runs: its settings."""
    row = {"key": job.key, "scene": job.source.name, "layout": job.layout.name}
    return row | tag_columns(job) | {key: _word(job.settings[key]) for key in SETTINGS}


def tag_columns(job: StudyJob) -> Row:
    """The columns of the tags of a job's scene."""
    return {f"tag_{name}": value for name, value in job.tags.items()}


def failed_row(job: StudyJob, error: Exception) -> Row:
    """The row of a job that failed; the error is put on one line."""
    failed = {"status": "failed", "error": " ".join(message_of(error).split())}
    return row_head(job) | versions() | failed


def _scored(
    scene: Scene, layout: Layout, job: StudyJob
) -> tuple[Scores, float | None, Layout | None]:
    """(scores, P_sm before a search, the layout that the search found)."""
    given = job.settings
    around = Conditions.of(given["light"], given["weather"])
    options: dict[str, Any] = {key: given[key] for key in SCORE_SETTINGS}
    options |= dict(metrics=job.metrics, detection=job.detection)
    if given["method"] == SCORE_ONLY:
        return evaluate(scene, layout, conditions=around, **options), None, None
    result = optimise.optimise(
        Case(scene, around),
        layout,
        given["method"],
        seconds=given["seconds"],
        evaluations=given["evaluations"],
        seed=given["search_seed"],
        objective=Objective(**options),
    )
    return result.scores, result.scores_before.surrogate, result.layout


def _word(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, Mapping):
        return " ".join(f"{key}={_word(item)}" for key, item in value.items())
    if isinstance(value, list):
        return " ".join(map(_word, value))
    return str(value).removesuffix(".0") if isinstance(value, float) else str(value)
