"""The world behind the wire-level CARLA server: one episode, and what clients may do to it.

There is no simulation: actors stay where they are placed. There is no gravity, and the only
collision is an actor that is spawned where another one is. Calls that recording does not need are
not answered, so that the client raises a RuntimeError. Blueprints are a selection: names and boxes
are close to the simulator's; a walker's origin is its middle, a vehicle's is on the ground.
"""

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from carla_rays import GROUND, Box, cast, colour_of, matrix, overlap

BOOL, INT, FLOAT, STRING, COLOUR = 1, 2, 3, 4, 5
"""Attribute types on the wire."""

TAGS = {"walker": 12, "car": 14, "van": 14, "truck": 15, "bus": 16, "motorcycle": 18, "bicycle": 19}
"""CARLA's semantic tags."""

PAINT = ("17,37,103", "75,87,173", "180,44,44", "137,0,0")
ROLE = ("role_name", STRING, ("autopilot", "scenario", "ego_vehicle"))


@dataclass(frozen=True)
class Blueprint:
    """A blueprint: attributes are name, type and recommended values; sensors have no box [m]."""

    name: str
    attributes: tuple[tuple[str, int, tuple[str, ...]], ...] = ()
    tag: int = 0
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    extent: tuple[float, float, float] = (0.0, 0.0, 0.0)
    defaults: dict[str, str] = field(init=False)

    def __post_init__(self):
        object.__setattr__(self, "defaults", {name: of[0] for name, _, of in self.attributes})


def vehicle(name, kind, height, extent, ahead=0.0, painted=True) -> Blueprint:
    """The middle of its box is above its origin, and may be ahead of it."""
    wheels = "2" if kind in ("bicycle", "motorcycle") else "4"
    attributes = (ROLE, ("base_type", STRING, (kind,)), ("number_of_wheels", INT, (wheels,)))
    if painted:
        attributes += (("color", COLOUR, PAINT),)
    return Blueprint(f"vehicle.{name}", attributes, TAGS[kind], (ahead, 0.0, height), extent)


def walker(number, extent) -> Blueprint:
    name = f"walker.pedestrian.{number:04}"
    return Blueprint(name, (ROLE,), TAGS["walker"], extent=extent)


def sensor(name, **attributes) -> Blueprint:
    kinds = {int: INT, float: FLOAT}
    own = [(key, kinds[type(value)], (str(value),)) for key, value in attributes.items()]
    return Blueprint(f"sensor.{name}", (ROLE, *own))


def camera(name) -> Blueprint:
    return sensor(f"camera.{name}", image_size_x=800, image_size_y=600, fov=90.0)


LIDAR = sensor(
    "lidar.ray_cast", channels=32, range=10.0, points_per_second=56000, rotation_frequency=10.0,
    upper_fov=10.0, lower_fov=-30.0, horizontal_fov=360.0, atmosphere_attenuation_rate=0.004,
    dropoff_general_rate=0.45, dropoff_zero_intensity=0.4, noise_stddev=0.0,
)  # fmt: skip

BLUEPRINTS = {
    blueprint.name: blueprint
    for blueprint in (
        vehicle("tesla.model3", "car", 0.72, (2.396, 1.082, 0.744)),
        vehicle("lincoln.mkz_2017", "car", 0.719, (2.451, 1.064, 0.755), ahead=0.004),
        vehicle("nissan.patrol", "car", 0.935, (2.302, 0.966, 0.927), ahead=-0.057),
        vehicle("dodge.charger_2020", "car", 0.77, (2.504, 1.049, 0.767)),
        vehicle("volkswagen.t2", "van", 1.02, (2.24, 1.035, 1.019)),
        vehicle("carlamotors.carlacola", "truck", 1.25, (2.601, 1.313, 1.234)),
        vehicle("carlamotors.firetruck", "truck", 1.93, (4.234, 1.446, 1.914), painted=False),
        vehicle("mitsubishi.fusorosa", "bus", 2.13, (5.136, 1.972, 2.126)),
        vehicle("vespa.zx125", "motorcycle", 0.62, (0.902, 0.43, 0.619)),
        vehicle("diamondback.century", "bicycle", 0.78, (0.821, 0.187, 0.775)),
        vehicle("bh.crossbike", "bicycle", 0.54, (0.744, 0.429, 0.54)),
        walker(1, (0.188, 0.188, 0.93)),
        walker(2, (0.188, 0.188, 0.93)),
        walker(9, (0.25, 0.25, 0.55)),
        LIDAR,
        *map(camera, ("rgb", "depth", "semantic_segmentation")),
    )
}

SPECTATOR = Blueprint("spectator")


def definitions() -> list:
    """The library as `get_actor_definitions` returns it; blueprints are numbered from 1."""
    return [
        [
            number,
            blueprint.name,
            blueprint.name.replace(".", ","),
            [[a, kind, of[0], list(of), True, False] for a, kind, of in blueprint.attributes],
        ]
        for number, blueprint in enumerate(BLUEPRINTS.values(), 1)
    ]


VERSION = "0.9.16"
SNAPSHOTS = 1
"""The number of the stream of snapshots; those of sensors follow it. Actors have other numbers."""
SETTINGS = [False, False, [False], True, 0.01, 10, 0.0, True, 3000.0, 2000.0, True]
NOON = [5.0, 0.0, 0.0, 10.0, -1.0, 45.0, 2.0, 0.75, 0.1, 0.0, 1.0, 0.03, 0.0331, 0.0]
STEP = 0.05
"""Seconds per frame, if no fixed time is set."""
LOADING = 0.3
"""Seconds without frames while a map is loaded."""

COMMANDS = {0: "spawn_actor", 1: "destroy_actor", 6: "set_actor_transform"}
"""The calls of the commands in a batch, by number."""


class Refused(Exception):
    """An error that the client raises as a RuntimeError."""


@dataclass
class Actor:
    number: int
    blueprint: Blueprint
    description: list
    pose: tuple[float, ...]
    stream: int = 0
    attributes: dict[str, str] = field(init=False)

    def __post_init__(self):
        given = {name: value for name, _, value in self.description[2]}
        self.attributes = self.blueprint.defaults | given

    @property
    def solid(self) -> bool:
        return self.blueprint.extent != (0.0, 0.0, 0.0)


class World:
    """State of the episode, whose methods answer calls; `token` gives the address of a stream."""

    def __init__(
        self,
        maps: Sequence[Path],
        token: Callable[[int], bytes],
        scenery: Sequence[dict],
        release: str,
    ):
        self.maps = {path.stem: path.read_text() for path in maps}
        self.map, self.token, self.scenery = maps[0].stem, token, scenery
        self.solids = [
            Box(matrix(s["pose"]), tuple(s["extent"]), s["tag"], (120, 110, 100)) for s in scenery
        ]
        self.release, self.hidden = release, set()
        self.numbers, self.streams = iter(range(24, 10**9)), iter(range(SNAPSHOTS + 1, 10**9))
        self.awaited: Counter[int] = Counter()  # streams asked for, and not connected to yet
        self.episode, self.frame, self.time = 7, 100, 5.0
        self.ticked, self.fresh, self.loaded = False, False, 0.0
        self.settings, self.weather = list(SETTINGS), list(NOON)
        self.begin()

    def begin(self) -> None:
        self.actors: dict[int, Actor] = {}
        self.spectator = self.add(SPECTATOR, [0, "spectator", []], (0.0, 0.0, 10.0, 0.0, 0.0, 0.0))

    def version(self) -> str:
        return self.release

    def get_episode_info(self) -> list:
        return [self.episode, [self.token(SNAPSHOTS)]]

    def get_sensor_token(self, stream: int) -> list:
        self.awaited[stream] += 1
        return [self.token(stream)]

    def get_episode_settings(self) -> list:
        return self.settings

    def set_episode_settings(self, settings: list) -> int:
        self.settings = settings
        return self.frame

    def get_weather_parameters(self) -> list:
        return self.weather

    def set_weather_parameters(self, weather: list) -> None:
        self.weather = weather

    def query_lights_state(self, client: str) -> list:
        return []

    def get_available_maps(self) -> list[str]:
        return [f"/Game/Carla/Maps/{name}" for name in self.maps]

    def get_map_info(self) -> list:
        """The name; there are no spawn points."""
        return [f"Carla/Maps/{self.map}", []]

    def get_map_data(self) -> str:
        return self.maps[self.map]

    def get_required_files(self, folder: str) -> list[str]:
        return []

    def load_new_episode(self, name: str, reset_settings: bool, layers: int) -> None:
        name = name.rpartition("/")[2] or self.map
        if name not in self.maps:
            raise Refused(f"Map '{name}' not found")
        self.map, self.fresh = name, True
        self.episode, self.frame = self.episode + 1, self.frame + 1
        if reset_settings:
            self.settings = list(SETTINGS)
        # The client now throws away what listened to snapshots, and is not told any meanwhile: a
        # simulator is busy loading.
        self.loaded = time.monotonic() + LOADING
        self.begin()

    def get_environment_objects(self, tag: int) -> list:
        """Objects of the map with a tag, 255 for any; their boxes are in the world."""
        found = []
        for number, (solid, box) in enumerate(zip(self.scenery, self.solids, strict=True)):
            if tag in (box.tag, 255):
                place, turn = solid["pose"][:3], solid["pose"][3:]
                around = [place, solid["extent"], turn]
                found.append([[place, turn], around, number, f"scenery_{number}", box.tag])
        return found

    def enable_environment_objects(self, objects: list[int], enabled: bool) -> None:
        if enabled:
            self.hidden -= set(objects)
        else:
            self.hidden |= set(objects)

    def project_point(self, start: list, direction: list, reach: float) -> list:
        """The first hit of a ray: whether there is one, its place and its tag."""
        boxes, along = self.boxes(), np.array(direction)
        far, which = cast(np.array(start), along[None], boxes)
        found = bool(far[0] * np.linalg.norm(along) <= reach)
        where = (start + far[0] * along).tolist() if found else start
        return [found, [where, boxes[which[0]].tag if which[0] >= 0 else GROUND]]

    def get_actor_definitions(self) -> list:
        return definitions()

    def add(self, blueprint: Blueprint, description: list, where: tuple) -> Actor:
        actor = Actor(next(self.numbers), blueprint, description, where)
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

    def box(self, actor: Actor) -> Box:
        kind = actor.blueprint
        middle = matrix(actor.pose) @ matrix((*kind.centre, 0.0, 0.0, 0.0))
        return Box(middle, kind.extent, kind.tag, colour_of(actor.number))

    def boxes(self) -> list[Box]:
        solids = [box for k, box in enumerate(self.solids) if k not in self.hidden]
        return [*solids, *(self.box(a) for a in self.actors.values() if a.solid)]

    def told(self, actor: Actor) -> list:
        kind = actor.blueprint
        box = [kind.centre, kind.extent, (0.0, 0.0, 0.0)]
        token = self.token(actor.stream) if actor.stream else b""
        return [actor.number, 0, actor.description, box, bytes([kind.tag]), token]

    def spawn_actor(self, description: list, transform: list) -> list:
        where = (*transform[0], *transform[1])
        return self.told(self.add(BLUEPRINTS[description[1]], description, where))

    def destroy_actor(self, actor: int) -> bool:
        self.find(actor)
        del self.actors[actor]
        return True

    def get_actors_by_id(self, actors: list[int]) -> list:
        return [self.told(self.actors[actor]) for actor in actors if actor in self.actors]

    def get_actor_bounding_box(self, actor: int) -> list:
        return self.told(self.find(actor))[3]

    def set_actor_transform(self, actor: int, transform: list) -> None:
        self.find(actor).pose = (*transform[0], *transform[1])

    def command(self, kind: int, arguments: list) -> int:
        if COMMANDS[kind] == "spawn_actor":
            return self.spawn_actor(*arguments[:2])[0]
        getattr(self, COMMANDS[kind])(*arguments)
        return arguments[0]

    @property
    def step(self) -> float:
        return self.settings[2][1] if self.settings[2][0] else STEP

    def tick_cue(self) -> int:
        self.frame, self.time, self.ticked = self.frame + 1, self.time + self.step, True
        return self.frame
