"""OpenDRIVE reader: against hand-made maps, the raw XML, CARLA's own waypoints and SUMO's nets."""

import re
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
    def to_file(text: str | bytes, name: str = "street.xodr") -> Path:
        path = tmp_path_factory.mktemp("map") / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
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
    """Beside road 1, which runs along x from −60: a house, a lamp on a lane, and two islands,
    one of them on the road."""
    objects = (
        '<objects><object type="building" s="40" t="14" length="10" width="6" height="8"/>'
        '<object type="pole" s="45" t="1" height="7"/>'
        '<object type="trafficIsland" s="45" t="9" length="2" width="2"/>'
        '<object type="trafficIsland" s="45" t="2" length="2" width="2"/></objects>'
    )
    text = street().replace("</lanes></road>", f"</lanes>{objects}</road>", 1)
    place = read_map(write(text), junction=7, radius=30)
    (house,) = place.bodies
    assert house.middle == pytest.approx([-20, 14], abs=1e-6)
    assert any(note.startswith("1 body of the map on lanes, crossings") for note in place.notes)
    where = shapely.contains_xy(place.mounting, -15, [9, 2])
    assert where.tolist() == [True, False]


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
        # The rim is a 128-gon, not turned along.
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
    "no roads": ("<OpenDRIVE/>", {}, r"the map has no roads$"),
    "no good road": (
        GOOD.replace('<geometry s="0"', '<geometry s="x"'),
        {},
        r"street.xodr: the map has no roads that can be read: road 1 \(s of <geometry> is 'x'\); ",
    ),
    "direct": (
        GOOD.replace("<junction", '<junction id="5" type="direct"/><junction', 1),
        {"junction": 5},
        r"street.xodr: junction 5 is not read: a direct junction has no area of its own, choose an",
    ),
    "no contact point": (
        re.sub(
            r'(tRoad|cessor elementType="road" elementId="[12]") contactPoint="\w*"', r"\1", GOOD
        ),
        {},
        r"junction 7 is not read: none of its roads that can be read has lanes; road 10 "
        r"\(contactPoint of its <predecessor> is missing; write start or end\); road 11 \(",
    ),
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


LANE = re.compile(r'(<lane id=")(-?)([123])(".*?)<width sOffset="0" a="[^"]*" ')
EDGES = {"1": 3.5, "2": 4.5, "3": 6.5}  # of each lane, outside
SECTION = re.compile(r'<laneSection s="0(".*?</laneSection>)')
SAME = {  # the street written otherwise, and its junction
    "words": (re.sub(r'((?:Road|<road id|"road" elementId)=")', r"\1way ", GOOD), 7),
    "large ids": (re.sub(r'"1([01])"', r'"9999999999\1"', GOOD), 7),
    "id of a road": (GOOD.replace('="7"', '="1"'), 1),
    "not defined": (re.sub("<junction .*</junction>", "", GOOD), 7),
    "UTF-16": (GOOD.replace("?>", ' encoding="UTF-16"?>').encode("utf-16"), 7),
    "comment": ("\n<!-- a licence -->\n" + GOOD, 7),
    "borders": (
        LANE.sub(
            lambda x: f'{x[1]}{x[2]}{x[3]}{x[4]}<border sOffset="0" a="{x[2]}{EDGES[x[3]]}" ', GOOD
        ),
        7,
    ),
    "shared": (GOOD.replace('"driving"', '"shared"'), 7),
    "same lanes": (re.sub(r'(<connection id="0"[^>]*)>.*?</connection>', r"\1/>", GOOD), 7),
    "lanes of its roads": (re.sub("<laneLink.*?>", "", GOOD), 7),
    "no connections": (re.sub("<connection.*</connection>", "", GOOD), 7),
    "borders to the left": (
        LANE.sub(lambda x: f'{x[1]}{x[2]}{x[3]}{x[4]}<border sOffset="0" a="{EDGES[x[3]]}" ', GOOD),
        7,
    ),
    "sections without links": (SECTION.sub(r'<laneSection s="0\1<laneSection s="10\1', GOOD, 1), 7),
}


@pytest.mark.parametrize("case", SAME)
def test_a_street_written_otherwise_is_the_same_place(write, plain, case):
    text, junction = SAME[case]
    assert text != GOOD
    place = read_map(write(text), junction=junction, radius=30)
    assert place.notes == plain.notes
    for region in Region:
        assert place.regions[region].symmetric_difference(plain.regions[region]).area < 1e-6
    for route, other in zip(place.routes, plain.routes, strict=True):
        np.testing.assert_allclose(route.waypoints, other.waypoints, atol=1e-6)


def test_far_coordinates_are_taken_from_a_point_near(write, plain):
    bad = road(3, (0, 200), 0.0, 9, "", 0.0, 0.0).replace('x="0"', "")
    text = street((678_000.0, 5_405_000.0)).replace("<junction", f"{bad}<junction", 1)
    place = read_map(write(text), center=(678_000.0, 5_405_000.0), radius=30)
    assert "coordinates are those of the map less (678000, 5405000) m" in place.notes
    assert "left out of the map: road 3 (x of <geometry> is missing)" in place.notes
    for region in Region:  # the text has them in double precision
        assert place.regions[region].symmetric_difference(plain.regions[region]).area < 1e-4


def test_what_cannot_be_read_is_left_out_and_named(write, plain):
    bad = road(3, (0, 200), 0.0, 0, "", 0.0, 0.0) + road(4, (0, 200), np.nan, 9, "", 0.0, 0.0)
    bad += '<junction id="8"/>' + road(1, (0, 200), 0.0, 9, "", 0.0, 0.0)
    place = read_map(write(GOOD.replace("<junction", f"{bad}<junction", 1)), junction=7, radius=30)
    assert place.notes[:-1] == (
        *plain.notes[:-1],
        "left out of the map: road 3 (length of <road> is 0); road 4 (hdg of <geometry> is 'nan'); "
        "road 1 (another road has this id); junction 8 (none of its roads that can be read has "
        "lanes)",
    )
    far = road(3, (1e8, 0), 0.0, 9, "", 0.0, 0.0) + road(4, (0, 200), 0.0, 9, "", 0.0, 0.0).replace(
        "</planView>",
        '<geometry s="9" x="50" y="200" hdg="0" length="9"><line/></geometry></planView>',
    )
    far += road(5, (0, 200), 0.0, 9, "", 0.0, 0.0).replace(
        "<laneSection", '<laneSection singleSide="true"'
    )
    place = read_map(write(GOOD.replace("<junction", f"{far}<junction", 1)), junction=7, radius=30)
    assert place.notes[:-1] == (
        *plain.notes[:-1],
        "left out of the map: road 3 (it is over 100 km from most roads); road 4 (pieces of its "
        "<planView> are over 20 m apart); road 5 (a <laneSection> of a single side)",
    )
    kinds = GOOD.replace('"sidewalk"', '"special1"')
    assert "lanes of other types are left out: special1" in read_map(write(kinds), junction=7).notes


def test_a_junction_that_nobody_can_drive_through_is_said(write):
    none = "no vehicles drive through: the map links no lanes through the junction"
    unlinked = read_map(write(re.sub('laneLink from="-?1"', 'laneLink from="5"', GOOD)), junction=7)
    apart = read_map(write(GOOD.replace('x="10.0"', 'x="76.0"', 1)), junction=7)
    for place in unlinked, apart:
        assert none in place.notes
        assert {route.user for route in place.routes} == {"pedestrian"}
    assert "routes whose lanes are over 20 m apart: 2, left out" in apart.notes


def test_traffic_drives_on_the_left_where_the_rule_says_so(write):
    text = GOOD.replace("<road ", '<road rule="LHT" ')
    for a, b in (("-1", "1"), ("1", "-1")):  # the other lanes lead through
        old = f'<laneLink from="{a}" to="-1"/>'
        text = text.replace(old, f'<laneLink from="{b}" to="@1"/>')
    parts = re.split(r"(<road .*?</road>)", text)
    for k, part in enumerate(parts):
        if 'junction="7"' in part:
            part = part.replace('"-1"', '"@"').replace('"1"/>', '"-1"/>').replace('"@"', '"1"')
            parts[k] = part.replace("right>", "left>").replace('elementId="-1"', 'elementId="1"')
    place = read_map(write("".join(parts).replace("@1", "1")), junction=7, radius=30)
    vehicles = [r for r in place.routes if r.user == "vehicle"]
    assert len(vehicles) == 2
    for route in vehicles:
        eastward = np.sign(route.waypoints[-1, 0] - route.waypoints[0, 0])
        np.testing.assert_allclose(route.waypoints[:, 1], 1.75 * eastward, atol=0.01)


def test_a_road_tilts_and_lanes_are_raised(write):
    tilt = '<lateralProfile><superelevation s="0" a="0.1" b="0" c="0" d="0"/></lateralProfile>'
    text = GOOD.replace("<lanes>", tilt + "<lanes>")
    kerbs = np.array([[-20.3, t * np.cos(0.1), 0.794 + t * np.sin(0.1)] for t in (-4.5, -3.5, 4.5)])
    ground = read_map(write(text), junction=7, radius=30).ground(kerbs[:, :2])
    np.testing.assert_allclose(ground, kerbs[:, 2], atol=0.01)  # between stations 1 m apart
    text = text.replace('type="sidewalk">', 'type="sidewalk" level="true">')
    text = text.replace(
        "</lane></left>", '<height sOffset="0" heightInner="0.1" outer="0.1"/></lane></left>'
    )
    lanes = load_map(write(text)).roads[1]
    cuts = lanes.cuts(lanes.sections[0], np.array([10.0]))
    t, z = (np.array([cuts[k].middle[0, axis] for k in (1, 2, 3, -3)]) for axis in (1, 2))
    flat = 5.5 + 4.5 * (np.cos(0.1) - 1)  # the sidewalk begins at t = 4.5 and does not tilt
    np.testing.assert_allclose(t, [1.75 * np.cos(0.1), 4 * np.cos(0.1), flat, -flat])
    up = np.sin(0.1) * np.array([1.75, 4, 4.5, -4.5])
    np.testing.assert_allclose(z, 0.2 + up + [0, 0, 0.1, 0])


def test_streets_have_the_names_that_a_person_gave(write):
    text = GOOD.replace('<road id="1"', '<road name="Ring" id="1"')
    (info,) = list_junctions(write(text.replace('<road id="2"', '<road name="Road 2" id="2"')))
    assert info.streets == ("Ring",)


def test_pieces_of_centimetres_are_as_sharp_and_steep_as_they_say(write):
    """As RoadRunner and CARLA's towns have them: they are no reason to leave a road out."""
    sharp = '<geometry s="50" x="-10" y="0" hdg="0" length="0.01">'
    sharp += '<spiral curvStart="126" curvEnd="-246"/></geometry></planView>'
    steep = '<width sOffset="0" a="3.5" b="0" c="0" d="1e25"/><width sOffset="1e-14" a="3.5" b="0" '
    text = GOOD.replace("</planView>", sharp, 1).replace('<width sOffset="0" a="3.5" b="0" ', steep)
    road = load_map(write(text)).roads[1]
    assert road.line.at(50.01)[1] == pytest.approx((126 - 246) / 2 * 0.01, abs=1e-9)
    cuts = road.cuts(road.sections[0], np.array([10.0]))
    np.testing.assert_allclose(cuts[1].width, 3.5)


def test_a_road_has_a_profile_across(write):
    """A crown of 2 cm a metre at s = 0, which is level at s = 40; cubics of t beyond 1 m."""
    rows = ((0, -5, 0.1, -0.02, 0), (0, 1, -0.02, 0.02, 0.001), (40, -5, 0, 0, 0))
    row = '<shape s="{}" t="{}" a="{}" b="{}" c="0" d="{}"/>'
    profile = "".join(row.format(*values) for values in rows)
    text = GOOD.replace("<lanes>", f"<lateralProfile>{profile}</lateralProfile><lanes>")
    road = load_map(write(text)).roads[1]
    t = np.array([[-5.0, 0.0, 3.0, 3.0, 3.0, 3.0]])
    rise = road.points(np.array([0, 0, 0, 10, 40, 45.0]), t)[0, :, 2] - 0.02 * np.array(
        [0, 0, 0, 10, 40, 45]
    )
    np.testing.assert_allclose(rise, [0.1, 0.0, 0.028, 0.021, 0, 0], atol=1e-12)
    text = text.replace("</lateralProfile>", row.format(20, -5, 9, 0, 0) + "</lateralProfile>", 1)
    assert "road 1 (its lateral <shape> is over 5 m high)" in load_map(write(text)).notes[0]


def test_lanes_lie_beside_the_offset_and_are_as_wide_as_their_cubics(write):
    """At s = 40 the offset is 1 + 0.02 · 40, and the lane 2 + 1e-3 · 10³, by its second cubic."""
    text = GOOD.replace("<lanes>", '<lanes><laneOffset s="0" a="1" b="0.02" c="0" d="0"/>', 1)
    second = '<width sOffset="30" a="2" b="0" c="0" d="1e-3"/></lane><lane id="2"'
    road = load_map(write(text.replace('</lane><lane id="2"', second, 1))).roads[1]
    cuts = road.cuts(road.sections[0], np.array([40.0]))
    np.testing.assert_allclose([cuts[k].width[0] for k in (1, 2, -1)], [3, 1, 3.5])
    np.testing.assert_allclose([cuts[k].middle[0, 1] for k in (1, 2, -1)], [3.3, 5.3, 0.05])


CORNERS = "".join(
    f'<cornerLocal u="{u}" v="{v}"/>' for u, v in ((-1, -4), (1, -4), (1, 4), (-1, 4))
)
ROADS = "".join(f'<cornerRoad s="{s}" t="{t}"/>' for s, t in ((46, -4), (48, -4), (48, 4), (46, 4)))
WALKS = {
    "outline": f"<outline>{CORNERS}</outline>",
    "outlines": f'<outlines><outline closed="false">{CORNERS}</outline></outlines>',
    "closed": f'<outline>{CORNERS}<cornerLocal u="-1" v="-4"/></outline>',
    "corners by road": f"<outline>{ROADS}</outline>",
    "none": "",
}


@pytest.mark.parametrize("form", WALKS)
def test_crosswalks_of_every_form_lie_at_t_of_the_reference_line(write, form):
    walk = f'<objects><object type="crosswalk" s="47" t="0" length="2" width="8">{WALKS[form]}'
    text = GOOD.replace("</lanes></road>", f"</lanes>{walk}</object></objects></road>", 1)
    text = text.replace("<lanes>", '<lanes><laneOffset s="0" a="1" b="0" c="0" d="0"/>', 1)
    (loop,) = load_map(write(text)).crossings
    assert (
        shapely.Polygon(loop[:, :2]).symmetric_difference(shapely.box(-14, -4, -12, 4)).area < 1e-9
    )
    np.testing.assert_allclose(loop[:, 2], 0.94)


def test_people_cross_a_wide_crosswalk_across_the_road_and_lanes_that_overlap_step_on(write):
    walk = '<objects><object type="crosswalk" s="43" t="0" length="12" width="7"/></objects>'
    text = GOOD.replace("</lanes></road>", f"</lanes>{walk}</road>", 1)
    text = text.replace('x="-60.0"', 'x="-59.3"')  # road 1 overlaps the junction's by 0.7 m
    place = read_map(write(text), junction=7, radius=30)
    crossing = [r.waypoints for r in place.routes if r.user == "pedestrian"]
    across = [w for w in crossing if np.ptp(w[:, 1]) > 6]
    assert [np.ptp(w[:, 0]) for w in across] == pytest.approx([0, 0], abs=1e-9)
    drives = [r.waypoints for r in place.routes if r.user == "vehicle"]
    assert all((np.sign(np.diff(w[:, 0])) == np.sign(w[-1, 0])).all() for w in drives)


def test_signals_stand_at_their_place_unless_over_lanes(write):
    signals = "".join(f'<signal type="1000001" s="45" t="{t}" zOffset="5"/>' for t in (5, 0))
    text = GOOD.replace("</lanes></road>", f"</lanes><signals>{signals}</signals></road>", 1)
    place = read_map(write(text), junction=7, radius=30)
    np.testing.assert_allclose(place.poles, [[-15, 5, 0.9]], atol=0.01)
    assert "1 signal over lanes: no standing poles" in place.notes


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


@pytest.mark.parametrize("where", PLACES)
def test_places_are_whole(maps, where):
    name, options, arms = PLACES[where]
    place = read_map(maps / f"{name}.xodr", **options)
    assert len(place.arms) == arms
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


@pytest.mark.parametrize("town", ["Town03", "Town06"])
def test_lanes_are_where_carla_s_client_says(maps, town):
    """To 1 mm, by which cuts keep inside a section, and what single precision leaves at 500 m."""
    carla = pytest.importorskip("carla", reason="the comparison needs the CARLA client")
    roads, off = load_map(maps / f"{town}.xodr").roads, []
    for found in carla.Map(town, (maps / f"{town}.xodr").read_text()).generate_waypoints(20.0):
        road, at = roads[found.road_id], found.transform.location
        section = road.sections[road.section_at(found.s)]
        cut = road.cuts(section, np.array([found.s]))[found.lane_id]
        off.append([*cut.middle[0] - [at.x, -at.y, at.z], cut.width[0] - found.lane_width])
    assert len(off) > 500
    assert abs(np.array(off)).max() < 2e-3


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


def test_routes_through_a_junction_wider_than_the_radius_lie_within_it(write):
    place = read_map(write(GOOD), junction=7, radius=6)
    drives = [r.waypoints for r in place.routes if r.user == "vehicle"]
    assert [np.ptp(w[:, 0]) for w in drives] == pytest.approx([13, 13], abs=1)
