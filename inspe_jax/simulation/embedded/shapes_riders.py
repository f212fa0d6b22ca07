"""Bicycles, motorcycles and scooters with their riders: one row of a table for each shape.

x forward, y left, z up [m], the ground at 0. Wheels of bicycles are those of ISO 5775 with their
tyres (622 mm rims: 0.34 m), wheelbases and saddles those of common models of each sort to 2 cm.
"""

from typing import NamedTuple

import numpy as np

from inspe_jax.simulation.embedded.shapes_mesh import (
    Mesh,
    block,
    join,
    mirrored,
    polygon,
    prism,
    tube,
)
from inspe_jax.simulation.embedded.shapes_people import Vector, head_on

Point = tuple[float, float, float]

CRANK_LENGTH = 0.17
"""From the axle of the cranks to a pedal [m]."""


class Rider(NamedTuple):
    """A two-wheeler and its rider [m]. Points are (x, y, z).

    ``size`` is length, width, height; ``wheel`` the radius of the wheels, ``rear`` and ``front``
    their x, ``tyre`` half their width. ``saddle`` and ``neck`` are the hips and the middle between
    the shoulders, ``grip`` the left hand, ``foot`` the axle of the cranks, or a motorcycle's left
    foot rest. ``limbs`` multiplies the lengths of arms and legs. ``loads`` are boxes: x of rear and
    front, half width, z of bottom and top, and part. ``motor`` says whether it is a motorcycle.
    """

    size: tuple[float, float, float]
    wheel: float
    rear: float
    front: float
    saddle: Point
    neck: Point
    grip: Point
    foot: Point
    tyre: float = 0.03
    limbs: float = 1.0
    loads: tuple[tuple[float, float, float, float, float, str], ...] = ()
    motor: bool = False


RIDERS: dict[str, Rider] = {
    "bicycle.upright": Rider(
        (1.8, 0.65, 1.75), 0.34, -0.56, 0.56, (-0.28, 0.0, 0.95), (-0.17, 0.0, 1.42),
        (0.3, 0.3, 1.08), (-0.1, 0.0, 0.3),
    ),
    "bicycle.sport": Rider(
        (1.78, 0.68, 1.68), 0.34, -0.55, 0.55, (-0.28, 0.0, 0.97), (0.12, 0.0, 1.36),
        (0.45, 0.24, 0.93), (-0.1, 0.0, 0.3),
    ),
    "bicycle.mountain": Rider(
        (1.88, 0.72, 1.74), 0.36, -0.58, 0.6, (-0.26, 0.0, 0.93), (0.02, 0.0, 1.41),
        (0.4, 0.35, 1.03), (-0.1, 0.0, 0.32), 0.045,
        loads=((-0.36, -0.2, 0.14, 1.05, 1.42, "bag"),),
    ),
    "bicycle.touring": Rider(
        (1.85, 0.65, 1.74), 0.35, -0.58, 0.56, (-0.28, 0.0, 0.96), (-0.06, 0.0, 1.42),
        (0.38, 0.29, 1.04), (-0.1, 0.0, 0.3),
        loads=((-0.78, -0.42, 0.24, 0.38, 0.74, "bag"), (-0.8, -0.4, 0.15, 0.73, 0.96, "bag")),
    ),
    "bicycle.courier": Rider(
        (1.8, 0.7, 1.75), 0.34, -0.56, 0.56, (-0.26, 0.0, 0.95), (0.0, 0.0, 1.42),
        (0.36, 0.29, 1.03), (-0.1, 0.0, 0.3),
        loads=((-0.66, -0.24, 0.22, 1.06, 1.5, "cargo"),),
    ),
    "bicycle.cargo": Rider(
        (2.51, 0.68, 1.75), 0.31, -0.92, 0.97, (-0.64, 0.0, 0.95), (-0.53, 0.0, 1.42),
        (-0.1, 0.3, 1.06), (-0.45, 0.0, 0.3),
        loads=((0.0, 0.68, 0.32, 0.3, 0.85, "cargo"),),
    ),
    "bicycle.child": Rider(
        (1.32, 0.52, 1.33), 0.26, -0.4, 0.4, (-0.2, 0.0, 0.66), (-0.13, 0.0, 1.02),
        (0.22, 0.24, 0.8), (-0.06, 0.0, 0.24), 0.03, 0.72,
    ),
    "scooter.electric": Rider(
        (1.12, 0.64, 1.89), 0.12, -0.44, 0.44, (-0.06, 0.0, 1.12), (-0.02, 0.0, 1.57),
        (0.34, 0.24, 1.12), (0.0, 0.08, 0.2), 0.035,
    ),
    "motorcycle.scooter": Rider(
        (1.8, 0.69, 1.63), 0.24, -0.66, 0.66, (-0.3, 0.0, 0.84), (-0.2, 0.0, 1.3),
        (0.28, 0.33, 1.02), (0.16, 0.14, 0.34), 0.06, 1.0,
        ((-0.86, -0.12, 0.17, 0.36, 0.8, "frame"), (0.26, 0.42, 0.2, 0.3, 0.98, "frame"),
         (-0.2, 0.4, 0.16, 0.2, 0.3, "trim")), True,
    ),
    "motorcycle.delivery": Rider(
        (1.86, 0.71, 1.63), 0.24, -0.66, 0.68, (-0.2, 0.0, 0.84), (-0.1, 0.0, 1.3),
        (0.34, 0.33, 1.02), (0.2, 0.14, 0.34), 0.06, 1.0,
        ((-0.8, -0.02, 0.17, 0.36, 0.8, "frame"), (0.32, 0.46, 0.2, 0.3, 0.98, "frame"),
         (-0.1, 0.44, 0.16, 0.2, 0.3, "trim"), (-0.92, -0.46, 0.23, 0.8, 1.28, "cargo")), True,
    ),
    "motorcycle.naked": Rider(
        (2.06, 0.74, 1.6), 0.31, -0.72, 0.72, (-0.3, 0.0, 0.84), (-0.04, 0.0, 1.27),
        (0.36, 0.37, 1.05), (-0.16, 0.2, 0.36), 0.08, 1.0,
        ((-0.92, -0.2, 0.13, 0.68, 0.8, "trim"), (-0.18, 0.36, 0.15, 0.66, 0.94, "frame"),
         (-0.3, 0.34, 0.17, 0.2, 0.7, "trim")), True,
    ),
    "motorcycle.sport": Rider(
        (2.04, 0.71, 1.49), 0.31, -0.7, 0.72, (-0.34, 0.0, 0.86), (0.06, 0.0, 1.16),
        (0.46, 0.31, 0.88), (-0.3, 0.2, 0.4), 0.085, 1.0,
        ((-0.96, -0.24, 0.11, 0.78, 0.94, "frame"), (-0.2, 0.34, 0.15, 0.6, 0.9, "frame"),
         (-0.24, 0.66, 0.19, 0.24, 0.62, "frame"), (0.44, 0.72, 0.17, 0.62, 1.02, "frame")), True,
    ),
    "motorcycle.tourer": Rider(
        (2.18, 0.92, 1.66), 0.32, -0.76, 0.76, (-0.26, 0.0, 0.86), (-0.12, 0.0, 1.33),
        (0.34, 0.4, 1.1), (-0.04, 0.22, 0.36), 0.08, 1.0,
        ((-0.9, -0.16, 0.17, 0.68, 0.84, "trim"), (-0.14, 0.4, 0.18, 0.66, 0.98, "frame"),
         (-0.26, 0.42, 0.24, 0.22, 0.7, "trim"), (0.4, 0.68, 0.22, 0.72, 1.3, "frame"),
         (-1.0, -0.46, 0.46, 0.44, 0.8, "bag"), (-1.08, -0.68, 0.26, 0.84, 1.2, "bag")), True,
    ),
}  # fmt: skip
"""The shapes of two-wheelers by name. To add one, add its row."""


def pedals(name: str) -> bool:
    """Whether the shape's legs turn cranks, so that it has phases."""
    return name.startswith("bicycle.")


def rider(name: str, phase: float) -> Mesh:
    """A two-wheeler of :data:`RIDERS` and its rider; at phase 0 the left pedal is in front."""
    row = RIDERS[name]
    saddle, neck, grip = (np.array(point) for point in (row.saddle, row.neck, row.grip))
    if pedals(name):
        left, right = (_leg(row, _pedal(row, phase + on)) for on in (0.0, 0.5))
    else:
        left = right = _leg(row, np.array(row.foot))
    arm, chin = _arm(row, neck, grip), neck + np.array([0.06, 0, 0.06]) * row.limbs
    girth = (1 + row.limbs) / 2
    torso = tube(
        [saddle + [-0.03, 0, 0.02], neck - 0.08 * (neck - saddle), chin + [0.0, 0, 0.06]],
        wide=girth * np.array([0.17, 0.19, 0.05]),
        deep=girth * np.array([0.12, 0.13, 0.05]),
        parts=("cloth", "cloth"),
        edges=6,
        caps=(True, False),
    )
    head = head_on(tuple(chin), "helmet")
    machine = _motorcycle(row) if row.motor else _bicycle(row, standing=not pedals(name))
    return join([*machine, torso, head, left, mirrored(right), arm, mirrored(arm)])


def _pedal(row: Rider, phase: float) -> Vector:
    """The ankle of a rider whose pedal is at a phase."""
    turn = 2 * np.pi * phase
    reach = CRANK_LENGTH * row.limbs
    return np.array(row.foot) + [reach * np.cos(turn), 0.12, -reach * np.sin(turn)]


def _leg(row: Rider, sole: Vector) -> Mesh:
    """The left leg of a rider, down to the sole of the shoe."""
    ankle = sole + np.array([-0.08, 0, 0.09]) * row.limbs
    hip = np.array(row.saddle) + [0.0, 0.09 * row.limbs, 0.0]
    knee = _bent(hip, ankle, 0.46 * row.limbs, 0.45 * row.limbs, np.array([1.0, 0, 0.5]))
    if row.motor:
        knee = knee + [0.0, 0.07, 0.0]  # beside the tank
    return tube(
        [hip, knee, ankle, ankle + np.array([0.2, 0, -0.07]) * row.limbs],
        wide=(0.1, 0.075, 0.05, 0.0),
        deep=(0.11, 0.08, 0.055, 0.0),
        parts=("trousers", "trousers", "shoe"),
        edges=3,
        caps=(True, False),
    )


def _arm(row: Rider, neck: Vector, grip: Vector) -> Mesh:
    """The left arm of a rider."""
    shoulder = neck + np.array([0.0, 0.17, -0.03]) * row.limbs
    upper = 0.31 * row.limbs
    elbow = _bent(shoulder, grip, upper, upper, np.array([0, 0.5, -1.0]))
    return tube(
        [shoulder, elbow, grip],
        wide=(0.07, 0.06, 0.0),
        deep=(0.07, 0.06, 0.0),
        parts=("cloth", "cloth" if row.motor else "skin"),
        edges=3,
        caps=(True, False),
    )


def _bent(start: Vector, end: Vector, upper: float, lower: float, towards: Vector) -> Vector:
    """The knee or elbow of a limb from start to end, whose parts have these lengths [m].

    It bends ``towards`` a direction. A limb that is too short is stretched.
    """
    reach = end - start
    far = np.linalg.norm(reach)
    along = np.clip((far**2 + upper**2 - lower**2) / (2 * far), -upper, upper)
    out = towards - (towards @ reach) / far**2 * reach
    out /= np.linalg.norm(out)
    return start + reach / far * along + out * np.sqrt(upper**2 - along**2)


def _bicycle(row: Rider, *, standing: bool) -> list[Mesh]:
    """Two wheels, the bars of the frame, the handlebar up to the grips, and loads."""
    grip, crank, saddle = (np.array(point) for point in (row.grip, row.foot, row.saddle))
    hubs = np.array([row.front, 0, row.wheel]), np.array([row.rear, 0, row.wheel])
    stem = np.array([grip[0] + 0.08, 0.0, grip[2]])
    head = stem + 0.36 * (hubs[0] - stem)
    bars = [_bar([stem, head, hubs[0]], (0.03, 0.04, 0.0))]
    if standing:
        deck = block((hubs[1][0], hubs[0][0]), 0.08, (row.wheel, row.wheel + 0.06), "frame")
        bars.append(deck)
    else:
        bars += [
            _bar([crank, hubs[1]], (0.05, 0.0)),
            _bar([crank, head], (0.04, 0.035)),
            _bar([crank, saddle + [0, 0, 0.1]], (0.035, 0.04)),
            _bar([head, saddle - [0, 0, 0.15]], (0.04, 0.0)),
        ]
    handle = _bar([stem, grip], (0.035, 0.0))
    rings = [_ring(x, row.wheel, row.tyre) for x in (row.front, row.rear)]
    return [*rings, *bars, handle, mirrored(handle), *_loads(row)]


def _motorcycle(row: Rider) -> list[Mesh]:
    """Two discs as wheels, the fork, a lamp at its top, the handlebar, and the loads."""
    grip = np.array(row.grip)
    stem = np.array([grip[0] + 0.06, 0.0, grip[2]])
    hub = np.array([row.front, 0.0, row.wheel])
    fork = tube([stem, hub], (0.07, 0.0), (0.05, 0.0), ["trim"], edges=3, caps=(True, False))
    handle = _bar([stem, grip], (0.035, 0.0))
    front = max([stem[0] + 0.08, *(box[1] for box in row.loads)])
    lamp = block((front - 0.1, front + 0.02), 0.08, (stem[2] - 0.24, stem[2] - 0.1), "lamp")
    back = min(box[0] for box in row.loads)
    bottom = min(box[3] for box in row.loads if box[0] == back)
    light = block((back - 0.02, back + 0.1), 0.08, (bottom + 0.02, bottom + 0.1), "lamp rear")
    discs = [_disc(x, row.wheel, row.tyre) for x in (row.front, row.rear)]
    return [*discs, fork, handle, mirrored(handle), lamp, light, *_loads(row)]


def _loads(row: Rider) -> list[Mesh]:
    return [block((x0, x1), half, (z0, z1), part) for x0, x1, half, z0, z1, part in row.loads]


def _bar(path: list[Vector], half: tuple[float, ...]) -> Mesh:
    return tube(path, half, half, ["frame"] * (len(path) - 1), edges=3)


def _ring(x: float, radius: float, half: float, edges: int = 8) -> Mesh:
    """A tyre with a triangular section, its ridge outward; it stands on one of its flats."""
    turn = 2 * np.pi * (np.arange(edges + 1) + 0.5) / edges - np.pi / 2
    spoke = np.stack([np.cos(turn), np.zeros(edges + 1), np.sin(turn)], -1)
    middle, across = np.array([x, 0, radius]), np.array([0, half, 0])
    outer = middle + spoke * radius / np.cos(np.pi / edges)
    left, right = (middle + spoke * (radius - 0.05) + side for side in (across, -across))
    section = ((outer, left), (left, right), (right, outer))
    return join(
        [
            polygon([b[k], b[k + 1], a[k + 1], a[k]], "tyre")
            for k in range(edges)
            for a, b in section
        ]
    )


def _disc(x: float, radius: float, half: float, edges: int = 8) -> Mesh:
    """A motorcycle's wheel; it stands on one of its flats."""
    turn = 2 * np.pi * (np.arange(edges) + 0.5) / edges - np.pi / 2
    rim = radius / np.cos(np.pi / edges) * np.stack([np.cos(turn), np.sin(turn)], -1)
    rim += [x, radius]
    return prism([(a, b) for a, b in rim], half, ["tyre"] * edges, "tyre")
