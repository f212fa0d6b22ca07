"""A LiDAR in the triangles: every channel at every azimuth, one turn a frame.

The turn is centred on the frame's time, and the road users go on meanwhile. What comes back is
dropped at random as CARLA drops it, its range is noisy, and its intensity falls with range.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from inspe_jax.core.geometry import rotation
from inspe_jax.sensing.sensors import LidarSpec
from inspe_jax.simulation.embedded.embree import Caster
from inspe_jax.simulation.embedded.road_users import FrameActors
from inspe_jax.simulation.embedded.static_world import StaticWorld
from inspe_jax.simulation.frame import Scan

ATTENUATION = 0.004
"""Intensity is exp(−this · range), as in CARLA and in the sets of the field [1/m]."""
SECTORS = 12
"""Parts of a turn within which road users stand still."""


@dataclass(frozen=True)
class LidarNoise:
    """What goes wrong: standard deviation of range [m]; the share of returns that are lost; and of
    those below an intensity, the share lost of the weakest, falling to none at that intensity.

    The defaults are settings of a public roadside set.
    """

    range: float = 0.02
    lost: float = 0.3
    weak: float = 0.7
    weakest_lost: float = 0.4


@dataclass(frozen=True, eq=False)
class Returns:
    """What R rays met, before anything is lost: in the order channel by channel.

    ``direction`` (R, 3) in the body frame; ``distance`` [m], infinite where nothing was met;
    ``thing`` the index of the road user met, −1 for what stands still or nothing; ``after`` the
    time of firing, from the frame's [s].
    """

    direction: Float[np.ndarray, "R 3"]
    distance: Float[np.ndarray, " R"]
    thing: Int[np.ndarray, " R"]
    after: Float[np.ndarray, " R"]


class Lidar:
    """One LiDAR at its place; what stands still is met once and for all."""

    def __init__(
        self, spec: LidarSpec, pose: Float[np.ndarray, "6"], statics: StaticWorld, still: Caster
    ) -> None:
        self.pose, self.reach, self.center = np.asarray(pose, float), spec.reach, statics.center
        self.body = spec.grid.directions()  # (R, 3), channel by channel
        self.directions = self.body @ rotation(self.pose[3:], np).T
        self.origin = self.pose[:3] - self.center
        self.still = still.cast(self.origin, self.directions, spec.reach).distance
        column = np.tile(np.arange(spec.azimuth_count), len(spec.elevations))
        self.turn = (column + 0.5) / spec.azimuth_count - 0.5  # −½ … ½ of a turn

    def cast(self, company: FrameActors, period: float) -> Returns:
        """One turn in ``period`` seconds about a frame; 0 for all at once."""
        distance, thing = self.still.copy(), np.full(len(self.body), -1)
        sectors = SECTORS if period > 0 else 1
        sector = np.clip(((self.turn + 0.5) * sectors).astype(int), 0, sectors - 1)
        after = ((sector + 0.5) / sectors - 0.5) * period
        for k in range(sectors):
            movers, caster = company.at(((k + 0.5) / sectors - 0.5) * period)
            own = np.flatnonzero(sector == k)
            hits = caster.cast(self.origin, self.directions[own], distance[own])
            met = hits.face >= 0
            distance[own[met]] = hits.distance[met]
            thing[own[met]] = movers.thing[hits.face[met]]
        return Returns(self.body, distance, thing, after)

    def scan(self, returns: Returns, noise: LidarNoise, rng: np.random.Generator) -> Scan:
        """The points of what comes back."""
        return Scan(self.pose, apply_noise(returns.direction, returns.distance, noise, rng))


def apply_noise(
    direction: Float[np.ndarray, "R 3"],
    distance: Float[np.ndarray, " R"],
    noise: LidarNoise,
    rng: np.random.Generator,
) -> Float[np.ndarray, "N 4"]:
    """Points of those of R rays that come back, x, y, z and intensity: some lost, ranges noisy.

    ``distance`` [m] is infinite where nothing was met.
    """
    lost = rng.random((2, len(direction)))
    blur = rng.standard_normal(len(direction)) * noise.range
    intensity = np.exp(-ATTENUATION * distance)
    weak = np.clip(1 - intensity / noise.weak, 0, 1) if noise.weak > 0 else 0.0
    back = np.isfinite(distance) & (lost[0] >= noise.lost)
    back &= lost[1] >= weak * noise.weakest_lost
    far = np.clip(distance[back] + blur[back], 0.0, None)
    points = np.column_stack([direction[back] * far[:, None], np.exp(-ATTENUATION * far)])
    return points.astype(np.float32)
