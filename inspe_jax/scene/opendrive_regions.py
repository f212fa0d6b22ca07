"""Where the roads of an OpenDRIVE map meet: legs, arms and the five regions."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import shapely
from jaxtyping import Float
from scipy.spatial import cKDTree
from shapely.geometry import LineString, MultiPolygon, Point, Polygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from inspe_jax.scene.intersection import Arm, corner_islands, mouth_crosswalks
from inspe_jax.scene.opendrive_map import (
    CARRIAGEWAY,
    INSET,
    SHOULDER,
    SIDEWALK,
    TRAVEL,
    Road,
    Strip,
    TownMap,
    heading_of,
    position,
)
from inspe_jax.scene.regions import Region

ISLAND = 3.0
"""A gap between a junction's lanes is paved unless a circle of this radius fits in it [m]."""
CLUSTER = 35.0
"""Around ``center``, junctions whose middle is this near count as one [m]."""


@dataclass(frozen=True, eq=False)
class Leg:
    """The end of a road at the junction, cut across; offsets run left, looking outward."""

    road: int
    end: str  # 'start' or 'end' of the road
    origin: Float[np.ndarray, "2"]
    outward: float  # heading away from the junction at the cut
    bearing: float  # the same over the first 15 m, which a flare does not turn
    lanes: tuple[tuple[int, str, float, float, bool], ...]  # id, type, from, to, inbound

    def point(self, offset: float) -> np.ndarray:
        """The point of the cut at an offset to the left (2,)."""
        return self.origin + offset * np.array([-np.sin(self.outward), np.cos(self.outward)])

    @property
    def kerbs(self) -> tuple[float, float]:
        """Offsets of the carriageway's right and left edge."""
        lanes = [lane for lane in self.lanes if lane[1] in CARRIAGEWAY]
        return min(lane[2] for lane in lanes), max(lane[3] for lane in lanes)

    @property
    def edges(self) -> tuple[float, float]:
        """Offsets of the whole road's right and left edge."""
        return min(lane[2] for lane in self.lanes), max(lane[3] for lane in self.lanes)

    @property
    def one_way(self) -> int:
        """+1 if all lanes lead in, −1 if all lead out, 0 otherwise."""
        ways = {lane[4] for lane in self.lanes if lane[1] in TRAVEL}
        return {frozenset([True]): 1, frozenset([False]): -1}.get(frozenset(ways), 0)

    def strip(self, kinds: set[str], side: int) -> tuple[float, float] | None:
        """Inner and outer offset of the lanes of some kinds beyond the left (+1) or right kerb."""
        kerb = self.kerbs[1] if side > 0 else self.kerbs[0]
        beyond = [x for x in self.lanes if x[1] in kinds and side * ((x[2] + x[3]) / 2 - kerb) > 0]
        if not beyond:
            return None
        low, high = min(x[2] for x in beyond), max(x[3] for x in beyond)
        return (low, high) if side > 0 else (high, low)


def interior_of(world: TownMap, members: set[int]) -> set[int]:
    """Short chains of roads from one member junction to another, as the ring of a roundabout."""
    found: set[int] = set()
    for first in world.roads.values():
        chain, ends, todo = set[int](), set[int](), [first.id]
        while todo and first.junction == -1 and len(members) > 1:
            road = world.roads[todo.pop()]
            chain.add(road.id)
            ends |= {link[1] for link in road.links.values() if link[0] == "junction"}
            following = {link[1] for link in road.links.values() if link[0] == "road"}
            todo += following & world.roads.keys() - chain
        length = sum(world.roads[road].length for road in chain)
        if len(ends) > 1 and ends <= members and length <= 2 * CLUSTER:
            found |= chain
    return found


def legs_of(world: TownMap, members: set[int]) -> list[Leg]:
    """The road ends that the members' connecting roads lead from and to."""
    inside = interior_of(world, members)
    touched = {
        _beyond(world, link[1], link[2])
        for road in world.roads.values()
        if road.junction in members
        for link in road.links.values()
        if link[0] == "road" and link[1] in world.roads and link[1] not in inside
        if world.roads[link[1]].junction not in members
    }
    legs = [_leg(world, world.roads[road], end) for road, end in sorted(touched)]
    return [leg for leg in legs if leg is not None]


def _beyond(world: TownMap, road: int, end: str) -> tuple[int, str]:
    """The road end itself, or the next where the road is a stub: maps have some of 0.01 mm."""
    here, other = world.roads[road], "end" if end == "start" else "start"
    kind, following, contact = here.links.get(other, ("", -1, ""))
    if here.length < 1.0 and kind == "road" and following in world.roads:
        return following, contact
    return road, end


def _leg(world: TownMap, road: Road, end: str) -> Leg | None:
    away = 1 if end == "start" else -1
    at = INSET if end == "start" else road.length - INSET
    here = _cut(world, road, at, away)
    there = _cut(world, road, at + away * min(15.0, road.length - 2 * INSET), away)
    if here is None or there is None:
        return None
    chord = there.point(sum(there.kerbs) / 2) - here.point(sum(here.kerbs) / 2)
    return replace(here, end=end, bearing=float(np.arctan2(chord[1], chord[0])))


def _cut(world: TownMap, road: Road, s: float, away: int) -> Leg | None:
    """A road's cross-section at s, looking along it (away = +1) or back (−1)."""
    lanes = next((lanes for a, b, lanes in road.sections if a <= s <= b), {})
    found = [(lane, kind, world.at(road.id, lane, s)) for lane, kind in lanes.items()]
    found = [x for x in found if x[2] is not None and x[2].lane_width > 0.05]
    carriageway = [x for x in found if x[1] in CARRIAGEWAY]
    if not carriageway:
        return None
    lane, _, guide = min(carriageway, key=lambda x: abs(x[0]))  # inmost: it tapers least
    origin = position(guide.transform.location)[:2]
    # CARLA's headings follow traffic; the road's own direction is that of growing s.
    step = min(0.5, road.length / 4) * (1 if s < road.length / 2 else -1)
    ahead = position(world.at(road.id, lane, s + step).transform.location)[:2]
    forward = heading_of(guide)
    if forward @ (ahead - origin) * away * step < 0:
        forward = -forward
    left = np.array([-forward[1], forward[0]])
    cut = []
    for lane, kind, waypoint in found:
        offset = float((position(waypoint.transform.location)[:2] - origin) @ left)
        inbound = bool(forward @ heading_of(waypoint) < 0)
        half = waypoint.lane_width / 2
        cut.append((lane, kind, offset - half, offset + half, inbound))
    heading = float(np.arctan2(forward[1], forward[0]))
    return Leg(road.id, "", origin, heading, heading, tuple(cut))


def arms_of(legs: list[Leg]) -> tuple[tuple[Arm, ...], dict[tuple[int, str], int]]:
    """One arm a leg, or a pair of legs where a divided road leads in on one and out on the other.

    Also says to which arm each (road, end) belongs. Arms go counter-clockwise by bearing.
    """
    groups = [[leg] for leg in legs]
    for i, leg in enumerate(legs):
        partners = [
            other
            for other in legs[i + 1 :]
            if leg.one_way * other.one_way == -1
            and np.cos(leg.bearing - other.bearing) > np.cos(np.radians(40))
            and _gap(leg, other) <= 20.0
        ]
        free = [p for p in partners if [p] in groups and [leg] in groups]
        if free:
            partner = min(free, key=lambda other: _gap(leg, other))
            groups.remove([leg])
            groups[groups.index([partner])].append(leg)
    made = sorted(((_arm(g), g) for g in groups), key=lambda x: x[0].bearing)
    return (
        tuple(arm for arm, _ in made),
        {(leg.road, leg.end): i for i, (_, g) in enumerate(made) for leg in g},
    )


def _gap(a: Leg, b: Leg) -> float:
    """Distance between the nearest kerbs of two cuts [m]."""
    return min(float(np.hypot(*(a.point(s) - b.point(t)))) for s in a.kerbs for t in b.kerbs)


def _arm(group: list[Leg]) -> Arm:
    along = np.sum([[np.cos(g.bearing), np.sin(g.bearing)] for g in group], axis=0)
    bearing = float(np.arctan2(along[1], along[0]))
    axes = np.array([[np.cos(bearing), np.sin(bearing)], [-np.sin(bearing), np.cos(bearing)]])
    kerbs = np.array([axes @ g.point(k) for g in group for k in g.kerbs])  # (2 or 4, 2)
    low, high = kerbs[:, 1].min(), kerbs[:, 1].max()
    x, y = np.array([kerbs[:, 0].mean(), (low + high) / 2]) @ axes
    return Arm((float(x), float(y)), bearing, float(high - low))


def areas_of(
    world: TownMap, strips: list[Strip], members: set[int], interior: set[int], notes: list[str]
) -> dict[Region, BaseGeometry]:
    """Driveway, junction, sidewalk and shoulder, one beside the other."""
    parts: dict[Region, list[BaseGeometry]] = {region: [] for region in Region}
    drawn = False
    for number in sorted({s.junction for s in strips} - {-1}):
        own = [s for s in strips if s.junction == number]
        legs = legs_of(world, {number})
        corners: dict[Region, list[Polygon]] = {}
        if not any(s.kind in SHOULDER | SIDEWALK for s in own):
            corners[Region.SHOULDER] = list(_corners(legs, SHOULDER))
            corners[Region.SIDEWALK] = list(_corners(legs, SIDEWALK))
            drawn |= number in members and any(corners.values())
        for region, shapes in corners.items():
            parts[region] += shapes
        paved = _paved(own, legs, [c for shapes in corners.values() for c in shapes])
        parts[Region.JUNCTION if number in members else Region.DRIVEWAY].append(paved)
    for strip in strips:
        if strip.kind in CARRIAGEWAY and strip.junction == -1:
            region = Region.JUNCTION if strip.road in interior else Region.DRIVEWAY
        elif strip.kind in SHOULDER:
            region = Region.SHOULDER
        elif strip.kind in SIDEWALK:
            region = Region.SIDEWALK
        else:  # a junction's lanes are in its paved area already
            continue
        parts[region].append(strip.polygon)
    if drawn:
        notes.append(
            "sidewalks and shoulders end at the junction in the map; its corners were drawn "
            "between those of neighbouring roads"
        )
    areas: dict[Region, BaseGeometry] = {}
    taken: BaseGeometry = MultiPolygon()
    for region in (Region.JUNCTION, Region.DRIVEWAY, Region.SHOULDER, Region.SIDEWALK):
        areas[region] = clean(unary_union(parts[region]).difference(taken))
        taken = unary_union([taken, areas[region]])
    return areas


def _paved(own: list[Strip], legs: list[Leg], corners: list[BaseGeometry]) -> BaseGeometry:
    """The carriageway of one junction: its lanes and the pockets between them and the kerbs."""
    lanes = [s.polygon for s in own if s.kind in CARRIAGEWAY]
    # A line from kerb to kerb closes the gaps that medians leave at the mouths; across the whole
    # road it closes those beside the kerbs.
    mouths = [LineString([g.point(k) for k in g.kerbs]).buffer(0.02) for g in legs]
    walls = [LineString([g.point(k) for k in g.edges]).buffer(0.02) for g in legs]
    walls += [s.polygon for s in own if s.kind not in CARRIAGEWAY]
    everything = unary_union([*lanes, *mouths, *walls, *corners]).buffer(0.05)
    surface = unary_union([*lanes, *mouths, *_pockets(everything)])
    surface = surface.buffer(0.5).buffer(-0.5)
    surface = unary_union([surface, *_pockets(surface)])
    # The lines have done their work: take away what of them still lies across a median.
    return surface.buffer(-0.15, join_style="mitre").buffer(0.15, join_style="mitre")


def _pockets(shape: BaseGeometry) -> list[Polygon]:
    """The holes of a shape that are too narrow for an island."""
    holes = [Polygon(ring) for part in shapely.get_parts(shape) for ring in part.interiors]
    return [hole.buffer(0.1) for hole in holes if hole.buffer(-ISLAND).is_empty]


def _corners(legs: list[Leg], kinds: set[str]) -> Iterator[Polygon]:
    """Strips that round the corners between neighbouring legs, where both have such lanes."""
    if len(legs) < 2:
        return
    mouths = np.array([leg.point(sum(leg.kerbs) / 2) for leg in legs])
    spokes = mouths - mouths.mean(0)
    order = np.argsort(np.arctan2(spokes[:, 1], spokes[:, 0]))
    for i, j in zip(order, np.roll(order, -1), strict=True):
        a, b = legs[i].strip(kinds, +1), legs[j].strip(kinds, -1)
        if a is None or b is None:
            continue
        inner, outer = (_bend(legs[i], s, legs[j], t) for s, t in zip(a, b, strict=True))
        yield _valid(Polygon(np.concatenate([inner, outer[::-1]])))


def _bend(a: Leg, s: float, b: Leg, t: float) -> np.ndarray:
    """A curve (N, 2) that leaves one leg and enters another along them; straight if it cannot."""
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


def mounting_of(
    regions: dict[Region, BaseGeometry], strips: list[Strip], arms: tuple[Arm, ...], disc: Polygon
) -> BaseGeometry:
    """Where a pole may stand: sidewalks, shoulders and medians, clear of traffic and crossings.

    Islands at the corners stand in only where there is none of these beside the junction: next
    to a sidewalk they add nothing, and on a deck they would hang in the air.
    """
    standing = [regions[Region.SIDEWALK], regions[Region.SHOULDER]]
    standing += [s.polygon for s in strips if s.kind == "median"]
    if unary_union(standing).distance(regions[Region.JUNCTION]) > 5.0:
        standing.append(corner_islands(arms))
    traffic = [regions[r] for r in (Region.DRIVEWAY, Region.JUNCTION, Region.CROSSWALK)]
    free = unary_union(standing).intersection(disc).difference(unary_union(traffic))
    return clean(free)


def crosswalks_of(
    world: TownMap,
    areas: dict[Region, BaseGeometry],
    arms: tuple[Arm, ...],
    ground: np.ndarray,
    disc: Polygon,
    notes: list[str],
) -> list[BaseGeometry]:
    """The map's crosswalks within the disc; strips across the mouths if it has none here."""
    index = cKDTree(ground[:, :2])
    walks = []
    for loop in world.crosswalks:
        middle = loop.mean(0)
        level = ground[index.query(middle[:2])[1], 2]
        if disc.contains(Point(middle)) and abs(middle[2] - level) < 2.0:
            walks.append(_valid(Polygon(loop[:, :2])))
    if any(walk.distance(areas[Region.JUNCTION]) < 8.0 for walk in walks):
        return walks
    if areas[Region.SIDEWALK].intersection(disc).is_empty:
        notes.append("no crosswalks: the map has none here, and no sidewalks they could join")
        return walks
    notes.append("the map has no crosswalks here; strips across the junction's mouths stand in")
    return walks + [mouth_crosswalks((arm,)) for arm in arms]


def _valid(shape: BaseGeometry) -> BaseGeometry:
    return shape if shape.is_valid else shape.buffer(0)


def clean(shape: BaseGeometry) -> BaseGeometry:
    """Close seams and drop slivers of a few centimetres and crumbs; corners stay square."""
    for step in (0.05, -0.12, 0.07):
        shape = shape.buffer(step, join_style="mitre")
    return unary_union([part for part in shapely.get_parts(shape) if part.area > 0.5])
