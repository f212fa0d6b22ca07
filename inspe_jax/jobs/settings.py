"""Settings of studies of any kind: one value or a list for each key, and how they are checked."""

import inspect
from collections.abc import Callable, Iterable, Mapping
from itertools import product
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, BeforeValidator, Field

from inspe_jax.core.errors import InspeError, check_known, error_at
from inspe_jax.core.files import STRICT
from inspe_jax.scene.profiles import DEFAULT_PROFILE, profile_of, profiles
from inspe_jax.scene.scene import build_scene, density_count
from inspe_jax.scene.street import STATICS
from inspe_jax.scene.terrain import check_terrain
from inspe_jax.scene.traffic.frames import MIXES, TRAFFIC_MODELS
from inspe_jax.sensing.conditions import FAIR, Conditions

T = TypeVar("T")

WORLD = ("radius", "voxel", "density", "mix", "traffic", "seed", "statics", "terrain")
"""Settings of a scene, without the number of frames and the time between them."""
CONDITIONS = ("light", "weather")


def _listed(value: Any) -> Any:
    return value if isinstance(value, list) else [value]


class Strict(BaseModel, **STRICT):
    """A part of a study file; unknown keys are errors."""


Count = Annotated[int, Field(ge=0)]
Length = Annotated[float, Field(gt=0)]
Text = Annotated[str, Field(min_length=1)]
Line = Annotated[str, Field(pattern=r"^[^\x00-\x1f\x7f]+$")]
Several = Annotated[list[T], BeforeValidator(_listed), Field(min_length=1)]
"""One value, or a list of values."""


class WorldSettings(Strict):
    """The settings of :data:`WORLD`; an empty list means that one is not given."""

    radius: Several[Length] = []
    voxel: Several[Length] = []
    density: Several[str | int] = []
    mix: Several[str] = []
    traffic: Several[str] = []
    seed: Several[Count] = []
    statics: Several[str] = []
    terrain: Several[str] = []


def defaults_of(keys: Iterable[str], profile: str = DEFAULT_PROFILE) -> dict[str, list[Any]]:
    """The default of each setting of scenes and conditions, as a list of one value."""
    own = {key: row.default for key, row in inspect.signature(build_scene).parameters.items()}
    own |= profile_of(profile).of_scene() | dict(profile=profile) | FAIR.record
    return {key: [own[key]] for key in keys}


def combinations(
    given: Mapping[str, Any], keys: Iterable[str], defaults: Mapping[str, Any]
) -> list[dict[str, Any]]:
    """Every combination of values, one of each key; defaults stand for keys that are not given."""
    keys = tuple(keys)
    values = [given[key] or defaults[key] for key in keys]
    return [dict(zip(keys, row, strict=True)) for row in product(*values)]


def conditioned(settings: dict[str, Any]) -> dict[str, Any]:
    """Settings with light and weather in one spelling."""
    return settings | Conditions.of(settings["light"], settings["weather"]).record


CHECKS: dict[str, Callable[[Any], Any]] = {
    "profile": lambda value: check_known(value, profiles(), ""),
    "density": density_count,
    "mix": lambda value: check_known(value, MIXES, ""),
    "traffic": lambda value: check_known(value, TRAFFIC_MODELS, ""),
    "statics": lambda value: check_known(value, STATICS, "statics"),
    "terrain": check_terrain,
    "light": Conditions.of,
    "weather": lambda value: Conditions.of("midday", value),
}
"""For each key, a function that raises InspeError for a value that is not allowed."""


def check_settings(
    given: Mapping[str, Any], where: str, checks: Mapping[str, Callable[[Any], Any]] = CHECKS
) -> None:
    """Raise InspeError where a setting has a value that is not allowed."""
    for key, check in checks.items():
        for value in given.get(key, ()):
            with error_at(f"{where}.{key}"):
                check(value)


def check_names(names: list[str], where: str) -> None:
    """Raise InspeError where two entries have the same name."""
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InspeError(f"{where}: two are named '{twice}'; give one another name")
