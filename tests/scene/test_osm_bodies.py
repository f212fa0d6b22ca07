"""Bodies of OpenStreetMap extracts: what stands where, how high, and in which coordinates."""

import gzip
import tracemalloc

import numpy as np
import pytest
import shapely
from osm_town import LAT, LON, METRES, ROAD, Town, box, degrees, full_town
from shapely.geometry import LineString, Point, Polygon

from inspe_jax.core.digest import digest
from inspe_jax.core.errors import InspeError
from inspe_jax.scene.maps.bodies import simple_pieces
from inspe_jax.scene.maps.openstreetmap.bodies import Sizes, length_of
from inspe_jax.scene.maps.openstreetmap.extract import read_extract
from inspe_jax.scene.maps.registry import junction_at, list_junctions, open_map, read_map
from inspe_jax.scene.regions import Region
from inspe_jax.scene.scene import build_scene, load_scene, save_scene
from inspe_jax.scene.street import map_bodies

pytest.importorskip("sumolib", reason="needs SUMO: extra [sumo]")
pytest.importorskip("pyproj", reason="needs pyproj: extra [sumo]")

from inspe_jax.scene.maps.sumo.reader import load_net
from inspe_jax.scene.traffic.sumo.generate import sumo_traffic


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return full_town().write(tmp_path_factory.mktemp("osm") / "town.osm")


@pytest.fixture(scope="module")
def place(path):
    return read_map(path, center=tuple(world(path, [(0, 0)])[0]), radius=50)


@pytest.fixture(scope="module")
def bodies(place):
    return place.bodies


def world(path, points):
    """World coordinates of points of the town."""
    return load_net(path).georeference.from_degrees(degrees(points))


def at(path, bodies, point, kind=None):
    """The bodies over a point of the town."""
    here = Point(world(path, [point])[0])
    return [b for b in bodies if b.polygon.contains(here) and kind in (None, b.kind)]


def test_the_middle_of_each_road_is_where_its_nodes_are(path, place):
    """netconvert's lanes against the nodes' degrees: 25 m out on every arm, to 2 cm."""
    road = shapely.union_all([place.regions[r] for r in Region if r is not Region.SIDEWALK])
    for ahead in ((25, 0), (0, 25), (-25, 0), (0, -25)):
        left = (-ahead[1] / 2.5, ahead[0] / 2.5)
        ends = [(ahead[0] + s * left[0], ahead[1] + s * left[1]) for s in (-1, 1)]
        across = LineString(world(path, ends)).intersection(road)
        (middle,) = world(path, [ahead])
        assert across.length == pytest.approx(6.4, abs=0.01)
        assert np.hypot(*(np.array(across.centroid.coords[0]) - middle)) < 0.02


def test_a_junction_is_found_by_its_coordinates(path):
    (lon, lat), *_ = degrees([(12, -9)])
    found = junction_at(path, lat, lon)
    middle = open_map(path).georeference.to_degrees(np.array([found.center[:2]]))[0]
    assert np.abs(middle - [LON, LAT]).max() < 1e-5
    with pytest.raises(InspeError, match=r"no junction within 100 m of 48,11; the middle of"):
        junction_at(path, 48.0, 11.0)
    with pytest.raises(InspeError, match="a latitude of -90 to 90"):
        junction_at(path, lon + 100, lat)


def test_heights_and_where_no_body_is(path, bodies):
    for point, base, height in (
        ((16, 15), 0, 9), ((-16, 14), 0, 10.5), ((13, -17), 0, 3), ((-36, -26), 0, 12),
        ((32, 15), 0, 15), ((37, 12), 5, 15), ((37, 18), 0, 8), ((27, 29), 0, 6),
        ((35, 29), 0, 6), ((27, 37), 0, 9), ((0, -35), 5.5, 6),
    ):  # fmt: skip
        (one,) = at(path, bodies, point)
        assert (one.kind, one.base, one.height) == ("building", base, pytest.approx(height))
    (house,) = at(path, bodies, (16, 15))
    corners = world(path, box(10, 10, 22, 20))  # degrees are written to 0.1 mm
    assert house.polygon.symmetric_difference(Polygon(corners)).area < 44 * 1e-4
    # In the courtyard, over what is underground or gone, on the road, and far away.
    for point in ((-26, -26), (-27, 25), (-27, 33), (0, 42), (505, 505)):
        assert at(path, bodies, point) == []


def test_lengths_with_units():
    for text, metres in (
        ("12", 12), ("12 m", 12), ("12.5m", 12.5), ("12,5", 12.5), ("3'", 0.9144),
        ("7'3\"", 2.2098), ("40 ft", 12.192), ("250 cm", 2.5), (" 4 ", 4), (".5", 0.5),
    ):  # fmt: skip
        assert length_of(text) == pytest.approx(metres)
    for text in ("3;4", "about 3", "", "-2", "1e3", "nan", "12 storeys", "3 - 4"):
        assert length_of(text) is None


def test_heights_of_buildings():
    for tags, expected in (
        ({}, (0, 6)),
        ({"building:levels": "4", "roof:levels": "1"}, (0, 15)),
        ({"building:levels": "4", "height": "10"}, (0, 10)),
        ({"building:levels": "four"}, (0, 6)),
        ({"building:levels": "0"}, (0, 6)),
        ({"building:levels": "5", "building:min_level": "2"}, (6, 15)),
        ({"building:min_level": "2"}, (6, 12)),
        ({"height": "0"}, (0, 6)),
        ({"height": "99999"}, (0, 6)),
        ({"height": "5", "min_height": "5"}, (0, 5)),
    ):
        assert Sizes().heights(tags, "yes") == pytest.approx(expected), tags


def test_notes_say_what_was_assumed(place):
    said = "\n".join(place.notes)
    assert "no height is given for 3 of the map's buildings: taken as 6 m high" in said
    assert "height=about ten, height=3;4" in said
    assert "1 body of the map whose outline crosses itself: mended" in said
    assert "1 body of the map on lanes, crossings or footpaths: cut off there" in said
    assert "of the map on lanes, crossings or footpaths, or without an area: left out" in said


def test_simple_pieces_of_many_holes():
    plate = Polygon(box(0, 0, 40, 20), [box(x, y, x + 3, y + 2)[::-1] for x in (2, 9, 30)
                                        for y in (3, 11)])  # fmt: skip
    pieces = list(simple_pieces(plate))
    assert all(not p.interiors and p.is_valid for p in pieces)
    assert shapely.union_all(pieces).symmetric_difference(plate).area < 1e-9
    assert sum(p.area for p in pieces) == pytest.approx(plate.area)


def test_outlines_that_cross_themselves_or_the_road(path, bodies):
    found = [*at(path, bodies, (13, 30)), *at(path, bodies, (19, 30))]
    assert len(found) == 2
    assert all(b.polygon.is_valid and b.height == 5 for b in found)
    assert at(path, bodies, (16, 27)) == []
    (house,) = at(path, bodies, (9, 28))
    assert house.height == 7
    assert 5 < house.polygon.area / 6 < 6.2  # beyond the middle of the footpath and 0.8 m
    assert at(path, bodies, (0, 28), "building") == []


def test_nothing_stands_on_lanes_crossings_or_footpaths(place, bodies):
    roads = [Region.DRIVEWAY, Region.JUNCTION, Region.CROSSWALK]
    lanes = shapely.union_all([place.regions[r] for r in roads])
    walked = shapely.union_all(
        [LineString(r.waypoints[:, :2]) for r in place.routes if r.user == "pedestrian"]
    )
    assert not walked.is_empty
    for one in bodies:
        foot = one.polygon if one.base == 0 else Point(one.middle).buffer(one.trunk)
        assert one.polygon.intersection(lanes).area < 1e-6 or one.base >= 4.5, one.words
        if one.base == 0 or one.trunk > 0:
            assert foot.distance(walked) > 0.7, one.words


def test_trees(path, bodies):
    plain, tall, low = (at(path, bodies, p, "tree")[0] for p in ((8, 8), (8, -9), (-8, 8)))
    assert (plain.height, plain.base, plain.transmittance) == (8, 2.5, 0.05)
    assert plain.polygon.area == pytest.approx(np.pi * 2.5**2)
    assert (tall.height, tall.base) == (12, 4.5)  # over the lanes
    assert [plain.trunk, tall.trunk] == pytest.approx([0.15, 0.25], abs=0.001)
    assert low.base == pytest.approx(1.6)
    assert 2.0 < np.sqrt(low.polygon.area / np.pi) < 5.0  # up to the lanes
    assert at(path, bodies, (0, 30), "tree") == []
    # Three of a row: of four, one is near a tree of its own.
    assert [b.height for b in bodies if b.kind == "tree"].count(10) == 3
    (own,) = at(path, bodies, (22, -8.5), "tree")
    assert own.height == 6


def test_walls_hedges_fences_and_poles_beside_the_road(bodies):
    walls = [b for b in bodies if b.kind == "wall"]
    assert sorted(round(b.height, 2) for b in walls) == [1.6, 2.21, 2.21]
    assert sum(b.polygon.area for b in walls) == pytest.approx(0.25 * 18 + 0.1 * 10, rel=1e-3)
    (hedge,) = (b for b in bodies if b.kind == "hedge")
    assert (hedge.height, hedge.polygon.area) == (1.5, pytest.approx(7.0, rel=1e-3))
    assert sorted(b.height for b in bodies if b.kind == "pole") == [3.4, 7.0, 9.0, 20.0]


def test_the_order_of_elements_and_compression_change_nothing(tmp_path, path):
    head, *lines, tail = path.read_text().splitlines()[1:]
    turned = "\n".join([head, *lines[::-1], tail])
    other = tmp_path / "town.osm.gz"
    other.write_bytes(gzip.compress(turned.encode()))
    degrees_ = (11.57, 48.13, 11.58, 48.14)
    one, two = read_extract(path, degrees_), read_extract(other, degrees_)
    assert one == two
    assert len(one.ways) > 20


def test_memory_grows_with_what_is_near_and_not_with_the_file(tmp_path):
    """30,000 nodes elsewhere: far less than a megabyte, where all of them would be over 10 MB."""
    file = tmp_path / "large.osm"
    with file.open("w") as f:
        f.write('<osm version="0.6">')
        for k in range(30_000):
            f.write(f'<node id="{k}" lat="50.{k:06d}" lon="8.0"><tag k="a" v="b"/></node>')
        f.write('<node id="n" lat="48.0" lon="11.0"><tag k="natural" v="tree"/></node></osm>')
    tracemalloc.start()
    found = read_extract(file, (10.99, 47.99, 11.01, 48.01))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert found.node_tags == {"n": {"natural": "tree"}}
    assert peak < 1e6


def test_what_is_deleted_or_rubbish_is_not_there(tmp_path):
    file = tmp_path / "rubbish.osm"
    file.write_text(
        '<osm><node id="1" lat="x" lon="0"/><node id="2" lat="0"/><node lat="0" lon="0"/>'
        '<node id="3" lat="0" lon="0" visible="false"/><node id="4" lat="nan" lon="0"/>'
        '<node id="5" lat="0" lon="0" action="delete"/><node id="6" lat="0" lon="0"/>'
        '<way id="1"><nd ref="1"/><nd/></way><way id="2"><nd ref="6"/><nd ref="9"/></way>'
        '<relation id="1"><member type="node" ref="6"/></relation></osm>'
    )
    found = read_extract(file, (-1, -1, 1, 1))
    assert (list(found.nodes), list(found.ways), found.relations) == (["6"], ["2"], {})
    file.write_text("<osm><node")
    with pytest.raises(InspeError, match=r"rubbish\.osm: not well-formed XML"):
        read_extract(file, (-1, -1, 1, 1))


def test_a_junction_says_its_streets(tmp_path):
    path = Town().write(tmp_path / "town.osm")
    named = path.read_text().replace("</way>", '<tag k="name" v="A &amp; B"/></way>')
    path.write_text(named)
    assert list_junctions(path)[0].streets == ("A & B",)


def test_outlines_that_the_extract_cuts_are_closed_or_left_out(tmp_path):
    town = Town()
    nodes = [town.node(p) for p in box(10, 10, 20, 20)]
    town.way([*nodes, 9999, nodes[0]], building="yes", height="4")
    town.way(nodes, building="yes", height="5")
    town.relation([(town.line(box(10, -20, 20, -10)), "outer")], building="yes", height="6")
    town.relation([(town.area(box(-20, 10, -10, 20)), ""), (888, "outer")], building="yes",
                  height="7")  # fmt: skip
    path = town.write(tmp_path / "cut.osm")
    (info,) = list_junctions(path)
    assert info.arms == 4
    place = read_map(path, junction=info.id, radius=40)
    assert sorted(b.height for b in place.bodies) == [4, 7]
    assert any("are not closed: 4, left out" in note for note in place.notes)
    size = dict(radius=40, voxel=2.0, density=10, frames=5)
    assert build_scene(place, traffic="sumo", **size).traffic.mean_count > 3


@pytest.mark.parametrize("seed", range(2))
def test_shapes_without_sense_are_mended_or_left_out(tmp_path, seed):
    """Ways on a few nodes over and over, with tags at random: bodies or notes, and no crash."""
    rng, town = np.random.default_rng(seed), Town()
    nodes = [town.node(tuple(rng.integers(-40, 40, 2).tolist())) for _ in range(25)]
    nodes += range(9990, 9995)  # which are not there
    tags = [("building", "yes"), ("building__part", "yes"), ("building", "roof"), ("height", "2"),
            ("barrier", "wall"), ("barrier", "hedge"), ("area", "yes"), ("natural", "tree_row"),
            ("min_height", "3"), ("height", "-"), ("building__levels", "-3"),
            ("width", "0")]  # fmt: skip

    def some():
        return dict(tags[i] for i in rng.integers(0, 12, 4))

    ways = [9999]
    for _ in range(120):
        through = [nodes[i] for i in rng.integers(0, 30, rng.integers(1, 8))]
        ways.append(town.way(through + through[:1] * int(rng.integers(0, 3)), **some()))
    for _ in range(40):
        rings = [(ways[i], rng.choice(["outer", "inner", ""])) for i in rng.integers(0, 121, 4)]
        town.relation(rings, **some())
    place = read_map(town.write(tmp_path / "odd.osm"), junction=town.middle, radius=50)
    assert len(place.bodies) > 50
    assert all(b.polygon.is_valid and b.polygon.area > 0 for b in place.bodies)
    assert any("mended" in note for note in place.notes)


def test_a_scene_has_the_map_s_bodies_and_keeps_them(place, tmp_path):
    size = dict(radius=30, voxel=1.0, spacing=2.0, frames=2, density=5)
    scene = build_scene(place, **size, statics="map")
    assert dict(scene.settings)["statics"] == "map"
    near = map_bodies(place, 30)
    assert {b.kind for b in scene.statics} == {"building", "wall", "hedge", "tree", "pole"}
    houses, kept = ([b for b in of if b.kind == "building"] for of in (near, scene.statics))
    assert houses == kept
    assert len(near) < len(place.bodies)
    save_scene(scene, tmp_path / "s.npz")
    again = load_scene(tmp_path / "s.npz")
    assert digest(again.statics) == digest(scene.statics)
    assert digest(again.intersection.bodies) == digest(place.bodies)
    assert again.intersection.georeference == place.georeference
    words = again.intersection.georeference.words(place.center).split(", ")
    assert np.array(words, float) == pytest.approx([LAT, LON], abs=1e-5)
    with pytest.raises(InspeError, match=r"brings no bodies here; an OpenStreetMap extract \(\.o"):
        build_scene("four_way", **size, statics="map")
    rebuilt = build_scene(again.intersection, **size, statics="map")
    assert digest(rebuilt.statics) == digest(scene.statics)


@pytest.mark.parametrize(("looking_out", "side", "lat", "lon", "note"), [
    ("right", None, "51", "-1", "left, as in Great Britain or Ireland; if not so, give --driving"),
    ("left", None, "48", "11", "right, as in most countries; if not so, give --driving-side left"),
    ("right", "left", "48", "11", "left, as --driving-side says"),
    ("left", "right", "51", "-1", "right, as --driving-side says"),
])  # fmt: skip
def test_traffic_drives_on_the_side_of_its_country_or_that_is_asked_for(
    tmp_path, looking_out, side, lat, lon, note
):
    text = full_town().write(tmp_path / "town.osm").read_text()
    text = text.replace('lat="48', f'lat="{lat}').replace('lon="11', f'lon="{lon}')
    (tmp_path / "town.osm").write_text(text)
    place = read_map(tmp_path / "town.osm", junction="1", radius=40.0, driving_side=side)
    assert f"traffic drives on the {note}" in " ".join(place.notes)
    starts = [r for r in place.routes if r.user == "vehicle"]
    assert starts
    for route in starts:
        arm = place.arms[route.through[0]]
        inbound = (arm.axes @ (route.waypoints[0, :2] - arm.mouth))[1]
        assert (inbound > 0) == (looking_out == "left")
    traffic = sumo_traffic(place, radius=40, count=15, frames=20, mix="largest")
    arm, there = place.arms[0], traffic.valid
    along, across = arm.axes @ (traffic.center[there, :2] - arm.mouth).T
    onward = (traffic.velocity[there, :2] @ arm.axes[0])[(along > 10) & (abs(across) < 8)]
    across = across[(along > 10) & (abs(across) < 8)]
    assert (onward != 0).sum() > 5  # on the arm, also for SUMO
    wrong = np.sign(onward) * np.sign(across) == (1 if looking_out == "left" else -1)
    assert not wrong.any()


def test_people_walk_on_no_carriageway_where_junctions_are_joined(tmp_path):
    """Two carriageways of three lanes 8 m apart, which overlap, with sidewalks in each other's
    lanes, and a street across: SUMO joins their two nodes."""
    town = Town()
    town.ways.clear()
    one, two = (town.node((x, 0), highway="traffic_signals") for x in (-4, 4))
    wide = dict(highway="secondary", lanes="3", oneway="yes", sidewalk="both")
    for node, x, y in ((one, -4, 100), (two, 4, -100)):
        town.way([town.node((x, y)), node, town.node((x, -y))], **wide)
    town.way([town.node((-100, 0)), one, two, town.node((100, 0))], **ROAD)
    path = town.write(tmp_path / "joined.osm")
    (joined,) = list_junctions(path)
    place = read_map(path, junction=joined.id, radius=40)
    roads = place.regions[Region.JUNCTION].union(place.regions[Region.DRIVEWAY])
    beside = roads.difference(place.regions[Region.CROSSWALK].buffer(0.5))
    people = [LineString(r.waypoints[:, :2]) for r in place.routes if r.user == "pedestrian"]
    assert sum(one.length for one in people) > 300
    for part in shapely.get_parts(shapely.intersection(people, beside)):
        assert part.length < 4.0  # crossing lines end 3 m beyond the crosswalk
    note = "footpaths over the carriageway beside crossings:"
    assert any(one.startswith(note) for one in place.notes)


def test_points_with_heights_make_the_ground(tmp_path):
    """Three points or more with ``ele``: the place stands on the surface through them."""

    def hill(*spots):
        town = full_town()
        for (x, y), ele in spots:
            town.node((x, y), ele=ele)
        return read_map(town.write(tmp_path / "hill.osm"), junction="1", radius=40.0)

    def height(x, y):
        return 500.0 + 0.06 * x - 0.02 * y

    corners = [(-90.0, -90.0), (90.0, -90.0), (90.0, 90.0), (-90.0, 90.0), (3.0, 4.0)]
    told = [(at, f"{height(*at):.3f} m") for at in corners]
    found = hill(*told, ((20.0, 0.0), "about ten"), ((0.0, 20.0), "99999"))
    assert "5 points of the map with a height" in " ".join(found.notes)

    def told_at(points):  # the projection's north is not true north
        east, north = ((found.georeference.to_degrees(points[:, :2]) - [LON, LAT]) * METRES).T
        return height(east, north)

    for points in (found.ground_points, found.center[None], *(r.waypoints for r in found.routes)):
        assert points[:, 2] == pytest.approx(told_at(points), abs=0.02)
    assert np.ptp(hill(*told[:2]).ground_points[:, 2]) == 0
