"""A study: every layout on every scene in every setting, as a list of jobs. Read from YAML.

The file; paths are relative to it, and every setting is one value or a list of them::

    scenes:
      - built_in: four_way
      - map: Town05.xodr             # OpenDRIVE; or SUMO's .net.xml, or .osm
        junction: 53                 # or center: [x, y]
        radius: 60                   # settings of a scene's own stand before the study's
        tags: {kind: four-way}       # go into columns of the results; a note does not
      - file: saved.npz              # keeps the settings that it was built with
    layouts:
      - Cam-d1                       # a strategy
      - layout.yaml
      - {strategy: L-d2, lidar: paper-lidar-32, name: L-d2 with 32 beams}
      - {strategy: Cam-d1, camera: far, name: Cam-d1 that sees far}
    devices:                         # of your own, in the keys of the catalogue
      far: {like: paper-camera, depth_m: 60}
    settings:
      density: [low, medium, high]   # of scenes: radius, voxel, density, frames, step, mix,
                                     #   traffic (waypoints or sumo), seed
      light: [midday, night]         # of the sensors: light, weather
      weather: [clear, "rain:10"]    # of the scores: weights, occlusion_reference, visibility
      method: [none, greedy-adam]    # score as it is, or search first: method, seconds,
      seconds: 30                    #   evaluations, search_seed
"""

import hashlib
import inspect
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, BeforeValidator, Field

from inspe_jax import metrics
from inspe_jax.errors import InspeError, nearest
from inspe_jax.evaluation import check_options
from inspe_jax.files import STRICT, check_input, check_model, read_yaml
from inspe_jax.placement.checkpoint import digest
from inspe_jax.placement.optimise import DEFAULT_SECONDS, METHODS
from inspe_jax.placement.run import check_budget, check_seed
from inspe_jax.placement.strategies import choose
from inspe_jax.scene.procedural import BUILT_INS
from inspe_jax.scene.scene import TRAFFIC, build_scene, density_count, load_scene
from inspe_jax.scene.traffic import MIXES
from inspe_jax.sensing.conditions import FAIR, Conditions
from inspe_jax.sensing.devices import spec_of
from inspe_jax.sensing.layout import load_layout
from inspe_jax.sensing.sensors import Spec

T = TypeVar("T")

AS_IT_IS = "none"
"""The method that only scores."""
BUILD = ("radius", "voxel", "density", "frames", "step", "mix", "traffic", "seed")
"""Settings that a scene is built with."""
CONDITIONS = ("light", "weather")
SCORE = ("weights", "occlusion_reference", "visibility")
SEARCH = ("method", "seconds", "evaluations", "search_seed")
SETTINGS = (*BUILD, *CONDITIONS, *SCORE, *SEARCH)


@dataclass(frozen=True)
class SceneSource:
    """Where a scene comes from: a built-in, a map's ``junction`` or ``center``, or a saved scene.

    ``content`` is the digest of the file, so that a job is known to be of what was in it.
    """

    name: str
    built_in: str | None = None
    map: str | None = None
    junction: str | int | None = None
    center: tuple[float, float] | None = None
    file: str | None = None
    content: str = ""

    @property
    def anywhere(self) -> "SceneSource":
        """The same, wherever its file lies."""
        map_, file = (path and Path(path).name for path in (self.map, self.file))
        return replace(self, map=map_, file=file)


@dataclass(frozen=True)
class LayoutSource:
    """Where a layout comes from: a strategy with its ``options``, or the ``text`` of a file.

    Among the options, devices of the study's own are specs, and others names.
    """

    name: str
    strategy: str | None = None
    options: tuple[tuple[str, Any], ...] = ()
    text: str | None = None


@dataclass(frozen=True)
class Job:
    """One layout on one scene in one setting; ``settings`` has every key of :data:`SETTINGS`."""

    source: SceneSource
    layout: LayoutSource
    settings: Mapping[str, Any]
    tags: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def key(self) -> str:
        """A short text that is this job's own: of what its result depends on."""
        return digest([self.source.anywhere, self.layout, self.settings])[:16]

    @cached_property
    def scene(self) -> str:
        """The same for its scene."""
        return digest([self.source.anywhere, {k: self.settings[k] for k in BUILD}])[:16]


@dataclass(frozen=True)
class Study:
    """Jobs in the order of their results, and the tags that their scenes have."""

    name: str
    jobs: tuple[Job, ...]

    @cached_property
    def tags(self) -> tuple[str, ...]:
        """Every tag of any scene."""
        return tuple(dict.fromkeys(tag for job in self.jobs for tag in job.tags))


def digest_of(path: Path) -> str:
    """A text that is the same for the same content of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


# ── The file ────────────────────────────────────────────────────────────────


def _listed(value: Any) -> Any:
    return value if isinstance(value, list) else [value]


def _rows(value: Any) -> Any:
    """Weights are a list already: of three, or of several such."""
    nested = isinstance(value, list) and value and isinstance(value[0], list)
    return value if nested else [value]


class _Strict(BaseModel):
    model_config = STRICT


_Count = Annotated[int, Field(ge=0)]
_Frames = Annotated[int, Field(ge=1)]
_Length = Annotated[float, Field(gt=0)]
_Budget = Annotated[float, Field(gt=0)]
_Text = Annotated[str, Field(min_length=1)]
_Line = Annotated[str, Field(pattern=r"^[^\x00-\x1f\x7f]+$")]
_One = Annotated[float, Field(ge=0, le=1)]
_Several = Annotated[list[T], BeforeValidator(_listed), Field(min_length=1)]
_Weights = Annotated[list[_One], Field(min_length=3, max_length=3)]


class _Build(_Strict):
    radius: _Several[_Length] = []
    voxel: _Several[_Length] = []
    density: _Several[str | int] = []
    frames: _Several[_Frames] = []
    step: _Several[_Length] = []
    mix: _Several[str] = []
    traffic: _Several[str] = []
    seed: _Several[_Count] = []


class _Settings(_Build):
    light: _Several[str] = []
    weather: _Several[str] = []
    weights: Annotated[list[_Weights], BeforeValidator(_rows), Field(min_length=1)] = []
    occlusion_reference: _Several[str] = []
    visibility: _Several[str] = []
    method: _Several[str] = []
    seconds: _Several[_Budget] = []
    evaluations: _Several[_Budget] = []
    search_seed: _Several[_Count] = []


class _SceneEntry(_Build):
    name: _Line | None = None
    built_in: str | None = None
    map: _Text | None = None
    junction: str | int | None = None
    center: Annotated[list[float], Field(min_length=2, max_length=2)] | None = None
    file: _Text | None = None
    tags: dict[_Line, _Line] = {}
    note: str = ""


class _LayoutEntry(_Strict):
    name: _Line | None = None
    strategy: str | None = None
    file: _Text | None = None
    camera: str | None = None
    lidar: str | None = None
    camera_height: _Length | None = None
    camera_pitch_deg: float | None = None
    lidar_height: _Length | None = None


class _StudyFile(_Strict):
    name: _Line | None = None
    scenes: Annotated[list[_SceneEntry], Field(min_length=1)]
    devices: dict[_Line, Any] = {}
    layouts: Annotated[list[_LayoutEntry], Field(min_length=1)]
    settings: _Settings = _Settings()


def load_study(path: str | os.PathLike[str]) -> Study:
    """Read a study file; its form is at the head of this module.

    Raises InspeError that names the file, the key and what is allowed.
    """
    path = Path(path)
    content = read_yaml(path)
    if not isinstance(content, dict) or not content:
        raise InspeError(f"{path}: the study is empty: it needs 'scenes' and 'layouts'")
    return make_study(content, path.parent, str(path), path.stem)


def make_study(
    content: Mapping[str, Any], folder: Path, where: str = "study", name: str = "study"
) -> Study:
    """A study from what a study file holds; paths in it are relative to ``folder``."""
    content = dict(content)
    if isinstance(content.get("layouts"), list):
        content["layouts"] = [_named(entry) for entry in content["layouts"]]
    entry = check_model(_StudyFile, content, where)
    whole = {key: getattr(entry.settings, key) for key in SETTINGS}
    _check_settings(whole, f"{where}: settings")
    own_devices = {
        key: spec_of(table, key, f"{where}: devices.{key}") for key, table in entry.devices.items()
    }
    layouts = [
        _layout_source(item, own_devices, folder, f"{where}: layouts[{k}]")
        for k, item in enumerate(entry.layouts)
    ]
    _check_names([item.name for item in layouts], f"{where}: layouts")
    jobs: dict[str, Job] = {}
    names = []
    for k, item in enumerate(entry.scenes):
        at = f"{where}: scenes[{k}]"
        own = {key: getattr(item, key) for key in BUILD}
        _check_settings(own, at)
        source = _scene_source(item, folder, at)
        names.append(source.name)
        given = whole | {key: value for key, value in own.items() if value}
        if source.file is not None:
            if any(own.values()):
                raise InspeError(f"{at}: a saved scene keeps its settings; leave out {_set(own)}")
            kept = dict(load_scene(source.file).settings)
            given |= {key: [kept.get(key, "")] for key in BUILD}
        for build in _combinations(given, BUILD):
            for layout in layouts:
                for rest in _combinations(given, (*CONDITIONS, *SCORE, *SEARCH)):
                    settings = build | _searched(_conditioned(rest))
                    job = Job(source, layout, settings, dict(item.tags))
                    jobs.setdefault(job.key, job)
    _check_names(names, f"{where}: scenes")
    return Study(entry.name or name, tuple(jobs.values()))


def _combinations(given: Mapping[str, Any], keys: Iterable[str]) -> list[dict[str, Any]]:
    """Every combination of values, with the defaults for what is not given."""
    keys = tuple(keys)
    values = [given[key] or _defaults()[key] for key in keys]
    return [dict(zip(keys, row, strict=True)) for row in product(*values)]


def _defaults() -> dict[str, list[Any]]:
    own = inspect.signature(build_scene).parameters
    return {key: [own[key].default] for key in BUILD} | dict(
        **{key: [value] for key, value in FAIR.record.items()},
        weights=[list(metrics.WEIGHTS)],
        occlusion_reference=["roi"],
        visibility=["in_view"],
        method=[AS_IT_IS],
        seconds=[None],
        evaluations=[None],
        search_seed=[0],
    )


def _conditioned(settings: dict[str, Any]) -> dict[str, Any]:
    """Settings, with light and weather spelt in one way."""
    around = Conditions.of(settings["light"], settings["weather"])
    return settings | around.record


def _searched(settings: dict[str, Any]) -> dict[str, Any]:
    """Settings, without those of a search where there is none."""
    if settings["method"] == AS_IT_IS:
        return settings | dict(seconds=None, evaluations=None, search_seed=None)
    if settings["seconds"] is None and settings["evaluations"] is None:
        return settings | dict(seconds=DEFAULT_SECONDS)
    return settings


def _set(given: Mapping[str, Any]) -> str:
    return ", ".join(key for key, value in given.items() if value)


def _check_names(names: list[str], where: str) -> None:
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InspeError(f"{where}: two are named '{twice}'; give one another name")


def _check_settings(given: Mapping[str, Any], where: str) -> None:
    """Raise InspeError where a setting's value is none that it can have."""

    def check(key: str, does: Any) -> None:
        for value in given.get(key, ()):
            try:
                does(value)
            except InspeError as e:
                raise InspeError(f"{where}.{key}: {e}") from None

    def one_of(known: Iterable[str]) -> Any:
        def does(value: str) -> None:
            if value not in known:
                allowed = ", ".join(known)
                raise InspeError(f"'{value}': one of {allowed}{nearest(value, tuple(known))}")

        return does

    check("density", density_count)
    check("mix", one_of(MIXES))
    check("traffic", one_of(TRAFFIC))
    check("light", Conditions.of)
    check("weather", lambda value: Conditions.of("midday", value))
    check("weights", lambda value: check_options(tuple(value), "roi", "in_view"))
    check("occlusion_reference", lambda value: check_options(metrics.WEIGHTS, value, "in_view"))
    check("visibility", lambda value: check_options(metrics.WEIGHTS, "roi", value))
    check("method", one_of((AS_IT_IS, *METHODS)))
    check("seconds", lambda value: check_budget(value, None))
    check("evaluations", lambda value: check_budget(None, value))
    check("search_seed", check_seed)


def _scene_source(entry: _SceneEntry, folder: Path, where: str) -> SceneSource:
    sources = [key for key in ("built_in", "map", "file") if getattr(entry, key) is not None]
    if len(sources) != 1:
        raise InspeError(f"{where}: give one of built_in, map and file")
    if entry.map is None and (entry.junction is not None or entry.center is not None):
        raise InspeError(f"{where}: junction and center are for maps")
    if entry.built_in is not None:
        if entry.built_in not in BUILT_INS:
            raise InspeError(
                f"{where}.built_in: '{entry.built_in}': one of {', '.join(BUILT_INS)}"
                + nearest(entry.built_in, tuple(BUILT_INS))
            )
        return SceneSource(entry.name or entry.built_in, built_in=entry.built_in)
    path = (folder / str(entry.map or entry.file)).resolve()
    check_input(path)
    content = digest_of(path)
    if entry.file is not None:
        return SceneSource(entry.name or path.stem, file=str(path), content=content)
    if (entry.junction is None) == (entry.center is None):
        raise InspeError(f"{where}: say which place of the map: junction or center")
    at = str(entry.junction) if entry.center is None else "{:g}, {:g}".format(*entry.center)
    return SceneSource(
        entry.name or f"{path.stem} {at}",
        map=str(path),
        junction=entry.junction,
        center=None if entry.center is None else (entry.center[0], entry.center[1]),
        content=content,
    )


def _named(entry: Any) -> Any:
    """A layout given by its name alone: a file's, or a strategy's."""
    if not isinstance(entry, str):
        return entry
    return {"file" if Path(entry).suffix in (".yaml", ".yml") else "strategy": entry}


def _layout_source(
    entry: _LayoutEntry, devices: Mapping[str, Spec], folder: Path, where: str
) -> LayoutSource:
    if (entry.strategy is None) == (entry.file is None):
        raise InspeError(f"{where}: give either a strategy or a file")
    options: dict[str, Any] = {
        key: value
        for key in ("camera", "lidar", "camera_height", "lidar_height", "camera_pitch_deg")
        if (value := getattr(entry, key)) is not None
    }
    if entry.file is not None:
        if options:
            raise InspeError(f"{where}: a file has its own devices; leave out {', '.join(options)}")
        path = folder / entry.file
        name = load_layout(path).name
        return LayoutSource(entry.name or name, text=path.read_text(encoding="utf-8"))
    options = {key: devices.get(value, value) for key, value in options.items()}
    try:
        chosen = choose(str(entry.strategy), **options)
    except InspeError as e:
        raise InspeError(f"{where}: {e}") from None
    return LayoutSource(entry.name or chosen.name, chosen.name, tuple(options.items()))
