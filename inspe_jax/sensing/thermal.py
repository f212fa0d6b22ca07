"""A thermal camera: a camera of long-wave infrared, which needs no light.

Its rays, lens and poses are a camera's. Its own are how far it perceives where nothing says so,
what light and weather take from it (``conditions.toml``), and its curves of detection
(``detection.toml``).
"""

from dataclasses import dataclass, replace
from functools import cached_property

from inspe_jax.core.pytree import pytree
from inspe_jax.sensing.lens_rays import DistortedRays, FisheyeRays
from inspe_jax.sensing.ray_grid import RayGrid
from inspe_jax.sensing.rays import PinholeRays, Rays
from inspe_jax.sensing.sensors import CameraSpec
from inspe_jax.sensing.signals import Signal

HEAT = Signal("thermal")


@pytree
@dataclass(frozen=True)
class ThermalRays(PinholeRays):
    """Of a pinhole."""

    signal = HEAT


@pytree
@dataclass(frozen=True)
class ThermalDistortedRays(DistortedRays):
    """Through a lens that distorts."""

    signal = HEAT


@pytree
@dataclass(frozen=True)
class ThermalFisheyeRays(FisheyeRays):
    """Through a fisheye."""

    signal = HEAT


OF_HEAT: dict[type[Rays], type[Rays]] = {
    PinholeRays: ThermalRays,
    DistortedRays: ThermalDistortedRays,
    FisheyeRays: ThermalFisheyeRays,
}


@dataclass(frozen=True)
class ThermalSpec(CameraSpec):
    """A thermal camera, with the fields of :class:`~inspe_jax.sensing.sensors.CameraSpec`.

    Not modelled: how warm road users are against the road, and the hours in which they are alike.
    """

    kind = "thermal"
    title = "thermal camera"
    pixels_per_metre = 8.0
    """To recognise a person: 6 px across 0.75 m (FLIR, technical note TN 0002)."""

    @cached_property
    def grid(self) -> RayGrid:
        """A camera's rays."""
        grid = super().grid
        return replace(grid, of=OF_HEAT[grid.of])
