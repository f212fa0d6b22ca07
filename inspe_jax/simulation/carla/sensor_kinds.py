"""The table of sensor kinds: which of CARLA's sensors record each, and what becomes of their data.

To add a kind, add a row to :data:`SENSOR_KINDS`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from inspe_jax.core.errors import InspeError
from inspe_jax.sensing.layout import Layout
from inspe_jax.simulation.carla.instances import instances_of
from inspe_jax.simulation.carla.sensors import (
    camera_attributes,
    camera_note,
    colours_of,
    depth_of,
    intrinsic_of,
    lidar_attributes,
    lidar_note,
    numbers_of,
    points_of,
    tags_of,
)
from inspe_jax.simulation.frame import Image, RoadUserBox, Scan
from inspe_jax.simulation.lidar_noise import apply_noise
from inspe_jax.simulation.recorder import Recording

LIDAR = "sensor.lidar.ray_cast"
PICTURES: dict[str, str] = {
    "rgb": "sensor.camera.rgb",
    "depth": "sensor.camera.depth",
    "instance": "sensor.camera.instance_segmentation",
    "semantic": "sensor.camera.semantic_segmentation",
}
"""CARLA's sensor for each kind of picture."""
NEEDS: dict[str, tuple[str, ...]] = {
    "depth": ("depth",),
    "instance": ("instance", "depth"),
    "semantic": ("semantic",),
}
"""The pictures that each layer is made of. Instances are matched to road users by their place."""


@dataclass(frozen=True)
class Measured:
    """What one sensor of a layout measured in one frame.

    ``data`` holds the measurements of CARLA's sensors, by the keys of
    :attr:`CarlaSensorKind.blueprints`; ``boxes`` are the road users of the frame; ``rng`` is for
    the sensor's noise.
    """

    spec: Any
    pose: Float[np.ndarray, "6"]
    recording: Recording
    data: Mapping[str, Any]
    boxes: tuple[RoadUserBox, ...]
    rng: np.random.Generator


@dataclass(frozen=True)
class CarlaSensorKind:
    """How CARLA records a kind of sensor.

    ``blueprints(recording)`` names CARLA's sensors, by keys of one's own;
    ``attributes(spec, recording)`` gives their attributes; ``note(spec)`` says what CARLA cannot
    record as the spec has it, empty if it can record everything; ``result(measured)`` is the
    image or the scan.
    """

    blueprints: Callable[[Recording], dict[str, str]]
    attributes: Callable[[Any, Recording], dict[str, str]]
    note: Callable[[Any], str]
    result: Callable[[Measured], Image | Scan]


def _pictures(recording: Recording) -> dict[str, str]:
    needed = [picture for layer in recording.layers for picture in NEEDS[layer]]
    return {picture: PICTURES[picture] for picture in dict.fromkeys(("rgb", *needed))}


def _image(measured: Measured) -> Image:
    data, pose, layers = measured.data, measured.pose, dict[str, Any]()
    intrinsic = intrinsic_of(measured.spec, measured.recording)
    if "depth" in data:
        layers["depth"] = depth_of(data["depth"])
    if "instance" in data:
        tags, numbers = tags_of(data["instance"]), numbers_of(data["instance"])
        layers["instance"] = instances_of(
            tags, numbers, layers["depth"], pose, intrinsic, measured.boxes
        )
    if "semantic" in data:
        layers["semantic"] = tags_of(data["semantic"])
    wanted = {name: layers[name] for name in measured.recording.layers}
    return Image(pose, intrinsic, colours_of(data["rgb"]), **wanted)


def _scan(measured: Measured) -> Scan:
    directions, distances = points_of(measured.data["points"])
    noise = measured.recording.noise
    points, _ = apply_noise(directions, distances, noise, measured.rng)
    return Scan(measured.pose, points)


SENSOR_KINDS: dict[str, CarlaSensorKind] = {
    "camera": CarlaSensorKind(_pictures, camera_attributes, camera_note, _image),
    "lidar": CarlaSensorKind(lambda _: {"points": LIDAR}, lidar_attributes, lidar_note, _scan),
}
"""By the ``kind`` of a spec."""


def sensor_kind(spec: Any) -> CarlaSensorKind:
    """The row of a spec. Raises InspeError for a kind that is not in :data:`SENSOR_KINDS`."""
    if spec.kind not in SENSOR_KINDS:
        raise InspeError(
            f"{spec.name}: backend carla cannot simulate a sensor of kind '{spec.kind}', only "
            f"{' and '.join(SENSOR_KINDS)}"
        )
    return SENSOR_KINDS[spec.kind]


def notes_of(layout: Layout, recording: Recording | None = None) -> tuple[str, ...]:
    """What CARLA cannot record as it is asked for: at most one line per device, and one of turns
    that take time."""
    specs = dict.fromkeys(sensor.spec for sensor in layout.sensors)
    notes = [sensor_kind(spec).note(spec) for spec in specs]
    turns = recording is not None and recording.turn > 0
    if turns and any(spec.kind == "lidar" for spec in specs):
        notes.append("CARLA fires all rays of a LiDAR's turn at once: lidar_turn_s is 0")
    return tuple(note for note in notes if note)
