"""Bodies that stand in every frame: upright prisms on simple outlines, and crowns on trunks."""

import json
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float
from shapely.geometry import LineString, Polygon

from inspe_jax.core.convex import merge
from inspe_jax.core.errors import InspeError, check_known
from inspe_jax.scene.lines import Vector

KINDS = ("building", "wall", "hedge", "tree", "pole", "furniture", "parked vehicle", "solid")
"""What a body can be. Furniture are bus shelters, kiosks, switch boxes. A solid is part of a mesh,
which does not say what it is."""
CORNERS = 8  # most corners of a convex part; round bodies have as many
STRAIGHT = 1e-4
"""A corner so near the line between its neighbours is none [m]: by so much sight lines are wider
(:data:`~inspe_jax.core.convex.SEAM`), on either side."""
LEAFY = 0.05
"""Share of light that a crown in leaf lets through: 0.01 to 0.05 in Konarska et al., Transmissivity
of solar radiation through crowns of single urban trees, Theor. Appl. Climatol. 117, 2014."""
HIGHEST = 1000.0  # no body is higher than this [m]


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class StaticBody:
    """One body, made by :func:`body`, :func:`upright_box`, :func:`wall` or :func:`tree`.

    ``kind`` is one of :data:`KINDS`. ``outline`` (N, 2) are its corners in plan, counter-clockwise,
    in world metres. It reaches from ``base`` to ``height`` [m] above the ground at its
    :attr:`middle`; with a base of 0 it stands on the ground, and nothing is seen beneath it.
    ``transmittance`` is the share of light that passes through it. ``trunk`` is the radius [m] of a
    trunk from the ground to the base, in the middle; 0 for none. The first side of a parked
    vehicle's outline points ahead.
    """

    kind: str
    outline: Float[np.ndarray, "N 2"]
    height: float
    base: float = 0.0
    transmittance: float = 0.0
    trunk: float = 0.0

    @cached_property
    def polygon(self) -> Polygon:
        """The outline as a shapely polygon."""
        return Polygon(self.outline)

    @property
    def middle(self) -> Float[np.ndarray, "2"]:
        """The centroid in plan [m]."""
        return np.array(self.polygon.centroid.coords[0])

    @property
    def number(self) -> int:
        """Seed of its looks: a hash of its outline."""
        return zlib.crc32(np.round(self.outline, 3).tobytes())

    @property
    def words(self) -> str:
        """Its kind and place, for messages."""
        x, y = self.middle.round(1) + 0.0  # no −0.0
        return f"{self.kind} at ({x:.1f}, {y:.1f})"

    @cached_property
    def pieces(self) -> tuple[Float[np.ndarray, "M 2"], ...]:
        """Convex outlines of at most :data:`CORNERS` corners that cover the outline exactly."""
        cut = shapely.constrained_delaunay_triangles(self.polygon).geoms
        triangles = np.array([t.exterior.coords[:3] for t in cut], float)
        return tuple(part for piece in merge(triangles, 0.0) for part in _cut(piece))


def _cut(piece: Float[np.ndarray, "M 2"]) -> list[Float[np.ndarray, "m 2"]]:
    """A convex outline in pieces of at most :data:`CORNERS` corners."""
    if len(piece) <= CORNERS:
        return [piece]
    half = len(piece) // 2
    return [*_cut(piece[: half + 1]), *_cut(np.concatenate([piece[half:], piece[:1]]))]


def body(
    kind: str,
    outline: Any,
    height: float,
    *,
    base: float = 0.0,
    transmittance: float = 0.0,
    trunk: float = 0.0,
) -> StaticBody:
    """A body on any simple outline (N, 2) [m], in either sense, closed or not: :class:`StaticBody`.
    Raises InspeError where the kind is unknown, the outline has fewer than three corners, crosses
    itself or has no area, or a number is not finite or out of range."""
    check_known(kind, KINDS, "body")
    try:
        corners = np.array(outline, float)
        numbers = np.array([height, base, transmittance, trunk], float)
    except (TypeError, ValueError):
        raise InspeError(f"{kind}: its outline and heights must be numbers, in metres") from None
    if corners.ndim != 2 or corners.shape[1] != 2:
        raise InspeError(f"{kind}: an outline of shape {corners.shape}; (N, 2) for x and y each")
    if not np.isfinite(corners).all() or not np.isfinite(numbers).all():
        raise InspeError(f"{kind}: its outline or its heights have a value that is not finite")
    if len(corners) > 1 and (corners[0] == corners[-1]).all():
        corners = corners[:-1]
    corners = corners[(corners != np.roll(corners, 1, 0)).any(1)]
    if len(corners) < 3:
        raise InspeError(f"{kind}: an outline has three corners or more that differ")
    where = "{} at ({:.1f}, {:.1f})".format(kind, *corners.mean(0))
    shape = Polygon(corners)
    if not shape.is_valid:
        raise InspeError(
            f"{where}: its outline crosses or touches itself; split it into simple outlines"
        )
    if not shape.area > 0:
        raise InspeError(f"{where}: its outline has no area; give a wall a width")
    if not 0 <= base < height <= HIGHEST:
        raise InspeError(
            f"{where}: from {base:g} to {height:g} m above the ground; its height must be above "
            f"its base, the base 0 or more, and the height at most {HIGHEST:g} m"
        )
    if not 0 <= transmittance <= 1:
        raise InspeError(f"{where}: transmittance {transmittance:g}: 0 (opaque) to 1")
    if trunk < 0 or (trunk > 0 and base <= 0):
        raise InspeError(
            f"{where}: a trunk of {trunk:g} m radius: 0 for none, and under a base above 0"
        )
    corners = _without_straight(corners)
    if not shape.exterior.is_ccw:  # of four corners, the first side still points ahead
        corners = corners[::-1]
    return StaticBody(kind, corners, float(height), float(base), float(transmittance), float(trunk))


def _without_straight(corners: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "M 2"]:
    """An outline without corners within :data:`STRAIGHT` of the line between their neighbours."""
    while len(corners) > 3:
        before, after = np.roll(corners, 1, 0), np.roll(corners, -1, 0)
        chord, to = after - before, corners - before
        length = np.maximum(np.hypot(*chord.T), 1e-12)
        apart = np.abs(chord[:, 0] * to[:, 1] - chord[:, 1] * to[:, 0]) / length
        flattest = int(np.argmin(apart))
        if apart[flattest] > STRAIGHT:
            break
        corners = np.delete(corners, flattest, 0)
    return corners


def upright_box(
    kind: str, at: Sequence[float] | Vector, size: Sequence[float], yaw: float = 0.0
) -> StaticBody:
    """A :func:`body` on the ground: middle (x, y), length, width, height [m], heading [rad]."""
    length, width, height = (float(x) for x in size)
    along = np.array([np.cos(yaw), np.sin(yaw)]) * length / 2
    across = np.array([-np.sin(yaw), np.cos(yaw)]) * width / 2
    corners = [-along - across, along - across, along + across, across - along]
    return body(kind, np.asarray(at, float) + corners, height)


def wall(
    line: Any, height: float, *, width: float = 0.3, kind: str = "wall"
) -> tuple[StaticBody, ...]:
    """A wall or a hedge along a line (N, 2) [m], a body for each straight stretch. Raises
    InspeError as :func:`body`, and where the line has fewer than two points."""
    points = np.array(line, float)
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < 2:
        raise InspeError(f"{kind}: a line of shape {points.shape}; two points (x, y) or more")
    stretches = (LineString(ends).buffer(width / 2, cap_style="flat") for ends in pairwise(points))
    return tuple(body(kind, stretch.exterior.coords, height) for stretch in stretches)


def tree(
    at: Sequence[float] | Vector,
    *,
    radius: float,
    height: float,
    base: float,
    trunk: float = 0.15,
    transmittance: float = LEAFY,
) -> StaticBody:
    """A tree at (x, y) [m]: a crown from ``base`` to ``height`` [m] on a trunk, both prisms on an
    :func:`octagon` of a radius [m]. Raises InspeError as :func:`body`."""
    crown = octagon(at, radius)
    return body("tree", crown, height, base=base, transmittance=transmittance, trunk=trunk)


def pole(at: Sequence[float] | Vector, *, radius: float, height: float) -> StaticBody:
    """A pole at (x, y) [m], an octagon of the area of a disc. Raises InspeError as :func:`body`."""
    return body("pole", octagon(at, radius), height)


def octagon(at: Any, radius: float) -> Float[np.ndarray, "8 2"]:
    """The corners of a regular octagon about a point [m], of the area of a disc of ``radius``."""
    turn = (np.arange(CORNERS) + 0.5) * 2 * np.pi / CORNERS
    out = radius * np.sqrt(2 * np.pi / (CORNERS * np.sin(2 * np.pi / CORNERS)))
    return np.asarray(at, float) + out * np.column_stack([np.cos(turn), np.sin(turn)])


def pack_bodies(bodies: Sequence[StaticBody], name: str = "statics") -> dict[str, np.ndarray]:
    """Bodies as plain arrays and one JSON text, whose names begin with ``name``; none of none."""
    if not bodies:
        return {}
    numbers = [[one.height, one.base, one.transmittance, one.trunk] for one in bodies]
    return {
        f"{name}_kinds": np.array(json.dumps([one.kind for one in bodies])),
        f"{name}_lengths": np.array([len(one.outline) for one in bodies], int),
        f"{name}_corners": np.concatenate([one.outline for one in bodies]),
        f"{name}_numbers": np.array(numbers),
    }


def unpack_bodies(data: Mapping[str, np.ndarray], name: str = "statics") -> tuple[StaticBody, ...]:
    """The bodies that :func:`pack_bodies` packed."""
    if f"{name}_kinds" not in data:
        return ()
    corners = np.split(data[f"{name}_corners"], np.cumsum(data[f"{name}_lengths"])[:-1])
    kinds = json.loads(str(data[f"{name}_kinds"]))
    return tuple(
        StaticBody(kind, outline, *map(float, numbers))
        for kind, outline, numbers in zip(kinds, corners, data[f"{name}_numbers"], strict=True)
    )
