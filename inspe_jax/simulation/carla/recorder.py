"""Records the sensors of a layout and the traffic of a scene in a CARLA server's town.

Exposure and weather change from tick to tick; LiDARs' rays are fired at one moment; there are no
masts. Tests run CARLA's client against a stand-in: a real server's data are untested.
"""

import time
from contextlib import ExitStack
from typing import Any, NoReturn, Self

import numpy as np

from inspe_jax.core.carla_frame import to_carla
from inspe_jax.core.errors import InspeError
from inspe_jax.scene.scene import Scene
from inspe_jax.sensing.conditions import FAIR, Conditions
from inspe_jax.sensing.layout import Layout
from inspe_jax.simulation.carla.sensors import SENSOR_KINDS, SensorQueue
from inspe_jax.simulation.carla.server import ROLE_NAME, CarlaSession, plain_errors, session_on
from inspe_jax.simulation.carla.traffic import Actors
from inspe_jax.simulation.frame import Boxes, Frame, Image, Scan
from inspe_jax.simulation.recorder import Recording, Server, frame_of, noise_source, row_of

SETTLE = 1.0  # simulated time before the first frame [s], in which cameras adjust their exposure
PATIENCE = 1.0  # how long to wait for the sensors' first measurements before the next tick [s]


class CarlaRecorder:
    """Records in a CARLA server's world, within a ``with`` block. Entering it raises InspeError
    where client, server or map do not fit, other traffic is there, or a sensor measures nothing. In
    the end actors, settings and weather are as before; only the map stays."""

    def __init__(
        self,
        scene: Scene,
        layout: Layout,
        conditions: Conditions = FAIR,
        recording: Recording | None = None,
        seed: int = 0,
        server: Server | None = None,
        appearance_seed: int = 0,
    ) -> None:
        self.recording, self.server = recording or Recording(), server or Server()
        self.recording.check()
        self.server.check()
        self.scene, self.conditions, self.seed = scene, conditions, seed
        self.appearance_seed = appearance_seed
        self.layout = conditions.layout(layout)
        self.poses = np.asarray(self.layout.poses, float)
        self.sensors = [
            row_of(SENSOR_KINDS, sensor.spec, "carla")(sensor.spec, self.recording)
            for sensor in self.layout.sensors
        ]
        self.notes = tuple(dict.fromkeys(note for one in self.sensors for note in one.notes))
        if scene.statics:
            self.notes += ("CARLA's town has bodies of its own: the scene's do not stand in it",)

    def __enter__(self) -> Self:
        with plain_errors(self.server), ExitStack() as stack:
            place, rate = self.scene.intersection, self.recording.rate
            opened = session_on(self.server, place, rate, self.conditions)
            self.session: CarlaSession = stack.enter_context(opened)
            lights = self.conditions != FAIR
            self.actors = Actors(self.session, self.scene.traffic, lights, self.appearance_seed)
            self.queues = [self._listen(s) for s in range(len(self.sensors))]
            self._warm_up()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: Any) -> None:
        with plain_errors(self.server):
            self._stack.__exit__(*error)

    def frame(self, t: int) -> Frame:
        """Frame t. Raises InspeError where the server or a sensor does not answer in time."""
        with plain_errors(self.server):
            self.actors.move(t)
            number = self.session.world.tick(self.server.timeout)
            boxes = self.actors.boxes(t, self.session.world.get_snapshot())
            recorded = [self._record(s, t, number, boxes) for s in range(len(self.sensors))]
        return frame_of(self.scene, self.layout, t, boxes, recorded)

    def _listen(self, s: int) -> dict[str, SensorQueue]:
        sensor, cords = self.layout.sensors[s], to_carla(self.poses[s])
        queues, unit = {}, self.layout.units[sensor.unit].name
        for name in self.sensors[s].blueprints:
            blueprint = self.actors.library.find(name)
            for key, value in {**self.sensors[s].attributes, "role_name": ROLE_NAME}.items():
                blueprint.set_attribute(key, value)
            actor = self.session.spawn(blueprint, cords)
            self.session.listening.append(actor)
            queues[name] = SensorQueue(actor, f"{name} of '{sensor.name}', unit '{unit}',")
        return queues

    def _warm_up(self) -> None:
        """Tick until every sensor has measured something, and cameras have settled."""
        begin, ticks = time.monotonic(), 0
        silent = [queue for queues in self.queues for queue in queues.values()]
        while silent or ticks < SETTLE * self.recording.rate:
            number = self.session.world.tick(self.server.timeout)
            ticks += 1
            until = time.monotonic() + PATIENCE
            silent = [queue for queue in silent if queue.take(number, until) is None]
            if silent and time.monotonic() > begin + self.server.timeout:
                self._fail(silent[0], "anything")

    def _fail(self, queue: SensorQueue, what: str) -> NoReturn:
        raise InspeError(
            f"CARLA at {self.server}: {queue.name} did not measure {what} within "
            f"{self.server.timeout:g} s; a slower machine needs a longer timeout"
        )

    def _record(self, s: int, t: int, number: int, boxes: Boxes) -> Image | Scan:
        """What sensor s measured in the server's frame ``number``, which is frame t."""
        until = time.monotonic() + self.server.timeout
        data = {}
        for name, queue in self.queues[s].items():
            data[name] = queue.take(number, until)
            if data[name] is None:
                self._fail(queue, f"frame {number}")
        return self.sensors[s].record(self.poses[s], data, boxes, noise_source(self.seed, t, s))
