"""Profiles: named choices for what the paper leaves open, from ``profiles.toml``."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from types import MappingProxyType
from typing import Any

from inspe_jax.core.errors import check_known

DEFAULT_PROFILE = "paper"
BEFORE_PROFILES = "ideal"  # of scenes that name none: made by hand, or before there were profiles


@dataclass(frozen=True)
class Profile:
    """One table of ``profiles.toml``, with a reason for every value.

    ``radius``, ``voxel`` and ``spacing`` [m], ``density`` and ``mix`` are those of
    :func:`~inspe_jax.scene.scene.build_scene`; ``occlusion_reference`` and ``visibility`` those of
    :func:`~inspe_jax.scoring.evaluate.evaluate`. The reliabilities multiply the device's own: the
    chance that a sensor perceives what is in its view. The devices, heights [m] and pitch are those
    of :func:`~inspe_jax.mounting.strategies.strategy`, None for its own defaults.
    """

    name: str
    title: str
    radius: float
    voxel: float
    spacing: float
    density: str
    mix: str
    occlusion_reference: str
    visibility: str
    camera_reliability: float
    lidar_reliability: float
    camera: str
    lidar_32: str
    lidar_64: str
    camera_height: float | None = None
    camera_pitch_deg: float | None = None
    lidar_height: float | None = None
    reasons: Mapping[str, str] = field(default_factory=dict, hash=False, compare=False)

    @property
    def reliability(self) -> dict[str, float]:
        """Reliability by kind of sensor; 1 for kinds that are not named."""
        camera = self.camera_reliability
        return {"camera": camera, "thermal": camera, "lidar": self.lidar_reliability}

    def of_scene(self, **given: Any) -> dict[str, Any]:
        """The options to build a scene with: the given ones, or the profile's where they are None.

        With another ``voxel`` than the profile's and no ``spacing``, all voxels are used.
        """
        own = {key: getattr(self, key) for key in ("radius", "voxel", "spacing", "density", "mix")}
        if given.get("voxel") not in (None, self.voxel):
            own["spacing"] = None
        return own | {key: value for key, value in given.items() if value is not None}


@cache
def profiles() -> Mapping[str, Profile]:
    """Every profile by name, the default first.

    >>> list(inspe_jax.profiles())
    ['paper', 'ideal']
    >>> inspe_jax.profiles()["paper"].voxel
    0.2
    """
    text = files("inspe_jax.scene").joinpath("profiles.toml").read_text(encoding="utf-8")
    found = {}
    for name, table in tomllib.loads(text).items():
        title = table.pop("title")
        values, reasons = ({k: row[of] for k, row in table.items()} for of in ("value", "reason"))
        found[name] = Profile(name, title, **values, reasons=reasons)
    return MappingProxyType(found)


def profile_of(name: str) -> Profile:
    """A profile by name. Raises InspeError with the known names."""
    check_known(name, profiles(), "no profile")
    return profiles()[name]
