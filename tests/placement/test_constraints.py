"""What can be mounted: rules and messages one by one; the feasible set against shapely and the raw
map, its charts and gradients; and bodies, which units and sensors keep out of."""

from dataclasses import replace
from itertools import combinations

import jax
import numpy as np
import pytest
import shapely
from mounts import (
    SCENES,
    SIDEWALK,
    anywhere,
    assert_mountable,
    lanes_of,
    scene_named,
    space_of,
    two_sensors,
)
from shapely.geometry import MultiPoint, Point, box
from shapely.ops import unary_union
from worlds import LIDAR, place_sensors, world

from inspe_jax.core.errors import InspeError
from inspe_jax.mounting.site import Site
from inspe_jax.mounting.strategies import STRATEGIES, strategy
from inspe_jax.placement.constraints import Constraints
from inspe_jax.placement.space import Space
from inspe_jax.scene.maps.registry import read_map
from inspe_jax.scene.placed_bodies import body_at
from inspe_jax.scene.procedural.built_ins import BUILT_INS
from inspe_jax.scene.scene import build_scene
from inspe_jax.scene.statics import tree, upright_box
from inspe_jax.sensing.layout import UNIT_PLAN

# ── Rules one by one ────────────────────────────────────────────────────────


def test_low_sensors_over_a_lane_are_raised_within_the_unit_rule():
    scene = scene_named("four_way")
    place, lanes = scene.intersection, lanes_of(scene.intersection)
    site = space_of(scene).site
    foot = shapely.get_coordinates(shapely.shortest_line(site.free, site.place.lanes))[0]
    turn = np.linspace(0, 2 * np.pi, 16)
    ring = 1.9 * np.stack([np.cos(turn), np.sin(turn)], 1)
    out = ring[shapely.contains_xy(lanes, foot + ring).argmax()]
    given = two_sensors(scene, tuple(foot), (*out, 3.0), (0, 0, 3.0))
    assert lanes.contains(Point(given.poses[0, :2]))
    space = Space(scene, given)
    assert space.violations(given) == ["sensor 's0' is 3.00 m above a lane, at least 5 m"]
    _, notes = space.start(given)
    # The other one, at the kerb, as well: the search keeps 0.3 m off a lane.
    assert notes == tuple(
        f"sensor 's{k}' raised from 3.00 to 5.00 m above the ground" for k in (0, 1)
    )
    rng = np.random.default_rng(9)
    poses = jax.jit(space.poses)
    raised = 0
    for x in space.random(rng, 150):
        c = space.split(x)
        # Both ends of the unit rule: 3 and 7 m, on a foot at the kerb.
        rise = rng.choice([-2.0, 2.0], 2)
        x = c._replace(base=foot[None] - space.center[:2], height=np.array([5.0]), rise=rise).flat()
        layout = space.layout(x)
        above = layout.poses[:, 2] - place.ground(foot)[0]
        assert space.violations(layout) == []
        over = shapely.contains_xy(lanes, layout.poses[:, :2])
        assert (above[over] >= 5.0 - 1e-9).all()
        raised += (over & (rise < 0)).sum()
        beside = shapely.distance(lanes, shapely.points(layout.poses[:, :2])) > 0.3
        np.testing.assert_allclose(above[beside], 5.0 + rise[beside])
        z = np.asarray(poses(np.float32(x)))[:, 2]
        np.testing.assert_allclose(z, layout.poses[:, 2] - space.center[2], atol=1e-5)
    assert raised > 10


def test_places_by_unit():
    """One stays where it is, one is tied to the poles, one free in the areas, one chooses."""
    for places, may in dict(any=True, areas=True, poles=True, keep=False).items():
        space = space_of(places=places)
        assert (space.scale[: 2 * len(space.given.units)] > 0).tolist() == [may] * 8
    names = [unit.name for unit in space_of().given.units]
    space = space_of(places={names[0]: "keep", names[1]: "poles", names[2]: "areas"})
    given = np.array([unit.base[:2] for unit in space.given.units])
    on_pole = []
    for x in space.random(np.random.default_rng(12), 40):
        layout = space.layout(x)
        assert space.violations(layout) == []
        feet = np.array([unit.base[:2] for unit in layout.units])
        np.testing.assert_allclose(feet[0], given[0])
        assert space.site.free.covers(Point(feet[2]))
        on_pole.append([np.hypot(*(space.site.poles - foot).T).min() < 1e-6 for foot in feet])
    assert (np.mean(on_pole, 0)[1], np.mean(on_pole, 0)[2]) == (1.0, 0.0)
    assert 0 < np.mean(on_pole, 0)[3] < 1
    moves = (space.scale[: 2 * len(given)] > 0).reshape(-1, 2).all(1)
    assert moves.tolist() == [False] + [True] * (len(given) - 1)
    # By shapely, too: the second one in the middle of an area and not on a pole.
    units = list(space.given.units)
    middle = space.site.free.representative_point().coords[0]
    units[1] = replace(units[1], base=(*middle, 0.0))
    wrong = space.violations(replace(space.given, units=tuple(units)))
    assert any(f"'{names[1]}'" in line and "stands on no pole" in line for line in wrong), wrong


def test_a_unit_over_the_centre_keeps_its_foot_and_its_heights():
    space = space_of(layout="Cam-c/L-c")
    for x in space.random(np.random.default_rng(11), 20):
        layout = space.layout(x)
        assert layout.units[0].base == pytest.approx(space.given.units[0].base)
        assert layout.poses[:, 2].min() >= 5.0 - 1e-6
        assert space.violations(layout) == []
    # On the island of a roundabout it may leave the middle.
    island = space_of("roundabout", "Cam-c")
    bases = [island.split(x).base for x in island.random(np.random.default_rng(11), 20)]
    assert np.ptp(bases, axis=0).min() > 10


def test_an_area_of_ones_own():
    scene = scene_named("four_way")
    corner = scene.intersection.center[:2] + 15.0
    own = box(*corner, *(corner + 6))
    space = space_of(area=own, places="areas")
    x, notes = space.start(space.given)
    assert len([note for note in notes if note.startswith("unit")]) == len(space.given.units)
    for row in (x, *space.random(np.random.default_rng(13), 20)):
        layout = space.layout(row)
        assert all(own.covers(Point(unit.base[:2])) for unit in layout.units)
        assert space.violations(layout) == []


def test_candidate_feet():
    units = space_of("roundabout").given.units
    places = ("any", "areas", "poles", "keep")
    named = {unit.name: place for unit, place in zip(units, places, strict=True)}
    space = space_of("roundabout", places=named)
    feet = space.feet(5.0)
    world_feet = feet + space.center[:2]
    assert (shapely.distance(shapely.points(world_feet), space.site.free) < 1e-6).sum() > 100
    # Every spot of the area has a candidate not far away, however narrow the area.
    spots = np.random.default_rng(14).uniform(-40, 40, (4000, 2))
    spots = spots[shapely.contains_xy(space.site.core, spots + space.center[:2])]
    gap = np.hypot(*np.moveaxis(spots[:, None] - feet, -1, 0)).min(1)
    assert gap.max() < 5 * np.sqrt(2)
    for pole in space.site.poles - space.center[:2]:
        assert np.hypot(*(feet - pole).T).min() < 1e-9
    everywhere, areas, poles, stays = (world_feet[may] for may in space.can_stand(feet))
    assert len(everywhere) == len(feet)
    assert len(areas) > 100
    assert shapely.distance(shapely.points(areas), space.site.free).max() < 2e-3
    assert len(poles) >= len(space.site.poles)
    assert np.hypot(*np.moveaxis(poles[:, None] - space.site.poles, -1, 0)).min(1).max() < 2e-3
    assert len(stays) > 0
    assert np.hypot(*(stays - units[3].base[:2]).T).max() < 2e-3


# ── Violations and messages ─────────────────────────────────────────────────

HEIGHTS = "m above the ground, not 3 to 12 m"
BROKEN = [
    (dict(foot=(14.0, 5.0)), {}, "stands on no mounting area and no pole",
     "'u' moved 2.30 m to the nearest mounting area", (1, 7.3)),
    (dict(z=14.0), {}, HEIGHTS, "'s0' lowered from 14.00 to 12.00 m above the ground", (2, 12.0)),
    (dict(z=2.0), {}, HEIGHTS, "'s0' raised from 2.00 to 3.00 m above the ground", (2, 3.0)),
    (dict(x=3.0), {}, "m from its unit's foot in plan",
     "sensor 's0' moved 1.00 m nearer to its unit's foot", (0, 16.0)),
    (dict(pitch=-1.5), {}, "has a pitch of", "pitch turned from -85.9° to -80.0°",
     (4, np.radians(-80))),
    ({}, dict(yaw={"s0": (1.0, 2.0)}), "has a yaw of", "yaw turned from 28.6° to 57.3°", (5, 1.0)),
]  # fmt: skip


@pytest.mark.parametrize(("change", "options", "wrong", "note", "expected"), BROKEN)
def test_what_is_not_feasible_is_named_moved_and_said(change, options, wrong, note, expected):
    scene = world()
    foot = change.get("foot", SIDEWALK)
    hung = (change.get("x", 0.0), 0.0, change.get("z", 6.0))
    given = two_sensors(scene, foot, hung, pitch=change.get("pitch", -0.3))
    space = Space(scene, given, Constraints(**options))
    (named,) = space.violations(given)
    assert wrong in named
    x, (said,) = space.start(given)
    assert note in said
    after = space.layout(x)
    assert space.violations(after) == []
    axis, value = expected
    assert after.poses[0, axis] == pytest.approx(value, abs=1e-3)
    others = [k for k in range(6) if k != axis]
    np.testing.assert_allclose(after.poses[0, others], given.poses[0, others], atol=1e-3)


@pytest.mark.parametrize(
    ("foot", "apart", "wrong"),
    [
        ((22.0, 9.5), (0.0, 0.0, 0.0), "m from the centre, at most 20 m"),
        (SIDEWALK, (1.3, 0.0, 0.0), "m apart in plan"),
        (SIDEWALK, (0.0, 0.0, 2.3), "m apart in height"),
    ],
)
def test_what_is_too_far_apart_is_named(foot, apart, wrong):
    scene = world()
    given = two_sensors(scene, SIDEWALK, (0, 0, 6), (0, 0, 6))
    units = (replace(given.units[0], base=(*foot, 0.0)),)
    poses = given.poses + np.outer([-1, 1], [*apart, 0, 0, 0])
    named = Space(scene, given).violations(replace(given, poses=poses, units=units))
    assert any(wrong in one for one in named), named


MESSAGES = [
    (dict(places="anyware"), "places 'anyware': one of any, areas, poles, keep; did you mean any"),
    (dict(places={"u": "pole"}), "places 'pole': one of any, areas, poles, keep; did you mean"),
    (dict(places={"v": "poles"}), "places of 'v': no such unit"),
    (dict(heights=(6.0, 3.0)), "heights 6 to 3 m"),
    (dict(heights=(-1.0, 3.0)), "heights -1 to 3 m"),
    (dict(heights=(0.5, 12.0)), "clearance 5 m: must be from 0 to 4.5 m where heights"),
    (dict(clearance=float("nan")), "clearance nan m"),
    (dict(pitch={"kamera": (0.0, 1.0)}), "pitch of kind 'kamera': one of lidar, camera, radar"),
    (dict(pitch={"camera": (1.0, 0.0), "lidar": (0.0, 1.0)}), "pitch of camera 57.2958° to 0°"),
    (dict(pitch={"camera": (0.0, 1.0), "lidar": (0.0, 2.0)}), "pitch of lidar 0° to 114.592°"),
    (dict(pitch={"camera": (-2.0, 0.0), "lidar": (0.0, 1.0)}), "pitch of camera -114.592° to 0°"),
    (dict(yaw={"s0": (0.0, 9.0)}), "yaw of 's0' 0° to 515.662°"),
    (dict(yaw={"s9": (0.0, 1.0)}), "yaw of 's9': no such sensor; did you mean s0"),
    (dict(places="poles"), "'u' has nowhere to stand: no pole off the driving lanes within 20 m of "
     "the centre; use places 'keep'"),
    (dict(area=box(100, 100, 110, 110)), "nowhere to stand"),
    (dict(area=box(0, 0, 0, 0)), "area: not a valid polygon"),
]  # fmt: skip


@pytest.mark.parametrize(("options", "message"), MESSAGES)
def test_each_bad_constraint_gets_its_message(options, message):
    scene = world()
    with pytest.raises(InspeError) as error:
        Space(scene, two_sensors(scene, (15.0, 3.0), (0, 0, 6)), Constraints(**options))
    assert message in str(error.value)


def test_no_mounting_area_says_what_to_do():
    scene = world()
    bare = replace(scene, intersection=replace(scene.intersection, mounting=box(0, 0, 0, 0)))
    given = two_sensors(scene, SIDEWALK, (0, 0, 6))
    with pytest.raises(InspeError, match=r"no mounting area and no pole .* use places 'keep'"):
        Space(bare, given)
    kept = Space(bare, given, Constraints(places="keep"))
    assert kept.start(given)[1] == ()
    assert kept.violations(kept.layout(kept.random(np.random.default_rng(0), 1)[0])) == []
    far = two_sensors(scene, (50.0, 9.5), (0, 0, 6))
    with pytest.raises(InspeError, match=r"'u' stands 50\.9 m from the centre, beyond"):
        Space(bare, far, Constraints(places="keep"))


def test_a_lidar_has_its_own_pitch_and_roll_stays_as_given():
    given = place_sensors((LIDAR, [*SIDEWALK, 5.0, 0.1, -1.0, 0.0]))
    space = Space(world(), given)
    roll, pitch = space.layout(space.start(given)[0]).poses[0, 3:5]
    assert (roll, pitch) == pytest.approx((0.1, np.radians(-30)))


def test_coordinates_that_are_not_feasible_are_refused():
    space = space_of()
    x, _ = space.start(space.given)
    with pytest.raises(InspeError, match=r"coordinate [01] is 0\.000; .*project the coord"):
        space.layout(x * (np.arange(space.size) >= 2))
    for bad in (x[:-1], x * np.nan):
        with pytest.raises(InspeError, match="expected 92 finite numbers"):
            space.layout(bad)
    with pytest.raises(InspeError, match="other sensors or units"):
        space.start(strategy(scene_named("four_way"), "L-d1"))


# ── Random layouts ──────────────────────────────────────────────────────────


TOWN = "a town"
"""It rises, and has no sidewalks."""


@pytest.fixture
def scene(request):
    """A scene by name."""
    if request.param == TOWN and TOWN not in SCENES:
        place = read_map(request.getfixturevalue("maps") / "Town03.xodr", junction=222)
        size = dict(radius=40.0, voxel=2.0, density="none", frames=1)
        SCENES[TOWN] = build_scene(place, **size)
    return scene_named(request.param)


@pytest.mark.parametrize("scene", ["four_way", "roundabout", "highway_ramp", TOWN], indirect=True)
def test_random_layouts_can_be_mounted(scene):
    space, lanes = space_of(scene, "Cam-d1/L-d1"), lanes_of(scene.intersection)
    rows, poses = space.random(np.random.default_rng(0), 80), jax.jit(space.poses)
    for x in rows:
        layout = space.layout(x)
        assert space.violations(layout) == []
        assert_mountable(scene, layout, lanes)
        # The scoring takes the ground between points 1 m apart: within a few centimetres.
        about = layout.poses - np.append(scene.voxels.center, np.zeros(3))
        np.testing.assert_allclose(poses(np.float32(x)), about, atol=0.1)
    assert rows.std(0)[space.free].min() > 0.01


def test_random_units_stand_apart_half_of_them_on_poles_and_half_look_inward():
    space = space_of()
    rows = space.random(np.random.default_rng(1), 300)
    base = np.array([space.split(x).base for x in rows])
    pairs = [base[:, a] - base[:, b] for a, b in combinations(range(base.shape[1]), 2)]
    assert (np.hypot(*np.moveaxis(np.array(pairs), -1, 0)) > 2.5).mean() > 0.999
    poles = space.site.poles - space.center[:2]
    on_pole = (np.hypot(*np.moveaxis(base[:, :, None] - poles, -1, 0)) < 1e-6).any(-1)
    # Four units share four poles: later ones find their draw taken more often.
    assert 0.35 < on_pole.mean() < 0.55
    assert 0.45 < on_pole[:, 0].mean() < 0.55
    poses = np.array([space.layout(x).poses for x in rows])
    inward = np.arctan2(*(space.center[:2] - poses[..., :2]).transpose(2, 0, 1)[::-1])
    off = np.abs((poses[..., 5] - inward + np.pi) % (2 * np.pi) - np.pi)
    # Half within 60°, and a third of the other half by chance; arms shift directions a little.
    assert (off < np.radians(60)).mean() == pytest.approx(2 / 3, abs=0.03)


# ── Starts ──────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("scene", [*BUILT_INS, TOWN], indirect=True)
def test_every_strategy_is_a_feasible_start(scene):
    for name in STRATEGIES:
        given = strategy(scene, name)
        space = Space(scene, given)
        x, notes = space.start(given)
        assert notes == ()
        assert space.violations(given) == []
        again = space.layout(x)
        np.testing.assert_allclose(again.poses, given.poses, atol=1e-6)
        bases = [[unit.base for unit in layout.units] for layout in (given, again)]
        np.testing.assert_allclose(*bases, atol=1e-6)


@pytest.mark.parametrize(
    "hung",
    [
        [(0, 0, 3.0), (0, 0, 7.0)],
        [(0, 0, 12.0), (1.5, 0, 8.0)],
        [(1.9, 0, 5.0)],
        [(1, 1, 4), (-0.7, 0, 7), (1, 1, 5)],
        [(2.0, 0, 4), (0, 0, 4)],
        [(0.7, 0.8, 6.0), (1.6, -0.8, 6.0)],
    ],
)
def test_all_that_the_rules_allow_can_be_reached(hung):
    scene = world(slope=0.05)
    given = two_sensors(scene, SIDEWALK, *hung)
    space = Space(scene, given)
    assert space.violations(given) == []
    x, notes = space.start(given)
    assert notes == ()
    np.testing.assert_allclose(space.layout(x).poses, given.poses, atol=1e-6)


# ── The nearest feasible point ──────────────────────────────────────────────


@pytest.mark.parametrize("built", ["four_way", "roundabout"])
def test_projection_is_feasible_idempotent_and_nearest(built):
    space = space_of(built)
    project = jax.jit(jax.vmap(space.project))
    wild = anywhere(space, 60)
    x = np.asarray(project(np.float32(wild)), float)
    np.testing.assert_allclose(project(np.float32(x)), x, atol=2e-5)
    for row in x:
        assert space.violations(space.layout(row)) == []
    others = space.random(np.random.default_rng(3), 400)
    np.testing.assert_allclose(project(np.float32(others[:60])), others[:60], atol=2e-5)
    for row, start in zip(x, wild, strict=True):
        near = others + 0.0
        # Also feasible points that share all but one kind of coordinate with the nearest.
        near[::2, : 2 * len(space.given.units)] = row[: 2 * len(space.given.units)]
        near[1::2, 2 * len(space.given.units) :] = row[2 * len(space.given.units) :]
        assert np.linalg.norm(row - start) <= np.linalg.norm(near - start, axis=1).min() + 1e-4
    standing = unary_union([space.site.core, MultiPoint(space.site.poles)])
    foot = np.array([space.split(row).base for row in wild]).reshape(-1, 2) + space.center[:2]
    found = np.array([space.split(row).base for row in x]).reshape(-1, 2) + space.center[:2]
    away = shapely.distance(shapely.points(foot), standing)
    # Pieces of less than 0.05 m² are left out: nowhere do they matter by a decimetre here.
    moved = np.hypot(*(found - foot).T)
    assert (moved > away - 1e-4).all()
    assert (moved < away + 0.1).all()


def test_yaw_keeps_its_turns_and_its_sector():
    name = strategy(scene_named("four_way"), "Cam-d1/L-d1").sensors[0].name
    space = space_of(yaw={name: (np.radians(170), np.radians(190))})
    x = space.random(np.random.default_rng(4), 50)
    first = np.cumsum([len(part.ravel()) for part in space.split(x[0])])[4]
    project, from_chart = jax.jit(space.project), jax.jit(space.from_chart)
    for row in x:
        assert space.violations(space.layout(row)) == []
    for turns in (-3, 0, 2):
        # 20° beyond the sector is nearest to its end, however many turns away.
        wild = x[0] + 0.0
        wild[first] = np.radians(210) + 2 * np.pi * turns
        found = np.asarray(project(np.float32(wild)))[first]
        assert found == pytest.approx(np.radians(190) + 2 * np.pi * turns, abs=1e-5)
    wild[first] = np.radians(185) + 4 * np.pi
    v, place = space.chart(wild)
    back = np.asarray(from_chart(np.float32(v), place))[first]
    assert back == pytest.approx(np.radians(185), abs=1e-5)
    v[first] = 99.0
    swung = np.asarray(from_chart(np.float32(v), place), float)[first]
    assert np.radians(170) <= swung <= np.radians(190)


# ── Charts ──────────────────────────────────────────────────────────────────


def test_a_pole_in_an_area_is_charted_there_and_one_apart_is_not():
    scene = world()
    poles = np.array([[14.0, 9.5, 0.0], [13.5, 13.5, 0.0]])  # on the sidewalk; behind it
    scene = replace(scene, intersection=replace(scene.intersection, poles=poles))
    for pole, area, off in (poles[0], True, 0.2), (poles[1], False, 1e-6):
        given = two_sensors(scene, tuple(pole[:2]), (0, 0, 6))
        space = Space(scene, given)
        x, notes = space.start(given)
        assert notes == ()
        v, place = space.chart(x)
        assert (space._pieces.area[place[0]] > 0) == area
        back = space.split(space.from_chart(v, place, np))
        assert np.hypot(*(back.base[0] - pole[:2])) <= off


def test_any_chart_coordinates_are_feasible():
    space = space_of("roundabout")
    rng = np.random.default_rng(6)
    poles = np.flatnonzero(space._pole)
    back = jax.jit(space.from_chart)
    for x, size in zip(space.random(rng, 40), np.resize([0.0, 1.0, 100.0, 1e30], 40), strict=True):
        place = space.chart(x)[1]
        place[0] = rng.choice(poles)  # tied to a pole
        v = np.clip(size * rng.normal(size=space.size), -3e38, 3e38).astype(np.float32)
        v[-len(x) // 2 :] = v[-len(x) // 2 :].clip(-1e6, 1e6)
        y = np.asarray(back(v, place), float)
        assert space.violations(space.layout(y)) == []
        np.testing.assert_allclose(space.split(y).base[0], space._pieces.corners[place[0], 0])


def test_gradients_are_finite_everywhere():
    """And a step of the chart is a step of the coordinates."""
    space = space_of(layout="Cam-d1/L-d1")
    given, _ = space.start(space.given)  # on poles, sensors at the clearance
    pieces = space._pieces
    on_corner = given + 0.0
    on_corner[:8] = np.tile(pieces.corners[0, 0], 4)
    project = jax.jit(jax.jacobian(space.project))
    poses = jax.jit(jax.jacobian(space.poses))
    chart = jax.jit(jax.jacobian(space.from_chart))
    whole = jax.jit(jax.jacobian(lambda v, place: space.poses(space.from_chart(v, place))))
    for x in (given, on_corner, given * 1e3, given * 0):
        assert np.isfinite(project(np.float32(x))).all()
        assert np.isfinite(poses(np.float32(x))).all()
        v, place = space.chart(x)
        v = np.float32(v)
        assert np.isfinite(whole(v, place)).all()
        # Even at the bounds, and beyond, where a chart begins it moves: each coordinate of a
        # sensor or a mast by a tenth of a step of the chart or more.
        slope = np.linalg.norm(np.asarray(chart(v, place)), axis=0)
        feet = np.arange(space.size) < 2 * len(place)
        assert slope[feet][np.repeat(pieces.area[place] > 0, 2)].min() > 1e-3
        assert slope[np.setdiff1d(space.free, np.flatnonzero(feet))].min() > 0.1
    tied, middle = np.full(4, np.flatnonzero(space._pole)[0]), np.zeros(space.size, np.float32)
    slope = np.asarray(chart(middle, tied))
    assert np.isfinite(slope).all()
    assert (slope[:, :8] == 0).all()  # a pole does not move
    sizes = np.linalg.norm(np.asarray(chart(middle, place)), axis=0)
    np.testing.assert_allclose(sizes[np.setdiff1d(space.free, np.arange(8))], 1, atol=1e-5)
    np.testing.assert_allclose(sizes[space.scale == 0], 0, atol=1e-5)


# ── Bodies ──────────────────────────────────────────────────────────────────


@pytest.fixture(scope="module")
def planted():
    """A tree where a pole of the nine placements stands, a car on another's, a house on the side
    of a third."""
    bare = scene_named("four_way")
    site = Site(bare.intersection, 30.0, 30.0)
    a, b, c = site.corners[:3]
    return bare.with_statics(
        [
            tree(a, radius=1.8, height=7, base=2.5),
            upright_box("parked vehicle", b, (4.6, 1.8, 1.5), 0.7),
            upright_box("building", c + 3.0 * (c - site.center) / 20, (6, 6, 9), 0.2),
        ]
    )


def test_poles_of_placements_and_of_random_layouts_stand_clear(planted):
    before, after = (strategy(of, "Cam-d1/L-d1") for of in (planted.with_statics([]), planted))
    feet = np.array([unit.base[:2] for unit in after.units])
    moved = np.hypot(*(feet - [unit.base[:2] for unit in before.units]).T)
    assert (moved > 0.5).sum() >= 3
    for foot in feet:
        assert planted.statics[0].polygon.distance(Point(foot)) > UNIT_PLAN - 1e-6
        assert planted.statics[1].polygon.distance(Point(foot)) > 0
    for pose in after.poses:
        assert body_at(planted.statics, planted.intersection, np.asarray(pose)[:3]) is None
    space = Space(planted, after)
    assert not space.faults(after)
    for found in map(space.layout, space.random(np.random.default_rng(3), 40)):
        assert not space.faults(found)
        for pose in found.poses:
            assert body_at(planted.statics, planted.intersection, np.asarray(pose)[:3]) is None


def test_what_stands_in_a_body_is_named(planted):
    crown, car, _ = planted.statics
    space = Space(planted, strategy(planted, "L-c"))
    high = place_sensors((LIDAR, [*crown.middle, 6.0, 0.0, 0.0, 0.0]))
    low = place_sensors((LIDAR, [*car.middle, 6.0, 0.0, 0.0, 0.0]))
    for layout, words in (
        (high, f"is within 2 m of a body, the {crown.words}"),
        (high, f"sensor 's0' is inside a body, the {crown.words}"),
        (low, f"is inside a body, the {car.words}"),
    ):
        own = Space(planted, layout, Constraints(places="any"))
        assert any(words in wrong for wrong in own.violations(layout)), own.violations(layout)
    assert not any("inside a body" in wrong for wrong in space.violations(strategy(planted, "L-c")))
