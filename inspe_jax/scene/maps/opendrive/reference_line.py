"""The reference line of an OpenDRIVE road: where (s, t) is in the plan."""

import xml.etree.ElementTree as ET
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from inspe_jax.scene.lines import turned

NODES, WEIGHTS = np.polynomial.legendre.leggauss(8)
"""Gauss's quadrature on −1 … 1."""
STRETCH = 5.0
"""Spirals are integrated in stretches of at most this length [m]: errors are below 1 µm."""


@dataclass(frozen=True, eq=False)
class Piece:
    """One ``<geometry>``: it begins at ``s`` [m] in (x, y) with a heading [rad].

    Lines, arcs and spirals have the curvature at either end [1/m]. Cubics have the coefficients of
    u and v over the parameter, which runs from 0 to ``last``.
    """

    s: float
    length: float
    start: Float[np.ndarray, "2"]
    heading: float
    curvature: tuple[float, float] = (0.0, 0.0)
    cubic: Float[np.ndarray, "2 4"] | None = None
    last: float = 0.0

    @classmethod
    def of(cls, element: ET.Element) -> "Piece":
        """Reads a ``<geometry>``. Raises KeyError, ValueError or StopIteration where it is none."""
        s, x, y, heading, length = (
            float(element.attrib[k]) for k in ("s", "x", "y", "hdg", "length")
        )
        shape = next(iter(element))
        given = {k: v for k, v in shape.attrib.items() if k != "pRange"}
        values = {k: float(v) for k, v in given.items()}
        own: dict[str, object] = {}
        if shape.tag == "arc":
            own["curvature"] = (values["curvature"], values["curvature"])
        elif shape.tag == "spiral":
            own["curvature"] = (values["curvStart"], values["curvEnd"])
        elif shape.tag == "poly3":
            own["cubic"] = np.array([[0, 1, 0, 0], [values[k] for k in "abcd"]], float)
            own["last"] = length
        elif shape.tag == "paramPoly3":
            own["cubic"] = np.array([[values[k + of] for k in "abcd"] for of in "UV"], float)
            own["last"] = length if shape.get("pRange") == "arcLength" else 1.0
        elif shape.tag != "line":
            raise ValueError(f"a <geometry> of <{shape.tag}>")
        return cls(s, length, np.array([x, y]), heading, **own)  # type: ignore[arg-type]

    def at(self, along: float) -> tuple[Float[np.ndarray, "2"], float]:
        """The point and the heading so far along the piece [m]."""
        if self.cubic is not None:
            p = along * self.last / max(self.length, 1e-9)
            powers, slopes = p ** np.arange(4), np.arange(4) * p ** np.array([0, 0, 1, 2])
            (u, v), (du, dv) = self.cubic @ powers, self.cubic @ slopes
            bent, point = float(np.arctan2(dv, du)), np.array([u, v])
        else:
            first, last = self.curvature
            change = (last - first) / max(self.length, 1e-9)
            edges = np.linspace(0.0, along, int(np.ceil(abs(along) / STRETCH)) + 1)
            half = np.diff(edges)[:, None] / 2
            where = edges[:-1, None] + half * (1 + NODES)  # (K, 8)
            turns = first * where + change * where**2 / 2
            weights = half * WEIGHTS
            point = np.array([(weights * np.cos(turns)).sum(), (weights * np.sin(turns)).sum()])
            bent = first * along + change * along**2 / 2
        return self.start + turned(point, self.heading), self.heading + bent


@dataclass(frozen=True, eq=False)
class ReferenceLine:
    """The pieces of a road's ``<planView>``, by s."""

    pieces: tuple[Piece, ...]

    @classmethod
    def of(cls, road: ET.Element) -> "ReferenceLine":
        """That of a road. Raises as :meth:`Piece.of`, and ValueError where it has no piece."""
        found = sorted((Piece.of(g) for g in road.iterfind("planView/geometry")), key=lambda p: p.s)
        if not found:
            raise ValueError("a road without a <planView>")
        return cls(tuple(found))

    def at(self, s: float, t: float = 0.0) -> tuple[Float[np.ndarray, "2"], float]:
        """The point at s and t [m] (t to the left), and the heading of the road there [rad]."""
        piece = next((p for p in reversed(self.pieces) if p.s <= s), self.pieces[0])
        point, heading = piece.at(s - piece.s)
        return point + t * np.array([-np.sin(heading), np.cos(heading)]), heading
