"""Trucks and buses as tables: one row of measures for each shape.

The sizes are those of common European vehicles, in the limits of Directive 96/53/EC: 2.55 m wide,
4 m high, 12 m long for a truck, 16.5 m with a semitrailer, 18.75 m with a trailer, 13.5 m for a bus
of two axles and 18.75 m for an articulated one. A box is straight, and so is what fills it. Axles
and superstructures stand where drawings of bodybuilders have them, to about 10 cm.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from inspe_jax.simulation.embedded.shapes_mesh import (
    Mesh,
    Strip,
    axle,
    block,
    filled,
    join,
    prism,
    tube,
)
from inspe_jax.simulation.embedded.shapes_vehicles import FACE, TAIL, Body, build

FLOOR = 1.05
"""Height of a chassis, on which superstructures stand [m]."""

Load = tuple[str, float, float, float]
"""A superstructure: what it is, x of its front and rear, measured from the front bumper, and the
height of its top [m]."""


class Truck(NamedTuple):
    """The measures of a truck [m]; x is the distance from the front bumper.

    ``size`` is length, width, height. ``cab`` are the length and the height of the cab; ``axles``
    are their x. Each of ``loads`` stands on the chassis.
    """

    size: tuple[float, float, float]
    cab: tuple[float, float]
    axles: tuple[float, ...]
    loads: tuple[Load, ...]
    wheel: float = 0.5


class Bus(NamedTuple):
    """The measures of a bus [m]; x is the distance from the front bumper.

    ``size`` is length, width, height; ``axles`` are x; ``belt`` is the height of the lower edge of
    the side windows; ``rails`` are those of their upper edges, one for each deck; ``rake`` is how
    far the windscreen leans back. An articulated bus has its ``joint`` at x of front and rear.
    """

    size: tuple[float, float, float]
    axles: tuple[float, ...]
    belt: float
    rails: tuple[float, ...]
    rake: float = 0.15
    joint: tuple[float, float] | None = None
    wheel: float = 0.48


TRUCKS: dict[str, Truck] = {
    "truck.dropside": Truck(
        (6.0, 2.1, 2.35), (2.0, 2.35), (0.9, 4.4), (("flat", 2.1, 6.0, 1.4),), 0.36,
    ),
    "truck.light_box": Truck(
        (6.9, 2.25, 3.2), (1.9, 2.35), (0.95, 4.9), (("box", 2.0, 6.9, 3.2),), 0.38,
    ),
    "truck.box": Truck(
        (8.5, 2.5, 3.4), (1.8, 2.75), (0.95, 5.7), (("box", 1.95, 8.5, 3.4),),
    ),
    "truck.high_box": Truck(
        (9.9, 2.55, 3.9), (2.2, 3.6), (1.4, 6.2, 7.5), (("box", 2.4, 9.9, 3.9),),
    ),
    "truck.tipper": Truck(
        (8.2, 2.5, 3.1), (2.0, 3.0), (1.4, 5.1, 6.45), (("tub", 2.2, 8.2, 2.75),),
    ),
    "truck.mixer": Truck(
        (8.9, 2.5, 3.85), (1.9, 2.95), (1.0, 2.9, 5.5, 6.85), (("drum", 2.3, 8.9, 3.85),),
    ),
    "truck.refuse": Truck(
        (9.5, 2.5, 3.55), (1.9, 2.9), (1.35, 5.2, 6.55),
        (("box", 2.2, 7.6, 3.4), ("hopper", 7.6, 9.5, 3.55)),
    ),
    "truck.tanker": Truck(
        (9.2, 2.5, 3.3), (2.0, 3.1), (1.4, 5.9, 7.25), (("tank", 2.4, 9.0, 3.3),),
    ),
    "truck.crane": Truck(
        (9.0, 2.5, 3.6), (2.0, 3.0), (1.4, 5.8, 7.15),
        (("post", 2.15, 2.85, 3.6), ("flat", 3.1, 9.0, 1.75)),
    ),
    "truck.articulated": Truck(
        (16.5, 2.55, 4.0), (2.3, 3.75), (1.45, 5.1, 11.3, 12.6, 13.9), (("box", 2.9, 16.5, 4.0),),
    ),
    "truck.articulated_tank": Truck(
        (15.4, 2.55, 3.65), (2.3, 3.65), (1.45, 5.1, 10.9, 12.2, 13.5),
        (("tank", 3.1, 15.3, 3.65),),
    ),
    "truck.container": Truck(
        (16.0, 2.5, 3.95), (2.3, 3.4), (1.45, 5.0, 11.0, 12.3, 13.6), (("box", 3.7, 15.9, 3.95),),
    ),
    "truck.road_train": Truck(
        (18.75, 2.55, 4.0), (2.3, 3.75), (1.45, 5.6, 6.95, 13.9, 15.2),
        (("box", 2.5, 10.25, 4.0), ("box", 11.0, 18.75, 4.0)),
    ),
}  # fmt: skip
"""The shapes of trucks by name. To add one, add its row."""

BUSES: dict[str, Bus] = {
    "bus.minibus": Bus((7.2, 2.1, 2.85), (1.0, 5.0), 1.35, (2.25,), 0.75, None, 0.36),
    "bus.midi": Bus((9.0, 2.4, 3.05), (2.2, 6.4), 1.15, (2.5,), 0.2),
    "bus.city": Bus((12.0, 2.55, 3.1), (2.7, 8.7), 1.1, (2.55,)),
    "bus.articulated": Bus((18.1, 2.55, 3.15), (2.7, 8.6, 14.6), 1.1, (2.55,), 0.15, (10.4, 11.6)),
    "bus.coach": Bus((13.0, 2.55, 3.75), (2.8, 9.2, 10.6), 1.85, (3.15,), 0.55, None, 0.52),
    "bus.double_decker": Bus((10.9, 2.52, 4.25), (2.6, 8.2), 1.1, (2.1, 3.75), 0.3),
}
"""The shapes of buses by name. To add one, add its row."""


def truck(name: str) -> Mesh:
    """A truck of :data:`TRUCKS` or a bus of :data:`BUSES`."""
    row = TRUCKS.get(name) or BUSES[name]
    length, width, _ = row.size
    wheels = [axle(length / 2 - x, row.wheel, width / 2 - 0.01, edges=7, hub=3) for x in row.axles]
    bodies = _truck_bodies(row) if isinstance(row, Truck) else _bus_bodies(row)
    return join([*bodies, *wheels])


def _truck_bodies(row: Truck) -> list[Mesh]:
    """Cab, chassis and superstructures."""
    wide, front, floor = row.size[1] / 2, row.size[0] / 2, FLOOR * row.wheel / 0.5
    start = front - row.cab[0] + 0.1
    outline = [(-front, 0.6 * floor), (start, 0.55 * floor), (start, floor), (-front, floor)]
    rear: Strip = ("lamp rear", "trim", 0.25)
    chassis = prism(outline, wide - 0.03, ["trim", "trim", "trim", rear], "trim")
    made = [build(_cab(row)), chassis]
    for what, x0, x1, top in row.loads:
        made.append(_LOADS[what]((front - x1, front - x0), wide, (floor, top)))
    return made


def _cab(row: Truck) -> Body:
    """A cab over its engine; a low one is that of a light truck, whose windscreen leans more."""
    deep, high = row.cab
    front, wide = row.size[0] / 2, row.size[1] / 2
    back, low, belt = front - deep, 0.9 * row.wheel, 0.22 * high + 0.98
    rake = 0.75 if high < 2.5 else 0.22
    glass = min(high - 0.25, belt + 0.95)
    return Body(
        lower=(
            (back, belt), (back, low + 0.1), (front - 0.15, low), (front, low + 0.3),
            (front, 1.15), (front - 0.3 * rake, belt),
        ),
        skirt=("body", "trim", "trim", FACE, "body"),
        upper=((front - rake, glass), (front - rake - 0.3, high), (back, high)),
        top=("window", "body", "body", "body"),
        rail=glass - 0.12,
        windows=((front - 0.3 * rake - 0.15, back + 0.45 * deep, back + 0.45 * deep,
                  front - rake - 0.02),),
        width=((low, 0.97 * wide), (belt, 0.98 * wide), (high, 0.92 * wide)),
        taper=((front - 0.4, 1.0), (front, 0.94)),
    )  # fmt: skip


def _flat(x: tuple[float, float], wide: float, z: tuple[float, float]) -> Mesh:
    """A platform with low sides, and goods on it."""
    back, front = x
    rim, low = z[1], z[0]
    outline = [(back, low), (front, low), (front, rim), (back, rim)]
    tub = prism(outline, wide, ["tub", "tub", None, "tub"], "tub")
    goods = filled(x, wide, (rim, rim - 0.12, rim + 0.15), "tub", "load")
    return join([tub, goods])


def _tub(x: tuple[float, float], wide: float, z: tuple[float, float]) -> Mesh:
    """A tipping body and its heap."""
    (back, front), (low, rim) = x, z
    outline = [(back + 0.3, low), (front, low), (front, rim), (back, rim)]
    tub = prism(outline, wide, ["tub", "tub", None, "tub"], "tub")
    return join([tub, filled(x, wide, (rim, rim - 0.25, rim + 0.35), "tub", "load")])


def _tank(x: tuple[float, float], wide: float, z: tuple[float, float]) -> Mesh:
    """A round tank between domed ends, as long as the superstructure."""
    (back, front), middle = x, (z[0] + z[1]) / 2
    high = (z[1] - z[0]) / 2 / np.cos(np.pi / 6)
    path = [(back, 0, middle), (back + 0.35, 0, middle), (front - 0.35, 0, middle),
            (front, 0, middle)]  # fmt: skip
    rings = np.array([0.7, 1.0, 1.0, 0.7])
    return tube(path, wide * rings, high * rings, ["cargo"] * 3, edges=6)


def _drum(x: tuple[float, float], wide: float, z: tuple[float, float]) -> Mesh:
    """A concrete mixer's drum, which rises to the rear, over the frame that carries it."""
    (back, front), (low, top) = x, z
    path = [(front - 0.1, 0, low + 0.75), (front - 1.0, 0, low + 1.15),
            (back + 2.2, 0, low + 1.5), (back + 0.75, 0, top - 0.55)]  # fmt: skip
    rings = np.array([0.45, 1.0, 1.0, 0.42])
    drum = tube(path, (wide - 0.1) * rings, 1.25 * rings, ["cargo"] * 3, edges=6)
    frame = block((back + 0.3, front), 0.6 * wide, (low, low + 0.5), "trim")
    chute = prism(
        [(back, low - 0.1), (back + 0.5, low), (back + 0.9, top), (back + 0.6, top)],
        0.35 * wide, ["tub"] * 4, "tub",
    )  # fmt: skip
    return join([drum, frame, chute])


def _hopper(x: tuple[float, float], wide: float, z: tuple[float, float]) -> Mesh:
    """The tail of a refuse truck, with its open mouth."""
    (back, front), (low, top) = x, z
    outline = [(back + 0.35, low - 0.35), (front, low - 0.1), (front, top), (back + 0.9, top),
               (back, low + 1.1), (back + 0.1, low + 0.25)]  # fmt: skip
    mouth: Strip = ("tub", "trim", 0.2)
    return prism(outline, wide, ["trim", "tub", "tub", "tub", mouth, TAIL], "tub")


def _post(x: tuple[float, float], wide: float, z: tuple[float, float]) -> Mesh:
    """A folded loading crane behind the cab."""
    (back, front), (low, top) = x, z
    base = block((back, front), 0.8 * wide, (low, low + 0.5), "trim")
    column = block((back + 0.15, front - 0.15), 0.2 * wide, (low + 0.5, top - 0.3), "tub")
    arm = block((back + 0.05, front - 0.05), 0.92 * wide, (top - 0.3, top), "tub")
    return join([base, column, arm])


_LOADS = {
    "box": lambda x, wide, z: block(x, wide, z, "cargo"),
    "flat": _flat,
    "tub": _tub,
    "tank": _tank,
    "drum": _drum,
    "hopper": _hopper,
    "post": _post,
}


def _bus_bodies(row: Bus) -> list[Mesh]:
    """The body of a bus; the windows of an upper deck and the bellows of a joint stand out 5 mm."""
    length, width, height = row.size
    half, wide, low = length / 2, width / 2 - 0.005, 0.32
    screen, doors = half - row.rake, half - 1.5
    start, end = doors - 0.1, 0.35 - half
    count = max(2, round((start - end) / 1.9))
    edges = np.linspace(start, end, count + 1)
    low_rail = row.rails[0]
    panes = [(half - 0.4 * row.rake - 0.12, doors, doors, screen - 0.03)]
    panes += [(a, b + 0.1, b + 0.1, a) for a, b in pairwise(edges)]
    body = build(
        Body(
            lower=((-half, row.belt), (-half + 0.05, low), (half - 0.15, low),
                   (half, low + 0.35), (half - 0.02, 0.95), (half - 0.4 * row.rake, row.belt)),
            skirt=(TAIL, "trim", "trim", FACE, "body"),
            upper=((screen, low_rail + 0.1), (screen - 0.1, height - 0.06),
                   (screen - 0.5, height), (-half + 0.15, height), (-half + 0.03, low_rail + 0.1)),
            top=("window", "trim", "body", "body", "body", "window"),
            rail=low_rail,
            windows=tuple(panes),
            width=((low, 0.97 * wide), (row.belt, wide), (row.rails[-1], 0.985 * wide),
                   (height, 0.93 * wide)),
            taper=((-half, 0.96), (0.5 - half, 1.0), (half - 0.6, 1.0), (half, 0.92)),
        )
    )  # fmt: skip
    extra = []
    for rail in row.rails[1:]:
        band = (rail - 0.85, rail)
        extra.append(block((0.3 - half, screen - 0.6), width / 2, band, "window"))
    if row.joint is not None:
        front, back = (half - x for x in row.joint)
        extra.append(block((back, front), width / 2, (0.4, height - 0.15), "trim"))
    return [body, *extra]
