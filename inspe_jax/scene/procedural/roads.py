"""Straight roads with kerbs, lanes and sidewalks: the parts of the built-in intersections."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from shapely.geometry import MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from inspe_jax.scene import intersection
from inspe_jax.scene.intersection import CROSSWALK_WIDTH, Arm, Intersection, Route
from inspe_jax.scene.lines import Line, arc_of, bend, fillet, joined, offset, resampled
from inspe_jax.scene.regions import Region

LENGTH = 120.0  # length of roads from the middle [m]
ROUTE_LENGTH = 110.0  # length of routes from the middle [m]
SHOULDER, SIDEWALK = 1.0, 3.0  # width of shoulders and of sidewalks [m]
_SIDE = (-LENGTH, 0.0, LENGTH)
LEVEL: dict[str, Any] = dict(
    source=intersection.BUILT_IN,
    center=np.zeros(3),
    ground_points=np.array([(x, y, 0.0) for x in _SIDE for y in _SIDE]),
)
"""What all built-ins have in common: the middle is the origin, and the ground is level."""

_CORNER = np.radians(150.0)  # arms nearer than this have a corner; between others the kerb runs on
_STRAIGHT = np.radians(30.0)  # a movement that turns less goes straight on
_STOP = CROSSWALK_WIDTH + 1.0  # from the mouth to where drivers stop [m]


@dataclass(frozen=True)
class Road:
    """A straight arm: as many lanes in as out, on either side of an axis through the origin. The
    junction ends on it ``mouth`` [m] from there."""

    bearing: float
    lanes: int
    lane_width: float
    median: float = 0.0
    mouth: float = 0.0

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

    @property
    def arm(self) -> Arm:
        """This road as an arm of the junction."""
        x, y = self.at(self.mouth, 0.0)
        return Arm((float(x), float(y)), self.bearing, 2 * self.half)

    @property
    def carriageway(self) -> Polygon:
        """The carriageway from kerb to kerb, outside the junction."""
        around = [(self.mouth, -1), (LENGTH, -1), (LENGTH, 1), (self.mouth, 1)]
        return Polygon([self.at(x, side * self.half) for x, side in around])


def neighbours(roads: list[Road]) -> list[tuple[Road, Road]]:
    """Each road and the next one, counter-clockwise."""
    return [*zip(roads, roads[1:] + roads[:1], strict=True)]


def town(
    name: str,
    roads: list[Road],
    kerbs: list[np.ndarray],
    routes: Sequence[Route],
    islands: BaseGeometry | None = None,
    notes: tuple[str, ...] = (),
) -> Intersection:
    """An intersection of roads with shoulders, sidewalks, crosswalks, footpaths and signal poles.
    Kerb i runs from the left of the mouth of road i, looking outward, to the right of that of the
    next. ``islands`` are cut out of the carriageway."""
    long = [
        joined(a.at(LENGTH, a.half), kerb, b.at(LENGTH, -b.half))
        for (a, b), kerb in zip(neighbours(roads), kerbs, strict=True)
    ]
    arms = tuple(road.arm for road in roads)
    driveway = MultiPolygon([road.carriageway for road in roads])
    junction = Polygon(joined(*kerbs))
    mounting = MultiPolygon([strip(line, 0.0, SHOULDER + SIDEWALK) for line in long])
    if islands is not None:
        driveway, junction = driveway.difference(islands), junction.difference(islands)
        mounting = unary_union([mounting, islands])
    # People walk from sidewalk to sidewalk, so a crosswalk spans the shoulders too.
    whole = tuple(replace(arm, width=arm.width + 2 * SHOULDER) for arm in arms)
    crosswalks = intersection.mouth_crosswalks(whole)
    regions = {
        Region.DRIVEWAY: driveway,
        Region.JUNCTION: junction,
        Region.CROSSWALK: crosswalks,
        Region.SIDEWALK: MultiPolygon([strip(x, SHOULDER, SHOULDER + SIDEWALK) for x in long]),
        Region.SHOULDER: MultiPolygon([strip(line, 0.0, SHOULDER) for line in long]),
    }
    people = [
        route(line, 2.0, user="pedestrian")
        for walk in _footpaths(roads, kerbs, SHOULDER + SIDEWALK / 2)
        for line in (walk, walk[::-1])
    ]
    return Intersection(
        name=name,
        regions=regions,
        arms=arms,
        routes=(*routes, *people),
        mounting=mounting.difference(crosswalks),
        poles=_poles(roads, kerbs, SHOULDER + 0.5),
        notes=notes,
        **LEVEL,
    )


def _footpaths(roads: list[Road], kerbs: list[np.ndarray], back: float) -> Iterator[Line]:
    """Footpaths over every crosswalk and along every sidewalk, ``back`` [m] from the kerb."""
    for road in roads:
        middle = road.mouth + CROSSWALK_WIDTH / 2
        yield np.array([road.at(middle, -road.half - back), road.at(middle, road.half + back)])
    for (a, b), kerb in zip(neighbours(roads), kerbs, strict=True):
        start = a.at(station(a.half + back), a.half)
        end = b.at(station(b.half + back), -b.half)
        yield offset(joined(start, kerb, end), -back)


def _poles(roads: list[Road], kerbs: list[np.ndarray], back: float) -> Float[np.ndarray, "P 3"]:
    """Signal poles ``back`` [m] from the kerb: at every corner, or where drivers stop if none."""
    feet: list[np.ndarray] = []
    for (a, b), kerb in zip(neighbours(roads), kerbs, strict=True):
        if gap(a, b) < _CORNER:
            line = offset(kerb, -back)
            feet.append(resampled(line, arc_of(line)[-1] / 2)[1])
        else:
            feet.append(a.at(a.mouth + _STOP, a.half + back))
            feet.append(b.at(b.mouth + _STOP, -b.half - back))
    return np.column_stack([np.array(feet), np.zeros(len(feet))])


def corners(roads: list[Road], radius: float) -> tuple[list[Road], list[np.ndarray]]:
    """The roads with their mouths, where the arcs of both corners, of ``radius`` [m], have ended;
    and the kerbs as :func:`town` takes them."""
    arcs = [
        fillet(a.at(LENGTH, a.half), -a.along, b.at(LENGTH, -b.half), b.along, radius)
        if gap(a, b) < _CORNER
        else np.zeros((0, 2))
        for a, b in neighbours(roads)
    ]
    ended = []
    for road, before, after in zip(roads, arcs[-1:] + arcs[:-1], arcs, strict=True):
        ends = [float(end @ road.along) for end in (*before[-1:], *after[:1])]
        ended.append(replace(road, mouth=max([radius, *ends])))
    kerbs = []
    for (a, b), arc in zip(neighbours(ended), arcs, strict=True):
        start, end = a.at(a.mouth, a.half), b.at(b.mouth, -b.half)
        kerbs.append(joined(start, arc if len(arc) else bend(start, -a.along, end, b.along), end))
    return ended, kerbs


def strip(line: Line, near: float, far: float) -> Polygon:
    """The strip from ``near`` to ``far`` metres to the right of a line."""
    return Polygon(joined(offset(line, -near), offset(line, -far)[::-1]))


def turns(roads: list[Road], corner_radius: float) -> Iterator[Route]:
    """Every movement from every road to every other, on the lanes for it: arcs as wide as the
    mouths allow; round corners lanes keep their distance from kerbs."""
    for i, a in enumerate(roads):
        for j, k, n in _movements(roads, i):
            b = roads[j]
            start, end = a.at(a.mouth, a.lane(k)), b.at(b.mouth, -b.lane(n))
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
    line: Line, width: float, through: tuple[int, int] = (-1, -1), user: str = "vehicle"
) -> Route:
    """A route on level ground, with waypoints 1 m apart."""
    points = resampled(line)
    return Route(np.column_stack([points, np.zeros(len(points))]), width, user, through)
