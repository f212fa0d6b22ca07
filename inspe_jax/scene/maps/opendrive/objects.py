"""The bodies of an OpenDRIVE map: its ``<object>`` elements of types that hide what is behind them,
at (s, t) of a road's reference line, its crosswalks and traffic islands, and vehicles parked at
random, the same for a place. Not read: guard rails, railings, fences, marks and signs."""

import xml.etree.ElementTree as ET
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Float
from shapely.geometry import LineString, Polygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from inspe_jax.core.words import counted
from inspe_jax.scene.intersection import Intersection
from inspe_jax.scene.lines import arc_of, turned
from inspe_jax.scene.maps.bodies import BARRIERS, HEIGHTS, POLE, TREE, Shape, crown_base
from inspe_jax.scene.maps.lanes import LaneStrip
from inspe_jax.scene.maps.opendrive.geometry import ReferenceLine, number
from inspe_jax.scene.maps.opendrive.road_network import OpenDriveRoad
from inspe_jax.scene.regions import Region
from inspe_jax.scene.statics import HIGHEST, LEAFY, StaticBody, octagon, upright_box
from inspe_jax.scene.street import PARKED
from inspe_jax.scene.traffic.frames import drawn_size

PARKING, CROSSWALK, SIGNAL, TRAFFIC_ISLAND = FLAT = (
    "parking space",
    "crosswalk",
    "signal",
    "traffic island",
)
"""Kinds of shapes that are no bodies."""
KINDS = {
    "building": "building",
    "tree": "tree",
    "vegetation": "tree",
    "pole": "pole",
    "streetLamp": "pole",
    "streetlamp": "pole",
    "barrier": "wall",
    "soundBarrier": "wall",
    "obstacle": "furniture",
    "parkingSpace": PARKING,
    "crosswalk": CROSSWALK,
    "trafficIsland": TRAFFIC_ISLAND,
    "1000001": SIGNAL,
    "1000002": SIGNAL,
}
"""The kind of body for each type of object or signal."""
SEEN_THROUGH = ("guardRail", "railing", "fence")  # subtypes of barriers that hide little
LIFTED = 0.5  # what begins lower above the road stands on the ground [m]
MOST_REPEATS = 1000  # objects that a ``<repeat>`` places more often are a strip without gaps
STEP = 2.0  # strips along a road have a corner this often [m]


class Place(NamedTuple):
    """Where an object stands on its road and its size [m], by its attributes; 0 if unknown."""

    s: float
    t: float
    zOffset: float
    height: float
    length: float
    width: float
    radius: float


Solid = tuple[BaseGeometry | None, float, float]
"""An area, None where no size is known, and between which heights over the road [m]."""


def shapes_of(
    roads: Iterable[tuple[ET.Element, OpenDriveRoad]],
) -> tuple[tuple[Shape, ...], tuple[str, ...]]:
    """The shapes on roads and their elements, and notes on what was assumed and left out. ``base``
    of a crosswalk or signal is its height [m]."""
    found: list[Shape] = []
    counts: Counter[str] = Counter()
    for parent, road in roads:
        for element in (*parent.iterfind("objects/object"), *parent.iterfind("signals/signal")):
            try:
                if _kind(element) is not None:
                    found += _shapes(element, road, counts)
            except ValueError:
                counts["bad"] += 1
    notes = tuple(
        f"objects of the map {words}: {counts[key]}, {done}"
        for key, words, done in (
            ("height", "without a height", "taken as of a usual one"),
            ("size", "without a size", "left out"),
            ("bad", "with a number missing or wrong", "left out"),
        )
        if counts[key]
    )
    return tuple(found), notes


def _kind(element: ET.Element) -> str | None:
    subtype = element.get("subtype", "")
    if subtype in SEEN_THROUGH:
        return None
    if "hedge" in (subtype, element.get("name", "").lower()):
        return "hedge"
    return KINDS.get(element.get("type", ""))


def _shapes(element: ET.Element, road: OpenDriveRoad, counts: "Counter[str]") -> Iterator[Shape]:
    for area, low, high in _areas(element, road.line):
        kind = _kind(element)
        if area is None or kind is None:
            counts["size"] += 1
            continue
        if kind in FLAT:
            s, t = (np.array([number(element, key)]) for key in "st")
            yield Shape(kind, area, 0.0, low + float(road.points(s, t)[0, 2]))
            continue
        base = low if low >= LIFTED else 0.0
        if not base < high <= HIGHEST or high - low <= 0:
            counts["height"] += 1
            high = base + HEIGHTS[kind]
        if kind != "tree":
            yield Shape(kind, area, high, base)
        elif next(element.iter("outline"), None) is not None:  # a patch of plants
            yield Shape("hedge", area, high, base)
        else:
            crown = base or crown_base(high)
            trunk = min(TREE["circumference"] / (2 * np.pi), float(np.sqrt(area.area)) / 4)
            yield Shape("tree", area, high, crown, LEAFY, trunk)


def _areas(element: ET.Element, line: ReferenceLine) -> Iterator[Solid]:
    own = Place(*(number(element, key, 0.0) for key in Place._fields))
    turn = number(element, "hdg", 0.0)
    outlines = [*element.iterfind("outline"), *element.iterfind("outlines/outline")]
    rows = [(repeat, _places(own, repeat)) for repeat in element.iterfind("repeat")]
    if outlines:
        for place in [place for _, row in rows for place in row or ()] or [own]:
            for outline in outlines:
                yield _outlined(outline, own, place, turn, line, _kind(element) != CROSSWALK)
        return
    if not rows:
        yield _simple(element, own, turn, line)
    for repeat, row in rows:
        if row is None:
            yield from _strip(own, repeat, line)
        for place in row or ():
            yield _simple(element, place, turn, line)


def _simple(element: ET.Element, place: Place, turn: float, line: ReferenceLine) -> Solid:
    at, heading = line.at(place.s, place.t)
    heights = place.zOffset, place.zOffset + place.height
    if place.radius > 0:
        return Polygon(octagon(at, place.radius)), *heights
    if place.length > 0 and place.width > 0:
        half = np.array([place.length, place.width]) / 2
        corners = half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        return Polygon(at + turned(corners, float(heading) + turn)), *heights
    usual = {"pole": POLE[1], SIGNAL: POLE[1], "tree": TREE["diameter_crown"] / 2}.get(
        _kind(element) or ""
    )
    return None if usual is None else Polygon(octagon(at, usual)), *heights


def _outlined(
    outline: ET.Element, own: Place, place: Place, turn: float, line: ReferenceLine, strip: bool
) -> Solid:
    """What is on an outline, moved from the object's own place to another; one that is not closed
    is a ``strip``, or closed all the same."""
    at, heading = line.at(place.s, place.t)
    corners, low, high = [], [], []
    for corner in outline:
        if corner.tag == "cornerRoad":
            s, t = number(corner, "s"), number(corner, "t")
            point, _ = line.at(s + place.s - own.s, t + place.t - own.t)
            low.append(number(corner, "dz", 0.0) - place.zOffset)  # over the reference line
        elif corner.tag == "cornerLocal":
            u, v = number(corner, "u"), number(corner, "v")
            point = at + turned(np.array([u, v]), float(heading) + turn)
            low.append(number(corner, "z", 0.0))
        else:
            continue
        corners.append(point)
        high.append(low[-1] + number(corner, "height", own.height))
    if strip and outline.get("closed") == "false" and len(corners) > 1:
        along = LineString(corners).buffer(BARRIERS["wall"][1] / 2, cap_style="flat")
        return along, place.zOffset + min(low), place.zOffset + max(high)
    if len(corners) < 3 or not np.isfinite(corners).all():
        return None, 0.0, 0.0
    area = Polygon(corners)
    area = area if area.is_valid else area.convex_hull  # corners in another order
    on_a_line = not area.area
    return None if on_a_line else area, place.zOffset + min(low), place.zOffset + max(high)


def _place_at(own: Place, repeat: ET.Element, share: float) -> Place:
    """The place of an object at a share of the length of its ``<repeat>``."""

    def between(key: str) -> float:
        first = number(repeat, f"{key}Start", getattr(own, key))
        return first + share * (number(repeat, f"{key}End", first) - first)

    s = number(repeat, "s", own.s) + share * number(repeat, "length", 0.0)
    return Place(s, *(between(key) for key in Place._fields[1:]))


def _places(own: Place, repeat: ET.Element) -> list[Place] | None:
    """An object's places along a ``<repeat>``; None where it has no gaps."""
    reach, distance = (number(repeat, key, 0.0) for key in ("length", "distance"))
    if distance <= 0 or reach / distance > MOST_REPEATS:
        return None
    count = int(reach / distance + 1e-9)
    return [_place_at(own, repeat, k * distance / max(reach, 1e-9)) for k in range(count + 1)]


def _strip(own: Place, repeat: ET.Element, line: ReferenceLine) -> Iterator[Solid]:
    """The stretches of an object that goes on along a ``<repeat>`` without gaps."""
    reach = number(repeat, "length", 0.0)
    shares = np.linspace(0.0, 1.0, int(np.clip(np.ceil(reach / STEP), 1, MOST_REPEATS)) + 1)
    for first, last in pairwise(shares.tolist()):
        ends = [_place_at(own, repeat, first), _place_at(own, repeat, last)]
        half = [max(e.width, BARRIERS["fence"][1]) / 2 for e in ends]
        right = [line.at(e.s, e.t - h)[0] for e, h in zip(ends, half, strict=True)]
        left = [line.at(e.s, e.t + h)[0] for e, h in zip(ends, half, strict=True)]
        low = ends[0].zOffset
        yield Polygon([*right, *left[::-1]]), low, low + ends[0].height


OCCUPIED = 0.85
"""Share of places that are taken: what cities manage parking for, since at more than this drivers
circle for one (Shoup, The High Cost of Free Parking, 2005)."""
PARALLEL, ABREAST = 6.0, 2.5  # length of a place along the lane [m]: vehicles in a row, abreast
DEEP = 4.4  # where a lane is wider than this, vehicles stand across it [m]
OUT = 0.1  # a vehicle may stand out of its place by so much [m²], as in a bend
FROM_EDGES = 0.1  # vehicles keep this far from the edges of a place [m]


def with_parked(
    place: Intersection,
    lanes: Iterable[LaneStrip],
    spaces: Iterable[BaseGeometry],
    reach: float,
    notes: list[str],
) -> Intersection:
    """A place with vehicles in parking lanes and on marked spaces within ``reach`` [m] of its
    centre, none on a crosswalk, in another body or out of its lane; ``notes`` get how many."""
    rng = np.random.default_rng(zlib.crc32(place.name.encode()))
    crossings = place.regions.get(Region.CROSSWALK, shapely.Polygon())
    others = unary_union([one.polygon for one in place.bodies])
    disc = shapely.Point(place.center[:2]).buffer(reach)
    found: list[StaticBody] = []
    for at, yaw, size, allowed in (*_along(lanes), *_on(spaces)):
        taken, back, first = rng.uniform(), rng.uniform() < 0.5, drawn_size(PARKED, rng)
        fits = [s for s in (first, *(s for _, s in PARKED)) if (np.array(s[:2]) <= size).all()]
        if taken > OCCUPIED or not fits:
            continue
        one = upright_box("parked vehicle", at, fits[0], yaw + np.pi * back)
        inside = disc.contains(one.polygon) and one.polygon.difference(allowed).area < OUT
        if inside and not (crossings.intersects(one.polygon) or others.intersects(one.polygon)):
            found.append(one)
    if found:
        notes.append(
            f"{counted(len(found), 'vehicle')} parked where the map has parking lanes or spaces: "
            f"{OCCUPIED:.0%} of the places are taken"
        )
    return replace(place, bodies=(*place.bodies, *found))


Spot = tuple[Float[np.ndarray, "2"], float, Float[np.ndarray, "2"], BaseGeometry]
"""The middle of a place [m], the direction of its vehicle [rad], the most that it may measure in
length and width [m], and the ground that it must stay on."""


def _along(lanes: Iterable[LaneStrip]) -> Iterator[Spot]:
    for lane in lanes:
        line = lane.center[:, :2]
        arc = arc_of(line)
        wide = np.hypot(*(lane.left - lane.right)[:, :2].T)
        across = float(np.median(wide)) > DEEP
        pitch = ABREAST if across else PARALLEL
        for at in np.arange(pitch / 2, arc[-1] - pitch / 2 + 1e-9, pitch):
            before, middle, after = (
                np.array([np.interp(at + d, arc, x) for x in line.T]) for d in (-0.5, 0.0, 0.5)
            )
            yaw = float(np.arctan2(*(after - before)[::-1])) + np.pi / 2 * across
            width = float(np.interp(at, arc, wide))
            size = np.array((width, pitch) if across else (pitch, width))
            yield middle, yaw, size - 2 * FROM_EDGES, lane.polygon


def _on(spaces: Iterable[BaseGeometry]) -> Iterator[Spot]:
    """The places of marked spaces: the vehicle stands along the longer side."""
    for space in spaces:
        around = shapely.minimum_rotated_rectangle(space)
        if around.geom_type != "Polygon":
            continue
        sides = np.diff(np.array(around.exterior.coords), axis=0)[:2]
        length = np.hypot(*sides.T)
        along = sides[int(np.argmax(length))]
        size = np.sort(length)[::-1] - 2 * FROM_EDGES
        yield np.array(around.centroid.coords[0]), float(np.arctan2(*along[::-1])), size, space
