"""The built-in intersections, against areas on paper and the rules of the road."""

import numpy as np
import pytest
from shapely import affinity, union_all
from shapely.geometry import LineString, Point, box

from inspe_jax.errors import InspeError
from inspe_jax.scene.procedural import BUILT_INS, built_in, crossing
from inspe_jax.scene.regions import Region
from inspe_jax.scene.voxels import build_voxels

PLACES = {name: built_in(name) for name in BUILT_INS}
ARMS = dict(four_way=4, five_way=5, t_junction=3, triangle=3, roundabout=4, highway_ramp=3)


def carriageway(place):
    return union_all([place.regions[r] for r in (Region.DRIVEWAY, Region.JUNCTION)])


def test_areas_of_the_four_way_by_hand():
    """Four 14 m arms to 120 m, and four corner fillets of 8 m: (1 − π/4)·8² each.

    The fillets are drawn with 16 chords a quarter, short of the arc by under 0.2 %.
    """
    place = PLACES["four_way"]
    plus = 2 * 240 * 14 - 14**2
    fillets = 4 * (1 - np.pi / 4) * 8**2
    assert carriageway(place).area == pytest.approx(plus + fillets, rel=1e-3)
    # Mouths are 7 + 8 m out; beyond each lies a 3 m crosswalk of 14 m.
    assert [np.hypot(*arm.mouth) for arm in place.arms] == pytest.approx([15.0] * 4)
    assert place.regions[Region.CROSSWALK].area == pytest.approx(4 * 3 * 14)
    assert place.regions[Region.JUNCTION].area == pytest.approx(
        30 * 14 + 2 * 8 * 14 + fillets, rel=1e-3
    )


@pytest.mark.parametrize(
    "turn",
    [lambda g: affinity.rotate(g, 90, (0, 0)), lambda g: affinity.scale(g, 1, -1, origin=(0, 0))],
    ids=["quarter-turn", "mirror"],
)
def test_the_four_way_is_symmetric(turn):
    place = PLACES["four_way"]
    for region, shape in place.regions.items():
        assert turn(shape).symmetric_difference(shape).area < 1e-6, region
    feet = {tuple(p) for p in place.poles[:, :2].round(6).tolist()}
    turned = {tuple(np.round(turn(Point(p)).coords[0], 6).tolist()) for p in feet}
    assert {(x + 0.0, y + 0.0) for x, y in turned} == {(x + 0.0, y + 0.0) for x, y in feet}


@pytest.mark.parametrize("name", PLACES)
def test_every_place_is_furnished(name):
    place = PLACES[name]
    assert place.name == name
    assert len(place.arms) == ARMS[name]
    assert all(shape.is_valid for shape in place.regions.values())
    assert len(place.poles) >= 3
    lanes = carriageway(place)
    for foot in place.poles:
        assert place.mounting.buffer(1e-6).contains(Point(foot[:2]))
        assert lanes.distance(Point(foot[:2])) > 0.2
    assert place.mounting.intersection(lanes).area < 1e-3
    walks = place.regions[Region.CROSSWALK]
    assert place.mounting.intersection(walks).area < 1e-6
    empty = name == "highway_ramp"
    assert walks.is_empty == place.regions[Region.SIDEWALK].is_empty == empty
    assert bool(place.notes) == empty


@pytest.mark.parametrize("name", PLACES)
def test_regions_cover_the_junction_without_gaps(name):
    """Every column on the carriageway is labelled as road."""
    place = PLACES[name]
    grid = build_voxels(place, radius=40, voxel=0.5)
    on = [carriageway(place).contains(Point(c)) for c in grid.columns]
    road = {Region.DRIVEWAY, Region.JUNCTION, Region.CROSSWALK}
    assert {Region(r) for r in grid.region[np.array(on)]} <= road
    assert (grid.region == Region.JUNCTION).sum() > 200


@pytest.mark.parametrize("name", PLACES)
def test_vehicles_drive_on_the_carriageway_to_the_right(name):
    place = PLACES[name]
    lanes = carriageway(place).buffer(0.01)
    vehicles = [r for r in place.routes if r.user == "vehicle"]
    assert {r.through[0] for r in vehicles} | {r.through[1] for r in vehicles} == set(
        range(len(place.arms))
    )
    for route in vehicles:
        line = LineString(route.waypoints[:, :2])
        inside = line.intersection(Point(0, 0).buffer(60))
        assert lanes.contains(inside.buffer(route.width / 2 - 0.45, cap_style="flat")), (
            route.through
        )
        step = np.diff(route.waypoints[:, :2], axis=0)
        assert np.hypot(*step.T).max() <= 1.05
        heading = np.arctan2(step[:, 1], step[:, 0])
        bend = np.abs((np.diff(heading) + np.pi) % (2 * np.pi) - np.pi)
        assert np.degrees(bend).max() < 22  # a radius of 3 m and more
        # Keeping right: entering, the road's axis is on the driver's left.
        entry = place.arms[route.through[0]]
        k = int(np.argmin(np.hypot(*(route.waypoints[:, :2] - entry.mouth).T)))
        k = min(k, len(step) - 1)
        to_axis = np.asarray(entry.mouth) - route.waypoints[k, :2]
        if name != "highway_ramp" or route.through[0] != 2:  # the ramp is one lane
            assert step[k, 0] * to_axis[1] - step[k, 1] * to_axis[0] > 0


def test_traffic_circulates_counter_clockwise():
    for route in PLACES["roundabout"].routes:
        if route.user == "vehicle":
            ring = route.waypoints[np.hypot(*route.waypoints[:, :2].T) < 18]
            turned = np.diff(np.unwrap(np.arctan2(ring[:, 1], ring[:, 0])))
            assert turned.sum() > 0


def test_a_crossing_of_ones_own():
    place = crossing("mine", (10, 130, 250), lanes_in=(1, 2, 1), lanes_out=1, lane_width=3.0)
    assert [arm.width for arm in place.arms] == [6.0, 9.0, 6.0]
    assert np.degrees([arm.bearing for arm in place.arms]).round().tolist() == [10, 130, 250]


@pytest.mark.parametrize(
    ("bearings", "lanes", "message"),
    [
        ((0, 180), 1, "at least three arms"),
        ((0, 20, 180), 1, "30° or more apart"),
        ((0, 120, 240), 0, "every arm needs a lane"),
    ],
)
def test_impossible_crossings(bearings, lanes, message):
    with pytest.raises(InspeError, match=message):
        crossing("odd", bearings, lanes_in=lanes, lanes_out=lanes)


def test_unknown_built_in():
    with pytest.raises(InspeError, match="no built-in intersection 'round': one of four_way"):
        built_in("round")


def test_roads_fill_the_largest_region_of_interest():
    lanes = carriageway(PLACES["four_way"])
    assert lanes.contains(box(-119, -6, 119, 6))
