"""Clients of the wire-level CARLA server, which write what they received to a file.

They are processes, because a message that the client cannot read ends the interpreter:
`python carla_client.py drive|ask|travel PORT FILE`.
"""

import json
import queue
import sys
import time

import carla
import numpy as np

TICKS, STEP = 20, 0.1
ROADSIDE = (-15.0, -4.0, 6.0, -15.0, 20.0, 5.0)
"""Pose of the cameras: x, y, z, pitch, yaw, roll."""
PILLAR = (0.0, 0.0, 5.0, 0.0, 30.0, 0.0)
"""Pose of the LiDAR."""
BONNET = (2.5, 0.0, 1.2, -5.0, 10.0, 0.0)
"""Pose of a camera in the frame of the car that carries it."""
SENSORS = {
    "rgb": ("sensor.camera.rgb", ROADSIDE),
    "depth": ("sensor.camera.depth", ROADSIDE),
    "semantic": ("sensor.camera.semantic_segmentation", ROADSIDE),
    "instance": ("sensor.camera.instance_segmentation", ROADSIDE),
    "bonnet": ("sensor.camera.rgb", BONNET),
    "lidar": ("sensor.lidar.ray_cast", PILLAR),
}
ROAD_USERS = (
    "vehicle.tesla.model3",
    "vehicle.carlamotors.carlacola",
    "vehicle.bh.crossbike",
    "walker.pedestrian.0002",
)
WALK = (0.0, 1.5, 0.0)
"""The walker's velocity [m/s]."""


def driven(tick: int) -> list[tuple[float, ...]]:
    """The places of the vehicles before a tick: two lanes and a bend."""
    turn = np.radians(10.0 * tick)
    x, y = 13 + 3 * np.cos(turn), 3 * np.sin(turn) - 2
    return [
        (-6.0 + tick, 6.0, 0.0, 0.0, 0.0, 0.0),
        (14.0 - 0.5 * tick, -9.0, 0.0, 0.0, 180.0, 0.0),
        (x, y, 0.0, 0.0, 10.0 * tick + 90, 0.0),
    ]


def transform(pose) -> carla.Transform:
    return carla.Transform(carla.Location(*pose[:3]), carla.Rotation(*pose[3:]))


def numbers(value) -> list[float]:
    """A transform, a location or a vector as numbers."""
    if isinstance(value, carla.Transform):
        turn = value.rotation
        return [*numbers(value.location), turn.pitch, turn.yaw, turn.roll]
    return [value.x, value.y, value.z]


def connect(port: int) -> tuple[carla.Client, carla.World]:
    client = carla.Client("127.0.0.1", port)
    client.set_timeout(10)
    return client, synchronous(client.get_world())


def synchronous(world: carla.World) -> carla.World:
    settings = world.get_settings()
    settings.synchronous_mode, settings.fixed_delta_seconds = True, STEP
    world.apply_settings(settings)
    return world


def sensor(library: carla.BlueprintLibrary, name: str, **attributes: str) -> carla.ActorBlueprint:
    blueprint = library.find(name)
    small = dict(image_size_x="80", image_size_y="60", fov="80")
    scan = dict(channels="16", range="60", points_per_second="28800", upper_fov="0")
    for key, value in ((small if "camera" in name else scan) | attributes).items():
        blueprint.set_attribute(key, value)
    return blueprint


def drive(port: int, file: str) -> None:
    """Twenty ticks of traffic, recorded by six sensors."""
    _, world = connect(port)
    library = world.get_blueprint_library()
    starts = [*driven(0), (6.0, -1.0, 0.93, 0.0, 90.0, 0.0)]
    users = [
        world.spawn_actor(library.find(name), transform(start))
        for name, start in zip(ROAD_USERS, starts, strict=True)
    ]
    for vehicle in users[:3]:
        vehicle.set_simulate_physics(False)
    users[3].set_target_velocity(carla.Vector3D(*WALK))
    inbox, seen, eyes = {}, {}, {}
    for key, (name, pose) in SENSORS.items():
        parent = users[0] if pose is BONNET else None
        eyes[key] = world.spawn_actor(sensor(library, name), transform(pose), attach_to=parent)
        inbox[key], seen[key] = queue.Queue(), []
        eyes[key].listen(inbox[key].put)
    frames, snapshots = [], []
    for tick in range(TICKS):
        for vehicle, pose in zip(users, driven(tick), strict=False):
            vehicle.set_transform(transform(pose))
        frames.append(world.tick())
        snapshot = world.get_snapshot()
        assert snapshot.frame == frames[-1]
        snapshots.append([snapshot.find(actor.id) for actor in users])
        for key in SENSORS:
            seen[key].append(inbox[key].get(timeout=5))
    time.sleep(0.2)
    told = {
        "frames": frames,
        "ids": [actor.id for actor in users],
        "tags": [actor.semantic_tags[0] for actor in users],
        "centres": [numbers(actor.bounding_box.location) for actor in users],
        "extents": [numbers(actor.bounding_box.extent) for actor in users],
        "poses": [[numbers(s.get_transform()) for s in row] for row in snapshots],
        "velocities": [[numbers(s.get_velocity()) for s in row] for row in snapshots],
        "left": [inbox[key].qsize() for key in SENSORS],
    }
    for key, measurements in seen.items():
        told[f"{key}_frames"] = [m.frame for m in measurements]
        told[f"{key}_times"] = [m.timestamp for m in measurements]
        told[f"{key}_poses"] = [numbers(m.transform) for m in measurements]
        if key != "lidar":
            told[key] = [
                np.frombuffer(m.raw_data, np.uint8).reshape(m.height, m.width, 4)
                for m in measurements
            ]
    scans = seen["lidar"]
    told["counts"] = [[s.get_point_count(c) for c in range(s.channels)] for s in scans]
    told["points"] = np.concatenate(
        [np.frombuffer(s.raw_data, np.float32).reshape(-1, 4) for s in scans]
    )
    for eye in eyes.values():
        eye.stop()
    for actor in (*eyes.values(), *users):
        assert actor.destroy()
    world.tick()
    told["after"] = [actor.id for actor in world.get_actors() if actor.type_id != "spectator"]
    np.savez(file, **told)


def ask(port: int, file: str) -> None:
    """The other calls that a recorder may make."""
    client, world = connect(port)
    library = world.get_blueprint_library()
    settings = world.get_settings()
    told = {
        "versions": [client.get_server_version(), client.get_client_version()],
        "settings": [settings.synchronous_mode, settings.fixed_delta_seconds],
        "trucks": sorted(b.id for b in library.filter_by_attribute("base_type", "truck")),
        "two_wheels": sorted(
            b.id
            for b in library.filter("vehicle.*")
            if int(b.get_attribute("number_of_wheels")) == 2
        ),
        "colour": library.find("vehicle.tesla.model3").get_attribute("color").recommended_values[0],
        "map": world.get_map().name,
        "spectator": world.get_spectator().type_id,
        "lights": len(world.get_lightmanager().get_all_lights()),
    }
    rain = carla.WeatherParameters(cloudiness=80, precipitation=60, fog_density=12)
    world.set_weather(rain)
    told["weather"] = world.get_weather() == rain

    car = world.try_spawn_actor(library.find("vehicle.tesla.model3"), transform((9, 0, 0, 0, 0, 0)))
    near = transform((11, 1, 0, 0, 30, 0))
    told["taken"] = world.try_spawn_actor(library.find("vehicle.nissan.patrol"), near) is None
    try:
        world.spawn_actor(library.find("vehicle.nissan.patrol"), near)
    except RuntimeError as error:
        told["refusal"] = str(error)
    car.set_location(carla.Location(8, 0, 0))
    world.tick()
    told["moved"] = numbers(car.get_location())

    command = carla.command
    patrol = command.SpawnActor(
        library.find("vehicle.nissan.patrol"), transform((40, 0, 0, 0, 0, 0))
    )
    patrol.then(command.SetSimulatePhysics(command.FutureActor, False))
    patrol.then(command.ApplyTransform(command.FutureActor, transform((45, 3, 0, 0, 60, 0))))
    eye = command.SpawnActor(sensor(library, "sensor.camera.rgb"), transform(BONNET), car.id)
    before = world.get_snapshot().frame
    replies = client.apply_batch_sync([patrol, eye, command.DestroyActor(9999)], True)
    told["batch"] = [reply.has_error() for reply in replies]
    told["batch_ticks"] = world.get_snapshot().frame - before
    spawned, carried = world.get_actors([reply.actor_id for reply in replies[:2]])
    told["spawned"] = [spawned.type_id, *numbers(spawned.get_transform())]
    told["parent"] = carried.parent.id == car.id
    told["attributes"] = spawned.attributes["base_type"]
    replies = client.apply_batch_sync([command.DestroyActor(a) for a in (spawned.id, carried.id)])
    told["destroyed"] = [reply.has_error() for reply in replies]

    slow = world.spawn_actor(
        sensor(library, "sensor.lidar.ray_cast", sensor_tick="0.3"), transform(PILLAR)
    )
    inbox = queue.Queue()
    slow.listen(inbox.put)
    frames = [world.tick() for _ in range(7)]
    told["slow"] = [inbox.get(timeout=5).frame - frames[0] for _ in range(2)]
    slow.stop()
    world.tick()
    told["slow_left"] = inbox.qsize()
    told["ended"] = [slow.destroy(), car.destroy(), car.is_alive]

    scenery = world.get_environment_objects(carla.CityObjectLabel.Buildings)
    told["scenery"] = [[s.name, str(s.type), numbers(s.bounding_box.extent)] for s in scenery]
    told["boxes"] = [numbers(b.location) for b in world.get_level_bbs(carla.CityObjectLabel.Any)]
    down = world.ground_projection(carla.Location(30, 30, 20), 50)
    told["below"] = [str(down.label), *numbers(down.location)]
    told["too_far"] = world.ground_projection(carla.Location(30, 30, 20), 5) is None

    other = carla.Client("127.0.0.1", port)
    other.set_timeout(10)
    frame = other.get_world().tick()
    told["shared"] = world.tick() - frame
    settings.synchronous_mode = False
    world.apply_settings(settings)
    start = world.wait_for_tick().frame
    told["flows"] = world.wait_for_tick().frame > start
    with open(file, "w") as out:
        json.dump(told, out)


def travel(port: int, file: str) -> None:
    """Load another map."""
    client, world = connect(port)
    world.spawn_actor(
        world.get_blueprint_library().find("vehicle.tesla.model3"), transform((9, 0, 0, 0, 0, 0))
    )
    world.tick()
    told = {"maps": client.get_available_maps(), "before": world.get_map().name}
    world = synchronous(client.load_world(sys.argv[4]))
    world.tick()
    told |= {"after": world.get_map().name, "actors": [a.type_id for a in world.get_actors()]}
    with open(file, "w") as out:
        json.dump(told, out)


if __name__ == "__main__":
    {"drive": drive, "ask": ask, "travel": travel}[sys.argv[1]](int(sys.argv[2]), sys.argv[3])
