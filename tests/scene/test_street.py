"""Made-up street furniture: where it may stand, for built-ins and maps; and as a setting."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import shapely
from mounts import lanes_of
from shapely.geometry import LineString, Point
from shapely.ops import unary_union
from worlds import slow_but

import inspe_jax
from inspe_jax.core.digest import digest
from inspe_jax.core.errors import InspeError
from inspe_jax.scene.maps.registry import read_map
from inspe_jax.scene.regions import Region
from inspe_jax.scene.scene import load_scene, save_scene
from inspe_jax.scene.street import (
    BEYOND,
    FROM_CROSSING,
    FROM_POLES,
    HEADROOM,
    street_bodies,
    untouched,
)
from inspe_jax.scene.traffic.waypoint.paths import with_walkways

RADIUS = 50.0
TOWN = {"parked vehicle": 15, "tree": 12, "pole": 8, "furniture": 5}
"""At least so many of each kind stand at every built-in where people walk."""


def check(place, bodies):
    """Nothing is on a lane, a footpath, a crosswalk or near a pole, nor in another body."""
    lanes = lanes_of(place)
    lines = [r for r in with_walkways(place, RADIUS).routes if r.user == "pedestrian"]
    walked = unary_union([LineString(r.waypoints[:, :2]) for r in lines])
    feet = [one.polygon if one.base == 0 else Point(one.middle).buffer(0.14) for one in bodies]
    for one, foot in zip(bodies, feet, strict=True):
        assert foot.distance(lanes) > 0.03, one.words
        assert not foot.distance(walked) <= 0.75, one.words  # not a number where nobody walks
        assert one.base == 0 or one.base >= HEADROOM
        assert one.polygon.distance(lanes) > 0.03 or one.base >= 4.5
        assert np.hypot(*(one.middle - place.center[:2])) < RADIUS + BEYOND
        assert np.hypot(*(place.poles[:, :2] - one.middle).T).min(initial=99) > FROM_POLES
        crossing = place.regions.get(Region.CROSSWALK)
        if crossing is not None and not crossing.is_empty:
            least = FROM_CROSSING if one.kind in ("parked vehicle", "tree") else 0.0
            assert one.polygon.distance(crossing) >= least - 1e-6
    pairs = shapely.STRtree(feet).query(feet, "intersects").T
    assert (pairs[:, 0] == pairs[:, 1]).all()


@pytest.mark.parametrize("name", slow_but(inspe_jax.BUILT_INS, "four_way", "highway_ramp"))
def test_nothing_is_in_the_way_of_traffic(name):
    place = inspe_jax.built_in(name)
    bodies = street_bodies(place, RADIUS)
    counts = Counter(one.kind for one in bodies)
    check(place, bodies)
    if name == "highway_ramp":  # nobody walks or parks there
        assert set(counts) == {"pole"}
    else:
        assert all(counts[kind] >= least for kind, least in TOWN.items()), counts


def test_on_a_town_map(maps):
    place = read_map(maps / "Town10HD.xodr", junction=189, radius=RADIUS)
    bodies = street_bodies(place, RADIUS)
    check(place, bodies)
    assert len(bodies) > 50


def test_no_road_user_touches_a_body_and_what_one_touches_is_left_out():
    place = inspe_jax.built_in("t_junction")
    scene = inspe_jax.build_scene(
        place, radius=40, voxel=1.0, frames=30, density="high", mix="fleet", statics="street"
    )
    bodies = street_bodies(place, 40.0)
    assert len(scene.statics) >= len(bodies) - 1
    assert untouched(scene.statics, scene.traffic) == scene.statics
    car = next(one for one in bodies if one.kind == "parked vehicle")
    moved = scene.traffic.center.copy()
    moved[0, np.flatnonzero(scene.traffic.valid[0])[0], :2] = car.middle
    left = untouched(bodies, replace(scene.traffic, center=moved))
    assert car not in left


def test_a_scene_says_that_it_has_them(tmp_path):
    size = dict(radius=30, voxel=1.0, spacing=2.0, frames=2, density=5)
    place = inspe_jax.built_in("four_way")
    street = inspe_jax.build_scene(place, **size, statics="street")
    assert dict(street.settings)["statics"] == "street"
    other = inspe_jax.build_scene(place, **(size | dict(density=9)), statics="street", seed=3)
    assert digest(other.statics) == digest(street.statics)  # a place stays what it is
    save_scene(street, tmp_path / "s.npz")
    assert digest(load_scene(tmp_path / "s.npz").statics) == digest(street.statics)
    with pytest.raises(InspeError, match="one of none, map, street; did you mean"):
        inspe_jax.build_scene(place, **size, statics="streets")
