"""A junction of an OpenDRIVE map: its approaches and the five regions."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import shapely
from shapely.geometry import LineString, Polygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from inspe_jax.scene.maps.approaches import CARRIAGEWAY, SHOULDER, SIDEWALK, Approach, heading
from inspe_jax.scene.maps.lane_strips import LaneStrip
from inspe_jax.scene.maps.opendrive.road_network import (
    INSET,
    OpenDriveRoad,
    TownMap,
    heading_of,
    position,
)
from inspe_jax.scene.maps.parts import CLUSTER, valid
from inspe_jax.scene.regions import Region

ISLAND = 3.0
"""A gap between a junction's lanes is paved unless a circle of this radius fits in it [m]."""


def interior_of(town: TownMap, members: set[int]) -> set[int]:
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


def approaches_of(town: TownMap, members: set[int]) -> list[Approach]:
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


def _beyond(town: TownMap, road: int, end: str) -> tuple[int, str]:
    """The road end itself; if the road is a stub, the next end. Maps have stubs of 0.01 mm."""
    here, other = town.roads[road], "end" if end == "start" else "start"
    kind, following, contact = here.links.get(other, ("", -1, ""))
    if here.length < 1.0 and kind == "road" and following in town.roads:
        return following, contact
    return road, end


def _approach(town: TownMap, road: OpenDriveRoad, end: str) -> Approach | None:
    away = 1 if end == "start" else -1
    at = INSET if end == "start" else road.length - INSET
    here = _cut(town, road, at, away)
    there = _cut(town, road, at + away * min(15.0, road.length - 2 * INSET), away)
    if here is None or there is None:
        return None
    chord = there.point(sum(there.kerbs) / 2) - here.point(sum(here.kerbs) / 2)
    return replace(here, end=end, bearing=heading(chord))


def _cut(town: TownMap, road: OpenDriveRoad, s: float, away: int) -> Approach | None:
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


def areas_of(
    town: TownMap,
    lane_strips: list[LaneStrip],
    members: set[int],
    interior: set[int],
    notes: list[str],
) -> dict[Region, list[BaseGeometry]]:
    """The parts of driveway, junction, sidewalk and shoulder."""
    parts: dict[Region, list[BaseGeometry]] = {region: [] for region in Region}
    drawn = False
    for number in sorted({s.junction for s in lane_strips} - {-1}):
        own = [s for s in lane_strips if s.junction == number]
        approaches = approaches_of(town, {number})
        corners: dict[Region, list[Polygon]] = {}
        if not any(s.kind in SHOULDER | SIDEWALK for s in own):
            corners[Region.SHOULDER] = list(_corners(approaches, SHOULDER))
            corners[Region.SIDEWALK] = list(_corners(approaches, SIDEWALK))
            drawn |= number in members and any(corners.values())
        for region, shapes in corners.items():
            parts[region] += shapes
        paved = _paved(own, approaches, [c for shapes in corners.values() for c in shapes])
        parts[Region.JUNCTION if number in members else Region.DRIVEWAY].append(paved)
    for strip in lane_strips:
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
    return parts


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
