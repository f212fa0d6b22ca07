"""Profiles: named choices for what the paper leaves open, from ``profiles.toml``.

A scene is built under a profile, and its settings name it. The profile decides which devices a
strategy places on that scene and how, what is scored, and how reliably sensors perceive.
"""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from types import MappingProxyType
from typing import Any

from inspe_jax.core.errors import check_known

DEFAULT_PROFILE = "paper"
BEFORE_PROFILES = "ideal"
"""The profile of scenes that name none: made by hand, or saved before there were profiles."""


@dataclass(frozen=True)
class Profile:
    """One table of ``profiles.toml``.

    ``radius``, ``voxel`` and ``spacing`` [m], ``density`` and ``mix`` are those of
    :func:`~inspe_jax.scene.scene.build_scene`. ``occlusion_reference`` and ``visibility`` are
    those of :func:`~inspe_jax.scoring.evaluate.evaluate`. ``camera_reliability`` and
    ``lidar_reliability`` multiply the device's own: the chance that a sensor perceives what is in
    its view. ``camera``, ``lidar_32`` and ``lidar_64`` are the devices of
    :func:`~inspe_jax.mounting.strategies.strategy`; ``camera_height``, ``lidar_height`` [m] and
    ``camera_pitch_deg`` are its options, None for its own defaults. ``reasons`` has a reason for
    every value.
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
        return {"camera": self.camera_reliability, "lidar": self.lidar_reliability}

    def of_scene(self, **given: Any) -> dict[str, Any]:
        """The options to build a scene with: the given ones, or the profile's where they are None.

        The profile's spacing is only for voxels of the profile's size. With another ``voxel`` and
        no ``spacing``, all voxels are used.
        """
        own = {key: getattr(self, key) for key in ("radius", "voxel", "spacing", "density", "mix")}
        if given.get("voxel") not in (None, self.voxel):
            own["spacing"] = None
        return own | {key: value for key, value in given.items() if value is not None}


@cache
def profiles() -> Mapping[str, Profile]:
    """Every profile by name, the default first."""
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
