"""The scene's road users as CARLA's actors without physics, of each class, and close in size."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from inspe_jax.core.carla_frame import flip, from_carla, to_carla, whole_box
from inspe_jax.core.errors import InspeError
from inspe_jax.core.geometry import rotation
from inspe_jax.scene.traffic.carla_log import kind_of
from inspe_jax.scene.traffic.frames import CLASSES, ROAD_USERS, TrafficFrames
from inspe_jax.simulation.carla.server import ROLE_NAME, CarlaSession
from inspe_jax.simulation.frame import Boxes, Pose6, RoadUserBox

SPAWN_HEIGHT = 300.0
"""Actors are spawned this high above the junction [m], in free air, and then moved down."""
SPAWN_GAP = 8.0  # vertical distance between actors that are spawned together [m]
SIZE_TOLERANCE = 0.1
"""Blueprints are used whose error (log of a side) is at most so much above the best one's."""


@dataclass(frozen=True, eq=False)
class ActorBody:
    """A blueprint's box: its middle from the actor's origin in the body frame, its size [m]."""

    name: str
    middle: Float[np.ndarray, "3"]
    size: Float[np.ndarray, "3"]


class Actors:
    """The actors of the current frame's road users. ``seed`` decides blueprints and colours. Raises
    InspeError where the server has no blueprint for a class of the traffic."""

    def __init__(
        self, session: CarlaSession, traffic: TrafficFrames, lights: bool, seed: int
    ) -> None:
        self.session, self.traffic, self.lights, self.seed = session, traffic, lights, seed
        self.library = session.world.get_blueprint_library()
        where = traffic.center[traffic.valid]
        self.middle = where.mean(0) if len(where) else np.zeros(3)
        self.bodies = self._bodies()
        missing = sorted({*np.unique(traffic.kind[traffic.valid]).tolist()} - self.bodies.keys())
        if missing:
            raise InspeError(
                f"CARLA at {session.server} has no blueprint of a {CLASSES[missing[0]]}, which is "
                "in the traffic"
            )
        # By track: the actor's id, and what it is.
        self.present: dict[int, tuple[int, ActorBody]] = {}

    def move(self, t: int) -> None:
        """Place the road users of frame t; actors of others are destroyed."""
        seen = self.traffic.at(t)
        tracks = seen.track.tolist()
        gone = [track for track in self.present if track not in tracks]
        self.session.destroy(self.present.pop(track)[0] for track in gone)
        self._spawn([track for track in tracks if track not in self.present])
        put, commands = self.session.carla.command.ApplyTransform, []
        for track, *where in zip(tracks, seen.center, seen.yaw, seen.size, strict=True):
            actor, body = self.present[track]
            commands.append(put(actor, self.session.transform(to_carla(_origin(body, *where)))))
        self.session.command(commands)

    def boxes(self, t: int, snapshot: Any) -> Boxes:
        """The boxes of the road users of frame t, as the server has them in a snapshot."""
        found, seen = [], self.traffic.at(t)
        for kind, track, velocity in zip(seen.kind, seen.track, seen.velocity, strict=True):
            actor, body = self.present[int(track)]
            where = snapshot.find(actor).get_transform()
            at, turn = where.location, where.rotation
            pose = from_carla([at.x, at.y, at.z, turn.roll, turn.yaw, turn.pitch])
            box = RoadUserBox(
                track=int(track),
                kind=CLASSES[kind],
                name=body.name,
                center=pose[:3] + rotation(pose[3:], np) @ body.middle,
                yaw=float(pose[5]),
                size=body.size,
                velocity=np.asarray(velocity, float),
            )
            found.append(box)
        return tuple(found)

    def _bodies(self) -> dict[int, list[ActorBody]]:
        """The blueprints of each class that can be spawned: only an actor has a box."""
        found: dict[int, list[ActorBody]] = {}
        blueprints = [*self.library.filter("vehicle.*"), *self.library.filter("walker.*")]
        for k, blueprint in enumerate(sorted(blueprints, key=lambda blueprint: blueprint.id)):
            try:
                # An actor that was just destroyed may still be in the way, hence the heights.
                actor = self.session.spawn(blueprint, self._in_the_air(k % 9))
            except RuntimeError:
                continue
            usual = np.array(ROAD_USERS[_class_of(blueprint, 0.0)].size, float)
            body = body_of(blueprint.id, actor.bounding_box, usual)
            self.session.destroy([actor.id])
            found.setdefault(_class_of(blueprint, float(body.size[0])), []).append(body)
        return found

    def _body(self, track: int) -> ActorBody:
        """The body of a road user: a random one of about its size, always the same for a track."""
        own = self.traffic.valid & (self.traffic.track == track)
        bodies, size = self.bodies[int(self.traffic.kind[own][0])], self.traffic.size[own][0]
        off = np.array([np.abs(np.log(body.size / size)).max() for body in bodies])
        near = np.flatnonzero(off <= off.min() + SIZE_TOLERANCE)
        return bodies[np.random.default_rng([self.seed, track, 1]).choice(near)]

    def _in_the_air(self, k: int) -> Pose6:
        x, y, z = self.middle
        return to_carla([x, y, z + SPAWN_HEIGHT + SPAWN_GAP * k, 0.0, 0.0, 0.0])

    def _spawn(self, tracks: list[int]) -> None:
        command, state = self.session.carla.command, self.session.carla.VehicleLightState
        commands, bodies = [], [self._body(track) for track in tracks]
        for k, (track, body) in enumerate(zip(tracks, bodies, strict=True)):
            blueprint = self.library.find(body.name)
            blueprint.set_attribute("role_name", ROLE_NAME)
            if blueprint.has_attribute("color"):
                colours = blueprint.get_attribute("color").recommended_values
                rng = np.random.default_rng([self.seed, track, 2])
                blueprint.set_attribute("color", colours[int(rng.integers(len(colours)))])
            spawn = command.SpawnActor(blueprint, self.session.transform(self._in_the_air(k)))
            spawn.then(command.SetSimulatePhysics(command.FutureActor, False))
            if self.lights and body.name.startswith("vehicle."):
                lit = state(state.Position | state.LowBeam)
                spawn.then(command.SetVehicleLightState(command.FutureActor, lit))
            commands.append(spawn)
        actors = self.session.command(commands)
        self.present |= dict(zip(tracks, zip(actors, bodies, strict=True), strict=True))


def _origin(
    body: ActorBody, center: Float[np.ndarray, "3"], yaw: float, size: Float[np.ndarray, "3"]
) -> Pose6:
    """The pose of an actor whose box stands on a road user's ground, with its middle in plan."""
    middle = np.array([*center[:2], center[2] - size[2] / 2 + body.size[2] / 2])
    angles = np.array([0.0, 0.0, yaw])
    return np.array([*(middle - rotation(angles, np) @ body.middle), *angles])


def body_of(name: str, box: Any, usual: Float[np.ndarray, "3"]) -> ActorBody:
    """A blueprint's body, from an actor's bounding box, or of the ``usual`` size [m]."""
    middle, half = (np.array([v.x, v.y, v.z]) for v in (box.location, box.extent))
    middle, half = whole_box(middle, half, usual)
    return ActorBody(name, flip(middle), 2 * half)


def _class_of(blueprint: Any, length: float) -> int:
    """The class of a vehicle or a walker of this length [m], an index into ``CLASSES``."""
    facts = {}
    if blueprint.has_attribute("number_of_wheels"):
        facts["number_of_wheels"] = str(int(blueprint.get_attribute("number_of_wheels")))
    if blueprint.has_attribute("base_type"):
        facts["base_type"] = blueprint.get_attribute("base_type").as_str()
    kind = kind_of(blueprint.id, facts, length)
    assert kind is not None
    return kind
