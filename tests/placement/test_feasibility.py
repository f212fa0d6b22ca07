"""The rules of mounting one by one, and what is said where one is broken."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from mounts import (
    SIDEWALK,
    lanes_of,
    scene_named,
    space_of,
    two_sensors,
)
from shapely.geometry import Point, box
from worlds import CAMERA, LIDAR, world

from inspe_jax.core.errors import InspeError
from inspe_jax.mounting.strategies import strategy
from inspe_jax.placement.constraints import Constraints
from inspe_jax.placement.space import Space
from inspe_jax.sensing.layout import Sensor, Unit, make_layout

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
        z = poses(jnp.asarray(x, float))[:, 2]
        np.testing.assert_allclose(z, layout.poses[:, 2] - space.center[2], atol=1e-5)
    assert raised > 10


def test_places_by_unit():
    """One stays where it is, one is tied to the poles, one free in the areas, one chooses.

    For all units alike, the places are those of one unit.
    """
    for places, may in dict(any=True, areas=True, poles=True, keep=False).items():
        space = space_of(places=places)
        assert (space.scale[: 2 * len(space.given.units)] > 0).tolist() == [may] * 8
        alone = space_of(places={unit.name: places for unit in space.given.units})
        np.testing.assert_array_equal(space._allowed, alone._allowed)
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


def test_what_a_unit_of_one_sensor_cannot_change_has_no_scale():
    space = space_of(layout="L-d2")
    assert space.size == 5 * 2 + 5 * 2
    frozen = [name for name, at in space.index._asdict().items() if not space.scale[at].any()]
    assert frozen == ["offset", "rise"]
    np.testing.assert_array_equal(space.index.flat(), np.arange(space.size))


# ── Violations and messages ─────────────────────────────────────────────────

BROKEN = {
    "stands on no mounting area and no pole": lambda p, u: (p, [(0.0, 5.0, u[0][2])]),
    "m from the centre, at most 20 m": lambda p, u: (p, [(22.0, 9.5, u[0][2])]),
    "m from its unit's foot in plan": lambda p, u: (p + [2.5, 0, 0, 0, 0, 0], u),
    "m above the ground, not 3 to 12 m": lambda p, u: (p + [0, 0, 9, 0, 0, 0], u),
    "has a pitch of": lambda p, u: (p + [0, 0, 0, 0, 1, 0], u),
    "has a yaw of": lambda p, u: (p + [0, 0, 0, 0, 0, 2], u),
    "m apart in plan": lambda p, u: (p + np.array([[-1.3], [1.3]]) * [1, 0, 0, 0, 0, 0], u),
    "m apart in height": lambda p, u: (p + np.array([[-2.3], [2.3]]) * [0, 0, 1, 0, 0, 0], u),
}


@pytest.mark.parametrize("message", BROKEN)
def test_each_violation_is_named(message):
    scene = world()
    given = two_sensors(scene, (15.0, 9.5), (0, 0, 6), (0, 0, 6))
    options = dict(yaw={"s0": (0.0, 1.0), "s1": (0.0, 1.0)})
    space = Space(scene, given, Constraints(**options))
    assert space.violations(given) == []
    poses, bases = BROKEN[message](given.poses, [unit.base for unit in given.units])
    units = tuple(replace(u, base=b) for u, b in zip(given.units, bases, strict=True))
    broken = space.violations(replace(given, poses=poses, units=units))
    assert any(message in found for found in broken), broken


MESSAGES = [
    (dict(places="anyware"), "places 'anyware': one of any, areas, poles, keep; did you mean any"),
    (dict(places={"u": "pole"}), "places 'pole': one of any, areas, poles, keep; did you mean"),
    (dict(places={"v": "poles"}), "places of 'v': no such unit"),
    (dict(heights=(6.0, 3.0)), "heights 6 to 3 m"),
    (dict(heights=(-1.0, 3.0)), "heights -1 to 3 m"),
    (dict(heights=(0.5, 12.0)), "clearance 5 m: must be from 0 to 4.5 m where heights"),
    (dict(clearance=float("nan")), "clearance nan m"),
    (dict(pitch={"camera": (0.0, 1.0)}), "pitch: give limits for camera and lidar"),
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


def test_coordinates_that_are_not_feasible_are_refused():
    space = space_of()
    x, _ = space.start(space.given)
    with pytest.raises(InspeError, match=r"coordinate [01] is 0\.000; .*project the coord"):
        space.layout(x * (np.arange(space.size) >= 2))
    for bad in (x[:-1], x * np.nan):
        with pytest.raises(InspeError, match="expected 80 finite numbers"):
            space.layout(bad)
    with pytest.raises(InspeError, match="other sensors or units"):
        space.start(strategy(scene_named("four_way"), "L-d1"))


def test_lidars_have_their_own_pitch():
    scene = world()
    layout = make_layout(
        [Sensor("l", LIDAR, 0), Sensor("c", CAMERA, 0)],
        [Unit("u", (*SIDEWALK, 0.0))],
        np.array([[*SIDEWALK, 5.0, 0.1, -1.0, 0.0], [*SIDEWALK, 5.0, 0.2, -1.0, 0.0]]),
    )
    after = Space(scene, layout).layout(Space(scene, layout).start(layout)[0])
    np.testing.assert_allclose(after.poses[:, 4], [np.radians(-30), -1.0])
    np.testing.assert_allclose(after.poses[:, 3], [0.1, 0.2])  # roll stays as given
