"""What a worker runs: it builds a scene, and turns a job into a row of the results."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import jax

from inspe_jax.core import version
from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import check_input, digest_of, parse_yaml
from inspe_jax.core.parallel import compiled
from inspe_jax.placement import optimise
from inspe_jax.placement.objective import Objective
from inspe_jax.placement.problem import Case
from inspe_jax.placement.strategies import strategy
from inspe_jax.placement.studies.pareto import starting_layout
from inspe_jax.scene.procedural.built_ins import built_in
from inspe_jax.scene.scene import Scene, build_scene, load_scene
from inspe_jax.scoring.evaluate import Scores, evaluate
from inspe_jax.scoring.metrics import listed
from inspe_jax.sensing.conditions import Conditions
from inspe_jax.sensing.layout import Layout, layout_text, parse_layout
from inspe_jax.study.plan import BUILD_SETTINGS, SCORE_ONLY, SETTINGS, Study, StudyJob
from inspe_jax.study.sources import LayoutSource, SceneSource

Row = dict[str, str]

LITERAL = "information_gain_literal"
"""Column of IG exactly as the paper prints it, for comparison."""
FACTS = ("sensors", "voxels", "objects")
"""Columns: number of sensors, of voxels, and mean number of objects in a frame."""
BEFORE = "surrogate_before"
"""Column of P_sm before a search; empty where nothing was searched."""
COMPILED_SCENES = 6
"""Most scenes whose compiled programs a worker keeps; programs depend on a scene's shapes."""

_compiled_for: set[str] = set()


def columns(study: Study) -> tuple[str, ...]:
    """The columns of a study's results."""
    first = ("key", "scene", "layout", *(f"tag_{name}" for name in study.tags))
    used = {key for job in study.jobs for key in job.settings}
    return (
        *first,
        *(key for key in SETTINGS if key in used),
        *FACTS,
        *(m.name for m in listed(study.metrics)),
        LITERAL,
        BEFORE,
        "status",
        "error",
        *versions(),
    )


@cache
def versions() -> dict[str, str]:
    """Versions that a result depends on."""
    return version.versions(("jax", "numpy"))


def scene_of_job(job: StudyJob) -> Scene | str:
    """The scene of a job; or an error message, which every job on the scene then reports."""
    try:
        return scene_of(job.source, {key: job.settings[key] for key in BUILD_SETTINGS})
    except Exception as e:
        return message_of(e)


def scene_of(source: SceneSource, settings: dict[str, Any]) -> Scene:
    """Build the scene of a source with ``settings``, or load a saved one.

    Raises InspeError if its file is missing or has changed since the study was read, or as
    building does.
    """
    if source.built_in is not None:
        return build_scene(built_in(source.built_in), **settings)
    path = Path(str(source.map or source.file))
    check_input(path)
    if digest_of(path) != source.content:
        raise InspeError(f"{path}: has changed since the study was read")
    if source.file is not None:
        return load_scene(path)
    from inspe_jax.scene.maps.registry import read_map

    at: dict[str, Any] = dict(junction=source.junction, center=source.center)
    return build_scene(read_map(path, **at, radius=settings["radius"]), **settings)


def release_compiled(scene: str) -> None:
    """Drop the programs compiled for earlier scenes, once there are many scenes."""
    if scene not in _compiled_for and len(_compiled_for) >= COMPILED_SCENES:
        jax.clear_caches()
        compiled.clear()
        _compiled_for.clear()
    _compiled_for.add(scene)


def run_job(scene: Scene | str, job: StudyJob, wanted: Row) -> tuple[Row, str | None]:
    """Run a job: (its row of the results, the layout that a search found as YAML text or None).

    An error goes into the row, so that other jobs go on. A worker without the ``wanted`` versions
    is such an error.
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


def place_layout(source: LayoutSource, scene: Scene) -> Layout:
    """The layout of a source on a scene. A mix stands as :func:`starting_layout` places it."""
    if source.mix:
        return starting_layout(scene, dict(source.mix), dict(source.options))
    if source.strategy is not None:
        return strategy(scene, source.strategy, **dict(source.options))
    assert source.text is not None
    return parse_layout(parse_yaml(source.text, source.name), source.name, source.name, scene)


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
    given = job.settings
    around = Conditions.of(given["light"], given["weather"])
    options: dict[str, Any] = dict(
        weights=given["weights"],
        occlusion_reference=given["occlusion_reference"],
        visibility=given["visibility"],
        metrics=job.metrics,
        detection=job.detection,
    )
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


def message_of(e: Exception) -> str:
    """An exception in words: the message alone if it is an InspeError."""
    return str(e) if isinstance(e, InspeError) else f"{type(e).__name__}: {e}"
