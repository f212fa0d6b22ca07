"""Plane curves of the built-in intersections: arcs, bends and offsets.

A line is an array (N, 2) of points [m] in the direction of travel. Left is on the left of that
direction.
"""

import numpy as np
from jaxtyping import Float

from inspe_jax.scene.lines import distinct

_ARC_STEP = np.radians(3.0)  # largest step of an arc: an error of 3 mm at a radius of 8 m
_CHORD = 1.0  # longest step of an arc [m]
_STRAIGHT = np.radians(5.0)  # a bend that turns less is one cubic curve
_HANDLE = 0.4  # distance of the cubic curve's inner control points, as a share of its chord


def joined(*parts: Float[np.ndarray, "..."]) -> Float[np.ndarray, "N 2"]:
    """Lines and points joined to one line, without repeated points."""
    return distinct(np.concatenate([np.reshape(part, (-1, 2)) for part in parts]))


def arc(
    center: Float[np.ndarray, "2"], radius: float, start: float, end: float
) -> Float[np.ndarray, "N 2"]:
    """A circular arc from the direction ``start`` to ``end`` about its centre [m, rad]."""
    sweep = abs(end - start)
    steps = int(np.ceil(round(sweep / min(_ARC_STEP, _CHORD / radius), 6)))
    angle = np.linspace(start, end, steps + 1)
    return center + radius * np.column_stack([np.cos(angle), np.sin(angle)])


def bend(
    start: Float[np.ndarray, "2"],
    out: Float[np.ndarray, "2"],
    end: Float[np.ndarray, "2"],
    into: Float[np.ndarray, "2"],
    radius: float = np.inf,
) -> Float[np.ndarray, "N 2"]:
    """A line from ``start`` along ``out`` to ``end`` along ``into``, tangent to these unit vectors.

    It is straight, then an arc of ``radius`` [m] or the largest that fits, then straight again. It
    is a cubic curve if the turn is slight, or if the two straights do not meet in between.
    """
    curve = fillet(start, out, end, into, radius)
    if not len(curve):
        handle = _HANDLE * np.hypot(*(end - start))
        t = np.linspace(0, 1, 33)[:, None]
        a, b = start + handle * out, end - handle * into
        curve = (
            (1 - t) ** 3 * start + 3 * (1 - t) ** 2 * t * a + 3 * (1 - t) * t**2 * b + t**3 * end
        )
    return joined(start, curve, end)


def fillet(
    start: Float[np.ndarray, "2"],
    out: Float[np.ndarray, "2"],
    end: Float[np.ndarray, "2"],
    into: Float[np.ndarray, "2"],
    radius: float,
) -> Float[np.ndarray, "N 2"]:
    """Only the arc of :func:`bend`; no points if there is none."""
    chord, sine = end - start, _cross(out, into)
    turn = float(np.arctan2(sine, out @ into))
    if abs(turn) < _STRAIGHT:
        return np.zeros((0, 2))
    before, after = _cross(chord, into) / sine, _cross(out, chord) / sine  # to where they meet
    if min(before, after) <= 0:
        return np.zeros((0, 2))
    half = abs(np.tan(turn / 2))
    radius = min(radius, min(before, after) / half)
    first = start + (before - radius * half) * out
    inward = np.sign(turn) * np.array([-out[1], out[0]])
    begin = float(np.arctan2(-inward[1], -inward[0]))
    return arc(first + radius * inward, radius, begin, begin + turn)


def onto_ring(left: float, ring: float, radius: float) -> Float[np.ndarray, "N 2"]:
    """The arc, a right turn, from an inbound line onto a ring about the origin.

    The line runs in the direction of −x at y = ``left`` [m]. ``ring`` is the radius of the ring,
    ``radius`` that of the arc [m]. Mirrored in the x axis and reversed, it leads off the ring.
    """
    beside = left + radius
    center = np.array([np.sqrt((ring + radius) ** 2 - beside**2), beside])
    to_ring = float(np.arctan2(center[1], center[0]))
    return arc(center, radius, -np.pi / 2, to_ring - np.pi)


def offset(line: Float[np.ndarray, "N 2"], left: float) -> Float[np.ndarray, "N 2"]:
    """The line moved ``left`` metres to the left, with mitred corners."""
    step = np.diff(line, axis=0)
    normal = np.column_stack([-step[:, 1], step[:, 0]]) / np.hypot(*step.T)[:, None]  # (N − 1, 2)
    before, after = np.vstack([normal[:1], normal]), np.vstack([normal, normal[-1:]])
    return line + left * (before + after) / (1 + (before * after).sum(1))[:, None]


def at_distance(
    start: Float[np.ndarray, "2"], direction: Float[np.ndarray, "2"], distance: float
) -> Float[np.ndarray, "2"]:
    """The point at which a ray from ``start`` is ``distance`` [m] from the origin.

    ``start`` is nearer to the origin than that.
    """
    along = float(start @ direction)
    return start + (np.sqrt(along**2 + distance**2 - start @ start) - along) * direction


def _cross(a: np.ndarray, b: np.ndarray) -> float:
    return float(a[0] * b[1] - a[1] * b[0])
