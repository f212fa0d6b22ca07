"""Straight roads with kerbs, lanes and sidewalks: the parts of the built-in intersections."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from shapely.geometry import MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from inspe_jax.scene.intersection import (
    BUILT_IN,
    CROSSWALK_WIDTH,
    Arm,
    Intersection,
    Route,
    mouth_crosswalks,
)
from inspe_jax.scene.lines import arc_of, resampled
from inspe_jax.scene.procedural.curves import bend, fillet, joined, offset
from inspe_jax.scene.regions import Region

LENGTH = 120.0
"""Length of roads from the middle [m]."""
ROUTE_LENGTH = 110.0
"""Length of routes from the middle [m]."""
SHOULDER, SIDEWALK = 1.0, 3.0
"""Width of shoulders and of sidewalks [m]."""

_CORNER = np.radians(150.0)  # arms nearer than this have a corner; between others the kerb runs on
_STRAIGHT = np.radians(30.0)  # a movement that turns less goes straight on
_STOP = CROSSWALK_WIDTH + 1.0  # from the mouth to where drivers stop [m]


@dataclass(frozen=True)
class Road:
    """A straight arm: as many lanes in as out, on either side of an axis through the origin."""

    bearing: float
    lanes: int
    lane_width: float
    median: float = 0.0

    @property
    def along(self) -> np.ndarray:
        """Unit vector outward (2,)."""
        # Exact on the axes, where cos and sin are not: quarter turns stay quarter turns.
        return np.round([np.cos(self.bearing), np.sin(self.bearing)], 15)

    @property
    def half(self) -> float:
        """Distance from the axis to either kerb [m]."""
        return self.median / 2 + self.lanes * self.lane_width

    def lane(self, k: int) -> float:
        """Distance from the axis to the middle of the k-th lane, in either direction [m]."""
        return self.median / 2 + (k + 0.5) * self.lane_width

    def at(self, station: float, left: float) -> np.ndarray:
        """The point (2,) ``station`` [m] out along the axis and ``left`` [m] of it."""
        u = self.along
        return station * u + left * np.array([-u[1], u[0]])

    def arm(self, mouth: float) -> Arm:
        """This road as an arm that enters the junction ``mouth`` [m] from the middle."""
        x, y = self.at(mouth, 0.0)
        return Arm((float(x), float(y)), self.bearing, 2 * self.half)

    def carriageway(self, start: float, end: float) -> Polygon:
        """The carriageway from kerb to kerb between two stations [m]."""
        across = ((start, -self.half), (end, -self.half), (end, self.half), (start, self.half))
        return Polygon([self.at(*corner) for corner in across])


def town(
    name: str,
    roads: list[Road],
    mouths: list[float],
    kerbs: list[np.ndarray],
    routes: Sequence[Route],
    islands: BaseGeometry | None = None,
    notes: tuple[str, ...] = (),
) -> Intersection:
    """An intersection of roads with shoulders, sidewalks, crosswalks, footpaths and signal poles.

    ``mouths`` are the distances from the middle at which the junction ends on each road [m].
    ``kerbs`` go round it: kerb i runs from the mouth of road i, on its left looking outward, to
    the mouth of the next road, on its right. ``islands`` are cut out of the carriageway.
    """
    long = [
        joined(a.at(LENGTH, a.half), kerb, b.at(LENGTH, -b.half))
        for a, b, kerb in zip(roads, roads[1:] + roads[:1], kerbs, strict=True)
    ]
    arms = tuple(road.arm(mouth) for road, mouth in zip(roads, mouths, strict=True))
    driveway = MultiPolygon([r.carriageway(m, LENGTH) for r, m in zip(roads, mouths, strict=True)])
    junction = Polygon(joined(*kerbs))
    mounting = MultiPolygon([strip(line, 0.0, SHOULDER + SIDEWALK) for line in long])
    if islands is not None:
        driveway, junction = driveway.difference(islands), junction.difference(islands)
        mounting = unary_union([mounting, islands])
    # People walk from sidewalk to sidewalk, so a crosswalk spans the shoulders too.
    crosswalks = mouth_crosswalks(
        tuple(replace(arm, width=arm.width + 2 * SHOULDER) for arm in arms)
    )
    regions = {
        Region.DRIVEWAY: driveway,
        Region.JUNCTION: junction,
        Region.CROSSWALK: crosswalks,
        Region.SIDEWALK: MultiPolygon([strip(x, SHOULDER, SHOULDER + SIDEWALK) for x in long]),
        Region.SHOULDER: MultiPolygon([strip(line, 0.0, SHOULDER) for line in long]),
    }
    people = [
        route(line, 2.0, user="pedestrian")
        for walk in _footpaths(roads, mouths, kerbs, SHOULDER + SIDEWALK / 2)
        for line in (walk, walk[::-1])
    ]
    poles = _poles(roads, mouths, kerbs, SHOULDER + 0.5)
    mounting = mounting.difference(crosswalks)
    return on_level_ground(name, regions, arms, [*routes, *people], mounting, poles, notes)


def _footpaths(
    roads: list[Road], mouths: list[float], kerbs: list[np.ndarray], back: float
) -> Iterator[Float[np.ndarray, "N 2"]]:
    """Footpaths over every crosswalk and along every sidewalk, ``back`` [m] from the kerb."""
    for road, mouth in zip(roads, mouths, strict=True):
        middle = mouth + CROSSWALK_WIDTH / 2
        yield np.array([road.at(middle, -road.half - back), road.at(middle, road.half + back)])
    for a, b, kerb in zip(roads, roads[1:] + roads[:1], kerbs, strict=True):
        start = a.at(station(a.half + back), a.half)
        end = b.at(station(b.half + back), -b.half)
        yield offset(joined(start, kerb, end), -back)


def _poles(
    roads: list[Road], mouths: list[float], kerbs: list[np.ndarray], back: float
) -> Float[np.ndarray, "P 3"]:
    """Signal poles ``back`` [m] from the kerb: at every corner, or where drivers stop if none."""
    feet: list[np.ndarray] = []
    for i, kerb in enumerate(kerbs):
        j = (i + 1) % len(roads)
        a, b = roads[i], roads[j]
        if gap(a, b) < _CORNER:
            line = offset(kerb, -back)
            feet.append(resampled(line, arc_of(line)[-1] / 2)[1])
        else:
            feet.append(a.at(mouths[i] + _STOP, a.half + back))
            feet.append(b.at(mouths[j] + _STOP, -b.half - back))
    return np.column_stack([np.array(feet), np.zeros(len(feet))])


def corners(roads: list[Road], radius: float) -> tuple[list[float], list[np.ndarray]]:
    """The mouth of every road [m] and the kerbs round the junction, as :func:`town` takes them.

    The junction ends on each road where the arcs of both its corners, of ``radius`` [m], have
    ended. Between roads that face each other the kerb runs on without a corner.
    """
    after = roads[1:] + roads[:1]
    arcs = [_corner(a, b, radius) for a, b in zip(roads, after, strict=True)]
    mouths = [radius] * len(roads)
    for i, arc in enumerate(arcs):
        j = (i + 1) % len(roads)
        if len(arc):
            mouths[i] = max(mouths[i], float(arc[0] @ roads[i].along))
            mouths[j] = max(mouths[j], float(arc[-1] @ roads[j].along))
    kerbs = []
    for i, (a, b) in enumerate(zip(roads, after, strict=True)):
        start, end = a.at(mouths[i], a.half), b.at(mouths[(i + 1) % len(roads)], -b.half)
        round_it = arcs[i] if len(arcs[i]) else bend(start, -a.along, end, b.along)
        kerbs.append(joined(start, round_it, end))
    return mouths, kerbs


def _corner(a: Road, b: Road, radius: float) -> Float[np.ndarray, "N 2"]:
    """The arc of the kerb between two neighbouring roads; no points if there is no corner."""
    if gap(a, b) >= _CORNER:
        return np.zeros((0, 2))
    start, end = a.at(LENGTH, a.half), b.at(LENGTH, -b.half)
    return fillet(start, -a.along, end, b.along, radius)


def on_level_ground(
    name: str,
    regions: dict[Region, BaseGeometry],
    arms: tuple[Arm, ...],
    routes: Sequence[Route],
    mounting: BaseGeometry,
    poles: Float[np.ndarray, "P 3"],
    notes: tuple[str, ...],
) -> Intersection:
    """An intersection at z = 0 with its middle at the origin."""
    at = (-LENGTH, 0.0, LENGTH)
    return Intersection(
        name=name,
        source=BUILT_IN,
        center=np.zeros(3),
        regions=regions,
        arms=arms,
        routes=tuple(routes),
        mounting=mounting,
        poles=poles,
        ground_points=np.array([(x, y, 0.0) for x in at for y in at]),
        notes=notes,
    )


def strip(line: Float[np.ndarray, "N 2"], near: float, far: float) -> Polygon:
    """The strip from ``near`` to ``far`` metres to the right of a line."""
    return Polygon(joined(offset(line, -near), offset(line, -far)[::-1]))


# ── Routes ──────────────────────────────────────────────────────────────────


def turns(roads: list[Road], mouths: list[float], corner_radius: float) -> Iterator[Route]:
    """Every movement from every road to every other, on the lanes for it.

    Turns are arcs as wide as the mouths allow. Round a corner they are only so wide that the lane
    keeps its distance from the kerb.
    """
    for i, a in enumerate(roads):
        for j, k, n in _movements(roads, i):
            b = roads[j]
            start, end = a.at(mouths[i], a.lane(k)), b.at(mouths[j], -b.lane(n))
            room = np.inf
            if j == (i + 1) % len(roads) and gap(a, b) < _CORNER:  # on the driver's right
                room = min(a.half - a.lane(k), b.half - b.lane(n))
            elif j == (i - 1) % len(roads) and gap(b, a) < _CORNER:
                room = min(a.half + a.lane(k), b.half + b.lane(n))
            path = joined(
                a.at(station(a.lane(k)), a.lane(k)),
                bend(start, -a.along, end, b.along, corner_radius + room),
                b.at(station(b.lane(n)), -b.lane(n)),
            )
            yield route(path, a.lane_width, (i, j))


def _movements(roads: list[Road], i: int) -> list[tuple[int, int, int]]:
    """(exit arm, entry lane, exit lane) of each movement from road i; lanes count from the axis."""
    lanes = roads[i].lanes
    exits = [j for j in range(len(roads)) if j != i]
    turn = {j: np.pi - gap(roads[i], roads[j]) for j in exits}  # right is positive
    found = []
    for j in exits:
        if abs(turn[j]) < _STRAIGHT:  # each lane keeps its number if the exit has that lane
            found += [(j, k, k) for k in range(min(lanes, roads[j].lanes))]
        elif turn[j] > 0:  # right turns use the outermost lanes, left turns the innermost
            found.append((j, lanes - 1, roads[j].lanes - 1))
        else:
            found.append((j, 0, 0))
    straightest = min(exits, key=lambda j: abs(turn[j]))
    last = roads[straightest].lanes - 1
    idle = set(range(lanes)) - {k for _, k, _ in found}
    return found + [(straightest, k, min(k, last)) for k in sorted(idle)]


def gap(a: Road, b: Road) -> float:
    """Angle from one road to another, counter-clockwise [rad]."""
    return float((b.bearing - a.bearing) % (2 * np.pi))


def station(left: float) -> float:
    """Distance along a road at which a line ``left`` [m] of the axis leaves the routes' circle."""
    return float(np.sqrt(ROUTE_LENGTH**2 - left**2))


def route(
    line: Float[np.ndarray, "N 2"],
    width: float,
    through: tuple[int, int] = (-1, -1),
    user: str = "vehicle",
) -> Route:
    """A route on level ground, with waypoints 1 m apart."""
    points = resampled(line)
    return Route(np.column_stack([points, np.zeros(len(points))]), width, user, through)
