"""Light and weather: how they change a sensor's effective depth and its reliability.

A catalogue's depth z₀ holds for midday and clear air. Light scales the depth of a camera; weather
weakens the signal. With extinction k [1/m], the signal is as weak at the effective depth z as it
is in clear air at z₀, so

    z · exp(k z) = z₀,    z = W(k z₀) / k,

where W is Lambert's function. For a LiDAR this is the range equation, power ∝ exp(−2 k z) / z²;
for a radar, ∝ exp(−2 k z) / z⁴, k is half of the extinction. For a camera it is contrast exp(−k z)
times the size of an object in the image, ∝ 1/z. Light and weather also multiply reliability by a
share, which falls as extinction grows.

The figures and their sources are in ``conditions.toml``. Published losses of detectors include a
loss of range, so depth and reliability together are somewhat pessimistic.
"""

import tomllib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
import scipy

from inspe_jax.core.errors import InspeError, check_known, wrong_kind
from inspe_jax.scene.scene import Scene, scene_of
from inspe_jax.sensing.layout import Layout
from inspe_jax.sensing.sensors import Spec

CLEAR = "clear"  # the weather without any loss


@dataclass(frozen=True)
class Conditions:
    """Light (midday, dusk or night) and weather (clear, rain or fog).

    ``intensity`` is the rate of rain [mm/h] or the meteorological optical range in fog [m], None
    for the usual one. Raises InspeError if a name is unknown or the intensity is out of range.

    >>> inspe_jax.Conditions("night", "rain", 10.0).weather_text
    'rain:10'
    """

    light: str = "midday"
    weather: str = CLEAR
    intensity: float | None = None

    def __post_init__(self) -> None:  # safe: it is not a pytree, so only users create it
        check_known(self.light, lights(), "light")
        check_known(self.weather, weathers(), "weather")
        if self.weather == CLEAR:
            if self.intensity is not None:
                raise InspeError(
                    f"weather clear:{self.intensity:g}: clear weather has no intensity"
                )
            return
        row = figures()["weather"][self.weather]
        low, high = row["limits"]
        if self.intensity is None:
            object.__setattr__(self, "intensity", row["usual"])
        elif not low <= self.intensity <= high:
            raise InspeError(
                f"weather {self.weather_text}: give {self.weather}:NUMBER, between {low:g} and "
                f"{high:g} {row['unit']}"
            )

    @classmethod
    def of(cls, light: str = "midday", weather: str = CLEAR) -> "Conditions":
        """Conditions by name; weather may have its intensity, as "rain:10" or "fog:200". Raises
        InspeError as the constructor does.

        >>> inspe_jax.Conditions.of("dusk", "fog:200")
        Conditions(light='dusk', weather='fog', intensity=200.0)
        """
        name, colon, number = weather.strip().lower().partition(":")
        try:
            intensity = float(number) if colon else None
        except ValueError:
            intensity = np.nan
        return cls(light.strip().lower(), name, intensity)

    def __str__(self) -> str:
        return f"{self.light}, {self.weather_text}"

    @property
    def weather_text(self) -> str:
        """The weather with its intensity, as :meth:`of` reads it."""
        return self.weather if self.intensity is None else f"{self.weather}:{self.intensity:.12g}"

    @property
    def words(self) -> str:
        """What a title adds for them; nothing at midday in clear air."""
        return "" if self == FAIR else f", {self}"

    @property
    def record(self) -> dict[str, str]:
        """The names that :meth:`of` reads, for settings that are saved."""
        return dict(light=self.light, weather=self.weather_text)

    def spec(self, spec: Spec) -> Spec:
        """A sensor with the reach [m] and the reliability that it has in these conditions. Light or
        weather without figures for its kind changes nothing.

        >>> spec = inspe_jax.device("paper-camera").spec
        >>> fog = inspe_jax.Conditions.of(weather="fog:100")
        >>> spec.depth, round(fog.spec(spec).depth, 1)
        (38.0, 20.5)
        """
        light = figures()["light"][self.light]
        depth = spec.grid.reach * light.get(f"{spec.kind}_depth", 1.0)
        share = light.get(f"{spec.kind}_reliability", 1.0)
        weather = figures()["weather"].get(self.weather, {})
        row = weather.get(spec.kind)
        if self.intensity is not None and row is not None:
            worse = (self.intensity / weather["usual"]) ** row["exponent"]
            depth = effective_depth(depth, row["factor"] * self.intensity ** row["exponent"])
            share *= row["reliability"] ** worse
        return spec.with_performance(spec.reliability * share, depth)

    def layout(self, layout: Layout) -> Layout:
        """The same sensors with the reach and reliability that they have in these conditions."""
        if self == FAIR:
            return layout
        return with_specs(layout, self.spec)


def perceiving(scene: Scene, layout: Layout, conditions: Conditions) -> Layout:
    """The sensors of a layout as they perceive on a scene in these conditions: reliability is the
    device's own, times the profile's of its kind, if any, times what the conditions leave."""
    share = scene.profile.reliability
    there = conditions.layout(layout)
    if set(share.values()) == {1.0}:
        return there
    return with_specs(
        there, lambda spec: spec.with_performance(spec.reliability * share.get(spec.kind, 1.0))
    )


def with_specs(layout: Layout, change: Callable[[Spec], Spec]) -> Layout:
    """The same sensors with each device changed, once for all that have it."""
    changed = {spec: change(spec) for spec in {sensor.spec for sensor in layout.sensors}}
    sensors = (replace(sensor, spec=changed[sensor.spec]) for sensor in layout.sensors)
    return replace(layout, sensors=tuple(sensors))


def effective_depth(depth: float, extinction: float) -> float:
    """z with z · exp(k z) = z₀ [m], for a depth z₀ [m] and an extinction k [1/m]."""
    if extinction == 0:
        return depth
    return float(scipy.special.lambertw(extinction * depth).real / extinction)


def lights() -> tuple[str, ...]:
    """The names of all lights."""
    return tuple(figures()["light"])


def weathers() -> tuple[str, ...]:
    """The names of all weathers, the clear one first."""
    return (CLEAR, *figures()["weather"])


@cache
def figures() -> dict[str, Any]:
    """The content of ``conditions.toml``."""
    resource = files("inspe_jax.sensing").joinpath("conditions.toml")
    return tomllib.loads(resource.read_text(encoding="utf-8"))


FAIR = Conditions()  # midday and clear air, the conditions of a catalogue's figures


@dataclass(frozen=True)
class Case:
    """A scene to score on, and the light and weather that the sensors work in.

    >>> night = inspe_jax.Case(scene, inspe_jax.Conditions("night"))
    >>> float(inspe_jax.evaluate(night, layout).surrogate) < 0.8
    True
    """

    scene: Scene
    conditions: Conditions = FAIR


def case_of(scene: Any, conditions: Any = None) -> Case:
    """A scene in conditions: a Case; or a scene, also by name, and Conditions, or their text such
    as "night", "rain:10" or "night, rain:10"; None is midday in clear air. Raises InspeError as
    :func:`~inspe_jax.scene.scene.scene_of`, and if conditions are none, or are given besides those
    of a Case."""
    if isinstance(scene, Case):
        if conditions is not None:
            raise InspeError(f"conditions: given twice, as {scene.conditions} and as {conditions}")
        scene, conditions = scene.scene, scene.conditions
    if isinstance(conditions, str):
        alone = conditions.partition(":")[0].strip().lower() in weathers()
        conditions = Conditions.of(*("midday," * alone + conditions).split(",", 1))
    if not isinstance(conditions, Conditions | None):
        wanted = "Conditions, or their text, such as 'night' or 'night, rain:10'"
        raise wrong_kind("conditions", conditions, wanted)
    return Case(scene_of(scene), conditions or FAIR)
