"""SUMO's networks and traffic: against the raw XML, CARLA's reading of the same town, and paper."""

import sys
import xml.etree.ElementTree as ET
from collections import Counter
from itertools import pairwise, permutations
from pathlib import Path

import numpy as np
import pytest
import shapely
from shapely.geometry import LineString, Point, Polygon
from worlds import rilsa

import inspe_jax
from inspe_jax.core.errors import InspeError
from inspe_jax.scene.maps.registry import list_junctions, open_map, read_map
from inspe_jax.scene.regions import Region
from inspe_jax.scene.scene import build_scene
from inspe_jax.scene.traffic.frames import CLASSES, ROAD_USERS
from inspe_jax.scene.traffic.sumo.generate import sumo_traffic

pytest.importorskip("sumolib", reason="needs SUMO: extra [sumo]")

CAR, TRUCK, CYCLIST, PEDESTRIAN = range(4)


OWN = {
    "crossing": [Region.CROSSWALK],
    "pedestrian": [Region.SIDEWALK, Region.JUNCTION, Region.CROSSWALK],
    "driven": [Region.DRIVEWAY, Region.JUNCTION],
}
"""The regions in which lanes of each kind lie."""


@pytest.fixture(scope="module")
def place():
    """RiLSA's signalled four-way: lanes of 3.2 m, crossings of 4 m, arms to all four winds."""
    return read_map(rilsa(), junction="0", radius=50)


@pytest.fixture(scope="module")
def traffic(place):
    return sumo_traffic(place, radius=50, count=30, frames=100, seed=3)


@pytest.fixture(scope="module")
def raw():
    """The outlines of the nodes of its file, by name, and its lanes: element, what its edge is
    for, line and width; in world metres."""
    root = ET.parse(rilsa()).getroot()
    moved = np.array(root.find("location").attrib["netOffset"].split(","), float)

    def points(of):
        return np.array([p.split(",")[:2] for p in of.attrib["shape"].split()], float) - moved

    nodes = {node.get("id"): points(node) for node in root.iter("junction") if node.get("shape")}
    lanes = [(lane, edge.get("function"), points(lane), float(lane.get("width", 3.2)))
             for edge in root.iter("edge") for lane in edge.iter("lane")]  # fmt: skip
    return nodes, lanes


def test_the_junction_is_what_its_file_says(place, raw):
    (info,) = list_junctions(rilsa())
    assert (info.id, info.arms, info.crosswalks, info.signals) == ("0", 4, 4, 4)
    assert np.allclose(place.center, 0, atol=0.5)  # 500, 500 less the 500, 500 it was moved by
    assert np.array_equal(info.center[:2], place.center[:2])
    outline = raw[0]["0"]
    assert np.allclose(info.center[:2], (outline.min(0) + outline.max(0)) / 2, atol=1e-6)
    bearings = [arm.bearing for arm in place.arms]
    assert np.allclose(bearings, np.radians([-90, 0, 90, 180]), atol=0.02)
    # Two lanes in, one out, all of 3.2 m.
    assert np.allclose([arm.width for arm in place.arms], 3 * 3.2, atol=0.3)
    drives = [r for r in place.routes if r.user == "vehicle"]
    assert Counter(r.through for r in drives) == dict.fromkeys(permutations(range(4), 2), 1)
    for route in drives:  # from rim to rim without a jump
        away = np.hypot(*route.waypoints[:, :2].T)
        assert away[[0, -1]] == pytest.approx(50, abs=1.5)
        assert away.min() < 15
        assert np.diff(route.arc).max() < 1.6
    assert "no poles" in " ".join(place.notes)


def test_every_lane_of_the_raw_file_lies_in_its_region(place, raw):
    """An independent reading of the XML: the middle of each lane, and its edges but for 0.2 m."""
    seen = Counter()
    for lane, use, line, width in raw[1]:
        if use == "walkingarea" or len(line) < 2:
            continue
        ribbon = LineString(line).buffer(width / 2 - 0.2, cap_style="flat")
        ribbon = ribbon.intersection(Point(0, 0).buffer(55))
        if ribbon.area < 1.0:
            continue
        kind = use if use == "crossing" else lane.get("allow")
        kind = kind if kind in OWN else "driven"
        whole = shapely.union_all([place.regions[r] for r in OWN[kind]])
        assert ribbon.difference(whole).area < 0.02 * ribbon.area, lane.attrib["id"]
        seen[kind] += 1
    assert seen["crossing"] == 4
    assert seen["pedestrian"] == 8
    assert seen["driven"] > 16


def test_nothing_is_paved_where_the_file_has_nothing(place, raw):
    nodes, lanes = raw
    areas = [*nodes.values(), *(line for _, use, line, _ in lanes if use == "walkingarea")]
    known = [Polygon(outline).buffer(0) for outline in areas if len(outline) > 2]
    lines = [(line, width) for _, use, line, width in lanes if use != "walkingarea"]
    known += [LineString(line).buffer(width / 2) for line, width in lines if len(line) > 1]
    disc = Point(0, 0).buffer(50)
    ours = shapely.union_all(list(place.regions.values())).intersection(disc)
    assert ours.difference(shapely.union_all(known).buffer(0.1)).area < 1.0
    traffic = [place.regions[r] for r in (Region.DRIVEWAY, Region.JUNCTION, Region.CROSSWALK)]
    assert place.mounting.area > 100
    assert place.mounting.intersection(shapely.union_all(traffic)).area < 0.01


def test_a_town_is_the_same_place_by_its_net_and_by_opendrive(maps):
    net = read_map(maps / "Town05.net.xml", junction=53)
    own = read_map(maps / "Town05.xodr", junction=53)
    assert np.hypot(*(net.center - own.center)[:2]) < 1.0
    drive = [p.regions[Region.DRIVEWAY].union(p.regions[Region.JUNCTION]) for p in (net, own)]
    # CARLA's crosswalks and shoulders are carriageway to SUMO.
    assert drive[0].intersection(drive[1]).area > 0.93 * min(d.area for d in drive)
    middles = [
        {tuple(np.round(r.waypoints[len(r.waypoints) // 2, :2], -1)) for r in p.routes
         if r.user == "vehicle"}
        for p in (net, own)
    ]  # fmt: skip
    assert len(middles[0] & middles[1]) >= 0.7 * len(middles[0])
    assert net.mounting.area > 0  # islands at the corners: the net has no sidewalks
    assert {a.bearing > 0 for a in net.arms} == {True, False}


def test_as_many_as_asked_for_of_every_class(traffic):
    assert traffic.frame_count == 100
    assert traffic.mean_count == pytest.approx(30, abs=4)
    by_class = np.bincount(traffic.kind[traffic.valid], minlength=4) / 100
    assert by_class[CAR] == pytest.approx(0.68 * 30, rel=0.35)
    assert (by_class > 0.5).all()
    assert np.allclose(traffic.time, np.arange(100))


def test_sizes_are_the_classes_and_stay_with_the_track(traffic):
    for kind, user in enumerate(ROAD_USERS):
        own = traffic.size[traffic.valid & (traffic.kind == kind)]
        assert np.allclose(own.mean(0), user.size, rtol=0.1)
        assert (np.abs(own / user.size - 1) <= 2 * 0.06 + 1e-9).all()
    for track in np.unique(traffic.track[traffic.valid]):
        own = traffic.track == track
        assert len(np.unique(traffic.size[own], axis=0)) == 1
        assert len(np.unique(traffic.kind[own])) == 1
    assert (traffic.track[~traffic.valid] == -1).all()


def test_everybody_moves_as_its_velocity_says(place):
    """Between frames 0.1 s apart: half the steps to 0.01 m/s, all but those that brake or change
    lanes (SUMO has those move sideways) to 0.5."""
    traffic = sumo_traffic(place, radius=50, count=20, frames=60, step=0.1, seed=1)
    off = []
    for track in np.unique(traffic.track[traffic.valid]):
        frame, entry = np.nonzero(traffic.track == track)
        at, speed = (x[frame, entry, :2] for x in (traffic.center, traffic.velocity))
        moved = np.diff(at, axis=0) / 0.1
        off += np.hypot(*(moved - (speed[1:] + speed[:-1]) / 2).T)[np.diff(frame) == 1].tolist()
    assert len(off) > 500
    assert np.median(off) < 0.01
    assert np.quantile(off, 0.98) < 0.5


def test_vehicles_keep_to_the_road_and_people_to_sidewalks_and_crossings(place, traffic):
    at = traffic.center[traffic.valid][:, :2]
    kind = traffic.kind[traffic.valid]
    road, foot = (
        shapely.union_all([place.regions[r] for r in regions])
        for regions in ([*OWN["driven"], Region.CROSSWALK], OWN["pedestrian"])
    )
    assert shapely.contains_xy(road, *at[kind != PEDESTRIAN].T).mean() > 0.999
    assert shapely.contains_xy(foot, *at[kind == PEDESTRIAN].T).mean() > 0.98


def test_cars_wait_for_signals_and_people_cross(place, traffic):
    cars = traffic.valid & (traffic.kind == CAR)
    speed = np.hypot(*traffic.velocity[..., :2].T).T
    assert 0.1 < (speed[cars] < 0.1).mean() < 0.9
    inside = shapely.contains_xy(place.regions[Region.JUNCTION], *traffic.center[cars][:, :2].T)
    assert 0.01 < inside.mean() < 0.5
    people = traffic.valid & (traffic.kind == PEDESTRIAN)
    zebra = place.regions[Region.CROSSWALK]
    assert shapely.contains_xy(zebra, *traffic.center[people][:, :2].T).any()


def test_the_same_seed_gives_the_same_traffic(place):
    def made(seed):
        return sumo_traffic(place, radius=30, count=8, frames=5, seed=seed)

    one, two, other = made(0), made(0), made(1)
    for name in ("center", "yaw", "size", "kind", "track", "velocity"):
        assert np.array_equal(getattr(one, name), getattr(two, name))
    assert not np.array_equal(one.center, other.center)


def test_the_largest_vehicle_alone_and_progress_to_its_end(place):
    told = []
    traffic = sumo_traffic(
        place, radius=40, count=6, frames=10, mix="largest", progress=lambda *at: told.append(at)
    )
    assert told[-1][0] == told[-1][1]
    assert all(a[0] < b[0] for a, b in pairwise(told))
    assert sumo_traffic(place, radius=40, count=0, frames=3).mean_count == 0.0
    assert set(traffic.kind[traffic.valid].tolist()) == {CLASSES.index("truck")}
    assert np.allclose(traffic.size[traffic.valid], ROAD_USERS[TRUCK].size)


NET = '<net version="1.20"><location netOffset="0.00,0.00" convBoundary="0,0,1,1" '
NET += 'origBoundary="0,0,1,1" projParameter="!"/>{}</net>'

BROKEN = {
    "empty": ("a.net.xml", NET.format(""), "the network has no roads"),
    "other": ("a.net.xml", "<html/>", "the root element is <html>, not <net>"),
    "nothing": ("a.net.xml", "", "not well-formed XML"),
    "other extract": ("a.osm", "<html/>", "the root element is <html>, not <osm>"),
    "another side": ("a.osm", "<osm/>", "driving side 'links': one of right, left"),
    "a network's side": ("a.net.xml", NET, "only OpenStreetMap takes a driving side; leave it out"),
    "Lanelet2": (
        "a.osm",
        "<osm><relation id='1'><tag k='type' v='lanelet'/></relation></osm>",
        "is a map of Lanelet2, which is not read; convert it to OpenDRIVE",
    ),
    "empty extract": ("a.osm", '<osm version="0.6"></osm>', "netconvert failed"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_each_bad_map_gets_its_message(tmp_path, case):
    name, text, message = BROKEN[case]
    path = tmp_path / name
    path.write_text(text)
    side = "links" if "side" in case else None
    with pytest.raises(InspeError, match=message) as raised:
        open_map(path, side)
    assert str(path) in str(raised.value)


def test_other_bad_input(place):
    with pytest.raises(InspeError, match=r"four_way: SUMO runs on a map"):
        build_scene(inspe_jax.built_in("four_way"), traffic="sumo", radius=20, voxel=1.0)
    with pytest.raises(InspeError, match=r"traffic 'somo': waypoints, sumo.*did you mean sumo"):
        build_scene(place, traffic="somo")
    for step in (0.0001, 0.0333, 0.007):
        with pytest.raises(InspeError, match="SUMO needs a step of whole milliseconds"):
            sumo_traffic(place, radius=30, count=5, frames=2, step=step)


def test_a_missing_extra_says_what_to_install(tmp_path, monkeypatch):
    path = tmp_path / "a.net.xml"
    path.write_text(Path(rilsa()).read_text())
    monkeypatch.setitem(sys.modules, "sumolib", None)
    with pytest.raises(InspeError, match=r"pip install .*\[sumo\]'"):
        list_junctions(path)
