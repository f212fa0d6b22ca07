"""Intersections built from parameters, no file needed: crossings, roundabouts and ramps.

Flat ground, right-hand traffic, the middle of the junction at (0, 0, 0). Roads are
straight and run 120 m out, so that a region of interest of up to 100 m is filled.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float
from shapely.geometry import LineString, MultiPolygon, Point, Polygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import nearest_points, unary_union

from inspe_jax.errors import InspeError, nearest
from inspe_jax.scene.intersection import Arm, Intersection, Route, mouth_crosswalks
from inspe_jax.scene.regions import Region

LENGTH = 120.0
"""How far roads run from the middle [m]."""
ROUTE_LENGTH = 115.0
"""How far routes run from the middle [m]."""
_SEGMENTS = 16  # of a quarter circle


def crossing(
    name: str,
    bearings_deg: Sequence[float],
    *,
    lanes_in: int | Sequence[int] = 2,
    lanes_out: int | Sequence[int] = 2,
    lane_width: float = 3.5,
    corner_radius: float = 8.0,
    shoulder: float = 1.0,
    sidewalk: float = 3.0,
) -> Intersection:
    """Straight arms that meet at the origin, with crosswalks, shoulders and sidewalks.

    ``bearings_deg`` are the arms' directions, counter-clockwise from +x;
    ``lanes_in`` and ``lanes_out`` lead to and from the junction, one number for
    all arms or one for each; widths and the kerbs' ``corner_radius`` in metres.
    Raises InspeError for fewer than three arms, arms closer than 30°, or an arm
    without lanes.
    """
    bearings = np.radians(np.sort(np.asarray(bearings_deg, float) % 360))
    count = len(bearings)
    gaps = (np.roll(bearings, -1) - bearings) % (2 * np.pi)
    if count < 3 or gaps.min() < np.radians(30):
        raise InspeError(f"{name}: a crossing needs at least three arms, 30° or more apart")
    inward = np.broadcast_to(lanes_in, count)
    outward = np.broadcast_to(lanes_out, count)
    if min(inward.min(), outward.min()) < 0 or (inward + outward).min() < 1:
        raise InspeError(f"{name}: every arm needs a lane")
    left, right = inward * lane_width, outward * lane_width  # kerbs, looking outward

    roads = unary_union(
        [_band(b, 0.0, LENGTH, -r, low) for b, r, low in zip(bearings, right, left, strict=True)]
    )
    carriageway = _rounded(roads, corner_radius)
    mouths = _mouths(bearings, gaps, left, right, corner_radius)
    beyond = unary_union(
        [
            _band(b, m, LENGTH + 10, -r - 0.5, low + 0.5)
            for b, m, low, r in zip(bearings, mouths, left, right, strict=True)
        ]
    )
    junction = carriageway.difference(beyond)
    arms = tuple(
        Arm(tuple(_at(b, m, (low - r) / 2)), float(b), float(low + r))
        for b, m, low, r in zip(bearings, mouths, left, right, strict=True)
    )
    turns = []
    for i in range(count):
        for j in range(count):
            if i != j and inward[i] and outward[j]:
                for k, n in _lane_pairs(bearings[i], bearings[j], inward[i], outward[j]):
                    entry = _lane(bearings[i], mouths[i], (k + 0.5) * lane_width)
                    exit_ = _lane(bearings[j], mouths[j], -(n + 0.5) * lane_width)
                    path = _through(entry[::-1], exit_, corner_radius + lane_width / 2)
                    turns.append(Route(path, lane_width, "vehicle", (i, j)))
    return _furnish(name, carriageway, junction, arms, turns, shoulder, sidewalk)


def roundabout(
    name: str = "roundabout",
    *,
    bearings_deg: Sequence[float] = (0, 90, 180, 270),
    island: float = 12.0,
    ring: float = 8.0,
    lane_width: float = 3.75,
    shoulder: float = 1.0,
    sidewalk: float = 3.0,
) -> Intersection:
    """One circulating lane, counter-clockwise, round a central ``island`` of that radius [m].

    ``ring`` is the width of the circulating carriageway; every arm has a lane
    each way. The island can carry a mast.
    """
    bearings = np.radians(np.sort(np.asarray(bearings_deg, float) % 360))
    outer = island + ring
    roads = [_band(b, 0.0, LENGTH, -lane_width, lane_width) for b in bearings]
    paved = unary_union([_disc(outer), *roads])
    middle = _disc(island)
    carriageway = _rounded(paved, 10.0).difference(middle)
    mouth = float(np.hypot(outer + 10.0, lane_width + 10.0) * 0.86)
    beyond = unary_union([_band(b, mouth, LENGTH + 10, -6.0, 6.0) for b in bearings])
    junction = carriageway.difference(beyond)
    arms = tuple(Arm(tuple(_at(b, mouth, 0.0)), float(b), 2 * lane_width) for b in bearings)
    circle, ease = island + ring / 2, np.radians(24)
    routes = []
    for i, a in enumerate(bearings):
        for j, b in enumerate(bearings):
            if i == j:
                continue
            sweep = (b - a) % (2 * np.pi)
            angles = np.linspace(a + ease, a + sweep - ease, max(2, int(circle * sweep)))
            arc = circle * np.column_stack([np.cos(angles), np.sin(angles)])
            entry = _lane(a, mouth, lane_width / 2)[::-1]
            exit_ = _lane(b, mouth, -lane_width / 2)
            first = _through(entry, arc)
            path = _through(first[:, :2], exit_)
            routes.append(Route(path, lane_width, "vehicle", (i, j)))
    return _furnish(name, carriageway, junction, arms, routes, shoulder, sidewalk, middle)


def ramp(
    name: str = "highway_ramp",
    *,
    lanes: int = 3,
    lane_width: float = 3.6,
    median: float = 4.0,
    angle_deg: float = 18.0,
    shoulder: float = 2.5,
) -> Intersection:
    """A motorway along x with an on-ramp that merges into its eastbound side.

    ``lanes`` each way, ``median`` metres apart; the ramp comes from the
    south-west at ``angle_deg`` and runs beside the outer lane for 60 m. Shoulders
    on both sides, no sidewalks and no people.
    """
    half = median / 2
    kerb = half + lanes * lane_width
    angle = np.radians(angle_deg)
    beside = -(kerb + lane_width / 2)  # middle of the acceleration lane
    merge = np.array([-15.0, beside])
    far = merge - LENGTH * np.array([np.cos(angle), np.sin(angle)])
    bend = 30.0
    start, end = merge - bend * np.array([np.cos(angle), np.sin(angle)]), merge + [bend, 0]
    lead = _resample(np.concatenate([[far], _bezier(start, merge, merge, end), [[45.0, beside]]]))
    taper = Polygon([(44, -kerb), (44, -kerb - lane_width), (75, -kerb)])
    west, east = (
        shapely.box(-LENGTH, low, LENGTH, high) for low, high in ((half, kerb), (-kerb, -half))
    )
    lane = LineString(lead).buffer(lane_width / 2, cap_style="flat", quad_segs=_SEGMENTS)
    carriageway = unary_union([west, east, lane, taper])
    merging = shapely.box(-40.0, -kerb - 2 * lane_width, 75.0, -half)
    junction = carriageway.intersection(merging)
    arms = (
        Arm((75.0, 0.0), 0.0, 2 * kerb),
        Arm((-40.0, 0.0), float(np.pi), 2 * kerb),
        Arm((float(start[0]), float(start[1])), float(np.pi + angle), lane_width),
    )
    routes = []
    for k in range(lanes):
        y = half + (k + 0.5) * lane_width
        reach = ROUTE_LENGTH
        for line, through in (
            ([[-reach, -y], [reach, -y]], (1, 0)),
            ([[reach, y], [-reach, y]], (0, 1)),
        ):
            routes.append(Route(_flat(_resample(np.array(line))), lane_width, "vehicle", through))
    outer = np.array([[ROUTE_LENGTH, -kerb + lane_width / 2]])
    aim, meet = outer[0] - [ROUTE_LENGTH - 58, 0], outer[0] - [ROUTE_LENGTH - 70, 0]
    joined = _bezier(lead[-1], lead[-1] + [12, 0], aim, meet)
    path = _resample(np.concatenate([lead[:-1], joined, outer]))
    path = path[np.hypot(*path.T) <= ROUTE_LENGTH]
    routes.append(Route(_flat(path), lane_width, "vehicle", (2, 0)))
    edge = carriageway.buffer(shoulder, quad_segs=_SEGMENTS, join_style="mitre")
    strips = edge.difference(carriageway).intersection(shapely.box(-LENGTH, -200, LENGTH, 200))
    regions = {
        Region.DRIVEWAY: carriageway.difference(junction),
        Region.JUNCTION: junction,
        Region.CROSSWALK: MultiPolygon(),
        Region.SIDEWALK: MultiPolygon(),
        Region.SHOULDER: strips,
    }
    outside = strips.buffer(-0.3)
    wanted = [(x, y) for y in (kerb + shoulder, -kerb - shoulder) for x in (-80, -40, 0, 40, 80)]
    poles = np.array([[*_stand(outside, xy), 0.0] for xy in wanted])
    note = "a motorway: no sidewalks and no crosswalks"
    return _assemble(name, regions, arms, routes, strips, poles, (note,))


def _furnish(
    name: str,
    carriageway: BaseGeometry,
    junction: BaseGeometry,
    arms: tuple[Arm, ...],
    routes: list[Route],
    shoulder: float,
    sidewalk: float,
    island: BaseGeometry | None = None,
) -> Intersection:
    """Shoulders, sidewalks, crosswalks, people and poles round a carriageway."""
    solid = carriageway if island is None else carriageway.union(island)
    kerb = solid.buffer(shoulder, quad_segs=_SEGMENTS)
    walk = kerb.buffer(sidewalk, quad_segs=_SEGMENTS).difference(kerb)
    crosswalks = mouth_crosswalks(arms).intersection(carriageway)
    square = shapely.box(-LENGTH, -LENGTH, LENGTH, LENGTH)
    regions = {
        Region.DRIVEWAY: carriageway.difference(junction),
        Region.JUNCTION: junction,
        Region.CROSSWALK: crosswalks,
        Region.SIDEWALK: walk.intersection(square),
        Region.SHOULDER: kerb.difference(solid).intersection(square),
    }
    side = shoulder + sidewalk / 2
    people = []
    for arm in arms:
        half = arm.width / 2 + side
        middle = np.array(arm.mouth) + 1.5 * _direction(arm.bearing)
        across = _direction(arm.bearing + np.pi / 2) * half
        lines = [np.array([middle - across, middle + across])]
        far = np.array(arm.mouth) + (ROUTE_LENGTH - np.hypot(*arm.mouth)) * _direction(arm.bearing)
        lines += [np.array([middle + s * across, far + s * across]) for s in (1, -1)]
        for line in lines:
            people += [Route(_flat(_resample(p)), 2.0, "pedestrian") for p in (line, line[::-1])]
    standing = regions[Region.SIDEWALK].buffer(-0.5)
    poles = np.array([[*_stand(standing, corner), 0.0] for corner in _corners(arms)])
    mounting = unary_union([regions[Region.SIDEWALK], regions[Region.SHOULDER]])
    if island is not None:
        mounting = mounting.union(island.buffer(-1.0))
    return _assemble(name, regions, arms, [*routes, *people], mounting, poles, ())


def _assemble(
    name: str,
    regions: dict[Region, BaseGeometry],
    arms: tuple[Arm, ...],
    routes: Sequence[Route],
    mounting: BaseGeometry,
    poles: Float[np.ndarray, "P 3"],
    notes: tuple[str, ...],
) -> Intersection:
    return Intersection(
        name=name,
        source="built-in",
        center=np.zeros(3),
        regions={region: _surface(shape) for region, shape in regions.items()},
        arms=arms,
        routes=tuple(routes),
        mounting=_surface(mounting.difference(regions[Region.CROSSWALK])),
        poles=poles,
        ground_points=np.array([[x, y, 0.0] for x in (-LENGTH, LENGTH) for y in (-LENGTH, LENGTH)]),
        notes=notes,
    )


# ── Shapes ──────────────────────────────────────────────────────────────────


def _surface(shape: BaseGeometry) -> BaseGeometry:
    """The polygons of a shape, without the lines where two only touched."""
    parts = [g for g in shapely.get_parts(shape) if g.geom_type == "Polygon" and g.area > 1e-6]
    return MultiPolygon(parts)


def _direction(bearing: float) -> Float[np.ndarray, "2"]:
    return np.array([np.cos(bearing), np.sin(bearing)])


def _at(bearing: float, along: float, left: float) -> Float[np.ndarray, "2"]:
    """A point so far along an arm and to the left of its axis, looking outward."""
    return along * _direction(bearing) + left * _direction(bearing + np.pi / 2)


def _band(bearing: float, start: float, end: float, right: float, left: float) -> Polygon:
    """A strip of an arm, from ``right`` to ``left`` of its axis."""
    corners = ((start, right), (end, right), (end, left), (start, left))
    return Polygon([_at(bearing, *corner) for corner in corners])


def _disc(radius: float) -> Polygon:
    return Point(0, 0).buffer(radius, quad_segs=4 * _SEGMENTS)


def _rounded(shape: BaseGeometry, radius: float) -> BaseGeometry:
    """Inner corners filled to an arc of ``radius``: grown by it, then shrunk."""
    grown = shape.buffer(radius, quad_segs=_SEGMENTS, join_style="mitre")
    return grown.buffer(-radius, quad_segs=_SEGMENTS)


def _mouths(
    bearings: np.ndarray, gaps: np.ndarray, left: np.ndarray, right: np.ndarray, radius: float
) -> Float[np.ndarray, " A"]:
    """How far along each arm its kerbs run straight: where the corners' arcs begin [m].

    Kerbs of two arms at an angle g, at distances l and r from their axes, meet
    (r + l cos g)/sin g along the first; an arc of ``radius`` begins
    radius/tan(g/2) further out. Arms that face each other have no corner.
    """
    count = len(bearings)
    mouths = np.full(count, 1.0)
    for i in range(count):
        j, g = (i + 1) % count, gaps[i]
        if g > np.radians(175):
            continue
        arc = radius / np.tan(g / 2)
        mouths[i] = max(mouths[i], (right[j] + left[i] * np.cos(g)) / np.sin(g) + arc)
        mouths[j] = max(mouths[j], (left[i] + right[j] * np.cos(g)) / np.sin(g) + arc)
    return mouths


def _corners(arms: tuple[Arm, ...]) -> list[np.ndarray]:
    """A point at each corner between neighbouring arms: midway between their kerb points."""
    found = []
    for arm, following in zip(arms, arms[1:] + arms[:1], strict=True):
        a = np.array(arm.mouth) + arm.width / 2 * _direction(arm.bearing + np.pi / 2)
        b = np.array(following.mouth) - following.width / 2 * _direction(
            following.bearing + np.pi / 2
        )
        found.append((a + b) / 2)
    return found


def _stand(ground: BaseGeometry, wanted: Any) -> tuple[float, float]:
    """The nearest point of ``ground`` to a wanted one."""
    foot = nearest_points(ground, Point(*wanted))[0]
    return foot.x, foot.y


# ── Routes ──────────────────────────────────────────────────────────────────


def _lane_pairs(a: float, b: float, lanes_in: int, lanes_out: int) -> list[tuple[int, int]]:
    """(entry, exit) lanes of one movement, counted from the road's axis.

    Right turns keep to the outermost lanes, left turns to the innermost;
    straight on every lane keeps its place, as far as the exit has lanes.
    """
    turn = (b - a) % (2 * np.pi)  # leaving at b, having come in along a + π
    if turn < np.radians(140):
        return [(lanes_in - 1, lanes_out - 1)]
    if turn > np.radians(220):
        return [(0, 0)]
    return [(k, k) for k in range(min(lanes_in, lanes_out))]


def _lane(bearing: float, mouth: float, left: float) -> Float[np.ndarray, "N 2"]:
    """The middle of a lane from the mouth outward, 1 m apart."""
    return _resample(np.array([_at(bearing, mouth, left), _at(bearing, ROUTE_LENGTH, left)]))


def _through(
    entry: Float[np.ndarray, "N 2"], exit_: Float[np.ndarray, "M 2"], corner: float = np.inf
) -> Float[np.ndarray, "K 3"]:
    """Entry lane, a curve tangent to both, exit lane: waypoints about 1 m apart.

    Where the two lanes' lines meet ahead, the curve is the arc that begins and ends
    equally far from that point, as far out as both lanes allow; on a right turn its
    radius is at most ``corner`` [m], so that it stays off the kerb.
    """
    a, b = entry[-1], exit_[0]
    u, v = _unit(a - entry[-2]), _unit(exit_[1] - b)
    cross = u[0] * v[1] - u[1] * v[0]
    if abs(cross) > 0.05:
        before = ((b - a)[0] * v[1] - (b - a)[1] * v[0]) / cross  # from a to the meeting point
        after = ((b - a)[0] * u[1] - (b - a)[1] * u[0]) / cross  # from the meeting point to b
        widest = corner * np.tan(np.arccos(np.clip(u @ v, -1, 1)) / 2) if cross < 0 else np.inf
        reach = min(before, -after, widest)
        if reach > 0:
            a, b = a + (before - reach) * u, b + (after + reach) * v
    chord = np.hypot(*(b - a))
    turn = max(float(np.arccos(np.clip(u @ v, -1, 1))), 1e-3)
    handle = chord * (2 / 3) * np.tan(turn / 4) / np.sin(turn / 2)  # nearest cubic to the arc
    curve = _bezier(a, a + handle * u, b - handle * v, b)
    return _flat(_resample(np.concatenate([entry, curve, exit_])))


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.hypot(*vector)


def _bezier(*points: np.ndarray) -> Float[np.ndarray, "40 2"]:
    """A cubic curve from the first to the last of four points."""
    t = np.linspace(0, 1, 40)[:, None]
    a, b, c, d = points
    return (1 - t) ** 3 * a + 3 * (1 - t) ** 2 * t * b + 3 * (1 - t) * t**2 * c + t**3 * d


def _resample(points: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "M 2"]:
    """The same line with points 1 m apart, or a little less."""
    steps = np.hypot(*np.diff(points, axis=0).T)
    points = points[np.concatenate([[True], steps > 1e-9])]
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    at = np.linspace(0, arc[-1], int(np.ceil(arc[-1])) + 1)
    return np.column_stack([np.interp(at, arc, points[:, k]) for k in range(2)])


def _flat(points: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 3"]:
    return np.column_stack([points, np.zeros(len(points))])


BUILT_INS: dict[str, Callable[[], Intersection]] = {
    "four_way": lambda: crossing("four_way", (0, 90, 180, 270)),
    "five_way": lambda: crossing("five_way", (0, 65, 140, 205, 285)),
    "t_junction": lambda: crossing("t_junction", (0, 180, 270)),
    "triangle": lambda: crossing("triangle", (90, 210, 330), lanes_in=1, lanes_out=1),
    "roundabout": roundabout,
    "highway_ramp": ramp,
}
"""The built-in intersections by name. ``triangle`` is three roads that meet at 120°."""


def built_in(name: str) -> Intersection:
    """A built-in intersection. Raises InspeError with the names there are."""
    if name not in BUILT_INS:
        raise InspeError(
            f"no built-in intersection '{name}': one of {', '.join(BUILT_INS)}"
            + nearest(name, tuple(BUILT_INS))
        )
    return BUILT_INS[name]()
