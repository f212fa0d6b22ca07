"""The nine placements, on intersections laid by hand, on the built-in ones and on a real map."""

from dataclasses import replace
from functools import cache
from itertools import combinations, permutations

import numpy as np
import pytest
from mounts import assert_mountable, lanes_of
from shapely import affinity
from shapely.geometry import LineString, MultiPoint, Point
from shapely.ops import unary_union
from worlds import MAPS

from inspe_jax.core.errors import InspeError
from inspe_jax.mounting.strategies import STRATEGIES, spread, strategy
from inspe_jax.scene.intersection import Arm, Intersection, Route, mouth_crosswalks
from inspe_jax.scene.maps.registry import read_map
from inspe_jax.scene.procedural.built_ins import BUILT_INS, built_in
from inspe_jax.scene.regions import Region
from inspe_jax.scene.scene import Scene, build_scene
from inspe_jax.sensing.catalogue import device

FOUR, TEE, WYE = (0, 90, 180, 270), (0, 180, 270), (30, 150, 270)
FIVE = (0, 72, 144, 216, 288)
CENTER = np.array([100.0, -50.0, 7.0])


def hand_made(degrees=FOUR, *, mouth=14.0, width=14.0, poles=()) -> Intersection:
    """Straight roads of two lanes each way, 3 m sidewalks, on a slope of 2 % to the east."""
    middle = CENTER[:2]
    arms, roads, lanes_in, lanes_out = [], [], [], []
    for bearing in np.radians(degrees):
        along = np.array([np.cos(bearing), np.sin(bearing)])
        mouth_at = middle + mouth * along
        arms.append(Arm(tuple(mouth_at), float(bearing), width))
        _, left = arms[-1].axes
        roads.append(LineString([mouth_at, middle + 80 * along]).buffer(width / 2, cap_style=2))
        # Right-hand traffic: inbound on the left looking outward.
        for lanes, side in ((lanes_in, width / 4), (lanes_out, -width / 4)):
            lanes.append([middle + d * along + side * left for d in (80.0, mouth)])
    junction = MultiPoint([a.kerb(side) for a in arms for side in (-1, 1)]).convex_hull
    road = unary_union([junction, *roads])
    sidewalk = road.buffer(3.0, join_style=2).difference(road)
    rng = np.random.default_rng(3)
    points = rng.uniform(-90, 90, (400, 2)) + middle
    heights = CENTER[2] + 0.02 * (points[:, 0] - middle[0])
    routes = []
    for i, j in permutations(range(len(arms)), 2):
        line = np.array([*lanes_in[i], *lanes_out[j][::-1]])
        waypoints = np.column_stack([line, np.full(4, CENTER[2])])
        routes.append(Route(waypoints, 3.5, "vehicle", (i, j)))
    return Intersection(
        name="hand-made",
        source="test",
        center=CENTER,
        regions={
            Region.DRIVEWAY: unary_union(roads),
            Region.JUNCTION: junction,
            Region.CROSSWALK: mouth_crosswalks(tuple(arms)),
            Region.SIDEWALK: sidewalk,
        },
        arms=tuple(arms),
        routes=tuple(routes),
        mounting=sidewalk,
        poles=np.array([[*middle + p, 99.0] for p in poles]).reshape(-1, 3),
        ground_points=np.column_stack([points, heights]),
    )


def turned(place: Intersection, degrees: float) -> Intersection:
    """The whole world turned about the intersection's centre."""
    angle, middle = np.radians(degrees), place.center[:2]
    c, s = np.cos(angle), np.sin(angle)

    def points(p):
        out = np.array(p, float)
        out[..., :2] = (out[..., :2] - middle) @ np.array([[c, s], [-s, c]]) + middle
        return out

    def shape(geometry):
        return affinity.rotate(geometry, degrees, origin=tuple(middle))

    return replace(
        place,
        regions={label: shape(region) for label, region in place.regions.items()},
        arms=tuple(Arm(tuple(points(a.mouth)), a.bearing + angle, a.width) for a in place.arms),
        routes=tuple(replace(r, waypoints=points(r.waypoints)) for r in place.routes),
        mounting=shape(place.mounting),
        poles=points(place.poles),
        ground_points=points(place.ground_points),
    )


def scene_of(place: Intersection, radius: float = 50.0) -> Scene:
    return build_scene(place, profile="ideal", radius=radius, voxel=2.0, density="none", frames=1)


def all_ground() -> Intersection:
    """A map may call all ground mountable, and its lanes may be wider than its kerbs are apart."""
    place = hand_made(FOUR)
    routes = tuple(replace(route, width=12.0) for route in place.routes)
    return replace(place, routes=routes, mounting=Point(CENTER[:2]).buffer(60.0))


PLACES = {
    "four": lambda: hand_made(FOUR),
    "tee": lambda: hand_made(TEE),
    "wye": lambda: hand_made(WYE),
    "five": lambda: hand_made(FIVE),
    "bend": lambda: hand_made((0, 180)),
    "narrow": lambda: hand_made(FOUR),
    "all ground": all_ground,
    "small": lambda: hand_made(FOUR, mouth=8.0, width=7.0),
    "town": lambda: read_map(MAPS / "Town05.xodr", junction=53),
}


@cache
def scene_named(name: str) -> Scene:
    place = PLACES[name]() if name in PLACES else built_in(name)
    return scene_of(place, radius=18.0 if name == "narrow" else 50.0)


HAND_MADE = ("four", "tee", "wye", "five", "bend")


# ── What is placed ──────────────────────────────────────────────────────────

LIDARS = {"L-c": 1, "L-d1": 4, "L-d2": 2}


@pytest.mark.parametrize("where", [*HAND_MADE, *BUILT_INS, "small"])
def test_counts_are_the_papers(where):
    six = ("tee", "wye", "bend", "t_junction", "triangle", "highway_ramp", "small")
    for name in STRATEGIES:
        kinds = [sensor.spec.kind for sensor in strategy(scene_named(where), name).sensors]
        cameras = (6 if where in six else 8) if name.startswith("Cam") else 0
        lidars = LIDARS.get(name.rpartition("/")[2], 0)
        assert (kinds.count("camera"), kinds.count("lidar")) == (cameras, lidars)


def test_devices_are_the_profiles_unless_named():
    for name, options, expected in (
        ("Cam-d1/L-d1", {}, {"ideal-camera", "ideal-lidar-32"}),
        ("L-d2", {}, {"ideal-lidar-64"}),
        ("Cam-d1", {"camera": "basler-aca1600-60gc"}, {"basler-aca1600-60gc"}),
    ):
        layout = strategy(scene_named("four"), name, **options)
        assert {sensor.spec.name for sensor in layout.sensors} == expected


# ── Where it stands ─────────────────────────────────────────────────────────


@pytest.mark.parametrize("where", [*HAND_MADE, *BUILT_INS, "narrow", "all ground", "town"])
def test_every_unit_can_stand_and_carry_its_sensors(where, request):
    """By the raw map, also within 18 m; lorries pass beneath what hangs over them."""
    if where == "town":
        request.getfixturevalue("maps")
    scene = scene_named(where)
    lanes = lanes_of(scene.intersection)
    for name in STRATEGIES:
        layout = strategy(scene, name)
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
    stands, in_lane, far = (15.0, 12.0), (-12.0, 3.5), (12.0, -40.0)
    place = hand_made(FOUR, poles=(stands, in_lane, far))
    bases = [np.array(u.base[:2]) - CENTER[:2] for u in strategy(scene_of(place), "Cam-d1").units]
    assert any(np.allclose(base, stands) for base in bases)
    for pole in (in_lane, far):
        assert all(np.hypot(*(base - pole)) > 1.0 for base in bases)


CHORD = 10.5 + 0.3 / np.sqrt(2)


@pytest.mark.parametrize(
    ("where", "name", "expected"),
    [
        # Between kerb points (14, 7) and (7, 14) the chord is the kerb: 0.3 m beyond its middle.
        ("four", "L-d1", [[x * CHORD, y * CHORD] for x, y in ((1, 1), (-1, 1), (-1, -1), (1, -1))]),
        # 8 m outside the mouths at ±14, on the right looking outward, 0.3 m beyond the kerb at 7.
        ("four", "Cam-d2", [[22, -7.3], [7.3, 22], [-22, 7.3], [-7.3, -22]]),
        # On a tee's far side each kerb has a corner of its own.
        ("tee", "L-d1", [[14, 7.3], [-14, 7.3], [-CHORD, -CHORD], [CHORD, -CHORD]]),
    ],
)
def test_feet_by_hand(where, name, expected):
    layout = strategy(scene_named(where), name)
    got = np.array([unit.base[:2] for unit in layout.units]) - CENTER[:2]
    order = [np.hypot(*(got - foot).T).argmin() for foot in expected]
    assert len(got) == 4
    np.testing.assert_allclose(got[order], expected, atol=1e-6)


# ── Where it looks ──────────────────────────────────────────────────────────


@pytest.mark.parametrize("where", [*HAND_MADE, *BUILT_INS])
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


@pytest.mark.parametrize("where", [*HAND_MADE, *BUILT_INS])
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
    scene = scene_named("four")
    poses = np.asarray(strategy(scene, "Cam-d2").poses)
    inward = [(p[:2] - CENTER[:2]) @ [np.cos(p[5]), np.sin(p[5])] < 0 for p in poses]
    assert inward == [True, False] * 4
    for pose, arm in zip(poses[::2], scene.intersection.arms, strict=True):
        gaze = LineString([pose[:2], axis_on_the_ground(scene, pose)])
        assert gaze.intersects(mouth_crosswalks((arm,)))


def test_central_cameras_look_all_round_and_higher_or_shorter_sighted_ones_steeper():
    scene = scene_named("four")
    yaws = np.sort(np.degrees(np.asarray(strategy(scene, "Cam-c").poses)[:, 5]) % 360)
    np.testing.assert_allclose(yaws, np.arange(8) * 45.0, atol=1e-9)

    def dip(**options):
        return -np.asarray(strategy(scene, "Cam-d1", **options).poses)[:, 4]

    assert (dip(camera=replace(device("paper-camera").spec, depth=10.0)) > dip()).all()
    assert (dip(camera_height=9.0) > dip()).all()


# ── Invariance ──────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("arms", "degrees"), [(FOUR, 37.0), (TEE, 251.0), (WYE, 37.0), (FIVE, 251.0)]
)
def test_layout_turns_with_the_world(arms, degrees):
    """Rotate about the centre; 1 cm allows for GEOS's polygons in place of circles."""
    place = hand_made(arms, poles=((15.0, 12.0),) if arms == FOUR else ())
    scenes = scene_of(place), scene_of(turned(place, degrees))
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    for name in STRATEGIES:
        before, after = (np.asarray(strategy(scene, name).poses) for scene in scenes)
        expected = before.copy()
        expected[:, :2] = (before[:, :2] - CENTER[:2]) @ np.array([[c, s], [-s, c]]) + CENTER[:2]
        np.testing.assert_allclose(after[:, :3], expected[:, :3], atol=0.01)
        np.testing.assert_allclose(after[:, 3:5], expected[:, 3:5], atol=0.002)
        turn = after[:, 5] - before[:, 5] - np.radians(degrees)
        np.testing.assert_allclose(np.cos(turn), 1.0, atol=1e-5)


# ── Pairs and options ───────────────────────────────────────────────────────


@pytest.mark.parametrize(("name", "shared"), [("c", 1), ("d1", 4), ("d2", 2)])
def test_pairs_share_units(name, shared):
    """A pair is its two halves on the same poles: at a four-way every LiDAR joins cameras."""
    scene = scene_named("four")
    pair = strategy(scene, f"Cam-{name}/L-{name}")
    alone = [strategy(scene, f"Cam-{name}"), strategy(scene, f"L-{name}")]
    ordered = lambda poses: poses[np.lexsort(poses.round(6).T)]  # noqa: E731
    both = np.concatenate([a.poses for a in alone])
    np.testing.assert_allclose(ordered(np.asarray(pair.poses)), ordered(both))
    assert len(pair.units) == len(alone[0].units)
    mixed = {s.unit for s in pair.sensors if s.spec.kind == "lidar"} & {
        s.unit for s in pair.sensors if s.spec.kind == "camera"
    }
    assert len(mixed) == shared


def test_heights_and_pitches_can_be_chosen():
    scene = scene_named("four")
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


@pytest.mark.parametrize(
    ("name", "options", "said"),
    [
        ("Cam-d3", {}, r"no strategy 'Cam-d3': one of Cam-c, .*Cam-d2/L-d2; did you mean Cam-d"),
        ("Cam-d1", {"camera_height": 2.0}, r"camera_height 2 m .* Cam-d1: between 3 and 12 m"),
        ("L-c", {"lidar_height": 4.0}, r"lidar_height 4 m .* L-c: between 5 and 12 m"),
        ("L-c", {"lidar_height": float("nan")}, r"lidar_height nan m is out of range"),
        ("Cam-d1", {"camera_pitch_deg": 5.0}, r"camera_pitch_deg 5: between -90, .* and 0"),
        ("L-c", {"lidar": "paper-camera"}, r"lidar 'paper-camera' is a camera"),
        ("L-c", {"lidar": "no-such-thing"}, r"no-such-thing"),
    ],
)
def test_bad_input_is_named(name, options, said):
    with pytest.raises(InspeError, match=said):
        strategy(scene_named("four"), name, **options)


def test_an_intersection_needs_two_arms_and_room_for_a_pole():
    place = hand_made(FOUR)
    with pytest.raises(InspeError, match="has 1 arm; strategies need at least 2"):
        strategy(scene_of(replace(place, arms=place.arms[:1])), "Cam-c")
    bare = scene_of(replace(place, mounting=Point(0, 0).buffer(0)))
    with pytest.raises(InspeError, match="a corner pole has nowhere to stand"):
        strategy(bare, "L-d1")


def test_spread_by_hand():
    """Of four directions the opposite two; of a cross with a diagonal, the cross."""
    quarter = np.radians([0.0, 90.0, 180.0, 270.0])
    assert spread(quarter, 2) == [0, 2]
    assert spread(quarter, 4) == [0, 1, 2, 3]
    assert spread(np.radians([0.0, 45.0, 90.0, 180.0, 270.0]), 4) == [0, 2, 3, 4]
    # Gaps 80, 60, 60, 70, 90: leaving one out merges two, to 170, 140, 120, 130 or 160.
    assert spread(np.radians([0.0, 80.0, 140.0, 200.0, 270.0]), 4) == [0, 1, 3, 4]
