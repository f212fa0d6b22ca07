"""Static bodies: outlines that can be meant, convex pieces, voxels inside, and the saved file; and
made-up street furniture: where it may stand."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import shapely
from mounts import lanes_of
from shapely.geometry import LineString, Point, Polygon
from shapely.ops import unary_union
from worlds import crossing, slow_but, world

import inspe_jax
from inspe_jax.core.digest import digest
from inspe_jax.core.errors import InspeError
from inspe_jax.scene import street
from inspe_jax.scene.maps.registry import read_map
from inspe_jax.scene.placed_bodies import body_at
from inspe_jax.scene.regions import Region
from inspe_jax.scene.scene import load_scene, save_scene
from inspe_jax.scene.statics import CORNERS, body, octagon, pole, tree, upright_box, wall
from inspe_jax.scene.traffic.waypoint.paths import with_walkways

ELL = np.array([[0, 0], [6, 0], [6, 2], [2, 2], [2, 6], [0, 6]], float)
BOW = [[0, 0], [4, 4], [4, 0], [0, 4]]


def comb(teeth: int) -> np.ndarray:
    """An outline with many reflex corners."""
    across = np.repeat(np.arange(2 * teeth), 2) + np.tile([0.0, 1.0], 2 * teeth)
    up = np.repeat(np.tile([5.0, 1.0], teeth), 2)
    top = np.column_stack([across, up])
    return np.concatenate([[[0, 0]], top, [[2 * teeth, 0]]])


@pytest.mark.parametrize("outline", [
    ELL,
    ELL[::-1],
    comb(5),
    np.array(Polygon(ELL).buffer(1.0, quad_segs=6).exterior.coords),
    ELL + [1873.2, -951.7],
])  # fmt: skip
def test_convex_pieces_cover_the_outline_exactly(outline):
    found = body("building", outline, 9.0)
    parts = [Polygon(piece) for piece in found.pieces]
    for piece, part in zip(found.pieces, parts, strict=True):
        assert len(piece) <= CORNERS
        assert part.exterior.is_ccw
        assert part.convex_hull.area == pytest.approx(part.area, abs=1e-9)
    assert sum(part.area for part in parts) == pytest.approx(Polygon(outline).area)
    assert shapely.union_all(parts).symmetric_difference(Polygon(outline)).area < 1e-9


@pytest.mark.parametrize(("wrong", "message"), [
    (lambda: body("hous", ELL, 3), "body 'hous': one of building.*"),
    (lambda: body("building", BOW, 3), r"building at \(2.0, 2.0\): its outline crosses"),
    (lambda: body("building", [[0, 0], [1, 1], [0, 0]], 3), "three corners or more"),
    (lambda: body("building", [[0, 0], [np.nan, 1], [2, 0]], 3), "not finite"),
    (lambda: body("building", ELL[:, :1], 3), r"shape \(6, 1\)"),
    (lambda: body("building", "house", 3), "must be numbers"),
    (lambda: body("building", ELL, 2, base=2), "from 2 to 2 m above the ground; its height"),
    (lambda: body("building", ELL, 2, base=-1), "the base 0 or more"),
    (lambda: body("building", ELL, 5000), "at most 1000 m"),
    (lambda: tree((0, 0), radius=2, height=7, base=3, transmittance=1.5), "transmittance 1.5"),
    (lambda: tree((0, 0), radius=2, height=7, base=0), "a trunk of 0.15 m"),
    (lambda: wall([[0, 0]], 2), "two points"),
])  # fmt: skip
def test_bodies_that_cannot_be_meant(wrong, message):
    with pytest.raises(InspeError, match=message):
        wrong()


def test_a_body_that_swallows_the_region_or_all_of_it():
    scene = world(count=0, voxel=2.0)
    everywhere = octagon((0, 0), 200)
    with pytest.raises(InspeError, match=r"building at \(0.0, 0.0\) stands on 100% of the region"):
        scene.with_statics([body("building", everywhere, 10)])
    halves = [upright_box("building", (x, y), (40, 40, 9)) for x in (-20, 20) for y in (-20, 20)]
    with pytest.raises(InspeError, match="leave nothing of the region of interest"):
        scene.with_statics(halves)


def test_voxels_inside_are_those_whose_centres_are():
    """On a slope, the ground under a body's middle is what its heights are above."""
    scene = world(count=0, slope=0.1, center=(103.0, -47.0, 12.0))
    house = upright_box("building", (108.0, -40.0), (6.0, 4.0, 2.0), 0.3)
    bus = tree((98.0, -50.0), radius=2.0, height=6.0, base=2.6, trunk=0.4)
    scene = scene.with_statics([house, bus])
    (x, y, z), centers = (scene.voxels.centers - scene.voxels.center).T, scene.voxels.centers
    x, y = x - 5.0, y - 7.0
    along, across = np.cos(0.3) * x + np.sin(0.3) * y, np.cos(0.3) * y - np.sin(0.3) * x
    in_house = (np.abs(along) < 3) & (np.abs(across) < 2) & (z < 0.5 + 2.0)
    in_crown = shapely.contains_xy(bus.polygon, *centers[:, :2].T) & (z > -0.5 + 2.6)
    away = np.hypot(*(centers[:, :2] - [98.0, -50.0]).T)
    inside = scene.inside_statics.ravel()
    assert (inside[away > 1.0] == (in_house | in_crown)[away > 1.0]).all()
    assert inside[(away < 0.38) & (z < 2.0)].all()  # the trunk
    assert not inside[(away > 0.45) & (away < 1.5) & (z < 2.0)].any()  # beneath the crown
    assert (scene.voxel_weight[inside] == 0).all()
    assert (scene.voxel_weight[~inside] > 0).all()


def test_which_body_a_point_is_in():
    place = crossing()
    bodies = [
        body("building", ELL, 6.0),
        tree((10, 10), radius=2, height=7, base=3),
        pole((20, 0), radius=0.1, height=6),
    ]
    ell, crown, post = bodies
    for at, expected in (
        ((1.0, 1.0, 5.9), ell),  # on a seam of its pieces
        ((1.0, 1.5, 5.9), ell),
        ((1.0, 1.0, 6.1), None),  # on its roof
        ((4.0, 4.0, 1.0), None),  # between its wings
        ((11.0, 10.0, 5.0), crown),
        ((11.0, 10.0, 2.0), None),  # beneath the crown
        ((10.1, 10.0, 2.0), crown),  # in the trunk
        ((20.05, 0.0, 2.0), post),
    ):
        assert body_at(bodies, place, np.array(at)) is expected
    # A sensor at a facade is in the house.
    house = upright_box("building", (0.0, 0.0), (10, 8, 6))
    for x, inside in ((4.9, True), (5.0, True), (5.0009, True), (5.0011, False)):
        assert (body_at([house], place, np.array([x, 1.0, 3.0])) is house) == inside


def test_saved_with_the_scene_and_part_of_what_it_is(tmp_path):
    scene = replace(world(frames=2, voxel=2.0), intersection=inspe_jax.built_in("four_way"))
    full = scene.with_statics(
        [
            body("building", ELL + [20.0, 20.0], 9.0, base=3.0),
            tree((-15.0, 15.0), radius=2, height=7, base=3),
            *wall([[-20, -12], [-15, -12], [-12, -15]], 1.5, kind="hedge"),
        ]
    )
    for name, one in (("open", scene), ("full", full)):
        save_scene(one, tmp_path / f"{name}.npz")
    with np.load(tmp_path / "open.npz") as data:
        assert not any("statics" in key for key in data.files)
    assert load_scene(tmp_path / "open.npz").statics == ()
    again = load_scene(tmp_path / "full.npz").statics
    assert digest(again) == digest(full.statics)
    assert digest(replace(full, statics=again)) == digest(full) != digest(scene)
    assert digest(full.with_statics([])) == digest(scene)


def test_corners_on_a_straight_side_are_none():
    """As outlines from maps have them: their pieces would have sides that go on for ever."""
    plain = upright_box("building", (3.0, 4.0), (12, 3, 5), 0.3)
    nodes = np.asarray(plain.polygon.segmentize(1.0).exterior.coords)[:-1]
    assert len(nodes) > 3 * 8
    for corners in (nodes, nodes[::-1], np.roll(nodes, 3, 0)):
        found = body("building", corners, 5.0)
        assert len(found.outline) == 4
        (piece,) = found.pieces
        assert Polygon(piece).symmetric_difference(plain.polygon).area < 1e-9


def test_an_outline_in_the_other_sense_keeps_where_its_first_side_points():
    """A parked vehicle heads along it."""
    car = np.array([[0, 0], [4.6, 0], [4.6, 1.8], [0, 1.8]])
    for corners, ahead in ((car, 4.6), (car[[1, 0, 3, 2]], -4.6), (car[[3, 2, 1, 0]], 4.6)):
        outline = body("parked vehicle", corners, 1.5).outline
        assert np.diff(outline[:2], axis=0).tolist() == [[ahead, 0]]
        assert Polygon(outline).exterior.is_ccw


RADIUS = 50.0
TOWN = {"parked vehicle": 15, "tree": 12, "pole": 8, "furniture": 5}
"""At least so many of each kind stand at every built-in where people walk."""


def test_street_bodies_on_a_town_map(maps):
    place = read_map(maps / "Town10HD.xodr", junction=189, radius=RADIUS)
    bodies = street.street_bodies(place, RADIUS)
    check(place, bodies)
    assert len(bodies) > 50


def check(place, bodies):
    """Nothing is on a lane, a footpath, a crosswalk or near a pole, nor in another body."""
    lanes = lanes_of(place)
    lines = [r for r in with_walkways(place, RADIUS).routes if r.user == "pedestrian"]
    walked = unary_union([LineString(r.waypoints[:, :2]) for r in lines])
    feet = [one.polygon if one.base == 0 else Point(one.middle).buffer(0.14) for one in bodies]
    for one, foot in zip(bodies, feet, strict=True):
        assert foot.distance(lanes) > 0.03, one.words
        assert not foot.distance(walked) <= 0.75, one.words  # not a number where nobody walks
        assert one.base == 0 or one.base >= street.HEADROOM
        assert one.polygon.distance(lanes) > 0.03 or one.base >= 4.5
        assert np.hypot(*(one.middle - place.center[:2])) < RADIUS + street.BEYOND
        assert np.hypot(*(place.poles[:, :2] - one.middle).T).min(initial=99) > street.FROM_POLES
        crossing = place.regions.get(Region.CROSSWALK)
        if crossing is not None and not crossing.is_empty:
            least = street.FROM_CROSSING if one.kind in ("parked vehicle", "tree") else 0.0
            assert one.polygon.distance(crossing) >= least - 1e-6
    pairs = shapely.STRtree(feet).query(feet, "intersects").T
    assert (pairs[:, 0] == pairs[:, 1]).all()


@pytest.mark.parametrize("name", slow_but(inspe_jax.BUILT_INS, "four_way", "highway_ramp"))
def test_nothing_is_in_the_way_of_traffic(name):
    place = inspe_jax.built_in(name)
    bodies = street.street_bodies(place, RADIUS)
    counts = Counter(one.kind for one in bodies)
    check(place, bodies)
    if name == "highway_ramp":  # nobody walks or parks there
        assert set(counts) == {"pole"}
    else:
        assert all(counts[kind] >= least for kind, least in TOWN.items()), counts


def test_no_road_user_touches_a_body_and_what_one_touches_is_left_out():
    place = inspe_jax.built_in("t_junction")
    scene = inspe_jax.build_scene(
        place, radius=40, voxel=1.0, frames=10, density="high", mix="fleet", statics="street"
    )
    bodies = street.street_bodies(place, 40.0)
    assert len(scene.statics) >= len(bodies) - 1
    assert street.untouched(scene.statics, scene.traffic) == scene.statics
    car = next(one for one in bodies if one.kind == "parked vehicle")
    moved = scene.traffic.center.copy()
    moved[0, np.flatnonzero(scene.traffic.valid[0])[0], :2] = car.middle
    left = street.untouched(bodies, replace(scene.traffic, center=moved))
    assert car not in left


def test_a_scene_says_that_it_has_them():
    size = dict(radius=30, voxel=1.0, spacing=2.0, frames=2, density=5)
    place = inspe_jax.built_in("four_way")
    built = inspe_jax.build_scene(place, **size, statics="street")
    assert dict(built.settings)["statics"] == "street"
    other = inspe_jax.build_scene(place, **(size | dict(density=9)), statics="street", seed=3)
    assert digest(other.statics) == digest(built.statics)  # a place stays what it is
    with pytest.raises(InspeError, match="one of none, map, street; did you mean"):
        inspe_jax.build_scene(place, **size, statics="streets")
