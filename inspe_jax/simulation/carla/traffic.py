"""Our road users as CARLA's actors: one a track, of its class and near its size, put where it is.

Actors have no physics: they stand upright where they are put, and people glide. What frames tell
of them is the box that the server has for them, where it says that they were.
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
from inspe_jax.simulation.carla.server import OURS, CarlaSession
from inspe_jax.simulation.frame import RoadUserBox

ALOFT = 300.0
"""Actors appear so high above the junction [m], where nothing is, and are put down from there."""
APART = 8.0
"""… one above the other by this much [m]."""
NEAR = 0.1
"""Blueprints whose size is off by this much more than the nearest one's will do as well: of the
logarithm of length, width or height."""
THINNEST = 0.05
"""Half a size below this is none [m]: some versions have no width for two wheels."""

_KNOWN: dict[tuple[str, str], "ActorBody | None"] = {}


@dataclass(frozen=True, eq=False)
class ActorBody:
    """A blueprint's box: its middle from the actor's origin, in our body frame, and size [m]."""

    name: str
    middle: Float[np.ndarray, "3"]
    size: Float[np.ndarray, "3"]


class Actors:
    """Everybody of the traffic who is in the world just now."""

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
        """Put everybody of frame t in place, and nobody else."""
        here = {int(self.traffic.track[t, b]): b for b in self._entries(t)}
        gone = [track for track in self.present if track not in here]
        self.session.destroy(self.present.pop(track)[0] for track in gone)
        self._appear(t, {track: b for track, b in here.items() if track not in self.present})
        put = self.session.carla.command.ApplyTransform
        self.session.command(
            [
                put(actor, self.session.transform(to_carla(self._origin(t, here[track], body))))
                for track, (actor, body) in self.present.items()
            ]
        )

    def boxes(self, t: int, snapshot: Any) -> tuple[RoadUserBox, ...]:
        """The road users of frame t, as the server has them."""
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

    # ── Who they are ────────────────────────────────────────────────────────

    def _bodies(self, kinds: set[int]) -> dict[int, tuple[ActorBody, ...]]:
        """What the library has of each class, by trying each once: only an actor has a box."""
        version = self.session.client.get_server_version()
        found: dict[int, list[ActorBody]] = {}
        names = [*self.library.filter("vehicle.*"), *self.library.filter("walker.*")]
        for blueprint in sorted(names, key=lambda blueprint: blueprint.id):
            might = kind_of(blueprint.id, _facts(blueprint), 0.0)
            if might is None or not kinds & {might, *_longer(might)}:
                continue
            if (version, blueprint.id) not in _KNOWN:
                _KNOWN[version, blueprint.id] = self._tried(blueprint, len(_KNOWN))
            body = _KNOWN[version, blueprint.id]
            if body is None:
                continue
            kind = kind_of(blueprint.id, _facts(blueprint), float(body.size[0]))
            if kind is not None:
                found.setdefault(kind, []).append(body)
        missing = [CLASSES[kind] for kind in sorted(kinds) if kind not in found]
        if missing:
            raise InspeError(
                f"CARLA at {self.session.server} has no blueprint of a {missing[0]}, which is in "
                "the traffic"
            )
        return {kind: tuple(bodies) for kind, bodies in found.items()}

    def _tried(self, blueprint: Any, k: int) -> ActorBody | None:
        """What a blueprint makes, None where it makes nothing. Who was destroyed may still be in
        the way."""
        actor = self.session.try_spawn(blueprint, to_carla(self._aloft(k % 9)))
        if actor is None:
            return None
        box = actor.bounding_box
        self.session.destroy([actor.id])
        return body_of(blueprint.id, box, _usual(blueprint))

    def _body(self, t: int, b: int) -> ActorBody:
        """Of a road user: by chance among those near its size, the same whenever it appears."""
        bodies = self.bodies[int(self.traffic.kind[t, b])]
        first = self.traffic.track == self.traffic.track[t, b]
        size = self.traffic.size[first & self.traffic.valid][0]
        off = np.array([np.abs(np.log(body.size / size)).max() for body in bodies])
        near = np.flatnonzero(off <= off.min() + NEAR)
        return bodies[self._dice(t, b, 1).choice(near)]

    def _dice(self, t: int, b: int, purpose: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, int(self.traffic.track[t, b]), purpose])

    def _entries(self, t: int) -> list[int]:
        """Entries of frame t that are no padding."""
        entries: list[int] = np.flatnonzero(self.traffic.valid[t]).tolist()
        return entries

    # ── Where they are ──────────────────────────────────────────────────────

    def _aloft(self, k: int) -> Float[np.ndarray, "6"]:
        return np.array([*self.middle[:2], self.middle[2] + ALOFT + APART * k, 0.0, 0.0, 0.0])

    def _origin(self, t: int, b: int, body: ActorBody) -> Float[np.ndarray, "6"]:
        """The pose of an actor whose box stands where the road user's does, middle on middle."""
        yaw, center = float(self.traffic.yaw[t, b]), self.traffic.center[t, b]
        foot = center[2] - self.traffic.size[t, b, 2] / 2
        middle = np.array([center[0], center[1], foot + body.size[2] / 2])
        angles = np.array([0.0, 0.0, yaw])
        return np.array([*(middle - rotation(angles, np) @ body.middle), *angles])

    def _appear(self, t: int, here: dict[int, int]) -> None:
        """Spawn those of frame t, by track and entry, up in the air."""
        command = self.session.carla.command
        commands, bodies = [], []
        for k, b in enumerate(here.values()):
            body = self._body(t, b)
            spawn = command.SpawnActor(
                self._painted(body.name, self._dice(t, b, 2)),
                self.session.transform(to_carla(self._aloft(k))),
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

    def _painted(self, name: str, dice: np.random.Generator) -> Any:
        blueprint = self.library.find(name)
        blueprint.set_attribute("role_name", OURS)
        if blueprint.has_attribute("color"):
            colours = blueprint.get_attribute("color").recommended_values
            blueprint.set_attribute("color", colours[int(dice.integers(len(colours)))])
        return blueprint


def body_of(name: str, box: Any, usual: Float[np.ndarray, "3"]) -> ActorBody:
    """A blueprint's body by the bounding box of its actor; ``usual`` where that has no size [m].

    A box without a height stands on the ground, as the actor does.
    """
    middle, half = (np.array([v.x, v.y, v.z]) for v in (box.location, box.extent))
    given = np.isfinite(half) & (half > THINNEST)
    half = np.where(given, half, usual / 2)
    middle = np.where(np.isfinite(middle), middle, 0.0)
    if not given[2]:
        middle[2] = half[2]
    return ActorBody(name, flip(middle), 2 * half)


def _facts(blueprint: Any) -> dict[str, str]:
    """What tells a vehicle's class."""
    facts = {}
    if blueprint.has_attribute("number_of_wheels"):
        facts["number_of_wheels"] = str(int(blueprint.get_attribute("number_of_wheels")))
    if blueprint.has_attribute("base_type"):
        facts["base_type"] = blueprint.get_attribute("base_type").as_str()
    return facts


def _longer(kind: int) -> tuple[int, ...]:
    """What a vehicle may be, too, by its length, which is not known before it is tried."""
    return (CLASSES.index("truck"),) if CLASSES[kind] == "car" else ()


def _usual(blueprint: Any) -> Float[np.ndarray, "3"]:
    """The size of those whose box the server does not know."""
    kind = kind_of(blueprint.id, _facts(blueprint), 0.0)
    assert kind is not None
    return np.array(ROAD_USERS[kind].size, float)
