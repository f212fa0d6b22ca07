"""The feasible set in its forms: against shapely and the raw map, and its charts and gradients."""

from dataclasses import replace
from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from mounts import (
    SIDEWALK,
    anywhere,
    assert_mountable,
    lanes_of,
    scene_named,
    space_of,
    two_sensors,
)
from shapely.geometry import MultiPoint
from shapely.ops import unary_union
from worlds import double_precision, world

from inspe_jax.mounting.strategies import STRATEGIES, strategy
from inspe_jax.placement.constraints import Constraints
from inspe_jax.placement.space import Space
from inspe_jax.scene.procedural.built_ins import BUILT_INS
from inspe_jax.scene.scene import build_scene

# ── Random layouts ──────────────────────────────────────────────────────────


@pytest.mark.parametrize("name", ["four_way", "roundabout", "highway_ramp"])
def test_random_layouts_can_be_mounted(name):
    scene = scene_named(name)
    space, lanes = space_of(name), lanes_of(scene.intersection)
    rows = space.random(np.random.default_rng(0), 80)
    for x in rows:
        layout = space.layout(x)
        assert space.violations(layout) == []
        assert_mountable(scene, layout, lanes)
    found = jax.jit(space.project)(jnp.asarray(rows[0], float))
    np.testing.assert_allclose(found, rows[0], atol=1e-5)
    assert rows.std(0)[space.free].min() > 0.01


def test_random_layouts_of_a_town_can_be_mounted(maps):
    from inspe_jax.scene.maps.registry import read_map

    place = read_map(maps / "Town03.xodr", junction=222)  # it rises, and has no sidewalks
    scene = build_scene(place, radius=40.0, voxel=2.0, density="none", frames=1)
    lanes = lanes_of(place)
    for name in STRATEGIES:
        given = strategy(scene, name)
        space = Space(scene, given)
        x, notes = space.start(given)
        assert not notes
        assert space.violations(given) == []
        np.testing.assert_allclose(space.layout(x).poses, given.poses, atol=1e-6)
    poses = jax.jit(space.poses)
    for x in space.random(np.random.default_rng(0), 80):
        layout = space.layout(x)
        assert space.violations(layout) == []
        assert_mountable(scene, layout, lanes)
        # The scoring takes the ground between points 1 m apart: within a few centimetres.
        about = layout.poses - np.append(scene.voxels.center, np.zeros(3))
        np.testing.assert_allclose(poses(jnp.asarray(x, float)), about, atol=0.1)


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


@pytest.mark.parametrize("built", BUILT_INS)
def test_every_strategy_is_a_feasible_start(built):
    scene = scene_named(built)
    lanes = lanes_of(scene.intersection)
    for name in STRATEGIES:
        given = strategy(scene, name)
        space = Space(scene, given)
        x, notes = space.start(given)
        assert notes == ()
        assert space.violations(given) == []
        assert_mountable(scene, given, lanes, central="-c" in name)
        again = space.layout(x)
        np.testing.assert_allclose(again.poses, given.poses, atol=1e-6)
        bases = [[unit.base for unit in layout.units] for layout in (given, again)]
        np.testing.assert_allclose(*bases, atol=1e-6)
    about = given.poses - np.append(space.center, np.zeros(3))
    np.testing.assert_allclose(jax.jit(space.poses)(jnp.asarray(x, float)), about, atol=1e-4)


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


@pytest.mark.parametrize(
    ("change", "options", "note", "expected"),
    [
        (dict(foot=(14.0, 5.0)), {}, "'u' moved 2.30 m to the nearest mounting area", (1, 7.3)),
        (dict(z=14.0), {}, "sensor 's0' lowered from 14.00 to 12.00 m above the ground", (2, 12.0)),
        (dict(z=2.0), {}, "sensor 's0' raised from 2.00 to 3.00 m above the ground", (2, 3.0)),
        (dict(x=3.0), {}, "sensor 's0' moved 1.00 m nearer to its unit's foot", (0, 16.0)),
        (dict(pitch=-1.5), {}, "pitch turned from -85.9° to -80.0°", (4, np.radians(-80))),
        ({}, dict(yaw={"s0": (1.0, 2.0)}), "yaw turned from 28.6° to 57.3°", (5, 1.0)),
    ],
)
def test_what_is_not_feasible_is_moved_and_said(change, options, note, expected):
    scene = world()
    foot = change.get("foot", SIDEWALK)
    hung = (change.get("x", 0.0), 0.0, change.get("z", 6.0))
    given = two_sensors(scene, foot, hung, pitch=change.get("pitch", -0.3))
    space = Space(scene, given, Constraints(**options))
    assert len(space.violations(given)) == 1
    x, (said,) = space.start(given)
    assert note in said
    after = space.layout(x)
    assert space.violations(after) == []
    axis, value = expected
    assert after.poses[0, axis] == pytest.approx(value, abs=1e-3)
    others = [k for k in range(6) if k != axis]
    np.testing.assert_allclose(after.poses[0, others], given.poses[0, others], atol=1e-3)


# ── The nearest feasible point ──────────────────────────────────────────────


@pytest.mark.parametrize("built", ["four_way", "roundabout"])
def test_projection_is_feasible_idempotent_and_nearest(built):
    space = space_of(built)
    project = jax.jit(jax.vmap(space.project))
    wild = anywhere(space, 60)
    x = np.asarray(project(jnp.asarray(wild, float)), float)
    np.testing.assert_allclose(project(jnp.asarray(x, float)), x, atol=2e-5)
    for row in x:
        assert space.violations(space.layout(row)) == []
    others = space.random(np.random.default_rng(3), 400)
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
        found = np.asarray(project(jnp.asarray(wild, float)))[first]
        assert found == pytest.approx(np.radians(190) + 2 * np.pi * turns, abs=1e-5)
    wild[first] = np.radians(185) + 4 * np.pi
    v, place = space.chart(wild)
    back = float(np.asarray(from_chart(jnp.asarray(v, float), place))[first])
    assert back == pytest.approx(np.radians(185), abs=1e-5)
    v[first] = 99.0
    swung = np.asarray(from_chart(jnp.asarray(v, float), place))[first]
    assert np.radians(170) <= float(swung) <= np.radians(190)


# ── Charts ──────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("built", ["five_way", "highway_ramp"])
def test_charts_invert_but_for_the_bounds(built):
    space = space_of(built)
    back = jax.jit(space.from_chart)
    for x in space.random(np.random.default_rng(5), 60):
        v, place = space.chart(x)
        y = np.asarray(back(jnp.asarray(v, float), place))
        off = np.abs(y - x)
        far = [np.ptp(space._pieces.corners[k], axis=0).max() for k in place]
        feet = off[: 2 * len(place)].reshape(-1, 2).max(1)
        # A foot on a pole may be charted on an area half a metre away.
        assert (feet <= 0.02 * np.array(far) + 0.55).all()
        assert off[2 * len(place) :].max() < 0.05
        w, again = space.chart(y)
        np.testing.assert_array_equal(again, place)
        np.testing.assert_allclose(back(jnp.asarray(w, float), place), y, atol=2e-3)


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


def test_a_step_of_the_chart_is_a_step_of_the_coordinates():
    space = space_of()
    x = space.random(np.random.default_rng(7), 1)[0]
    _, place = space.chart(x)
    slope = jax.jit(jax.jacobian(space.from_chart))(jnp.zeros(space.size), place)
    sizes = np.linalg.norm(np.asarray(slope), axis=0)
    wide = np.repeat(space._pieces.area[place] > 0, 2)
    assert (sizes[: 2 * len(place)][~wide] == 0).all()
    rest = np.setdiff1d(space.free, np.arange(2 * len(place)))
    np.testing.assert_allclose(sizes[rest], 1, atol=1e-5)
    frozen = np.flatnonzero(space.scale == 0)
    np.testing.assert_allclose(sizes[frozen], 0, atol=1e-5)


def test_gradients_are_finite_everywhere():
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
        flat = jnp.asarray(x, float)
        assert np.isfinite(project(flat)).all()
        assert np.isfinite(poses(flat)).all()
        v, place = space.chart(x)
        v = jnp.asarray(v, float)
        assert np.isfinite(whole(v, place)).all()
        # Even at the bounds, and beyond, where a chart begins it moves: each coordinate of a
        # sensor or a mast by a tenth of a step of the chart or more.
        slope = np.linalg.norm(np.asarray(chart(v, place)), axis=0)
        feet = np.arange(space.size) < 2 * len(place)
        assert slope[feet][np.repeat(pieces.area[place] > 0, 2)].min() > 1e-3
        assert slope[np.setdiff1d(space.free, np.flatnonzero(feet))].min() > 0.1
    tied = np.full(4, np.flatnonzero(space._pole)[0])
    slope = np.asarray(chart(jnp.zeros(space.size), tied))
    assert np.isfinite(slope).all()
    assert (slope[:, :8] == 0).all()  # a pole does not move


def test_all_forms_are_of_the_precision_that_is_set():
    space = space_of("five_way")
    x = space.random(np.random.default_rng(8), 1)[0]
    with double_precision():
        row, place = jnp.asarray(x), np.zeros(5, int)
        for form in (space.poses, space.project, lambda row: space.from_chart(row, place)):
            assert jax.eval_shape(form, row).dtype == jnp.float64
        about = space.layout(x).poses - np.append(space.center, np.zeros(3))
        made = np.asarray(jax.jit(space.poses)(row))
        np.testing.assert_allclose(made[:, :5], about[:, :5], atol=1e-9)  # the ground is level
