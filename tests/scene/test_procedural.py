"""The built-in intersections, against areas on paper and the rules of the road."""

from itertools import permutations

import numpy as np
import pytest
import shapely
from shapely import affinity
from shapely.geometry import LineString, Point, box
from shapely.ops import unary_union

from inspe_jax.core.errors import InspeError
from inspe_jax.scene.procedural.built_ins import BUILT_INS, built_in, crossing
from inspe_jax.scene.regions import Region

PLACES = {name: built_in(name) for name in BUILT_INS}
PLACES["one half empty"] = crossing("one half empty", (0, 60, 120), (1, 1, 1))
ARMS = dict(four_way=4, five_way=5, t_junction=3, triangle=3, roundabout=4, highway_ramp=3)
ON_FOOT = [n for n in PLACES if "ramp" not in n]

every_place = pytest.mark.parametrize("name", PLACES)


def carriageway(place):
    """Driveway and junction, with the seams at the mouths (which never quite touch) closed."""
    both = unary_union([place.regions[r] for r in (Region.DRIVEWAY, Region.JUNCTION)])
    return both.buffer(1e-6, join_style="mitre")


def routes(place, user):
    return [r for r in place.routes if r.user == user]


def headings(route):
    step = np.diff(route.waypoints[:, :2], axis=0)
    return step / np.hypot(*step.T)[:, None]


def test_areas_of_the_four_way():
    """Roads of 14 m to 120 m, kerbs of 8 m radius, gutters of 1 m and sidewalks of 3 m.

    An arc drawn in 3° chords encloses 0.05 % less than the circle, so 1e-3 of a corner's area.
    """
    regions = PLACES["four_way"].regions
    quarter, mouth = np.pi / 4, 7 + 8
    junction = 30 * 30 - 4 * quarter * 8**2
    assert regions[Region.JUNCTION].area == pytest.approx(junction, abs=4e-3 * 64)
    assert regions[Region.DRIVEWAY].area == pytest.approx(4 * (120 - mouth) * 14, rel=1e-9)
    # Spanning the gutters on both sides.
    assert regions[Region.CROSSWALK].area == pytest.approx(4 * 3 * 16, rel=1e-9)
    # Eight straights and four quarter rings each.
    straights = 8 * (120 - mouth)
    gutters = straights + 4 * quarter * (8**2 - 7**2)
    walks = 3 * straights + 4 * quarter * (7**2 - 4**2)
    assert regions[Region.SHOULDER].area == pytest.approx(gutters, rel=1e-3)
    assert regions[Region.SIDEWALK].area == pytest.approx(walks, rel=1e-3)
    # Poles may stand on all of it but the eight crosswalk ends of 3 m by 1 m in the gutters.
    assert PLACES["four_way"].mounting.area == pytest.approx(gutters + walks - 24, rel=1e-3)


def test_areas_of_the_roundabout():
    """The ring is 6 m round an island of 12 m, which with the splitters is left out of the road."""
    place = PLACES["roundabout"]
    ring = Point(0, 0).buffer(18, 90).difference(Point(0, 0).buffer(12, 90))
    assert ring.difference(place.regions[Region.JUNCTION]).area < 0.005 * ring.area
    assert not place.regions[Region.JUNCTION].intersects(Point(0, 0).buffer(11.98))
    # Kerbs of 12 m bend from 4.5 m beside the axis onto the ring: 16.5² + mouth² = 30².
    mouth = np.sqrt(30**2 - 16.5**2)
    assert [np.hypot(*arm.mouth) for arm in place.arms] == pytest.approx([mouth] * 4)
    assert place.mounting.contains(Point(0, 0).buffer(11.9))
    for x, y in ((21, 0), (0, 32)):  # on a splitter, before and beyond the crosswalk
        assert place.mounting.contains(Point(x, y))
        assert not carriageway(place).contains(Point(x, y))


def test_areas_of_the_motorway():
    """Three lanes of 3.6 m each way, 2.5 m from the axis; westbound it is one strip of 240 m."""
    place = PLACES["highway_ramp"]
    nose = place.arms[1].mouth[0]
    driveway = place.regions[Region.DRIVEWAY]
    assert driveway.intersection(box(-120, 0, 120, 50)).area == pytest.approx(240 * 10.8)
    eastbound = driveway.intersection(box(-120, -13.3, 120, 0)).area
    assert eastbound == pytest.approx((120 + nose + 120 - 70) * 10.8)
    # Through lanes from the nose, and the extra one from the nose to 30 m, then half of it to 70.
    ahead = place.regions[Region.JUNCTION].intersection(box(-30, -50, 120, 0)).area
    assert ahead == pytest.approx(100 * 10.8 + 60 * 3.6 + 40 * 3.6 / 2, rel=1e-6)
    assert -60 < nose < -30
    # Shoulders are 1 m at the median and 3 m outside, without a gap; one gore to the nose.
    shoulder = place.regions[Region.SHOULDER]
    paved = unary_union([carriageway(place), shoulder.buffer(1e-6, join_style="mitre")])
    assert shoulder.intersection(box(-120, 0, 120, 50)).area == pytest.approx(240 * 4)
    for x, outer in ((0, 13.3 + 3.6 + 3), (100, 13.3 + 3)):
        across = LineString([(x, 0), (x, -50)]).intersection(paved)
        assert across.bounds == pytest.approx((x, -outer, x, -1.5), abs=1e-5)
        assert across.length == pytest.approx(outer - 1.5, abs=1e-5)
    for back, parts in ((1, 1), (10, 1), (50, 2)):  # between 10 m and 50 m the verge begins
        across = LineString([(nose - back, -2), (nose - back, -50)]).intersection(paved)
        assert len(shapely.get_parts(across)) == parts


def turned(degrees):
    return lambda shape: affinity.rotate(shape, degrees, origin=(0, 0))


def mirrored(x, y):
    return lambda shape: affinity.scale(shape, x, y, origin=(0, 0))


def points_of(lines):
    """Waypoints, rounded to 1 µm, one tuple a line; adding 0.0 unsigns zeros."""
    return {tuple(map(tuple, (np.round(line, 6) + 0.0).tolist())) for line in lines}


@pytest.mark.parametrize(("name", "moved", "backwards"), [
    ("four_way", turned(90), False),
    ("four_way", mirrored(1, -1), True),  # in the mirror everybody drives on the left
    ("triangle", turned(120), False),
    ("roundabout", turned(90), False),
    ("roundabout", mirrored(1, -1), True),
    ("t_junction", mirrored(-1, 1), True),
])  # fmt: skip
def test_places_are_symmetric(name, moved, backwards):
    place = PLACES[name]
    for shape in (*place.regions.values(), place.mounting):
        assert moved(shape).symmetric_difference(shape).area < 1e-6
    if name == "four_way":
        lines = [r.waypoints[:: -1 if backwards else 1, :2] for r in place.routes]
        turned_lines = [shapely.get_coordinates(moved(LineString(line))) for line in lines]
        assert points_of(turned_lines) == points_of(r.waypoints[:, :2] for r in place.routes)
        feet = [shapely.get_coordinates(moved(Point(p))) for p in place.poles]
        assert points_of(feet) == points_of(place.poles[:, None, :2])


@every_place
def test_regions_lie_side_by_side(name):
    """Only crosswalks overlap what they cross; no slivers, spikes or stray specks anywhere, and no
    gap to the nearest sidewalk's far side, but for a motorway's median."""
    place = PLACES[name]
    flat = [r for r in Region if r != Region.CROSSWALK]
    for i, a in enumerate(flat):
        for b in flat[i + 1 :]:
            assert place.regions[a].intersection(place.regions[b]).area < 1e-6, (a, b)
    walks = place.regions[Region.CROSSWALK]
    assert walks.intersection(place.regions[Region.SIDEWALK]).area < 1e-6
    across = unary_union([place.regions[r] for r in (Region.DRIVEWAY, Region.SHOULDER)])
    if name in ON_FOOT and "round" not in name:
        assert walks.difference(across.buffer(1e-6)).area < 1e-6
    for shape in (*place.regions.values(), place.mounting):
        assert shape.is_valid
        for part in shapely.get_parts(shape):
            # 30 cm is half the gore's nose; nothing else is narrower than a gutter.
            assert part.buffer(-0.29).area > 0.3 * part.area
            rounded = part.buffer(-0.1).buffer(0.101, join_style="mitre")
            assert part.difference(rounded).area < 0.1
    ground = unary_union([s.buffer(1e-6) for s in (*place.regions.values(), place.mounting)])
    assert ground.contains(Point(0, 0).buffer(2.0))
    assert not ground.interiors
    free = place.mounting.difference(unary_union(list(place.regions.values())))
    assert (free.area > 1) == (name in ("roundabout", "highway_ramp"))  # islands, a median


@every_place
def test_mounting_is_off_the_road_and_carries_every_pole(name):
    place = PLACES[name]
    road = unary_union([carriageway(place), place.regions[Region.CROSSWALK]])
    assert place.mounting.area > 100
    assert place.mounting.intersection(road).area < 1e-2
    assert len(place.poles) >= len(place.arms)
    for foot in place.poles:
        assert place.mounting.contains(Point(foot[:2]).buffer(0.2))
        assert road.distance(Point(foot[:2])) > 0.9
        assert foot[2] == 0
    if name in ON_FOOT:
        walks = place.regions[Region.SIDEWALK]
        assert all(walks.contains(Point(p)) for p in place.poles)
    apart = np.hypot(*(place.poles[:, None, :2] - place.poles[None, :, :2]).transpose(2, 0, 1))
    assert apart[np.triu_indices(len(apart), 1)].min() > 4


@every_place
def test_arms_are_the_road_at_the_mouth(name):
    """Kerb to kerb: just inside ``width`` it is road, just outside it is not."""
    place = PLACES[name]
    assert place.name == name
    assert len(place.arms) == ARMS.get(name, len(place.arms))
    for arm in place.arms:
        along, across = arm.axes
        for side in (-1, 1):
            inside, outside = (arm.kerb(side, 0.05) + side * d * across for d in (-0.03, 0.03))
            assert carriageway(place).contains(Point(inside))
            assert not carriageway(place).contains(Point(outside))
        mouth = LineString([arm.kerb(-1), arm.kerb(1)])
        assert place.regions[Region.JUNCTION].distance(mouth) < 1e-6
        assert along @ arm.mouth > 0


@every_place
def test_vehicles_drive_on_the_right_from_rim_to_rim_on_the_arms_named(name):
    """1 m either side of every route is road; no turn is tighter than 1/R a metre: R is the least
    corner's 6 m and half a lane; 10 % for chords. The road's axis is on the left of who comes and
    of who goes."""
    place = PLACES[name]
    road = carriageway(place)
    for route in routes(place, "vehicle"):
        swept = LineString(route.waypoints[:, :2]).buffer(1.0, cap_style="flat")
        assert swept.difference(road).area < 1e-3, route.through
        way = headings(route)
        across, along = np.linalg.det(np.stack([way[:-1], way[1:]], 1)), (way[:-1] * way[1:]).sum(1)
        assert np.abs(np.arctan2(across, along)).max() < 1.1 / 7.75
        step = np.diff(route.arc)
        assert 0.9 < step.min() <= step.max() < 1.01
        ends, way = route.waypoints[[0, -1], :2], way[[0, -1]]
        assert np.hypot(*ends.T) == pytest.approx(110, abs=0.8)
        assert (route.waypoints[:, 2] == 0).all()
        bearings = np.array([place.arms[a].bearing for a in route.through])
        outward = np.column_stack([np.cos(bearings), np.sin(bearings)])
        along = (way * outward).sum(1) * [-1, 1]
        left = way[:, 1] * ends[:, 0] - way[:, 0] * ends[:, 1]
        assert (along > 0.8).all()  # the ramp bends beyond its mouth
        if name in ON_FOOT:
            assert along == pytest.approx(1)
            assert ((left > 1.7) & (left < 14)).all()
            assert (left < [place.arms[a].width for a in route.through]).all()
        else:
            assert np.sign(ends[1, 1]) == -np.sign(way[1, 0])


@every_place
def test_every_movement_and_every_lane_is_served(name):
    place = PLACES[name]
    if name in ON_FOOT:
        pairs = set(permutations(range(len(place.arms)), 2))
        assert {r.through for r in routes(place, "vehicle")} == pairs
    starts = {tuple(r.waypoints[0, :2].round(3)) for r in routes(place, "vehicle")}
    lanes = dict(four_way=8, five_way=7, t_junction=5, triangle=3, roundabout=4, highway_ramp=7)
    assert len(starts) == lanes.get(name, 3)


def test_movements_of_the_four_way():
    """From each of 4 arms: two lanes straight on, one right, one left, each in its own lane."""
    found = routes(PLACES["four_way"], "vehicle")
    assert len(found) == 16
    south = {(r.through[1], round(r.waypoints[0, 0], 2)): r for r in found if r.through[0] == 3}
    assert set(south) == {(0, 5.25), (1, 5.25), (1, 1.75), (2, 1.75)}
    # Round the kerb's centre (15, −15), a lane's half beyond its 8 m.
    right = south[0, 5.25].waypoints[:, :2]
    near = right[np.hypot(*right.T) < 14]
    assert np.hypot(*(near - [15, -15]).T) == pytest.approx(9.75, abs=0.02)


def test_the_ramp_merges_into_the_outer_lane():
    (merging,) = (r for r in routes(PLACES["highway_ramp"], "vehicle") if r.through == (2, 0))
    at = {round(x): y for x, y, _ in merging.waypoints.tolist()}
    assert at[-20] == pytest.approx(-(2.5 + 3.5 * 3.6))
    assert at[60] == pytest.approx(-(2.5 + 2.5 * 3.6))
    start = headings(merging)[0]
    assert np.degrees(np.arctan2(start[1], start[0])) == pytest.approx(18)


@pytest.mark.parametrize("name", ON_FOOT)
def test_people_walk_on_sidewalks_and_crosswalks(name):
    place = PLACES[name]
    paths = unary_union([place.regions[r] for r in (Region.SIDEWALK, Region.CROSSWALK)])
    people = routes(place, "pedestrian")
    assert len(people) == 4 * len(place.arms)  # a crosswalk and a corner each, both ways
    lines = [LineString(route.waypoints[:, :2]) for route in people]
    assert all(line.difference(paths.buffer(1e-6)).length < 1e-6 for line in lines)
    assert sum(line.intersects(carriageway(place)) for line in lines) == 2 * len(place.arms)
    assert points_of(r.waypoints for r in people) == points_of(r.waypoints[::-1] for r in people)
    ramp = PLACES["highway_ramp"]
    assert not routes(ramp, "pedestrian")
    assert all(ramp.regions[r].is_empty for r in (Region.CROSSWALK, Region.SIDEWALK))


def test_a_built_in_that_is_not_known_is_an_error():
    with pytest.raises(InspeError, match=r"no built-in intersection 'round': one of .*did you"):
        built_in("round")
