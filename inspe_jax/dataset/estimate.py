"""What a data set would hold, its size and how long it would take: every scene is built, and two
frames of every layout are recorded in each light and weather, on the first scene that has it.
"""

import time
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from inspe_jax.dataset.chunk import layout_of, open_recorder
from inspe_jax.dataset.formats.registry import FORMATS
from inspe_jax.dataset.manifest import record_frame
from inspe_jax.dataset.plan import Generation, ScenarioPlan
from inspe_jax.dataset.points_in_boxes import with_counts
from inspe_jax.jobs.sources import scene_of
from inspe_jax.scene.scene import Scene
from inspe_jax.scene.traffic.frames import CLASSES
from inspe_jax.simulation.backends import BACKENDS
from inspe_jax.simulation.embedded.road_users import parked_vehicles


@dataclass(frozen=True)
class Sample:
    """What a layout takes: seconds until its first frame, and seconds and bytes a frame."""

    setup: float
    frame: float
    size: int


@dataclass(frozen=True)
class Estimate:
    """What a data set would hold and take.

    ``boxes`` is the number of road users of each class in each split, each counted once a frame;
    ``size`` [bytes] and ``seconds`` are None where the backend cannot be tried without its server.
    ``shortfalls`` say in how many scenarios there is less of what than was asked for.
    """

    boxes: Mapping[str, Counter[str]]
    size: float | None
    seconds: float | None
    shortfalls: Counter[str]


def estimate(
    generation: Generation,
    backend: str | None = None,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Estimate:
    """Build the scenes of a data set and try its layouts; nothing is left on disk.

    The seconds are those of ``workers`` processes, which share the frames of a scenario, and each
    build its scene and open its recorder. ``progress`` is called with (scenarios done, all). Raises
    InspeError as generating does.
    """
    backend = backend or generation.backend
    tried = None if BACKENDS[backend].remote else dict[Any, Sample]()
    boxes = {split: Counter[str]() for split in generation.splits}
    by_scene = defaultdict[str, list[ScenarioPlan]](list)
    for plan in generation.scenarios:
        by_scene[plan.scene].append(plan)
    shortfalls, size, seconds, done = Counter[str](), 0.0, 0.0, 0
    for plans in by_scene.values():
        began = time.perf_counter()
        scene = scene_of(plans[0].source, plans[0].build)
        built = time.perf_counter() - began
        seconds += built * min(workers, sum(len(plan.chunks) for plan in plans))
        own = _boxes(scene, backend)
        if scene.shortfall:
            where = f"{plans[0].source.name}, {plans[0].settings['density']}"
            shortfalls[f"{where}: road users: {scene.shortfall}"] += len(plans)
        for plan in plans:
            boxes[plan.split].update(own)
            if tried is not None:
                sample = _sample(generation.format, backend, plan, scene, tried)
                size += plan.frames * sample.size
                seconds += plan.frames * sample.frame
                seconds += sample.setup * min(workers, len(plan.chunks))
            done += 1
            if progress:
                progress(done, len(generation.scenarios))
    if tried is None:
        return Estimate(boxes, None, None, shortfalls)
    return Estimate(boxes, size, seconds / workers, shortfalls)


def _boxes(scene: Scene, backend: str) -> Counter[str]:
    """The number of boxes of each class in all frames of a scene, as the backend records it."""
    count = np.bincount(scene.traffic.kind[scene.traffic.valid], minlength=len(CLASSES))
    if BACKENDS[backend].statics:
        parked, _ = parked_vehicles(scene)
        count += scene.traffic.frame_count * np.bincount(parked.kind, minlength=len(CLASSES))
    return Counter(dict(zip(CLASSES, count.tolist(), strict=True)))


def _sample(
    format: str, backend: str, plan: ScenarioPlan, scene: Scene, tried: dict[Any, Sample]
) -> Sample:
    """What a scenario's layout takes, tried where its like was not before."""
    layout, _ = layout_of(plan, scene)
    sees_light = any(sensor.spec.kind == "camera" for sensor in layout.sensors)
    light = plan.conditions.light if sees_light else ""
    key = plan.layout, light, plan.conditions.weather, plan.conditions.intensity
    if key in tried:
        return tried[key]
    began = time.perf_counter()
    with open_recorder(backend, plan, scene, layout) as recorder, TemporaryDirectory() as folder:
        opened = time.perf_counter()
        for t in (0, plan.frames // 2):  # what is done once, is done with the first
            first = time.perf_counter()
            files = FORMATS[format].write(Path(folder), with_counts(recorder.frame(t)), plan.files)
            record_frame(Path(folder), t, files)
        ended = time.perf_counter()
        size = sum(path.stat().st_size for path in files)
    tried[key] = Sample(opened - began, ended - first, size)
    return tried[key]
