"""Pedestrians as jointed tubes: one row of a table for each shape. Their pose follows the phase.

The figure is that of an adult of 1.72 m: x forward, y left, z up [m], the ground at 0. A row scales
it. The lengths of limbs are shares of the stature after Drillis and Contini (1966); statures of
children are medians of the World Health Organization's growth references (2006, 2007).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from inspe_jax.simulation.embedded.shapes_mesh import Mesh, join, mirrored, tube

Vector = Float[np.ndarray, "3"]

HIP, THIGH, SHIN = 0.91, 0.43, 0.40
"""Height of the hip joint and lengths of the leg [m]."""

STRIDE = np.radians(10.0)
"""Largest angle of a thigh from the vertical [rad]; small, because the class's boxes are short."""

TRUNK, REACH = 0.14, 0.25
"""Half the depth of a trunk, and half the length of a pedestrian's box of mean size [m]."""

CHIN, HEAD = 1.46, 0.26
"""Height of the chin, and from there to the crown [m]."""


class Person(NamedTuple):
    """A pedestrian: ``stature`` [m], and how it differs from the figure.

    ``girth`` multiplies the width and depth of the trunk; ``head`` is the height of the head over
    an adult's of the same stature. ``dress`` is trousers, shorts, skirt or coat; ``hair`` is short,
    long, hood, hat or helmet; ``extra`` is nothing, backpack, bag or stick. ``stands`` is None for
    those who walk, else what the right hand does: hangs or phones. ``ahead`` is the number of
    cycles that a walker is ahead, and ``stoop`` how far the shoulders are in front of the hips [m].
    """

    stature: float
    girth: float = 1.0
    head: float = 1.0
    dress: str = "trousers"
    hair: str = "short"
    extra: str = ""
    stands: str | None = None
    ahead: float = 0.0
    stoop: float = 0.0

    @property
    def size(self) -> tuple[float, float, float]:
        """Length, width and height [m] in natural proportions."""
        plan = 2 * REACH * self.stature / (CHIN + HEAD)
        return plan, plan * (0.75 + 0.3 * self.girth), self.stature  # the elbows stand out


PEOPLE: dict[str, Person] = {
    "walker.standing": Person(1.72, extra="backpack", stands="phones"),
    "walker.stride_left": Person(1.72),
    "walker.stride_right": Person(1.78, girth=0.92, ahead=0.5),
    "walker.coat": Person(1.72, dress="coat"),
    "walker.long_coat": Person(1.65, girth=0.95, dress="coat", hair="long", extra="bag"),
    "walker.waiting": Person(1.7, girth=1.08, stands="hangs"),
    "walker.woman": Person(1.65, girth=0.88, hair="long"),
    "walker.skirt": Person(1.63, girth=0.9, dress="skirt", hair="long"),
    "walker.stout": Person(1.74, girth=1.3),
    "walker.tall": Person(1.93, girth=0.96, extra="backpack"),
    "walker.hood": Person(1.76, girth=1.08, hair="hood"),
    "walker.shorts": Person(1.8, dress="shorts"),
    "walker.bag": Person(1.68, hair="hat", extra="bag"),
    "walker.stooped": Person(1.6, girth=1.06, extra="stick", stoop=0.13),
    "walker.worker": Person(1.8, girth=1.12, hair="helmet"),
    "walker.child_3": Person(0.96, 1.16, 1.4, dress="shorts"),
    "walker.child_5": Person(1.1, 1.08, 1.28, hair="long", dress="skirt"),
    "walker.child_8": Person(1.27, 1.0, 1.18, extra="backpack"),
    "walker.child_11": Person(1.44, 0.94, 1.1, hair="hood"),
}
"""The shapes of pedestrians by name. To add one, add its row."""


def pedestrian(name: str, phase: float) -> Mesh:
    """A pedestrian of :data:`PEOPLE` at a phase of 0 … 1 of a stride, or one who stands.

    At phase 0 the left heel has just touched the ground in front, but for ``ahead``.
    """
    row = PEOPLE[name]
    top = HEAD * row.head * row.stature / (CHIN + HEAD)
    body, limbs = [_trunk(row)], _limbs(row, phase)
    if row.extra == "backpack":
        body.append(_backpack(row.girth))
    if row.extra == "bag":
        limbs.append(_bag(row, phase))
    figure = join([*body, _stretched(join(limbs))])
    by = (row.stature - top) / CHIN
    head = head_on((0.0, 0.0, 0.0), row.hair)
    head = head._replace(vertices=head.vertices * (top / HEAD) + [0.02 * by, 0, CHIN * by])
    whole = join([figure._replace(vertices=figure.vertices * by), head])
    return whole._replace(vertices=_stooped(whole.vertices, row.stoop, by))


def _stretched(limbs: Mesh) -> Mesh:
    """Scale limbs along x to fill the box, so that the trunk has the same depth at all phases."""
    x = limbs.vertices[:, 0]
    folded = np.interp(x, [x.min(), -TRUNK, TRUNK, x.max()], [-REACH, -TRUNK, TRUNK, REACH])
    return limbs._replace(vertices=np.column_stack([folded, limbs.vertices[:, 1:]]))


def _stooped(points: Float[np.ndarray, "n 3"], stoop: float, by: float) -> np.ndarray:
    """Points with what is above the hips moved forward, more the higher it is."""
    lean = np.clip((points[:, 2] / by - HIP) / (1.42 - HIP), 0, 1.2)
    x = points[:, 0] + stoop * by * lean
    return np.column_stack([np.clip(x, -REACH * by, REACH * by), points[:, 1:]])


def _trunk(row: Person) -> Mesh:
    """The torso down to the hem."""
    hem, wide, deep = {"coat": (0.4, 0.22, 0.22), "skirt": (0.52, 0.23, 0.21)}.get(
        row.dress, (0.77, 0.165, 0.12)
    )
    low = "cloth" if row.dress == "coat" else "trousers"
    girth = np.array([1, row.girth, row.girth, min(row.girth, 1.1), 1])
    return tube(
        [(0, 0, hem), (0, 0, 1.0), (0, 0, 1.32), (0, 0, 1.42), (0, 0, 1.52)],
        wide=girth * (wide, 0.18, 0.2, 0.19, 0.05),
        deep=girth * (deep, 0.15, 0.16, 0.13, 0.06),
        parts=(low, "cloth", "cloth", "cloth"),
        edges=6,
        caps=(True, False),
    )


def head_on(chin: tuple[float, float, float], hair: str) -> Mesh:
    """A head from the chin up, with short or long hair, a hood, a hat or a helmet."""
    x, y, z = chin
    top = {"hood": "cloth", "hat": "bag", "helmet": "helmet"}.get(hair, "hair")
    nape = {"hat": "hair", "helmet": "skin"}.get(hair, top)
    size = 1.2 if hair == "hood" else 1.0
    skull = tube(
        [(x, y, z), (x, y, z + 0.15), (x - 0.02, y, z + 0.26)],
        wide=size * np.array([0.055, 0.085, 0.05]),
        deep=size * np.array([0.075, 0.12, 0.07]),
        parts=((nape, nape, nape, "skin", "skin", "skin"), top),
        edges=6,
    )
    if hair == "long":
        lock = [(x - 0.06, y, z - 0.14), (x - 0.07, y, z + 0.16)]
        return join([skull, tube(lock, (0.11, 0.095), (0.045, 0.08), ["hair"], edges=4)])
    if hair == "hat":
        brim = [(x - 0.01, y, z + 0.165), (x - 0.01, y, z + 0.185)]
        return join([skull, tube(brim, (0.15, 0.13), (0.19, 0.17), ["bag"], edges=6)])
    return skull


def _limbs(row: Person, phase: float) -> list[Mesh]:
    """Arms and legs, and a stick in the right hand."""
    if row.stands is not None:
        return _standing_limbs(row)
    left, right = (_walking_limbs(phase + row.ahead + on, row) for on in (0.0, 0.5))
    limbs = [left, mirrored(right)]
    if row.extra == "stick":
        x = 0.12 + 0.1 * np.cos(2 * np.pi * (phase + row.ahead))
        stick = [(x, -0.24, 0.02), (x - 0.06, -0.23, 0.86)]
        limbs.append(tube(stick, (0.015, 0.02), (0.015, 0.02), ["bag"], edges=3))
    return limbs


def _leg(hip: Vector, knee: Vector, ankle: Vector, toe_up: float, dress: str) -> list[Mesh]:
    """Thigh, shin and shoe; the toe points ``toe_up`` [rad] above the horizontal."""
    cuff = ankle + 0.1 * (ankle - knee)  # in the shoe
    shin = "skin" if dress in ("skirt", "shorts") else "trousers"
    slim = 0.8 if shin == "skin" else 1.0
    leg = tube(
        [hip, knee, cuff],
        wide=(0.1, 0.08 * slim, 0.06 * slim),
        deep=(0.13, 0.1 * slim, 0.075 * slim),
        parts=("skin" if dress == "skirt" else "trousers", shin),
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


def _walking_limbs(phase: float, row: Person) -> Mesh:
    """The left leg, and the left arm, which swings the other way."""
    turn = 2 * np.pi * phase
    thigh = STRIDE * np.cos(turn)
    bend = np.radians(2 + 36 * max(0.0, -np.sin(turn)) + 6 * max(0.0, -np.cos(turn)))
    covered = {"coat": 0.85, "skirt": 0.6}.get(row.dress, 0.0)
    hip = np.array([0.03, 0.065 if covered else 0.09, HIP])
    knee = hip + THIGH * _swung(thigh)
    ankle = knee + SHIN * _swung(thigh - bend)
    top = hip + covered * (knee - hip)  # what a coat hides must not show through it
    leg = _leg(top, knee, ankle, 0.9 * (thigh - bend), row.dress)
    shoulder, swing = _shoulder(row), -0.3 * np.cos(turn)
    elbow = shoulder + 0.28 * _swung(swing - 0.1) + [0, 0.05, 0]
    return join([*leg, _arm(shoulder, elbow, elbow + 0.3 * _swung(swing + 0.3))])


def _shoulder(row: Person) -> Vector:
    """The left shoulder joint."""
    return np.array([0, 0.17 * min(max(row.girth, 0.9), 1.15), 1.39])


def _swung(angle: float) -> Vector:
    """The unit vector that points straight down, swung forward by an angle [rad]."""
    return np.array([np.sin(angle), 0.0, -np.cos(angle)])


def _standing_limbs(row: Person) -> list[Mesh]:
    """Limbs of somebody who stands, one foot ahead; the right hand may hold a telephone."""
    limbs = []
    for side, ahead in ((1.0, 0.08), (-1.0, -0.1)):
        hip = np.array([0, side * 0.09, HIP])
        ankle = np.array([ahead, side * 0.12, 0.08])
        knee = (hip + ankle) / 2 + [0.02, 0, 0]
        limbs += _leg(hip, knee, ankle, 0.0, row.dress)
    shoulder = _shoulder(row)
    left = shoulder, shoulder + [-0.03, 0.06, -0.29], shoulder + [0.04, 0.05, -0.57]
    arms = [_arm(*left)]
    if row.stands == "phones":
        right = [np.array(p) for p in ((0, -0.17, 1.39), (0.02, -0.24, 1.12), (0.27, -0.12, 1.25))]
        arms.append(_arm(*right))
    else:
        arms.append(mirrored(arms[0]))
    return [*limbs, *arms]


def _backpack(girth: float) -> Mesh:
    """A backpack from the back of the box to inside the trunk."""
    middle = 0.18
    deep = (REACH - middle) * np.sqrt(2)  # of the corners; the flats reach to 1/√2 of that
    path = [(-middle, 0, 1.0), (-middle, 0, 1.42)]
    return tube(path, (0.2 * girth, 0.17 * girth), (deep, 0.9 * deep), ["bag"], edges=4)


def _bag(row: Person, phase: float) -> Mesh:
    """A bag that the left hand carries."""
    x = -0.06 * np.cos(2 * np.pi * (phase + row.ahead))
    path = [(x, 0.235, 0.42), (x, 0.235, 0.78)]
    return tube(path, (0.05, 0.02), (0.17, 0.13), ["bag"], edges=4)
