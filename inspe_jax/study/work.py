"""What a worker does: builds a scene, and turns a job into a row of the results."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import jax

from inspe_jax.core import version
from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import check_input, parse_yaml
from inspe_jax.core.parallel import compiled
from inspe_jax.placement import optimise
from inspe_jax.placement.problem import Case, Objective
from inspe_jax.placement.strategies import strategy
from inspe_jax.scene.procedural.built_ins import built_in
from inspe_jax.scene.scene import Scene, build_scene, load_scene
from inspe_jax.scoring.evaluate import Scores, evaluate
from inspe_jax.scoring.metrics import listed
from inspe_jax.sensing.conditions import Conditions
from inspe_jax.sensing.layout import Layout, layout_text, parse_layout
from inspe_jax.study.plan import AS_IT_IS, BUILD, SETTINGS, Job, Study
from inspe_jax.study.sources import LayoutSource, SceneSource, digest_of

Row = dict[str, str]

LITERAL = "information_gain_literal"
"""IG to the letter of the paper, for comparison."""
FACTS = ("sensors", "voxels", "objects")
"""How many sensors and voxels, and objects in a frame in the mean."""
BEFORE = "surrogate_before"
"""P_sm of the layout as it was given, where a search moved it."""
MEMORY = 6
"""Scenes after which a worker forgets what it compiled for them: it is of their shapes."""

_compiled_for: set[str] = set()


def columns(study: Study) -> tuple[str, ...]:
    """The columns of a study's results."""
    head = ("key", "scene", "layout", *(f"tag_{name}" for name in study.tags))
    return (
        *head,
        *SETTINGS,
        *FACTS,
        *(m.name for m in listed()),
        LITERAL,
        BEFORE,
        "status",
        "error",
        *versions(),
    )


@cache
def versions() -> dict[str, str]:
    """What a result depends on beside its job."""
    return version.versions(("jax", "numpy"))


def build(job: Job) -> Scene | str:
    """The scene of a job; or what is wrong with it, for every job that is on it."""
    try:
        return scene_of(job.source, {key: job.settings[key] for key in BUILD})
    except Exception as e:
        return message_of(e)


def scene_of(source: SceneSource, settings: dict[str, Any]) -> Scene:
    """The scene of a source, built with ``settings`` where it was not before.

    Raises InspeError where its file is missing or has changed since the study began, or as
    building does.
    """
    if source.built_in is not None:
        return build_scene(built_in(source.built_in), **settings)
    path = Path(str(source.map or source.file))
    check_input(path)
    if digest_of(path) != source.content:
        raise InspeError(f"{path}: is no longer what it was when the study began")
    if source.file is not None:
        return load_scene(path)
    from inspe_jax.scene.maps.registry import read_map

    at: dict[str, Any] = dict(junction=source.junction, center=source.center)
    return build_scene(read_map(path, **at, radius=settings["radius"]), **settings)


def make_room(scene: str) -> None:
    """Forget what was compiled for earlier scenes, once there are many."""
    if scene not in _compiled_for and len(_compiled_for) >= MEMORY:
        jax.clear_caches()
        compiled.clear()
        _compiled_for.clear()
    _compiled_for.add(scene)


def work(scene: Scene | str, job: Job, wanted: Row) -> tuple[Row, str | None]:
    """(a row of the results, the layout that a search found as a file's text).

    What goes wrong is told in the row: the other jobs go on. So is a worker that has not the
    ``wanted`` versions.
    """
    row = head(job) | wanted
    if versions() != wanted:
        return row | failed(f"the worker has other versions: {versions()}"), None
    if isinstance(scene, str):
        return row | failed(scene), None
    make_room(job.scene)
    try:
        layout = placed(job.layout, scene)
        scores, before, found = _scored(scene, layout, job)
    except Exception as e:
        return row | failed(message_of(e)), None
    facts = (len(layout), scene.voxels.count, round(scene.traffic.mean_count, 2))
    row |= dict(zip(FACTS, map(str, facts), strict=True))
    row |= {m.name: f"{scores.value(m.name):.7f}" for m in listed()}
    row[LITERAL] = f"{scores.information_gain_literal:.7f}"
    row |= {BEFORE: "" if before is None else f"{before:.7f}", "status": "done", "error": ""}
    return row, None if found is None else layout_text(found)


def placed(source: LayoutSource, scene: Scene) -> Layout:
    """A job's layout on its scene."""
    if source.strategy is not None:
        return strategy(scene, source.strategy, **dict(source.options))
    assert source.text is not None
    return parse_layout(parse_yaml(source.text, source.name), source.name, source.name, scene)


def head(job: Job) -> Row:
    """What a row says before the job is done: all its settings."""
    row = {"key": job.key, "scene": job.source.name, "layout": job.layout.name}
    return row | tags(job) | {key: _word(job.settings[key]) for key in SETTINGS}


def tags(job: Job) -> Row:
    """The columns of its scene's tags."""
    return {f"tag_{name}": value for name, value in job.tags.items()}


def failed(error: str) -> Row:
    """The end of a row of a job that could not be done; one line, whatever the error says."""
    return {"status": "failed", "error": " ".join(error.split())}


def _scored(scene: Scene, layout: Layout, job: Job) -> tuple[Scores, float | None, Layout | None]:
    given = job.settings
    around = Conditions.of(given["light"], given["weather"])
    options: dict[str, Any] = dict(
        weights=given["weights"],
        occlusion_reference=given["occlusion_reference"],
        visibility=given["visibility"],
    )
    if given["method"] == AS_IT_IS:
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
    """What went wrong, in words."""
    return str(e) if isinstance(e, InspeError) else f"{type(e).__name__}: {e}"
