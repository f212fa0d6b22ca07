"""Lines as arrays of points (N, 2 or 3) [m], measured in plan; arcs, bends and offsets.

Left is on the left of the direction of travel.
"""

from itertools import pairwise

import numpy as np
from jaxtyping import Float

Vector = Float[np.ndarray, "2"]
Line = Float[np.ndarray, "N 2"]
"""A point or a direction, and a line, in plan."""


def turned(line: Line, angle: float) -> Line:
    """A line turned about the origin by ``angle`` [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    return line @ np.array([[c, s], [-s, c]])


def arc_of(line: np.ndarray) -> Float[np.ndarray, " N"]:
    """How far along the line each point is [m]."""
    steps = np.hypot(*np.diff(line[:, :2], axis=0).T)
    return np.concatenate([[0.0], np.cumsum(steps)])


def distance_from(points: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Plan distance of points (N, 2 or 3) from the middle [m]."""
    return np.hypot(*(points[:, :2] - middle[:2]).T)


def resampled(line: np.ndarray, spacing: float = 1.0) -> np.ndarray:
    """The same line with evenly spaced points, about ``spacing`` metres apart in plan."""
    arc = arc_of(line)
    even = np.linspace(0, arc[-1], max(2, round(arc[-1] / spacing) + 1))
    return np.column_stack([np.interp(even, arc, column) for column in line.T])


def distinct(line: np.ndarray) -> np.ndarray:
    """A line without points that repeat the one before."""
    apart = np.hypot(*np.diff(line[:, :2], axis=0).T) > 1e-6
    return line[np.concatenate([[True], apart])]


def onward(line: np.ndarray) -> np.ndarray:
    """A line without the points at which it steps back, as where two lanes overlap."""
    kept = [line[0]]
    for here, there in pairwise([*line[1:], 2 * line[-1] - line[-2]]):
        if (here - kept[-1])[:2] @ (there - here)[:2] >= 0:
            kept.append(here)
    return np.array(kept)


_ARC_STEP = np.radians(3.0)  # largest step of an arc: an error of 3 mm at a radius of 8 m
_CHORD = 1.0  # longest step of an arc [m]
_STRAIGHT = np.radians(5.0)  # a bend that turns less is one cubic curve
_HANDLE = 0.4  # distance of the cubic curve's inner control points, as a share of its chord


def joined(*parts: Float[np.ndarray, "..."]) -> Line:
    """Lines and points joined to one line, without repeated points."""
    return distinct(np.concatenate([np.reshape(part, (-1, 2)) for part in parts]))


def arc(center: Vector, radius: float, start: float, end: float) -> Line:
    """A circular arc from the direction ``start`` to ``end`` about its centre [m, rad]."""
    steps = int(np.ceil(round(abs(end - start) / min(_ARC_STEP, _CHORD / radius), 6)))
    angle = np.linspace(start, end, steps + 1)
    return center + radius * np.column_stack([np.cos(angle), np.sin(angle)])


def bend(start: Vector, out: Vector, end: Vector, into: Vector, radius: float = np.inf) -> Line:
    """A line from ``start`` along ``out`` to ``end`` along ``into``, tangent to these unit vectors:
    straight, an arc of ``radius`` [m] or the largest that fits, and straight; or a cubic curve, if
    the turn is slight or the two straights do not meet in between."""
    curve = fillet(start, out, end, into, radius)
    if not len(curve):
        handle = _HANDLE * np.hypot(*(end - start))
        t = np.linspace(0, 1, 33)[:, None]
        u, a, b = 1 - t, start + handle * out, end - handle * into
        curve = u**3 * start + 3 * u**2 * t * a + 3 * u * t**2 * b + t**3 * end
    return joined(start, curve, end)


def fillet(start: Vector, out: Vector, end: Vector, into: Vector, radius: float) -> Line:
    """Only the arc of :func:`bend`; no points if there is none."""
    chord, sine = end - start, cross(out, into)
    turn = float(np.arctan2(sine, out @ into))
    if abs(turn) < _STRAIGHT:
        return np.zeros((0, 2))
    before, after = cross(chord, into) / sine, cross(out, chord) / sine  # to where they meet
    if min(before, after) <= 0:
        return np.zeros((0, 2))
    half = abs(np.tan(turn / 2))
    radius = min(radius, min(before, after) / half)
    first = start + (before - radius * half) * out
    inward = np.sign(turn) * np.array([-out[1], out[0]])
    begin = float(np.arctan2(-inward[1], -inward[0]))
    return arc(first + radius * inward, radius, begin, begin + turn)


def onto_ring(left: float, ring: float, radius: float) -> Line:
    """The arc of a radius [m], a right turn, from a line along −x at y = ``left`` [m] onto the ring
    of radius ``ring`` [m] about the origin. Mirrored in the x axis and reversed, it leads off."""
    beside = left + radius
    center = np.array([np.sqrt((ring + radius) ** 2 - beside**2), beside])
    to_ring = float(np.arctan2(center[1], center[0]))
    return arc(center, radius, -np.pi / 2, to_ring - np.pi)


def offset(line: Line, left: float) -> Line:
    """The line moved ``left`` metres to the left, with mitred corners."""
    step = np.diff(line, axis=0)
    normal = np.column_stack([-step[:, 1], step[:, 0]]) / np.hypot(*step.T)[:, None]  # (N − 1, 2)
    before, after = np.vstack([normal[:1], normal]), np.vstack([normal, normal[-1:]])
    return line + left * (before + after) / (1 + (before * after).sum(1))[:, None]


def at_distance(start: Vector, direction: Vector, distance: float) -> Vector:
    """Where a ray from ``start``, which is nearer, is ``distance`` [m] from the origin."""
    along = float(start @ direction)
    return start + (np.sqrt(along**2 + distance**2 - start @ start) - along) * direction


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Of plan vectors (…, 2): positive where b points to the left of a."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
