"""The nine placements, on the built-in intersections, turned and on a slope, and on a real map."""

from dataclasses import replace
from functools import cache
from itertools import combinations

import numpy as np
import pytest
from mounts import assert_mountable, lanes_of
from shapely import affinity
from shapely.geometry import LineString, Point, Polygon
from shapely.ops import unary_union
from worlds import MAPS

from inspe_jax.core.errors import InspeError
from inspe_jax.mounting.strategies import STRATEGIES, spread, strategy
from inspe_jax.scene.intersection import Arm, Intersection, mouth_crosswalks
from inspe_jax.scene.maps.registry import read_map
from inspe_jax.scene.procedural.built_ins import BUILT_INS, built_in, crossing
from inspe_jax.scene.scene import Scene, build_scene
from inspe_jax.sensing.catalogue import device

SHIFT = np.array([100.0, -50.0, 7.0])


def bare(name: str, **changes) -> Intersection:
    """A built-in without its poles."""
    return replace(built_in(name), poles=np.zeros((0, 3)), **changes)


def moved(place: Intersection, degrees: float) -> Intersection:
    """The whole world turned about the origin and shifted."""
    angle = np.radians(degrees)
    c, s = np.cos(angle), np.sin(angle)

    def points(p):
        x, y, *z = np.moveaxis(np.array(p, float), -1, 0)
        return np.stack([c * x - s * y, s * x + c * y, *z], -1) + SHIFT[: 2 + len(z)]

    def shape(geometry):
        turned = affinity.rotate(geometry, degrees, origin=(0, 0))
        return affinity.translate(turned, *SHIFT[:2])

    return replace(
        place,
        center=points(place.center),
        regions={label: shape(region) for label, region in place.regions.items()},
        arms=tuple(Arm(tuple(points(a.mouth)), a.bearing + angle, a.width) for a in place.arms),
        routes=tuple(replace(r, waypoints=points(r.waypoints)) for r in place.routes),
        mounting=shape(place.mounting),
        poles=points(place.poles),
        ground_points=points(place.ground_points),
    )


def sloped(place: Intersection) -> Intersection:
    """A place on a slope of 2 % to the east."""
    xy = np.random.default_rng(3).uniform(-90, 90, (400, 2))
    return place.standing_on(np.column_stack([xy, 0.02 * xy[:, 0]]))


def scene_of(place: Intersection, radius: float = 50.0) -> Scene:
    return build_scene(place, profile="ideal", radius=radius, voxel=2.0, density="none", frames=1)


def all_ground() -> Intersection:
    """A map may call all ground mountable, and its lanes may be wider than its kerbs are apart."""
    place = bare("four_way", mounting=Point(0, 0).buffer(60.0))
    return replace(place, routes=tuple(replace(route, width=12.0) for route in place.routes))


PLACES = {
    "sloped": lambda: moved(sloped(bare("four_way")), 37.0),
    "bend": lambda: bare("t_junction", arms=built_in("t_junction").arms[:2]),
    "narrow": lambda: bare("four_way"),
    "all ground": all_ground,
    "small": lambda: crossing("small", (0, 90, 180, 270), (1, 1, 1, 1), 6.0),
    "town": lambda: read_map(MAPS / "Town05.xodr", junction=53),
}


@cache
def scene_named(name: str) -> Scene:
    place = PLACES[name]() if name in PLACES else built_in(name)
    return scene_of(place, radius=18.0 if name == "narrow" else 50.0)


EVERYWHERE = [*BUILT_INS, "sloped", "bend"]
SIX = ("bend", "t_junction", "triangle", "highway_ramp", "small")
"""Where there are six cameras; elsewhere eight."""
LIDARS = {"L-c": 1, "L-d1": 4, "L-d2": 2}


@pytest.mark.parametrize("where", [*EVERYWHERE, "small", "narrow", "all ground", "town"])
def test_counts_are_the_papers_and_every_unit_can_stand_and_carry_its_sensors(where, request):
    """By the raw map, also within 18 m; lorries pass beneath what hangs over them."""
    if where == "town":
        request.getfixturevalue("maps")
    scene = scene_named(where)
    lanes = lanes_of(scene.intersection)
    for name in STRATEGIES:
        layout = strategy(scene, name)
        kinds = [sensor.spec.kind for sensor in layout.sensors]
        cameras = (6 if where in SIX else 8) if name.startswith("Cam") else 0
        lidars = LIDARS.get(name.rpartition("/")[2], 0)
        assert (kinds.count("camera"), kinds.count("lidar")) == (cameras, lidars)
        assert_mountable(scene, layout, lanes, central="-c" in name)
        poses, bases = np.asarray(layout.poses), np.array([unit.base for unit in layout.units])
        assert {s.unit for s in layout.sensors} == set(range(len(layout.units)))
        assert len({unit.name for unit in layout.units}) == len(layout.units)
        assert (np.hypot(*(poses[:, :2] - scene.voxels.center[:2]).T) <= scene.voxels.radius).all()
        if where == "highway_ramp":  # mouths 40 to 75 m away are drawn in to 25 m
            assert np.hypot(*(bases - scene.voxels.center)[:, :2].T).max() < 40.0
        above = poses[:, 2] - bases[[sensor.unit for sensor in layout.sensors], 2]
        low, high = (6.0, 8.0) if "-c" in name else (4.0, 6.0)
        assert ((above >= low - 1e-9) & (above <= high + 1e-9)).all()
        for a, b in combinations(bases, 2):
            assert np.hypot(*(a - b)[:2]) > 2.0


def test_standing_poles_near_a_corner_are_used():
    """A signal pole 3 m from the corner carries the cameras; one in a lane or far off does not."""
    stands, in_lane, far = (14.0, 11.0, 0.0), (-12.0, 3.5, 0.0), (12.0, -40.0, 0.0)
    place = replace(built_in("four_way"), poles=np.array([stands, in_lane, far]))
    feet = np.array([unit.base for unit in strategy(scene_of(place), "Cam-d1").units])
    away = [np.hypot(*(feet - pole)[:, :2].T).min() for pole in (stands, in_lane, far)]
    assert away[0] < 1e-6
    assert min(away[1:]) > 1.0


@pytest.mark.parametrize(("where", "name", "expected"), [
    # Between kerb points (15, 7) and (7, 15) the chord's middle is on the sidewalk.
    ("four_way", "L-d1", [[11, 11], [-11, 11], [-11, -11], [11, -11]]),
    # 8 m outside the mouths at ±15, on the right looking outward, 0.3 m beyond the kerb at 7.
    ("four_way", "Cam-d2", [[23, -7.3], [7.3, 23], [-23, 7.3], [-7.3, -23]]),
    # On a tee's far side each kerb has a corner of its own, 0.3 m off its crosswalk at 11.5 m.
    ("t_junction", "L-d1", [[11.2, 7.3], [-11.2, 7.3], [-7.5, -11], [7.5, -11]]),
])  # fmt: skip
def test_feet_by_hand(where, name, expected):
    got = np.array([unit.base[:2] for unit in strategy(scene_of(bare(where)), name).units])
    order = [np.hypot(*(got - foot).T).argmin() for foot in expected]
    assert len(got) == 4
    np.testing.assert_allclose(got[order], expected, atol=1e-6)


@pytest.mark.parametrize("where", EVERYWHERE)
def test_corner_cameras_look_along_the_arms(where):
    """Every yaw of Cam-d1 is some arm's bearing or its opposite, and every arm is watched.

    A roundabout's corners lie far beside the arms: from there half look across at the arm.
    """
    scene = scene_named(where)
    yaws = np.asarray(strategy(scene, "Cam-d1").poses)[:, 5]
    bearings = np.array([arm.bearing for arm in scene.intersection.arms])
    along = np.cos(yaws[:, None] - bearings)
    if where == "roundabout":
        np.testing.assert_allclose(along[1::2].min(1), -1.0, atol=1e-9)
        assert (along[::2].diagonal() > np.cos(np.radians(50.0))).all()
        return
    np.testing.assert_allclose(np.abs(along).max(1), 1.0, atol=1e-9)
    np.testing.assert_allclose(along.max(0), 1.0, atol=1e-9)


def axis_on_the_ground(scene: Scene, pose: np.ndarray) -> np.ndarray:
    """Where a camera's optical axis meets the ground, by walking down it."""
    x, y, z, _, pitch, yaw = pose
    t = np.arange(0.0, 80.0, 0.02)[:, None]
    ray = np.array([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)])
    line = np.array([x, y, z]) + t * ray
    below = line[:, 2] < scene.intersection.ground(line[:, :2])
    return line[np.argmax(below), :2]


@pytest.mark.parametrize("where", EVERYWHERE)
@pytest.mark.parametrize("name", ["Cam-c", "Cam-d1", "Cam-d2"])
def test_cameras_look_down_at_ground_that_counts(where, name):
    """The axis dips, and meets the ground within the camera's depth, on the road's area."""
    scene = scene_named(where)
    layout = strategy(scene, name)
    road = unary_union(list(scene.intersection.regions.values()))
    for pose, sensor in zip(np.asarray(layout.poses), layout.sensors, strict=True):
        meets = axis_on_the_ground(scene, pose)
        assert -70 < np.degrees(pose[4]) < -8
        assert np.hypot(*(meets - pose[:2])) < sensor.spec.depth
        assert road.distance(Point(meets)) < 2.0


def test_roadside_cameras_see_their_crosswalk():
    """Each unit's first looks over its crosswalk at the junction; its second looks outward."""
    scene = scene_named("four_way")
    poses = np.asarray(strategy(scene, "Cam-d2").poses)
    inward = [p[:2] @ [np.cos(p[5]), np.sin(p[5])] < 0 for p in poses]
    assert inward == [True, False] * 4
    for pose, arm in zip(poses[::2], scene.intersection.arms, strict=True):
        gaze = LineString([pose[:2], axis_on_the_ground(scene, pose)])
        assert gaze.intersects(mouth_crosswalks((arm,)))


def test_central_cameras_look_all_round_and_higher_or_shorter_sighted_ones_steeper():
    scene = scene_named("four_way")
    yaws = np.sort(np.degrees(np.asarray(strategy(scene, "Cam-c").poses)[:, 5]) % 360)
    np.testing.assert_allclose(yaws, np.arange(8) * 45.0, atol=1e-9)

    def dip(**options):
        return -np.asarray(strategy(scene, "Cam-d1", **options).poses)[:, 4]

    assert (dip(camera=replace(device("paper-camera").spec, depth=10.0)) > dip()).all()
    assert (dip(camera_height=9.0) > dip()).all()


@pytest.mark.parametrize(("name", "degrees"), [
    ("four_way", 37), ("t_junction", 251), ("triangle", 37), ("five_way", 251),
])  # fmt: skip
def test_layout_turns_with_the_world(name, degrees):
    """1 cm allows for GEOS's polygons in place of circles."""
    place = sloped(built_in(name) if name == "four_way" else bare(name))
    scenes = scene_of(place), scene_of(moved(place, degrees))
    turn = np.radians(degrees)
    c, s = np.cos(turn), np.sin(turn)
    for layout in STRATEGIES:
        before, after = (np.asarray(strategy(scene, layout).poses) for scene in scenes)
        expected = before[:, :3] @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + SHIFT
        np.testing.assert_allclose(after[:, :3], expected, atol=0.01)
        np.testing.assert_allclose(after[:, 3:5], before[:, 3:5], atol=0.002)
        np.testing.assert_allclose(np.cos(after[:, 5] - before[:, 5] - turn), 1.0, atol=1e-5)


@pytest.mark.parametrize(("name", "shared"), [("c", 1), ("d1", 4), ("d2", 2)])
def test_pairs_share_units(name, shared):
    """A pair is its two halves on the same poles: at a four-way every LiDAR joins cameras."""
    scene = scene_named("four_way")
    pair = strategy(scene, f"Cam-{name}/L-{name}")
    alone = [strategy(scene, f"Cam-{name}"), strategy(scene, f"L-{name}")]
    both = np.asarray(pair.poses), np.concatenate([a.poses for a in alone])
    np.testing.assert_allclose(*(poses[np.lexsort(poses.round(6).T)] for poses in both))
    assert len(pair.units) == len(alone[0].units)
    lidars, cameras = (
        {s.unit for s in pair.sensors if s.spec.kind == kind} for kind in ("lidar", "camera")
    )
    assert len(lidars & cameras) == shared


def test_heights_and_pitches_can_be_chosen():
    scene = scene_named("four_way")
    layout = strategy(scene, " cam-D2/l-d2 ", camera_height=8.0, lidar_height=5.5)
    assert layout.name == "Cam-d2/L-d2"
    for pose, sensor in zip(np.asarray(layout.poses), layout.sensors, strict=True):
        above = pose[2] - layout.units[sensor.unit].base[2]
        assert above == pytest.approx(8.0 if sensor.spec.kind == "camera" else 5.5)
    for pitch in (-17.0, 0.0):  # of the cameras alone
        layout = strategy(scene, "Cam-d1/L-d1", camera_pitch_deg=pitch)
        expected = [pitch * (sensor.spec.kind == "camera") for sensor in layout.sensors]
        np.testing.assert_allclose(np.degrees(layout.poses)[:, 4], expected, atol=1e-6)
    low = strategy(scene, "Cam-d1", camera_height=4.0)  # no mast arm reaches over traffic
    bases = np.array([low.units[s.unit].base[:2] for s in low.sensors])
    np.testing.assert_allclose(np.asarray(low.poses)[:, :2], bases)
    apart = strategy(scene, "Cam-d1/L-d1", camera_height=10.0, lidar_height=4.0)
    assert len(apart.units) == 8
    assert "corner 1, lidar" in {unit.name for unit in apart.units}


@pytest.mark.parametrize(("name", "options", "said"), [
    ("Cam-d3", {}, r"no strategy 'Cam-d3': one of Cam-c, .*Cam-d2/L-d2; did you mean Cam-d"),
    ("Cam-d1", {"camera_height": 2.0}, r"camera_height 2 m .* Cam-d1: between 3 and 12 m"),
    ("L-c", {"lidar_height": 4.0}, r"lidar_height 4 m .* L-c: between 5 and 12 m"),
    ("L-c", {"lidar_height": float("nan")}, r"lidar_height nan m is out of range"),
    ("Cam-d1", {"camera_pitch_deg": 5.0}, r"camera_pitch_deg 5: between -90, .* and 0"),
    ("L-c", {"lidar": "paper-camera"}, r"lidar 'paper-camera' is a camera"),
    ("L-c", {"lidar": "no-such-thing"}, r"no-such-thing"),
])  # fmt: skip
def test_bad_input_is_named(name, options, said):
    with pytest.raises(InspeError, match=said):
        strategy(scene_named("four_way"), name, **options)


def test_an_intersection_needs_two_arms_and_room_for_a_pole():
    place = built_in("four_way")
    with pytest.raises(InspeError, match="has 1 arm; strategies need at least 2"):
        strategy(scene_of(replace(place, arms=place.arms[:1])), "Cam-c")
    nowhere = scene_of(bare("four_way", mounting=Polygon()))
    with pytest.raises(InspeError, match="a corner pole has nowhere to stand"):
        strategy(nowhere, "L-d1")


def test_spread_by_hand():
    """Of four directions the opposite two; of a cross with a diagonal, the cross."""
    quarter = np.radians([0.0, 90.0, 180.0, 270.0])
    assert spread(quarter, 2) == [0, 2]
    assert spread(quarter, 4) == [0, 1, 2, 3]
    assert spread(np.radians([0.0, 45.0, 90.0, 180.0, 270.0]), 4) == [0, 2, 3, 4]
    # Gaps 80, 60, 60, 70, 90: leaving one out merges two, to 170, 140, 120, 130 or 160.
    assert spread(np.radians([0.0, 80.0, 140.0, 200.0, 270.0]), 4) == [0, 1, 3, 4]
