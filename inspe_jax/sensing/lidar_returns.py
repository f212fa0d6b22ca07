"""Which of a LiDAR's rays come back: the share that is lost, at random and over range, as in
CARLA's model. It is the same for every recorder and for expected numbers of returns."""

from dataclasses import dataclass
from typing import Any

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
