"""The world behind the wire-level CARLA server: one episode, and what clients may do to it.

There is no simulation: actors stay where they are placed. There is no gravity, and the only
collision is an actor that is spawned where another one is. Calls that recording does not need are
not answered, so that the client raises a RuntimeError.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from carla_blueprints import BLUEPRINTS, SPECTATOR, Blueprint, definitions
from carla_rays import (
    GROUND,
    Box,
    cast,
    colour_of,
    instance_of,
    matrix,
    overlap,
    pose,
    swept,
)

VERSION = "0.9.16"
SNAPSHOTS = 1
"""The number of the stream of snapshots; those of sensors follow it. Actors have other numbers."""
SETTINGS = [False, False, [False], True, 0.01, 10, 0.0, True, 3000.0, 2000.0, True]
NOON = [5.0, 0.0, 0.0, 10.0, -1.0, 45.0, 2.0, 0.75, 0.1, 0.0, 1.0, 0.03, 0.0331, 0.0]
STEP = 0.05
"""Seconds per frame, if no fixed time is set."""
LOADING = 0.3
"""Seconds without frames while a map is loaded."""

CALLS: dict[str, Callable] = {}
"""The calls of a client, and the methods of the world that answer them."""

COMMANDS = {0: "spawn_actor", 1: "destroy_actor", 6: "set_actor_transform"}
"""The calls of the commands in a batch, by number."""


class Refused(Exception):
    """An error that the client raises as a RuntimeError."""


def call(method: Callable) -> Callable:
    CALLS[method.__name__] = method
    return method


@dataclass
class Actor:
    """Its pose is in the world, or in the frame of its parent, if it has one.

    A sensor has a stream, the time since its last measurement, and a LiDAR's angle [deg].
    """

    number: int
    blueprint: Blueprint
    description: list
    pose: tuple[float, ...]
    parent: int = 0
    stream: int = 0
    since: float = 0.0
    angle: float = 0.0
    attributes: dict[str, str] = field(init=False)

    def __post_init__(self):
        given = {name: value for name, _, value in self.description[2]}
        self.attributes = self.blueprint.defaults | given

    @property
    def solid(self) -> bool:
        return self.blueprint.extent != (0.0, 0.0, 0.0)


class World:
    """State of the episode; `token` gives the address of a stream."""

    def __init__(
        self, maps: Sequence[Path], token: Callable[[int], bytes], scenery: Sequence[dict] = ()
    ):
        self.maps = {path.stem: path.read_text() for path in maps}
        self.map, self.token, self.scenery = maps[0].stem, token, scenery
        self.solids = [
            Box(matrix(s["pose"]), tuple(s["extent"]), s["tag"], 60000 + k, (120, 110, 100))
            for k, s in enumerate(scenery)
        ]
        self.release, self.hidden = VERSION, set()
        self.numbers, self.streams = iter(range(24, 10**9)), iter(range(SNAPSHOTS + 1, 10**9))
        self.awaited: Counter[int] = (
            Counter()
        )  # streams that a client asked for, but did not connect to yet
        self.episode, self.frame, self.time = 7, 100, 5.0
        self.ticked, self.fresh, self.loaded = False, False, 0.0
        self.settings, self.weather = list(SETTINGS), list(NOON)
        self.begin()

    def begin(self) -> None:
        self.actors: dict[int, Actor] = {}
        self.spectator = self.add(SPECTATOR, [0, "spectator", []], (0.0, 0.0, 10.0, 0.0, 0.0, 0.0))

    # -- Episode -------------------------------------------------------------------------------

    @call
    def version(self) -> str:
        return self.release

    @call
    def get_episode_info(self) -> list:
        return [self.episode, [self.token(SNAPSHOTS)]]

    @call
    def get_sensor_token(self, stream: int) -> list:
        self.awaited[stream] += 1
        return [self.token(stream)]

    @call
    def get_episode_settings(self) -> list:
        return self.settings

    @call
    def set_episode_settings(self, settings: list) -> int:
        self.settings = settings
        return self.frame

    @call
    def get_weather_parameters(self) -> list:
        return self.weather

    @call
    def set_weather_parameters(self, weather: list) -> None:
        self.weather = weather

    @call
    def query_lights_state(self, client: str) -> list:
        return []

    # -- Map -----------------------------------------------------------------------------------

    @call
    def get_available_maps(self) -> list[str]:
        return [f"/Game/Carla/Maps/{name}" for name in self.maps]

    @call
    def get_map_info(self) -> list:
        """The name; there are no spawn points."""
        return [f"Carla/Maps/{self.map}", []]

    @call
    def get_map_data(self) -> str:
        return self.maps[self.map]

    @call
    def get_required_files(self, folder: str) -> list[str]:
        return []

    @call
    def load_new_episode(self, name: str, reset_settings: bool, layers: int) -> None:
        name = name.rpartition("/")[2] or self.map
        if name not in self.maps:
            raise Refused(f"Map '{name}' not found")
        self.map, self.episode, self.frame, self.fresh = (
            name,
            self.episode + 1,
            self.frame + 1,
            True,
        )
        if reset_settings:
            self.settings = list(SETTINGS)
        # The client now throws away what listened to snapshots, and is not told any meanwhile: a
        # simulator is busy loading.
        self.loaded = time.monotonic() + LOADING
        self.begin()

    @call
    def get_environment_objects(self, tag: int) -> list:
        """Objects of the map with a tag, 255 for any; their boxes are in the world."""
        found = []
        for number, (solid, box) in enumerate(zip(self.scenery, self.solids, strict=True)):
            if tag in (box.tag, 255):
                place, turn = solid["pose"][:3], solid["pose"][3:]
                around = [place, solid["extent"], turn]
                found.append([[place, turn], around, box.instance, f"scenery_{number}", box.tag])
        return found

    @call
    def enable_environment_objects(self, objects: list[int], enabled: bool) -> None:
        if enabled:
            self.hidden -= set(objects)
        else:
            self.hidden |= set(objects)

    @call
    def project_point(self, start: list, direction: list, reach: float) -> list:
        """The first hit of a ray: whether there is one, its place and its tag."""
        boxes, along = self.boxes(), np.array(direction)
        far, which = cast(np.array(start), along[None], boxes)
        found = bool(far[0] * np.linalg.norm(along) <= reach)
        where = (start + far[0] * along).tolist() if found else start
        return [found, [where, boxes[which[0]].tag if which[0] >= 0 else GROUND]]

    # -- Actors --------------------------------------------------------------------------------

    @call
    def get_actor_definitions(self) -> list:
        return definitions()

    def add(self, blueprint: Blueprint, description: list, where: tuple, parent: int = 0) -> Actor:
        actor = Actor(next(self.numbers), blueprint, description, where, parent)
        if actor.solid:
            box = self.box(actor)
            if any(overlap(box, other) for other in self.boxes()):
                raise Refused("Spawn failed because of collision at spawn position")
        if blueprint.name.startswith("sensor."):
            actor.stream = next(self.streams)
        self.actors[actor.number] = actor
        return actor

    def find(self, actor: int) -> Actor:
        if actor not in self.actors:
            raise Refused(f"unable to find actor: not found. Actor Id: {actor}")
        return self.actors[actor]

    def where(self, actor: Actor) -> np.ndarray:
        own = matrix(actor.pose)
        return self.where(self.actors[actor.parent]) @ own if actor.parent else own

    def placed(self, actor: Actor) -> tuple[float, ...]:
        return pose(self.where(actor)) if actor.parent else actor.pose

    def box(self, actor: Actor) -> Box:
        kind, number = actor.blueprint, actor.number
        middle = self.where(actor) @ matrix((*kind.centre, 0.0, 0.0, 0.0))
        return Box(middle, kind.extent, kind.tag, instance_of(number), colour_of(number))

    def boxes(self) -> list[Box]:
        solids = [box for box in self.solids if box.instance not in self.hidden]
        return [*solids, *(self.box(a) for a in self.actors.values() if a.solid)]

    def told(self, actor: Actor) -> list:
        kind = actor.blueprint
        box = [kind.centre, kind.extent, (0.0, 0.0, 0.0)]
        token = self.token(actor.stream) if actor.stream else b""
        return [actor.number, actor.parent, actor.description, box, bytes([kind.tag]), token]

    @call
    def spawn_actor(self, description: list, transform: list) -> list:
        return self.spawn_actor_with_parent(description, transform, 0, 0, "")

    @call
    def spawn_actor_with_parent(
        self, description: list, transform: list, parent: int, attachment: int, bone: str
    ) -> list:
        if description[1] not in BLUEPRINTS:
            raise Refused("Spawn failed because of invalid actor description")
        if parent:
            self.find(parent)
        where = (*transform[0], *transform[1])
        return self.told(self.add(BLUEPRINTS[description[1]], description, where, parent))

    @call
    def destroy_actor(self, actor: int) -> bool:
        """Actors that were attached to it stay where they are."""
        self.find(actor)
        for other in self.actors.values():
            if other.parent == actor:
                other.pose, other.parent = self.placed(other), 0
        del self.actors[actor]
        return True

    @call
    def get_actors_by_id(self, actors: list[int]) -> list:
        return [self.told(self.actors[actor]) for actor in actors if actor in self.actors]

    @call
    def get_actor_bounding_box(self, actor: int) -> list:
        return self.told(self.find(actor))[3]

    @call
    def set_actor_transform(self, actor: int, transform: list) -> None:
        self.find(actor).pose = (*transform[0], *transform[1])

    def command(self, kind: int, arguments: list) -> int:
        """Run one command of a batch; gives the actor's number."""
        if COMMANDS[kind] != "spawn_actor":
            CALLS[COMMANDS[kind]](self, *arguments)
            return arguments[0]
        description, transform, parent, attachment, bone, _ = arguments
        on = parent[1] if parent[0] else 0
        return self.spawn_actor_with_parent(description, transform, on, attachment, bone)[0]

    # -- Time ----------------------------------------------------------------------------------

    @property
    def step(self) -> float:
        return self.settings[2][1] if self.settings[2][0] else STEP

    @call
    def tick_cue(self) -> int:
        self.frame, self.time, self.ticked = self.frame + 1, self.time + self.step, True
        for actor in self.actors.values():
            actor.since += self.step
        return self.frame

    def due(self) -> Iterator[tuple[Actor, float, float]]:
        """Sensors that measure in this frame, the time since the last one, and a LiDAR's first
        angle.

        One with a `sensor_tick` waits for that time from its last measurement, whole frames.
        """
        for actor in list(self.actors.values()):
            if actor.stream and actor.since > float(actor.attributes["sensor_tick"]) - 1e-6:
                seconds, start, actor.since = actor.since, actor.angle, 0.0
                if "lidar" in actor.blueprint.name:
                    span = float(actor.attributes["horizontal_fov"])
                    actor.angle = (start + swept(actor.attributes, seconds)) % span
                yield actor, seconds, start
