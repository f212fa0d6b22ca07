"""Reads OpenDRIVE maps with the CARLA client's ``carla.Map``, which needs no server."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float
from shapely.geometry import LineString, Point, Polygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from inspe_jax.core.errors import InspeError, needs
from inspe_jax.core.files import cached_by_file
from inspe_jax.scene.intersection import Intersection, Route
from inspe_jax.scene.lines import distance_from, resampled
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
from inspe_jax.scene.maps.opendrive.objects import PARKING, shapes_of, with_parked
from inspe_jax.scene.maps.opendrive.road_network import (
    INSET,
    OpenDriveRoad,
    distinct_points,
    heading_of,
    loops_of,
    position,
    projection_of,
    quiet,
    read_roads,
)
from inspe_jax.scene.maps.road_map import (
    CLUSTER,
    MARGIN,
    STEP,
    Id,
    MapJunction,
    Node,
    RoadMap,
    valid,
)
from inspe_jax.scene.regions import Region

TRAFFIC_LIGHT = "1000001"  # CARLA's type of landmark
ISLAND = 3.0  # a gap between a junction's lanes is paved unless such a circle fits in it [m]
COARSE = 5.0  # spacing of the points of a map's road lines [m]
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
            for start, end, lanes in road.sections if road.near(self.middle, reach) else ():
                for lane, kind in lanes.items():
                    line = self.map.along(road.id, lane, start, end, STEP)
                    width = np.array([w.lane_width for w in line])
                    if len(line) < 2 or width.max() < 0.05:
                        continue
                    center = np.array([position(w.transform.location) for w in line])
                    ahead = np.array([heading_of(w) for w in line])
                    strip = LaneStrip.along(road.id, road.junction, kind, center, ahead, width)
                    # One lane's width farther: the disc cuts the lane, and not its stations.
                    away = distance_from(center, self.middle)
                    found += strip.runs(away <= reach + width.max() + STEP)
        return found, [s.junction in self.members or s.road in self.interior for s in found]

    def areas(self, lane_strips: list[LaneStrip]) -> dict[Region, list[BaseGeometry]]:
        parts: dict[Region, list[BaseGeometry]] = {region: [] for region in Region}
        drawn = False
        for number in sorted({s.junction for s in lane_strips} - {-1}):
            strips = [s for s in lane_strips if s.junction == number]
            approaches = approaches_of(self.map, {number})
            corners: list[Polygon] = []
            if not any(s.kind in SHOULDER | SIDEWALK for s in strips):
                for side, kinds in ((Region.SHOULDER, SHOULDER), (Region.SIDEWALK, SIDEWALK)):
                    parts[side] += (found := list(_corners(approaches, kinds)))
                    corners += found
            drawn |= number in self.members and bool(corners)
            paved = _paved(strips, approaches, corners)
            parts[Region.JUNCTION if number in self.members else Region.DRIVEWAY].append(paved)
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
        self.notes += self.map.notes
        place = with_bodies(place, [s for s in shapes if s.kind != PARKING], reach, self.notes)
        lanes = [strip for strip in lane_strips if strip.kind == "parking"]
        spaces = [shape.area for shape in shapes if shape.kind == PARKING]
        return with_parked(place, lanes, spaces, reach, self.notes)

    def drives(self, arm_of: dict[tuple[int, str], int]) -> Iterator[Route]:
        town, approaches = self.map, self.approaches
        inside = {r.id for r in town.roads.values() if r.junction in self.members} | self.interior
        # By position, not by road, because a step may skip a road that is a stub.
        cuts = [LineString([approach.point(k) for k in approach.kerbs]) for approach in approaches]

        def leads_to(waypoint: Any) -> int:
            """The arm at whose mouth a waypoint is; −1 if it is at none."""
            away = shapely.distance(cuts, Point(position(waypoint.transform.location)[:2]))
            best = approaches[int(np.argmin(away))]
            return arm_of[best.road, best.end] if away.min() < 2 * STEP else -1

        for approach in approaches:
            at = INSET if approach.end == "start" else town.roads[approach.road].length - INSET
            for lane, kind, _, _, inbound in approach.lanes:
                if kind not in TRAVEL or not inbound:
                    continue
                mouth = town.at(approach.road, lane, at)
                upstream = self._follow(mouth, "previous")[::-1]
                for path in _lane_paths(mouth, inside):
                    entry_arm, exit_arm = arm_of[approach.road, approach.end], leads_to(path[-1])
                    if exit_arm in (entry_arm, -1):
                        continue
                    line = [*upstream, *path, *self._follow(path[-1], "next")]
                    points = resampled(np.array([position(w.transform.location) for w in line]))
                    yield Route(points, mouth.lane_width, "vehicle", (entry_arm, exit_arm))

    def _follow(self, start: Any, direction: str) -> list[Any]:
        """Waypoints from a lane on ('next') or back ('previous') to the radius, straight on."""
        line, here = list[Any](), start
        for _ in range(int(4 * self.radius / STEP)):  # four radii on a winding road
            options = getattr(here, direction)(STEP)
            at = position(here.transform.location)[None]
            if not options or distance_from(at, self.middle)[0] > self.radius:
                break
            heading = heading_of(here)
            here = max(options, key=lambda w: float(heading_of(w) @ heading))
            line.append(here)
        return line


class OpenDriveMap(RoadMap):
    """An OpenDRIVE file: CARLA's map, and what its XML adds.

    ``notes`` are on the ``shapes`` of its objects and on its projection. Raises InspeError if the
    CARLA client is missing, or if the file is not OpenDRIVE.
    """

    format, around = "(OpenDRIVE)", OpenDriveJunction

    def __init__(self, path: Path) -> None:
        self.path, self.name = path, path.stem
        text, root, self.roads = read_roads(path)
        where = "Linux and Windows, Python up to 3.12"
        with needs("reading OpenDRIVE needs the CARLA client", "opendrive", where):
            import carla
        try:
            with quiet():
                self.carla = carla.Map(path.stem, text)
                corners = [position(c) for c in self.carla.get_crosswalks()]
                marks = [m for m in self.carla.get_all_landmarks() if m.type == TRAFFIC_LIGHT]
        except (RuntimeError, IndexError) as error:
            raise InspeError(f"{path}: the CARLA client cannot read this map ({error})") from error
        self.signals = distinct_points([position(m.transform.location) for m in marks])
        self.crossings = tuple(loops_of(corners))
        self.shapes, notes = shapes_of(root)
        self.georeference, on_it = projection_of(root)
        self.notes = (*notes, *on_it)

    def at(self, road: int, lane: int, s: float) -> Any:
        """CARLA's waypoint in the middle of a lane, s [m] along the road; None beyond its ends."""
        return self.carla.get_waypoint_xodr(road, lane, s)

    def along(self, road: int, lane: int, start: float, end: float, spacing: float) -> list[Any]:
        """CARLA's waypoints along a lane from one s to another, about ``spacing`` [m] apart."""
        inset, count = min(INSET, (end - start) / 4), int(np.ceil((end - start) / spacing)) + 1
        stations = np.linspace(start + inset, end - inset, max(2, count)).tolist()
        return [w for s in stations if (w := self.at(road, lane, s)) is not None]

    def road_lines(self) -> list[Float[np.ndarray, "N 2"]]:
        found = []  # the middle of a driving lane of each
        for road in self.roads.values():
            for start, end, lanes in road.sections:
                lane = next((name for name, kind in lanes.items() if kind == "driving"), 0)
                marks = self.along(road.id, lane, start, end, COARSE) if lane else []
                if len(marks) > 1:
                    found.append(np.array([position(m.transform.location)[:2] for m in marks]))
        return found

    def junctions(self) -> list[Id]:
        return sorted({road.junction for road in self.roads.values()} - {-1})

    def node(self, junction: Id) -> Node:
        for road in self.roads.values():
            for lane in road.sections[0][2] if road.junction == junction else ():
                waypoint = self.at(road.id, lane, road.length / 2)
                if waypoint is not None and waypoint.get_junction() is not None:
                    box = waypoint.get_junction().bounding_box
                    middle, size = position(box.location), 2 * max(box.extent.x, box.extent.y)
                    signals = distance_from(self.signals, middle) < size / 2 + 15.0
                    return Node(middle, size, int(signals.sum()))
        raise InspeError(f"{self.source}: junction {junction} has no lanes")


@cached_by_file(8)
def load_map(path: Path) -> OpenDriveMap:
    """The map of a file, cached while it does not change. Raises as :class:`OpenDriveMap`."""
    return OpenDriveMap(path)


def _lane_paths(mouth: Any, inside: set[int]) -> Iterator[list[Any]]:
    """All paths of waypoints from a mouth through the junction to the first one beyond it."""
    stack = [([mouth], frozenset[tuple[int, int]]())]
    while stack:
        path, seen = stack.pop()
        here = path[-1]
        for step in here.next(STEP):
            lane = (step.road_id, step.lane_id)
            if step.road_id not in inside:
                if here.road_id in inside:
                    yield [*path, step]
                elif len(path) < 5:  # still on the approach
                    stack.append(([*path, step], seen))
            elif lane == (here.road_id, here.lane_id):
                stack.append(([*path, step], seen))
            elif lane not in seen:  # at most once round a roundabout
                stack.append(([*path, step], seen | {lane}))


def interior_of(town: OpenDriveMap, members: set[int]) -> set[int]:
    """Roads of short chains from one member junction to another, as the ring of a roundabout."""
    found: set[int] = set()
    for first in town.roads.values():
        chain, ends, todo = set[int](), set[int](), [first.id]
        while todo and first.junction == -1 and len(members) > 1:
            road = town.roads[todo.pop()]
            chain.add(road.id)
            ends |= {link[1] for link in road.links.values() if link[0] == "junction"}
            following = {link[1] for link in road.links.values() if link[0] == "road"}
            todo += following & town.roads.keys() - chain
        length = sum(town.roads[road].length for road in chain)
        if len(ends) > 1 and ends <= members and length <= 2 * CLUSTER:
            found |= chain
    return found


def approaches_of(town: OpenDriveMap, members: set[int]) -> list[Approach]:
    """The approaches: ends of the roads that the members' connecting roads lead from and to."""
    inside = interior_of(town, members)
    touched = {
        _beyond(town, link[1], link[2])
        for road in town.roads.values()
        if road.junction in members
        for link in road.links.values()
        if link[0] == "road" and link[1] in town.roads and link[1] not in inside
        if town.roads[link[1]].junction not in members
    }
    approaches = [_approach(town, town.roads[road], end) for road, end in sorted(touched)]
    return [approach for approach in approaches if approach is not None]


def _beyond(town: OpenDriveMap, road: int, end: str) -> tuple[int, str]:
    """The road end itself; if the road is a stub, the next end. Maps have stubs of 0.01 mm."""
    here, other = town.roads[road], "end" if end == "start" else "start"
    kind, following, contact = here.links.get(other, ("", -1, ""))
    if here.length < 1.0 and kind == "road" and following in town.roads:
        return following, contact
    return road, end


def _approach(town: OpenDriveMap, road: OpenDriveRoad, end: str) -> Approach | None:
    away = 1 if end == "start" else -1
    at = INSET if end == "start" else road.length - INSET
    here = _cut(town, road, at, away)
    there = _cut(town, road, at + away * min(15.0, road.length - 2 * INSET), away)
    if here is None or there is None:
        return None
    chord = there.point(sum(there.kerbs) / 2) - here.point(sum(here.kerbs) / 2)
    return replace(here, end=end, bearing=heading(chord))


def _cut(town: OpenDriveMap, road: OpenDriveRoad, s: float, away: int) -> Approach | None:
    """A road's cross-section at s, looking along it (away = +1) or back (−1)."""
    lanes = next((lanes for a, b, lanes in road.sections if a <= s <= b), {})
    found = [(lane, kind, town.at(road.id, lane, s)) for lane, kind in lanes.items()]
    found = [x for x in found if x[2] is not None and x[2].lane_width > 0.05]
    carriageway = [x for x in found if x[1] in CARRIAGEWAY]
    if not carriageway:
        return None
    lane, _, guide = min(carriageway, key=lambda x: abs(x[0]))  # the innermost tapers least
    origin = position(guide.transform.location)[:2]
    # CARLA's headings follow traffic; the road's own direction is that of growing s.
    step = min(0.5, road.length / 4) * (1 if s < road.length / 2 else -1)
    ahead = position(town.at(road.id, lane, s + step).transform.location)[:2]
    forward = heading_of(guide)
    if forward @ (ahead - origin) * away * step < 0:
        forward = -forward
    cut = [
        (lane, kind, position(w.transform.location)[:2], w.lane_width,
         bool(forward @ heading_of(w) < 0))
        for lane, kind, w in found
    ]  # fmt: skip
    return Approach.across(road.id, "", origin, forward, heading(forward), cut)


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
