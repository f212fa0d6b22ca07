"""What a worker runs: it builds a scene, and turns a job into a row of the results."""

from collections.abc import Mapping
from typing import Any

from inspe_jax.jobs.scenes import (
    message_of,
    place_layout,
    release_compiled,
    scene_or_message,
    versions,
)
from inspe_jax.placement import optimise
from inspe_jax.placement.objective import Objective
from inspe_jax.placement.problem import Case
from inspe_jax.scene.scene import Scene
from inspe_jax.scoring.evaluate import Scores, evaluate
from inspe_jax.scoring.metrics import listed
from inspe_jax.sensing.conditions import Conditions
from inspe_jax.sensing.layout import Layout, layout_text
from inspe_jax.study.plan import (
    BUILD_SETTINGS,
    SCORE_ONLY,
    SCORE_SETTINGS,
    SETTINGS,
    Study,
    StudyJob,
)

Row = dict[str, str]

LITERAL = "information_gain_literal"
"""Column of IG exactly as the paper prints it, for comparison."""
FACTS = ("sensors", "voxels", "objects")
"""Columns: number of sensors, of voxels, and mean number of objects in a frame."""
BEFORE = "surrogate_before"
"""Column of P_sm before a search; empty where nothing was searched."""
LAYOUTS = "layouts"
"""Folder of the layouts that searches found, by the keys of their jobs."""


def columns(study: Study) -> tuple[str, ...]:
    """The columns of a study's results."""
    first = ("key", "scene", "layout", *(f"tag_{name}" for name in study.tags))
    names = (m.name for m in listed(study.metrics))
    last = (LITERAL, BEFORE, "status", "error", *versions())
    return (*first, *SETTINGS, *FACTS, *names, *last)


def scene_of_job(job: StudyJob) -> Scene | str:
    """The scene of a job; or an error message, which every job on the scene then reports."""
    return scene_or_message(job.source, {key: job.settings[key] for key in BUILD_SETTINGS})


def run_job(scene: Scene | str, job: StudyJob, wanted: Row) -> tuple[Row, str | None]:
    """Run a job: (its row of the results, the layout that a search found as YAML text or None).

    An error goes into the row; a worker without the ``wanted`` versions is one.
    """
    row = row_head(job) | wanted
    if versions() != wanted:
        return row | failure_columns(f"this worker has other versions: {versions()}"), None
    if isinstance(scene, str):
        return row | failure_columns(scene), None
    release_compiled(job.scene)
    try:
        layout = place_layout(job.layout, scene)
        scores, before, found = _scored(scene, layout, job)
    except Exception as e:
        return row | failure_columns(message_of(e)), None
    facts = (len(layout), scene.voxels.count, round(scene.traffic.mean_count, 2))
    row |= dict(zip(FACTS, map(str, facts), strict=True))
    row |= {m.name: f"{scores.value(m.name):.7f}" for m in listed(job.metrics)}
    row[LITERAL] = f"{scores.information_gain_literal:.7f}"
    row |= {BEFORE: "" if before is None else f"{before:.7f}", "status": "done", "error": ""}
    return row, None if found is None else layout_text(found)


def row_head(job: StudyJob) -> Row:
    """The columns of a row that are known before the job runs: its settings."""
    row = {"key": job.key, "scene": job.source.name, "layout": job.layout.name}
    return row | tag_columns(job) | {key: _word(job.settings[key]) for key in SETTINGS}


def tag_columns(job: StudyJob) -> Row:
    """The columns of the tags of a job's scene."""
    return {f"tag_{name}": value for name, value in job.tags.items()}


def failure_columns(error: str) -> Row:
    """The last columns of a job that failed; the error is put on one line."""
    return {"status": "failed", "error": " ".join(error.split())}


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
