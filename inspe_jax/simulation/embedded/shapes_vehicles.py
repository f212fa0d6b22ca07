"""Cars and trucks as tables of outlines, at the mean size of their class.

A body has an outline in x and z [m], side windows above a belt line, and a half width. The half
width is a function of height, times a taper along the vehicle.
"""

from typing import NamedTuple

import numpy as np

from inspe_jax.simulation.embedded.shapes_mesh import (
    Line,
    Mesh,
    Strip,
    axle,
    block,
    filled,
    join,
    prism,
    sides,
    strips,
)

Window = tuple[float, float, float, float]
"""A side window by x [m]: its lower edge, front and rear, then its upper edge, rear and front."""


class Body(NamedTuple):
    """A closed body with windows.

    ``lower`` runs from the foot of the rear window down the tail, along the underside, and up the
    front to the foot of the windscreen. ``upper`` continues from there over the roof back to the
    rear window; it leaves both feet out. The belt line joins the feet; ``rail`` is the height of
    the upper edge of the side windows [m]. ``skirt`` and ``top`` are the parts of the edges of
    ``lower`` and ``upper``. If ``clad`` is given, dark cladding covers the sides between four
    points of ``lower``, of which ``clad`` is the first.
    """

    lower: Line
    skirt: tuple[Strip, ...]
    upper: Line
    top: tuple[Strip, ...]
    rail: float
    windows: tuple[Window, ...]
    width: Line
    taper: Line
    clad: int | None = None


def build(body: Body) -> Mesh:
    """The mesh of a body."""
    tail, cowl = body.lower[0], body.lower[-1]
    outline = [*body.lower, *body.upper]
    belt = [(x, _at(x, (tail, cowl))) for w in body.windows for x in w[:2]]
    rail = [(x, body.rail) for w in body.windows for x in (w[3], w[2])]
    # Belt and rail from windscreen to tail: between them pillar, window, pillar, …
    below, above = [cowl, *belt, tail], [body.upper[0], *rail, body.upper[-1]]
    flank = [*body.lower]
    panels = [("body", [*body.upper, *rail[::-1]])]
    if body.clad is not None:
        panels.append(("trim", flank[body.clad : body.clad + 4]))
        del flank[body.clad + 1 : body.clad + 3]
    panels.append(("body", [*flank, *belt]))
    for k in range(len(below) - 1):
        part = "window" if k % 2 else "body"
        panels.append((part, [below[k], below[k + 1], above[k + 1], above[k]]))
    return join(
        [strips(outline, _halves(body, outline), (*body.skirt, *body.top))]
        + [sides(points, _halves(body, points), part) for part, points in panels]
    )


def _at(x: float, line: Line) -> float:
    places, values = zip(*line, strict=True)
    return float(np.interp(x, places, values))


def _halves(body: Body, points: Line) -> list[float]:
    return [_at(z, body.width) * _at(x, body.taper) for x, z in points]


TAIL: Strip = ("lamp rear", "body", 0.25)
FACE: Strip = ("lamp", "trim", 0.3)
GLAZED: tuple[Strip, ...] = ("window", "body", "window")
TAPER: Line = ((-2.3, 0.97), (-1.9, 0.99), (-1.2, 1.0), (1.2, 1.0), (1.9, 0.98), (2.3, 0.91))

CARS: dict[str, tuple[Body, tuple[float, float, float]]] = {
    "car.saloon": (
        Body(
            lower=(
                (-1.72, 1.12),
                (-2.26, 1.11),
                (-2.3, 0.65),
                (-2.24, 0.17),
                (2.18, 0.16),
                (2.3, 0.5),
                (2.26, 0.86),
                (1.1, 1.05),
            ),
            skirt=("body", TAIL, "body", "trim", "body", FACE, "body"),
            upper=((0.4, 1.53), (-1.15, 1.53)),
            top=GLAZED,
            rail=1.45,
            windows=((0.9, -0.25, -0.25, 0.43), (-0.35, -1.44, -1.14, -0.35)),
            width=((0.16, 0.9), (0.6, 0.91), (1.05, 0.9), (1.53, 0.79)),
            taper=TAPER,
        ),
        (1.42, -1.38, 0.33),
    ),
    "car.estate": (
        Body(
            lower=(
                (-2.26, 1.02),
                (-2.3, 0.62),
                (-2.24, 0.17),
                (2.18, 0.16),
                (2.3, 0.5),
                (2.26, 0.85),
                (1.1, 1.03),
            ),
            skirt=(TAIL, "body", "trim", "body", FACE, "body"),
            upper=((0.4, 1.52), (-1.98, 1.53)),
            top=GLAZED,
            rail=1.43,
            windows=((0.9, -0.45, -0.45, 0.43), (-0.55, -2.02, -1.84, -0.55)),
            width=((0.16, 0.9), (0.6, 0.91), (1.02, 0.9), (1.53, 0.78)),
            taper=TAPER,
        ),
        (1.42, -1.38, 0.33),
    ),
    "car.hatchback": (
        Body(
            lower=(
                (-2.2, 1.08),
                (-2.3, 0.62),
                (-2.22, 0.18),
                (2.18, 0.16),
                (2.3, 0.5),
                (2.24, 0.86),
                (1.3, 1.06),
            ),
            skirt=(TAIL, "body", "trim", "body", FACE, "body"),
            upper=((0.5, 1.54), (-1.5, 1.54)),
            top=GLAZED,
            rail=1.45,
            windows=((1.08, -0.35, -0.35, 0.52), (-0.47, -1.65, -1.3, -0.47)),
            width=((0.16, 0.9), (0.6, 0.91), (1.08, 0.9), (1.54, 0.78)),
            taper=TAPER,
        ),
        (1.55, -1.5, 0.36),
    ),
    "car.suv": (
        Body(
            lower=(
                (-2.25, 1.05),
                (-2.3, 0.52),
                (-2.22, 0.27),
                (2.2, 0.28),
                (2.3, 0.55),
                (2.28, 1.0),
                (1.1, 1.08),
            ),
            skirt=(TAIL, "trim", "trim", "trim", FACE, "body"),
            upper=((0.7, 1.54), (-2.12, 1.55)),
            top=GLAZED,
            rail=1.43,
            windows=((0.93, -0.4, -0.4, 0.71), (-0.54, -2.0, -1.95, -0.54)),
            width=((0.27, 0.91), (0.55, 0.91), (1.05, 0.9), (1.55, 0.82)),
            taper=((-2.3, 0.98), (-1.9, 0.99), (-1.2, 1.0), (1.2, 1.0), (2.0, 0.98), (2.3, 0.94)),
            clad=1,
        ),
        (1.42, -1.38, 0.4),
    ),
    "car.van": (
        Body(
            lower=(
                (-2.28, 0.95),
                (-2.3, 0.6),
                (-2.25, 0.24),
                (2.1, 0.2),
                (2.3, 0.45),
                (2.22, 0.72),
                (1.7, 0.9),
            ),
            skirt=(TAIL, "body", "trim", "trim", FACE, "body"),
            upper=((1.05, 1.5), (0.8, 1.55), (-2.22, 1.55)),
            top=("window", "body", "body", ("body", "window", 0.12)),
            rail=1.36,
            windows=((1.5, 0.5, 0.5, 1.1),),
            width=((0.2, 0.88), (0.6, 0.91), (0.95, 0.9), (1.55, 0.8)),
            taper=((-2.3, 0.97), (1.2, 1.0), (1.9, 0.95), (2.3, 0.84)),
        ),
        (1.55, -1.45, 0.32),
    ),
}
"""Of each car its body, and (x of the front axle, x of the rear axle, radius of the wheels) [m]."""


def car(name: str) -> Mesh:
    """A car of :data:`CARS`."""
    body, (front, rear, radius) = CARS[name]
    return join([build(body)] + [axle(x, radius, 0.905) for x in (front, rear)])


CAB = Body(
    lower=((2.4, 1.75), (2.4, 0.6), (4.1, 0.45), (4.25, 0.7), (4.25, 1.15), (4.2, 1.75)),
    skirt=("body", "trim", "trim", FACE, "body"),
    upper=((4.0, 2.7), (2.55, 2.8)),
    top=("window", "body", "body"),
    rail=2.5,
    windows=((3.95, 3.05, 3.05, 3.8),),
    width=((0.45, 1.18), (1.75, 1.2), (2.8, 1.1)),
    taper=((3.8, 1.0), (4.25, 0.93)),
)

BUS = Body(
    lower=((-4.25, 1.5), (-4.2, 0.4), (4.1, 0.35), (4.25, 1.05), (4.22, 1.5)),
    skirt=(TAIL, "trim", FACE, "body"),
    upper=((4.05, 2.9), (3.9, 3.35), (-4.15, 3.4), (-4.22, 2.75)),
    top=("window", "trim", "body", "body", "window"),
    rail=2.75,
    windows=((3.9, 2.2, 2.2, 3.8), (2.0, -0.8, -0.8, 2.0), (-1.0, -3.9, -3.9, -1.0)),
    width=((0.35, 1.2), (1.5, 1.23), (3.4, 1.12)),
    taper=((-4.25, 0.97), (-3.8, 1.0), (3.8, 1.0), (4.25, 0.93)),
)


def truck(name: str) -> Mesh:
    """A truck or bus by name: ``truck.box``, ``truck.tipper`` or ``truck.bus``."""
    if name == "truck.bus":
        return join([build(BUS), *(axle(x, 0.46, 1.225, edges=7, hub=3) for x in (2.6, -2.4))])
    chassis = prism(
        [(-4.2, 0.55), (2.4, 0.55), (2.4, 1.0), (-4.2, 1.0)],
        1.25,
        ["trim", "trim", None, ("lamp rear", "trim", 0.25)],
        "trim",
    )
    cab = [build(CAB), chassis, *(axle(x, 0.48, 1.26, edges=7) for x in (3.35, -2.5))]
    if name == "truck.box":
        return join([*cab, block((-4.25, 2.4), 1.25, (1.0, 3.4), "cargo")])
    back, front, rim = -4.25, 2.4, 2.35
    outline = [(-4.2, 1.0), (2.4, 1.0), (front, rim), (back, rim)]
    tub = prism(outline, 1.25, [None, "tub", None, "tub"], "tub")
    return join([*cab, tub, filled((back, front), 1.25, (rim, 2.15, 2.7), "tub", "load")])
