"""What a data set would hold, how large it would be and how long it would take: before it is made.

Every scene is built, so that road users are counted. Of every device one frame is recorded in each
light and weather that it meets, on this machine; sizes and times of the set are sums of these.
"""

import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from inspe_jax.dataset.chunk import layout_of
from inspe_jax.dataset.formats.registry import FORMATS
from inspe_jax.dataset.manifest import record_frame
from inspe_jax.dataset.plan import Generation, ScenarioPlan
from inspe_jax.dataset.points_in_boxes import counted
from inspe_jax.scene.scene import Scene
from inspe_jax.scene.traffic.frames import CLASSES
from inspe_jax.sensing.layout import Layout, Sensor, make_layout
from inspe_jax.simulation.backends import BACKENDS, recorder_of
from inspe_jax.study.work import scene_of

HEAD = ".yaml"
"""Suffix of the files that a station has once, however many sensors it has."""


@dataclass
class SplitContent:
    """What a split would hold.

    ``densities`` and ``kinds`` are the numbers of its scenarios by density of the traffic and by
    kind of intersection; ``boxes`` is the number of road users of each class, each counted once a
    frame.
    """

    scenes: set[str] = field(default_factory=set)
    scenarios: int = 0
    frames: int = 0
    densities: Counter[str] = field(default_factory=Counter)
    kinds: Counter[str] = field(default_factory=Counter)
    boxes: Counter[str] = field(default_factory=Counter)


@dataclass(frozen=True)
class Sample:
    """What one sensor takes: seconds until its first frame, and seconds and bytes a frame; ``head``
    are the bytes a frame that its station takes, however many sensors it has."""

    setup: float
    frame: float
    size: int
    head: int


@dataclass(frozen=True)
class Estimate:
    """What a data set would hold and take.

    ``size`` [bytes] and ``seconds`` of one process are None where the backend cannot be tried
    without its server. ``shortfalls`` say what scenes have less of than was asked for, each with
    the number of scenarios.
    """

    splits: Mapping[str, SplitContent]
    size: float | None
    seconds: float | None
    shortfalls: Counter[str]


def estimate(
    generation: Generation,
    backend: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Estimate:
    """Build the scenes of a data set and try its sensors; nothing is left on disk.

    ``progress`` is called with the number of scenarios done and of all. Raises InspeError as
    generating does.
    """
    backend = backend or generation.backend
    tried = None if BACKENDS[backend].remote else dict[Any, Sample]()
    splits = {split: SplitContent() for split in generation.splits}
    by_scene: dict[str, list[ScenarioPlan]] = {}
    for plan in generation.scenarios:
        by_scene.setdefault(plan.scene, []).append(plan)
    shortfalls: Counter[str] = Counter()
    size = seconds = 0.0
    done = 0
    for plans in by_scene.values():
        began = time.perf_counter()
        scene = scene_of(plans[0].source, plans[0].build)
        seconds += time.perf_counter() - began
        boxes = _boxes(scene)
        if scene.shortfall:
            where = f"{plans[0].source.name}, {plans[0].settings['density']}"
            shortfalls[f"{where}: road users: {scene.shortfall}"] += len(plans)
        for plan in plans:
            _count(splits[plan.split], plan, boxes)
            if tried is not None:
                layout, _ = layout_of(plan, scene)
                one, other = _cost(generation, plan, scene, layout, tried)
                size, seconds = size + one, seconds + other
            done += 1
            if progress:
                progress(done, len(generation.scenarios))
    if tried is None:
        return Estimate(splits, None, None, shortfalls)
    return Estimate(splits, size, seconds, shortfalls)


def _boxes(scene: Scene) -> Counter[str]:
    """The number of boxes of each class in all frames of a scene."""
    kinds = scene.traffic.kind[scene.traffic.valid]
    return Counter(dict(zip(CLASSES, np.bincount(kinds, minlength=len(CLASSES)), strict=True)))


def _count(content: SplitContent, plan: ScenarioPlan, boxes: Counter[str]) -> None:
    content.scenes.add(plan.traffic)
    content.scenarios += 1
    content.frames += plan.frames
    content.densities[str(plan.settings["density"])] += 1
    content.kinds[plan.kind] += 1
    content.boxes.update(boxes)


def _cost(
    generation: Generation,
    plan: ScenarioPlan,
    scene: Scene,
    layout: Layout,
    tried: dict[Any, Sample],
) -> tuple[float, float]:
    """Bytes and seconds that a scenario takes."""
    samples = []
    for sensor, pose in zip(layout.sensors, np.asarray(layout.poses), strict=True):
        weather = plan.conditions.weather, plan.conditions.intensity
        light = plan.conditions.light if sensor.spec.kind == "camera" else ""
        key = sensor.spec, light, weather, plan.settings["density"]
        if key not in tried:
            tried[key] = _try(generation, plan, scene, layout, sensor, pose)
        samples.append(tried[key])
    world = min(sample.setup for sample in tried.values())  # what every recorder builds
    setup = world + sum(sample.setup - world for sample in samples)
    seconds = setup + plan.frames * sum(sample.frame for sample in samples)
    head = float(np.mean([sample.head for sample in samples])) * len(layout.units)
    return plan.frames * (sum(sample.size for sample in samples) + head), seconds


def _try(
    generation: Generation,
    plan: ScenarioPlan,
    scene: Scene,
    layout: Layout,
    sensor: Sensor,
    pose: np.ndarray,
) -> Sample:
    """Record a frame with one sensor of a layout alone, in the middle of the scene's time."""
    own = Sensor(sensor.name, sensor.spec, 0)
    alone = make_layout([own], [layout.units[sensor.unit]], pose[None], layout.name)
    began = time.perf_counter()
    given = scene, alone, plan.conditions, plan.recording, plan.seed, None, plan.appearance_seed
    with recorder_of(generation.backend, *given) as recorder, TemporaryDirectory() as folder:
        opened = time.perf_counter()
        frame = counted(recorder.frame(plan.frames // 2))
        files = FORMATS[generation.format].write(Path(folder), frame, plan.files)
        record_frame(Path(folder), frame.number, files)
        ended = time.perf_counter()
        sizes = [(path.suffix == HEAD, path.stat().st_size) for path in files]
    head = sum(size for is_head, size in sizes if is_head)
    return Sample(opened - began, ended - opened, sum(size for _, size in sizes) - head, head)
