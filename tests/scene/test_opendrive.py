"""OpenDRIVE reader: against hand-made maps, the raw XML, CARLA's own waypoints and SUMO's nets."""

import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
import shapely
from scipy.spatial import cKDTree
from shapely import affinity

from inspe_jax.core.errors import InspeError
from inspe_jax.scene.intersection import Intersection, mouth_crosswalks
from inspe_jax.scene.maps.opendrive.reader import load_map
from inspe_jax.scene.maps.registry import list_junctions, read_map
from inspe_jax.scene.regions import Region

carla = pytest.importorskip("carla", reason="needs the CARLA client: extra [opendrive]")

# A map small enough to work out on paper: one straight street along x. Road 1 from −60 to −10, a
# junction from −10 to 10, road 2 from 10 to 60. Lanes 3.5 m, shoulders 1 m and sidewalks 2 m on
# both sides of roads 1 and 2; the two connecting roads carry one driving lane each. It climbs 0.02
# per metre from 0.

WIDTHS = {"driving": 3.5, "shoulder": 1.0, "sidewalk": 2.0}


def lanes(side: str, sign: int, kinds: list[str], link: str = "") -> str:
    rows = "".join(
        f'<lane id="{sign * (i + 1)}" type="{kind}">{link}'
        f'<width sOffset="0" a="{WIDTHS[kind]}" b="0" c="0" d="0"/></lane>'
        for i, kind in enumerate(kinds)
    )
    return f"<{side}>{rows}</{side}>"


def road(number, start, heading, length, links, height, grade, through=0) -> str:
    """A road with lanes on both sides; or of one lane ``through`` the junction, from a lane of that
    number to another."""
    left, right = lanes("left", 1, [*WIDTHS]), lanes("right", -1, [*WIDTHS])
    if through:
        ends = f'<link><predecessor id="{through}"/><successor id="{through}"/></link>'
        left, right = "", lanes("right", -1, ["driving"], ends)
    return (
        f'<road id="{number}" junction="{7 if through else -1}" length="{length}"><link>{links}'
        f'</link><planView><geometry s="0" x="{start[0]}" y="{start[1]}" hdg="{heading}" '
        f'length="{length}"><line/></geometry></planView><elevationProfile>'
        f'<elevation s="0" a="{height}" b="{grade}" c="0" d="0"/></elevationProfile>'
        f'<lanes><laneSection s="0">{left}<center><lane id="0" type="none"/></center>{right}'
        "</laneSection></lanes></road>"
    )


def street(shift=(0.0, 0.0), turn=0.0, bridge=False) -> str:
    """The map's text, turned about the origin and shifted; ``bridge`` crosses at x = −30, z = 9."""

    def at(x, y=0.0):
        c, s = np.cos(turn), np.sin(turn)
        return c * x - s * y + shift[0], s * x + c * y + shift[1]

    junction = 'elementType="junction" elementId="7"'
    one, two = (
        f'elementType="road" elementId="{number}" contactPoint="{end}"'
        for number, end in ((1, "end"), (2, "start"))
    )
    east = f"<predecessor {one}/><successor {two}/>"
    west = f"<predecessor {two}/><successor {one}/>"
    roads = [
        road(1, at(-60), turn, 50, f"<successor {junction}/>", 0.0, 0.02),
        road(2, at(10), turn, 50, f"<predecessor {junction}/>", 1.4, 0.02),
        road(10, at(-10), turn, 20, east, 1.0, 0.02, through=-1),
        road(11, at(10), turn + np.pi, 20, west, 1.4, -0.02, through=1),
    ]
    if bridge:
        roads.append(road(3, at(-30, -60), turn + np.pi / 2, 120, "", 9.0, 0.0))
    connections = "".join(
        f'<connection id="{i}" incomingRoad="{a}" connectingRoad="{b}" contactPoint="start">'
        f'<laneLink from="{lane}" to="-1"/></connection>'
        for i, (a, b, lane) in enumerate([(1, 10, -1), (2, 11, 1)])
    )
    return (
        '<?xml version="1.0"?><OpenDRIVE><header revMajor="1" revMinor="4"/>'
        f'{"".join(roads)}<junction id="7" name="">{connections}</junction></OpenDRIVE>'
    )


@pytest.fixture(scope="module")
def write(tmp_path_factory):
    def to_file(text: str, name: str = "street.xodr") -> Path:
        path = tmp_path_factory.mktemp("map") / name
        path.write_text(text)
        return path

    return to_file


@pytest.fixture(scope="module")
def plain(write) -> Intersection:
    return read_map(write(street()), junction=7, radius=30)


def test_street_has_the_areas_worked_out_on_paper(plain):
    # Lanes are cut by a circle of 40 m, which takes less than 0.5 m off each road's end; the
    # junction ends at its mouths to within the width of the lines that close them.
    assert plain.regions[Region.JUNCTION].area == pytest.approx(20 * 7, rel=0.01)
    assert plain.regions[Region.DRIVEWAY].area == pytest.approx(2 * 30 * 7, rel=0.01)
    assert plain.regions[Region.SHOULDER].area == pytest.approx(2 * 80 * 1, rel=0.02)
    assert plain.regions[Region.SIDEWALK].area == pytest.approx(2 * 80 * 2, rel=0.02)
    assert plain.regions[Region.CROSSWALK].area == pytest.approx(2 * 3 * 7, rel=0.01)
    x, y = np.array([0.0, 20, 20, 20, 0, 0]), np.array([0.0, 3, 4, -5.5, -4, 5.5])
    expected = ["JUNCTION", "DRIVEWAY", "SHOULDER", "SIDEWALK", "SHOULDER", "SIDEWALK"]
    for region in Region:
        inside = shapely.contains_xy(plain.regions[region], x, y)
        assert list(inside) == [name == region.name for name in expected]


def test_street_has_the_bodies_of_its_objects(write):
    """Beside road 1, which runs along x from −60: a house, and a lamp on a lane."""
    objects = (
        '<objects><object type="building" s="40" t="14" length="10" width="6" height="8"/>'
        '<object type="pole" s="45" t="1" height="7"/></objects>'
    )
    text = street().replace("</lanes></road>", f"</lanes>{objects}</road>", 1)
    place = read_map(write(text), junction=7, radius=30)
    (house,) = place.bodies
    assert house.middle == pytest.approx([-20, 14], abs=1e-6)
    assert any(note.startswith("1 body of the map on lanes, crossings") for note in place.notes)


def test_street_has_two_arms_and_drives_on_the_right(plain):
    west, east = sorted(plain.arms, key=lambda a: a.mouth[0])
    np.testing.assert_allclose([west.mouth, east.mouth], [[-10, 0], [10, 0]], atol=0.01)
    np.testing.assert_allclose([west.width, east.width], 7, atol=0.01)
    np.testing.assert_allclose(plain.center, [0, 0, 1.2], atol=0.02)
    x, _, z = plain.ground_points.T
    np.testing.assert_allclose(z, 0.02 * (x + 60), atol=0.01)
    np.testing.assert_allclose(np.cos([west.bearing, east.bearing]), [-1, 1], atol=1e-6)
    vehicles = [r for r in plain.routes if r.user == "vehicle"]
    assert len(vehicles) == 2
    for route in vehicles:
        eastward = np.sign(route.waypoints[-1, 0] - route.waypoints[0, 0])
        np.testing.assert_allclose(route.waypoints[:, 1], -1.75 * eastward, atol=0.01)
        assert plain.arms[route.through[0]].mouth[0] * eastward < 0
        assert plain.arms[route.through[1]].mouth[0] * eastward > 0
        assert abs(route.waypoints[[0, -1], 0]).min() > 29
        assert route.width == pytest.approx(3.5)
        x, _, z = route.waypoints.T
        np.testing.assert_allclose(z, 0.02 * (x + 60), atol=0.01)


def test_street_pedestrians_cross_both_ways_from_sidewalk_to_sidewalk(plain):
    people = [r for r in plain.routes if r.user == "pedestrian"]
    crossing = [r for r in people if np.ptp(r.waypoints[:, 0]) < 0.1]
    # Two crosswalks of 7 m, 3 m beyond each kerb, both ways.
    assert [r.length for r in crossing] == pytest.approx([13.0] * 4, abs=0.05)
    assert sum(np.sign(r.waypoints[-1, 1]) for r in crossing) == 0
    ends = np.array([r.waypoints[0, :2] for r in crossing])
    # They end 6.5 m from the middle, on the sidewalks' outer edge.
    assert shapely.contains_xy(plain.regions[Region.SIDEWALK].buffer(0.1), ends).all()


def test_a_bridge_overhead_is_left_out(write, plain):
    bridged = read_map(write(street(bridge=True), "bridged.xodr"), junction=7, radius=30)
    assert bridged.ground_points[:, 2].max() < 3
    for region in Region:
        assert bridged.regions[region].equals(plain.regions[region])


def test_moving_the_map_moves_the_intersection(write, plain):
    moved = read_map(write(street((250.0, -90.0), 0.7), "moved.xodr"), junction=7, radius=30)
    for region in Region:
        expected = affinity.rotate(plain.regions[region], 0.7, origin=(0, 0), use_radians=True)
        expected = affinity.translate(expected, 250, -90)
        # CARLA computes in float32, good to 3e-5 m here; the rim is a 128-gon, not turned along.
        assert moved.regions[region].symmetric_difference(expected).area < 0.15


def test_center_takes_the_junctions_near_it_for_one(write):
    path = write(street())
    around = read_map(path, center=(3.0, 1.0), radius=30)
    np.testing.assert_allclose(around.center[:2], [3, 1])
    assert len(around.arms) == 2
    assert around.regions[Region.JUNCTION].area == pytest.approx(140, rel=0.01)


GOOD = street()
ERRORS = {
    "malformed": (GOOD.replace("</planView>", "", 1), {}, r"not well-formed XML.*line 1, column"),
    "truncated": (GOOD[: len(GOOD) // 2], {}, r"not well-formed XML, perhaps cut short: .*line"),
    "empty": ("", {}, r"not well-formed XML"),
    "no roads": ("<OpenDRIVE/>", {}, r"the map has no roads"),
    "no length": (GOOD.replace('length="50"', ""), {}, r"not OpenDRIVE: .*'length'"),
    "unknown junction": (GOOD, {"junction": 3}, r"street.xodr: no junction '3'; there are: 7$"),
    "far center": (
        GOOD,
        {"junction": None, "center": (500, 0)},
        r"within 35 m of \(500, 0\); the nearest is 7 at 500 m",
    ),
    "neither": (GOOD, {"junction": None}, r"either a junction id or a center"),
    "both": (GOOD, {"center": (0, 0)}, r"either a junction id or a center"),
    "radius": (GOOD, {"radius": -1}, r"radius -1 m is out of range: between 0 and 500 m"),
}


@pytest.mark.parametrize("case", ERRORS)
def test_each_bad_input_gets_its_message(write, case):
    text, options, message = ERRORS[case]
    with pytest.raises(InspeError, match=message):
        read_map(write(text), **{"junction": 7, **options})


def test_a_missing_file_or_client_is_named(write, tmp_path, monkeypatch):
    with pytest.raises(InspeError, match=r"nowhere.xodr: no such file"):
        list_junctions(tmp_path / "nowhere.xodr")
    monkeypatch.setitem(sys.modules, "carla", None)
    with pytest.raises(InspeError, match=r"pip install .*\[opendrive\]'"):
        read_map(write(GOOD, "unread.xodr"), junction=7)


def test_the_client_is_silent(write, capfd):
    read_map(write(street(), "silent.xodr"), junction=7, radius=30)  # has no georeference
    assert capfd.readouterr() == ("", "")


PLACES = {  # place: (town, options, arms that one sees on the map)
    "four-way": ("Town05", {"junction": 53}, 4),
    "tee": ("Town05", {"junction": 905}, 3),
    "five-way": ("Town03", {"junction": 422}, 5),
    "raised": ("Town03", {"junction": 222}, 4),
    "roundabout": ("Town03", {"center": (0.0, 0.0)}, 4),
    "motorway": ("Town04", {"junction": 1176}, 4),
    "divided": ("Town06", {"junction": 72}, 4),
    "stub arm": ("Town07", {"junction": 725}, 4),
    "city": ("Town10HD", {"junction": 189}, 4),
}


@pytest.fixture(params=PLACES)
def place(request, maps) -> Intersection:
    name, options, arms = PLACES[request.param]
    found = read_map(maps / f"{name}.xodr", **options)
    assert len(found.arms) == arms
    return found


def test_places_are_whole(place):
    drivable = [place.regions[r] for r in (Region.JUNCTION, Region.DRIVEWAY, Region.CROSSWALK)]
    surface = shapely.union_all(drivable).buffer(0.2)
    for shape in [*place.regions.values(), place.mounting]:
        assert shape.is_valid
        parts = shapely.get_parts(shape)
        assert set(shapely.get_type_id(parts)) <= {shapely.GeometryType.POLYGON}
        if shape is not place.mounting:  # a crosswalk may cut a shoulder into crumbs
            assert shapely.area(parts).min(initial=1.0) > 0.01
    on_road = place.mounting.intersection(shapely.union_all(drivable))
    assert on_road.area < 0.05 * place.mounting.area > 2.5
    np.testing.assert_allclose(place.ground(place.center[None, :2]), place.center[2], atol=1e-6)

    for part in shapely.get_parts(place.regions[Region.JUNCTION]):
        for ring in part.interiors:  # only true islands, into which a circle of 3 m fits
            assert not shapely.Polygon(ring).buffer(-2.5).is_empty

    vehicles = [r for r in place.routes if r.user == "vehicle"]
    used, lateral = set(), {}
    for route in vehicles:
        steps = np.diff(route.arc)
        assert 0.9 < steps.min() <= steps.max() < 1.1
        assert shapely.contains_xy(surface, route.waypoints[:, :2]).mean() > 0.99
        entry, leaving = route.through
        assert entry != leaving
        for arm, inbound in ((place.arms[entry], True), (place.arms[leaving], False)):
            out, across = arm.axes @ (route.waypoints[:, :2] - arm.mouth).T
            on_arm = (out > 1) & (out < 9) & (abs(across) < arm.width / 2)
            assert on_arm.sum() >= 5
            assert ((np.diff(out[on_arm]) < 0) == inbound).all()
            lateral.setdefault((arm, inbound), []).append(across[on_arm].mean())
        used |= {entry, leaving}
    assert used == set(range(len(place.arms)))
    for arm in place.arms:  # traffic keeps right: looking outward, what comes in is on the left
        inward, outward = lateral.get((arm, True)), lateral.get((arm, False))
        assert inward or outward
        assert min(inward or [np.inf]) > max(outward or [-np.inf])


@pytest.mark.parametrize(("name", "junction"), [("Town05", 53), ("Town10HD", 189), ("Town06", 72)])
def test_carlas_own_waypoints_lie_in_their_region(maps, name, junction):
    place = read_map(maps / f"{name}.xodr", junction=junction)
    world = carla.Map(name, (maps / f"{name}.xodr").read_text())
    width = 0.0
    for waypoint in world.generate_waypoints(1.0):
        at = waypoint.transform.location
        x, y = at.x, -at.y
        if np.hypot(x - place.center[0], y - place.center[1]) > 59 or abs(at.z) > 1:
            continue
        own = waypoint.is_junction and waypoint.get_junction().id == junction
        region = Region.JUNCTION if own else Region.DRIVEWAY
        shape = place.regions[region].buffer(0.2)
        # Where junctions abut or a junction paves over a lane's first metre both will do.
        assert shape.distance(shapely.Point(x, y)) < 0.5
        assert place.ground(np.array([[x, y]]))[0] == pytest.approx(at.z, abs=0.1)
        width += 0.0 if waypoint.is_junction else waypoint.lane_width
    if name == "Town06":  # no other junction near and no parking: metres × width is the area
        assert place.regions[Region.DRIVEWAY].area == pytest.approx(width, rel=0.04)


@pytest.mark.parametrize(("name", "junction"), [("Town05", 53), ("Town03", 222), ("Town07", 725)])
def test_lanes_lie_where_the_raw_xml_puts_them(maps, name, junction):
    """Lane middles from the file's own numbers, right-handed, without CARLA."""
    place = read_map(maps / f"{name}.xodr", junction=junction)
    regions = {"driving": Region.DRIVEWAY, "sidewalk": Region.SIDEWALK, "shoulder": Region.SHOULDER}
    checked = 0
    for element in ET.parse(maps / f"{name}.xodr").iter("road"):
        sections = element.findall("lanes/laneSection")
        if element.get("junction") != "-1" or len(sections) != 1:
            continue
        for piece in element.iter("geometry"):
            if piece.find("line") is None or float(piece.get("length")) < 4:
                continue
            s = float(piece.get("s")) + 2.0
            heading = float(piece.get("hdg"))
            along = np.array([np.cos(heading), np.sin(heading)])
            point = np.array([float(piece.get("x")), float(piece.get("y"))]) + 2.0 * along
            if np.hypot(*(point - place.center[:2])) > 35:
                continue
            shift = polynomial(element.findall("lanes/laneOffset"), "s", s)
            for side, sign in (("left", 1), ("right", -1)):
                rows, inner = sections[0].findall(f"{side}/lane"), 0.0
                for row in sorted(rows, key=lambda r: abs(int(r.get("id")))):
                    width = polynomial(row.findall("width"), "sOffset", s)
                    t = shift + sign * (inner + width / 2)
                    inner += width
                    middle = shapely.Point(point + t * np.array([-along[1], along[0]]))
                    if row.get("type") in regions and width > 0.3:
                        own = (regions[row.get("type")], Region.CROSSWALK)
                        assert min(place.regions[r].distance(middle) for r in own) < 0.02
                        checked += 1
    assert checked >= 15


def polynomial(rows, key: str, s: float) -> float:
    row = [r for r in rows if float(r.get(key)) <= s][-1:]
    ds = s - float(row[0].get(key)) if row else 0.0
    return sum(float(row[0].get(k)) * ds**i for i, k in enumerate("abcd")) if row else 0.0


def test_levels_that_overlap_are_told_apart(maps):
    """Town05's elevated road over 53, and Town04's interchange whose ramps join both levels."""
    for name, junction in (("Town05", 53), ("Town04", 1061)):
        points = read_map(maps / f"{name}.xodr", junction=junction, radius=100).ground_points
        a, b = cKDTree(points[:, :2]).query_pairs(2.0, output_type="ndarray").T
        assert abs(points[a, 2] - points[b, 2]).max() < 2


def test_crosswalks_are_the_maps_or_strips_with_a_note(maps):
    own = read_map(maps / "Town10HD.xodr", junction=189)
    assert not any("crosswalk" in note for note in own.notes)
    loops = load_map(maps / "Town10HD.xodr").crossings
    near = [c for c in loops if np.hypot(*(c.mean(0) - own.center)[:2]) < 45]
    assert len(near) == 2
    for shape in (shapely.Polygon(c[:, :2]) for c in near):
        assert own.regions[Region.CROSSWALK].intersection(shape).area > 0.98 * shape.area

    assert own.regions[Region.JUNCTION].contains(shapely.Point(-62.0, -20.5))  # a median's gap

    bare = read_map(maps / "Town05.xodr", junction=53)
    assert any("the map has no crosswalks here" in note for note in bare.notes)
    strips = mouth_crosswalks(bare.arms)
    assert bare.regions[Region.CROSSWALK].symmetric_difference(strips).area < 0.1

    motorway = read_map(maps / "Town04.xodr", junction=1176)
    assert motorway.regions[Region.CROSSWALK].is_empty
    assert any("no crosswalks" in note for note in motorway.notes)


def test_poles_are_signals_on_the_ground_each_once(maps):
    signals = read_map(maps / "Town04.xodr", junction=916)
    assert len(signals.poles) == 6
    gaps = shapely.distance(*np.meshgrid(*[shapely.points(signals.poles[:, :2])] * 2))
    assert gaps[~np.eye(6, dtype=bool)].min() >= 0.5
    np.testing.assert_allclose(signals.poles[:, 2], signals.ground(signals.poles[:, :2]))
    bare = read_map(maps / "Town05.xodr", junction=53)
    assert bare.poles.shape == (0, 3)
    assert any("no poles" in note for note in bare.notes)


@pytest.mark.parametrize("name", ["Town03", "Town10HD"])
def test_the_list_has_the_junctions_of_the_file(maps, name):
    listed = list_junctions(maps / f"{name}.xodr")
    ids = [int(j.get("id")) for j in ET.parse(maps / f"{name}.xodr").iter("junction")]
    assert [j.id for j in listed] == sorted(ids)
    by_id = {j.id: j for j in listed}
    if name == "Town03":
        assert (by_id[422].arms, by_id[222].arms, by_id[268].arms) == (5, 4, 3)
        assert by_id[678].arms == 3  # one of them behind a road of 0.015 mm
        assert by_id[222].center == pytest.approx((83.5, 134.7, 8.1), abs=0.2)
        assert by_id[222].crosswalks == by_id[222].signals == 0
    else:
        assert by_id[189].crosswalks == 2
        assert by_id[189].size == pytest.approx(44.4, abs=0.2)
