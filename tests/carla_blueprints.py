"""Blueprints of the wire-level CARLA server: names, attributes and boxes as CARLA 0.9.16 has them.

A selection: sizes are close to the simulator's, and of the attributes that change a camera's
picture only a few are here. A walker's origin is its middle, a vehicle's is on the ground below it.
"""

from dataclasses import dataclass, field

BOOL, INT, FLOAT, STRING, COLOUR = 1, 2, 3, 4, 5
"""Attribute types on the wire."""

TAGS = {"walker": 12, "car": 14, "van": 14, "truck": 15, "bus": 16, "motorcycle": 18, "bicycle": 19}
"""CARLA's semantic tags."""

PAINT = ("17,37,103", "75,87,173", "180,44,44", "137,0,0")


@dataclass(frozen=True)
class Attribute:
    """An attribute of a blueprint; its first recommended value is the default."""

    name: str
    kind: int
    values: tuple[str, ...]
    modifiable: bool = True


@dataclass(frozen=True)
class Blueprint:
    """A blueprint; centre and extent are those of its box [m]; sensors have no box."""

    name: str
    attributes: tuple[Attribute, ...] = ()
    tag: int = 0
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    extent: tuple[float, float, float] = (0.0, 0.0, 0.0)
    defaults: dict[str, str] = field(init=False)

    def __post_init__(self):
        object.__setattr__(self, "defaults", {a.name: a.values[0] for a in self.attributes})


def vehicle(name, kind, generation, height, extent, special="", ahead=0.0) -> Blueprint:
    """The middle of its box is above its origin, and may be ahead of it."""
    wheels = 2 if kind in ("bicycle", "motorcycle") else 4
    told = dict(object_type="", base_type=kind, special_type=special)
    return Blueprint(
        f"vehicle.{name}",
        (
            Attribute("role_name", STRING, ("autopilot", "scenario", "ego_vehicle")),
            *((Attribute("color", COLOUR, PAINT),) if special != "emergency" else ()),
            Attribute("sticky_control", BOOL, ("true",)),
            *(Attribute(key, STRING, (value,), modifiable=False) for key, value in told.items()),
            Attribute("number_of_wheels", INT, (str(wheels),), modifiable=False),
            Attribute("generation", INT, (str(generation),), modifiable=False),
            Attribute("has_dynamic_doors", BOOL, ("false",), modifiable=False),
            Attribute("has_lights", BOOL, ("true",), modifiable=False),
        ),
        TAGS[kind],
        (ahead, 0.0, height),
        extent,
    )


def walker(number, gender, age, extent) -> Blueprint:
    return Blueprint(
        f"walker.pedestrian.{number:04}",
        (
            Attribute("role_name", STRING, ("pedestrian",)),
            Attribute("gender", STRING, (gender,), modifiable=False),
            Attribute("generation", INT, ("1",), modifiable=False),
            Attribute("age", STRING, (age,), modifiable=False),
            Attribute("speed", FLOAT, ("0.0", "1.4", "2.7")),
            Attribute("is_invincible", BOOL, ("true",)),
        ),
        TAGS["walker"],
        (0.0, 0.0, 0.0),
        extent,
    )


def sensor(name, **attributes) -> Blueprint:
    """The types follow from the values: an int, a float, text, or "true"."""
    kinds = {int: INT, float: FLOAT, str: STRING}
    return Blueprint(
        f"sensor.{name}",
        (
            Attribute("role_name", STRING, ("front", "back", "left", "right")),
            Attribute("sensor_tick", FLOAT, ("0.0",)),
            *(
                Attribute(key, BOOL if value == "true" else kinds[type(value)], (str(value),))
                for key, value in attributes.items()
            ),
        ),
    )


def camera(name, **attributes) -> Blueprint:
    lens = dict(
        lens_circle_falloff=5.0,
        lens_circle_multiplier=0.0,
        lens_k=-1.0,
        lens_kcube=0.0,
        lens_x_size=0.08,
        lens_y_size=0.08,
    )
    size = dict(image_size_x=800, image_size_y=600, fov=90.0)
    return sensor(f"camera.{name}", **size, **lens, **attributes)


LIDAR = sensor(
    "lidar.ray_cast",
    channels=32,
    range=10.0,
    points_per_second=56000,
    rotation_frequency=10.0,
    upper_fov=10.0,
    lower_fov=-30.0,
    horizontal_fov=360.0,
    atmosphere_attenuation_rate=0.004,
    noise_seed=0,
    dropoff_general_rate=0.45,
    dropoff_intensity_limit=0.8,
    dropoff_zero_intensity=0.4,
    noise_stddev=0.0,
)

CAMERA = camera(
    "rgb",
    enable_postprocess_effects="true",
    gamma=2.2,
    exposure_mode="histogram",
    exposure_compensation=0.0,
    shutter_speed=200.0,
    iso=100.0,
    fstop=1.4,
    motion_blur_intensity=0.45,
    bloom_intensity=0.675,
    lens_flare_intensity=0.1,
)

BLUEPRINTS = {
    blueprint.name: blueprint
    for blueprint in (
        vehicle("tesla.model3", "car", 1, 0.72, (2.396, 1.082, 0.744), "electric"),
        vehicle("lincoln.mkz_2017", "car", 1, 0.719, (2.451, 1.064, 0.755), ahead=0.004),
        vehicle("nissan.patrol", "car", 1, 0.935, (2.302, 0.966, 0.927), ahead=-0.057),
        vehicle("dodge.charger_2020", "car", 2, 0.77, (2.504, 1.049, 0.767)),
        vehicle("volkswagen.t2", "van", 1, 1.02, (2.24, 1.035, 1.019)),
        vehicle("carlamotors.carlacola", "truck", 1, 1.25, (2.601, 1.313, 1.234)),
        vehicle("carlamotors.firetruck", "truck", 2, 1.93, (4.234, 1.446, 1.914), "emergency"),
        vehicle("mitsubishi.fusorosa", "bus", 2, 2.13, (5.136, 1.972, 2.126)),
        vehicle("vespa.zx125", "motorcycle", 1, 0.62, (0.902, 0.43, 0.619)),
        vehicle("diamondback.century", "bicycle", 1, 0.78, (0.821, 0.187, 0.775)),
        vehicle("bh.crossbike", "bicycle", 1, 0.54, (0.744, 0.429, 0.54)),
        walker(1, "female", "adult", (0.188, 0.188, 0.93)),
        walker(2, "male", "adult", (0.188, 0.188, 0.93)),
        walker(9, "female", "child", (0.25, 0.25, 0.55)),
        LIDAR,
        CAMERA,
        camera("depth"),
        camera("instance_segmentation"),
        camera("semantic_segmentation"),
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
            [
                [a.name, a.kind, a.values[0], list(a.values), a.modifiable, False]
                for a in blueprint.attributes
            ],
        ]
        for number, blueprint in enumerate(BLUEPRINTS.values(), 1)
    ]
