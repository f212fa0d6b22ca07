"""Clients that record with the wire-level CARLA server, and write what they received to a file.

They are processes, because a message that the client cannot read ends the interpreter:
`python carla_recording.py record|errors PORT FILE`.
"""

import json
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from worlds import MAPS

from inspe_jax.core.errors import InspeError
from inspe_jax.dataset import write_frame, write_protocol
from inspe_jax.scene.maps.registry import read_map
from inspe_jax.scene.scene import Scene, build_scene
from inspe_jax.sensing.conditions import FAIR, Conditions
from inspe_jax.sensing.layout import Layout, Sensor, Unit, make_layout
from inspe_jax.sensing.sensors import CameraSpec, LidarSpec
from inspe_jax.sensing.signals import LidarNoise
from inspe_jax.simulation.backends import recorder_of
from inspe_jax.simulation.recorder import Recording, Server

TOWN, JUNCTION = "Town10HD", 189
MIDDLE = (-47.76, -20.43)
"""The middle of the recorded junction [m]."""
FRAMES, RATE, SEED = 8, 10.0, 4  # by this seed nobody drives over the parked car's place
AGAIN = 5
"""The frame that is recorded twice."""
RECORDING = Recording(
    rate=RATE,
    layers=("depth", "instance", "semantic"),
    image_size=(96, 72),
    noise=LidarNoise(range=0.0, lost=0.2),
)
RAIN = Conditions.of("dusk", "rain:10")
LIDAR = LidarSpec("lidar", tuple(np.radians(np.linspace(-30, 2, 32)).tolist()), 360, 2 * np.pi, 60)
CAMERA = CameraSpec("camera", 640, 480, 320 / np.tan(np.radians(45)), (320.0, 240.0), 0.1, 30.0)


def scene() -> Scene:
    """Road users of every class at a junction of a town; its ground is level, at z = 0."""
    place = read_map(MAPS / f"{TOWN}.xodr", junction=JUNCTION, radius=40)
    return build_scene(
        place, radius=40, voxel=2.0, density=24, frames=FRAMES, step=1 / RATE, seed=SEED
    )


def layout() -> Layout:
    """Two cameras and a LiDAR on one mast at a corner, turned about all axes."""
    x, y = MIDDLE[0] + 14, MIDDLE[1] + 14
    angles = np.radians([[2, -20, -135], [-3, -25, 160], [1, 2, 30]])
    poses = np.column_stack([np.full(3, x), np.full(3, y), [6.0, 6.2, 6.5], angles])
    sensors = [Sensor("west", CAMERA, 0), Sensor("east", CAMERA, 0), Sensor("top", LIDAR, 0)]
    return make_layout(sensors, [Unit("mast", (x, y, 0.0))], poses)


def at(port: int, seen: Scene, server: Server | None = None, conditions: Conditions = FAIR):
    server = replace(server or Server(), port=port)
    return recorder_of("carla", seen, layout(), conditions, RECORDING, SEED, server)


def record(port: int, file: Path) -> None:
    """Records a scenario, one frame twice; writes the server's state meanwhile and afterwards."""
    seen, folder = scene(), file.parent / "train" / TOWN
    with at(port, seen, conditions=RAIN) as recorder:
        frames = [recorder.frame(t) for t in range(FRAMES)]
        again = recorder.frame(AGAIN)
        meanwhile = look_at(port)
    told = {"meanwhile": meanwhile, "after": look_at(port)}
    world = dict(
        fixed_delta_seconds=1 / RATE, client_port=port, seed=SEED, weather=RAIN.record, town=TOWN
    )
    write_protocol(folder, {"world": world}, frames[0].stations)
    for frame in frames:
        write_frame(folder, frame)
    for one, other in zip(frames[AGAIN].boxes, again.boxes, strict=True):
        assert (one.track, one.name, one.kind) == (other.track, other.name, other.kind)
        np.testing.assert_array_equal(one.center, other.center)
    (one,), (other,) = frames[AGAIN].stations, again.stations
    np.testing.assert_array_equal(one.scans[0].points, other.scans[0].points)
    for image, same in zip(one.images, other.images, strict=True):
        for layer in RECORDING.layers:
            np.testing.assert_array_equal(getattr(image, layer), getattr(same, layer))
    file.write_text(json.dumps(told))


def look_at(port: int) -> dict:
    import carla

    client = carla.Client("127.0.0.1", port)
    client.set_timeout(10)
    world = client.get_world()
    settings, weather = world.get_settings(), world.get_weather()
    here = carla.Location(MIDDLE[0], -MIDDLE[1], 30)
    below = world.project_point(here, carla.Vector3D(0, 0, -1), 50)
    until = time.monotonic() + 5
    while not len(world.get_actors()) and time.monotonic() < until:
        time.sleep(0.02)  # without ticks the first snapshot may not have arrived yet
    return {
        "map": world.get_map().name.rpartition("/")[2],
        "settings": [settings.synchronous_mode, settings.fixed_delta_seconds],
        "weather": [weather.precipitation, weather.sun_altitude_angle],
        "actors": sorted(actor.type_id for actor in world.get_actors()),
        "below": str(below.label),
    }


def errors(_: int, file: Path, *ports: str) -> None:
    """The errors of servers NAME:PORT, and their state then; Ctrl-C is pressed on "stopped"."""
    told, seen, quick = {}, scene(), Server(timeout=1.5)
    for name, port in (given.split(":") for given in ports):
        if name == "taken":
            park(int(port))
        try:
            with at(int(port), seen, quick) as recorder:
                for t in range(FRAMES):
                    recorder.frame(t)
                if name == "stopped":
                    raise KeyboardInterrupt
            told[name] = "nothing"
        except (InspeError, KeyboardInterrupt) as error:
            told[name] = str(error)
        if name in ("mute", "failing", "taken", "stopped"):
            told[f"{name}, left"] = look_at(int(port))
    file.write_text(json.dumps(told))


def park(port: int) -> None:
    """Leaves a car, and synchronous mode switched on, as a client that crashed."""
    import carla

    client = carla.Client("127.0.0.1", port)
    client.set_timeout(10)
    world = client.get_world()
    world.spawn_actor(world.get_blueprint_library().find("vehicle.tesla.model3"), carla.Transform())
    settings = world.get_settings()
    settings.synchronous_mode = True
    world.apply_settings(settings)


if __name__ == "__main__":
    tasks = {"record": record, "errors": errors}
    tasks[sys.argv[1]](int(sys.argv[2]), Path(sys.argv[3]), *sys.argv[4:])
