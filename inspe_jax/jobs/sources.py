"""Where the scenes and layouts of sweeps and data sets come from, and how workers make them."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import jax
from pydantic import Field, model_validator

from inspe_jax.core import version
from inspe_jax.core.digest import OPTIONAL
from inspe_jax.core.errors import InspeError, check_known, error_at
from inspe_jax.core.files import check_input, digest_of, parse_yaml, read_yaml
from inspe_jax.core.parallel import compiled
from inspe_jax.jobs.settings import Count, Length, Line, Strict, Text, check_names, check_settings
from inspe_jax.mounting.mixes import mix_name, starting_layout
from inspe_jax.mounting.strategies import choose, strategy
from inspe_jax.scene.maps.registry import check_side, read_map
from inspe_jax.scene.procedural.built_ins import BUILT_INS, built_in
from inspe_jax.scene.profiles import BEFORE_PROFILES
from inspe_jax.scene.scene import Scene, build_scene, load_scene
from inspe_jax.sensing.catalogue import device, spec_of
from inspe_jax.sensing.layout import Layout, load_layout, parse_layout
from inspe_jax.sensing.sensors import Spec


@dataclass(frozen=True)
class SceneSource:
    """Where a scene comes from: a built-in, a map's ``junction`` or ``center`` (with the
    ``driving_side`` given for an extract), or a saved scene; ``content`` is the digest of the file.
    The name of this class is part of the keys of jobs in saved results."""

    name: str
    built_in: str | None = None
    map: str | None = None
    junction: str | int | None = None
    center: tuple[float, float] | None = None
    file: str | None = None
    content: str = ""
    driving_side: str | None = field(default=None, metadata=OPTIONAL)

    @property
    def anywhere(self) -> "SceneSource":
        """The same source without the folder of its file."""
        map_, file = (path and Path(path).name for path in (self.map, self.file))
        return replace(self, map=map_, file=file)


@dataclass(frozen=True)
class LayoutSource:
    """Where a layout comes from: a strategy with its ``options``, the ``text`` of a file, or a
    ``mix`` of numbers of devices; the study's own devices are specs in the options. The name of
    this class is part of the keys of jobs in saved results."""

    name: str
    strategy: str | None = None
    options: tuple[tuple[str, Any], ...] = ()
    text: str | None = None
    mix: tuple[tuple[str, int], ...] = ()


# ── The file ────────────────────────────────────────────────────────────────


def read_study(path: Path) -> dict[str, Any]:
    """The content of a study file. Raises InspeError if it is missing, empty or not YAML."""
    content = read_yaml(path)
    if not isinstance(content, dict) or not content:
        raise InspeError(f"{path}: the study is empty: it needs 'scenes' and 'layouts'")
    return content


class SceneEntry(Strict):
    """A scene of a study file, without settings of its own."""

    name: Line | None = None
    built_in: str | None = None
    map: Text | None = None
    junction: str | int | None = None
    center: Annotated[list[float], Field(min_length=2, max_length=2)] | None = None
    driving_side: str | None = None
    file: Text | None = None
    tags: dict[Line, Line] = Field(default={})
    note: str = ""


class LayoutEntry(Strict):
    """A layout of a study file; a name alone is that of a file or of a strategy. The order of these
    keys is part of the keys of jobs."""

    name: Line | None = None
    strategy: str | None = None
    file: Text | None = None
    mix: Annotated[dict[Line, Count], Field(min_length=1)] | None = None
    camera: str | None = None
    lidar: str | None = None
    camera_height: Length | None = None
    lidar_height: Length | None = None
    camera_pitch_deg: float | None = None

    @model_validator(mode="before")
    @classmethod
    def _of_name(cls, given: Any) -> Any:
        if not isinstance(given, str):
            return given
        return {"file" if Path(given).suffix in (".yaml", ".yml") else "strategy": given}


class Sources(Strict):
    """The parts of every study file except its scenes and settings."""

    name: Line | None = None
    devices: dict[Line, Any] = Field(default={})
    layouts: Annotated[list[LayoutEntry], Field(min_length=1)]


def each_scene(
    entries: Sequence[SceneEntry],
    keys: Iterable[str],
    whole: Mapping[str, list[Any]],
    folder: Path,
    where: str,
) -> Iterator[tuple[str, SceneEntry, SceneSource, dict[str, list[Any]]]]:
    """(place in the file, entry, source, settings) of every scene of a study; its own settings,
    named by ``keys``, replace those of the ``whole`` study."""
    keys, names = tuple(keys), []
    for k, entry in enumerate(entries):
        at = f"{where}: scenes[{k}]"
        own = {key: getattr(entry, key) for key in keys}
        check_settings(own, at)
        source = scene_source(entry, folder, at)
        names.append(source.name)
        yield at, entry, source, scene_settings(source, own, whole, at)
    check_names(names, f"{where}: scenes")


def scene_source(entry: SceneEntry, folder: Path, where: str) -> SceneSource:
    """The source of an entry's scene. Raises InspeError unless it names exactly one."""
    sources = [key for key in ("built_in", "map", "file") if getattr(entry, key) is not None]
    if len(sources) != 1:
        raise InspeError(f"{where}: give exactly one of built_in, map and file")
    places = entry.junction, entry.center, entry.driving_side
    if entry.map is None and places != (None, None, None):
        raise InspeError(f"{where}: junction, center and driving_side are only for maps")
    if entry.built_in is not None:
        check_known(entry.built_in, BUILT_INS, f"{where}.built_in:")
        return SceneSource(entry.name or entry.built_in, built_in=entry.built_in)
    path = (folder / str(entry.map or entry.file)).resolve()
    check_input(path)
    content = digest_of(path)
    if entry.file is not None:
        return SceneSource(entry.name or path.stem, file=str(path), content=content)
    if (entry.junction is None) == (entry.center is None):
        raise InspeError(f"{where}: choose a place on the map: give either junction or center")
    center = None if entry.center is None else (entry.center[0], entry.center[1])
    at = str(entry.junction) if center is None else "{:g}, {:g}".format(*center)
    name, side = entry.name or f"{path.stem} {at}", entry.driving_side
    with error_at(where):
        check_side(path, side)
    return SceneSource(name, None, str(path), entry.junction, center, None, content, side)


def scene_settings(
    source: SceneSource, own: Mapping[str, Any], whole: Mapping[str, Any], where: str
) -> dict[str, Any]:
    """A scene's settings, as lists: its ``own``, else those of the ``whole`` study; of a saved
    scene those it was built with. Raises InspeError if it is given others."""
    if source.file is None:
        return {**whole} | {key: value for key, value in own.items() if value}
    if given := ", ".join(key for key, value in own.items() if value):
        raise InspeError(
            f"{where}: a saved scene keeps the settings it was built with; leave out {given}"
        )
    kept = {"profile": BEFORE_PROFILES} | dict(load_scene(source.file).settings)
    return {**whole} | {key: [kept.get(key, "")] for key in own}


def layout_sources(entry: Sources, folder: Path, where: str) -> list[LayoutSource]:
    """The sources of a study's layouts. Raises InspeError for an unknown device or strategy."""
    own = {
        key: spec_of(table, key, f"{where}: devices.{key}") for key, table in entry.devices.items()
    }
    layouts = [
        _layout_source(item, own, folder, f"{where}: layouts[{k}]")
        for k, item in enumerate(entry.layouts)
    ]
    names = [source.name for source in layouts]
    # A file that a strategy was saved to has the strategy's name: beside that, its own tells it.
    layouts = [
        replace(source, name=Path(item.file).stem)
        if item.file and not item.name and names.count(source.name) > 1
        else source
        for item, source in zip(entry.layouts, layouts, strict=True)
    ]
    check_names([source.name for source in layouts], f"{where}: layouts")
    return layouts


def _layout_source(
    entry: LayoutEntry, devices: Mapping[str, Spec], folder: Path, where: str
) -> LayoutSource:
    if [entry.strategy, entry.file, entry.mix].count(None) != 2:
        raise InspeError(f"{where}: give either a strategy or a file, or a mix of devices")
    options = entry.model_dump(exclude={"name", "strategy", "file", "mix"}, exclude_none=True)
    if options and entry.strategy is None:
        kind = "file" if entry.mix is None else "mix"
        raise InspeError(f"{where}: a {kind} has its own devices; leave out {', '.join(options)}")
    if entry.mix is not None:
        counts = {key: count for key, count in entry.mix.items() if count}
        if not counts:
            raise InspeError(f"{where}.mix: needs at least one sensor")
        with error_at(f"{where}.mix"):
            for key in entry.mix:
                devices.get(key) or device(key)
        specs = tuple((key, devices[key]) for key in counts if key in devices)
        mix = tuple(counts.items())
        return LayoutSource(entry.name or mix_name(counts), options=specs, mix=mix)
    if entry.file is not None:
        path = folder / entry.file
        name = load_layout(path).name
        return LayoutSource(entry.name or name, text=path.read_text(encoding="utf-8"))
    options = {key: devices.get(value, value) for key, value in options.items()}
    with error_at(where):
        chosen = choose(str(entry.strategy), **options)
    return LayoutSource(entry.name or chosen.name, chosen.name, tuple(options.items()))


# ── What a worker needs for any job ─────────────────────────────────────────

COMPILED_SCENES = 6
"""Most scenes whose compiled programs a worker keeps; programs depend on a scene's shapes."""

_compiled_for: set[str] = set()


@cache
def versions() -> dict[str, str]:
    """Versions that a result depends on."""
    return version.versions(("jax", "numpy"))


def scene_of(source: SceneSource, settings: dict[str, Any]) -> Scene:
    """Build the scene of a source, or load a saved one that has not changed since the study."""
    if source.built_in is not None:
        return build_scene(built_in(source.built_in), **settings)
    path = Path(str(source.map or source.file))
    check_input(path)
    if digest_of(path) != source.content:
        raise InspeError(f"{path}: has changed since the study was read")
    if source.file is not None:
        return load_scene(path)
    at: dict[str, Any] = {k: getattr(source, k) for k in ("junction", "center", "driving_side")}
    return build_scene(read_map(path, **at, radius=settings["radius"]), **settings)


def place_layout(source: LayoutSource, scene: Scene) -> Layout:
    """The layout of a source on a scene. A mix stands as :func:`starting_layout` places it."""
    if source.mix:
        return starting_layout(scene, dict(source.mix), dict(source.options))
    if source.strategy is not None:
        return strategy(scene, source.strategy, **dict(source.options))
    assert source.text is not None
    return parse_layout(parse_yaml(source.text, source.name), source.name, source.name, scene)


def release_compiled(scene: str) -> None:
    """Drop the programs compiled for earlier scenes, once there are many scenes."""
    if scene not in _compiled_for and len(_compiled_for) >= COMPILED_SCENES:
        jax.clear_caches()
        compiled.clear()
        _compiled_for.clear()
    _compiled_for.add(scene)


def message_of(e: Exception) -> str:
    """An exception in words: the message alone if it is an InspeError."""
    return str(e) if isinstance(e, InspeError) else f"{type(e).__name__}: {e}"
