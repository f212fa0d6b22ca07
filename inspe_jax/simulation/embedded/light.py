"""Light: the position of the sun, the brightness of sun and sky, and a camera's response to it."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.special import ndtri

from inspe_jax.sensing.conditions import Conditions
from inspe_jax.simulation.frame import Picture


@dataclass(frozen=True)
class Light:
    """One time of day; colours are linear, and a white wall at midday has brightness 1. Angles of
    the sun are in radians, from east; ``lamps`` is how bright lamps are, of 1; ``exposure`` in
    seconds. The gain aims at ``target`` for the mean brightness, up to ``most``. A picture is the
    mean of ``moments``."""

    elevation: float
    azimuth: float
    sun: tuple[float, float, float]
    ambient: tuple[float, float, float]
    sky: tuple[float, float, float]
    lamps: float
    exposure: float
    target: float
    most: float
    moments: int

    @property
    def to_sun(self) -> Float[np.ndarray, "3"]:
        """The unit vector to the sun, in the world."""
        plan = np.cos(self.elevation)
        x, y = plan * np.cos(self.azimuth), plan * np.sin(self.azimuth)
        return np.array([x, y, np.sin(self.elevation)])

    @property
    def sky_over_lamps(self) -> float:
        """How bright the diffuse light is where lamps are 1, if they are on."""
        return float(np.mean(self.ambient)) / self.lamps

    @property
    def has_sun(self) -> bool:
        """Whether the sun is up."""
        return max(self.sun) > 0


LIGHTS: dict[str, Light] = {
    "midday": Light(
        elevation=np.radians(52), azimuth=np.radians(-65),
        sun=(0.95, 0.92, 0.86), ambient=(0.27, 0.30, 0.36), sky=(0.42, 0.60, 0.86),
        lamps=0.0, exposure=0.001, target=0.16, most=2.0, moments=1,
    ),
    "dusk": Light(
        elevation=np.radians(7), azimuth=np.radians(165),
        sun=(0.42, 0.24, 0.11), ambient=(0.10, 0.105, 0.15), sky=(0.46, 0.33, 0.34),
        lamps=0.25, exposure=0.008, target=0.09, most=8.0, moments=2,
    ),
    "night": Light(
        elevation=np.radians(-20), azimuth=0.0,
        sun=(0.0, 0.0, 0.0), ambient=(0.006, 0.007, 0.011), sky=(0.008, 0.010, 0.018),
        lamps=1.0, exposure=0.033, target=0.05, most=32.0, moments=3,
    ),
}  # fmt: skip
"""Plausible values: under 10 lx at night white is 0.11. A gain of 32 is 30 dB."""

LAMP = (6.0, 5.0, 3.6)
"""Light of a street lamp at 1 m: warm white; at 7.5 m 10 lx, as EN 13201 asks for mixed traffic."""
CANDELA = 6.0 / 560  # light of 1 cd at 1 m: 10 lx at 7.5 m are 560 cd
ELECTRONS = 6000.0
"""Photo-electrons of a pixel at brightness 1. White at midday is then 11,000, the full well of
pixels of 3 µm; at night, 10 lx on asphalt are some 60 through f/1.4 in 33 ms."""
READ = 2.5
"""Standard deviation of a pixel's noise in the dark, in electrons: that of CMOS sensors now."""
REDUCED = 0.5
"""What a camera's own noise reduction leaves of the noise: as the mean over 4 pixels does."""
KOSCHMIEDER = 3.0  # contrast falls to 5 % = exp(−3) at the meteorological optical range
RAIN = 0.00025  # extinction per 1 mm/h of rain [1/m]

SOAKED = 1.0
"""Rain that leaves 1/e of a road dry [mm/h]: in drizzle it dries in places, in more it is wet."""


def haze(conditions: Conditions) -> float:
    """Extinction of the air [1/m]; 0 if it is clear."""
    strength = conditions.intensity or 0.0
    return KOSCHMIEDER / strength if conditions.weather == "fog" else RAIN * strength


def wetness(conditions: Conditions) -> float:
    """How wet the roads are, of 1; 0 if it does not rain."""
    rain = (conditions.intensity or 0.0) if conditions.weather == "rain" else 0.0
    return float(1 - np.exp(-rain / SOAKED))


def metered_gain(linear: Float[np.ndarray, "R 3"], light: Light) -> float:
    """The automatic gain: it brings the geometric mean of every seventh pixel to the target."""
    brightness = np.asarray(linear, np.float64)[::7].mean(1)
    mean = float(np.exp(np.log(np.maximum(brightness, 1e-5)).mean())) if len(brightness) else 1.0
    return float(np.clip(light.target / mean, 1.0, light.most))


def grain(linear: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Standard deviation of the noise at a brightness, before the gain: shot and read noise."""
    shot, read = np.float32(1 / ELECTRONS), np.float32((READ / ELECTRONS) ** 2)
    return np.float32(REDUCED) * np.sqrt(np.maximum(linear, 0) * shot + read)


def tone_map(linear: Float[np.ndarray, "H W 3"], gain: float, rng: np.random.Generator) -> Picture:
    """The 8-bit picture of linear light: noise, gain, roll-off of highlights, sRGB's curve."""
    given = np.asarray(linear, np.float32).ravel()
    picture = np.empty(given.shape, np.uint8)
    for part in parts(len(given)):
        value = np.maximum(given[part], 0)
        # Normal numbers by 65,536 equally likely quantiles: fast for large pictures.
        normal = np.take(_QUANTILES, rng.integers(0, 2**16, len(value), np.uint16))
        value = (value + grain(value) * normal) * (gain * _FINE / WHITE)
        step = np.clip(value, 0, _FINE).astype(np.int16)
        picture[part] = np.take(_CURVE, step, mode="clip")  # clipped already: the faster way
    return picture.reshape(np.shape(linear))


def parts(many: int) -> Iterator[slice]:
    """Slices of ``many`` items, each small enough for a core's cache."""
    return (slice(k, k + AT_ONCE) for k in range(0, many, AT_ONCE))


WHITE = 2.5  # brightness after the gain that becomes white in an image
AT_ONCE = 2**16  # largest number of items in a slice of :func:`parts`
_FINE = 2**14
_LINEAR = (np.arange(_FINE + 1) + 0.5) / _FINE * WHITE
_ROLLED = _LINEAR * (1 + _LINEAR / WHITE**2) / (1 + _LINEAR)  # Reinhard's, which ends at white
_SRGB = np.where(_ROLLED <= 0.0031308, 12.92 * _ROLLED, 1.055 * _ROLLED ** (1 / 2.4) - 0.055)
_CURVE = np.round(255 * np.clip(_SRGB, 0, 1)).astype(np.uint8)
_QUANTILES = ndtri((np.arange(2**16) + 0.5) / 2**16).astype(np.float32)
