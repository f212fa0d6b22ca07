"""Light: the position of the sun, the brightness of sun and sky, and a camera's response to it."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from scipy.special import ndtri

from inspe_jax.sensing.conditions import Conditions


@dataclass(frozen=True)
class Light:
    """One time of day. Colours are linear; a white wall at midday has brightness 1.

    ``elevation`` and ``azimuth`` are those of the sun [rad], the azimuth counter-clockwise from
    east. ``sun``, ``ambient`` and ``sky`` are the colours of direct light, of diffuse light and of
    the sky; ``lamps`` is how bright street lamps and headlights are, of 1. ``exposure`` is in
    seconds; ``gain`` is the camera's. ``read`` and ``shot`` are the standard deviation of its noise
    in the dark and at full scale, before the gain. A picture is the mean of so many ``moments``
    of the exposure.
    """

    elevation: float
    azimuth: float
    sun: tuple[float, float, float]
    ambient: tuple[float, float, float]
    sky: tuple[float, float, float]
    lamps: float
    exposure: float
    gain: float
    read: float
    shot: float
    moments: int

    @property
    def to_sun(self) -> Float[np.ndarray, "3"]:
        """The unit vector to the sun, in the world."""
        plan = np.cos(self.elevation)
        x, y = plan * np.cos(self.azimuth), plan * np.sin(self.azimuth)
        return np.array([x, y, np.sin(self.elevation)])

    @property
    def has_sun(self) -> bool:
        """Whether the sun is up."""
        return max(self.sun) > 0


LIGHTS: dict[str, Light] = {
    "midday": Light(
        elevation=np.radians(52), azimuth=np.radians(-65),
        sun=(0.95, 0.92, 0.86), ambient=(0.27, 0.30, 0.36), sky=(0.42, 0.60, 0.86),
        lamps=0.0, exposure=0.001, gain=1.35, read=0.002, shot=0.008, moments=1,
    ),
    "dusk": Light(
        elevation=np.radians(7), azimuth=np.radians(165),
        sun=(0.42, 0.24, 0.11), ambient=(0.10, 0.105, 0.15), sky=(0.46, 0.33, 0.34),
        lamps=0.25, exposure=0.008, gain=3.0, read=0.002, shot=0.012, moments=2,
    ),
    "night": Light(
        elevation=np.radians(-20), azimuth=0.0,
        sun=(0.0, 0.0, 0.0), ambient=(0.006, 0.007, 0.011), sky=(0.008, 0.010, 0.018),
        lamps=1.0, exposure=0.033, gain=7.0, read=0.004, shot=0.02, moments=3,
    ),
}  # fmt: skip
"""Plausible values; the brightness has the order of magnitude that streets have."""

LAMP = (6.0, 5.0, 3.6)
"""Light of a street lamp at 1 m: a warm white."""
KOSCHMIEDER = 3.0
"""Contrast falls to 5 % = exp(−3) at the meteorological optical range."""
RAIN = 0.00025
"""Extinction per 1 mm/h of rain [1/m]."""


def light_of(conditions: Conditions) -> Light:
    """The light of the conditions' time of day."""
    return LIGHTS[conditions.light]


def haze(conditions: Conditions) -> float:
    """Extinction of the air [1/m]; 0 if it is clear."""
    if conditions.intensity is None:
        return 0.0
    if conditions.weather == "fog":
        return KOSCHMIEDER / conditions.intensity
    return RAIN * conditions.intensity


def tone_map(
    linear: Float[np.ndarray, "H W 3"], light: Light, rng: np.random.Generator
) -> UInt8[np.ndarray, "H W 3"]:
    """The 8-bit picture of linear light: noise, gain, roll-off of highlights, sRGB's curve."""
    given = np.asarray(linear, np.float32).ravel()
    picture = np.empty(given.shape, np.uint8)
    for part in parts(len(given)):
        value = np.maximum(given[part], 0)
        deviation = np.sqrt(light.read**2 + light.shot**2 / light.gain * value)
        value = (value + deviation * _normal(len(value), rng)) * (light.gain * _FINE / WHITE)
        step = np.clip(value, 0, _FINE).astype(np.int16)
        picture[part] = np.take(_CURVE, step, mode="clip")  # clipped already: the faster way
    return picture.reshape(np.shape(linear))


def parts(many: int) -> Iterator[slice]:
    """Slices of ``many`` items, each small enough for a core's cache."""
    return (slice(k, k + AT_ONCE) for k in range(0, many, AT_ONCE))


def _normal(many: int, rng: np.random.Generator) -> Float[np.ndarray, " N"]:
    """Standard normal numbers, drawn from 65,536 equally likely quantiles: fast for large N."""
    return np.take(_QUANTILES, rng.integers(0, 2**16, many, np.uint16))


def _curve() -> UInt8[np.ndarray, " N"]:
    """The 8-bit values of evenly spaced brightness from 0 to :data:`WHITE`."""
    value = (np.arange(_FINE + 1) + 0.5) / _FINE * WHITE
    value = value * (1 + value / WHITE**2) / (1 + value)  # Reinhard's, which ends at white
    curve = np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)
    return np.round(255 * np.clip(curve, 0, 1)).astype(np.uint8)


WHITE = 2.5
"""Brightness after the gain that becomes white in an image."""
AT_ONCE = 2**16
"""Largest number of items in a slice of :func:`parts`."""
_FINE = 2**14
_CURVE = _curve()
_QUANTILES = ndtri((np.arange(2**16) + 0.5) / 2**16).astype(np.float32)
