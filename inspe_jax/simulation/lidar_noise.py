"""What is wrong with a LiDAR's returns: some are lost, and ranges are noisy.

The same for every backend. Returns are dropped at random as CARLA drops them.
"""

import numpy as np
from jaxtyping import Bool, Float

from inspe_jax.sensing.lidar_returns import ATTENUATION, LidarNoise


def apply_noise(
    direction: Float[np.ndarray, "R 3"],
    distance: Float[np.ndarray, " R"],
    noise: LidarNoise,
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "N 4"], Bool[np.ndarray, " R"]]:
    """Points of those of R rays that come back, and which these are.

    A point is x, y, z [m] and intensity 0…1, float32. ``direction`` holds unit vectors in the body
    frame; ``distance`` [m] is infinite where nothing was hit.
    """
    lost = rng.random((2, len(direction)))
    error = rng.standard_normal(len(direction)) * noise.range
    back = np.isfinite(distance) & (lost[0] >= noise.lost)
    back &= lost[1] >= noise.weak_lost(distance)
    far = np.clip(distance[back] + error[back], 0.0, None)
    points = np.column_stack([direction[back] * far[:, None], np.exp(-ATTENUATION * far)])
    return points.astype(np.float32), back
