"""Pedestrians and cyclists as jointed tubes; their pose follows the phase of a stride or a crank.

They have the mean size of their class: x forward, y left, z up [m], the ground at 0.
"""

import numpy as np
from jaxtyping import Float

from inspe_jax.simulation.embedded.shapes_mesh import Mesh, join, mirrored, polygon, tube

Vector = Float[np.ndarray, "3"]

HIP, THIGH, SHIN = 0.91, 0.43, 0.40
"""Height of the hip joint and lengths of the leg [m]."""

STRIDE = np.radians(10.0)
"""Largest angle of a thigh from the vertical [rad]; small, because the class's boxes are short."""

TRUNK, REACH = 0.14, 0.25
"""Half the depth of a trunk, and half the length of a pedestrian's box of mean size [m]."""

WALKERS: dict[str, tuple[float, bool]] = {
    "walker.stride_left": (0.0, False),
    "walker.stride_right": (0.5, False),
    "walker.coat": (0.0, True),
}
"""The walking pedestrians: by how many cycles each is ahead, and whether it wears a coat."""


def pedestrian(name: str, phase: float) -> Mesh:
    """A pedestrian: one of :data:`WALKERS` at a phase of 0 … 1 of the cycle, or one who stands.

    At phase 0 the left heel has just touched the ground in front; ``stride_right`` is half a cycle
    ahead of that.
    """
    if name not in WALKERS:
        return _fold(join([_figure(), *_standing_limbs(), _backpack()]))
    start, coat = WALKERS[name]
    left, right = (_walking_limbs(phase + start + on, coat) for on in (0.0, 0.5))
    return _fold(join([_figure(coat), left, mirrored(right)]))


def _fold(mesh: Mesh) -> Mesh:
    """Scale limbs along x to fill the box, so that the trunk has the same depth at all phases."""
    x = mesh.vertices[:, 0]
    folded = np.interp(x, [x.min(), -TRUNK, TRUNK, x.max()], [-REACH, -TRUNK, TRUNK, REACH])
    return mesh._replace(vertices=np.column_stack([folded, mesh.vertices[:, 1:]]))


def _figure(coat: bool = False) -> Mesh:
    """Torso and head; a coat reaches below the knees."""
    hem, wide, deep = (0.4, 0.24, 0.3) if coat else (0.77, 0.165, 0.12)
    torso = tube(
        [(0, 0, hem), (0, 0, 1.0), (0, 0, 1.32), (0, 0, 1.42), (0, 0, 1.52)],
        wide=(wide, 0.18, 0.2, 0.19, 0.05),
        deep=(deep, 0.15, 0.16, 0.13, 0.06),
        parts=("cloth" if coat else "trousers", "cloth", "cloth", "cloth"),
        edges=6,
        caps=(True, False),
    )
    return join([torso, _head((0.02, 0.0, 1.46), "hair")])


def _head(chin: tuple[float, float, float], top: str) -> Mesh:
    """A head from the chin up. Its crown has the part ``top``; if that is hair, the nape too."""
    x, y, z = chin
    nape = "hair" if top == "hair" else "skin"
    return tube(
        [(x, y, z), (x, y, z + 0.15), (x - 0.02, y, z + 0.26)],
        wide=(0.055, 0.085, 0.05),
        deep=(0.075, 0.12, 0.07),
        parts=((nape, nape, nape, "skin", "skin", "skin"), top),
        edges=6,
    )


def _leg(hip: Vector, knee: Vector, ankle: Vector, toe_up: float) -> list[Mesh]:
    """Thigh, shin and shoe; the toe points ``toe_up`` [rad] above the horizontal."""
    cuff = ankle + 0.1 * (ankle - knee)  # in the shoe
    leg = tube(
        [hip, knee, cuff],
        wide=(0.1, 0.08, 0.06),
        deep=(0.13, 0.1, 0.075),
        parts=("trousers", "trousers"),
        edges=4,
        caps=(True, False),
    )
    cos, sin = np.cos(toe_up), np.sin(toe_up)
    sole = ankle - np.array([-sin, 0, cos]) * 0.045
    heel, toe = (sole + np.array([cos, 0, sin]) * reach for reach in (-0.08, 0.18))
    return [leg, tube([heel, toe], (0.065, 0.055), (0.06, 0.045), ["shoe"], edges=4)]


def _arm(shoulder: Vector, elbow: Vector, hand: Vector) -> Mesh:
    wrist = elbow + 0.75 * (hand - elbow)
    return tube(
        [shoulder, elbow, wrist, hand],
        wide=(0.07, 0.06, 0.05, 0.0),
        deep=(0.085, 0.075, 0.06, 0.0),
        parts=("cloth", "cloth", "skin"),
        edges=4,
        caps=(True, False),
    )


def _walking_limbs(phase: float, coat: bool) -> Mesh:
    """The left leg, and the left arm, which swings the other way."""
    turn = 2 * np.pi * phase
    thigh = STRIDE * np.cos(turn)
    bend = np.radians(2 + 36 * max(0.0, -np.sin(turn)) + 6 * max(0.0, -np.cos(turn)))
    hip = np.array([0.03, 0.065 if coat else 0.09, HIP])
    knee = hip + THIGH * _swung(thigh)
    ankle = knee + SHIN * _swung(thigh - bend)
    top = 0.15 * hip + 0.85 * knee if coat else hip  # what a coat hides must not show through it
    leg = _leg(top, knee, ankle, toe_up=0.9 * (thigh - bend))
    shoulder, swing = np.array([0, 0.17, 1.39]), -0.3 * np.cos(turn)
    elbow = shoulder + 0.28 * _swung(swing - 0.1) + [0, 0.05, 0]
    return join([*leg, _arm(shoulder, elbow, elbow + 0.3 * _swung(swing + 0.3))])


def _swung(angle: float) -> Vector:
    """The unit vector that points straight down, swung forward by an angle [rad]."""
    return np.array([np.sin(angle), 0.0, -np.cos(angle)])


def _standing_limbs() -> list[Mesh]:
    """Limbs of somebody who stands, one foot ahead, the right hand raised to a telephone."""
    limbs = []
    for side, ahead in ((1.0, 0.06), (-1.0, -0.04)):
        hip = np.array([0, side * 0.09, HIP])
        ankle = np.array([ahead, side * 0.12, 0.08])
        limbs += _leg(hip, (hip + ankle) / 2 + [0.02, 0, 0], ankle, toe_up=0.0)
    left = [np.array(p) for p in ((0, 0.17, 1.39), (-0.03, 0.23, 1.1), (0.04, 0.22, 0.82))]
    right = [np.array(p) for p in ((0, -0.17, 1.39), (0.02, -0.24, 1.12), (0.27, -0.12, 1.25))]
    return [*limbs, _arm(*left), _arm(*right)]


def _backpack() -> Mesh:
    path = [(-0.17, 0, 1.0), (-0.17, 0, 1.42)]
    return tube(path, (0.2, 0.17), (0.13, 0.1), ["bag"], edges=4)


WHEEL, REAR, FRONT = 0.34, -0.56, 0.56
"""Radius of a bicycle's wheels, and where they are along x [m]."""
CRANK = np.array([-0.1, 0.0, 0.3])
SADDLE = np.array([-0.28, 0.0, 0.95])

POSTURES: dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "bicycle.upright": ((-0.17, 0.0, 1.42), (0.3, 0.3, 1.08)),
    "bicycle.sport": ((0.12, 0.0, 1.36), (0.45, 0.27, 0.93)),
}
"""The middle between the shoulders, and the left hand, of each cyclist (x, y, z) [m]."""


def cyclist(name: str, phase: float) -> Mesh:
    """A bicycle and its rider; at phase 0 the left pedal is in front."""
    neck, grip = (np.array(point) for point in POSTURES[name])
    arm, left, right = _reaching(neck, grip), _pedalling(phase), _pedalling(phase + 0.5)
    chin = neck + [0.06, 0, 0.06]
    torso = tube(
        [SADDLE + [-0.03, 0, 0.02], neck - 0.08 * (neck - SADDLE), chin + [0.0, 0, 0.06]],
        wide=(0.17, 0.19, 0.05),
        deep=(0.12, 0.13, 0.05),
        parts=("cloth", "cloth"),
        edges=6,
        caps=(True, False),
    )
    return join(
        [
            *_bicycle(grip),
            torso,
            _head(tuple(chin), "helmet"),
            left,
            mirrored(right),
            arm,
            mirrored(arm),
        ]
    )


def _bicycle(grip: Vector) -> list[Mesh]:
    """Two wheels, the bars of the frame, and the handlebar up to the grips."""
    head, stem = np.array([0.38, 0.0, 0.82]), np.array([grip[0] + 0.08, 0.0, grip[2]])
    hubs = np.array([FRONT, 0, WHEEL]), np.array([REAR, 0, WHEEL])
    bars = [
        _bar([stem, head, hubs[0]], (0.03, 0.04, 0.0)),
        _bar([CRANK, hubs[1]], (0.05, 0.0)),
        _bar([CRANK, head], (0.04, 0.035)),
        _bar([CRANK, SADDLE + [0, 0, 0.1]], (0.035, 0.04)),
        _bar([head, SADDLE - [0, 0, 0.15]], (0.04, 0.0)),
    ]
    handle = _bar([stem, grip], (0.035, 0.0))
    return [_ring(FRONT), _ring(REAR), *bars, handle, mirrored(handle)]


def _bar(path: list[Vector], half: tuple[float, ...]) -> Mesh:
    return tube(path, half, half, ["frame"] * (len(path) - 1), edges=3, caps=(True, False))


def _ring(x: float, edges: int = 8) -> Mesh:
    """A tyre with a triangular section, its ridge outward; it stands on one of its flats."""
    turn = 2 * np.pi * (np.arange(edges + 1) + 0.5) / edges - np.pi / 2
    spoke = np.stack([np.cos(turn), np.zeros(edges + 1), np.sin(turn)], -1)
    middle, across = np.array([x, 0, WHEEL]), np.array([0, 0.03, 0])
    outer = middle + spoke * WHEEL / np.cos(np.pi / edges)
    left, right = (middle + spoke * (WHEEL - 0.05) + side for side in (across, -across))
    section = ((outer, left), (left, right), (right, outer))
    return join(
        [
            polygon([b[k], b[k + 1], a[k + 1], a[k]], "tyre")
            for k in range(edges)
            for a, b in section
        ]
    )


def _pedalling(phase: float) -> Mesh:
    """The left leg of a cyclist; ``phase`` is that of its pedal."""
    turn = 2 * np.pi * phase
    pedal = CRANK + 0.17 * np.array([np.cos(turn), 0.0, -np.sin(turn)])
    hip, ankle = SADDLE + [0.0, 0.09, 0.0], pedal + [-0.08, 0.12, 0.09]
    knee = _bent(hip, ankle, 0.46, 0.45, np.array([1.0, 0, 0.5]))
    return tube(
        [hip, knee, ankle, ankle + [0.2, 0, -0.07]],
        wide=(0.1, 0.075, 0.05, 0.0),
        deep=(0.11, 0.08, 0.055, 0.0),
        parts=("trousers", "trousers", "shoe"),
        edges=3,
        caps=(True, False),
    )


def _reaching(neck: Vector, grip: Vector) -> Mesh:
    """The left arm of a cyclist."""
    shoulder = neck + [0.0, 0.17, -0.03]
    elbow = _bent(shoulder, grip, 0.31, 0.31, np.array([0, 0.5, -1.0]))
    return tube(
        [shoulder, elbow, grip],
        wide=(0.07, 0.06, 0.0),
        deep=(0.07, 0.06, 0.0),
        parts=("cloth", "skin"),
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
