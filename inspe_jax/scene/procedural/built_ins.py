"""Intersections built from parameters, without a file: crossings, roundabouts and ramps.

The ground is flat at z = 0, traffic drives on the right, and the middle of the junction is
at (0, 0, 0). Roads are 120 m long, which fills a region of interest of up to 100 m. All
shapes follow from the kerbs. Each kerb is one line from road to road round a corner. The
shoulder, sidewalk and footpath are offsets of it, so there are no gaps between them.
"""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float
from shapely.geometry import MultiPolygon, Polygon, box

from inspe_jax.core.errors import InspeError, nearest
from inspe_jax.scene.intersection import CROSSWALK_WIDTH, Arm, Intersection
from inspe_jax.scene.lines import resampled, turned
from inspe_jax.scene.procedural.curves import (
    arc,
    at_distance,
    bend,
    joined,
    offset,
    onto_ring,
)
from inspe_jax.scene.procedural.roads import (
    LENGTH,
    ROUTE_LENGTH,
    Road,
    corners,
    gap,
    on_level_ground,
    route,
    station,
    strip,
    town,
    turns,
)
from inspe_jax.scene.regions import Region

NARROWEST = 40.0
"""Least angle between neighbouring arms [deg]."""

_NOSE = 0.6  # width at which the gore between motorway and ramp begins [m]
_PARALLEL, _TAPER, _END = -30.0, 30.0, 70.0  # x where the extra lane begins, narrows, ends [m]
_VERGE = 2.0  # strip beyond a motorway's shoulder where lamps stand [m]
_LAMPS = (-80.0, -40.0, 0.0, 40.0, 80.0)  # x of the lamps [m]
_EAST = np.array([1.0, 0.0])


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
    """Straight roads that meet at the origin, with crosswalks, shoulders and sidewalks.

    ``bearings_deg`` are the directions in which they leave it, counter-clockwise from +x.
    ``lanes_in`` and ``lanes_out`` lead to and from the junction: one number for all arms, or one
    for each. ``corner_radius`` is that of the kerbs. Widths and radii are in metres. The line
    between inbound and outbound lanes of every arm points at the origin. Arms are sorted by
    bearing. The junction ends where the kerbs begin to run straight; crosswalks lie just outside
    it. There is a signal pole at each corner. Where the kerb runs on without a corner, there is
    one on either side.

    Raises InspeError for fewer than three arms, arms less than 40° apart, an arm without lanes,
    or widths out of range.
    """
    _check("lane width", lane_width, 2.0, 6.0)
    _check_kerbs(corner_radius, shoulder, sidewalk)
    order = _in_order(name, bearings_deg)
    inbound, outbound = (
        _each(name, key, lanes, order)
        for key, lanes in (("lanes_in", lanes_in), ("lanes_out", lanes_out))
    )
    roads = [
        Road(float(np.radians(bearings_deg[i] % 360)), n_in, n_out, lane_width)
        for i, n_in, n_out in zip(order, inbound, outbound, strict=True)
    ]
    for road in roads:
        if not road.lanes_in + road.lanes_out:
            where = f"{np.degrees(road.bearing):g}°"
            raise InspeError(f"{name}: every arm needs a lane, and the one at {where} has none")
    mouths, kerbs = corners(roads, corner_radius)
    routes = list(turns(roads, mouths, corner_radius))
    return town(name, roads, mouths, kerbs, routes, shoulder=shoulder, sidewalk=sidewalk)


def roundabout(
    name: str = "roundabout",
    *,
    bearings_deg: Sequence[float] = (0, 90, 180, 270),
    island: float = 12.0,
    ring: float = 6.0,
    lane_width: float = 3.5,
    splitter: float = 2.0,
    corner_radius: float = 12.0,
    shoulder: float = 1.0,
    sidewalk: float = 3.0,
) -> Intersection:
    """A roundabout of one lane, counter-clockwise round an ``island`` of that radius [m].

    ``ring`` is the width of the circulating carriageway. Each arm has one lane each way, on either
    side of a ``splitter`` island of that width, which continues as a painted median. Its crosswalk
    is about a car's length from the ring. ``corner_radius`` is that of the kerbs between arm and
    ring. Widths and radii are in metres. The islands belong to no region, but can carry a pole.

    Raises InspeError as :func:`crossing`, or if two arms do not fit beside each other.
    """
    _check("island", island, 4.0, 40.0)
    _check("ring", ring, 4.0, 12.0)
    _check("lane width", lane_width, 2.0, ring)
    _check("splitter", splitter, 1.0, 6.0)
    _check_kerbs(corner_radius, shoulder, sidewalk)
    order = _in_order(name, bearings_deg)
    roads = [
        Road(float(np.radians(bearings_deg[i] % 360)), 1, 1, lane_width, splitter) for i in order
    ]
    outer = island + ring

    def from_to(a: Road, b: Road, left: float, radius: float, bend: float) -> np.ndarray:
        """In along one road, ``left`` of its axis, round the ring, and out along another."""
        on = onto_ring(left, radius, bend)
        until = float(np.arctan2(on[-1, 1], on[-1, 0]))
        sweep = gap(a, b)
        round_it = arc(np.zeros(2), radius, until, sweep - until)
        off = turned(on * [1, -1], sweep)[::-1]
        return turned(joined(on, round_it, off), a.bearing)

    ease = onto_ring(roads[0].left, outer, corner_radius)
    narrowest = 2 * np.degrees(np.arctan2(ease[-1, 1], ease[-1, 0]))
    neighbours = list(zip(roads, roads[1:] + roads[:1], strict=True))
    closest = np.degrees(min(gap(a, b) for a, b in neighbours))
    if closest < narrowest:
        raise InspeError(
            f"{name}: arms {closest:.0f}° apart do not fit on a ring of {outer:g} m: "
            f"at least {np.ceil(narrowest):.0f}°"
        )
    mouth = float(ease[0, 0])
    kerbs = [from_to(a, b, a.left, outer, corner_radius) for a, b in neighbours]
    # A lane keeps its distance from the kerb on the arm, and follows the middle of the ring.
    lane = roads[0].lane(0)
    inner, bent = island + ring / 2, corner_radius + lane_width / 2
    routes = []
    for i, a in enumerate(roads):
        for j, b in enumerate(roads):
            if i != j:
                ends = a.at(station(lane), lane), b.at(station(lane), -lane)
                path = joined(ends[0], from_to(a, b, lane, inner, bent), ends[1])
                routes.append(route(path, lane_width, (i, j)))
    drop = _teardrop(splitter / 2, outer, mouth)
    islands = [Polygon(turned(drop, road.bearing)) for road in roads]
    islands.append(Polygon(arc(np.zeros(2), island, 0, 2 * np.pi)[:-1]))
    return town(
        name, roads, [mouth] * len(roads), kerbs, routes, shoulder=shoulder, sidewalk=sidewalk,
        islands=MultiPolygon(islands),
        notes=("the central island and the splitter islands belong to no region",),
    )  # fmt: skip


def ramp(
    name: str = "highway_ramp",
    *,
    lanes: int = 3,
    lane_width: float = 3.6,
    median: float = 3.0,
    angle_deg: float = 18.0,
    bend_radius: float = 120.0,
    shoulder: float = 3.0,
    inner_shoulder: float = 1.0,
) -> Intersection:
    """A motorway along x, and an on-ramp that merges into its eastbound carriageway.

    There are ``lanes`` lanes each way, on either side of a ``median``. The ramp has one lane. It
    comes from the south-west at ``angle_deg``, bends with ``bend_radius``, runs beside the outer
    lane to x = 30 m, and tapers off until 70 m. The junction is the eastbound carriageway from
    the nose of the gore to the end of the taper. There are shoulders (``inner_shoulder`` at the
    median), but no sidewalks, crosswalks or pedestrians. Lamps stand on the verge, 2 m wide,
    beyond the shoulder. Widths are in metres. Raises InspeError for a value out of range.
    """
    if lanes not in range(1, 7):
        raise InspeError(f"{name}: lanes {lanes} is out of range: a whole number from 1 to 6")
    _check("lane width", lane_width, 2.5, 5.0)
    _check("median", median, 1.0, 20.0)
    _check("ramp angle", angle_deg, 8.0, 45.0, unit="°")
    _check("bend radius", bend_radius, 50.0, 50.0 / np.tan(np.radians(angle_deg) / 2))
    _check("shoulder", shoulder, 1.0, 5.0)
    _check("inner shoulder", inner_shoulder, 0.5, 5.0)
    low = median / 2 + inner_shoulder
    high = low + lanes * lane_width  # kerb of the through lanes
    beside, outer_lane = -(high + lane_width / 2), -(high - lane_width / 2)
    angle = np.radians(angle_deg)
    up = np.array([np.cos(angle), np.sin(angle)])

    # The ramp's middle line: straight, then an arc that ends beside the outer lane, then along it.
    turn = np.array([_PARALLEL - bend_radius * np.tan(angle / 2), beside])
    along = bend(turn - LENGTH * up, up, np.array([_TAPER, beside]), _EAST, bend_radius)[1:]
    middle = joined(resampled(np.array([at_distance(turn, -up, LENGTH), along[0]])), along)
    left, right = offset(middle, lane_width / 2), offset(middle, -lane_width / 2)
    taper = bend(right[-1], _EAST, np.array([_END, -high]), _EAST)
    edge = joined(right, taper, np.array([LENGTH, -high]))
    k = int(np.flatnonzero(left[:, 1] <= -high - _NOSE)[-1])  # the gore's nose is beside left[k]
    nose = float(left[k, 0])
    west = np.array([[nose, -high], [nose, -low], [_END, -low]])
    merging = joined(west, taper[::-1], right[: k - 1 : -1], left[k])

    driveway = [
        box(-LENGTH, low, LENGTH, high),
        box(-LENGTH, -high, nose, -low),
        box(_END, -high, LENGTH, -low),
        Polygon(joined(left[: k + 1], right[k::-1])),
    ]
    shoulders = [
        box(-LENGTH, median / 2, LENGTH, low),
        box(-LENGTH, -low, LENGTH, -median / 2),
        box(-LENGTH, high, LENGTH, high + shoulder),
        strip(edge, 0.0, shoulder),
        _gore(left[: k + 1], -high, shoulder, inner_shoulder),
    ]
    regions = {
        Region.DRIVEWAY: MultiPolygon(driveway),
        Region.JUNCTION: Polygon(merging),
        Region.CROSSWALK: MultiPolygon(),
        Region.SIDEWALK: MultiPolygon(),
        Region.SHOULDER: MultiPolygon(shoulders),
    }
    mounting = [
        box(-LENGTH, -median / 2, LENGTH, median / 2),
        box(-LENGTH, high, LENGTH, high + shoulder + _VERGE),
        strip(edge, 0.0, shoulder + _VERGE),
    ]
    back = shoulder + _VERGE / 2
    southern = np.interp(_LAMPS, *offset(edge, -back).T)
    lamps = [(x, y, 0.0) for x, y in zip(_LAMPS, southern, strict=True)]
    lamps += [(x, high + back, 0.0) for x in _LAMPS]

    x, y = (left[k] + right[k]) / 2
    to_left = left[k] - right[k]
    arms = (
        Arm((_END, 0.0), 0.0, 2 * high),
        Arm((nose, 0.0), np.pi, 2 * high),
        Arm((float(x), float(y)), float(np.arctan2(to_left[0], -to_left[1])), lane_width),
    )
    routes = []
    for lane in low + lane_width * (np.arange(lanes) + 0.5):
        for to, through in ((1, (1, 0)), (-1, (0, 1))):
            ends = np.array([[-to * ROUTE_LENGTH, -to * lane], [to * ROUTE_LENGTH, -to * lane]])
            routes.append(route(ends, lane_width, through))
    merge = bend(np.array([0.0, beside]), _EAST, np.array([45.0, outer_lane]), _EAST)
    first, last = at_distance(turn, -up, ROUTE_LENGTH), np.array([ROUTE_LENGTH, outer_lane])
    routes.append(route(joined(first, along[:-1], merge, last), lane_width, (2, 0)))
    note = "a motorway: no crosswalks and no sidewalks"
    return on_level_ground(
        name, regions, arms, routes, MultiPolygon(mounting), np.array(lamps), (note,)
    )


def _gore(
    left: Float[np.ndarray, "N 2"], kerb: float, shoulder: float, inner_shoulder: float
) -> Polygon:
    """The shoulders between a motorway's ``kerb`` (y) and the left edge of a ramp, up to the nose.

    They meet near the nose; farther out the verge separates them.
    """
    beyond = offset(left, inner_shoulder)
    beyond = beyond[beyond[:, 1] <= kerb - shoulder - _NOSE]
    parts, outer = float(beyond[-1, 0]), kerb - shoulder
    motorway = np.array([[parts, outer], [-LENGTH, outer], [-LENGTH, kerb], [left[-1, 0], kerb]])
    return Polygon(joined(left[::-1], beyond, motorway))


def _teardrop(half: float, ring: float, mouth: float) -> Float[np.ndarray, "N 2"]:
    """A splitter island on an arm along +x: round at the ring, tapering beyond the crosswalk."""
    blunt = arc(np.array([ring + 1.0 + half, 0.0]), half, np.pi / 2, 3 * np.pi / 2)
    shoulders = np.array([[mouth + CROSSWALK_WIDTH + 1.0, side * half] for side in (-1, 1)])
    tip = half / 4
    tail = arc(np.array([mouth + CROSSWALK_WIDTH + 15.0, 0.0]), tip, -np.pi / 2, np.pi / 2)
    return joined(blunt, shoulders[0], tail, shoulders[1])


# ── Checks of the parameters ────────────────────────────────────────────────


def _check(what: str, value: float, low: float, high: float, unit: str = " m") -> None:
    if not low <= value <= high:
        raise InspeError(
            f"{what} {value:g}{unit} is out of range: between {low:g} and {high:g}{unit}"
        )


def _check_kerbs(corner_radius: float, shoulder: float, sidewalk: float) -> None:
    _check("shoulder", shoulder, 0.0, 5.0)
    _check("sidewalk", sidewalk, 0.5, 10.0)
    # The sidewalk's outer edge goes round the same corner, on what radius is left.
    _check("corner radius", corner_radius, shoulder + sidewalk + 0.5, 30.0)


def _in_order(name: str, bearings_deg: Sequence[float]) -> list[int]:
    """Indices of the arms by bearing.

    Raises InspeError for fewer than three arms, or two less than :data:`NARROWEST` apart.
    """
    bearings = np.asarray(bearings_deg, float) % 360
    order = [int(i) for i in np.argsort(bearings)]
    gaps = np.diff(bearings[order], append=bearings[order[:1]] + 360)
    if len(order) < 3 or not gaps.min() >= NARROWEST:
        given = ", ".join(f"{b:g}" for b in bearings_deg)
        raise InspeError(
            f"{name}: arms at {given}°: give at least three arms, {NARROWEST:g}° or more apart"
        )
    return order


def _each(name: str, key: str, lanes: int | Sequence[int], order: list[int]) -> list[int]:
    """Lanes in one direction of every arm, in the order of the arms."""
    listed = list(lanes) if isinstance(lanes, Sequence) else [lanes] * len(order)
    if len(listed) != len(order):
        raise InspeError(
            f"{name}: {key} has {len(listed)} entries for {len(order)} arms: give one number, or "
            "one for each arm"
        )
    for count in listed:
        if count not in range(7):
            raise InspeError(f"{name}: {key} {count} is out of range: a whole number from 0 to 6")
    return [int(listed[i]) for i in order]


BUILT_INS: dict[str, Callable[[], Intersection]] = {
    "four_way": lambda: crossing("four_way", (0, 90, 180, 270)),
    "five_way": lambda: crossing(
        "five_way",
        (0, 65, 125, 180, 270),
        lanes_in=(2, 1, 1, 2, 1),
        lanes_out=(2, 1, 1, 2, 1),
        corner_radius=6.0,
    ),
    "t_junction": lambda: crossing(
        "t_junction", (0, 180, 270), lanes_in=(2, 2, 1), lanes_out=(2, 2, 1)
    ),
    "triangle": lambda: crossing(
        "triangle", (90, 210, 330), lanes_in=1, lanes_out=1, corner_radius=15.0
    ),
    "roundabout": roundabout,
    "highway_ramp": ramp,
}
"""The built-in intersections by name.

``five_way`` is a main street along x, a side street, and two streets that join at an angle.
``triangle`` is three roads that meet at 120°; its junction is a triangle with concave sides.
"""


def built_in(name: str) -> Intersection:
    """A built-in intersection by name. Raises InspeError with the known names."""
    if name not in BUILT_INS:
        raise InspeError(
            f"no built-in intersection '{name}': one of {', '.join(BUILT_INS)}"
            + nearest(name, tuple(BUILT_INS))
        )
    return BUILT_INS[name]()
