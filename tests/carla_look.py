"""Writes the state of a CARLA server to a file: `python carla_look.py PORT FILE`.

It is apart from the clients that record, because it needs nothing from the package.
"""

import json
import sys
import time
from pathlib import Path

MIDDLE = (-47.76, -20.43)
"""The middle of the recorded junction, in the package's axes [m]."""


def look_at(port: int) -> dict:
    """The state of a server."""
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
    actors = sorted(actor.type_id for actor in world.get_actors())
    return {
        "map": world.get_map().name.rpartition("/")[2],
        "settings": [settings.synchronous_mode, settings.fixed_delta_seconds],
        "weather": [weather.precipitation, weather.sun_altitude_angle],
        "actors": actors,
        "below": str(below.label),
    }


if __name__ == "__main__":
    Path(sys.argv[2]).write_text(json.dumps(look_at(int(sys.argv[1]))))
