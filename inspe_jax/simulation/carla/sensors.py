"""CARLA's sensors: their attributes, the weather, and what their measurements hold.

CARLA's LiDAR has evenly spaced channels and is not affected by weather. The principal point of its
cameras is the middle of the picture. What a spec says beyond that is left out, and a note says so.
"""

import queue
import time
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from inspe_jax.core.carla_frame import flip
from inspe_jax.core.errors import InspeError
from inspe_jax.sensing.conditions import Conditions
from inspe_jax.sensing.lidar_returns import ATTENUATION
from inspe_jax.sensing.sensors import CameraSpec, LidarSpec
from inspe_jax.simulation.embedded.light import light_of
from inspe_jax.simulation.recorder import Recording

FAR = 1000.0
"""The largest depth that CARLA's depth camera can tell [m]."""
EVEN = np.radians(0.02)
"""Channels that are this close to evenly spaced ones count as even [rad]: tables are rounded."""


def lidar_attributes(spec: LidarSpec, recording: Recording) -> dict[str, str]:
    """Attributes of a LiDAR: one turn per frame, all rays of the spec, no losses.

    Random losses are added afterwards, by :mod:`inspe_jax.simulation.lidar_noise`: CARLA's own
    random numbers continue from frame to frame, and a frame should be the same however often it is
    recorded.
    """
    channels = len(spec.elevations)
    return {
        "channels": str(channels),
        "range": repr(float(spec.reach)),
        "points_per_second": str(round(spec.azimuth_count * channels * recording.rate)),
        "rotation_frequency": repr(float(recording.rate)),
        "upper_fov": repr(float(np.degrees(max(spec.elevations)))),
        "lower_fov": repr(float(np.degrees(min(spec.elevations)))),
        "horizontal_fov": repr(min(float(np.degrees(spec.azimuth_fov)), 360.0)),
        "atmosphere_attenuation_rate": repr(ATTENUATION),
        "dropoff_general_rate": "0.0",
        "dropoff_zero_intensity": "0.0",
        "noise_stddev": "0.0",
    }


def camera_attributes(spec: CameraSpec, recording: Recording) -> dict[str, str]:
    """Attributes of a camera: the size of its pictures, and its horizontal field of view.

    Raises InspeError for a size of another shape than the spec's own.
    """
    width, height = recording.picture_size(spec.width, spec.height)
    if abs(height - spec.height * width / spec.width) > 1:
        raise InspeError(
            f"image_size [{width}, {height}]: CARLA's pixels are square, and {spec.name} has "
            f"{spec.width} x {spec.height} of them: give a size of the same shape"
        )
    across = 2 * np.degrees(np.arctan(spec.width / 2 / spec.focal))
    return {
        "image_size_x": str(width),
        "image_size_y": str(height),
        "fov": repr(float(across)),
    }


def intrinsic_of(spec: CameraSpec, recording: Recording) -> Float[np.ndarray, "3 3"]:
    """Calibration of a camera with :func:`camera_attributes`, in pixels.

    Pixels are square, and the principal point is in the middle.
    """
    width, height = recording.picture_size(spec.width, spec.height)
    focal = spec.focal * width / spec.width
    return np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])


def lidar_note(spec: LidarSpec) -> str:
    """What CARLA cannot record as the spec has it; empty if there is nothing."""
    table = np.array(spec.elevations)
    off = np.abs(table - np.linspace(table[0], table[-1], len(table))).max()
    if off <= EVEN:
        return ""
    low, high = np.degrees(table[[0, -1]])
    return (
        f"{spec.name}: CARLA's channels are evenly spaced: {len(table)} from {low:g}° "
        f"to {high:g}°, up to {np.degrees(off):.1f}° off the device's own"
    )


def camera_note(spec: CameraSpec) -> str:
    """What CARLA cannot record as the spec has it; empty if there is nothing."""
    if np.abs(np.subtract(spec.principal, (spec.width / 2, spec.height / 2))).max() <= 1:
        return ""
    return (
        f"{spec.name}: CARLA's principal point is the middle of the picture, not "
        f"({spec.principal[0]:g}, {spec.principal[1]:g})"
    )


def weather_of(carla: Any, conditions: Conditions) -> Any:
    """CARLA's weather parameters; the sun stands where it does for the embedded recorder.

    ``carla`` is the client's module. CARLA's percentages of rain and fog have no unit. Rain of
    10 mm/h becomes 63 %, between CARLA's presets of medium (60 %) and hard rain (100 %). Fog with
    a visual range of 200 m becomes 26 %, and with 50 m 70 %, equally dense at all heights that
    matter.
    """
    light, strength = light_of(conditions), conditions.intensity or 0.0
    weather = dict(cloudiness=10.0, wind_intensity=10.0)
    if conditions.weather == "rain":
        share = 100.0 * (1.0 - np.exp(-strength / 10.0))
        weather = dict(
            cloudiness=60.0 + 0.4 * share,
            precipitation=share,
            precipitation_deposits=share,
            wetness=share,
            wind_intensity=share,
            fog_density=0.05 * share,
            fog_distance=0.75,
            fog_falloff=0.1,
        )
    elif conditions.weather == "fog":
        weather = dict(
            cloudiness=80.0,
            fog_density=100.0 * (1.0 - np.exp(-60.0 / strength)),
            fog_falloff=0.01,
        )
    return carla.WeatherParameters(
        sun_altitude_angle=float(np.degrees(light.elevation)),
        sun_azimuth_angle=float(-np.degrees(light.azimuth) % 360.0),
        scattering_intensity=1.0,
        mie_scattering_scale=0.03,
        **{key: float(value) for key, value in weather.items()},
    )


# ── Measurements ───────────────────────────────────────────────────────────────────────────────


class SensorQueue:
    """The measurements of one sensor: they arrive in the order of the frames, after some time.

    ``name`` is for error messages.
    """

    def __init__(self, sensor: Any, name: str) -> None:
        self.name, self.has_delivered = name, False
        self._queue: queue.SimpleQueue[Any] = queue.SimpleQueue()
        sensor.listen(self._queue.put)

    def wait(self, until: float) -> bool:
        """Whether any measurement has ever arrived. Waits for the first until ``until``, a time on
        the monotonic clock [s]."""
        self.has_delivered = self.has_delivered or self._next(until) is not None
        return self.has_delivered

    def take(self, frame: int, until: float) -> Any:
        """The measurement of a frame of the server; None if it has not arrived by ``until``.

        Measurements of earlier frames are dropped.
        """
        while (found := self._next(until)) is not None and found.frame < frame:
            pass
        return found if found is not None and found.frame == frame else None

    def _next(self, until: float) -> Any:
        try:
            return self._queue.get(timeout=max(until - time.monotonic(), 1e-3))
        except queue.Empty:
            return None


def points_of(scan: Any) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, " N"]]:
    """Unit directions in the body frame (x forward, y left, z up) and distances [m] of a LiDAR's
    measurement."""
    points = flip(np.frombuffer(scan.raw_data, np.float32).reshape(-1, 4)[:, :3]).astype(float)
    distance = np.linalg.norm(points, axis=1)
    return points / np.maximum(distance, 1e-9)[:, None], distance


def colours_of(image: Any) -> UInt8[np.ndarray, "H W 3"]:
    """Red, green and blue of a picture, which CARLA stores as blue, green, red and alpha."""
    bgra = np.frombuffer(image.raw_data, np.uint8).reshape(image.height, image.width, 4)
    return np.ascontiguousarray(bgra[..., 2::-1])


def depth_of(image: Any) -> Float[np.ndarray, "H W"]:
    """Depth along the camera's axis [m], infinite from :data:`FAR` on.

    CARLA stores it in the 24 bits of the colour.
    """
    red, green, blue = np.moveaxis(colours_of(image).astype(np.int64), -1, 0)
    code = red + 256 * green + 65536 * blue
    return np.where(code >= 2**24 - 1, np.inf, code * (FAR / (2**24 - 1))).astype(np.float32)


def tags_of(image: Any) -> UInt8[np.ndarray, "H W"]:
    """CARLA's labels in a semantic or an instance picture."""
    return np.ascontiguousarray(colours_of(image)[..., 0])


def numbers_of(image: Any) -> Int[np.ndarray, "H W"]:
    """Unreal's numbers of the objects in an instance picture: their lower 16 bits."""
    colours = colours_of(image).astype(np.int32)
    return colours[..., 1] + 256 * colours[..., 2]
