"""What the sensors of a layout record of a scene's traffic, by a CARLA server.

The server has the town; the traffic is the scene's, put in place frame by frame. A frame is the
same however often it is asked for as far as the simulator lets it be: exposure, weather and wind
go on from tick to tick. Unlike the embedded recorder's, a LiDAR's turn is all at one moment, as
CARLA has it, and sensors hang in the air.
"""

import time
from contextlib import ExitStack
from types import TracebackType
from typing import Any, Self

import numpy as np

from inspe_jax.core.carla_frame import to_carla
from inspe_jax.core.errors import InspeError
from inspe_jax.scene.scene import Scene
from inspe_jax.sensing.conditions import FAIR, Conditions
from inspe_jax.sensing.layout import Layout
from inspe_jax.sensing.sensors import CameraSpec
from inspe_jax.simulation.carla.instances import instances_of
from inspe_jax.simulation.carla.sensors import (
    LIDAR,
    NEEDS,
    PICTURES,
    SensorQueue,
    camera_attributes,
    colours_of,
    depth_of,
    intrinsic_of,
    lidar_attributes,
    notes_of,
    numbers_of,
    points_of,
    tags_of,
    weather_of,
)
from inspe_jax.simulation.carla.server import OURS, CarlaSession, failing_plainly, session_on
from inspe_jax.simulation.carla.traffic import Actors
from inspe_jax.simulation.embedded.lidar import apply_noise
from inspe_jax.simulation.frame import Frame, Image, RoadUserBox, Scan
from inspe_jax.simulation.recorder import Recording, Server, recordable, stations_of

SETTLE = 1.0
"""The world goes on for so long before the first frame [s]: cameras find their exposure."""
PATIENCE = 1.0
"""So long we wait for a sensor's first measurement before we tick once more [s]."""


class CarlaRecorder:
    """The sensors in a CARLA server's world, within a ``with`` block.

    ``notes`` tell what CARLA cannot record as the layout has it. Entering raises InspeError where
    the client is missing; there is no server or one of another version; it has not the map that
    the scene is of; others' traffic is there; or a sensor does not answer. However the block is
    left, what was spawned is destroyed and settings and weather are as they were; the map stays.
    """

    def __init__(
        self,
        scene: Scene,
        layout: Layout,
        conditions: Conditions = FAIR,
        recording: Recording | None = None,
        seed: int = 0,
        server: Server | None = None,
    ) -> None:
        self.recording, self.server = recording or Recording(), server or Server()
        self.recording.check()
        self.server.check()
        self.scene, self.conditions, self.seed = scene, conditions, seed
        self.layout = conditions.layout(layout)
        self.poses = np.asarray(self.layout.poses, float)
        self.notes = notes_of(self.layout)
        pictures = [kind for layer in self.recording.layers for kind in NEEDS[layer]]
        self.pictures = tuple(dict.fromkeys(("rgb", *pictures)))

    def __enter__(self) -> Self:
        with failing_plainly(self.server), ExitStack() as stack:
            self.session: CarlaSession = stack.enter_context(
                session_on(
                    self.server,
                    self.scene.intersection,
                    self.recording.rate,
                    lambda carla: weather_of(carla, self.conditions),
                )
            )
            lights = self.conditions != FAIR
            self.actors = Actors(self.session, self.scene.traffic, lights, self.seed)
            self.ears = [self._ears(s) for s in range(len(self.layout))]
            self._warm_up()
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with failing_plainly(self.server):
            self._stack.__exit__(kind, error, trace)

    def frame(self, t: int) -> Frame:
        """Frame t, as every station recorded it.

        Raises InspeError where the server or a sensor does not answer.
        """
        with failing_plainly(self.server):
            self.actors.move(t)
            number = self.session.world.tick(self.server.timeout)
            snapshot = self.session.world.get_snapshot()
            if snapshot.frame != number:
                raise InspeError(
                    f"CARLA at {self.server}: time went on to frame {snapshot.frame} after we "
                    f"asked for {number}: does another client tick?"
                )
            things = self.actors.things(t, snapshot)
            seen = [self._seen(s, t, number, things) for s in range(len(self.layout))]
        stations = stations_of(self.layout, seen)
        return Frame(t, float(self.scene.traffic.time[t]), things, stations)

    # ── Sensors ─────────────────────────────────────────────────────────────

    def _ears(self, s: int) -> dict[str, SensorQueue]:
        """CARLA's sensors that one of the layout stands for, by what they bring."""
        sensor, cords = self.layout.sensors[s], to_carla(self.poses[s])
        spec = recordable(sensor.spec)
        if isinstance(spec, CameraSpec):
            attributes = camera_attributes(spec, self.recording.image_scale)
            names = {kind: PICTURES[kind] for kind in self.pictures}
        else:
            attributes = lidar_attributes(spec, self.recording.rate)
            names = {"points": LIDAR}
        ears, unit = {}, self.layout.units[sensor.unit].name
        for kind, name in names.items():
            blueprint = self.actors.library.find(name)
            for key, value in {**attributes, "role_name": OURS}.items():
                blueprint.set_attribute(key, value)
            actor = self.session.spawn(blueprint, cords)
            self.session.listening.append(actor)
            ears[kind] = SensorQueue(actor, f"{name} of '{sensor.name}', unit '{unit}',")
        return ears

    def _warm_up(self) -> None:
        """Tick until every sensor has brought something, and cameras have settled."""
        begin, ticks = time.monotonic(), 0
        everything = [ear for ears in self.ears for ear in ears.values()]
        silent = everything
        while silent or ticks < SETTLE * self.recording.rate:
            self.session.world.tick(self.server.timeout)
            ticks += 1
            until = time.monotonic() + PATIENCE
            silent = [ear for ear in everything if not ear.wait(until)]
            if silent and time.monotonic() > begin + self.server.timeout:
                self._missing(silent[0], "anything")

    def _missing(self, ear: SensorQueue, what: str) -> None:
        raise InspeError(
            f"CARLA at {self.server}: {ear.name} did not bring {what} in "
            f"{self.server.timeout:g} s; a slower machine needs a longer timeout"
        )

    def _seen(self, s: int, t: int, number: int, things: tuple[RoadUserBox, ...]) -> Image | Scan:
        """What a sensor brings of the server's frame ``number``."""
        until = time.monotonic() + self.server.timeout
        brought: dict[str, Any] = {}
        for kind, ear in self.ears[s].items():
            brought[kind] = ear.take(number, until)
            if brought[kind] is None:
                self._missing(ear, f"frame {number}")
        pose, spec = self.poses[s], self.layout.sensors[s].spec
        if not isinstance(spec, CameraSpec):
            rng = np.random.default_rng([self.seed, t, s, 3])
            return Scan(pose, apply_noise(*points_of(brought["points"]), self.recording.noise, rng))
        intrinsic = intrinsic_of(spec, self.recording.image_scale)
        whole: dict[str, Any] = {}
        if "depth" in brought:
            whole["depth"] = depth_of(brought["depth"])
        if "instance" in brought:
            picture = brought["instance"]
            whole["instance"] = instances_of(
                tags_of(picture), numbers_of(picture), whole["depth"], pose, intrinsic, things
            )
        if "semantic" in brought:
            whole["semantic"] = tags_of(brought["semantic"])
        layers = {name: whole[name] for name in self.recording.layers}
        return Image(pose, intrinsic, colours_of(brought["rgb"]), **layers)
