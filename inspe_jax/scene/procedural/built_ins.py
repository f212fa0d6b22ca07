"""The built-in intersections: crossings, a roundabout and a motorway ramp, without a file. The
ground is flat at z = 0, traffic drives on the right, the middle of the junction is the origin.
Shoulder, sidewalk and footpath are offsets of kerbs, each one line from road to road."""

from collections.abc import Callable, Sequence
from itertools import permutations

import numpy as np
from jaxtyping import Float
from shapely.geometry import MultiPolygon, Polygon, box

from inspe_jax.core.errors import check_known
from inspe_jax.scene import lines
from inspe_jax.scene.intersection import CROSSWALK_WIDTH, Arm, Intersection
from inspe_jax.scene.lines import arc, at_distance, bend, joined, offset, onto_ring, turned
from inspe_jax.scene.procedural import roads as town_roads
from inspe_jax.scene.procedural.roads import LENGTH, ROUTE_LENGTH, Road, route, station, strip, town
from inspe_jax.scene.regions import Region

LANE = 3.5  # width of a lane in towns [m]
_EAST = np.array([1.0, 0.0])


def crossing(
    name: str, bearings_deg: Sequence[float], lanes: Sequence[int], corner_radius: float = 8.0
) -> Intersection:
    """Straight roads that meet at the origin, with crosswalks, shoulders and sidewalks.

    The junction ends where the kerbs begin to run straight; crosswalks lie just outside it.

    Args:
        name: Name of the place.
        bearings_deg: Directions in which three or more roads leave the origin, counter-clockwise
            from +x, ascending and at least 40° apart.
        lanes: Lanes of each road to the junction, and as many from it.
        corner_radius: Radius of the kerbs [m].
    """
    roads = [Road(float(np.radians(b)), n, LANE) for b, n in zip(bearings_deg, lanes, strict=True)]
    roads, kerbs = town_roads.corners(roads, corner_radius)
    return town(name, roads, kerbs, list(town_roads.turns(roads, corner_radius)))


def roundabout() -> Intersection:
    """A roundabout of one lane, counter-clockwise round an island. Each of four arms has one lane
    each way, on either side of a splitter island, and a crosswalk about a car's length from the
    ring. The islands belong to no region, but can carry a pole."""
    island, ring, splitter, corner_radius = 12.0, 6.0, 2.0, 12.0  # [m]; widths but of the radii
    outer, half = island + ring, splitter / 2 + LANE
    mouth = float(onto_ring(half, outer, corner_radius)[0, 0])
    roads = [Road(float(np.radians(b)), 1, LANE, splitter, mouth) for b in (0, 90, 180, 270)]

    def from_to(a: Road, b: Road, left: float, radius: float, bend: float) -> np.ndarray:
        """In along one road, ``left`` of its axis, round the ring, and out along another."""
        on = onto_ring(left, radius, bend)
        until = float(np.arctan2(on[-1, 1], on[-1, 0]))
        sweep = town_roads.gap(a, b)
        round_it = arc(np.zeros(2), radius, until, sweep - until)
        off = turned(on * [1, -1], sweep)[::-1]
        return turned(joined(on, round_it, off), a.bearing)

    kerbs = [from_to(a, b, half, outer, corner_radius) for a, b in town_roads.neighbours(roads)]
    # A lane keeps its distance from the kerb on the arm, and follows the middle of the ring.
    lane = roads[0].lane(0)
    inner, bent = island + ring / 2, corner_radius + LANE / 2
    routes = []
    for (i, a), (j, b) in permutations(enumerate(roads), 2):
        ends = a.at(station(lane), lane), b.at(station(lane), -lane)
        path = joined(ends[0], from_to(a, b, lane, inner, bent), ends[1])
        routes.append(route(path, LANE, (i, j)))
    drop = _teardrop(splitter / 2, outer, mouth)
    islands = [Polygon(turned(drop, road.bearing)) for road in roads]
    islands.append(Polygon(arc(np.zeros(2), island, 0, 2 * np.pi)[:-1]))
    note = "the central island and the splitter islands belong to no region"
    return town("roundabout", roads, kerbs, routes, MultiPolygon(islands), (note,))


def ramp() -> Intersection:
    """A motorway along x of three lanes each way, and an on-ramp from the south-west that merges
    into its eastbound carriageway: beside the outer lane to x = 30 m, tapering off until 70 m. The
    junction is from the nose of the gore to the end of the taper. There are shoulders and a median,
    lamps on the verge, but no sidewalks, crosswalks or pedestrians."""
    lanes, lane_width, median, shoulder, inner_shoulder = 3, 3.6, 3.0, 3.0, 1.0  # widths [m]
    verge, nose_width = 2.0, 0.6  # [m]; at the nose the gore between motorway and ramp begins
    parallel, narrows, end = -30.0, 30.0, 70.0  # x [m] where the extra lane begins, narrows, ends
    angle, bend_radius = np.radians(18.0), 120.0
    low = median / 2 + inner_shoulder
    high = low + lanes * lane_width  # kerb of the through lanes
    beside, outer_lane = -(high + lane_width / 2), -(high - lane_width / 2)
    up = np.array([np.cos(angle), np.sin(angle)])

    # The ramp's middle line: straight, then an arc that ends beside the outer lane, then along it.
    turn = np.array([parallel - bend_radius * np.tan(angle / 2), beside])
    along = bend(turn - LENGTH * up, up, np.array([narrows, beside]), _EAST, bend_radius)[1:]
    middle = joined(lines.resampled(np.array([at_distance(turn, -up, LENGTH), along[0]])), along)
    left, right = offset(middle, lane_width / 2), offset(middle, -lane_width / 2)
    taper = bend(right[-1], _EAST, np.array([end, -high]), _EAST)
    edge = joined(right, taper, np.array([LENGTH, -high]))
    k = int(np.flatnonzero(left[:, 1] <= -high - nose_width)[-1])  # left[k] is beside the nose
    nose = float(left[k, 0])
    west = np.array([[nose, -high], [nose, -low], [end, -low]])

    driveway = [
        box(-LENGTH, low, LENGTH, high),
        box(-LENGTH, -high, nose, -low),
        box(end, -high, LENGTH, -low),
        Polygon(joined(left[: k + 1], right[k::-1])),
    ]
    # The shoulders of motorway and ramp meet near the nose; farther out the verge separates them.
    rim = -high - shoulder
    beyond = offset(left[: k + 1], inner_shoulder)
    beyond = beyond[beyond[:, 1] <= rim - nose_width]
    apart = np.array([[beyond[-1, 0], rim], [-LENGTH, rim], [-LENGTH, -high], [nose, -high]])
    shoulders = [
        box(-LENGTH, median / 2, LENGTH, low),
        box(-LENGTH, -low, LENGTH, -median / 2),
        box(-LENGTH, high, LENGTH, high + shoulder),
        strip(edge, 0.0, shoulder),
        Polygon(joined(left[k::-1], beyond, apart)),
    ]
    regions = {
        Region.DRIVEWAY: MultiPolygon(driveway),
        Region.JUNCTION: Polygon(joined(west, taper[::-1], right[: k - 1 : -1], left[k])),
        Region.CROSSWALK: MultiPolygon(),
        Region.SIDEWALK: MultiPolygon(),
        Region.SHOULDER: MultiPolygon(shoulders),
    }
    mounting = [
        box(-LENGTH, -median / 2, LENGTH, median / 2),
        box(-LENGTH, high, LENGTH, high + shoulder + verge),
        strip(edge, 0.0, shoulder + verge),
    ]
    x, back = np.arange(-80.0, 81.0, 40.0), shoulder + verge / 2
    sides = np.interp(x, *offset(edge, -back).T), np.full(len(x), high + back)
    lamps = np.concatenate([np.column_stack([x, y, np.zeros(len(x))]) for y in sides])

    to_left, (mouth_x, mouth_y) = left[k] - right[k], ((left[k] + right[k]) / 2).tolist()
    arms = (
        Arm((end, 0.0), 0.0, 2 * high),
        Arm((nose, 0.0), np.pi, 2 * high),
        Arm((mouth_x, mouth_y), float(np.arctan2(to_left[0], -to_left[1])), lane_width),
    )
    routes = []
    for lane in low + lane_width * (np.arange(lanes) + 0.5):
        for to, through in ((1, (1, 0)), (-1, (0, 1))):
            ends = np.array([[-to * ROUTE_LENGTH, -to * lane], [to * ROUTE_LENGTH, -to * lane]])
            routes.append(route(ends, lane_width, through))
    merge = bend(np.array([0.0, beside]), _EAST, np.array([45.0, outer_lane]), _EAST)
    first, last = at_distance(turn, -up, ROUTE_LENGTH), np.array([ROUTE_LENGTH, outer_lane])
    routes.append(route(joined(first, along[:-1], merge, last), lane_width, (2, 0)))
    return Intersection(
        name="highway_ramp",
        regions=regions,
        arms=arms,
        routes=tuple(routes),
        mounting=MultiPolygon(mounting),
        poles=lamps,
        notes=("a motorway: no crosswalks and no sidewalks",),
        **town_roads.LEVEL,
    )


def _teardrop(half: float, ring: float, mouth: float) -> Float[np.ndarray, "N 2"]:
    """A splitter island on an arm along +x: round at the ring, tapering beyond the crosswalk."""
    blunt = arc(np.array([ring + 1.0 + half, 0.0]), half, np.pi / 2, 3 * np.pi / 2)
    shoulders = np.array([[mouth + CROSSWALK_WIDTH + 1.0, side * half] for side in (-1, 1)])
    tip = half / 4
    tail = arc(np.array([mouth + CROSSWALK_WIDTH + 15.0, 0.0]), tip, -np.pi / 2, np.pi / 2)
    return joined(blunt, shoulders[0], tail, shoulders[1])


BUILT_INS: dict[str, Callable[[], Intersection]] = {
    "four_way": lambda: crossing("four_way", (0, 90, 180, 270), (2, 2, 2, 2)),
    "five_way": lambda: crossing("five_way", (0, 65, 125, 180, 270), (2, 1, 1, 2, 1), 6.0),
    "t_junction": lambda: crossing("t_junction", (0, 180, 270), (2, 2, 1)),
    "triangle": lambda: crossing("triangle", (90, 210, 330), (1, 1, 1), 15.0),
    "roundabout": roundabout,
    "highway_ramp": ramp,
}
"""The built-in intersections by name.

``five_way`` is a main street along x, a side street, and two streets that join at an angle.
``triangle`` is three roads that meet at 120°; its junction is a triangle with concave sides.
"""


def built_in(name: str) -> Intersection:
    """A built-in intersection by name. Raises InspeError with the known names.

    >>> place = inspe_jax.built_in("four_way")
    >>> len(place.arms), len(place.poles)
    (4, 4)
    """
    check_known(name, BUILT_INS, "no built-in intersection")
    return BUILT_INS[name]()
