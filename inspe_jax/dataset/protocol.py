"""The protocol of a scenario, ``data_protocol.yaml``: all that is needed to generate it again."""

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import Field

from inspe_jax.core import version
from inspe_jax.core.errors import InspeError, brief, check_known
from inspe_jax.core.files import check_model, digest_of
from inspe_jax.dataset import plan as plans
from inspe_jax.dataset.folders import SPLITS
from inspe_jax.dataset.formats.other_readers import DEFAULT_OPTIONS
from inspe_jax.dataset.formats.registry import DEFAULT_FORMAT
from inspe_jax.dataset.plan import SETTINGS, Generation, ScenarioPlan
from inspe_jax.jobs import settings, sources
from inspe_jax.jobs.settings import Count, Line, Strict, Text
from inspe_jax.sensing.layout import parse_layout
from inspe_jax.simulation.backends import BACKENDS

FORMAT = "inspe_jax scenario 3"
PORT = 2000
"""CARLA's usual port. Readers of OPV2V data sets expect one in the protocol; it has no effect."""


class _Scene(sources.SceneEntry):
    name: Line
    content: str = ""


class _Recording(plans.RecordingEntry):
    backend: str
    seed: Count


class _Protocol(Strict):
    format: str
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_+-][A-Za-z0-9._+-]*$")]
    split: Text
    world: dict[str, Any]
    scene: _Scene
    settings: dict[str, Any]
    recording: _Recording
    tags: dict[Line, Line] = Field(default={})
    layout: dict[str, Any]
    versions: dict[str, str]
    notes: list[str] = Field(default=[])
    middle: Annotated[list[float], Field(min_length=3, max_length=3)] | None = None
    lidar_range: list[float] = Field(default=[])
    stations: dict[int, str] = Field(default={})


def versions(backend: str) -> dict[str, str]:
    """Versions of the packages that the bytes of a data set depend on."""
    own = {name for name in BACKENDS[backend].packages if find_spec(name)}
    return version.versions(("jax", "numpy", "pillow", "scipy", "shapely", *own))


def protocol_of(
    plan: ScenarioPlan,
    layout: Mapping[str, Any],
    backend: str,
    notes: Sequence[str] = (),
    format: str = DEFAULT_FORMAT,
    middle: Sequence[float] | None = None,
) -> dict[str, Any]:
    """The content of a scenario's protocol; ``middle`` is that of the region of interest [m]."""
    source = plan.source.anywhere
    scene = asdict(source) | {"content": source.content or None}
    if source.center is not None:
        scene["center"] = list(source.center)
    size = plan.recording.image_size
    recording = {
        "backend": backend,
        "rate_hz": plan.recording.rate,
        "layers": list(plan.recording.layers),
        "image_size": list(size) if size else None,
        "lidar_turn_s": plan.recording.turn,
        "seed": plan.seed,
        "format": None if format == DEFAULT_FORMAT else format,
        **{k: v for k, v in asdict(plan.files).items() if v != getattr(DEFAULT_OPTIONS, k)},
    }
    content = {
        "format": FORMAT,
        "name": plan.name,
        "split": plan.split,
        "world": {
            "fixed_delta_seconds": 1 / plan.recording.rate,
            "client_port": PORT,
            "seed": plan.settings["seed"],
            "weather": plan.conditions.record,
            "town": source.built_in or str(source.map or source.file).partition(".")[0],
        },
        "scene": _without_none(scene),
        "settings": {key: plan.settings[key] for key in SETTINGS},
        "recording": _without_none(recording),
        "tags": dict(plan.tags) or None,
        "layout": dict(layout),
        "versions": versions(backend),
        "middle": None if middle is None else [float(x) for x in middle],
        "notes": list(notes) or None,
    }
    return _without_none(content)


def _without_none(content: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in content.items() if value is not None}


def load_generation(
    path: str | os.PathLike[str], files: str | os.PathLike[str] | None = None
) -> Generation:
    """Read the plan of a data set: a study file, see :mod:`inspe_jax.dataset.plan`, or the protocol
    of a scenario, which is the plan of this scenario alone. Its map or saved scene is searched in
    ``files`` if given, else in its folder and the two above it; then in the current folder. Raises
    InspeError that names the file, the key and what is allowed."""
    path = Path(path)
    content = sources.read_study(path)
    if "world" not in content:
        return plans.make_generation(content, path.parent, str(path), path.stem)
    if "format" not in content:
        raise InspeError(f"{path}: a protocol that was not written by this package")
    folders = [*([Path(files)] if files else path.resolve().parents[:3]), Path.cwd()]
    where = str(path)
    entry = check_model(_Protocol, content, where)
    for key, value, known in (
        ("format", entry.format, (FORMAT,)),
        ("split", entry.split, SPLITS),
        ("recording.backend", entry.recording.backend, tuple(BACKENDS)),
    ):
        check_known(value, known, f"{where}: {key}:")
    source = _source(entry.scene, folders, f"{where}: scene")
    recording = entry.recording.recording(f"{where}: recording")
    parse_layout(entry.layout, f"{where}: layout", "layout")  # raises where it is not valid
    text = yaml.safe_dump(entry.layout, sort_keys=False)
    plan = ScenarioPlan(
        name=entry.name,
        split=entry.split,
        source=source,
        layout=sources.LayoutSource(str(entry.layout.get("name", entry.name)), text=text),
        settings=_settings(entry.settings, source, recording.rate, f"{where}: settings"),
        recording=recording,
        seed=entry.recording.seed,
        tags=entry.tags,
        files=entry.recording.files(f"{where}: recording"),
    )
    now = versions(entry.recording.backend)
    differ = [
        f"{name} {entry.versions.get(name)} (here {now.get(name)})"
        for name in entry.versions.keys() | now.keys()
        if entry.versions.get(name) != now.get(name)
    ]
    notes = [f"made with {', '.join(sorted(differ))}: files may differ"] if differ else []
    recorded = entry.recording
    return Generation(entry.name, (plan,), recorded.backend, tuple(notes), recorded.format)


def _source(entry: _Scene, folders: Iterable[Path], where: str) -> sources.SceneSource:
    given = entry.map or entry.file
    if given is None:
        return sources.scene_source(entry, Path(), where)
    folders = list(dict.fromkeys(folders))
    there = [folder for folder in folders if (folder / Path(given).name).is_file()]
    same = [folder for folder in there if digest_of(folder / Path(given).name) == entry.content]
    if not same:
        searched = ", ".join(map(str, there or folders))
        what = "has changed since the protocol was written" if there else "was not found"
        raise InspeError(
            f"{where}: {given} {what}; searched in {searched}; name its folder: --files"
        )
    return sources.scene_source(entry, same[0], where)


def _settings(
    given: dict[str, Any], source: sources.SceneSource, rate: float, where: str
) -> dict[str, Any]:
    """The settings of a protocol. For a saved scene, most of them are taken from its file."""
    for key in SETTINGS:
        if key not in given:
            raise InspeError(f"{where}: {key}: missing key")
    kept = sources.scene_settings(source, dict.fromkeys(settings.WORLD, ()), {}, where)
    entry = check_model(plans.Settings, {k: v for k, v in given.items() if k not in kept}, where)
    several = {key: getattr(entry, key) for key in SETTINGS if key not in kept}
    twice = next((key for key, values in several.items() if len(values) != 1), None)
    if twice is not None:
        raise InspeError(f"{where}: {twice}: must be one value, got {brief(given[twice])}")
    settings.check_settings(several, where)
    plans.check_seconds(several["seconds"][0], rate, f"{where}: seconds")
    if source.file is not None:
        plans.saved_seconds(source, several["seconds"], rate, where)
    one = {key: values[0] for key, values in (several | kept).items()}
    one |= settings.conditioned({key: one[key] for key in settings.CONDITIONS})
    return {key: one[key] for key in SETTINGS}
