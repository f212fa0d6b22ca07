"""The bodies of cars, trucks and buses, from an outline and windows.

A body has an outline in x and z [m], side windows above a belt line, and a half width. The half
width is a function of height, times a taper along the vehicle.
"""

from typing import NamedTuple

import numpy as np

from inspe_jax.simulation.embedded.shapes_mesh import Line, Mesh, Strip, join, sides, strips

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
"""Parts of the upper edge of a tail and of a face: lamps at both sides."""
