"""The plan of a data set, read from YAML: every layout on every scene in every setting.

The file is like that of a study (:mod:`inspe_jax.study.plan`), with ``seconds``, the length of a
scenario, among its settings, and the keys of :class:`RecordingEntry`, ``splits`` and ``split_by``.
The frames of a saved scene must be 1 / ``rate_hz`` apart; without ``seconds`` all are used.

Scenarios that differ only in layout, light or weather have the same road users: they are of one
scene, which is in one split. To test on other places, use ``split_by: intersection``; with
``statics: street`` in any case, as parked vehicles are the same in all scenes of a place. Densities
and kinds of intersections (the tag ``kind``, else the name) are spread over the splits evenly.
"""

import hashlib
import math
import re
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache, cached_property
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from inspe_jax.core.digest import digest
from inspe_jax.core.errors import InspeError, check_known, error_at
from inspe_jax.core.files import check_model
from inspe_jax.core.words import counted
from inspe_jax.dataset.folders import SPLITS
from inspe_jax.dataset.formats.other_readers import DEFAULT_OPTIONS, FileOptions
from inspe_jax.dataset.formats.registry import DEFAULT_FORMAT, FORMATS
from inspe_jax.jobs import settings, sources
from inspe_jax.jobs.settings import CONDITIONS, WORLD, Length, Several, Strict, WorldSettings
from inspe_jax.scene.traffic.frames import DENSITIES, MOST_FRAMES
from inspe_jax.sensing.conditions import CLEAR, Conditions
from inspe_jax.simulation.backends import DEFAULT_BACKEND
from inspe_jax.simulation.recorder import TURN, Recording

SECONDS = 10.0  # length of a scenario, if none is given [s]
SETTINGS = (*WORLD, *CONDITIONS, "seconds")
PROPORTIONS: dict[Any, float] = {"train": 7, "validate": 1, "test": 2}
"""Proportions of the scenarios in the splits, if none are given."""
LONGEST_NAME = 120
CHUNK = 10  # number of frames that a worker records at a time


@dataclass(frozen=True)
class ScenarioPlan:
    """A scenario to be generated, with every one of :data:`SETTINGS`; ``seed`` is of noise."""

    name: str
    split: str
    source: sources.SceneSource
    layout: sources.LayoutSource
    settings: Mapping[str, Any]
    recording: Recording
    seed: int
    tags: Mapping[str, str] = field(default_factory=dict)
    files: FileOptions = DEFAULT_OPTIONS

    @property
    def frames(self) -> int:
        """Number of frames."""
        return round(self.settings["seconds"] * self.recording.rate)

    @property
    def chunks(self) -> list[range]:
        """The frames, in parts that workers share."""
        frames = range(self.frames)
        return [frames[first : first + CHUNK] for first in frames[::CHUNK]]

    @property
    def conditions(self) -> Conditions:
        """Light and weather."""
        return Conditions.of(self.settings["light"], self.settings["weather"])

    @property
    def build(self) -> dict[str, Any]:
        """Settings that the scene is built with."""
        world = {key: self.settings[key] for key in WORLD}
        return world | dict(frames=self.frames, step=1 / self.recording.rate)

    @cached_property
    def scene(self) -> str:
        """A short text that identifies the scene."""
        return digest([self.source.anywhere, self.build])[:16]

    @cached_property
    def key(self) -> str:
        """A short text that identifies the scenario: by its content, not by its name."""
        return digest([self.source.anywhere, self.layout, self.settings, self.recording])[:16]

    @cached_property
    def traffic_key(self) -> str:
        """A short text that identifies the road users, whatever sees them in whichever light."""
        of = {key: self.settings[key] for key in ("mix", "traffic", "seed")}
        return digest([place_of(self.source), self.source.content, of, self.density])[:16]

    @property
    def density(self) -> Any:
        """The number of road users that was asked for, also where it has a name."""
        return DENSITIES.get(self.settings["density"], self.settings["density"])

    @property
    def kind(self) -> str:
        """The kind of intersection: the tag ``kind``, or else the name of the scene."""
        return self.tags.get("kind", self.source.name)

    @property
    def appearance_seed(self) -> int:
        """The seed of the road users' shapes and colours: the same for every layout and light."""
        return _seed(self.traffic_key)


@dataclass(frozen=True)
class Generation:
    """A data set to be generated: its scenarios, in order, and ``notes`` for the user.

    >>> from pathlib import Path
    >>> text = "{scenes: [{built_in: four_way}], layouts: [L-d1], settings: {seconds: 2}}"
    >>> _ = Path("set.yaml").write_text(text)
    >>> plan = dataset.load_generation("set.yaml")
    >>> plan.frames, [scenario.name for scenario in plan.scenarios]
    (20, ['four_way__L-d1__medium__midday__0'])
    """

    name: str
    scenarios: tuple[ScenarioPlan, ...]
    backend: str = DEFAULT_BACKEND
    notes: tuple[str, ...] = ()
    format: str = DEFAULT_FORMAT

    @property
    def frames(self) -> int:
        """Number of frames of all scenarios together."""
        return sum(plan.frames for plan in self.scenarios)

    @property
    def splits(self) -> dict[str, tuple[ScenarioPlan, ...]]:
        """The scenarios of each of the usual splits, perhaps none."""
        plans = self.scenarios
        return {split: tuple(plan for plan in plans if plan.split == split) for split in SPLITS}


class Settings(WorldSettings):
    """The section ``settings`` of the file."""

    light: Several[str] = Field(default=[])
    weather: Several[str] = Field(default=[])
    seconds: Several[Length] = Field(default=[])


class _SceneEntry(sources.SceneEntry, WorldSettings):
    pass


class RecordingEntry(Strict):
    """Keys that concern the recording and, the last four, :class:`FileOptions`."""

    rate_hz: Annotated[float, Field(gt=0, le=1000)] = 10.0
    # Beside pictures.
    layers: list[Literal["depth", "instance", "semantic"]] = Field(default=[])
    # Width and height of all pictures, if not the cameras' own.
    image_size: Annotated[list[int], Field(min_length=2, max_length=2)] | None = None
    # How long a LiDAR's turn takes; 0: all rays at once.
    lidar_turn_s: Annotated[float, Field(ge=0, le=1)] = TURN
    format: str = DEFAULT_FORMAT
    pictures: str = DEFAULT_OPTIONS.pictures
    cameras_per_agent: int = DEFAULT_OPTIONS.cameras_per_agent
    infra_set_names: bool = DEFAULT_OPTIONS.infra_set_names
    visibility_maps: bool = DEFAULT_OPTIONS.visibility_maps

    def recording(self, where: str) -> Recording:
        """The settings of the recording. Raises InspeError where a value is not allowed."""
        check_known(self.format, FORMATS, f"{where}: format:")
        settings.check_names([str(layer) for layer in self.layers], f"{where}: layers")
        size = (self.image_size[0], self.image_size[1]) if self.image_size else None
        turn, layers = self.lidar_turn_s, tuple(self.layers)
        found = Recording(self.rate_hz, layers, turn=turn, image_size=size)
        with error_at(where):
            found.check()
        return found

    def files(self, where: str) -> FileOptions:
        """How files are written. Raises InspeError where a value is out of range."""
        options = FileOptions(**{f.name: getattr(self, f.name) for f in fields(FileOptions)})
        options.check(where)
        return options


class _File(sources.Sources, RecordingEntry):
    scenes: Annotated[list[_SceneEntry], Field(min_length=1)]
    settings: Settings = Settings()
    splits: dict[Literal["train", "validate", "test"], Annotated[float, Field(ge=0)]] = Field(
        default=PROPORTIONS
    )
    split_by: Literal["scene", "intersection", "scenario"] = "scene"


def make_generation(
    content: Mapping[str, Any], folder: Path, where: str = "study", name: str = "study"
) -> Generation:
    """The plan of a data set, from the content of the file ``where`` in ``folder``; ``name`` is its
    name if it gives none. Raises InspeError that names the file, the key and what is allowed."""
    entry = check_model(_File, content, where)
    recording, files = entry.recording(where), entry.files(where)
    whole = {key: getattr(entry.settings, key) for key in SETTINGS}
    settings.check_settings(whole, f"{where}: settings")
    for seconds in whole["seconds"]:
        check_seconds(seconds, recording.rate, f"{where}: settings.seconds")
    each: Mapping[Any, float] = entry.splits
    proportions = [each.get(split, 0) for split in SPLITS]
    if not sum(proportions):
        raise InspeError(f"{where}: splits: one of {', '.join(SPLITS)} must be above 0")
    layouts = sources.layout_sources(entry, folder, where)
    defaults = settings.defaults_of((*WORLD, *CONDITIONS)) | {"seconds": [SECONDS]}
    plans: dict[str, ScenarioPlan] = {}
    for at, item, source, own in sources.each_scene(entry.scenes, WORLD, whole, folder, where):
        if source.file is not None:
            own["seconds"] = saved_seconds(source, own["seconds"], recording.rate, at)
        builds = settings.combinations(own, (*WORLD, "seconds"), defaults)
        around = settings.combinations(own, CONDITIONS, defaults)
        for build, layout, rest in product(builds, layouts, around):
            values = build | settings.conditioned(rest)
            plan = ScenarioPlan("", "", source, layout, values, recording, 0)
            plans.setdefault(plan.key, replace(plan, tags=dict(item.tags), files=files))
    done = _named([replace(plan, seed=_seed(key)) for key, plan in plans.items()])
    groups = [_group(plan, entry.split_by) for plan in done]
    splits = _split(dict(groups), proportions)
    grouped = zip(groups, done, strict=True)
    scenarios = tuple(replace(plan, split=splits[group]) for (group, _), plan in grouped)
    given = [split for split, share in zip(SPLITS, proportions, strict=True) if share]
    advice = "scenes" if entry.split_by == "intersection" else "values of seed"
    notes = tuple(
        f"{split} is empty: {counted(len(splits), entry.split_by)} for {len(given)} splits; give "
        f"more {advice}, or another split_by"
        for split in given
        if split not in splits.values()
    )
    return Generation(entry.name or name, scenarios, notes=notes, format=entry.format)


def check_seconds(seconds: float, rate: float, where: str) -> None:
    """Raise InspeError if so many seconds have no whole number of frames, or too many."""
    frames = seconds * rate
    if abs(frames - round(frames)) > 1e-6 * frames or not 1 <= round(frames) <= MOST_FRAMES:
        raise InspeError(
            f"{where}: {seconds:g} s are {frames:g} frames at {rate:g} Hz: must be a whole number, "
            f"1 to {MOST_FRAMES}"
        )


def saved_seconds(
    source: sources.SceneSource, wanted: Sequence[float], rate: float, where: str
) -> list[float]:
    """Lengths of the scenarios of a saved scene [s]. Raises InspeError if it has other frames."""
    from inspe_jax.scene.scene import load_scene

    traffic = load_scene(str(source.file)).traffic
    step = float(traffic.time[1] - traffic.time[0]) if traffic.frame_count > 1 else 1 / rate
    if not math.isclose(step, 1 / rate, rel_tol=1e-5):
        raise InspeError(
            f"{where}: {source.file} has frames {step:g} s apart, but rate_hz {rate:g} needs "
            f"{1 / rate:g} s: build the scene with this step, or set rate_hz: {1 / step:g}"
        )
    for seconds in wanted:
        if round(seconds * rate) > traffic.frame_count:
            raise InspeError(
                f"{where}: {source.file} has {traffic.frame_count} frames, but {seconds:g} s at "
                f"{rate:g} Hz are {round(seconds * rate)}"
            )
    return list(wanted) or [traffic.frame_count / rate]


def _seed(key: str) -> int:
    return int(key[:8], 16) >> 1  # a seed is below 2³¹


def _named(plans: list[ScenarioPlan]) -> list[ScenarioPlan]:
    """The same plans with names that say what varies, and that are valid names of folders."""
    varied: dict[tuple[str, str], set[Any]] = defaultdict(set)
    for plan in plans:
        for key in ("radius", "voxel", "mix", "traffic", "statics", "terrain", "seconds"):
            varied[plan.source.name, key].add(plan.settings[key])
    names = []
    for plan in plans:
        given = plan.settings
        parts = [plan.source.name, plan.layout.name, given["density"], given["light"]]
        parts += [given["weather"]] * (given["weather"] != CLEAR)
        more = [key for (name, key), own in varied.items() if name == parts[0] and len(own) > 1]
        parts += [f"{key}-{_word(given[key])}" for key in more]
        names.append("__".join(map(_fit, (*parts, given["seed"])))[:LONGEST_NAME])
    counts = Counter(name.lower() for name in names)  # some disks ignore upper case
    return [
        replace(plan, name=name if counts[name.lower()] == 1 else f"{name}__{plan.key}")
        for plan, name in zip(plans, names, strict=True)
    ]


def _word(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _fit(part: Any) -> str:
    """A part of a name: letters, digits and a few signs; others become ``_``."""
    return re.sub(r"[^A-Za-z0-9.+-]+", "_", str(part)).strip("._") or "_"


@cache
def place_of(source: sources.SceneSource) -> str:
    """Identifies the intersection, whatever its name: a saved one by its regions. A junction by its
    number and by its ``center`` counts as two."""
    if source.file is not None:
        from inspe_jax.scene.scene import load_scene

        place = load_scene(source.file).intersection
        regions = {int(region): polygon for region, polygon in place.regions.items()}
        return digest([np.asarray(place.center), regions])[:16]
    return digest(replace(source.anywhere, name=""))[:16]


def _group(plan: ScenarioPlan, split_by: str) -> tuple[str, tuple[str, ...]]:
    """What a scenario is kept together with in a split, and the kind of that."""
    density = str(plan.density)
    return {
        "intersection": (place_of(plan.source), (plan.kind,)),
        "scene": (plan.traffic_key, (density, plan.kind)),
        "scenario": (plan.key, (density, plan.kind, plan.conditions.light)),
    }[split_by]


def _split(kinds: Mapping[str, tuple[str, ...]], proportions: Sequence[float]) -> dict[str, str]:
    """The split of each key of ``kinds``, which maps keys to their kinds, coarse to fine. Keys are
    sorted by hashes of kinds, then their own, and every stretch is divided in proportion."""
    total, count = sum(proportions), len(kinds)
    exact = [proportion * count / total for proportion in proportions]
    quota = [math.floor(value + 1e-9) for value in exact]
    rest = sorted(range(len(quota)), key=lambda s: (round(quota[s] - exact[s], 9), quota[s]))
    for s in rest[: count - sum(quota)]:
        quota[s] += 1
    found, dealt = {}, [0] * len(quota)
    place = {
        key: [*(_hash(*kind[: k + 1]) for k in range(len(kind))), _hash(key)]
        for key, kind in kinds.items()
    }
    for n, key in enumerate(sorted(kinds, key=place.__getitem__), 1):
        left = [s for s in range(len(quota)) if dealt[s] < quota[s]]
        s = max(left, key=lambda s: quota[s] * n / count - dealt[s])
        dealt[s] += 1
        found[key] = SPLITS[s]
    return found


def _hash(*words: str) -> str:
    return hashlib.sha256("\n".join(words).encode()).hexdigest()
