"""The embedded recorder: simulates the sensors of a layout in a world of triangles."""

from collections.abc import Callable
from functools import cache, lru_cache
from typing import Any, Protocol

import numpy as np

from inspe_jax.scene.scene import Scene
from inspe_jax.sensing.conditions import FAIR, Conditions
from inspe_jax.sensing.layout import Layout
from inspe_jax.simulation.embedded.camera import Camera
from inspe_jax.simulation.embedded.ray_sensors import Lidar, Radar
from inspe_jax.simulation.embedded.road_users import FrameActors
from inspe_jax.simulation.embedded.surroundings import Surroundings
from inspe_jax.simulation.frame import Boxes, Frame, Image, Pose6, Scan
from inspe_jax.simulation.recorder import Recording, frame_of, noise_source, row_of


class SimulatedSensor(Protocol):
    """One sensor at its place."""

    def record(self, actors: FrameActors, rng: np.random.Generator) -> Image | Scan:
        """What the sensor records of one frame; ``rng`` is for its noise."""


SENSORS: dict[str, Callable[[Any, Pose6, Surroundings], SimulatedSensor]] = {
    "camera": Camera,
    "lidar": Lidar,
    "radar": Radar,
}
"""What simulates each ``kind`` of a spec. To add a kind, add a row."""


def simulated_sensor(spec: Any, pose: Pose6, surroundings: Surroundings) -> SimulatedSensor:
    """The simulation of a sensor. Raises InspeError for a kind that is not in :data:`SENSORS`."""
    return row_of(SENSORS, spec, "embedded")(spec, pose, surroundings)


class EmbeddedRecorder:
    """Records a scene's traffic with ray casting. ``seed`` is that of noise, ``appearance_seed`` of
    road users' shapes and colours. Raises InspeError where Embree is missing, the recording is not
    valid, or a sensor is of a kind that it does not know."""

    notes: tuple[str, ...] = ()

    def __init__(
        self,
        scene: Scene,
        layout: Layout,
        conditions: Conditions = FAIR,
        recording: Recording | None = None,
        seed: int = 0,
        appearance_seed: int = 0,
    ) -> None:
        self.scene, self.seed = scene, seed
        self.surroundings = Surroundings(scene, layout, conditions, recording, appearance_seed)
        self.layout, poses = conditions.layout(layout), np.asarray(layout.poses, float)
        self.sensors = [
            simulated_sensor(sensor.spec, poses[s], self.surroundings)
            for s, sensor in enumerate(self.layout.sensors)
        ]

    def frame(self, t: int) -> Frame:
        """Frame t of the scene's traffic, as every station recorded it."""
        actors = self.surroundings.actors(t)
        recorded = [
            sensor.record(actors, noise_source(self.seed, t, s))
            for s, sensor in enumerate(self.sensors)
        ]
        return frame_of(self.scene, self.layout, t, actors.boxes, recorded)


class LiveSensor:
    """Sensor ``s`` of a layout, recorded wherever it is held. At its own pose it records what
    :class:`EmbeddedRecorder` does, with the same errors; elsewhere its unit has no mast."""

    def __init__(
        self,
        scene: Scene,
        layout: Layout,
        s: int,
        conditions: Conditions = FAIR,
        recording: Recording | None = None,
        seed: int = 0,
    ) -> None:
        sensor, given = layout.sensors[s], (scene, layout, conditions, recording)
        self.spec, self._own = conditions.spec(sensor.spec), tuple(map(float, layout.poses[s]))
        self._s, self._seed, own = s, seed, Surroundings(*given)
        moved = cache(lambda: Surroundings(*given, mastless=sensor.unit))

        @lru_cache(maxsize=1)
        def placed(*pose: float) -> SimulatedSensor:
            around = own if pose == self._own else moved()
            return simulated_sensor(self.spec, np.array(pose), around)

        self._placed, self._actors = placed, lru_cache(maxsize=1)(own.actors)

    def record(self, t: int, pose: Pose6 | None = None) -> tuple[Boxes, Image | Scan]:
        """Road users of frame t, and what the sensor records of them at a pose, or at its own."""
        at = self._own if pose is None else map(float, pose)
        actors, noise = self._actors(t), noise_source(self._seed, t, self._s)
        return actors.boxes, self._placed(*at).record(actors, noise)
