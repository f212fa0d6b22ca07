"""Blueprints of the wire-level CARLA server: names and boxes as CARLA 0.9.16 has them.

A selection: sizes are close to the simulator's, and attributes are those that a recording reads or
sets. A walker's origin is its middle, a vehicle's is on the ground below it.
"""

from dataclasses import dataclass, field

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
