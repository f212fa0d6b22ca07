"""A study: every layout on every scene in every setting, as a list of jobs. Read from YAML.

The form of the file. Paths are relative to it; every setting is one value or a list of values::

    scenes:
      - built_in: four_way
      - map: Town05.xodr             # OpenDRIVE; or SUMO's .net.xml, or .osm
        junction: 53                 # or center: [x, y]
        radius: 60                   # a scene's own settings replace those of the study
        tags: {kind: four-way}       # become columns of the results; a note does not
      - file: saved.npz              # keeps the settings that it was built with
    layouts:
      - Cam-d1                       # a strategy
      - layout.yaml
      - {strategy: L-d2, lidar: paper-lidar-32, name: L-d2 with 32 beams}
      - mix: {hesai-xt32: 2, far: 4} # as many of each, at corners and roadsides
    devices:                         # your own devices, with the keys of the catalogue
      far: {like: paper-camera, depth_m: 60}
    settings:
      density: [low, medium, high]   # for scenes: profile, radius, voxel, spacing, density, frames,
                                     #   step, mix, traffic (waypoints or sumo), seed,
                                     #   statics (none, map or street), terrain (none or ground)
      light: [midday, night]         # for sensors: light, weather
      weights:                       # for scores: weights, occlusion_reference, visibility
        - {coverage: 0.3, occlusion: 0.7}
      method: [none, greedy-adam]    # score the layout, or search first: method, seconds,
      seconds: 30                    #   evaluations, search_seed
    metrics: [detectability]         # columns besides C, O, IG and the metrics with weight
    detection: mine.toml             # curves of detectability, in place of the usual ones
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from inspe_jax.core.digest import digest
from inspe_jax.core.errors import check_known, error_at
from inspe_jax.core.files import check_model
from inspe_jax.jobs import settings, sources
from inspe_jax.jobs.settings import Count, Length, Several, Text, WorldSettings
from inspe_jax.placement.optimise import DEFAULT_SECONDS, METHODS
from inspe_jax.placement.run import check_budget, check_seed
from inspe_jax.scene.profiles import DEFAULT_PROFILE, profile_of
from inspe_jax.scoring import metrics
from inspe_jax.scoring.detection import DetectionCurves, detection_curves, load_detection
from inspe_jax.scoring.evaluate import check_options

SCORE_ONLY = "none"  # the method that scores a layout as it is, without a search
BUILD_SETTINGS = (
    *("profile", "radius", "voxel", "spacing", "density", "frames", "step", "mix", "traffic"),
    *("seed", "statics", "terrain"),
)
"""Settings that a scene is built with."""
SCORE_SETTINGS = ("weights", "occlusion_reference", "visibility")
SEARCH_SETTINGS = ("method", "seconds", "evaluations", "search_seed")
SETTINGS = (*BUILD_SETTINGS, *settings.CONDITIONS, *SCORE_SETTINGS, *SEARCH_SETTINGS)


@dataclass(frozen=True)
class StudyJob:
    """One layout on one scene in one setting; ``settings`` has every key of :data:`SETTINGS`.
    ``metrics`` are computed: the usual ones, those the study asks for, and those with weight in
    some job. ``detection`` has the curves of detectability, None for the usual ones."""

    source: sources.SceneSource
    layout: sources.LayoutSource
    settings: Mapping[str, Any]
    tags: Mapping[str, str] = field(default_factory=dict)
    metrics: tuple[str, ...] = ()
    detection: DetectionCurves | None = None

    @cached_property
    def key(self) -> str:
        """A short text that identifies the job: a digest of all that its result depends on."""
        curves = () if self.detection is None else (self.detection,)
        return digest([self.source.anywhere, self.layout, self.settings, *curves])[:16]

    @property
    def build(self) -> dict[str, Any]:
        """Settings that its scene is built with."""
        return {key: self.settings[key] for key in BUILD_SETTINGS}

    @cached_property
    def scene(self) -> str:
        """A short text that identifies its scene."""
        return digest([self.source.anywhere, self.build])[:16]


@dataclass(frozen=True)
class Study:
    """The jobs of a study, in the order of the results, and the study's name."""

    name: str
    jobs: tuple[StudyJob, ...]

    @cached_property
    def tags(self) -> tuple[str, ...]:
        """Every tag that a scene has."""
        return tuple(dict.fromkeys(tag for job in self.jobs for tag in job.tags))

    @cached_property
    def metrics(self) -> tuple[str, ...]:
        """Every metric that a job computes."""
        return tuple(dict.fromkeys(name for job in self.jobs for name in job.metrics))


# ── The file ────────────────────────────────────────────────────────────────


class _Build(WorldSettings):
    profile: Several[str] = Field(default=[])
    spacing: Several[Length] = Field(default=[])
    frames: Several[Annotated[int, Field(ge=1)]] = Field(default=[])
    step: Several[Length] = Field(default=[])


class _Settings(_Build):
    light: Several[str] = Field(default=[])
    weather: Several[str] = Field(default=[])
    weights: Several[dict[str, float]] = Field(default=[])
    occlusion_reference: Several[str] = Field(default=[])
    visibility: Several[str] = Field(default=[])
    method: Several[str] = Field(default=[])
    seconds: Several[Length] = Field(default=[])
    evaluations: Several[Length] = Field(default=[])
    search_seed: Several[Count] = Field(default=[])


class _SceneEntry(sources.SceneEntry, _Build):
    pass


class _StudyFile(sources.Sources):
    scenes: Annotated[list[_SceneEntry], Field(min_length=1)]
    settings: _Settings = _Settings()
    metrics: list[str] = Field(default=[])
    detection: Text | None = None


_CHECKS = settings.CHECKS | {
    "weights": metrics.weights_of,
    "occlusion_reference": lambda value: check_options(None, value, "in_view"),
    "visibility": lambda value: check_options(None, "roi", value),
    "method": lambda value: check_known(value, (SCORE_ONLY, *METHODS), ""),
    "seconds": lambda value: check_budget(value, None),
    "evaluations": lambda value: check_budget(None, value),
    "search_seed": check_seed,
}


def load_study(path: str | os.PathLike[str]) -> Study:
    r"""Read a study file; its form is in this module's docstring. Raises InspeError that names the
    file, the key and what is allowed.

    >>> from pathlib import Path
    >>> text = "{scenes: [{built_in: four_way}], layouts: [Cam-d1, L-d1]}"
    >>> _ = Path("study.yaml").write_text(text)
    >>> len(inspe_jax.load_study("study.yaml").jobs)
    2
    """
    path = Path(path)
    return make_study(sources.read_study(path), path.parent, str(path), path.stem)


def make_study(
    content: Mapping[str, Any], folder: Path, where: str = "study", name: str = "study"
) -> Study:
    """A study from the content of a study file; its paths are relative to ``folder``."""
    entry = check_model(_StudyFile, content, where)
    whole = {key: getattr(entry.settings, key) for key in SETTINGS}
    settings.check_settings(whole, f"{where}: settings", _CHECKS)
    weights = [metrics.weights_of(given) for given in entry.settings.weights]
    with error_at(f"{where}: metrics"):
        most = {name: max(row[name] for row in weights) for name in metrics.METRICS if weights}
        found = metrics.chosen(entry.metrics, most)
    curves = None
    if entry.detection is not None:
        with error_at(f"{where}: detection"):
            own = load_detection(folder / entry.detection)
        curves = None if own == detection_curves() else own
    layouts = sources.layout_sources(entry, folder, where)
    jobs: dict[str, StudyJob] = {}
    scenes = sources.each_scene(entry.scenes, BUILD_SETTINGS, whole, folder, where)
    for _, item, source, given in scenes:
        for profile in given["profile"] or [DEFAULT_PROFILE]:
            of = given | dict(profile=[profile])
            defaults = _defaults(profile, sized=bool(given["voxel"]))
            builds = settings.combinations(of, BUILD_SETTINGS, defaults)
            rests = settings.combinations(of, SETTINGS[len(BUILD_SETTINGS) :], defaults)
            for build, layout, rest in product(builds, layouts, rests):
                values = build | _completed(settings.conditioned(rest))
                job = StudyJob(source, layout, values, dict(item.tags), found, curves)
                jobs.setdefault(job.key, job)
    return Study(entry.name or name, tuple(jobs.values()))


def _defaults(profile: str, sized: bool) -> dict[str, list[Any]]:
    """The values of settings that are not given, by the profile; no spacing if ``sized``."""
    own = profile_of(profile)
    rest: dict[str, Any] = dict.fromkeys((*SCORE_SETTINGS, *SEARCH_SETTINGS))
    rest |= dict(occlusion_reference=own.occlusion_reference, visibility=own.visibility)
    rest |= dict(method=SCORE_ONLY, search_seed=0) | (dict(spacing=None) if sized else {})
    usual = settings.defaults_of((*BUILD_SETTINGS, *settings.CONDITIONS), profile)
    return usual | {key: [value] for key, value in rest.items()}


def _completed(given: dict[str, Any]) -> dict[str, Any]:
    """Settings with the weights above 0, and without a budget where nothing is searched."""
    by_name = metrics.weights_of(given["weights"])
    given = given | dict(weights={name: value for name, value in by_name.items() if value})
    if given["method"] == SCORE_ONLY:
        return given | dict(seconds=None, evaluations=None, search_seed=None)
    if given["seconds"] is None and given["evaluations"] is None:
        return given | dict(seconds=DEFAULT_SECONDS)
    return given
