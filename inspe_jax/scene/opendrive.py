"""OpenDRIVE maps into intersections, through the CARLA client's ``carla.Map`` (needs no server).

The file's XML says which roads, lanes and links there are; CARLA says where they run. CARLA is
left-handed: its y is flipped in :func:`_position` and its heading with it, here and nowhere else.
"""

import functools
import os
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from shapely.geometry import LineString, MultiPolygon, Point, Polygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from inspe_jax.errors import InspeError
from inspe_jax.scene.intersection import (
    Arm,
    Intersection,
    Route,
    corner_islands,
    mouth_crosswalks,
)
from inspe_jax.scene.regions import Region

TRAVEL = {"driving", "entry", "exit", "onRamp", "offRamp", "connectingRamp", "bus", "taxi", "HOV"}
TRAVEL |= {"mwyEntry", "mwyExit"}
CARRIAGEWAY = TRAVEL | {"bidirectional", "parking", "biking", "stop", "restricted", "roadWorks"}
SHOULDER = {"shoulder", "border", "curb"}
SIDEWALK = {"sidewalk", "walking"}
TRAFFIC_LIGHT = "1000001"

STEP = 1.0
"""Spacing of the stations sampled along lanes and routes [m]."""
MARGIN = 10.0
"""The map is read this much beyond the radius [m]."""
CLUSTER = 35.0
"""Around ``center``, junctions whose middle is this near count as one [m]."""
ISLAND = 3.0
"""A gap between a junction's lanes is paved unless a circle of this radius fits in it [m]."""
GRADE = 0.15
"""Roads climb no steeper; a lane higher or lower than that is on another level."""
_EPS = 1e-3  # CARLA answers at a lane's very end with the next lane; stay this much inside [m]


@dataclass(frozen=True)
class JunctionInfo:
    """A junction of a map: its id, middle (x, y, z) [m], arms, size, crosswalks and signals.

    ``size`` is the larger side of its bounding box [m]; ``crosswalks`` and ``signals`` count
    those that the map itself has near it.
    """

    id: int
    center: tuple[float, float, float]
    arms: int
    size: float
    crosswalks: int
    signals: int


def list_junctions(path: str | os.PathLike[str]) -> tuple[JunctionInfo, ...]:
    """The junctions of an OpenDRIVE file, by id. Raises InspeError as :func:`read_opendrive`."""
    world = _load(path)
    found = []
    for junction in world.junctions:
        center, size = world.box(junction)
        arms, _ = _arms(_legs(world, {junction}))

        def near(points: np.ndarray, beyond: float, c: np.ndarray = center, s: float = size) -> int:
            return int((np.hypot(*(points[:, :2] - c[:2]).T) < s / 2 + beyond).sum())

        middles = np.array([loop.mean(0) for loop in world.crosswalks]).reshape(-1, 3)
        x, y, z = (float(v) for v in center)
        counts = near(middles, 8.0), near(world.signals, 15.0)
        found.append(JunctionInfo(junction, (x, y, z), len(arms), size, *counts))
    return tuple(found)


def read_opendrive(
    path: str | os.PathLike[str],
    *,
    junction: int | None = None,
    center: tuple[float, float] | None = None,
    radius: float = 50.0,
) -> Intersection:
    """One junction of an OpenDRIVE file and its surroundings, in world metres (ENU).

    Give ``junction``, an id of the file, or ``center`` (x, y) [m] for a place that is not one
    OpenDRIVE junction, as a roundabout: all junctions within 35 m of it then count as one. Lanes
    are read to ``radius`` + 10 m; routes run from ``radius`` to ``radius``. Roads on another
    level are left out. Raises InspeError where the CARLA client is missing, the file is missing
    or is not well-formed OpenDRIVE, the junction is unknown, or no road is near.
    """
    world = _load(path)
    members, middle, place = _choose(world, junction, center)
    if not 0 < radius <= 500:
        raise InspeError(f"radius {radius:g} m is out of range: between 0 and 500 m")
    interior = _interior(world, members)
    reach = radius + MARGIN
    strips = _strips(world, middle[:2], reach)
    core = [s.junction in members or s.road in interior for s in strips]
    strips = _same_level(strips, core)
    if not strips:
        raise InspeError(
            f"{world.source}: no roads within {radius:g} m of ({middle[0]:.1f}, {middle[1]:.1f})"
        )
    legs = _legs(world, members)
    arms, arm_of = _arms(legs)
    notes: list[str] = []

    areas = _areas(world, strips, members, interior, notes)
    ground = np.concatenate([s.center for s in strips])
    disc = Point(middle[:2]).buffer(reach, quad_segs=32)
    walks = _crosswalks(world, areas, arms, ground, disc, notes)
    areas[Region.CROSSWALK] = _clean(unary_union(walks))
    regions = {region: areas[region].intersection(disc) for region in Region}

    medians = unary_union([s.polygon for s in strips if s.kind == "median"])
    standing = [regions[Region.SIDEWALK], regions[Region.SHOULDER], medians, corner_islands(arms)]
    traffic = [regions[r] for r in (Region.DRIVEWAY, Region.JUNCTION, Region.CROSSWALK)]
    mounting = unary_union(standing).intersection(disc).difference(unary_union(traffic))

    signals = _deduplicate(world.signals[_distance(world.signals, middle) <= reach])
    if not len(signals):
        notes.append("no signal poles: the map has no traffic lights near")
    found = Intersection(
        name=f"{world.name} {place}",
        source=f"{world.source} (OpenDRIVE)",
        center=middle,
        regions=regions,
        arms=arms,
        routes=(),
        mounting=_clean(mounting),
        poles=signals,
        ground_points=ground,
        notes=tuple(notes),
    )

    # Signals hang on poles or are sunk in the map; their feet, the centre and people stand on
    # the ground.
    def on_ground(xy: np.ndarray) -> np.ndarray:
        return np.column_stack([xy[:, :2], found.ground(xy[:, :2])])

    people = [*_crossings(walks), *_pavements(strips)]
    routes = [
        *_vehicle_routes(world, legs, arm_of, members, interior, middle, radius),
        *(Route(on_ground(line), 2.0, "pedestrian") for p in people for line in (p, p[::-1])),
    ]
    poles = on_ground(signals) if len(signals) else signals
    return replace(found, center=on_ground(middle[None])[0], poles=poles, routes=tuple(routes))


# ---- the map --------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Road:
    """A road as its XML says: where it starts piecewise, its lanes by section, its links."""

    id: int
    junction: int  # −1 outside junctions
    length: float
    pieces: Float[np.ndarray, "K 3"]  # x, y where each planView piece starts, and its length
    sections: tuple[tuple[float, float, dict[int, str]], ...]  # from s, to s, lane id → type
    links: dict[str, tuple[str, int, str]]  # 'start'/'end' → ('road'/'junction', id, contact)

    def near(self, middle: np.ndarray, reach: float) -> bool:
        """Whether some piece can come within reach: none strays farther than its length."""
        away = np.hypot(*(self.pieces[:, :2] - middle).T)
        return bool((away <= reach + self.pieces[:, 2] + 20.0).any())  # 20 m: half a wide road


@dataclass(frozen=True, eq=False)
class _Map:
    """A map read: CARLA's, and what its XML adds. Positions are world metres (ENU)."""

    name: str
    source: str
    carla: Any
    roads: dict[int, _Road]
    junctions: tuple[int, ...]
    crosswalks: tuple[np.ndarray, ...]  # loops, each (K, 3)
    signals: Float[np.ndarray, "P 3"]

    def at(self, road: int, lane: int, s: float) -> Any:
        """CARLA's waypoint in the middle of a lane, s metres along the road; None off its ends."""
        return self.carla.get_waypoint_xodr(road, lane, s)

    def box(self, junction: int) -> tuple[np.ndarray, float]:
        """Middle (3,) and larger side of a junction's bounding box [m]."""
        for road in self.roads.values():
            if road.junction == junction:
                for lane in road.sections[0][2]:
                    waypoint = self.at(road.id, lane, road.length / 2)
                    if waypoint is not None and waypoint.get_junction() is not None:
                        box = waypoint.get_junction().bounding_box
                        return _position(box.location), 2 * max(box.extent.x, box.extent.y)
        raise InspeError(f"{self.source}: junction {junction} has no lanes")


def _position(location: Any) -> np.ndarray:
    """CARLA's left-handed location in the world frame (3,) [m]."""
    return np.array([location.x, -location.y, location.z])


def _load(path: str | os.PathLike[str]) -> _Map:
    path = Path(path)
    if not path.is_file():
        raise InspeError(f"{path}: no such file")
    stat = path.stat()
    return _read(path.resolve(), stat.st_mtime_ns, stat.st_size)


@functools.lru_cache(maxsize=8)
def _read(path: Path, _modified: int, _size: int) -> _Map:
    """Read a file once for as long as it stays the same."""
    text = path.read_bytes().decode("utf-8-sig", "replace")
    root = _root(path, text)
    try:
        roads = {r.id: r for r in map(_road, root.iter("road"))}
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InspeError(f"{path}: not OpenDRIVE: a road lacks or misstates {error}") from error
    junctions = sorted({r.junction for r in roads.values()} - {-1})
    if not roads:
        raise InspeError(f"{path}: the map has no roads")
    try:
        import carla
    except ImportError as error:
        raise InspeError(
            "reading OpenDRIVE needs the CARLA client: pip install 'inspe_jax[opendrive]' "
            "(Linux and Windows, Python up to 3.12)"
        ) from error
    try:
        with _quiet():
            parsed = carla.Map(path.stem, text)
            corners = [_position(c) for c in parsed.get_crosswalks()]
            marks = [m for m in parsed.get_all_landmarks() if m.type == TRAFFIC_LIGHT]
    except (RuntimeError, IndexError) as error:
        raise InspeError(f"{path}: the CARLA client cannot read this map ({error})") from error
    signals = np.array([_position(m.transform.location) for m in marks]).reshape(-1, 3)
    return _Map(
        path.stem, path.name, parsed, roads, tuple(junctions), tuple(_loops(corners)), signals
    )


def _root(path: Path, text: str) -> ET.Element:
    """The XML, checked first: CARLA reads on past what it does not understand, or aborts."""
    try:
        root = ET.fromstring(text.encode())
    except ET.ParseError as error:
        line, column = error.position
        raise InspeError(
            f"{path}: not well-formed XML, perhaps cut short: line {line}, column {column} "
            f"({str(error).split(':')[0]})"
        ) from error
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]  # namespaces say nothing here
    if root.tag != "OpenDRIVE":
        raise InspeError(
            f"{path}: not OpenDRIVE: the root element is <{root.tag}>, not <OpenDRIVE>"
        )
    return root


def _road(element: ET.Element) -> _Road:
    length = float(element.attrib["length"])
    sections = element.findall("lanes/laneSection")
    bounds = [float(s.attrib["s"]) for s in sections] + [length]
    lanes = [
        {int(x.attrib["id"]): x.attrib["type"] for x in s.iter("lane") if x.get("id") != "0"}
        for s in sections
    ]
    links = {}
    for end, tag in (("start", "predecessor"), ("end", "successor")):
        link = element.find(f"link/{tag}")
        if link is not None:
            kind, contact = link.attrib["elementType"], link.get("contactPoint", "")
            links[end] = (kind, int(link.attrib["elementId"]), contact)
    pieces = [[float(g.attrib[k]) for k in ("x", "y", "length")] for g in element.iter("geometry")]
    return _Road(
        int(element.attrib["id"]),
        int(element.get("junction", -1)),
        length,
        np.array(pieces).reshape(-1, 3),
        tuple(zip(bounds, bounds[1:], lanes, strict=False)),
        links,
    )


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence C++ code, which writes to the descriptors and not to ``sys.stderr``."""
    kept = {fd: os.dup(fd) for fd in (1, 2)}
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        for fd in kept:
            os.dup2(null, fd)
        yield
    finally:
        for fd, copy in kept.items():
            os.dup2(copy, fd)
            os.close(copy)
        os.close(null)


def _loops(corners: list[np.ndarray]) -> Iterator[np.ndarray]:
    """Split CARLA's run of corners where a loop comes back to its first."""
    loop: list[np.ndarray] = []
    for corner in corners:
        if loop and np.allclose(corner, loop[0], atol=1e-3):
            if len(loop) > 2:
                yield np.array(loop)
            loop = []
        else:
            loop.append(corner)


def _choose(
    world: _Map, junction: int | None, center: tuple[float, float] | None
) -> tuple[set[int], np.ndarray, str]:
    """Which junctions are meant, their middle (3,), and what to call the place."""
    if (junction is None) == (center is None):
        raise InspeError("say which place to read: either a junction id or a center (x, y)")
    if junction is not None:
        if junction not in world.junctions:
            known = ", ".join(map(str, world.junctions)) or "none"
            raise InspeError(f"{world.source}: no junction {junction}; there are: {known}")
        return {junction}, world.box(junction)[0], f"junction {junction}"
    assert center is not None
    middle = np.array([*center, 0.0], float)
    away = {j: float(_distance(world.box(j)[0][None], middle)[0]) for j in world.junctions}
    members = {j for j, d in away.items() if d <= CLUSTER}
    if not members:
        where = f"({center[0]:g}, {center[1]:g})"
        nearest = min(away, key=lambda j: away[j], default=None)
        hint = "" if nearest is None else f"; the nearest is {nearest} at {away[nearest]:.0f} m"
        raise InspeError(
            f"{world.source}: no roads of a junction within {CLUSTER:g} m of {where}{hint}"
        )
    return members, middle, f"at ({center[0]:g}, {center[1]:g})"


# ---- lanes ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Strip:
    """A run of one lane: middle line and both edges at stations about 1 m apart."""

    road: int
    lane: int
    junction: int
    kind: str
    center: Float[np.ndarray, "N 3"]
    left: Float[np.ndarray, "N 2"]
    right: Float[np.ndarray, "N 2"]

    @functools.cached_property
    def polygon(self) -> BaseGeometry:
        """The lane's surface; quad by quad where a tight bend folds an edge over."""
        whole = Polygon(np.concatenate([self.left, self.right[::-1]]))
        if whole.is_valid:
            return whole
        quads = np.stack([self.left[:-1], self.left[1:], self.right[1:], self.right[:-1]], 1)
        return unary_union(shapely.convex_hull(shapely.polygons(quads)))

    def runs(self, keep: np.ndarray) -> "Iterator[_Strip]":
        """The unbroken runs of stations to keep, of two or more."""
        edges = np.flatnonzero(np.diff(np.concatenate([[0], keep, [0]])))
        for a, b in edges.reshape(-1, 2):
            if b - a > 1:
                part = slice(a, b)
                yield replace(
                    self, center=self.center[part], left=self.left[part], right=self.right[part]
                )


def _strips(world: _Map, middle: np.ndarray, reach: float) -> list[_Strip]:
    """Every lane that has width and passes within reach, cut to it."""
    found: list[_Strip] = []
    for road in world.roads.values():
        if not road.near(middle, reach):
            continue
        for start, end, lanes in road.sections:
            count = max(2, int(np.ceil((end - start) / STEP)) + 1)
            stations = np.linspace(start + _EPS, end - _EPS, count)
            for lane, kind in lanes.items():
                line = [w for s in stations if (w := world.at(road.id, lane, s)) is not None]
                if len(line) < 2 or max(w.lane_width for w in line) < 0.05:
                    continue
                center = np.array([_position(w.transform.location) for w in line])
                yaw = -np.radians([w.transform.rotation.yaw for w in line])
                half = np.array([w.lane_width for w in line])[:, None] / 2
                across = np.column_stack([-np.sin(yaw), np.cos(yaw)]) * half
                edges = center[:, :2] + across, center[:, :2] - across
                strip = _Strip(road.id, lane, road.junction, kind, center, *edges)
                # One lane's width over, so that what is left is cut by the disc, not by stations.
                found += strip.runs(_distance(center, middle) <= reach + 2 * half.max() + STEP)
    return found


def _same_level(strips: list[_Strip], core: list[bool]) -> list[_Strip]:
    """Leave out what lies above or beneath: keep stations that join the core without a jump.

    Two stations are joined within 5 m, height counted thrice, so a deck 2 m up is apart from the
    road beneath it. What is not joined, as a street behind a verge, stays if level with the
    nearest that is; what is joined by a ramp goes once it has climbed beyond the steepest grade.
    """
    if not any(core):
        return []
    points = np.concatenate([s.center for s in strips])  # (N, 3)
    sizes = [len(s.center) for s in strips]
    is_core = np.repeat(core, sizes)
    pairs = cKDTree(points * [1, 1, 3]).query_pairs(5.0, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs), bool), pairs.T), shape=(len(points),) * 2)
    _, label = connected_components(graph, directed=False)
    joined = np.isin(label, np.unique(label[is_core]))

    def rise_from(some: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        away, index = cKDTree(points[some, :2]).query(points[:, :2])
        return np.abs(points[:, 2] - points[some][index, 2]), away

    rise, away = rise_from(is_core)
    keep = joined & (rise <= 1.5 + GRADE * away)
    rise, _ = rise_from(keep)
    keep |= rise <= 2.0
    cut = np.split(keep, np.cumsum(sizes)[:-1])
    return [run for strip, mask in zip(strips, cut, strict=True) for run in strip.runs(mask)]


# ---- legs and arms --------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Leg:
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


def _interior(world: _Map, members: set[int]) -> set[int]:
    """Short roads from one member junction to another, as the ring of a roundabout."""
    found = set()
    for road in world.roads.values():
        ends = {link[1] for link in road.links.values() if link[0] == "junction"}
        if road.junction == -1 and len(ends) == 2 and ends <= members:
            if road.length <= 2 * CLUSTER:
                found.add(road.id)
    return found


def _legs(world: _Map, members: set[int]) -> list[_Leg]:
    """The road ends that the members' connecting roads lead from and to."""
    inside = _interior(world, members)
    touched = {
        (link[1], link[2])
        for road in world.roads.values()
        if road.junction in members
        for link in road.links.values()
        if link[0] == "road" and link[1] in world.roads and link[1] not in inside
        if world.roads[link[1]].junction not in members
    }
    legs = [_leg(world, world.roads[road], end) for road, end in sorted(touched)]
    return [leg for leg in legs if leg is not None]


def _leg(world: _Map, road: _Road, end: str) -> _Leg | None:
    away = 1 if end == "start" else -1
    at = _EPS if end == "start" else road.length - _EPS
    here = _cut(world, road, at, away)
    there = _cut(world, road, at + away * min(15.0, road.length - 2 * _EPS), away)
    if here is None or there is None:
        return None
    chord = there.point(sum(there.kerbs) / 2) - here.point(sum(here.kerbs) / 2)
    return replace(here, end=end, bearing=float(np.arctan2(chord[1], chord[0])))


def _cut(world: _Map, road: _Road, s: float, away: int) -> _Leg | None:
    """A road's cross-section at s, looking along it (away = +1) or back (−1)."""
    lanes = next((lanes for a, b, lanes in road.sections if a <= s <= b), {})
    found = [(lane, kind, world.at(road.id, lane, s)) for lane, kind in lanes.items()]
    found = [x for x in found if x[2] is not None and x[2].lane_width > 0.05]
    carriageway = [x for x in found if x[1] in CARRIAGEWAY]
    if not carriageway:
        return None
    lane, _, guide = min(carriageway, key=lambda x: abs(x[0]))  # inmost: it tapers least
    origin = _position(guide.transform.location)[:2]
    # CARLA's headings follow traffic; the road's own direction is that of growing s.
    step = min(0.5, road.length / 4) * (1 if s < road.length / 2 else -1)
    ahead = _position(world.at(road.id, lane, s + step).transform.location)[:2]
    forward = (ahead - origin) * away * np.sign(step)
    forward /= np.linalg.norm(forward)
    left = np.array([-forward[1], forward[0]])
    cut = []
    for lane, kind, waypoint in found:
        offset = float((_position(waypoint.transform.location)[:2] - origin) @ left)
        inbound = bool(forward @ _heading(waypoint) < 0)
        half = waypoint.lane_width / 2
        cut.append((lane, kind, offset - half, offset + half, inbound))
    heading = float(np.arctan2(forward[1], forward[0]))
    return _Leg(road.id, "", origin, heading, heading, tuple(cut))


def _arms(legs: list[_Leg]) -> tuple[tuple[Arm, ...], dict[tuple[int, str], int]]:
    """One arm a leg, or a pair of legs where a divided road leads in on one and out on the other.

    Also says to which arm each (road, end) belongs. Arms go counter-clockwise by bearing.
    """
    groups = [[leg] for leg in legs]
    for i, leg in enumerate(legs):
        partners = [
            other
            for other in legs[i + 1 :]
            if leg.one_way * other.one_way == -1
            and np.cos(leg.bearing - other.bearing) > np.cos(np.pi / 6)
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


def _gap(a: _Leg, b: _Leg) -> float:
    """Distance between the nearest kerbs of two cuts [m]."""
    return min(float(np.hypot(*(a.point(s) - b.point(t)))) for s in a.kerbs for t in b.kerbs)


def _arm(group: list[_Leg]) -> Arm:
    along = np.sum([[np.cos(g.bearing), np.sin(g.bearing)] for g in group], axis=0)
    bearing = float(np.arctan2(along[1], along[0]))
    axes = np.array([[np.cos(bearing), np.sin(bearing)], [-np.sin(bearing), np.cos(bearing)]])
    kerbs = np.array([axes @ g.point(k) for g in group for k in g.kerbs])  # (2 or 4, 2)
    low, high = kerbs[:, 1].min(), kerbs[:, 1].max()
    x, y = np.array([kerbs[:, 0].mean(), (low + high) / 2]) @ axes
    return Arm((float(x), float(y)), bearing, float(high - low))


# ---- regions --------------------------------------------------------------------------------


def _areas(
    world: _Map, strips: list[_Strip], members: set[int], interior: set[int], notes: list[str]
) -> dict[Region, BaseGeometry]:
    """Driveway, junction, sidewalk and shoulder, one beside the other."""
    junction, driveway, shoulder, sidewalk = [], [], [], []
    drawn = False
    for number in sorted({s.junction for s in strips} - {-1}):
        own = [s for s in strips if s.junction == number]
        corners: dict[str, list[BaseGeometry]] = {"shoulder": [], "sidewalk": []}
        if not any(s.kind in SHOULDER | SIDEWALK for s in own):
            legs = _legs(world, {number})
            corners = {
                "shoulder": list(_corners(legs, SHOULDER)),
                "sidewalk": list(_corners(legs, SIDEWALK)),
            }
            drawn |= number in members and any(corners.values())
        paved = _paved(own, _legs(world, {number}), corners["shoulder"] + corners["sidewalk"])
        (junction if number in members else driveway).append(paved)
        shoulder += corners["shoulder"]
        sidewalk += corners["sidewalk"]
    for strip in strips:
        if strip.kind in CARRIAGEWAY and strip.junction == -1:
            (junction if strip.road in interior else driveway).append(strip.polygon)
        elif strip.kind in SHOULDER:
            shoulder.append(strip.polygon)
        elif strip.kind in SIDEWALK:
            sidewalk.append(strip.polygon)
    if drawn:
        notes.append(
            "sidewalks and shoulders end at the junction in the map; its corners were drawn "
            "between those of neighbouring roads"
        )
    areas: dict[Region, BaseGeometry] = {}
    taken: BaseGeometry = MultiPolygon()
    for region, parts in (
        (Region.JUNCTION, junction),
        (Region.DRIVEWAY, driveway),
        (Region.SHOULDER, shoulder),
        (Region.SIDEWALK, sidewalk),
    ):
        areas[region] = _clean(unary_union(parts).difference(taken))
        taken = unary_union([taken, areas[region]])
    return areas


def _paved(own: list[_Strip], legs: list[_Leg], corners: list[BaseGeometry]) -> BaseGeometry:
    """The carriageway of one junction: its lanes and the pockets between them and the kerbs."""
    lanes = [s.polygon for s in own if s.kind in CARRIAGEWAY]
    # A line from kerb to kerb closes the gaps that medians leave at the mouths.
    mouths = [LineString([g.point(k) for k in g.kerbs]).buffer(0.1) for g in legs if own]
    walls = [s.polygon for s in own if s.kind not in CARRIAGEWAY]
    everything = unary_union([*lanes, *mouths, *walls, *corners]).buffer(0.05)
    surface = unary_union([*lanes, *mouths, *_pockets(everything)])
    surface = surface.buffer(0.5).buffer(-0.5)
    return unary_union([surface, *_pockets(surface)])


def _pockets(shape: BaseGeometry) -> list[Polygon]:
    """The holes of a shape that are too narrow for an island."""
    holes = [Polygon(ring) for part in shapely.get_parts(shape) for ring in part.interiors]
    return [hole.buffer(0.1) for hole in holes if hole.buffer(-ISLAND).is_empty]


def _corners(legs: list[_Leg], kinds: set[str]) -> Iterator[Polygon]:
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


def _bend(a: _Leg, s: float, b: _Leg, t: float) -> np.ndarray:
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


def _crosswalks(
    world: _Map,
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


def _clean(shape: BaseGeometry) -> BaseGeometry:
    """Close seams and drop slivers of a few centimetres; corners stay square."""
    for step in (0.05, -0.12, 0.07):
        shape = shape.buffer(step, join_style="mitre")
    return shape


# ---- routes ---------------------------------------------------------------------------------


def _vehicle_routes(
    world: _Map,
    legs: list[_Leg],
    arm_of: dict[tuple[int, str], int],
    members: set[int],
    interior: set[int],
    middle: np.ndarray,
    radius: float,
) -> Iterator[Route]:
    """Every way from an inbound lane to another arm, from radius to radius; no U-turns."""
    inside = {r.id for r in world.roads.values() if r.junction in members} | interior
    for leg in legs:
        length = world.roads[leg.road].length
        for lane, kind, _, _, inbound in leg.lanes:
            if kind not in TRAVEL or not inbound:
                continue
            mouth = world.at(leg.road, lane, _EPS if leg.end == "start" else length - _EPS)
            upstream = _follow(mouth, "previous", middle, radius)[::-1]
            for path in _ways(mouth, inside):
                last = path[-1]
                end = "start" if last.s < world.roads[last.road_id].length / 2 else "end"
                exit_arm = arm_of.get((last.road_id, end), -1)
                entry_arm = arm_of[leg.road, leg.end]
                if exit_arm == entry_arm:
                    continue
                line = [*upstream, *path, *_follow(last, "next", middle, radius)]
                points = _resample(np.array([_position(w.transform.location) for w in line]))
                yield Route(points, mouth.lane_width, "vehicle", (entry_arm, exit_arm))


def _ways(mouth: Any, inside: set[int]) -> Iterator[list[Any]]:
    """All lane paths from a mouth through the junction to the first station beyond it."""
    stack = [([mouth], frozenset[tuple[int, int]]())]
    while stack:
        path, seen = stack.pop()
        here = path[-1]
        for step in here.next(STEP):
            lane = (step.road_id, step.lane_id)
            if step.road_id not in inside:
                if here.road_id in inside:
                    yield [*path, step]
                elif len(path) < 5:  # still on the leg
                    stack.append(([*path, step], seen))
            elif lane == (here.road_id, here.lane_id):
                stack.append(([*path, step], seen))
            elif lane not in seen:  # round a roundabout once
                stack.append(([*path, step], seen | {lane}))


def _follow(start: Any, way: str, middle: np.ndarray, radius: float) -> list[Any]:
    """Waypoints from a lane onward ('next') or back ('previous') to the radius, forks straight on.

    Ends early where the lane does, or after four radii on a road that winds.
    """
    line: list[Any] = []
    here = start
    for _ in range(int(4 * radius / STEP)):
        options = getattr(here, way)(STEP)
        if not options or _distance(_position(here.transform.location)[None], middle)[0] > radius:
            break
        direction = _heading(here)
        here = max(options, key=lambda w: float(_heading(w) @ direction))
        line.append(here)
    return line


def _crossings(walks: list[BaseGeometry]) -> Iterator[np.ndarray]:
    """The middle line of each crosswalk, along its longer side and 3 m beyond (N, 2)."""
    for walk in walks:
        corners = np.array(walk.minimum_rotated_rectangle.exterior.coords)[:4]
        sides = np.diff(corners[:3], axis=0)
        along = sides[np.argmax(np.hypot(*sides.T))]
        reach = along / 2 + 3.0 * along / np.linalg.norm(along)
        middle = corners.mean(0)
        yield _resample(np.array([middle - reach, middle + reach]))


def _pavements(strips: list[_Strip]) -> Iterator[np.ndarray]:
    """The middle lines of sidewalks (N, 2), joined where one goes on from another."""
    lines = [s.center[:, :2] for s in strips if s.kind in SIDEWALK]
    while lines:
        line = lines.pop()
        grown = True
        while grown:
            grown = False
            for i, other in enumerate(lines):
                for a in (line, line[::-1]):
                    for b in (other, other[::-1]):
                        if not grown and np.hypot(*(a[-1] - b[0])) < 1.5:
                            line, grown = np.concatenate([a, b]), True
                            del lines[i]
                if grown:
                    break
        yield _resample(line)


def _heading(waypoint: Any) -> np.ndarray:
    """Unit vector along a waypoint's lane in the world frame (2,)."""
    yaw = -np.radians(waypoint.transform.rotation.yaw)
    return np.array([np.cos(yaw), np.sin(yaw)])


def _resample(line: np.ndarray) -> np.ndarray:
    """Points evenly spaced in plan, about 1 m apart."""
    steps = np.hypot(*np.diff(line[:, :2], axis=0).T)
    arc = np.concatenate([[0.0], np.cumsum(steps)])
    even = np.linspace(0, arc[-1], max(2, round(arc[-1] / STEP) + 1))
    return np.column_stack([np.interp(even, arc, column) for column in line.T])


def _deduplicate(points: np.ndarray) -> np.ndarray:
    """Points (P, 3) less those within 0.5 m of an earlier one: roads share their signals."""
    kept: list[np.ndarray] = []
    for point in points:
        if all(np.hypot(*(point - other)[:2]) >= 0.5 for other in kept):
            kept.append(point)
    return np.array(kept).reshape(-1, 3)


def _distance(points: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Plan distance of points (N, 2 or 3) from the middle [m]."""
    return np.hypot(*(points[:, :2] - middle[:2]).T)
