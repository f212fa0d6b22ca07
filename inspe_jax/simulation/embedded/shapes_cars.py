"""Cars as a table: one row of measures for each shape, from which its outline follows.

The lengths, widths without mirrors, heights, wheelbases and overhangs are those of common European
models of each segment (A to F, and J, M and S, of the European Commission's market segments), as in
their makers' data sheets and rounded to 1 or 5 cm. The rest of an outline is read from side views
of such models to about 5 cm: it is typical of a body style, and no model's in particular.
"""

from typing import NamedTuple

from inspe_jax.simulation.embedded.shapes_mesh import Line, Mesh, Strip, axle, join
from inspe_jax.simulation.embedded.shapes_vehicles import FACE, TAIL, Body, build

POST = 0.1
"""Width of the pillar between two side windows [m]."""
SCREEN_POST, TAIL_POST = (0.2, 0.09), (0.26, 0.12)
"""Widths of the pillars at the windscreen and at the tail, at the belt line and at the roof [m]."""


class Car(NamedTuple):
    """The measures of a car [m]; x is the distance from the front bumper, z the height.

    ``size`` is length, width, height; ``axles`` are x of the front axle and the wheelbase;
    ``wheel`` is the radius of the wheels, ``sill`` the height of the underside and ``nose`` that of
    the front edge of the bonnet. ``foot`` is the foot of the windscreen (x, z). ``roof`` runs from
    the windscreen to the rear window, ``tail`` from the foot of the rear window to the upper edge
    of the rear lamps. ``posts`` are x of the pillars between side windows; the windows end at
    ``glass``, or else near the rear window. ``waist`` is the half width at the roof over that at
    the belt line. ``clad`` says whether dark cladding covers the sides down to the sill, ``deck``
    is the part of the tail's upper side, and ``back`` that of the rear window.
    """

    size: tuple[float, float, float]
    axles: tuple[float, float]
    wheel: float
    sill: float
    nose: float
    foot: tuple[float, float]
    roof: tuple[tuple[float, float], ...]
    tail: tuple[tuple[float, float], ...]
    posts: tuple[float, ...] = ()
    glass: float | None = None
    waist: float = 0.86
    clad: bool = False
    deck: str = "body"
    back: Strip = "window"


VAN_DOORS: Strip = ("body", "window", 0.12)
"""Rear doors: a window between two pillars."""

CARS: dict[str, Car] = {
    "car.micro": Car(
        (2.7, 1.66, 1.55), (0.43, 1.87), 0.28, 0.17, 0.76, (0.55, 1.0),
        ((1.2, 1.5), (1.7, 1.55), (2.3, 1.5)), ((2.58, 1.04),),
    ),
    "car.city": Car(
        (3.6, 1.65, 1.5), (0.6, 2.42), 0.28, 0.16, 0.74, (0.92, 0.99),
        ((1.55, 1.46), (2.3, 1.5), (3.15, 1.45)), ((3.5, 1.02),), (2.0,),
    ),
    "car.retro": Car(
        (3.55, 1.63, 1.49), (0.72, 2.3), 0.29, 0.16, 0.82, (1.1, 0.99),
        ((1.62, 1.44), (2.1, 1.49), (2.7, 1.44)), ((3.36, 1.0), (3.48, 0.93)), (),
    ),
    "car.supermini": Car(
        (4.05, 1.75, 1.46), (0.8, 2.55), 0.31, 0.15, 0.72, (1.15, 0.98),
        ((1.85, 1.42), (2.5, 1.46), (3.45, 1.4)), ((3.93, 1.02),), (2.25,),
    ),
    "car.hatchback": Car(
        (4.3, 1.8, 1.47), (0.86, 2.64), 0.32, 0.15, 0.74, (1.3, 1.0),
        ((2.02, 1.44), (2.7, 1.47), (3.7, 1.41)), ((4.18, 1.03),), (2.45,),
    ),
    "car.liftback": Car(
        (4.7, 1.85, 1.44), (0.84, 2.88), 0.34, 0.15, 0.7, (1.12, 0.96),
        ((2.05, 1.39), (2.6, 1.44), (3.2, 1.39)), ((4.32, 1.1), (4.62, 1.1)), (2.55,),
    ),
    "car.compact_saloon": Car(
        (4.45, 1.8, 1.45), (0.86, 2.65), 0.31, 0.15, 0.76, (1.25, 1.0),
        ((1.98, 1.42), (2.6, 1.45), (3.25, 1.42)), ((3.82, 1.07), (4.36, 1.06)), (2.4,),
    ),
    "car.saloon": Car(
        (4.7, 1.83, 1.44), (0.78, 2.85), 0.33, 0.15, 0.78, (1.42, 0.99),
        ((2.18, 1.4), (2.75, 1.44), (3.4, 1.4)), ((4.0, 1.07), (4.62, 1.06)), (2.6,),
    ),
    "car.executive": Car(
        (4.95, 1.87, 1.46), (0.85, 2.95), 0.34, 0.15, 0.82, (1.6, 1.02),
        ((2.38, 1.42), (2.95, 1.46), (3.6, 1.43)), ((4.22, 1.09), (4.86, 1.06)), (2.8,),
    ),
    "car.limousine": Car(
        (5.25, 1.92, 1.5), (0.88, 3.17), 0.36, 0.14, 0.84, (1.62, 1.03),
        ((2.4, 1.46), (3.1, 1.5), (3.9, 1.47)), ((4.56, 1.1), (5.14, 1.05)), (2.9,),
    ),
    "car.compact_estate": Car(
        (4.65, 1.8, 1.48), (0.86, 2.69), 0.32, 0.15, 0.74, (1.3, 1.0),
        ((2.02, 1.44), (2.8, 1.48), (4.2, 1.46)), ((4.56, 1.02),), (2.45, 3.4),
    ),
    "car.estate": Car(
        (4.95, 1.87, 1.49), (0.85, 2.94), 0.34, 0.15, 0.8, (1.58, 1.02),
        ((2.36, 1.44), (3.1, 1.49), (4.45, 1.44)), ((4.85, 1.03),), (2.8, 3.75),
    ),
    "car.coupe": Car(
        (4.55, 1.84, 1.37), (0.8, 2.72), 0.34, 0.13, 0.72, (1.5, 0.95),
        ((2.25, 1.33), (2.65, 1.37), (3.15, 1.33)), ((3.95, 1.02), (4.46, 1.04)), (2.75,),
    ),
    "car.sports": Car(
        (4.5, 1.85, 1.3), (1.02, 2.45), 0.34, 0.12, 0.66, (1.28, 0.9),
        ((2.1, 1.26), (2.4, 1.3), (2.85, 1.24)), ((3.85, 0.93), (4.4, 0.84)), (2.55,),
    ),
    "car.small_suv": Car(
        (4.15, 1.78, 1.58), (0.8, 2.58), 0.33, 0.2, 0.88, (1.15, 1.08),
        ((1.82, 1.53), (2.5, 1.58), (3.6, 1.53)), ((4.04, 1.1),), (2.25,), clad=True,
    ),
    "car.suv": Car(
        (4.5, 1.85, 1.67), (0.88, 2.68), 0.35, 0.21, 0.96, (1.25, 1.13),
        ((1.95, 1.62), (2.7, 1.67), (4.0, 1.62)), ((4.4, 1.12),), (2.4, 3.45), clad=True,
    ),
    "car.suv_coupe": Car(
        (4.75, 1.92, 1.62), (0.87, 2.86), 0.37, 0.21, 0.95, (1.35, 1.12),
        ((2.05, 1.57), (2.6, 1.62), (3.25, 1.58)), ((4.4, 1.2), (4.66, 1.16)), (2.55,), clad=True,
    ),
    "car.large_suv": Car(
        (4.93, 2.0, 1.75), (0.87, 2.97), 0.38, 0.22, 1.02, (1.5, 1.19),
        ((2.15, 1.7), (2.9, 1.75), (4.35, 1.69)), ((4.84, 1.2),), (2.7, 3.85), clad=True,
    ),
    "car.off_road": Car(
        (4.6, 1.93, 1.95), (0.78, 2.85), 0.4, 0.26, 1.12, (1.5, 1.22),
        ((1.72, 1.92), (1.95, 1.95), (4.5, 1.95)), ((4.55, 1.2),), (2.5, 3.5), waist=0.92,
        clad=True,
    ),
    "car.compact_mpv": Car(
        (4.4, 1.83, 1.63), (0.9, 2.75), 0.32, 0.16, 0.8, (0.98, 1.04),
        ((1.95, 1.58), (2.6, 1.63), (3.9, 1.59)), ((4.3, 1.05),), (2.35, 3.4),
    ),
    "car.mpv": Car(
        (4.85, 1.9, 1.73), (0.93, 2.92), 0.34, 0.16, 0.84, (1.05, 1.07),
        ((2.0, 1.67), (2.7, 1.73), (4.45, 1.71)), ((4.76, 1.08),), (2.45, 3.6), waist=0.88,
    ),
    "car.pickup": Car(
        (5.3, 1.87, 1.81), (0.9, 3.15), 0.38, 0.27, 1.06, (1.5, 1.18),
        ((2.15, 1.76), (2.6, 1.81), (3.45, 1.78)), ((3.7, 1.2), (5.24, 1.16)), (2.65,),
        clad=True, deck="trim",
    ),
    "car.leisure_van": Car(
        (4.45, 1.86, 1.83), (0.9, 2.77), 0.33, 0.18, 0.88, (1.12, 1.13),
        ((1.85, 1.77), (2.4, 1.83), (4.25, 1.83)), ((4.4, 1.12),), (2.15, 3.25), waist=0.92,
    ),
    "car.small_van": Car(
        (4.4, 1.85, 1.8), (0.89, 2.78), 0.32, 0.17, 0.86, (1.0, 1.1),
        ((1.75, 1.74), (2.3, 1.8), (4.3, 1.8)), ((4.38, 1.05),), (), 2.05, 0.93, back="body",
    ),
    "car.van": Car(
        (4.95, 1.91, 1.98), (0.93, 3.0), 0.34, 0.2, 0.95, (0.78, 1.2),
        ((1.5, 1.92), (2.1, 1.98), (4.85, 1.98)), ((4.93, 1.15),), (), 1.95, 0.93, back=VAN_DOORS,
    ),
    "car.minibus": Car(
        (5.3, 1.92, 1.97), (0.93, 3.28), 0.34, 0.2, 0.95, (0.78, 1.18),
        ((1.5, 1.91), (2.1, 1.97), (5.18, 1.96)), ((5.27, 1.16),), (1.9, 3.1, 4.2), waist=0.93,
    ),
    "car.high_van": Car(
        (5.95, 2.02, 2.65), (1.0, 3.67), 0.35, 0.22, 1.05, (0.9, 1.4),
        ((1.6, 2.2), (2.05, 2.6), (2.6, 2.65), (5.9, 2.65)), ((5.93, 1.4),), (), 1.95, 0.94,
        back=VAN_DOORS,
    ),
}  # fmt: skip
"""The shapes of cars by name. To add one, add its row."""


def car(name: str) -> Mesh:
    """A car of :data:`CARS`."""
    row = CARS[name]
    length, width, _ = row.size
    front, base = row.axles
    wheels = [axle(length / 2 - x, row.wheel, width / 2 - 0.01) for x in (front, front + base)]
    return join([build(body_of(row)), *wheels])


def body_of(row: Car) -> Body:
    """The outline of a car; its middle is at x = 0."""
    length, width, height = row.size

    def at(points: Line) -> list[tuple[float, float]]:
        return [(length / 2 - x, z) for x, z in points]

    tail, foot, roof = at(row.tail), *at([row.foot]), at(row.roof)
    half, low = length / 2, row.sill
    bumper, chin = 0.42 * row.tail[-1][1] + 0.58 * low, 0.5 * (row.nose + low)
    ends = [(-half, bumper), (0.06 - half, low), (half - 0.12, low), (half, chin)]
    sides: Strip = "trim" if row.clad else "body"
    decks = (row.deck,) * (len(tail) - 1)
    belt, wide = (foot[1] + tail[0][1]) / 2, width / 2
    return Body(
        lower=(*tail, *ends, (half - 0.05, row.nose), foot),
        skirt=(*decks, TAIL, sides, "trim", sides, FACE, "body"),
        upper=tuple(roof),
        top=("window", *("body",) * (len(roof) - 1), row.back),
        rail=(rail := min(z for _, z in roof) - 0.07),
        windows=_windows(row, foot, roof, tail[0], rail),
        width=((low, 0.98 * wide), (0.55 * belt, wide), (belt, 0.985 * wide),
               (height, row.waist * wide)),
        taper=((-half, 0.96), (0.4 - half, 0.99), (1.0 - half, 1.0), (half - 1.1, 1.0),
               (half - 0.4, 0.975), (half, 0.91)),
        clad=len(tail) if row.clad else None,
    )  # fmt: skip


def _windows(
    row: Car,
    foot: tuple[float, float],
    roof: list[tuple[float, float]],
    tail: tuple[float, float],
    rail: float,
) -> tuple[tuple[float, float, float, float], ...]:
    """The side windows, between the pillars."""

    def leaning(low: tuple[float, float], high: tuple[float, float]) -> float:
        """x at the rail of the line between two points."""
        return float(low[0] + (high[0] - low[0]) * (rail - low[1]) / (high[1] - low[1]))

    middle = row.size[0] / 2
    lower = [foot[0] - SCREEN_POST[0]]
    upper = [leaning(foot, roof[0]) - SCREEN_POST[1]]
    for x in row.posts:
        lower += [middle - x + POST / 2, middle - x - POST / 2]
        upper += lower[-2:]
    if row.glass is None:
        lower.append(tail[0] + TAIL_POST[0])
        upper.append(leaning(tail, roof[-1]) + TAIL_POST[1])
    else:
        lower.append(middle - row.glass)
        upper.append(middle - row.glass)
    panes = range(0, len(lower), 2)
    return tuple((lower[k], lower[k + 1], upper[k + 1], upper[k]) for k in panes)
