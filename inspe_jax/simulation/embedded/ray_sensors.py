"""LiDARs and radars in a world of triangles.

A LiDAR has one turn per frame, centred on its time, in which road users move. What a radar has:

1. Rays that fill the beam meet road users, and each adds to an echo as the radar equation has it
   (:mod:`inspe_jax.scoring.radar_evidence`), unless it is slower than the radar finds.
2. Rays in one cell of range, azimuth and radial speed make one echo, found with its chance.
3. Its place and speed are the mean of its rays, with the noise of a cell that is hit anywhere.

Echoes by way of walls and the road, and false alarms, are left out; a near car has tens of echoes.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.random import Generator

from inspe_jax.core.geometry import rotation
from inspe_jax.scene.traffic.frames import CLASSES
from inspe_jax.scoring.detection import detection_curves
from inspe_jax.scoring.target_evidence import SIZES, WIDTH
from inspe_jax.sensing.radar import RadarSpec
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


class RaySensor:
    """A sensor at its place. Rays into the static world are cast only once."""

    def __init__(self, spec: Any, pose: Pose6, surroundings: Surroundings) -> None:
        self.pose, self.reach = np.asarray(pose, float), spec.reach
        self.body = spec.grid.directions()  # (R, 3), channel by channel
        self.directions = self.body @ rotation(self.pose[3:], np).T
        self.origin = self.pose[:3] - surroundings.static_world.center
        hits = surroundings.caster.cast(self.origin, self.directions, spec.reach)
        self.static_distance = hits.distance


class Lidar(RaySensor):
    """One LiDAR at its place."""

    def __init__(self, spec: LidarSpec, pose: Pose6, surroundings: Surroundings) -> None:
        super().__init__(spec, pose, surroundings)
        self.recording = surroundings.recording
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


class Radar(RaySensor):
    """One radar at its place."""

    def __init__(self, spec: RadarSpec, pose: Pose6, surroundings: Surroundings) -> None:
        super().__init__(spec, pose, surroundings)
        self.spec, self.limit = spec, np.minimum(self.static_distance, spec.reach)
        self.steradians = 2 * np.sin(spec.elevation_fov / 2) * spec.azimuth_fov / len(self.body)

    def record(self, actors: FrameActors, rng: Generator) -> Scan:
        """The echoes of one frame as points, each with its chance as intensity and its speed."""
        spec, (road_users, caster) = self.spec, actors.at(0.0)
        hits = caster.cast(self.origin, self.directions, self.limit)
        met = np.flatnonzero(hits.face >= 0)
        box = road_users.box[hits.face[met]]
        speed = (actors.velocity[box] * self.directions[met]).sum(-1)
        fast = np.abs(speed) >= spec.min_speed
        met, box, speed = met[fast], box[fast], speed[fast]

        curves = detection_curves().of(spec.kind)
        kinds = np.array([CLASSES.index(each.kind) for each in actors.boxes], int)[box]
        area = (WIDTH * SIZES[:, 2])[kinds]
        half = np.array([curve.half for curve in curves])[kinds]
        far, (x, y, z) = hits.distance[met], self.body[met].T
        power = self.steradians * spec.reach**4 / (far**2 * area * half)

        measured = np.stack([far, np.arctan2(y, x), speed, np.arcsin(z)])  # (4, hits)
        cell = np.array([spec.range_resolution, spec.azimuth_resolution, spec.speed_resolution])
        _, first, own = np.unique(
            np.floor(measured[:3] / cell[:, None]), axis=1, return_index=True, return_inverse=True
        )
        count = len(first)
        total = np.bincount(own, power, count)
        mean = np.stack([np.bincount(own, power * row, count) / total for row in measured])
        chance = 1 / (1 + total ** -curves[0].slope)
        found = rng.random(count) < chance
        mean[:3] += rng.standard_normal((3, count)) * cell[:, None] / 12**0.5
        (far, azimuth, speed, up), owner = mean[:, found], box[first[found]]
        plan = far * np.cos(up)
        points = np.column_stack(
            [plan * np.cos(azimuth), plan * np.sin(azimuth), far * np.sin(up), chance[found]]
        )
        counted = np.bincount(owner, minlength=len(actors.boxes))
        return Scan(self.pose, points.astype(np.float32), counted, speed.astype(np.float32))
