"""Reads SUMO networks and OpenStreetMap extracts: lanes, crossings, sidewalks and bodies."""

import html
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.sax import SAXException

import numpy as np
from jaxtyping import Float
from shapely.geometry import MultiPoint, Point, Polygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from inspe_jax.core.errors import InspeError, error_at, needs
from inspe_jax.core.files import cached_by_file
from inspe_jax.scene.georeference import Georeference
from inspe_jax.scene.intersection import BEYOND, Intersection
from inspe_jax.scene.lines import distance_from, distinct, resampled
from inspe_jax.scene.maps.bodies import with_bodies
from inspe_jax.scene.maps.lanes import Approach, LaneStrip, heading
from inspe_jax.scene.maps.openstreetmap.bodies import BodyReader
from inspe_jax.scene.maps.road_map import CLUSTER, MARGIN, Id, MapJunction, Node, RoadMap, valid
from inspe_jax.scene.maps.sumo.network import GEOGRAPHIC, OSM_SUFFIXES, SUMO, network_file
from inspe_jax.scene.regions import Region
from inspe_jax.scene.terrain import laid_on

NEAR_SPOTS = 20.0  # spot heights count as around a place if no road is so far out of their hull [m]
SPOTS = 3  # fewer points with a height make no surface
LONGEST = 1e5  # no lane is so long [m]
NO_JUNCTION = ("dead_end", "internal", "unregulated", "rail_signal", "rail_crossing")
MOTORS = {"passenger", "private", "taxi", "bus", "truck", "delivery", "hov", "evehicle"}


def kind_of(lane: Any) -> str:
    """What a lane is for, as a word of :mod:`inspe_jax.scene.maps.lanes`; '' for rails."""
    who = set(lane.getPermissions())
    if who & MOTORS:
        return "driving"
    if "pedestrian" in who:
        return "sidewalk"
    if "bicycle" in who:
        return "biking"
    return "" if who else "shoulder"


def _roads(edges: Iterable[Any]) -> list[Any]:
    """The edges with a lane for motor vehicles."""
    return [e for e in edges if any(kind_of(lane) == "driving" for lane in e.getLanes())]


def _is_junction(node: Any) -> bool:
    """Whether a node's roads lead to or come from more than two others."""
    beyond = {e.getToNode().getID() for e in _roads(node.getOutgoing())}
    beyond |= {e.getFromNode().getID() for e in _roads(node.getIncoming())}
    return node.getType() not in NO_JUNCTION and len(beyond - {node.getID()}) > 2


class SumoJunction(MapJunction):
    """Nodes of a network that are one junction, and the edges that begin or end there."""

    def __post_init__(self) -> None:
        of, members = self.map, self.members
        self.poles = np.zeros((0, 3))
        nodes = [of.net.getNode(name) for name in members]
        edges = {edge for node in nodes for edge in (*node.getIncoming(), *node.getOutgoing())}
        self.edges = dict(sorted((of.numbers[edge.getID()], edge) for edge in edges))
        self.interior = {
            number
            for number, edge in self.edges.items()
            if {edge.getFromNode().getID(), edge.getToNode().getID()} <= members
            and (edge.getFunction() or edge.getLength() <= 2 * CLUSTER)
        }
        self.approaches = [  # the near ends of the edges that lead to or from it
            _approach(of, number, edge, end)
            for number, edge in self.edges.items()
            if number not in self.interior and not edge.getFunction() and _roads([edge])
            for end, node in (("end", edge.getToNode()), ("start", edge.getFromNode()))
            if node.getID() in members
        ]

    def lanes(self) -> tuple[list[LaneStrip], list[bool]]:
        strips = self.map.lane_strips.values()
        away = [(s, distance_from(s.center, self.middle).min()) for s in strips]
        near = [(s, far) for s, far in away if far <= self.radius + MARGIN]
        own = {s.road for s, far in near if far <= CLUSTER} | self.interior
        return [s for s, _ in near], [s.road in own for s, _ in near]

    def areas(self, lane_strips: list[LaneStrip]) -> dict[Region, list[BaseGeometry]]:
        middle = self.middle
        reach = max(float(distance_from(s.center, middle).max()) for s in lane_strips)
        ground = np.concatenate([s.center for s in lane_strips])
        corners = {n for n, _ in self.map.walks}
        at = Point(middle[:2])
        waiting = [shape for _, shape in self.map.walks if shape.distance(at) <= reach]
        parts: dict[Region, list[BaseGeometry]] = {region: [] for region in Region}
        parts[Region.SIDEWALK] += waiting
        walked = unary_union(waiting)
        for node in self.map.net.getNodes():
            at, outline = self.map.position(node.getID()), self.map.to_world(node.getShape())
            if len(outline) < 3 or distance_from(at[None], middle)[0] > reach + CLUSTER:
                continue
            closest = ground[np.argmin(distance_from(ground, at))]
            if abs(at[2] - closest[2]) <= 2.0:
                shape = valid(Polygon(outline[:, :2]))
                if node.getID() in corners:  # its outline encloses where people wait, too
                    shape = shape.difference(walked)
                own = node.getID() in self.members
                parts[Region.JUNCTION if own else Region.DRIVEWAY].append(shape)
        for strip in lane_strips:
            if (region := self.region_of(strip)) is not None:
                parts[region].append(strip.polygon)
        return parts

    def with_bodies(self, place: Intersection, lane_strips: list[LaneStrip]) -> Intersection:
        place = replace(place, driving_side=self.map.side)
        if place.georeference is None or not str(self.map.path).lower().endswith(OSM_SUFFIXES):
            return place
        reach = self.radius + MARGIN
        reader = BodyReader(self.map.path, place, reach, self.notes)
        place = self._on_heights(place, reader.spot_heights())
        return with_bodies(place, reader.shapes(), reach, self.notes)

    def _on_heights(self, place: Intersection, spots: Float[np.ndarray, "N 3"]) -> Intersection:
        """A place on ground through spot heights, if they lie around its roads."""
        if (count := len(spots)) < SPOTS:
            return place
        near = Point(place.center[:2]).buffer(self.radius)
        roads = unary_union(list(place.regions.values())).intersection(near)
        if not MultiPoint(spots[:, :2]).convex_hull.buffer(NEAR_SPOTS).covers(roads):
            self.notes.append(f"the map's {count} points with a height do not lie around it: level")
            return place
        self.notes.append(f"heights of the ground between {count} points of the map with a height")
        return laid_on(place, spots, self.radius)


class SumoMap(RoadMap):
    """A SUMO network, or an OpenStreetMap extract by the network that netconvert makes of it.

    ``file`` is what SUMO can run on, ``net`` sumolib's. World coordinates are the network's less
    ``shift`` [m], those of the map that it was made from, but for geographic projections, whose
    coordinates are millions of metres. ``side`` is what traffic of an extract was asked to drive
    on. Every lane is a strip by the network's name: ``road`` is the number of its edge,
    ``junction`` is 1 inside any junction, else −1. ``walks`` are nodes with their walking areas.
    """

    format, around = SUMO, SumoJunction

    def __init__(
        self, path: Path, file: Path, net: Any, side: str | None, notes: list[str]
    ) -> None:
        self.path, self.file, self.net, self.side, self.notes = path, file, net, side, notes
        self.name = path.name.split(".")[0]
        moved = np.array(net.getLocationOffset(), float)
        self.shift = moved if np.abs(moved).max() <= GEOGRAPHIC else np.zeros(2)
        self.georeference = None
        if net.hasGeoProj():
            x, y = moved - self.shift
            self.georeference = Georeference(net._location["projParameter"], (float(x), float(y)))
        self.lane_strips: dict[str, LaneStrip] = {}
        self.follows: dict[str, list[str]] = {}
        self.leads: dict[str, list[str]] = {}
        self.walks: list[tuple[str, BaseGeometry]] = []
        self.crossings: list[np.ndarray] = []
        self.walked: list[np.ndarray] = []
        self.edges = net.getEdges(withInternal=True)
        self.numbers = {edge.getID(): number for number, edge in enumerate(self.edges)}
        for edge in self.edges:
            for lane in edge.getLanes():
                self._add(edge, lane)
        for lane, after in self.follows.items():
            self.follows[lane] = [other for other in after if other in self.lane_strips]
            for other in self.follows[lane]:
                self.leads.setdefault(other, []).append(lane)

    def _add(self, edge: Any, lane: Any) -> None:
        line, use = distinct(self.to_world(lane.getShape3D())), edge.getFunction()
        if use == "walkingarea" and len(line) > 2:
            self.walks.append((edge.getFromNode().getID(), valid(Polygon(line[:, :2]))))
        if use == "walkingarea" or len(line) < 2:
            return
        if (length := np.hypot(*np.diff(line[:, :2], axis=0).T).sum()) > LONGEST:
            long = f"lane '{lane.getID()}' is {length / 1000:,.0f} km long"
            raise InspeError(f"{self.path}: {long}; mend the coordinates of its nodes")
        center = resampled(line)
        ahead = np.gradient(center[:, :2], axis=0)
        ahead /= np.hypot(*ahead.T)[:, None]
        number, inside, kind = self.numbers[edge.getID()], 1 if use else -1, kind_of(lane)
        strip = LaneStrip.along(number, inside, kind, center, ahead, lane.getWidth())
        if use == "crossing":
            self.crossings.append(np.concatenate([strip.left, strip.right[::-1]]))
            ends = line[[0, -1], :2] + [-BEYOND * ahead[0], BEYOND * ahead[-1]]
            self.walked.append(resampled(np.vstack([ends[0], line[:, :2], ends[1]])))
        elif kind:
            self.lane_strips[lane.getID()] = strip
            after = (link.getViaLaneID() or link.getToLane().getID() for link in lane.getOutgoing())
            self.follows[lane.getID()] = [*after]

    def to_world(self, points: Any) -> np.ndarray:
        """Points (N, 2 or 3) of the network in world coordinates (N, 3); height 0 if not given."""
        at = np.array([(*p, 0.0)[:3] for p in points], float).reshape(-1, 3)
        return at - [*self.shift, 0.0]

    def position(self, name: Id) -> Float[np.ndarray, "3"]:
        """The position of a node [m]."""
        return self.to_world([self.net.getNode(name).getCoord3D()])[0]

    def strip(self, lane: str) -> LaneStrip:
        return self.lane_strips[lane]

    def lane_at(self, approach: Approach, lane: int) -> str:
        return str(self.edges[int(approach.road)].getLane(lane).getID())

    def street(self, approach: Approach) -> str:
        name = self.edges[int(approach.road)].getName() or ""
        return html.unescape(name)  # netconvert escapes it twice

    def road_lines(self) -> list[Float[np.ndarray, "N 2"]]:
        return [self.to_world(edge.getShape())[:, :2] for edge in _roads(self.net.getEdges())]

    def junctions(self) -> list[Id]:
        return [node.getID() for node in self.net.getNodes() if _is_junction(node)]

    def node(self, junction: Id) -> Node:
        node = self.net.getNode(junction)
        middle = self.position(junction)
        outline = self.to_world(node.getShape())[:, :2]
        if len(outline) > 2:
            middle[:2] = (outline.min(0) + outline.max(0)) / 2
        size = float(np.ptp(outline, axis=0).max()) if len(outline) else 0.0
        lit = node.getType().startswith("traffic_light")
        signals = sum(not e.getFunction() for e in _roads(node.getIncoming())) if lit else 0
        return Node(middle, size, signals)


@cached_by_file(8)
def load_net(path: Path, side: str | None = None) -> SumoMap:
    """The network of a .net.xml, .osm or .xodr file, cached. Traffic of an extract drives on a
    ``side``, or by its country. Raises InspeError if SUMO is missing, or the file is missing or no
    such map."""
    with needs("SUMO networks and OpenStreetMap need sumolib", "sumo"):
        import sumolib
    file, notes = network_file(path, side)
    wrong = f"{path}: not a SUMO network: missing or wrong"
    how = dict(withInternal=True, withPedestrianConnections=True, lxml=False)
    with error_at(wrong, SAXException, KeyError, ValueError, AttributeError, TypeError):
        net = sumolib.net.readNet(str(file), **how)
    if not any(edge.getFunction() == "" for edge in net.getEdges()):
        raise InspeError(f"{path}: the network has no roads")
    return SumoMap(path, file, net, side, notes)


def _approach(streets: SumoMap, number: int, edge: Any, end: str) -> Approach:
    step = 1 if end == "start" else -1  # along the lane's stations, away from the junction
    lanes = [(lane, streets.lane_strips.get(lane.getID())) for lane in edge.getLanes()]
    lane_strips = [(lane, strip) for lane, strip in lanes if strip is not None]
    guide = next(s for _, s in lane_strips if s.kind == "driving").center[::step, :2]
    origin, outward = guide[0], guide[min(2, len(guide) - 1)] - guide[0]
    outward = outward / np.hypot(*outward)
    chord = guide[min(15, len(guide) - 1)] - guide[0]
    cut = [
        (lane.getIndex(), strip.kind, strip.center[::step][0, :2], lane.getWidth(), end == "end")
        for lane, strip in lane_strips
    ]
    return Approach.across(number, end, origin, outward, heading(chord), cut)
