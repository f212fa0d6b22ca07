"""A LiDAR in a world of triangles: one turn per frame, centred on its time; road users move."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.random import Generator

from inspe_jax.core.geometry import rotation
from inspe_jax.sensing.sensors import LidarSpec
from inspe_jax.sensing.signals import LidarNoise
from inspe_jax.simulation.embedded.road_users import FrameActors
from inspe_jax.simulation.embedded.surroundings import Surroundings
from inspe_jax.simulation.frame import Pose6, Scan
from inspe_jax.simulation.recorder import apply_noise

SECTORS = 12
"""Number of parts of a turn. Road users stand still within a part, and move from part to part."""


class Returns(NamedTuple):
    """What R rays hit before noise is added: distance [m], and index of the road user, or −1."""

    distance: Float[np.ndarray, " R"]
    box: Int[np.ndarray, " R"]


class Lidar:
    """One LiDAR at its place. Rays into the static world are cast only once."""

    def __init__(self, spec: LidarSpec, pose: Pose6, surroundings: Surroundings) -> None:
        self.recording, self.reach = surroundings.recording, spec.reach
        self.pose = np.asarray(pose, float)
        self.body = spec.grid.directions()  # (R, 3), channel by channel
        self.directions = self.body @ rotation(self.pose[3:], np).T
        self.origin = self.pose[:3] - surroundings.static_world.center
        hits = surroundings.caster.cast(self.origin, self.directions, spec.reach)
        self.static_distance = hits.distance
        column = np.tile(np.arange(spec.azimuth_count), len(spec.elevations))
        self.phase = (column + 0.5) / spec.azimuth_count  # of a turn, 0 … 1

    def record(self, actors: FrameActors, rng: Generator) -> Scan:
        """The points of one turn."""
        returns = self.cast(actors, self.recording.turn)
        return self.scan(returns, len(actors.boxes), self.recording.noise, rng)

    def cast(self, actors: FrameActors, turn: float) -> Returns:
        """What the rays hit in one turn of ``turn`` seconds; if 0, all are fired at once."""
        distance, box = self.static_distance.copy(), np.full(len(self.body), -1)
        sectors = SECTORS if turn > 0 else 1
        sector = (self.phase * sectors).astype(int)
        for k in range(sectors):
            road_users, caster = actors.at(((k + 0.5) / sectors - 0.5) * turn)
            own = np.flatnonzero(sector == k)
            limit = np.minimum(distance[own], self.reach)
            hits = caster.cast(self.origin, self.directions[own], limit)
            hit = hits.face >= 0
            distance[own[hit]] = hits.distance[hit]
            box[own[hit]] = road_users.box[hits.face[hit]]
        return Returns(distance, box)

    def scan(self, returns: Returns, boxes: int, noise: LidarNoise, rng: Generator) -> Scan:
        """The points of the returns that are not lost; ``boxes`` is the number of road users."""
        points, back = apply_noise(self.body, returns.distance, noise, rng)
        own = returns.box[back]
        return Scan(self.pose, points, np.bincount(own[own >= 0], minlength=boxes))
