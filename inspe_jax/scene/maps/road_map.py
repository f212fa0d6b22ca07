"""A map of roads: what each format reads of it, and the place that is made of that."""

from abc import ABC, abstractmethod
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np
import scipy
import shapely
from jaxtyping import Float
from shapely.geometry import MultiPolygon, Point, Polygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from inspe_jax.core.errors import InspeError, nearest
from inspe_jax.scene import intersection
from inspe_jax.scene.georeference import Georeference
from inspe_jax.scene.intersection import Arm, Intersection, Route, crossing_lines, joined_lines
from inspe_jax.scene.lines import distance_from, distinct, onward, resampled
from inspe_jax.scene.maps import lanes
from inspe_jax.scene.maps.bodies import NO_POLES
from inspe_jax.scene.maps.lanes import CARRIAGEWAY, SIDEWALK, TRAVEL, Approach, LaneStrip
from inspe_jax.scene.regions import Region
from inspe_jax.scene.voxels import check_range

STEP = 1.0  # spacing of the stations sampled along lanes and routes [m]
CLUSTER = 35.0  # junctions whose middle is this near to ``center`` count as one [m]
MARGIN = 10.0  # a map is read this much beyond the radius [m]
AHEAD = 10  # which of lanes is straight on, is seen from so many stations of each
MOST_LANES = 200  # a route goes along at most so many beyond its junction
APART = 20.0  # lanes, and pieces of a road, that follow each other are no farther apart [m]
FAR = 1e5  # single precision is 8 mm here: coordinates beyond are taken from a point near [m]
NO_ROUTES = "no vehicles drive through: the map links no lanes through the junction"
DRIVEN = TRAVEL | {"bidirectional"}  # kinds of lanes that routes go along
MOST_LISTED = 20  # at most this many junctions are listed in an error

Areas = dict[Region, BaseGeometry]


@dataclass(frozen=True)
class JunctionInfo:
    """A junction of a map: id, middle [m], number of arms, larger side of its bounding box [m],
    numbers of crosswalks and signals near it, and the names of its streets if there are any."""

    id: int | str
    center: tuple[float, float, float]
    arms: int
    size: float
    crosswalks: int
    signals: int
    streets: tuple[str, ...] = ()


def valid(shape: BaseGeometry) -> BaseGeometry:
    """The shape, repaired if its outline crosses itself."""
    return shape if shape.is_valid else shape.buffer(0)


def clean(shape: BaseGeometry) -> BaseGeometry:
    """A shape without seams and slivers of a few centimetres and without parts below 0.5 m²."""
    with np.errstate(divide="ignore", invalid="ignore"):  # at corners that double back
        for step in (0.05, -0.12, 0.07):
            shape = shape.buffer(step, join_style="mitre")
    return unary_union([part for part in shapely.get_parts(shape) if part.area > 0.5])


def mounting_of(
    regions: Areas, medians: list[BaseGeometry], arms: tuple[Arm, ...], disc: Polygon
) -> BaseGeometry:
    """Where a pole may stand: sidewalks, shoulders and medians, off carriageway and crosswalks; if
    none is beside the junction, islands at its corners, which on a deck would hang in the air."""
    standing = [regions[Region.SIDEWALK], regions[Region.SHOULDER], *medians]
    beside = unary_union(standing).distance(regions[Region.JUNCTION])
    if not beside <= 5.0:  # also if there is nothing: the distance is then not a number
        standing.append(intersection.corner_islands(arms))
    traffic = [regions[r] for r in (Region.DRIVEWAY, Region.JUNCTION, Region.CROSSWALK)]
    return clean(unary_union(standing).intersection(disc).difference(unary_union(traffic)))


RADIUS_READ = (0.0, 500.0)  # allowed radius of what is read of a map [m]

Id = int | str  # a junction's id
Name = TypeVar("Name", bound=Id)


def check_choice(junction: Id | None, center: tuple[float, float] | None) -> None:
    """Raise InspeError unless a place is named by one of the two."""
    if (junction is None) == (center is None):
        raise InspeError("say which place to read: either a junction id or a center (x, y)")


def named_junction(source: str, junction: Id | None, ids: Iterable[Name]) -> Name:
    """The one of ``ids`` that a user writes so. Raises InspeError that lists those there are."""
    named = {str(one): one for one in ids}
    if (name := str(junction)) not in named:
        known = ", ".join([*named][:MOST_LISTED]) + ", …" * (len(named) > MOST_LISTED)
        hint = nearest(name, [*named])
        raise InspeError(f"{source}: no junction '{name}'; there are: {known or 'none'}{hint}")
    return named[name]


class Node(NamedTuple):
    """A junction's middle [m], larger side of its bounding box [m], and number of signals."""

    middle: Float[np.ndarray, "3"]
    size: float
    signals: int


@dataclass(eq=False)
class MapJunction(ABC):
    """One junction of a map, or several members that count as one, and what its format reads to a
    radius [m] about their middle.

    ``poles`` of the map are at any height [m]; ``interior`` are the numbers of the roads inside the
    junction, or from one member to another. A format's ``__post_init__`` finds these and the
    ``approaches``. ``notes`` get what was assumed and done.
    """

    map: Any
    members: set[Any]
    middle: Float[np.ndarray, "3"]
    radius: float
    approaches: list[Approach] = field(init=False)
    poles: Float[np.ndarray, "P 3"] = field(init=False)
    interior: set[Any] = field(init=False)
    notes: list[str] = field(init=False, default_factory=list)

    @abstractmethod
    def __post_init__(self) -> None: ...

    def region_of(self, strip: LaneStrip) -> Region | None:
        """The region of a lane; None of one that is in no region."""
        if strip.kind in CARRIAGEWAY:
            return Region.JUNCTION if strip.road in self.interior else Region.DRIVEWAY
        if strip.kind in lanes.SHOULDER:
            return Region.SHOULDER
        return Region.SIDEWALK if strip.kind in SIDEWALK else None

    def crosswalks(
        self, areas: Areas, arms: tuple[Arm, ...], ground: Float[np.ndarray, "N 3"], disc: Polygon
    ) -> tuple[list[BaseGeometry], list[np.ndarray]]:
        """The crosswalks of its map inside the disc and near ground points [m], and the ``walked``
        lines of the first ones; if the junction has none, strips across its mouths too, with a
        note."""
        index = scipy.spatial.cKDTree(ground[:, :2])
        walks, lines = [], list[np.ndarray]()
        for k, loop in enumerate(self.map.crossings):
            middle = loop.mean(0)
            level = ground[index.query(middle[:2])[1], 2]
            if disc.contains(Point(middle)) and abs(middle[2] - level) < 2.0:
                walks.append(valid(Polygon(loop[:, :2])))
                lines += self.map.walked[k : k + 1]
        if any(walk.distance(areas[Region.JUNCTION]) < 8.0 for walk in walks):
            return walks, lines
        if areas[Region.SIDEWALK].intersection(disc).is_empty:
            strips, arms = "no crosswalks: the map has none here, nor sidewalks they could join", ()
        else:
            strips = "the map has no crosswalks here; strips across the junction's mouths stand in"
        self.notes.append(strips)
        return walks + [intersection.mouth_crosswalks((arm,)) for arm in arms], lines

    @abstractmethod
    def lanes(self) -> tuple[list[LaneStrip], list[bool]]:
        """The lanes near the junction on all levels, and which of them are certainly on its own."""

    @abstractmethod
    def areas(self, lane_strips: list[LaneStrip]) -> dict[Region, list[BaseGeometry]]:
        """Parts, which may overlap, of all regions but crosswalks."""

    def drives(self, arm_of: dict[tuple[Id, str], int]) -> Iterator[Route]:
        """Every path from an inbound lane to another arm (road, end), between radii; no U-turns."""
        town, broken, driven = self.map, 0, 0
        for approach in self.approaches:
            arm = arm_of[approach.road, approach.end]
            for lane, kind, low, high, inbound in approach.lanes:
                if kind not in TRAVEL or not inbound:
                    continue
                mouth = town.lane_at(approach, lane)
                before = self._follow(mouth, -1)
                for path in self._paths(mouth, arm_of):
                    exit_arm = arm_of[town.entry(path[-1])]
                    if exit_arm == arm:
                        continue
                    names = [*before, *path, *self._follow(path[-1], 1)]
                    lines = [town.strip(name).center for name in names]
                    if any(distance_from(b[:1], a[-1])[0] > APART for a, b in pairwise(lines)):
                        broken += 1
                        continue
                    line = np.concatenate(lines)
                    line = onward(distinct(line))
                    at = distance_from(line, town.strip(mouth).center[-1]).argmin()
                    line = self._about(line, at)
                    if len(line) > 1:
                        driven += 1
                        yield Route(resampled(line), high - low, "vehicle", (arm, exit_arm))
        if broken:
            self.notes.append(f"routes whose lanes are over {APART:g} m apart: {broken}, left out")
        if self.approaches and not driven:
            self.notes.append(NO_ROUTES)

    def _paths(self, start: Any, arm_of: Container[tuple[Id, str]]) -> Iterator[list[Any]]:
        """All sequences of lanes from an inbound lane through the junction to an arm."""
        stack = [[start]]
        while stack:
            path = stack.pop()
            for lane in self.map.follows[path[-1]]:
                strip = self.map.strip(lane)
                if strip.kind not in DRIVEN or lane in path:  # at most once round a roundabout
                    continue
                if self.map.entry(lane) in arm_of:
                    yield [*path, lane]
                elif strip.road in self.interior or len(strip.center) < 3:  # a stub
                    stack.append([*path, lane])

    def _follow(self, start: Any, direction: int) -> list[Any]:
        """Lanes from ``start`` on (1) or back (−1) to the radius, in travel order; straight on."""
        here, found = start, list[Any]()
        links = self.map.follows if direction > 0 else self.map.leads

        def line_of(lane: Any) -> np.ndarray:
            return np.asarray(self.map.strip(lane).center[::direction, :2])

        def turn(lane: Any, here: Any) -> float:
            line, last = line_of(lane), lane
            while len(line) < AHEAD and len(links.get(last, ())) == 1:
                (last,) = links[last]
                line = np.concatenate([line, line_of(last)])
            one, two = np.diff(line_of(here)[-2:], axis=0)[0], line[:AHEAD][-1] - line[0]
            return float(one @ two / np.maximum(np.hypot(*one) * np.hypot(*two), 1e-12))

        for _ in range(MOST_LANES):
            options = [o for o in links.get(here, ()) if o not in found]
            options = [o for o in options if self.map.strip(o).kind in DRIVEN]
            end = line_of(here)[-1:]
            if not options or distance_from(end, self.middle)[0] > self.radius:
                break
            here = max(options, key=partial(turn, here=here))
            found.append(here)
        return found[::direction]

    def _about(self, line: np.ndarray, at: int | np.intp) -> np.ndarray:
        """The points of a line around index ``at``, or the next one within the radius, up to the
        first ones beyond it; none where it does not come so near."""
        away = distance_from(line, self.middle)
        inside, outside = np.flatnonzero(away <= self.radius), np.flatnonzero(away > self.radius)
        if not len(inside):
            return line[:0]
        at = int(inside[min(int(np.searchsorted(inside, at)), len(inside) - 1)])
        first = outside[outside < at].max(initial=0)
        last = outside[outside > at].min(initial=len(line))
        return line[first : last + 1]

    @abstractmethod
    def with_bodies(self, place: Intersection, lane_strips: list[LaneStrip]) -> Intersection:
        """The place with the bodies of its map."""


class RoadMap(ABC):
    """A map file as its format reads it, in world metres.

    ``format`` is how the source of its places ends, ``around`` how a junction is read. ``name`` is
    that of its file without suffixes. ``crossings`` are the outlines of all crosswalks, each
    (K, 3), and ``walked`` the lines (N, 2) over them, where the format has these. ``georeference``
    is the projection of its coordinates, None without a usable one. ``notes`` are on all of it;
    ``unread`` are junctions that are left out, with why. Coordinates are less than in the file by
    ``moved`` [m]. ``follows`` and ``leads`` have the lanes after and before each, as traffic runs.
    """

    format: ClassVar[str]
    around: ClassVar[type[MapJunction]]
    path: Path
    name: str
    crossings: Sequence[np.ndarray]
    walked: Sequence[np.ndarray] = ()
    georeference: Georeference | None
    follows: Mapping[Any, Sequence[Any]]
    leads: Mapping[Any, Sequence[Any]]
    notes: Sequence[str] = ()
    unread: Mapping[str, str] = MappingProxyType({})
    moved: tuple[float, float] = (0.0, 0.0)

    @abstractmethod
    def road_lines(self) -> list[Float[np.ndarray, "N 2"]]:
        """The lines of its roads [m], for drawing."""

    @abstractmethod
    def strip(self, lane: Any) -> LaneStrip:
        """All of a lane, in the direction of its traffic."""

    @abstractmethod
    def lane_at(self, approach: Approach, lane: int) -> Any:
        """The key of a lane at the end of its road."""

    @abstractmethod
    def street(self, approach: Approach) -> str:
        """The name of the street of an approach; empty where the map has none."""

    def entry(self, lane: Any) -> tuple[Id, str]:
        """The road of a lane, and the end by which its traffic enters it."""
        return self.strip(lane).road, "start"

    @abstractmethod
    def junctions(self) -> list[Id]:
        """The ids of its junctions."""

    @abstractmethod
    def node(self, junction: Id) -> Node:
        """One of its junctions."""

    @property
    def source(self) -> str:
        """The name of its file."""
        return self.path.name

    def list_junctions(self) -> tuple[JunctionInfo, ...]:
        """Its junctions."""
        walks = np.array([loop.mean(0) for loop in self.crossings]).reshape(-1, 3)
        found = []
        for name in self.junctions():
            middle, size, signals = self.node(name)
            approaches = self.around(self, {name}, middle, 0.0).approaches
            arms, _ = lanes.arms_of(approaches)
            streets = dict.fromkeys(filter(None, (self.street(one) for one in approaches)))
            near = int((distance_from(walks, middle) < size / 2 + 8.0).sum())
            x, y, z = middle.tolist()
            found.append(JunctionInfo(name, (x, y, z), len(arms), size, near, signals, (*streets,)))
        return tuple(found)

    def read(
        self, junction: Id | None, center: tuple[float, float] | None, radius: float
    ) -> Intersection:
        """One junction and its surroundings: :func:`~inspe_jax.scene.maps.registry.read_map`."""
        members, middle, where = self._chosen(junction, center)
        check_range("radius", radius, RADIUS_READ)
        here = self.around(self, members, middle, radius)
        lane_strips = lanes.same_level(*here.lanes())
        reach = radius + MARGIN
        ground = np.concatenate([np.zeros((0, 3)), *(s.ground for s in lane_strips)])
        ground = ground[distance_from(ground, middle) <= reach + 5.0]
        if not len(ground):
            raise InspeError(
                f"{self.source}: no roads within {radius:g} m of ({middle[0]:.1f}, {middle[1]:.1f})"
            )
        arms, arm_of = lanes.arms_of(here.approaches)
        areas = _side_by_side(here.areas(lane_strips))
        disc = Point(middle[:2]).buffer(reach, quad_segs=32)
        walks, known = here.crosswalks(areas, arms, ground, disc)
        areas[Region.CROSSWALK] = clean(unary_union(walks))
        regions = {region: areas[region].intersection(disc) for region in Region}
        medians = [s.polygon for s in lane_strips if s.kind == "median"]
        place = Intersection(
            name=f"{self.name} {where}",
            source=f"{self.source} {self.format}",
            center=middle,
            regions=regions,
            arms=arms,
            routes=(),
            mounting=mounting_of(regions, medians, arms, disc),
            poles=here.poles,
            ground_points=ground,
            map=self.path.resolve(),
            georeference=self.georeference,
        )
        pavements = [
            run.center[:, :2]
            for strip in lane_strips
            if strip.kind in SIDEWALK
            for run in strip.runs(distance_from(strip.center, middle) <= radius)
        ]
        middles = [s.center for s in lane_strips if s.kind in CARRIAGEWAY]
        paths = [*known, *crossing_lines(walks[len(known) :], middles), *joined_lines(pavements)]
        walked = intersection.off_roads(paths, areas, here.notes)
        people = intersection.walking_routes(place, walked)
        place = replace(
            place,
            center=place.on_ground(middle[None])[0],
            poles=place.on_ground(here.poles),
            routes=(*here.drives(arm_of), *people),
        )
        here.notes += self.notes
        place = here.with_bodies(place, lane_strips)
        if not len(place.poles):
            here.notes.append(NO_POLES)
        return replace(place, notes=tuple(here.notes))

    def _chosen(
        self, junction: Id | None, center: tuple[float, float] | None
    ) -> tuple[set[Id], Float[np.ndarray, "3"], str]:
        """The junctions that a user names, their middle [m], and words for the place."""
        check_choice(junction, center)
        ids = self.junctions()
        if center is None:
            if why := self.unread.get(str(junction)):
                raise InspeError(f"{self.source}: junction {junction} is not read: {why}")
            one = named_junction(self.source, junction, ids)
            return {one}, self.node(one).middle, f"junction {one}"
        where = f"({center[0]:.10g}, {center[1]:.10g})"
        whole = np.abs(center).max() > FAR  # given in coordinates of the file
        at = np.array([*center, 0.0], float) - [*(self.moved if whole else (0.0, 0.0)), 0.0]
        middles = np.array([self.node(j).middle for j in ids]).reshape(-1, 3)
        away = distance_from(middles, at)
        near = away <= CLUSTER
        if not near.any():
            closest = int(np.argmin(away)) if ids else 0
            hint = f"; the nearest is {ids[closest]} at {away[closest]:.0f} m" if ids else ""
            raise InspeError(f"{self.source}: no junction within {CLUSTER:g} m of {where}{hint}")
        at[2] = np.mean(middles[near, 2])
        return {j for j, one in zip(ids, near, strict=True) if one}, at, f"at {where}"


def _side_by_side(parts: dict[Region, list[BaseGeometry]]) -> Areas:
    """Junction, driveway, shoulder and sidewalk of their parts, without overlaps, seams or gaps."""
    areas: Areas = {}
    taken: BaseGeometry = MultiPolygon()
    for region in (Region.JUNCTION, Region.DRIVEWAY, Region.SHOULDER, Region.SIDEWALK):
        areas[region] = clean(unary_union(parts[region]).difference(taken))
        taken = unary_union([taken, areas[region]])
    return areas
