"""The scene's road users as CARLA's actors: one per track, of its class, and close to its size.

Actors have no physics: they stand upright where they are placed, and people glide. The boxes in
frames are those that the server has for the actors, at the places that the server reports.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from inspe_jax.core.carla_frame import flip, from_carla, to_carla
from inspe_jax.core.errors import InspeError
from inspe_jax.core.geometry import rotation
from inspe_jax.scene.traffic.carla_log import kind_of
from inspe_jax.scene.traffic.frames import CLASSES, ROAD_USERS, TrafficFrames
from inspe_jax.simulation.carla.server import ROLE_NAME, CarlaSession
from inspe_jax.simulation.frame import RoadUserBox

SPAWN_HEIGHT = 300.0
"""Actors are spawned this high above the junction [m], where the air is free, and then moved
down."""
SPAWN_GAP = 8.0
"""Vertical distance between actors that are spawned together [m]."""
SIZE_TOLERANCE = 0.1
"""A blueprint may be used if its error in size is at most this much larger than the best one's. The
error is the largest absolute logarithm of the ratios of length, width and height."""
THINNEST = 0.05
"""Half sizes below this do not count [m]: some versions of CARLA give two-wheelers no width."""

_BODIES: dict[tuple[str, str], "ActorBody | None"] = {}


@dataclass(frozen=True, eq=False)
class ActorBody:
    """A blueprint's box: its middle relative to the actor's origin, in the body frame (x forward, y
    left, z up), and its size [m]."""

    name: str
    middle: Float[np.ndarray, "3"]
    size: Float[np.ndarray, "3"]


class Actors:
    """The actors that stand for the road users of the current frame.

    ``lights`` switches the vehicles' lights on; ``seed`` decides blueprints and colours. Raises
    InspeError where the server has no blueprint for a class of the traffic.
    """

    def __init__(
        self, session: CarlaSession, traffic: TrafficFrames, lights: bool, seed: int
    ) -> None:
        self.session, self.traffic, self.lights, self.seed = session, traffic, lights, seed
        self.library = session.world.get_blueprint_library()
        where = traffic.center[traffic.valid]
        self.middle = where.mean(0) if len(where) else np.zeros(3)
        kinds = {int(kind) for kind in np.unique(traffic.kind[traffic.valid])}
        self.bodies = self._bodies(kinds)
        self.present: dict[
            int, tuple[int, ActorBody]
        ] = {}  # by track: the actor's id, and what it is

    def move(self, t: int) -> None:
        """Place the road users of frame t; actors of others are destroyed."""
        here = {int(self.traffic.track[t, b]): b for b in self._entries(t)}
        gone = [track for track in self.present if track not in here]
        self.session.destroy(self.present.pop(track)[0] for track in gone)
        self._spawn(t, {track: b for track, b in here.items() if track not in self.present})
        put = self.session.carla.command.ApplyTransform
        self.session.command(
            [
                put(actor, self.session.transform(to_carla(self._origin(t, here[track], body))))
                for track, (actor, body) in self.present.items()
            ]
        )

    def boxes(self, t: int, snapshot: Any) -> tuple[RoadUserBox, ...]:
        """The boxes of the road users of frame t, as the server has them in a snapshot."""
        found = []
        for b in self._entries(t):
            track = int(self.traffic.track[t, b])
            actor, body = self.present[track]
            state = snapshot.find(actor)
            if state is None:
                raise InspeError(
                    f"CARLA at {self.session.server}: track {track}, a {body.name}, is gone from "
                    "the world: does another client destroy actors?"
                )
            where = state.get_transform()
            at, turn = where.location, where.rotation
            pose = from_carla([at.x, at.y, at.z, turn.roll, turn.yaw, turn.pitch])
            found.append(
                RoadUserBox(
                    track=track,
                    kind=CLASSES[self.traffic.kind[t, b]],
                    name=body.name,
                    center=pose[:3] + rotation(pose[3:], np) @ body.middle,
                    yaw=float(pose[5]),
                    size=body.size,
                    velocity=np.asarray(self.traffic.velocity[t, b], float),
                )
            )
        return tuple(found)

    # ── Blueprints ──────────────────────────────────────────────────────────

    def _bodies(self, kinds: set[int]) -> dict[int, tuple[ActorBody, ...]]:
        """The blueprints of each class. Each is spawned once, because only an actor has a box."""
        version = self.session.client.get_server_version()
        found: dict[int, list[ActorBody]] = {}
        names = [*self.library.filter("vehicle.*"), *self.library.filter("walker.*")]
        for blueprint in sorted(names, key=lambda blueprint: blueprint.id):
            kind = kind_of(blueprint.id, _attributes(blueprint), 0.0)
            if kind is None or not kinds & {kind, *_longer(kind)}:
                continue
            if (version, blueprint.id) not in _BODIES:
                _BODIES[version, blueprint.id] = self._try_blueprint(blueprint, len(_BODIES))
            body = _BODIES[version, blueprint.id]
            if body is None:
                continue
            kind = kind_of(blueprint.id, _attributes(blueprint), float(body.size[0]))
            if kind is not None:
                found.setdefault(kind, []).append(body)
        missing = [CLASSES[kind] for kind in sorted(kinds) if kind not in found]
        if missing:
            raise InspeError(
                f"CARLA at {self.session.server} has no blueprint of a {missing[0]}, which is in "
                "the traffic"
            )
        return {kind: tuple(bodies) for kind, bodies in found.items()}

    def _try_blueprint(self, blueprint: Any, k: int) -> ActorBody | None:
        """The body of a blueprint, None where it cannot be spawned. ``k`` decides at which height:
        an actor that was just destroyed may still be in the way."""
        actor = self.session.try_spawn(blueprint, to_carla(self._spawn_pose(k % 9)))
        if actor is None:
            return None
        box = actor.bounding_box
        self.session.destroy([actor.id])
        return body_of(blueprint.id, box, _usual_size(blueprint))

    def _body(self, t: int, b: int) -> ActorBody:
        """The body of a road user: a random one of about its size, always the same for a track."""
        bodies = self.bodies[int(self.traffic.kind[t, b])]
        first = self.traffic.track == self.traffic.track[t, b]
        size = self.traffic.size[first & self.traffic.valid][0]
        off = np.array([np.abs(np.log(body.size / size)).max() for body in bodies])
        near = np.flatnonzero(off <= off.min() + SIZE_TOLERANCE)
        return bodies[self._rng(t, b, 1).choice(near)]

    def _rng(self, t: int, b: int, purpose: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, int(self.traffic.track[t, b]), purpose])

    def _entries(self, t: int) -> list[int]:
        """Indices of the valid entries of frame t."""
        entries: list[int] = np.flatnonzero(self.traffic.valid[t]).tolist()
        return entries

    # ── Poses ───────────────────────────────────────────────────────────────

    def _spawn_pose(self, k: int) -> Float[np.ndarray, "6"]:
        return np.array(
            [*self.middle[:2], self.middle[2] + SPAWN_HEIGHT + SPAWN_GAP * k, 0.0, 0.0, 0.0]
        )

    def _origin(self, t: int, b: int, body: ActorBody) -> Float[np.ndarray, "6"]:
        """The pose of an actor whose box stands on the same ground as the road user's, with the
        same middle in plan."""
        yaw, center = float(self.traffic.yaw[t, b]), self.traffic.center[t, b]
        foot = center[2] - self.traffic.size[t, b, 2] / 2
        middle = np.array([center[0], center[1], foot + body.size[2] / 2])
        angles = np.array([0.0, 0.0, yaw])
        return np.array([*(middle - rotation(angles, np) @ body.middle), *angles])

    def _spawn(self, t: int, here: dict[int, int]) -> None:
        """Spawn the actors of road users of frame t, high in the air. ``here`` maps tracks to their
        entries in the frame."""
        command = self.session.carla.command
        commands, bodies = [], []
        for k, b in enumerate(here.values()):
            body = self._body(t, b)
            spawn = command.SpawnActor(
                self._blueprint(body.name, self._rng(t, b, 2)),
                self.session.transform(to_carla(self._spawn_pose(k))),
            )
            spawn.then(command.SetSimulatePhysics(command.FutureActor, False))
            if self.lights and body.name.startswith("vehicle."):
                state = self.session.carla.VehicleLightState
                lit = state(state.Position | state.LowBeam)
                spawn.then(command.SetVehicleLightState(command.FutureActor, lit))
            commands.append(spawn)
            bodies.append(body)
        actors = self.session.command(commands)
        self.present |= dict(zip(here, zip(actors, bodies, strict=True), strict=True))

    def _blueprint(self, name: str, rng: np.random.Generator) -> Any:
        blueprint = self.library.find(name)
        blueprint.set_attribute("role_name", ROLE_NAME)
        if blueprint.has_attribute("color"):
            colours = blueprint.get_attribute("color").recommended_values
            blueprint.set_attribute("color", colours[int(rng.integers(len(colours)))])
        return blueprint


def body_of(name: str, box: Any, usual: Float[np.ndarray, "3"]) -> ActorBody:
    """A blueprint's body, from the bounding box of an actor.

    ``usual`` is the size to take where the box has none [m]. A box without a height is taken to
    stand on the ground, at the actor's origin.
    """
    middle, half = (np.array([v.x, v.y, v.z]) for v in (box.location, box.extent))
    given = np.isfinite(half) & (half > THINNEST)
    half = np.where(given, half, usual / 2)
    middle = np.where(np.isfinite(middle), middle, 0.0)
    if not given[2]:
        middle[2] = half[2]
    return ActorBody(name, flip(middle), 2 * half)


def _attributes(blueprint: Any) -> dict[str, str]:
    """The attributes of a blueprint that tell a vehicle's class."""
    facts = {}
    if blueprint.has_attribute("number_of_wheels"):
        facts["number_of_wheels"] = str(int(blueprint.get_attribute("number_of_wheels")))
    if blueprint.has_attribute("base_type"):
        facts["base_type"] = blueprint.get_attribute("base_type").as_str()
    return facts


def _longer(kind: int) -> tuple[int, ...]:
    """Classes that a vehicle may have as well, once its length is known: a long car is a truck."""
    return (CLASSES.index("truck"),) if CLASSES[kind] == "car" else ()


def _usual_size(blueprint: Any) -> Float[np.ndarray, "3"]:
    """The usual size of a blueprint's class, for boxes without a size [m]."""
    kind = kind_of(blueprint.id, _attributes(blueprint), 0.0)
    assert kind is not None
    return np.array(ROAD_USERS[kind].size, float)
