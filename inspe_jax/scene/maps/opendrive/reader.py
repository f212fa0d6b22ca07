"""Reads OpenDRIVE maps: junctions with their lanes, crosswalks, routes and bodies."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import shapely
from jaxtyping import Float
from shapely.geometry import LineString, Point, Polygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import cached_by_file
from inspe_jax.core.words import counted
from inspe_jax.scene.intersection import Intersection
from inspe_jax.scene.lines import distance_from
from inspe_jax.scene.maps.bodies import with_bodies
from inspe_jax.scene.maps.lanes import (
    CARRIAGEWAY,
    SHOULDER,
    SIDEWALK,
    TRAVEL,
    Approach,
    LaneStrip,
    heading,
)
from inspe_jax.scene.maps.opendrive.lane_graph import LaneGraph, LaneKey
from inspe_jax.scene.maps.opendrive.objects import (
    CROSSWALK,
    FLAT,
    PARKING,
    SIGNAL,
    TRAFFIC_ISLAND,
    shapes_of,
    with_parked,
)
from inspe_jax.scene.maps.opendrive.road_network import (
    LaneCut,
    OpenDriveRoad,
    Section,
    listed,
    moved_near,
    projection_of,
    read_roads,
    read_tree,
)
from inspe_jax.scene.maps.road_map import (
    CLUSTER,
    MARGIN,
    STEP,
    Id,
    MapJunction,
    Node,
    RoadMap,
    clean,
    valid,
)
from inspe_jax.scene.regions import Region

ISLAND = 3.0  # a gap between a junction's lanes is paved unless such a circle fits in it [m]
COARSE = 5.0  # spacing of the points of a map's road lines [m]
MOST_NAMED = 6  # at most so many of what is left out are named in a note
NO_AREA = "a {} junction has no area of its own, choose another"
NO_LANES = "none of its roads that can be read has lanes"
BOX = 10  # a bounding box is that of so many stretches of each lane
KINDS = CARRIAGEWAY | SHOULDER | SIDEWALK | {"none", "median", "rail", "tram"}  # known types
APRON = 25.0  # lanes are read so much farther than kept [m]: none ends inside the rim


class OpenDriveJunction(MapJunction):
    """One or several junctions of an OpenDRIVE file."""

    def __post_init__(self) -> None:
        signals = self.map.signals
        # They are at the height of their lights, or below ground.
        self.poles = signals[distance_from(signals, self.middle) <= self.radius + MARGIN]
        self.interior = interior_of(self.map, self.members)
        self.approaches = approaches_of(self.map, self.members)

    def lanes(self) -> tuple[list[LaneStrip], list[bool]]:
        reach, found = self.radius + MARGIN + APRON, list[LaneStrip]()
        for road in self.map.roads.values():
            for index in range(len(road.sections)) if road.near(self.middle, reach) else ():
                for strip in self.map.strips(road, index).values():
                    width = np.hypot(*(strip.left - strip.right)[:, :2].T).max()
                    if width < 0.05:
                        continue
                    # One lane's width farther: the disc cuts the lane, and not its stations.
                    away = distance_from(strip.center, self.middle)
                    found += strip.runs(away <= reach + width + STEP)
        return found, [s.road in self.interior for s in found]

    def areas(self, lane_strips: list[LaneStrip]) -> dict[Region, list[BaseGeometry]]:
        parts: dict[Region, list[BaseGeometry]] = {region: [] for region in Region}
        drawn = False
        for name in sorted({s.junction for s in lane_strips} - {-1}, key=listed):
            strips = [s for s in lane_strips if s.junction == name]
            approaches = approaches_of(self.map, {name})
            corners: list[Polygon] = []
            if not any(s.kind in SHOULDER | SIDEWALK for s in strips):
                for side, kinds in ((Region.SHOULDER, SHOULDER), (Region.SIDEWALK, SIDEWALK)):
                    parts[side] += (found := list(_corners(approaches, kinds)))
                    corners += found
            drawn |= name in self.members and bool(corners)
            paved = _paved(strips, approaches, corners)
            parts[Region.JUNCTION if name in self.members else Region.DRIVEWAY].append(paved)
        for strip in lane_strips:
            if strip.kind in CARRIAGEWAY and strip.junction != -1:  # in the paved area already
                continue
            if (region := self.region_of(strip)) is not None:
                parts[region].append(strip.polygon)
        if drawn:
            self.notes.append(
                "sidewalks and shoulders end at the junction in the map; its corners were drawn "
                "between those of neighbouring roads"
            )
        return parts

    def with_bodies(self, place: Intersection, lane_strips: list[LaneStrip]) -> Intersection:
        reach, shapes = self.radius + MARGIN, self.map.shapes
        lanes = unary_union([s.polygon for s in lane_strips if s.kind in CARRIAGEWAY])
        hung = shapely.intersects_xy(lanes, *place.poles[:, :2].T)
        if hung.any():
            self.notes.append(f"{counted(int(hung.sum()), 'signal')} over lanes: no standing poles")
            place = replace(place, poles=place.poles[~hung])
        if islands := [s.area for s in shapes if s.kind == TRAFFIC_ISLAND]:
            near = unary_union(islands).intersection(Point(self.middle[:2]).buffer(reach))
            free = near.difference(unary_union([lanes, place.regions[Region.CROSSWALK]]))
            place = replace(place, mounting=unary_union([place.mounting, clean(free)]))
        bodies = [s for s in shapes if s.kind not in FLAT]
        place = with_bodies(place, bodies, reach, self.notes)
        parking = [strip for strip in lane_strips if strip.kind == "parking"]
        spaces = [shape.area for shape in shapes if shape.kind == PARKING]
        return with_parked(place, parking, spaces, reach, self.notes)


class OpenDriveMap(RoadMap):
    """An OpenDRIVE file; ``notes`` are on what is left out, its ``shapes`` and its projection.
    Raises InspeError if it is not OpenDRIVE, or has no road that can be read."""

    format, around = "(OpenDRIVE)", OpenDriveJunction

    def __init__(self, path: Path) -> None:
        self.path, self.name = path, path.stem
        root = read_tree(path)
        self.moved = moved = moved_near(root)
        found, roads_out = read_roads(root)
        out = [words for _, words in roads_out]
        self.roads = {name: road for name, (_, road) in found.items()}
        if not self.roads:
            why = f" that can be read: {'; '.join(out[:MOST_NAMED])}" if out else ""
            raise InspeError(f"{path}: the map has no roads{why}")
        graph = LaneGraph(self.roads, root)
        self.inside: dict[Id, list[OpenDriveRoad]] = {}
        for road in self.roads.values():
            self.inside.setdefault(road.junction, []).append(road)
        self._strips: dict[tuple[Id, int], dict[int, LaneStrip]] = {}
        self.follows, self.leads = graph.follows, graph.leads
        self.shapes, on_shapes = shapes_of(found.values())
        self.crossings = tuple(
            np.column_stack([outline[:-1], np.full(len(outline) - 1, shape.base)])
            for shape in self.shapes
            if shape.kind == CROSSWALK
            for outline in [np.array(shape.area.exterior.coords)]
        )
        self.signals = np.zeros((0, 3))
        for shape in (shape for shape in self.shapes if shape.kind == SIGNAL):
            point = np.array([*shape.area.centroid.coords[0], shape.base])
            if not (distance_from(self.signals, point) < 0.5).any():  # roads share them
                self.signals = np.vstack([self.signals, point])
        self.georeference, on_it = projection_of(root, moved)
        with_lanes = self.junctions()
        self.unread = {
            str(name): NO_AREA.format(kind)
            if kind in ("direct", "virtual")
            else "; ".join(
                [NO_LANES, *(words for junction, words in roads_out if junction == name)]
            )
            for name, kind in graph.junctions.items()
            if name not in with_lanes
        }
        unread = (f"junction {n} ({w.partition(';')[0]})" for n, w in self.unread.items())
        out += [*graph.left_out, *unread]
        self.notes = (*self._notes(out, moved), *on_shapes, *on_it)

    def _notes(self, out: list[str], moved: tuple[float, float]) -> Iterator[str]:
        if out:
            more = f" and {len(out) - MOST_NAMED} more" * (len(out) > MOST_NAMED)
            yield f"left out of the map: {'; '.join(out[:MOST_NAMED])}{more}"
        if kinds := set().union(*(road.kinds() for road in self.roads.values())) - KINDS:
            yield f"lanes of other types are left out: {', '.join(sorted(kinds)[:MOST_NAMED])}"
        if any(moved):
            east, north = moved
            yield f"coordinates are those of the map less ({east:.0f}, {north:.0f}) m"

    def strips(self, road: OpenDriveRoad, index: int) -> dict[int, LaneStrip]:
        """The lanes of a section of a road, by id."""
        section = road.sections[index]
        if (road.id, index) not in self._strips:
            found = self._strips[road.id, index] = {}
            for lane, cut in along(road, section, STEP).items():
                one, way = section.lanes[lane], 1 if section.lanes[lane].onward else -1
                left, right = (cut.outer, cut.inner)[:: way if lane > 0 else -way]
                lines = (line[::way] for line in (cut.middle, left, right))
                found[lane] = LaneStrip(road.id, road.junction, one.kind, *lines)
        return self._strips[road.id, index]

    def strip(self, lane: LaneKey) -> LaneStrip:
        return self.strips(self.roads[lane[0]], lane[1])[lane[2]]

    def lane_at(self, approach: Approach, lane: int) -> LaneKey:
        last = len(self.roads[approach.road].sections) - 1
        return approach.road, 0 if approach.end == "start" else last, lane

    def street(self, approach: Approach) -> str:
        name = self.roads[approach.road].name
        return name if name != f"Road {approach.road}" else ""  # as RoadRunner names all

    def entry(self, lane: LaneKey) -> tuple[Id, str]:
        one = self.roads[lane[0]].sections[lane[1]].lanes[lane[2]]
        return lane[0], "start" if one.onward else "end"

    def road_lines(self) -> list[Float[np.ndarray, "N 2"]]:
        found = []  # the middle of a driving lane of each
        for road in self.roads.values():
            for section in road.sections:
                driving = [name for name, one in section.lanes.items() if one.kind in TRAVEL]
                if driving:
                    found.append(along(road, section, COARSE)[driving[0]].middle[:, :2])
        return found

    def junctions(self) -> list[Id]:
        roads = self.roads.values()
        with_lanes = {road.junction for road in roads if road.kinds() - {"none"}}
        return sorted(with_lanes - {-1}, key=listed)

    def node(self, junction: Id) -> Node:
        lines = [
            cut.middle
            for road in self.inside[junction]
            for section in road.sections
            for name, cut in along(road, section, (section.end - section.start) / BOX).items()
            if section.lanes[name].kind != "none"
        ]
        points = np.concatenate(lines)
        middle, size = (points.min(0) + points.max(0)) / 2, float(np.ptp(points[:, :2], 0).max())
        signals = distance_from(self.signals, middle) < size / 2 + 15.0
        return Node(middle, size, int(signals.sum()))


load_map = cached_by_file(8)(OpenDriveMap)
"""The map of a file, cached while it does not change. Raises as :class:`OpenDriveMap`."""


def along(road: OpenDriveRoad, section: Section, spacing: float) -> dict[int, LaneCut]:
    """Lanes at stations from one end of a section to the other, about ``spacing`` [m] apart."""
    count = max(2, int(np.ceil((section.end - section.start) / spacing)) + 1)
    return road.cuts(section, np.linspace(section.start, section.end, count))


def interior_of(town: OpenDriveMap, members: set[Id]) -> set[Id]:
    """The roads of member junctions, and of short chains between them, as a roundabout's ring."""
    found = {road.id for name in members for road in town.inside[name]}
    if len(members) < 2:
        return found
    for first in town.roads.values():
        chain, ends, todo = set[Id](), set[Id](), [first.id]
        while todo and first.junction == -1:
            road = town.roads[todo.pop()]
            chain.add(road.id)
            ends |= {link[1] for link in road.links.values() if link[0] == "junction"}
            following = {link[1] for link in road.links.values() if link[0] == "road"}
            todo += following & town.roads.keys() - chain
        length = sum(town.roads[road].length for road in chain)
        if len(ends) > 1 and ends <= members and length <= 2 * CLUSTER:
            found |= chain
    return found


def approaches_of(town: OpenDriveMap, members: set[Id]) -> list[Approach]:
    """The approaches: ends of the roads that the members' connecting roads lead from and to."""
    inside = interior_of(town, members)
    touched = {
        _beyond(town, link[1], link[2])
        for name in members
        for road in town.inside[name]
        for link in road.links.values()
        if link[0] == "road" and link[1] in town.roads and link[1] not in inside
    }
    touched = {one for one in touched if one[1]}  # not along a road, as a virtual junction
    ends = sorted(touched, key=lambda one: (listed(one[0]), one[1]))
    approaches = [_approach(town.roads[road], end) for road, end in ends]
    return [approach for approach in approaches if approach is not None]


def _beyond(town: OpenDriveMap, road: Id, end: str) -> tuple[Id, str]:
    """The road end itself; if the road is a stub, the next end. Maps have stubs of 0.01 mm."""
    here, other = town.roads[road], "end" if end == "start" else "start"
    kind, following, contact = here.links.get(other, ("", -1, ""))
    if here.length < 1.0 and kind == "road" and following in town.roads:
        return following, contact
    return road, end


def _approach(road: OpenDriveRoad, end: str) -> Approach | None:
    away, at = (1, 0.0) if end == "start" else (-1, road.length)
    here, there = (_cut(road, at + away * far, away) for far in (0.0, min(15.0, road.length)))
    if here is None or there is None:
        return None
    chord = there.point(sum(there.kerbs) / 2) - here.point(sum(here.kerbs) / 2)
    return replace(here, end=end, bearing=heading(chord))


def _cut(road: OpenDriveRoad, s: float, away: int) -> Approach | None:
    """A road's cross-section at s, looking along it (away = +1) or back (−1)."""
    section, found = road.sections[road.section_at(s)], []
    for lane, cut in road.cuts(section, np.array([s])).items():
        if (width := float(cut.width[0])) > 0.05:
            one = section.lanes[lane]
            inbound = one.onward != (away > 0)
            found.append((lane, one.kind, cut.middle[0, :2], width, inbound))
    carriageway = [x for x in found if x[1] in CARRIAGEWAY]
    if not carriageway:
        return None
    turn = float(road.line.at(s)[1])
    forward = away * np.array([np.cos(turn), np.sin(turn)])
    origin = carriageway[0][2]  # of the innermost, which tapers least
    return Approach.across(road.id, "", origin, forward, heading(forward), found)


def _paved(
    own: list[LaneStrip], approaches: list[Approach], corners: list[BaseGeometry]
) -> BaseGeometry:
    """The carriageway of one junction: its lanes and the gaps between them and the kerbs."""
    lanes = [s.polygon for s in own if s.kind in CARRIAGEWAY]
    # A line from kerb to kerb closes the gaps that medians leave at the mouths. A line across the
    # whole road closes the gaps beside the kerbs.
    mouths = [LineString([g.point(k) for k in g.kerbs]).buffer(0.02) for g in approaches]
    walls = [LineString([g.point(k) for k in g.edges]).buffer(0.02) for g in approaches]
    walls += [s.polygon for s in own if s.kind not in CARRIAGEWAY]
    everything = unary_union([*lanes, *mouths, *walls, *corners]).buffer(0.05)
    surface = unary_union([*lanes, *mouths, *_pockets(everything)])
    surface = surface.buffer(0.5).buffer(-0.5)
    surface = unary_union([surface, *_pockets(surface)])
    # Remove what is left of those lines across a median.
    return surface.buffer(-0.15, join_style="mitre").buffer(0.15, join_style="mitre")


def _pockets(shape: BaseGeometry) -> list[Polygon]:
    """The holes of a shape in which no circle of radius :data:`ISLAND` fits."""
    holes = [Polygon(ring) for part in shapely.get_parts(shape) for ring in part.interiors]
    return [hole.buffer(0.1) for hole in holes if hole.buffer(-ISLAND).is_empty]


def _corners(approaches: list[Approach], kinds: set[str]) -> Iterator[Polygon]:
    """Areas round the corners between neighbouring approaches that both have such lanes."""
    if len(approaches) < 2:
        return
    mouths = np.array([approach.point(sum(approach.kerbs) / 2) for approach in approaches])
    spokes = mouths - mouths.mean(0)
    order = np.argsort(np.arctan2(spokes[:, 1], spokes[:, 0]))
    for i, j in zip(order, np.roll(order, -1), strict=True):
        a, b = approaches[i].lane_range(kinds, +1), approaches[j].lane_range(kinds, -1)
        if a is None or b is None:
            continue
        inner, outer = (
            _bend(approaches[i], s, approaches[j], t) for s, t in zip(a, b, strict=True)
        )
        yield valid(Polygon(np.concatenate([inner, outer[::-1]])))


def _bend(a: Approach, s: float, b: Approach, t: float) -> np.ndarray:
    """A curve (N, 2) from one approach to another, tangent to both; straight if there is none."""
    start, end = a.point(s), b.point(t)
    inward = -np.array([[np.cos(g.outward), np.sin(g.outward)] for g in (a, b)])
    u = np.linspace(0, 1, 13)[:, None]
    straight = start + u * (end - start)
    if abs(np.linalg.det(inward)) < 0.2:
        return straight
    reach = np.linalg.solve(inward.T * [1, -1], end - start)  # to where the tangents meet
    if (reach < 0).any() or (reach > 2 * np.linalg.norm(end - start)).any():
        return straight
    control = start + reach[0] * inward[0]
    return (1 - u) ** 2 * start + 2 * u * (1 - u) * control + u**2 * end
