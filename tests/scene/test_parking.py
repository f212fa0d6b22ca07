"""Vehicles in the parking lanes and spaces of maps."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from shapely.geometry import box
from worlds import MAPS, crossing

import inspe_jax
from inspe_jax.scene.maps.lanes import LaneStrip
from inspe_jax.scene.maps.parking import OCCUPIED, parked_vehicles, with_parked
from inspe_jax.scene.regions import Region


def lane(y, width, length=48.0, bend=0.0):
    """A parking lane along x, whose middle is at y; or on an arc of a curvature [1/m]."""
    s = np.arange(0.0, length + 0.5)
    turn = s * bend
    x = np.sin(turn) / bend if bend else s
    lift = (1 - np.cos(turn)) / bend if bend else 0 * s
    center = np.column_stack([x - length / 2, y + lift, 0 * s])
    ahead = np.column_stack([np.cos(turn), np.sin(turn)])
    return LaneStrip.along(1, 1, -1, "parking", center, ahead, width)


@pytest.mark.parametrize(("width", "across", "places"), [(2.2, False, 8), (5.2, True, 19)])
def test_vehicles_stand_in_their_lane(width, across, places):
    """Behind each other in a narrow lane and side by side in a wide one; most places are taken."""
    counts = []
    for name in "abcdefgh":
        place, strip = replace(crossing(), name=name), lane(9.0, width)
        found = parked_vehicles(place, [strip], [], 50.0)
        counts.append(len(found))
        for one in found:
            assert strip.polygon.covers(one.polygon)
            length = one.outline[1] - one.outline[0]
            assert abs(length[int(not across)]) < 1e-9
        bodies = [one.polygon for one in found]
        pairs = shapely.STRtree(bodies).query(bodies, "intersects")
        assert pairs.shape[1] == len(found)  # each meets itself alone
        again = parked_vehicles(place, [strip], [], 50.0)
        assert [one.number for one in again] == [one.number for one in found]
    assert np.mean(counts) / places == pytest.approx(OCCUPIED, abs=0.12)
    assert max(counts) <= places
    strip = lane(9.0, 2.4, bend=1 / 30)
    found = parked_vehicles(crossing(), [strip], [], 60.0)
    assert len(found) >= 4
    assert all(one.polygon.difference(strip.polygon).area < 0.1 for one in found)


def test_on_marked_spaces_along_the_longer_side():
    turned = shapely.affinity.rotate(box(10, 10, 15, 12.4), 30)
    spaces = [turned, box(20, 10, 22.5, 15), box(30, 10, 31, 12)]  # the last is for a bicycle
    found = [
        one
        for name in "abcdefgh"
        for one in parked_vehicles(replace(crossing(), name=name), [], spaces, 60.0)
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
    near = parked_vehicles(place, [lane(9.0, 2.2)], [], 14.0)
    assert 0 < len(near) < len(found.bodies)


def test_a_town_with_parking_lanes():
    """In Town05 parked vehicles stand in nobody's way."""
    if not (path := MAPS / "Town05.xodr").is_file():
        pytest.skip("the town maps are not beside the checkout")
    pytest.importorskip("carla", reason="needs the CARLA client: extra [opendrive]")
    from inspe_jax.scene.maps.registry import read_map

    place = read_map(path, junction="53", radius=50.0)
    assert {one.kind for one in place.bodies} == {"parked vehicle"}
    size = dict(radius=50, voxel=1.0, frames=4)
    scene = inspe_jax.build_scene(place, statics="map", **size)
    assert 0.8 * len(place.bodies) <= len(scene.statics) <= len(place.bodies)
