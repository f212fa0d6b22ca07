"""An intersection: regions of the ground, arms, routes, places to mount poles, and heights."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import scipy
import shapely
from jaxtyping import Float, UInt8
from shapely.geometry import LineString, MultiPolygon, Point, Polygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from inspe_jax.core.digest import ORIGIN
from inspe_jax.core.errors import InspeError
from inspe_jax.core.records import Described, check_values
from inspe_jax.scene.georeference import Georeference
from inspe_jax.scene.lines import arc_of, resampled
from inspe_jax.scene.regions import Region
from inspe_jax.scene.statics import StaticBody

BUILT_IN = "built-in"  # source of a place that is made up
CLEARANCE = 2.5  # what is higher or lower than the road by more is on another level [m]
ALONG = 0.87  # lines that differ by less than 30° run along each other
LOW = 0.4  # what of a mesh rises less over the ground is part of it, as kerbs are [m]
BEYOND = 3.0  # people who cross begin and end so far beyond a crosswalk [m]
STRAY = 4.0  # footpaths lead no farther over a road beside crossings [m]
CROSSWALK_WIDTH = 3.0  # width of a crosswalk that is added where a map has none [m]
FOOTPATH_WIDTH = 2.0  # of routes of pedestrians of which nothing says so [m]


@dataclass(frozen=True)
class Arm:
    """One road that meets the junction. ``mouth`` is the middle of its carriageway where it enters
    [m]; ``bearing`` points away [rad]; ``width`` is that of both directions, kerb to kerb [m]."""

    mouth: tuple[float, float]
    bearing: float
    width: float

    @property
    def axes(self) -> Float[np.ndarray, "2 2"]:
        """Unit vectors out along the road, and to its left looking outward."""
        x, y = np.cos(self.bearing), np.sin(self.bearing)
        return np.array([[x, y], [-y, x]])

    def kerb(self, side: int, outward: float = 0.0) -> Float[np.ndarray, "2"]:
        """The kerb ``outward`` [m] of the mouth, on the left (+1) or right (−1); 0: middle."""
        along, across = self.axes
        return np.asarray(self.mouth) + outward * along + side * self.width / 2 * across


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class Route:
    """A path that one kind of road user follows: ``waypoints`` about 1 m apart, in the direction of
    travel [m]; ``width`` of the lane [m]; ``user``, ``'vehicle'`` or ``'pedestrian'``; and
    ``through``, the indices of a vehicle's (entry, exit) arms, −1 where it begins or ends
    elsewhere."""

    waypoints: Float[np.ndarray, "N 3"]
    width: float
    user: str = "vehicle"
    through: tuple[int, int] = (-1, -1)

    @cached_property
    def arc(self) -> Float[np.ndarray, " N"]:
        """Plan-view arc length at each waypoint [m]."""
        return arc_of(self.waypoints)

    @property
    def length(self) -> float:
        """Plan-view length [m]."""
        return float(self.arc[-1])


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class Mesh:
    """Triangles (F, 3, 3) relative to ``origin`` (3,) in the world [m], in single precision, and
    the ``colour`` (F, 3) of each in sRGB, 0 to 255."""

    origin: Float[np.ndarray, "3"]
    triangles: Float[np.ndarray, "F 3 3"]
    colour: UInt8[np.ndarray, "F 3"]

    @property
    def world(self) -> Float[np.ndarray, "F 3 3"]:
        """The triangles in the world [m], in double precision."""
        return self.triangles.astype(float) + self.origin


@dataclass(frozen=True, eq=False, repr=False)  # arrays inside: identity is equality
class Intersection(Described):
    """A junction and what surrounds it, in world metres (ENU).

    ``regions`` may overlap: a column takes its label by
    :data:`~inspe_jax.scene.regions.PRECEDENCE`. ``mounting`` is where a pole may be put, ``poles``
    are the feet of existing ones. ``ground_points`` give the height of the ground. ``notes`` say
    what was assumed. ``map`` is the file that it was read from. ``bodies`` are those of its map,
    which a scene has with ``statics="map"``; ``mesh`` are the triangles that bodies of kind
    ``solid`` stand for. ``georeference`` is the projection of its coordinates, None if unknown.
    ``level_points`` are the ground points of the map, where the place stands on other ground
    (:meth:`standing_on`). ``driving_side`` is the side that was given, None for the country's.
    A saved scene keeps neither the map nor these.
    """

    name: str
    source: str
    center: Float[np.ndarray, "3"]
    regions: Mapping[Region, BaseGeometry]
    arms: tuple[Arm, ...]
    routes: tuple[Route, ...]
    mounting: BaseGeometry
    poles: Float[np.ndarray, "P 3"]
    ground_points: Float[np.ndarray, "G 3"]
    notes: tuple[str, ...] = field(default=())
    map: Path | None = field(default=None, metadata={ORIGIN: None})
    bodies: tuple[StaticBody, ...] = ()
    georeference: Georeference | None = field(default=None, metadata={ORIGIN: None})
    mesh: Mesh | None = None
    level_points: Float[np.ndarray, "N 3"] | None = field(default=None, metadata={ORIGIN: None})
    driving_side: str | None = field(default=None, metadata={ORIGIN: None})

    def _facts(self) -> dict[str, Any]:
        counts = {part: len(getattr(self, part)) for part in ("arms", "routes", "poles", "bodies")}
        return {"name": self.name, "source": self.source} | counts

    def _check(self, prefix: str) -> None:
        if not len(self.ground_points):
            raise InspeError(f"{prefix}ground_points: at least one is needed")
        for shape in (*self.regions.values(), self.mounting):
            check_values(shapely.get_coordinates(shape), f"{prefix}regions or mounting")

    @cached_property
    def lanes(self) -> BaseGeometry:
        """The ground of all lanes of vehicles."""
        # Mitred, because round joins would change a little where the world is turned.
        drives = [r for r in self.routes if r.user == "vehicle" and len(r.waypoints) > 1]
        lines, half = lines_of(drives, "vehicle"), [route.width / 2 for route in drives]
        return unary_union(shapely.buffer(lines, half, cap_style="flat", join_style="mitre"))

    @cached_property
    def _ground_index(self) -> "scipy.spatial.cKDTree":
        return scipy.spatial.cKDTree(self.ground_points[:, :2])

    def ground(self, xy: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, " N"]:
        """Ground height [m] at plan points: inverse-distance mean of the 4 nearest points.

        Exact at a ground point; on level ground it is that level everywhere.

        >>> scene.intersection.ground(np.array([[0.0, 0.0], [10.0, 5.0]])).tolist()
        [0.0, 0.0]
        """
        xy = np.atleast_2d(np.asarray(xy, float))
        neighbours = min(4, len(self.ground_points))
        distance, index = self._ground_index.query(xy, k=neighbours)
        distance, index = (found.reshape(len(xy), neighbours) for found in (distance, index))
        weight = 1.0 / np.maximum(distance, 1e-6) ** 2
        return (weight * self.ground_points[index, 2]).sum(1) / weight.sum(1)

    def level(self, xy: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, " N"]:
        """Height [m] of the roads in the map's own coordinates, which tells levels apart."""
        return self._on_own_ground.ground(xy)

    @cached_property
    def _on_own_ground(self) -> "Intersection":
        if self.level_points is None:
            return self
        return replace(self, ground_points=self.level_points, level_points=None)

    def on_ground(self, xy: Float[np.ndarray, "N d"]) -> Float[np.ndarray, "N 3"]:
        """Points on the ground [m] at plan points; only their x and y are used."""
        return np.column_stack([xy[:, :2], self.ground(xy[:, :2])])

    def standing_on(self, points: Float[np.ndarray, "G 3"]) -> "Intersection":
        """This place on ground through other points [m]: its centre, poles and routes too."""
        own = self.ground_points if self.level_points is None else self.level_points
        place = replace(self, ground_points=points, level_points=own)
        center, poles = place.on_ground(self.center[None])[0], place.on_ground(self.poles)
        routes = tuple(replace(r, waypoints=place.on_ground(r.waypoints)) for r in self.routes)
        return replace(place, center=center, poles=poles, routes=routes)


def lines_of(routes: Iterable[Route], user: str) -> list[LineString]:
    """The routes of a kind of road user in plan, but for those of a single point."""
    own = (r.waypoints[:, :2] for r in routes if r.user == user and len(r.waypoints) > 1)
    return [LineString(line) for line in own]


def mouth_crosswalks(arms: tuple[Arm, ...]) -> BaseGeometry:
    """One strip of :data:`CROSSWALK_WIDTH` across each arm, just outside the junction's mouth."""
    half = CROSSWALK_WIDTH / 2
    ends = [[arm.kerb(side, half) for side in (-1, 1)] for arm in arms]
    return unary_union([LineString(line).buffer(half, cap_style="flat") for line in ends])


def crossing_lines(
    walks: list[BaseGeometry], lanes: Iterable[np.ndarray] = ()
) -> Iterator[np.ndarray]:
    """The middle line (N, 2) of each crosswalk, :data:`BEYOND` both ends: along its longer side, or
    the other if the lines of ``lanes`` under it run along that."""
    steps = [np.diff(line[:, :2], axis=0) for line in lanes]
    at = np.concatenate([np.zeros((0, 2)), *(line[:-1, :2] for line in lanes)])
    ahead = np.concatenate([np.zeros((0, 2)), *steps])
    for walk in walks:
        corners = np.array(walk.minimum_rotated_rectangle.exterior.coords)[:4]
        sides = np.diff(corners[:3], axis=0)
        length, under = np.hypot(*sides.T), ahead[shapely.intersects_xy(walk, *at.T)]
        along = sides[np.argmax(length)]
        alike = abs(under @ along) > ALONG * length.max() * np.hypot(*under.T)
        if alike.sum() > len(under) / 2:
            along = sides[np.argmin(length)]
        reach = along / 2 + BEYOND * along / np.linalg.norm(along)
        middle = corners.mean(0)
        yield resampled(np.array([middle - reach, middle + reach]))


def joined_lines(lines: list[np.ndarray]) -> Iterator[np.ndarray]:
    """Footpaths (N, 2), joined where the end of one is within 1.5 m of another; 5 m or longer."""
    lines = list(lines)

    def joint(line: np.ndarray) -> tuple[int, np.ndarray] | None:
        for i, other in enumerate(lines):
            for a, b in product((line, line[::-1]), (other, other[::-1])):
                if np.hypot(*(a[-1] - b[0])) < 1.5:
                    return i, np.concatenate([a, b])
        return None

    while lines:
        line = lines.pop()
        while found := joint(line):
            del lines[found[0]]
            line = found[1]
        if np.hypot(*np.diff(line, axis=0).T).sum() >= 5.0:
            yield resampled(line)


def off_roads(
    lines: Iterable[np.ndarray], areas: Mapping[Region, BaseGeometry], notes: list[str]
) -> Iterator[Float[np.ndarray, "N 2"]]:
    """Footpaths (N, 2) without what leads over a road for more than :data:`STRAY`; with a note."""
    roads = unary_union([areas[Region.JUNCTION], areas[Region.DRIVEWAY]])
    roads = roads.buffer(0.5).buffer(-0.8)  # without gaps between lanes, and inside the kerb
    roads, cut = roads.difference(areas[Region.CROSSWALK].buffer(0.5)), 0
    for line in lines:
        path = LineString(line)
        on = shapely.get_parts(path.intersection(roads))
        stray = on[shapely.length(on) > STRAY]
        if not len(stray):
            yield line
            continue
        cut += 1
        rest = path.difference(unary_union(stray).buffer(0.01))
        yield from (resampled(np.array(p.coords)) for p in shapely.get_parts(rest) if p.length >= 5)
    if cut:
        notes.append(f"footpaths over the carriageway beside crossings: {cut}, cut off there")


def walking_routes(
    place: Intersection, lines: Iterable[np.ndarray], width: float = FOOTPATH_WIDTH
) -> Iterator[Route]:
    """Footpaths (N, 2) as routes on the ground of a place, in both directions."""
    for line in lines:
        for path in (line, line[::-1]):
            yield Route(place.on_ground(path), width, "pedestrian")


def corner_islands(arms: tuple[Arm, ...]) -> BaseGeometry:
    """Square islands of 2 m at the corners between neighbouring arms: midway between their facing
    kerb points, moved 1.5 m out from the middle of all mouths. None of fewer than two arms."""
    if len(arms) < 2:
        return MultiPolygon()
    ordered = sorted(arms, key=lambda a: a.bearing % (2 * np.pi))
    islands: list[Polygon] = []
    for arm, following in zip(ordered, ordered[1:] + ordered[:1], strict=True):
        corner = (arm.kerb(+1) + following.kerb(-1)) / 2
        outward = corner - np.mean([a.mouth for a in arms], axis=0)
        norm = np.linalg.norm(outward)
        if norm > 0:
            corner = corner + outward / norm * 1.5
        islands.append(Point(corner).buffer(1.0, cap_style="square"))
    return unary_union(islands)
