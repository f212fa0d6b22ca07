"""The geometry of OpenDRIVE roads: s runs along a road's reference line [m], t to its left [m]."""

import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Callable, Iterable

import numpy as np
from jaxtyping import Float

from inspe_jax.scene.lines import turned
from inspe_jax.scene.maps.road_map import APART

NODES, WEIGHTS = np.polynomial.legendre.leggauss(8)  # Gauss's quadrature on −1 … 1
STRETCH = 5.0  # spirals are integrated in stretches of at most 1 rad and this [m]: to below 1 µm
STEPS = 512  # a cubic's length is summed up over so many
HUGE = 1e9  # no number of a map is so large
STEEP = 1e30  # no coefficient of a cubic, which may be of a stretch of nanometres
TURNS = 100.0  # no piece turns so far [rad]; short ones are sharp
LONGEST = 1e5  # no road is so long, nor so far from others [m]

Course = Callable[[Float[np.ndarray, " N"]], tuple[Float[np.ndarray, "N 2"], np.ndarray]]
"""The points [m] and the headings (N,) [rad] so far along a piece [m], from (0, 0) along x."""


def number(
    element: ET.Element, key: str, default: float | None = None, most: float = HUGE
) -> float:
    """A number of an element. Raises ValueError where it is none, is missing or not below most."""
    text = element.get(key)
    if text is None and default is not None:
        return default
    try:
        value = float(text or "")
    except ValueError:
        value = np.nan
    if not abs(value) < most:
        given = "is missing" if text is None else f"is '{text[:40]}'"
        raise ValueError(f"{key} of <{element.tag}> {given}")
    return value


class Cubics:
    """A cubic of s from each start on, which a, b, c and d of elements give; 0 without elements."""

    def __init__(self, elements: Iterable[ET.Element], key: str = "s") -> None:
        rows = [[number(one, name, most=STEEP) for name in (key, *"abcd")] for one in elements]
        self.rows = np.array(sorted(rows, key=lambda row: row[0])).reshape(-1, 5)

    def __call__(self, s: Float[np.ndarray, "*N"]) -> Float[np.ndarray, "*N"]:
        """The values at s."""
        if not len(self.rows):
            return np.zeros_like(s)
        which = np.searchsorted(self.rows[1:, 0], s, side="right") if len(self.rows) > 1 else 0
        start, a, b, c, d = np.moveaxis(self.rows[which], -1, 0)
        ds = np.maximum(s - start, 0.0)
        return a + ds * (b + ds * (c + ds * d))


class Crossfall:
    """The height of a road's surface over what it is by elevation and superelevation, from its
    ``<shape>`` records: cubics of t at some s, between them in proportion."""

    def __init__(self, records: Iterable[ET.Element]) -> None:
        at = defaultdict[float, list[ET.Element]](list)
        for one in records:
            at[number(one, "s")].append(one)
        self.starts = np.array(sorted(at))
        self.profiles = [Cubics(at[s], "t") for s in self.starts.tolist()]

    def __call__(self, s: Float[np.ndarray, " N"], t: Float[np.ndarray, "*B N"]) -> np.ndarray:
        """The heights [m] at s and t."""
        rise = np.zeros(t.shape)
        for hat, profile in zip(np.eye(len(self.starts)), self.profiles, strict=True):
            share = np.interp(s, self.starts, hat)
            here = share > 0
            rise[..., here] += share[here] * profile(t[..., here])
        return rise


class ReferenceLine:
    """The pieces of a road's ``<planView>``, by s; straight on beyond both ends. ``starts`` are the
    points (K, 2) where they start, ``lengths`` (K,) theirs [m]. Raises ValueError if one lacks
    something."""

    def __init__(self, road: ET.Element) -> None:
        pieces = []
        for element in road.iterfind("planView/geometry"):
            s, x, y, heading, length = (
                number(element, key) for key in ("s", "x", "y", "hdg", "length")
            )
            if 0 < length < LONGEST:
                shape = next(iter(element), ET.Element("nothing"))
                pieces.append((s, x, y, heading, length, _course(shape, length)))
        if not pieces:
            raise ValueError("no <geometry> in its <planView>")
        pieces.sort(key=lambda piece: piece[0])
        self.table = np.array([piece[:5] for piece in pieces])
        self.starts, self.lengths = self.table[:, 1:3], self.table[:, 4]
        self.courses: list[Course] = [piece[5] for piece in pieces]
        if abs(self.starts).max() > LONGEST:
            raise ValueError(f"it is over {LONGEST / 1000:g} km from most roads")
        apart = np.hypot(*(self.starts[1:] - self.starts[:-1]).T) - self.lengths[:-1]
        if apart.max(initial=0.0) > APART:
            raise ValueError(f"pieces of its <planView> are over {APART:g} m apart")

    def at(
        self, s: np.ndarray | float, t: np.ndarray | float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """The points (…, 2) at s and t [m], and the headings (…) of the road there [rad]."""
        s, t = np.broadcast_arrays(np.asarray(s, float), t)
        flat = s.ravel()
        which = np.searchsorted(self.table[1:, 0], flat, side="right")
        points, headings = np.zeros((flat.size, 2)), np.zeros(flat.size)
        for k in np.unique(which):
            here = which == k
            begin, _, _, heading, length = self.table[k]
            along = flat[here] - begin
            inside = np.clip(along, 0.0, length)
            path, bent = self.courses[k](inside)
            path += (along - inside)[:, None] * np.column_stack([np.cos(bent), np.sin(bent)])
            points[here], headings[here] = self.starts[k] + turned(path, heading), heading + bent
        left = np.column_stack([-np.sin(headings), np.cos(headings)])
        points += t.reshape(-1, 1) * left
        return points.reshape(*s.shape, 2), headings.reshape(s.shape)


def _course(shape: ET.Element, length: float) -> Course:
    if shape.tag == "line":
        return _arc(0.0)
    if shape.tag == "arc":
        return _arc(number(shape, "curvature", most=TURNS / length))
    if shape.tag == "spiral":
        first, last = (number(shape, k, most=TURNS / length) for k in ("curvStart", "curvEnd"))
        return _spiral(first, (last - first) / length, length)
    if shape.tag == "poly3":
        rows = np.array([[0, 1, 0, 0], [number(shape, k) for k in "abcd"]], float)
        return _cubic(rows, length, length, 1.0)
    if shape.tag == "paramPoly3":
        rows = np.array([[number(shape, k + of) for k in "abcd"] for of in "UV"])
        end = length if shape.get("pRange") == "arcLength" else 1.0
        return _cubic(rows, end, length, None)
    raise ValueError(f"a <geometry> of <{shape.tag}>")


def _arc(curvature: float) -> Course:
    def course(along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        half = curvature * along / 2
        chord = along * np.sinc(half / np.pi)
        return np.column_stack([chord * np.cos(half), chord * np.sin(half)]), 2 * half

    return course


def _spiral(curvature: float, change: float, length: float) -> Course:
    """A curve of a curvature at its start [1/m], which changes evenly [1/m²]."""
    turns = length * max(abs(curvature), abs(curvature + change * length))
    knots = np.linspace(0.0, length, int(np.ceil(max(length / STRETCH, turns))) + 1)

    def turn(along: np.ndarray) -> np.ndarray:
        return along * (curvature + change * along / 2)

    def run(start: np.ndarray, end: np.ndarray) -> np.ndarray:
        half = (end - start)[:, None] / 2
        turns = turn(start[:, None] + half * (1 + NODES))  # (N, 8)
        return half * np.column_stack([np.cos(turns) @ WEIGHTS, np.sin(turns) @ WEIGHTS])

    bases = np.vstack([np.zeros((1, 2)), np.cumsum(run(knots[:-1], knots[1:]), 0)])

    def course(along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        k = np.searchsorted(knots, along, side="right") - 1
        return bases[k] + run(knots[k], along), turn(along)

    return course


def _cubic(
    rows: Float[np.ndarray, "2 4"], last: float, length: float, scale: float | None
) -> Course:
    """Two cubics over a parameter from 0 to ``last``, by their length: times ``scale``, or if that
    is None so that all of it is ``length`` [m]."""

    def slope(p: np.ndarray) -> np.ndarray:
        return rows[:, 1:] @ (
            np.array([[1.0], [2.0], [3.0]]) * p ** np.arange(3)[:, None]
        )  # (2, N)

    parameter = np.linspace(0.0, last, STEPS + 1)
    speed = np.hypot(*slope(parameter))
    arc = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * last / STEPS)])
    scale = arc[-1] / length if scale is None else scale

    def course(along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        p = np.interp(along * scale, arc, parameter)
        dx, dy = slope(p)
        return (rows @ p ** np.arange(4)[:, None]).T, np.arctan2(dy, dx)

    return course
