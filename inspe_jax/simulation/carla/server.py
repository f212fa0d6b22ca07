"""A session on a CARLA server: the right map, synchronous ticks, all restored at the end."""

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from inspe_jax.core.errors import InspeError, nearest, needs
from inspe_jax.scene.intersection import Intersection
from inspe_jax.sensing.conditions import Conditions
from inspe_jax.simulation.embedded.light import LIGHTS
from inspe_jax.simulation.recorder import Server

LOADING = 180.0  # how long a map may take to load [s]
ENDING = 5.0  # how long a call may take while everything is restored [s]: the server may be gone
ROLE_NAME = "inspe"  # the role name of the actors that this package spawns

_OPENDRIVE = " (OpenDRIVE)"


@contextmanager
def plain_errors(server: Server) -> Iterator[None]:
    """Turn the client's errors, all RuntimeErrors, into InspeErrors with the server's name."""
    try:
        yield
    except RuntimeError as error:
        if type(error) is not RuntimeError:
            raise
        raise InspeError(f"CARLA at {server}: {' '.join(str(error).split())}") from error


@dataclass(eq=False)
class CarlaSession:
    """A connected client, its world, and what is restored at the end: settings, weather, spawned
    actors, sensors that listen, and parked vehicles that were hidden."""

    carla: Any
    client: Any
    world: Any
    server: Server
    settings: Any
    weather: Any
    actors: set[int] = field(default_factory=set)
    listening: list[Any] = field(default_factory=list)
    hidden: list[int] = field(default_factory=list)

    def transform(self, cords: Iterable[float]) -> Any:
        """CARLA's transform of ``cords`` (6,), see :mod:`~inspe_jax.core.carla_frame`."""
        x, y, z, roll, yaw, pitch = map(float, cords)
        turn = self.carla.Rotation(pitch=pitch, yaw=yaw, roll=roll)
        return self.carla.Transform(self.carla.Location(x, y, z), turn)

    def spawn(self, blueprint: Any, cords: Iterable[float]) -> Any:
        """Spawn an actor; it is destroyed at the end of the session."""
        actor = self.world.spawn_actor(blueprint, self.transform(cords))
        self.actors.add(actor.id)
        return actor

    def command(self, commands: list[Any]) -> list[int]:
        """Run a batch of commands; gives the ids of actors. Raises InspeError if one failed."""
        if not commands:
            return []
        replies = self.client.apply_batch_sync(commands, False)
        found = [reply.actor_id for reply in replies if not reply.has_error()]
        self.actors.update(found)
        wrong = next((reply.error for reply in replies if reply.has_error()), None)
        if wrong is not None:
            raise InspeError(f"CARLA at {self.server}: {wrong}")
        return found

    def destroy(self, actors: Iterable[int]) -> None:
        """Destroy actors by id; those that are gone already do no harm."""
        actors = list(actors)
        if actors:
            destroy = self.carla.command.DestroyActor
            self.client.apply_batch_sync([destroy(actor) for actor in actors], False)
        self.actors.difference_update(actors)

    def restore(self) -> None:
        """Restore everything but the map. Raises RuntimeError if the server is gone."""
        self.client.set_timeout(min(self.server.timeout, ENDING))
        for sensor in self.listening:
            sensor.stop()
        self.destroy(self.actors)
        if self.hidden:
            self.world.enable_environment_objects(self.hidden, True)
        self.world.set_weather(self.weather)
        self.world.apply_settings(self.settings)


@contextmanager
def session_on(
    server: Server, place: Intersection, rate: float, conditions: Conditions
) -> Iterator[CarlaSession]:
    """A session on the map of an intersection, in ticks of 1 / ``rate`` seconds. Vehicles parked
    there, of which frames have no boxes, are hidden. Everything is restored when the block ends.
    Raises InspeError where no server answers, or version, map or traffic do not fit."""
    if not place.source.endswith(_OPENDRIVE):
        raise InspeError(
            f"{place.name}: its source is {place.source}, which a CARLA server cannot show; read "
            "an intersection from the OpenDRIVE map (.xodr) of one of CARLA's towns"
        )
    town = Path(place.source.removesuffix(_OPENDRIVE)).stem
    what = "recording with CARLA needs its client, in the server's version"
    with needs(what, "carla", "Linux and Windows, Python up to 3.12"):
        import carla
    server.reach()
    client = carla.Client(server.host, server.port)
    client.set_timeout(server.timeout)
    theirs, own = client.get_server_version(), client.get_client_version()
    if _release(theirs) != _release(own):  # messages of another version crash the process
        raise InspeError(
            f"CARLA at {server} is {theirs} and the client here {own}: "
            f"pip install carla=={_release(theirs)}"
        )
    world = client.get_world()
    settings = world.get_settings()
    world = _on_map(client, world, town, server)
    session = CarlaSession(carla, client, world, server, settings, world.get_weather())
    try:
        synchronous = world.get_settings()
        synchronous.synchronous_mode, synchronous.fixed_delta_seconds = True, 1.0 / rate
        synchronous.no_rendering_mode = False
        world.apply_settings(synchronous)
        world.tick(server.timeout)  # without a tick the client may not know all actors yet
        _check_empty(world, server)
        world.set_weather(weather_of(carla, conditions))
        session.hidden = [
            item.id
            for label in ("Car", "Truck", "Bus", "Motorcycle", "Bicycle")
            for item in world.get_environment_objects(getattr(carla.CityObjectLabel, label))
        ]
        if session.hidden:
            world.enable_environment_objects(session.hidden, False)
        yield session
    except BaseException:
        with suppress(RuntimeError):  # the first error says more
            session.restore()
        raise
    session.restore()


def weather_of(carla: Any, conditions: Conditions) -> Any:
    """CARLA's weather, under the embedded recorder's sun. Rain of 10 mm/h is 63 %, between its
    medium (60 %) and hard rain (100 %); fog of 200 m is 26 %, of 50 m 70 %."""
    light, strength = LIGHTS[conditions.light], conditions.intensity or 0.0
    weather = dict(cloudiness=10.0, wind_intensity=10.0)
    if conditions.weather == "rain":
        share = 100.0 * (1.0 - np.exp(-strength / 10.0))
        wet = ("precipitation", "precipitation_deposits", "wetness", "wind_intensity")
        fog = dict(fog_density=0.05 * share, fog_distance=0.75, fog_falloff=0.1)
        weather = dict.fromkeys(wet, share) | fog | dict(cloudiness=60.0 + 0.4 * share)
    elif conditions.weather == "fog":
        share = 100.0 * (1.0 - np.exp(-60.0 / strength))
        weather = dict(cloudiness=80.0, fog_density=share, fog_falloff=0.01)
    return carla.WeatherParameters(
        sun_altitude_angle=float(np.degrees(light.elevation)),
        sun_azimuth_angle=float(-np.degrees(light.azimuth) % 360.0),
        scattering_intensity=1.0,
        mie_scattering_scale=0.03,
        **{key: float(value) for key, value in weather.items()},
    )


def _release(version: str) -> str:
    """The release of a version: 0.9.16 of 0.9.16-3-gabc, which is a build from source."""
    found = re.match(r"\d+(\.\d+)*", version)
    return found[0] if found else version


def _on_map(client: Any, world: Any, town: str, server: Server) -> Any:
    if _plain(world.get_map().name) == _plain(town):
        return world
    there = sorted({name.rpartition("/")[2] for name in client.get_available_maps()})
    same = [name for name in there if _plain(name) == _plain(town)]
    if not same:
        hint = nearest(town, there)
        raise InspeError(f"CARLA at {server} has no map '{town}'; it has {', '.join(there)}{hint}")
    client.set_timeout(LOADING)
    world = client.load_world(town if town in same else same[0])
    client.set_timeout(server.timeout)
    return world


def _plain(name: str) -> str:
    """A map's name without its folder, and without the suffix of its layered version."""
    return name.rpartition("/")[2].removesuffix("_Opt")


def _check_empty(world: Any, server: Server) -> None:
    """Raise InspeError if there are road users: pictures would show them, but no frame has them."""
    actors = world.get_actors()
    others = [*actors.filter("vehicle.*"), *actors.filter("walker.*")]
    if others:
        names = ", ".join(sorted({actor.type_id for actor in others})[:3])
        raise InspeError(
            f"CARLA at {server}: {len(others)} vehicles or walkers are there already ({names}), "
            "and would be missing from the frames: destroy them or reload the world"
        )
