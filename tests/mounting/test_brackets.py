"""Units on poles that stand in the scene: sensors hang beside them, and see past them or not."""

import jax
import numpy as np
import pytest
import shapely
from mounts import assert_mountable, lanes_of

from inspe_jax.mounting.brackets import STANDOFF
from inspe_jax.mounting.site import Site
from inspe_jax.mounting.strategies import strategy
from inspe_jax.placement.constraints import Constraints
from inspe_jax.placement.space import Space
from inspe_jax.scene.placed_bodies import body_at
from inspe_jax.scene.procedural.built_ins import built_in
from inspe_jax.scene.scene import build_scene
from inspe_jax.scene.statics import pole, upright_box
from inspe_jax.visibility.queries import line_of_sight

RADIUS = 0.1
"""Of the poles [m]."""


@pytest.fixture(scope="module")
def scene():
    """The four-way, whose signal poles stand in it as bodies."""
    place = built_in("four_way")
    built = build_scene(place, profile="ideal", radius=40.0, voxel=1.0, density="none", frames=1)
    return built.with_statics([pole(p[:2], radius=RADIUS, height=9.0) for p in place.poles])


@pytest.fixture(scope="module")
def layout(scene):
    return strategy(scene, "Cam-d1/L-d1")


def nearest_pole(scene, points):
    """The axis of the pole nearest to each point (x, y), and how far away it is [m]."""
    poles = np.asarray(scene.intersection.poles)[:, :2]
    away = np.hypot(*(np.asarray(points)[:, None, :2] - poles).transpose(2, 0, 1))
    return poles[away.argmin(1)], away.min(1)


def test_strategies_hang_sensors_beside_poles(scene, layout):
    feet = np.array([unit.base[:2] for unit in layout.units])
    assert nearest_pole(scene, feet)[1].max() < 1e-9
    bare = strategy(scene.with_statics([]), "Cam-d1/L-d1")
    assert np.allclose(feet, [unit.base[:2] for unit in bare.units])  # the same poles
    lidars = np.array([sensor.spec.kind == "lidar" for sensor in layout.sensors])
    away = nearest_pole(scene, layout.poses)[1]
    assert away[lidars] == pytest.approx(RADIUS + STANDOFF, abs=0.01)  # of an octagon
    assert away.min() > RADIUS + STANDOFF - 1e-9
    for name in ("Cam-d1", "Cam-d2", "L-d1", "Cam-d1/L-d1", "Cam-d2/L-d2"):
        placed = strategy(scene, name)
        space = Space(scene, placed)
        assert not space.faults(placed)
        assert space.start(placed)[1] == ()


def test_a_pole_hides_its_own_wedge(scene, layout):
    """Directions from 0.4 m away that meet a pole of 0.2 m: 29°, as for a disc."""
    s = next(k for k, sensor in enumerate(layout.sensors) if sensor.spec.kind == "lidar")
    at, columns = np.asarray(layout.poses)[s, :2], scene.voxels.columns
    bare, seen = (
        np.asarray(line_of_sight(world, layout, 0))[s].reshape(len(columns), -1)
        for world in (scene.with_statics([]), scene)
    )
    far = np.hypot(*(columns - at).T) > 5
    hidden = (bare & ~seen).any(-1) & far
    (own,), (away,) = nearest_pole(scene, at[None])
    toward, ways = (np.arctan2(*(to - at).T[::-1]) for to in (own, columns))
    off = (ways - toward + np.pi) % (2 * np.pi) - np.pi
    half = np.arcsin(RADIUS / away)
    assert np.degrees(2 * half) == pytest.approx(29, abs=1.5)
    # The octagon's corners are 3 % farther out than the disc's rim, the middles of its sides 5 %
    # nearer.
    assert hidden[(np.abs(off) < 0.93 * half) & far & bare.any(-1)].all()
    others = [p for p in np.asarray(scene.intersection.poles)[:, :2] if (p != own).any()]
    for column in columns[hidden & (np.abs(off) > 1.05 * half)]:
        line = shapely.LineString([at, column])
        assert min(line.distance(shapely.Point(p)) for p in others) < 1.05 * RADIUS


def test_what_a_search_may_do_on_poles_can_be_mounted(scene, layout):
    """Also on opposite sides of their pole, as far out as coordinates reach, along any line."""
    space = Space(scene, layout, Constraints(places="poles"))
    rng, lanes = np.random.default_rng(3), lanes_of(scene.intersection)
    for x in space.random(rng, 30):
        c, way = space.split(x), rng.uniform(-np.pi, np.pi)
        line = np.array([np.cos(way), np.sin(way)])
        yaw = way + np.resize([0.0, np.pi], c.yaw.shape)
        along = rng.choice([0.0, 0.3, 0.8, 9.0], len(c.offset))[:, None]
        sides = np.resize([[1.0], [-1.0]], along.shape)
        wide = c._replace(
            arm=rng.choice([0.0, 0.3, 9.0]) * np.tile(line, (len(c.arm), 1)),
            offset=along * sides * line,
            yaw=yaw,
        )
        for one in (x, space.project(wide.flat(), np)):
            placed = space.layout(one)
            assert not space.faults(placed)
            assert_mountable(scene, placed, lanes)
            assert nearest_pole(scene, placed.poses)[1].min() > RADIUS + STANDOFF - 1e-6
            for pose in np.asarray(placed.poses):
                assert body_at(scene.statics, scene.intersection, pose[:3]) is None
            again = space.layout(space.start(placed)[0])
            assert np.abs(np.asarray(again.poses) - np.asarray(placed.poses)).max() < 1e-6


@pytest.mark.parametrize("out", [0.0, 0.05, 0.399, 0.4, 0.4005, 0.45, 0.79, 0.81, 1.4])
def test_a_given_sensor_stays_where_it_may(scene, layout, out):
    """On any side of its pole; one that is too near moves out as far as it must, the same way."""
    space = Space(scene, layout, Constraints(places="poles"))
    feet = np.array([unit.base[:2] for unit in layout.units])
    length = space._brackets.length[0]
    for way in np.radians([10.0, 130.0, 250.0]):
        poses = np.array(layout.poses)
        units = np.array([sensor.unit for sensor in layout.sensors])
        toward = np.array([np.cos(way), np.sin(way)])
        poses[:, :2] = feet[units] + out / 0.4 * length * toward
        x, notes = space.start(layout.with_poses(poses))
        assert out >= 0.39 or any("to hang beside its pole" in note for note in notes)
        placed = space.layout(x)
        assert not space.faults(placed)
        moved = np.asarray(placed.poses)[:, :2] - feet[units]
        if out > 0:
            wanted = max(out / 0.4, 1.0) * length
            assert np.abs(moved @ toward - wanted).max() < 2e-3
            assert np.abs(moved @ [-toward[1], toward[0]]).max() < 2e-3


def test_a_camera_s_bracket_turns_with_it(scene, layout):
    """With offsets of 0 the pole is behind the camera, and poses have slopes there."""
    space = Space(scene, layout, Constraints(places="poles"))
    with jax.enable_x64(True):
        c = space.split(space.start(layout)[0])
        x = c._replace(arm=0 * c.arm, offset=0 * c.offset).flat()
        slopes = np.asarray(jax.jit(jax.jacobian(space.poses))(x))
        assert np.isfinite(slopes).all()
        placed = jax.jit(space.poses)
        poses = np.asarray(placed(x))
        step = 1e-6
        index = space.index
        for k in np.intersect1d(space.free, [*index.yaw, *index.height, *index.pitch]):
            ahead = np.asarray(placed(x + step * np.eye(len(x))[k]))
            assert np.allclose((ahead - poses) / step, slopes[..., k], atol=1e-4)
    cameras = np.array([sensor.spec.kind == "camera" for sensor in layout.sensors])
    feet, away = nearest_pole(scene, poses[:, :2] + space.center[:2])
    out = (poses[:, :2] + space.center[:2] - feet) / away[:, None]
    looks = np.column_stack([np.cos(poses[:, 5]), np.sin(poses[:, 5])])
    assert (out * looks).sum(1)[cameras] == pytest.approx(1, abs=1e-9)


def test_other_bodies_still_keep_units_away(scene):
    place = scene.intersection
    beside = place.poles[0, :2]
    shed = upright_box("furniture", beside + [1.0, 0.0], (0.6, 0.6, 4.0))
    site = Site(place, 40.0, 30.0, bodies=(*scene.statics, shed))
    assert len(site.carriers) == len(place.poles)
    assert not (np.hypot(*(site.poles - beside).T) < 1e-9).any()
    assert len(site.poles) == len(Site(place, 40.0, 30.0, bodies=scene.statics).poles) - 1
