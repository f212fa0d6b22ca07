"""Reads SUMO networks and OpenStreetMap extracts: lanes, crossings, sidewalks and bodies."""

import os
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from shapely.geometry import MultiPoint, Point, Polygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from inspe_jax.core.errors import InspeError
from inspe_jax.scene.georeference import Georeference
from inspe_jax.scene.intersection import Intersection, Route
from inspe_jax.scene.lines import distinct, resampled
from inspe_jax.scene.maps.approaches import CARRIAGEWAY, Approach, arms_of
from inspe_jax.scene.maps.assembly import assembled, side_by_side
from inspe_jax.scene.maps.bodies import NO_POLES, with_bodies
from inspe_jax.scene.maps.lane_strips import LaneStrip, same_level
from inspe_jax.scene.maps.openstreetmap.bodies import BodyReader, extract_about, spot_heights
from inspe_jax.scene.maps.parts import (
    CLUSTER,
    MARGIN,
    RADIUS_READ,
    JunctionInfo,
    distance_from,
    junctions_at,
    valid,
)
from inspe_jax.scene.maps.sumo.lanes import Streets, kind_of, streets_of
from inspe_jax.scene.maps.sumo.network import OSM_SUFFIXES, SUMO, load_net
from inspe_jax.scene.regions import Region
from inspe_jax.scene.terrain import laid_on
from inspe_jax.scene.voxels import check_range

NEAR_SPOTS = 20.0
"""Spot heights count as around a place if no road is so far out of their hull [m]."""
SPOTS = 3
"""Fewer points with a height make no surface."""
NO_JUNCTION = ("dead_end", "internal", "unregulated", "rail_signal", "rail_crossing")


def _roads(edges: Iterable[Any]) -> list[Any]:
    """The edges with a lane for motor vehicles."""
    return [e for e in edges if any(kind_of(lane) == "driving" for lane in e.getLanes())]


def _arm_count(node: Any) -> int:
    """Number of other nodes that a node's roads lead to or come from."""
    beyond = {e.getToNode().getID() for e in _roads(node.getOutgoing())}
    beyond |= {e.getFromNode().getID() for e in _roads(node.getIncoming())}
    return len(beyond - {node.getID()})


def _is_junction(node: Any) -> bool:
    return node.getType() not in NO_JUNCTION and _arm_count(node) > 2


def list_junctions(path: str | os.PathLike[str]) -> tuple[JunctionInfo, ...]:
    """The junctions of a SUMO network or OpenStreetMap extract: nodes where 3 or more roads meet.

    Raises InspeError as :func:`read_sumo`.
    """
    streets = streets_of(load_net(Path(path)))
    middles = np.array([loop.mean(0) for loop in streets.crossings]).reshape(-1, 3)
    found = []
    for node in streets.road.net.getNodes():
        if not _is_junction(node):
            continue
        x, y, z = (float(v) for v in _middle(streets, node.getID()))
        outline = streets.road.to_world(node.getShape())[:, :2].reshape(-1, 2)
        size = float(np.ptp(outline, axis=0).max()) if len(outline) else 0.0
        arms, _ = arms_of(_Junction(streets, {node.getID()}).approaches())
        near = int((distance_from(middles, np.array([x, y])) < size / 2 + 8.0).sum())
        lit = node.getType().startswith("traffic_light")
        lights = sum(not e.getFunction() for e in _roads(node.getIncoming())) if lit else 0
        found.append(JunctionInfo(node.getID(), (x, y, z), len(arms), size, near, lights))
    return tuple(found)


def georeference_of(path: str | os.PathLike[str]) -> Georeference | None:
    """The projection of a network's coordinates; None if it names none.

    Raises InspeError as :func:`read_sumo`.
    """
    return load_net(Path(path)).georeference


def road_lines(path: str | os.PathLike[str]) -> list[Float[np.ndarray, "N 2"]]:
    """The lines of a network's roads [m]. Raises InspeError as :func:`read_sumo`."""
    road = load_net(Path(path))
    return [road.to_world(edge.getShape())[:, :2] for edge in _roads(road.net.getEdges())]


def read_sumo(
    path: str | os.PathLike[str],
    *,
    junction: str | int | None = None,
    center: tuple[float, float] | None = None,
    radius: float = 50.0,
) -> Intersection:
    """One junction of a network or extract: :func:`~inspe_jax.scene.maps.registry.read_map`."""
    streets = streets_of(load_net(Path(path)))
    road = streets.road
    nodes = [node.getID() for node in road.net.getNodes() if _is_junction(node)]
    members, middle, place = junctions_at(
        road.source, nodes, partial(_middle, streets), junction, center
    )
    check_range("radius", radius, RADIUS_READ)
    reach = radius + MARGIN
    near = [
        s for s in streets.lane_strips.values() if distance_from(s.center, middle).min() <= reach
    ]
    here = _Junction(streets, members)
    own = {s.road for s in near if distance_from(s.center, middle).min() <= CLUSTER}
    lane_strips = same_level(near, [s.road in own or s.road in here.interior for s in near])
    if not lane_strips:
        raise InspeError(
            f"{road.source}: no roads within {radius:g} m of ({middle[0]:.1f}, {middle[1]:.1f})"
        )
    approaches = here.approaches()
    arms, arm_of = arms_of(approaches)
    notes: list[str] = []
    found = assembled(
        name=f"{road.name} {place}",
        source=f"{road.source} {SUMO}",
        path=Path(path),
        georeference=road.georeference,
        middle=middle,
        radius=radius,
        lane_strips=lane_strips,
        areas=here.areas(lane_strips, middle),
        arms=arms,
        drives=here.routes(approaches, arm_of, middle, radius),
        loops=streets.crossings,
        poles=np.zeros((0, 3)),
        notes=notes,
    )
    if road.georeference is not None and str(path).lower().endswith(OSM_SUFFIXES):
        where = middle[:2], reach, road.georeference
        extract = extract_about(Path(path), *where)
        found = _on_heights(found, spot_heights(extract, road.georeference), radius, notes)
        found = with_bodies(found, BodyReader(extract, *where, notes).shapes(), reach, notes)
    if not len(found.poles):
        notes.append(NO_POLES)
    return replace(found, notes=tuple(notes))


def _on_heights(
    place: Intersection, spots: Float[np.ndarray, "N 3"], radius: float, notes: list[str]
) -> Intersection:
    """A place on ground through spot heights, if they lie around its roads."""
    if len(spots) < SPOTS:
        return place
    roads = unary_union(list(place.regions.values())).intersection(
        Point(place.center[:2]).buffer(radius)
    )
    if not MultiPoint(spots[:, :2]).convex_hull.buffer(NEAR_SPOTS).covers(roads):
        notes.append(f"the map's {len(spots)} points with a height do not lie around it: level")
        return place
    notes.append(f"heights of the ground between {len(spots)} points of the map with a height")
    return laid_on(place, spots, radius)


def _middle(streets: Streets, name: str) -> np.ndarray:
    """The middle of a node's outline (3,); the node's own position if it has no outline."""
    middle = streets.node(name)
    outline = streets.road.to_world(streets.road.net.getNode(name).getShape())
    if len(outline) > 2:
        middle[:2] = (outline.min(0) + outline.max(0))[:2] / 2
    return middle


class _Junction:
    """Nodes of a network that are one junction, and the edges that begin or end there."""

    def __init__(self, streets: Streets, members: set[str]) -> None:
        nodes = [streets.road.net.getNode(name) for name in members]
        edges = {edge for node in nodes for edge in (*node.getIncoming(), *node.getOutgoing())}
        self.streets, self.members = streets, members
        self.edges = dict(sorted((streets.numbers[edge.getID()], edge) for edge in edges))
        self.interior = {
            number
            for number, edge in self.edges.items()
            if {edge.getFromNode().getID(), edge.getToNode().getID()} <= members
            and (edge.getFunction() or edge.getLength() <= 2 * CLUSTER)
        }
        """Numbers of the edges inside the junction, or from one of its nodes to another."""

    def approaches(self) -> list[Approach]:
        """The near ends of the edges that lead to or from the junction."""
        return [
            _approach(self.streets, number, edge, end)
            for number, edge in self.edges.items()
            if number not in self.interior and not edge.getFunction() and _roads([edge])
            for end, node in (("end", edge.getToNode()), ("start", edge.getFromNode()))
            if node.getID() in self.members
        ]

    def areas(
        self, lane_strips: list[LaneStrip], middle: Float[np.ndarray, "3"]
    ) -> dict[Region, BaseGeometry]:
        """Junction, driveway, shoulder and sidewalk, which do not overlap."""
        reach = max(float(distance_from(s.center, middle).max()) for s in lane_strips)
        ground = np.concatenate([s.center for s in lane_strips])
        corners = {n for n, _ in self.streets.walks}
        waiting = [
            shape for _, shape in self.streets.walks if shape.distance(Point(middle[:2])) <= reach
        ]
        parts: dict[Region, list[BaseGeometry]] = {region: [] for region in Region}
        parts[Region.SIDEWALK] += waiting
        walked = unary_union(waiting)
        for node in self.streets.road.net.getNodes():
            at = self.streets.node(node.getID())
            closest = ground[np.argmin(distance_from(ground, at))]
            outline = self.streets.road.to_world(node.getShape())
            near = distance_from(at[None], middle)[0] <= reach + CLUSTER
            if len(outline) > 2 and near and abs(at[2] - closest[2]) <= 2.0:
                shape = valid(Polygon(outline[:, :2]))
                if node.getID() in corners:  # its outline encloses where people wait, too
                    shape = shape.difference(walked)
                own = node.getID() in self.members
                parts[Region.JUNCTION if own else Region.DRIVEWAY].append(shape)
        for strip in lane_strips:
            if strip.kind in CARRIAGEWAY:
                region = Region.JUNCTION if strip.road in self.interior else Region.DRIVEWAY
            else:
                region = Region.SHOULDER if strip.kind == "shoulder" else Region.SIDEWALK
            parts[region].append(strip.polygon)
        return side_by_side(parts)

    def routes(
        self,
        approaches: list[Approach],
        arm_of: dict[tuple[int, str], int],
        middle: np.ndarray,
        radius: float,
    ) -> Iterator[Route]:
        """Every path from an inbound lane to another arm, from radius to radius; no U-turns."""
        strips = self.streets.lane_strips
        for road in (approach.road for approach in approaches if approach.end == "end"):
            arm = arm_of[road, "end"]
            for lane in self.edges[road].getLanes():
                name = lane.getID()
                if name not in strips or strips[name].kind != "driving":
                    continue
                before = _follow(self.streets, name, -1, middle, radius)
                for path in self._paths(name):
                    exit_arm = arm_of.get((strips[path[-1]].road, "start"), -1)
                    if exit_arm in (arm, -1):
                        continue
                    names = [*before, *path, *_follow(self.streets, path[-1], 1, middle, radius)]
                    line = distinct(np.concatenate([strips[n].center for n in names]))
                    at = distance_from(line, strips[name].center[-1]).argmin()
                    line = _about(line, at, middle, radius)
                    if len(line) > 1:
                        yield Route(resampled(line), lane.getWidth(), "vehicle", (arm, exit_arm))

    def _paths(self, start: str) -> Iterator[list[str]]:
        """All sequences of lanes from an inbound lane through the junction to one beyond."""
        stack = [[start]]
        while stack:
            path = stack.pop()
            for lane in self.streets.follows[path[-1]]:
                strip = self.streets.lane_strips[lane]
                if strip.kind != "driving" or lane in path:  # at most once round a roundabout
                    continue
                if strip.road in self.interior:
                    stack.append([*path, lane])
                else:
                    yield [*path, lane]


def _approach(streets: Streets, number: int, edge: Any, end: str) -> Approach:
    """The approach of one edge, cut where it meets the junction."""
    step = 1 if end == "start" else -1  # along the lane's stations, away from the junction
    lanes = [(lane, streets.lane_strips.get(lane.getID())) for lane in edge.getLanes()]
    lane_strips = [(lane, strip) for lane, strip in lanes if strip is not None]
    guide = next(s for _, s in lane_strips if s.kind == "driving").center[::step, :2]
    origin, outward = guide[0], guide[min(2, len(guide) - 1)] - guide[0]
    outward = outward / np.hypot(*outward)
    left = np.array([-outward[1], outward[0]])
    cut = []
    for lane, strip in lane_strips:
        offset = float((strip.center[::step][0, :2] - origin) @ left)
        half = lane.getWidth() / 2
        cut.append((lane.getIndex(), strip.kind, offset - half, offset + half, end == "end"))
    chord = guide[min(15, len(guide) - 1)] - guide[0]
    return Approach(
        number,
        end,
        origin,
        float(np.arctan2(outward[1], outward[0])),
        float(np.arctan2(chord[1], chord[0])),
        tuple(cut),
    )


def _follow(
    streets: Streets, start: str, direction: int, middle: np.ndarray, radius: float
) -> list[str]:
    """Lanes from ``start`` on (1) or back (−1) to the radius, in travel order; straight on."""
    found: list[str] = []
    here = start
    for _ in range(50):
        end = streets.lane_strips[here].center[-1 if direction > 0 else 0]
        options = (streets.follows if direction > 0 else streets.leads).get(here, [])
        options = [o for o in options if streets.lane_strips[o].kind == "driving"]
        options = [o for o in options if o not in found]
        if not options or distance_from(end[None], middle)[0] > radius:
            break

        def turn(lane: str, here: str = here) -> float:
            a, b = (streets.lane_strips[n].center[:, :2] for n in (here, lane))
            ends = (-1, -2) if direction > 0 else (1, 0)
            one, two = (line[ends[0]] - line[ends[1]] for line in (a, b))
            return float(one @ two / np.hypot(*one) / np.hypot(*two))

        here = max(options, key=turn)
        found.append(here)
    return found if direction > 0 else found[::-1]


def _about(line: np.ndarray, at: int | np.intp, middle: np.ndarray, radius: float) -> np.ndarray:
    """The points of a line around index ``at`` up to where it leaves the radius."""
    outside = np.flatnonzero(distance_from(line, middle) > radius)
    first = outside[outside < at].max(initial=-1) + 1
    last = outside[outside > at].min(initial=len(line))
    return line[first:last]
