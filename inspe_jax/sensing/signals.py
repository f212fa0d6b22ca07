"""What rays bring a detector; and which of a LiDAR's come back: the share that is lost, at random
and over range, as in CARLA's model, the same for every recorder and for expected returns."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

ATTENUATION = 0.004  # intensity is exp(−this · range), as in CARLA and in public data sets [1/m]


@dataclass(frozen=True)
class LidarNoise:
    """The noise of a LiDAR; the defaults are settings of a public roadside data set.

    ``range`` is the standard deviation of the range [m]. ``lost`` is the share of all returns that
    is lost. Of returns with an intensity below ``weak`` more are lost: the share grows linearly
    from 0 at this intensity to ``weakest_lost`` at intensity 0.
    """

    range: float = 0.02
    lost: float = 0.3
    weak: float = 0.7
    weakest_lost: float = 0.4

    def weak_lost(self, distance: Any, xp: Any = np) -> Any:
        """The share of returns from a distance [m] that is lost since they are weak."""
        if not self.weak > 0:
            return xp.zeros_like(distance)
        weakness = 1.0 - xp.exp(-ATTENUATION * distance) / self.weak
        return xp.clip(weakness, 0.0, 1.0) * self.weakest_lost

    def share_returned(self, distance: Any, xp: Any = np) -> Any:
        """The share of rays that hit something at a distance [m] and come back."""
        return (1.0 - self.lost) * (1.0 - self.weak_lost(distance, xp))


class Signal(NamedTuple):
    """What a sensor's rays bring a detector: the ``name`` of the curves by which it finds road
    users (:mod:`inspe_jax.scoring.detection`), and the ``noise``, which says which rays come back
    and how exactly they range; None for pictures, of which all pixels count. With ``echo`` it is
    the strength of one echo that counts, as a radar's."""

    name: str
    noise: LidarNoise | None = None
    echo: bool = False

    @property
    def pictures(self) -> bool:
        """Whether pixels are what it has on a road user."""
        return self.noise is None and not self.echo
