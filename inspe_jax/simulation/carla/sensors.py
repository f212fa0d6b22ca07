"""CARLA's sensors for each kind of sensor, and what becomes of their data; notes say what CARLA
leaves out. To add a kind, add a row to :data:`SENSOR_KINDS`."""

import queue
import time
from collections.abc import Callable, Mapping
from typing import Any, Protocol, TypeAlias

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy.random import Generator

from inspe_jax.core.carla_frame import flip
from inspe_jax.core.errors import InspeError
from inspe_jax.core.geometry import rotation
from inspe_jax.sensing.sensors import CameraSpec, LidarSpec
from inspe_jax.sensing.signals import ATTENUATION
from inspe_jax.simulation.frame import Boxes, Image, Picture, Pose6, Scan
from inspe_jax.simulation.recorder import Recording, apply_noise

FAR = 1000.0  # the largest depth that CARLA's depth camera can tell [m]
EVEN = np.radians(0.02)
"""Channels that are this close to evenly spaced ones count as even [rad]: tables are rounded."""
NEEDS: dict[str, tuple[str, ...]] = {
    "depth": ("depth",),
    "instance": ("semantic_segmentation", "depth"),
    "semantic": ("semantic_segmentation",),
}
"""CARLA's pictures that each layer is made of; instances are matched to road users by place."""
ROAD_USER_LABELS = (12, 13, 14, 15, 16, 18, 19)
"""CARLA's labels (from 0.9.14 on) of people, riders, cars, trucks, buses, motorcycles, bicycles."""
SQUARE = 0.005  # focal lengths that differ by less count as one
MARGIN = 0.3  # mirrors and limbs may reach this far out of a box [m]

Measured: TypeAlias = Mapping[str, Any]
"""What sensors of CARLA have measured, by the name of their blueprint."""


class CarlaSensor(Protocol):
    """CARLA's sensors (``blueprints``, with ``attributes``) that record one; notes say what not."""

    blueprints: tuple[str, ...]
    attributes: dict[str, str]
    notes: tuple[str, ...]

    def record(self, pose: Pose6, data: Measured, boxes: Boxes, rng: Generator) -> Image | Scan:
        """The image or the scan of a frame with these ``boxes``; ``rng`` is for the noise."""


class CarlaCamera:
    """A camera, and a camera of CARLA for each picture that its layers are made of."""

    def __init__(self, spec: CameraSpec, recording: Recording) -> None:
        width, height = recording.image_size or (spec.width, spec.height)
        if abs(height - spec.height * width / spec.width) > 1:
            raise InspeError(
                f"image_size [{width}, {height}]: CARLA's pixels are square, and {spec.name} has "
                f"{spec.width} x {spec.height} of them: give a size of the same shape"
            )
        if spec.bends:
            raise InspeError(
                f"{spec.name}: CARLA's cameras are pinholes here, and its own parameters of a lens "
                "are not OpenCV's: record with the backend embedded, or give a device without "
                "'lens', 'distortion' and 'image_circle_deg'"
            )
        if abs(spec.focals[1] / spec.focal - 1) > SQUARE:
            raise InspeError(
                f"{spec.name}: its pixels are not square, {spec.focal:g} and {spec.focals[1]:g} px "
                "of focal length, and CARLA's are: give a device with one focal length"
            )
        self.layers = recording.layers
        needed = ["rgb", *(picture for layer in self.layers for picture in NEEDS[layer])]
        self.blueprints = tuple(f"sensor.camera.{picture}" for picture in dict.fromkeys(needed))
        across = 2 * np.degrees(np.arctan(spec.width / 2 / spec.focal))
        size = {"image_size_x": str(width), "image_size_y": str(height)}
        self.attributes = {**size, "fov": repr(float(across))}
        focal = spec.focal * width / spec.width
        self.intrinsic = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
        self.notes: tuple[str, ...] = ()
        if np.abs(np.subtract(spec.principal, (spec.width / 2, spec.height / 2))).max() > 1:
            self.notes = (
                f"{spec.name}: CARLA's principal point is the middle of the picture, not "
                f"({spec.principal[0]:g}, {spec.principal[1]:g})",
            )

    def record(self, pose: Pose6, data: Measured, boxes: Boxes, rng: Generator) -> Image:
        """The picture and its layers."""
        pictures = {name.rpartition(".")[2]: _colours(image) for name, image in data.items()}
        layers: dict[str, np.ndarray] = {}
        if "depth" in pictures:
            red, green, blue = np.moveaxis(pictures["depth"].astype(np.int64), -1, 0)
            code = red + 256 * green + 65536 * blue
            depth = np.where(code >= 2**24 - 1, np.inf, code * (FAR / (2**24 - 1)))
            layers["depth"] = depth.astype(np.float32)
        if "semantic_segmentation" in pictures:
            layers["semantic"] = pictures["semantic_segmentation"][..., 0].copy()
        if "instance" in self.layers:
            given = layers["semantic"], layers["depth"], pose, self.intrinsic
            layers["instance"] = instances_of(*given, boxes)
        wanted: dict[str, Any] = {name: layers[name] for name in self.layers}
        return Image(pose, self.intrinsic, pictures["rgb"], **wanted)


class CarlaLidar:
    """A LiDAR: one turn per frame. Losses are added afterwards: CARLA's own would not repeat."""

    blueprints: tuple[str, ...] = ("sensor.lidar.ray_cast",)

    def __init__(self, spec: LidarSpec, recording: Recording) -> None:
        self.noise = recording.noise
        table = np.array(spec.elevations)
        low, high = np.degrees([table.min(), table.max()]).tolist()
        self.attributes = {
            "channels": str(len(table)),
            "range": repr(float(spec.reach)),
            "points_per_second": str(round(spec.azimuth_count * len(table) * recording.rate)),
            "rotation_frequency": repr(float(recording.rate)),
            "upper_fov": repr(high),
            "lower_fov": repr(low),
            "horizontal_fov": repr(min(float(np.degrees(spec.azimuth_fov)), 360.0)),
            "atmosphere_attenuation_rate": repr(ATTENUATION),
            "dropoff_general_rate": "0.0",
            "dropoff_zero_intensity": "0.0",
            "noise_stddev": "0.0",
        }
        self.notes: tuple[str, ...] = ()
        off = np.abs(table - np.linspace(table[0], table[-1], len(table))).max()
        if off > EVEN:
            self.notes += (
                f"{spec.name}: CARLA's channels are evenly spaced: {len(table)} from {low:g}° "
                f"to {high:g}°, up to {np.degrees(off):.1f}° off the device's own",
            )
        if recording.turn > 0:
            self.notes += ("CARLA fires all rays of a LiDAR's turn at once: lidar_turn_s is 0",)

    def record(self, pose: Pose6, data: Measured, boxes: Boxes, rng: Generator) -> Scan:
        """The points that are not lost."""
        (scan,) = data.values()
        points = flip(np.frombuffer(scan.raw_data, np.float32).reshape(-1, 4)[:, :3]).astype(float)
        distance = np.linalg.norm(points, axis=1)
        directions = points / np.maximum(distance, 1e-9)[:, None]
        return Scan(pose, apply_noise(directions, distance, self.noise, rng)[0])


SENSOR_KINDS: dict[str, Callable[[Any, Recording], CarlaSensor]] = {
    "camera": CarlaCamera,
    "lidar": CarlaLidar,
}
"""By the ``kind`` of a spec: called with the spec and the recording."""


class SensorQueue:
    """The measurements of one of CARLA's sensors, frame by frame; ``name`` is for errors."""

    def __init__(self, sensor: Any, name: str) -> None:
        self.name = name
        self._queue: queue.SimpleQueue[Any] = queue.SimpleQueue()
        sensor.listen(self._queue.put)

    def take(self, frame: int, until: float) -> Any:
        """The measurement of a frame; None if it has not come by ``until`` (monotonic [s])."""
        try:
            while True:
                found = self._queue.get(timeout=max(until - time.monotonic(), 1e-3))
                if found.frame >= frame:
                    return found if found.frame == frame else None
        except queue.Empty:
            return None


def _colours(image: Any) -> Picture:
    """Red, green and blue of a picture, which CARLA stores as blue, green, red and alpha."""
    bgra = np.frombuffer(image.raw_data, np.uint8).reshape(image.height, image.width, 4)
    return np.ascontiguousarray(bgra[..., 2::-1])


def instances_of(
    semantic: UInt8[np.ndarray, "H W"],
    depth: Float[np.ndarray, "H W"],
    pose: Pose6,
    intrinsic: Float[np.ndarray, "3 3"],
    boxes: Boxes,
) -> Int[np.ndarray, "H W"]:
    """Track + 1 of each pixel: that of the box nearest to its point; 0: no road user."""
    found = np.zeros(depth.shape, np.int32)
    rows, columns = np.nonzero(np.isin(semantic, ROAD_USER_LABELS) & np.isfinite(depth))
    away = depth[rows, columns].astype(float)
    (fx, _, cx), (_, fy, cy), _ = intrinsic
    left, up = (cx - columns - 0.5) / fx, (cy - rows - 0.5) / fy
    body = np.stack([away, away * left, away * up], -1)
    points = body @ rotation(pose[3:], np).T + pose[:3]
    least = np.full(len(points), MARGIN)
    for box in boxes:
        local = (points - box.center) @ rotation(np.array([0.0, 0.0, box.yaw]), np)
        out = (np.abs(local) - box.size / 2).max(1)
        nearer = out < least
        least[nearer], found[rows[nearer], columns[nearer]] = out[nearer], box.track + 1
    return found
