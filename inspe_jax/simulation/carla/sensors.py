"""Sensors as CARLA has them: their attributes, the weather they are in, and what they bring.

CARLA's LiDAR has evenly spaced channels and knows no weather; its cameras look through the middle
of the picture. What a spec says beyond that is left out, and :func:`notes_of` tells it.
"""

import queue
import time
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from inspe_jax.core.carla_frame import flip
from inspe_jax.sensing.conditions import Conditions
from inspe_jax.sensing.layout import Layout
from inspe_jax.sensing.sensors import CameraSpec, LidarSpec
from inspe_jax.simulation.embedded.lidar import ATTENUATION
from inspe_jax.simulation.embedded.light import light_of

LIDAR = "sensor.lidar.ray_cast"
PICTURES: dict[str, str] = {
    "rgb": "sensor.camera.rgb",
    "depth": "sensor.camera.depth",
    "instance": "sensor.camera.instance_segmentation",
    "semantic": "sensor.camera.semantic_segmentation",
}
"""The sensor that takes each kind of picture."""
NEEDS: dict[str, tuple[str, ...]] = {
    "depth": ("depth",),
    "instance": ("instance", "depth"),
    "semantic": ("semantic",),
}
"""The pictures that each layer is made of: whose an instance is, its place tells."""
FAR = 1000.0
"""Where CARLA's depth camera ends [m]."""
EVEN = np.radians(0.02)
"""Channels this near to even ones are even [rad]: tables are rounded."""


def lidar_attributes(spec: LidarSpec, rate: float) -> dict[str, str]:
    """One turn a frame, with all of a spec's rays, and nothing lost.

    What is lost at random we take away ourselves: CARLA's dice go on from frame to frame, and a
    frame should be the same however often it is asked for.
    """
    channels = len(spec.elevations)
    return {
        "channels": str(channels),
        "range": repr(float(spec.reach)),
        "points_per_second": str(round(spec.azimuth_count * channels * rate)),
        "rotation_frequency": repr(float(rate)),
        "upper_fov": repr(float(np.degrees(max(spec.elevations)))),
        "lower_fov": repr(float(np.degrees(min(spec.elevations)))),
        "horizontal_fov": repr(min(float(np.degrees(spec.azimuth_fov)), 360.0)),
        "atmosphere_attenuation_rate": repr(ATTENUATION),
        "dropoff_general_rate": "0.0",
        "dropoff_zero_intensity": "0.0",
        "noise_stddev": "0.0",
    }


def camera_attributes(spec: CameraSpec, scale: float) -> dict[str, str]:
    """The size of the picture and the field of view across it."""
    height, width = (max(1, round(n * scale)) for n in (spec.height, spec.width))
    across = 2 * np.degrees(np.arctan(spec.width / 2 / spec.focal))
    return {
        "image_size_x": str(width),
        "image_size_y": str(height),
        "fov": repr(float(across)),
    }


def intrinsic_of(spec: CameraSpec, scale: float) -> Float[np.ndarray, "3 3"]:
    """Of a camera with :func:`camera_attributes`: square pixels, and its axis in the middle."""
    height, width = (max(1, round(n * scale)) for n in (spec.height, spec.width))
    focal = spec.focal * width / spec.width
    return np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])


def notes_of(layout: Layout) -> tuple[str, ...]:
    """What CARLA cannot record as the layout's specs have it, one line a device."""
    specs = dict.fromkeys(sensor.spec for sensor in layout.sensors)
    notes = []
    for spec in specs:
        if isinstance(spec, LidarSpec):
            table = np.array(spec.elevations)
            off = np.abs(table - np.linspace(table[0], table[-1], len(table))).max()
            if off > EVEN:
                low, high = np.degrees(table[[0, -1]])
                notes.append(
                    f"{spec.name}: CARLA's channels are evenly spaced: {len(table)} from {low:g}° "
                    f"to {high:g}°, up to {np.degrees(off):.1f}° off the device's own"
                )
        elif (
            isinstance(spec, CameraSpec)
            and np.abs(np.subtract(spec.principal, (spec.width / 2, spec.height / 2))).max() > 1
        ):
            notes.append(
                f"{spec.name}: CARLA's principal point is the middle of the picture, not "
                f"({spec.principal[0]:g}, {spec.principal[1]:g})"
            )
    return tuple(notes)


def weather_of(carla: Any, conditions: Conditions) -> Any:
    """CARLA's weather parameters; the sun stands where it does for the embedded recorder.

    CARLA's shares of rain and fog have no unit. Rain is read so that the usual 10 mm/h are between
    its presets of middling and hard rain, 60 and 100 %; fog so that a range of 200 m is 26 % and
    one of 50 m 70 %, as dense at any height that matters.
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


# ── What sensors bring ──────────────────────────────────────────────────────────────────────────


class SensorQueue:
    """Listens to a sensor: its measurements come in the order of the frames, in their own time."""

    def __init__(self, sensor: Any, name: str) -> None:
        self.name, self.heard = name, False
        self._inbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
        sensor.listen(self._inbox.put)

    def wait(self, until: float) -> bool:
        """Whether anything came yet; waits until then, on the monotonic clock [s]."""
        self.heard = self.heard or self._next(until) is not None
        return self.heard

    def take(self, frame: int, until: float) -> Any:
        """The measurement of a frame, of which those before are let go; None if there is none."""
        while (found := self._next(until)) is not None and found.frame < frame:
            pass
        return found if found is not None and found.frame == frame else None

    def _next(self, until: float) -> Any:
        try:
            return self._inbox.get(timeout=max(until - time.monotonic(), 1e-3))
        except queue.Empty:
            return None


def points_of(scan: Any) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, " N"]]:
    """Unit directions in our body frame and distances [m] of a LiDAR's measurement."""
    points = flip(np.frombuffer(scan.raw_data, np.float32).reshape(-1, 4)[:, :3]).astype(float)
    distance = np.linalg.norm(points, axis=1)
    return points / np.maximum(distance, 1e-9)[:, None], distance


def colours_of(image: Any) -> UInt8[np.ndarray, "H W 3"]:
    """Red, green and blue of a picture."""
    bgra = np.frombuffer(image.raw_data, np.uint8).reshape(image.height, image.width, 4)
    return np.ascontiguousarray(bgra[..., 2::-1])


def depth_of(image: Any) -> Float[np.ndarray, "H W"]:
    """Depth along the camera's axis [m], infinite where CARLA's ends; in 24 bits of the colour."""
    red, green, blue = np.moveaxis(colours_of(image).astype(np.int64), -1, 0)
    code = red + 256 * green + 65536 * blue
    return np.where(code >= 2**24 - 1, np.inf, code * (FAR / (2**24 - 1))).astype(np.float32)


def tags_of(image: Any) -> UInt8[np.ndarray, "H W"]:
    """CARLA's labels, of a semantic or an instance picture."""
    return np.ascontiguousarray(colours_of(image)[..., 0])


def numbers_of(image: Any) -> Int[np.ndarray, "H W"]:
    """What Unreal numbers the objects of an instance picture by, as far as 16 bits tell."""
    colours = colours_of(image).astype(np.int32)
    return colours[..., 1] + 256 * colours[..., 2]
