"""Bodies of OpenDRIVE maps on paper, parking, and the reference line."""

import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
import shapely
from shapely.geometry import Point, Polygon, box
from worlds import crossing

import inspe_jax
from inspe_jax.scene.maps.lanes import LaneStrip
from inspe_jax.scene.maps.opendrive.geometry import ReferenceLine
from inspe_jax.scene.maps.opendrive.objects import OCCUPIED, PARKING, shapes_of, with_parked
from inspe_jax.scene.maps.opendrive.road_network import OpenDriveRoad
from inspe_jax.scene.maps.registry import read_map
from inspe_jax.scene.regions import Region

LINE = '<geometry s="0" x="10" y="20" hdg="0" length="100"><line/></geometry>'
ARC = '<geometry s="0" x="0" y="0" hdg="0" length="100"><arc curvature="0.02"/></geometry>'


def read(objects: str, plan: str = LINE):
    road = ET.fromstring(
        f'<road length="100"><planView>{plan}</planView><lanes><laneSection s="0"/></lanes>'
        f"<objects>{objects}</objects></road>"
    )
    return shapes_of([(road, OpenDriveRoad.of(road))])


def same(area, expected):
    return area.symmetric_difference(expected).area < 1e-6


ROAD_CORNERS = "".join(
    f'<cornerRoad s="{s}" t="{t}" dz="0" height="9"/>' for s, t in ((20, 5), (30, 5), (30, 12))
)
LOCAL_CORNERS = "".join(
    f'<cornerLocal u="{u}" v="{v}" z="1" height="4"/>' for u, v in ((0, 0), (6, 0), (6, 2), (0, 2))
)
ON_A_LINE = "".join(f'<cornerLocal u="{u}" v="2"/>' for u in (0, 3, 1))
HOUSE = 'type="building" s="30" t="15" length="12" width="8" height="7"'
TRIANGLE = Polygon([(30, 25), (40, 25), (40, 32)])
ON_PAPER = {  # object: kind, base, height, and area, or what it measures about its middle
    f'<object {HOUSE} hdg="0"/>': ("building", 0, 7, box(34, 31, 46, 39)),
    f'<object {HOUSE} hdg="{np.pi / 2}"/>': ("building", 0, 7, box(36, 29, 44, 41)),
    f'<object type="building" s="0" t="0"><outline>{ROAD_CORNERS}</outline></object>': (
        *("building", 0, 9, TRIANGLE),
    ),
    f'<object type="building" s="20" t="-10" hdg="{np.pi / 2}" zOffset="3"><outlines><outline>'
    f"{LOCAL_CORNERS}</outline></outlines></object>": ("building", 4, 8, box(28, 10, 30, 16)),
    '<object type="tree" s="10" t="6" radius="2" height="9"/>': (
        *("tree", 2.5, 9, (20, 26), 4 * np.pi),
    ),
    '<object type="pole" s="10" t="6" height="5"/>': ("pole", 0, 5, (20, 26), 0.01 * np.pi),
    '<object type="barrier" subtype="wall" s="5" t="4" length="20" width="0.3" height="2"/>': (
        *("wall", 0, 2, box(5, 23.85, 25, 24.15)),
    ),
    '<object type="vegetation" name="hedge" s="5" t="4" length="9" width="1" height="2"/>': (
        *("hedge", 0, 2, box(10.5, 23.5, 19.5, 24.5)),
    ),
    '<object type="parkingSpace" s="20" t="6" length="5" width="2.4"/>': (
        *(PARKING, 0, 0, box(27.5, 24.8, 32.5, 27.2)),
    ),
}


@pytest.mark.parametrize("given", ON_PAPER)
def test_an_object_worked_out_on_paper(given):
    ((shape,), notes) = read(given)
    kind, base, height, area, *size = ON_PAPER[given]
    assert notes == ()
    assert (shape.kind, shape.base, shape.height) == (kind, base, height)
    if size:
        assert np.allclose(shape.area.centroid.coords[0], area)
        assert shape.area.area == pytest.approx(*size)
    else:
        assert same(shape.area, area)


def test_repeats_with_gaps_and_without():
    trees, notes = read(
        '<object type="tree" s="0" t="6" radius="2" height="9"><repeat s="10" length="40" '
        'distance="10" tStart="6" tEnd="10" heightStart="5" heightEnd="9"/></object>'
    )
    assert notes == ()
    assert np.allclose([t.area.centroid.coords[0] for t in trees],
                       [(20 + 10 * k, 26 + k) for k in range(5)])  # fmt: skip
    assert [t.height for t in trees] == [5, 6, 7, 8, 9]
    strips, _ = read(
        '<object type="barrier" s="0" t="5" height="3"><repeat s="0" length="50" distance="0" '
        'widthStart="0.4" widthEnd="0.4"/></object>',
        ARC,
    )
    whole = shapely.union_all([s.area for s in strips])
    ring = Point(0, 50).buffer(45.2, quad_segs=256) - Point(0, 50).buffer(44.8, quad_segs=256)
    assert whole.difference(ring.buffer(0.02)).area < 1e-9
    assert whole.area == pytest.approx(0.4 * 45, rel=2e-3)  # an arc of 1 rad about (0, 50)
    corners = "".join(
        f'<cornerRoad s="{s}" t="{t}" height="4"/>' for s, t in ((0, 4), (2, 4), (2, 6))
    )
    row, _ = read(
        f'<object type="building" s="0" t="5"><repeat s="20" length="30" distance="15" tStart="8" '
        f'tEnd="8"/><outline>{corners}</outline></object>'
    )
    for k, shape in enumerate(row):
        x = 10 + 20 + 15 * k  # and 3 m farther out than the object
        assert same(shape.area, Polygon([(x, 27), (x + 2, 27), (x + 2, 29)]))
    assert [shape.height for shape in row] == [4, 4, 4]
    many, _ = read('<object type="pole" s="0" t="5" height="3"><repeat s="0" length="50" '
                   'distance="1e-9"/></object>')  # fmt: skip
    assert len(many) == 25


def test_what_is_no_body_or_makes_no_sense():
    none, notes = read(
        '<object type="-1"/>'
        '<object type="barrier" subtype="guardRail" s="0" t="5" length="5" width="2" height="1"/>'
        "<object/>"
    )
    assert (none, notes) == ((), ())
    some, notes = read(
        '<object type="building" s="x" t="0"/>'
        '<object type="building" s="nan" length="5" width="5"/>'
        '<object type="building" s="4" t="9"/>'
        f'<object type="crosswalk" s="4" t="9"><outline>{ON_A_LINE}</outline></object>'
        '<object type="building" s="9" t="9"><outline><cornerLocal u="1"/></outline></object>'
        '<object type="building" s="9" t="9" length="5" width="5"/>'
    )
    assert [s.height for s in some] == [6]
    assert notes == (
        "objects of the map without a height: 1, taken as of a usual one",
        "objects of the map without a size: 2, left out",
        "objects of the map with a number missing or wrong: 3, left out",
    )


def test_pieces_worked_out_on_paper():
    def line(shape: str):
        return ReferenceLine(ET.fromstring(
            f'<road><planView><geometry s="0" x="1" y="2" hdg="{np.pi / 2}" length="10">{shape}'
            "</geometry></planView></road>"))  # fmt: skip

    at, heading = line("<line/>").at(4, 3)
    assert np.allclose([*at, heading], [1 - 3, 2 + 4, np.pi / 2])
    at, heading = line(f'<arc curvature="{np.pi / 20}"/>').at(10)
    assert np.allclose([*at, heading], [1 - 20 / np.pi, 2 + 20 / np.pi, np.pi])
    # A clothoid from 0 to c: Fresnel's integrals.
    from scipy.special import fresnel

    scale = np.sqrt(np.pi * 10 / 0.3)
    s, c = fresnel(10 / scale)
    at, heading = line('<spiral curvStart="0" curvEnd="0.3"/>').at(10)
    assert np.allclose([*at, heading], [1 - s * scale, 2 + c * scale, np.pi / 2 + 1.5])
    # v = 0.04 u²: to u = 5 it is 5.1939 m long, half of which is (asinh x + x √(1 + x²)) / 0.16.
    u, x = 5.0, 0.4
    along = (np.arcsinh(x) + x * np.hypot(1, x)) / 0.16
    at, heading = line('<poly3 a="0" b="0" c="0.04" d="0"/>').at(along)
    assert np.allclose(
        [*at, heading], [1 - 0.04 * u**2, 2 + u, np.pi / 2 + np.arctan(x)], atol=1e-4
    )
    for shape, at_end in (("arcLength", (10, 1.0)), ("normalized", (1, 0.1))):
        cubic = f'<paramPoly3 pRange="{shape}" aU="0" bU="1" cU="0" dU="0" '
        at, _ = line(cubic + 'aV="0" bV="0.1" cV="0" dV="0"/>').at(10)
        assert np.allclose(at, [1 - at_end[1], 2 + at_end[0]])


def lane(y, width, length=48.0, bend=0.0):
    """A parking lane along x, whose middle is at y; or on an arc of a curvature [1/m]."""
    s = np.arange(0.0, length + 0.5)
    turn = s * bend
    x = np.sin(turn) / bend if bend else s
    lift = (1 - np.cos(turn)) / bend if bend else 0 * s
    center = np.column_stack([x - length / 2, y + lift, 0 * s])
    ahead = np.column_stack([np.cos(turn), np.sin(turn)])
    return LaneStrip.along(1, -1, "parking", center, ahead, width)


def parked(place, lanes, spaces, reach):
    """The parked vehicles of a place without bodies."""
    return with_parked(place, lanes, spaces, reach, []).bodies


@pytest.mark.parametrize(("width", "across", "places"), [(2.2, False, 8), (5.2, True, 19)])
def test_vehicles_stand_in_their_lane(width, across, places):
    """Behind each other in a narrow lane and side by side in a wide one; most places are taken."""
    counts = []
    for name in "abcdefgh":
        place, strip = replace(crossing(), name=name), lane(9.0, width)
        found = parked(place, [strip], [], 50.0)
        counts.append(len(found))
        for one in found:
            assert strip.polygon.covers(one.polygon)
            length = one.outline[1] - one.outline[0]
            assert abs(length[int(not across)]) < 1e-9
        bodies = [one.polygon for one in found]
        pairs = shapely.STRtree(bodies).query(bodies, "intersects")
        assert pairs.shape[1] == len(found)  # each meets itself alone
        again = parked(place, [strip], [], 50.0)
        assert [one.number for one in again] == [one.number for one in found]
    assert np.mean(counts) / places == pytest.approx(OCCUPIED, abs=0.12)
    assert max(counts) <= places
    strip = lane(9.0, 2.4, bend=1 / 30)
    found = parked(crossing(), [strip], [], 60.0)
    assert len(found) >= 4
    assert all(one.polygon.difference(strip.polygon).area < 0.1 for one in found)


def test_on_marked_spaces_along_the_longer_side():
    turned = shapely.affinity.rotate(box(10, 10, 15, 12.4), 30)
    spaces = [turned, box(20, 10, 22.5, 15), box(30, 10, 31, 12)]  # the last is for a bicycle
    found = [
        one
        for name in "abcdefgh"
        for one in parked(replace(crossing(), name=name), [], spaces, 60.0)
    ]
    assert 8 <= len(found) <= 16
    for one in found:
        assert any(space.buffer(1e-6).covers(one.polygon) for space in spaces[:2])


def test_not_on_crosswalks_nor_in_other_bodies():
    place = crossing()
    place = replace(place, regions={**place.regions, Region.CROSSWALK: box(-6, 5, -2, 13)})
    notes = []
    found = with_parked(place, [lane(9.0, 2.2)], [], 50.0, notes)
    assert found.bodies
    assert not any(one.polygon.intersects(box(-6, 5, -2, 13)) for one in found.bodies)
    assert f"{len(found.bodies)} vehicles parked" in notes[0]
    assert with_parked(found, [lane(9.0, 2.2)], [], 50.0, notes).bodies == found.bodies
    near = parked(place, [lane(9.0, 2.2)], [], 14.0)
    assert 0 < len(near) < len(found.bodies)


def test_a_town_with_parking_lanes(maps):
    """In Town05 parked vehicles stand in nobody's way."""
    place = read_map(maps / "Town05.xodr", junction="53", radius=50.0)
    assert {one.kind for one in place.bodies} == {"parked vehicle"}
    size = dict(radius=50, voxel=1.0, frames=4)
    scene = inspe_jax.build_scene(place, statics="map", **size)
    assert 0.8 * len(place.bodies) <= len(scene.statics) <= len(place.bodies)
