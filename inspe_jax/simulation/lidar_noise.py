"""What is wrong with a LiDAR's returns: some are lost, and ranges are noisy.

The same model for every backend. Returns are dropped at random as CARLA drops them.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

ATTENUATION = 0.004
"""Intensity is exp(−this · range), as in CARLA and in public data sets [1/m]."""


@dataclass(frozen=True)
class LidarNoise:
    """The noise of a LiDAR.

    ``range`` is the standard deviation of the range [m]. ``lost`` is the share of all returns that
    is lost. Of returns with an intensity below ``weak`` more are lost: the share grows linearly
    from 0 at this intensity to ``weakest_lost`` at intensity 0.

    The defaults are settings of a public roadside data set.
    """

    range: float = 0.02
    lost: float = 0.3
    weak: float = 0.7
    weakest_lost: float = 0.4


def apply_noise(
    direction: Float[np.ndarray, "R 3"],
    distance: Float[np.ndarray, " R"],
    noise: LidarNoise,
    rng: np.random.Generator,
) -> Float[np.ndarray, "N 4"]:
    """Points of those of R rays that come back: x, y, z [m] and intensity 0…1, float32.

    ``direction`` holds unit vectors in the body frame; ``distance`` [m] is infinite where nothing
    was hit.
    """
    lost = rng.random((2, len(direction)))
    error = rng.standard_normal(len(direction)) * noise.range
    intensity = np.exp(-ATTENUATION * distance)
    weak = np.clip(1 - intensity / noise.weak, 0, 1) if noise.weak > 0 else 0.0
    back = np.isfinite(distance) & (lost[0] >= noise.lost)
    back &= lost[1] >= weak * noise.weakest_lost
    far = np.clip(distance[back] + error[back], 0.0, None)
    points = np.column_stack([direction[back] * far[:, None], np.exp(-ATTENUATION * far)])
    return points.astype(np.float32)
