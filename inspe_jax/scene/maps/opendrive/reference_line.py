"""The reference line of an OpenDRIVE road: where (s, t) is in the plan."""

import xml.etree.ElementTree as ET
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from inspe_jax.scene.lines import turned

NODES, WEIGHTS = np.polynomial.legendre.leggauss(8)
"""Gauss's quadrature on −1 … 1."""
STRETCH = 5.0
"""Spirals are integrated in stretches of at most this length [m]: errors are below 1 µm."""

Course = Callable[[float], tuple[Float[np.ndarray, "2"], float]]
"""The point [m] and the heading [rad] so far along a piece [m], which begins in (0, 0) along x."""


class ReferenceLine:
    """The pieces of a road's ``<planView>``, by s.

    Raises KeyError, ValueError or StopIteration where one lacks something, or there is none.
    """

    def __init__(self, road: ET.Element) -> None:
        self.pieces = []
        for element in road.iterfind("planView/geometry"):
            s, x, y, heading, length = (
                float(element.attrib[k]) for k in ("s", "x", "y", "hdg", "length")
            )
            course = _course(next(iter(element)), length)
            self.pieces.append((s, np.array([x, y]), heading, course))
        self.pieces.sort(key=lambda piece: piece[0])
        if not self.pieces:
            raise ValueError("a road without a <planView>")

    def at(self, s: float, t: float = 0.0) -> tuple[Float[np.ndarray, "2"], float]:
        """The point at s and t [m] (t to the left), and the heading of the road there [rad]."""
        begin, start, heading, course = next(
            (piece for piece in reversed(self.pieces) if piece[0] <= s), self.pieces[0]
        )
        point, bent = course(s - begin)
        point, heading = start + turned(point, heading), heading + bent
        return point + t * np.array([-np.sin(heading), np.cos(heading)]), heading


def _course(shape: ET.Element, length: float) -> Course:
    """The course of a line, an arc, a spiral or a cubic."""
    values = {k: float(v) for k, v in shape.attrib.items() if k != "pRange"}
    length = max(length, 1e-9)
    if shape.tag == "line":
        return _bent(0.0, 0.0)
    if shape.tag == "arc":
        return _bent(values["curvature"], 0.0)
    if shape.tag == "spiral":
        first = values["curvStart"]
        return _bent(first, (values["curvEnd"] - first) / length)
    if shape.tag == "poly3":
        rows = np.array([[0, 1, 0, 0], [values[k] for k in "abcd"]], float)
        return _cubic(rows, length, length)
    if shape.tag == "paramPoly3":
        rows = np.array([[values[k + of] for k in "abcd"] for of in "UV"])
        return _cubic(rows, length, length if shape.get("pRange") == "arcLength" else 1.0)
    raise ValueError(f"a <geometry> of <{shape.tag}>")


def _bent(curvature: float, change: float) -> Course:
    """A curve of a curvature at its start [1/m], which changes evenly [1/m²]."""

    def course(along: float) -> tuple[Float[np.ndarray, "2"], float]:
        edges = np.linspace(0.0, along, int(np.ceil(abs(along) / STRETCH)) + 1)
        half = np.diff(edges)[:, None] / 2
        where = edges[:-1, None] + half * (1 + NODES)  # (K, 8)
        turns = curvature * where + change * where**2 / 2
        weights = half * WEIGHTS
        point = np.array([(weights * np.cos(turns)).sum(), (weights * np.sin(turns)).sum()])
        return point, curvature * along + change * along**2 / 2

    return course


def _cubic(coefficients: Float[np.ndarray, "2 4"], length: float, last: float) -> Course:
    """Two cubics over a parameter that runs from 0 to ``last`` over the length [m]."""

    def course(along: float) -> tuple[Float[np.ndarray, "2"], float]:
        p = along * last / length
        powers, slopes = p ** np.arange(4), np.arange(4) * p ** np.array([0, 0, 1, 2])
        dx, dy = coefficients @ slopes
        return coefficients @ powers, float(np.arctan2(dy, dx))

    return course
