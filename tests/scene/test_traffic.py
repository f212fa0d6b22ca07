"""The waypoint model: nobody overlaps, everybody gets through, and turning the world turns it.

Where roads fill: shares of classes, queues, footpaths of one's own, and what falls short in words.
"""

import re
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from streets import FAR, LANE, crossing, intersection, line, overlapping, quarter_bend, turned

from inspe_jax.core.errors import InspeError
from inspe_jax.scene.intersection import Arm, Intersection, Route
from inspe_jax.scene.maps.registry import read_map
from inspe_jax.scene.procedural.built_ins import built_in
from inspe_jax.scene.scene import AS_RECORDED, build_scene
from inspe_jax.scene.traffic import frames
from inspe_jax.scene.traffic.frames import (
    MIXES,
    ROAD_USERS,
    BodySize,
    Mix,
    TrafficFrames,
    quota,
    shortfall,
)
from inspe_jax.scene.traffic.waypoint.generate import (
    LONGEST_HEADWAY,
    CongestedModel,
    waypoint_traffic,
)
from inspe_jax.scene.traffic.waypoint.model import WEDGED, WaypointModel
from inspe_jax.scene.traffic.waypoint.paths import BESIDE, SLACK, SPACING, lay_paths, with_walkways

CAR, TRUCK, CYCLIST, PEDESTRIAN = range(4)
STREET = Route(line((-FAR, 0), (FAR, 0)), LANE)
OVER = Route(line((0, -FAR), (0, FAR)) + [0, 0, 6], LANE)


@cache
def usual(mix: str = "mixed", count: int = 40) -> TrafficFrames:
    return waypoint_traffic(crossing(), radius=50, count=count, frames=30, mix=mix)


def model_of(place: Intersection, count: int) -> WaypointModel:
    """The model before anybody is there, with the shares of the usual mix."""
    paths, mix = lay_paths(place, 50.0), MIXES["mixed"]
    walked = bool((paths.user == 2).any())
    kind = np.repeat(np.arange(4, dtype=np.int8), quota(mix, [True, True, walked, walked], count))
    return WaypointModel(paths, kind, mix, np.random.default_rng(0))


@pytest.mark.parametrize(("mix", "count"), [
    ("mixed", 20), ("mixed", 40), ("mixed", 60), ("largest", 40), ("fleet", 40),
])  # fmt: skip
def test_as_many_as_asked_for_and_nobody_overlaps(mix: str, count: int) -> None:
    traffic = usual(mix, count)
    assert overlapping(traffic) == []
    if mix != "largest":  # as many trucks do not fit
        assert traffic.mean_count == pytest.approx(count, rel=0.1)


def test_padding_comes_last_and_everybody_is_within_the_radius() -> None:
    traffic = usual()
    assert (np.diff(traffic.valid.astype(int), axis=1) <= 0).all()
    assert (np.hypot(*traffic.center[traffic.valid][:, :2].T) <= 50).all()
    assert waypoint_traffic(crossing(), radius=50, count=0, frames=3).center.shape == (3, 0, 3)


def test_sizes_by_class() -> None:
    largest = usual("largest")
    assert (largest.size[largest.valid] == ROAD_USERS[TRUCK].size).all()
    mixed = usual(count=60)
    for k, user in enumerate(ROAD_USERS):
        size = mixed.size[mixed.valid & (mixed.kind == k)]
        assert (np.abs(size / user.size - 1) <= 0.12 + 1e-12).all(), user.name
        assert len(np.unique(size[:, 0])) > 1
    cars = np.unique(mixed.size[mixed.valid & (mixed.kind == CAR)], axis=0)
    # About 80 cars, 6 % spread cut at two deviations: standard error 0.6 %.
    assert cars.mean(0) == pytest.approx(ROAD_USERS[CAR].size, rel=0.02)


def test_shares() -> None:
    # 0.68 · 20 = 13.6, 2, 2, 2.4: the one left over goes to the largest remainder.
    assert quota(MIXES["mixed"], [True] * 4, 20).tolist() == [14, 2, 2, 2]
    # 68 : 10 of 88 is 76.7 : 11.3.
    assert quota(MIXES["mixed"], [True, True, False, False], 88).tolist() == [77, 11, 0, 0]


def test_a_fleet_has_bodies_by_their_shares():
    """Every body occurs, and sizes are within two standard deviations of a body's."""
    mix, rng = MIXES["fleet"], np.random.default_rng(0)
    for kind, name in enumerate(frames.CLASSES):
        bodies = mix.bodies[name]
        drawn = np.array([mix.mean_size(kind, rng) for _ in range(4000)])
        share = np.array([body.share for body in bodies])
        for body, expected in zip(bodies, share / share.sum(), strict=True):
            found = (drawn == body.size).all(1).mean()
            assert found == pytest.approx(expected, abs=4 * np.sqrt(expected / 4000))
    state = rng.bit_generator.state
    assert MIXES["mixed"].mean_size(CAR, rng).tolist() == list(ROAD_USERS[CAR].size)
    assert rng.bit_generator.state == state  # no other random numbers where there are no bodies
    traffic = usual("fleet")
    length, kind = traffic.size[..., 0][traffic.valid], traffic.kind[traffic.valid]
    assert length.max() <= 16.5 * 1.06
    assert length[kind == CAR].min() < 4.0 < 4.8 < length[kind == CAR].max()


def test_stands_on_the_ground_of_its_route() -> None:
    route = Route(line((-FAR, 0), (FAR, 0), grade=0.1), LANE)
    traffic = waypoint_traffic(intersection([route]), radius=50, count=5, frames=10)
    x, _, z = traffic.center[traffic.valid].T
    assert z - traffic.size[traffic.valid][:, 2] / 2 == pytest.approx(0.1 * x, abs=1e-9)


def test_cyclists_and_pedestrians_keep_right() -> None:
    walk = Route(line((-FAR, 9), (FAR, 9)), 2.0, "pedestrian")
    traffic = waypoint_traffic(intersection([STREET, walk]), radius=50, count=20, frames=5)
    y, kind = traffic.center[traffic.valid][:, 1], traffic.kind[traffic.valid]
    assert y[kind == CYCLIST] == pytest.approx(-(LANE / 2 - 0.6))
    assert y[kind == PEDESTRIAN] == pytest.approx(9 - 0.5)
    assert y[(kind == CAR) | (kind == TRUCK)] == pytest.approx(0)
    assert traffic.yaw[traffic.valid] == pytest.approx(0)


def test_everybody_moves_ahead_every_arm_discharges_and_nobody_is_stuck() -> None:
    """In 140 s each of the four approaches, and its left turn, has its turn."""
    model = model_of(crossing(), 40)
    model.fill()
    fastest = np.array([u.top_speed for u in ROAD_USERS])[model.kind]
    left: list[int] = []
    stood = moved = 0
    for _ in range(700):
        track, point, heading = model.track.copy(), model.point.copy(), model.heading.copy()
        was_on, path = model.active.copy(), model.path.copy()
        ended = model.arc >= model.paths.length[model.path] - 2.5
        model.step(0.2)
        left += path[was_on & ~model.active & ended].tolist()
        same = was_on & model.active & (track == model.track)
        step = model.point[same] - point[same]
        distance = np.hypot(*step[:, :2].T)
        assert (distance <= fastest[same] * 0.2 + 1e-9).all()
        ahead = (model.heading[same] + heading[same]) / 2
        along = (step[:, :2] * ahead).sum(1)
        # Within 8 degrees: a long body in a bend turns about its axles, not its middle.
        assert (along >= np.cos(np.radians(8)) * distance - 1e-9).all()
        stood += int((distance == 0).sum())
        moved += int((distance > 0.5).sum())
    assert min(stood, moved) > 300  # they stop and go
    first = model.paths.point[model.paths.start]
    vehicles = [p for p in left if model.paths.user[p] == 0]
    approach = np.round(np.arctan2(*first[vehicles, 1::-1].T) / (np.pi / 2)).astype(int) % 4
    assert (np.bincount(approach, minlength=4) >= 5).all()
    assert {model.paths.user[p] for p in left} == {0, 1, 2}
    assert model.removed == 0


def test_free_road_is_driven_at_the_desired_speed() -> None:
    model = model_of(intersection([STREET]), 1)
    speeds = []
    for _ in range(40):
        model.step(0.2)
        speeds.append(model.speed[0])
    assert speeds[5:35] == pytest.approx([model.wish[0]] * 30)
    assert 0.8 * 10 <= model.wish[0] <= 10


def test_a_side_road_has_its_turn() -> None:
    """Six lanes that never cease to flow do not shut out the seventh."""
    main = [Route(line((-FAR, y), (FAR, y)), LANE) for y in LANE * np.arange(6.0)]
    side = Route(line((0, -FAR), (0, FAR)), LANE)
    model = model_of(intersection([*main, side]), 60)
    for _ in range(450):
        model.step(0.2)
    assert model.removed == 0
    assert model.still.max() < 60


def test_one_stream_waits_for_the_other() -> None:
    """Two lanes that cross: the stop line, by hand, and never two bodies in the square."""
    place = intersection([STREET, Route(line((0, -FAR), (0, FAR)), LANE)])
    paths = lay_paths(place, 50)
    numbers = paths.block[paths.user == 0, 0]
    # Seen every metre, two lanes (2.6 + 0.37 m free) are in conflict up to 2 m from where they
    # cross, at 50 m. Cyclists, 1.15 m to the right of the other lane (1.7 + 0.37 m free), reach
    # from 0.9 m before to 3.2 m beyond. Lines are 1 m before, ends 1 m beyond.
    right_of_it = np.array([1, -1]) * 1.15
    assert paths.stop[numbers] == pytest.approx(50 + np.minimum(-2, right_of_it - 2) - 1, abs=0.6)
    assert paths.leave[numbers] == pytest.approx(50 + np.maximum(2, right_of_it + 2) + 1, abs=0.6)
    assert np.isfinite(paths.clear[numbers[0], numbers[1]])
    assert paths.clear[numbers[0], numbers[0]] == -np.inf  # whoever follows needs no leave
    traffic = waypoint_traffic(place, radius=50, count=12, frames=100, mix="largest")
    near = np.abs(traffic.center[..., :2]).max(-1) < 1.25
    assert ((near & traffic.valid).sum(1) <= 1).all()
    both = [np.abs(np.sin(traffic.yaw)) < 0.5, np.abs(np.sin(traffic.yaw)) > 0.5]
    assert all((near & traffic.valid & b).any() for b in both)


def test_streams_that_do_not_meet_need_no_leave() -> None:
    opposite = [
        Route(line((-FAR, -LANE / 2), (FAR, -LANE / 2)), LANE),
        Route(line((FAR, LANE / 2), (-FAR, LANE / 2)), LANE),
        Route(line((-FAR, -LANE * 1.5), (FAR, -LANE * 1.5)), LANE),
    ]
    paths = lay_paths(intersection(opposite), 50)
    assert (paths.block == -1).all()


def test_people_cross_when_no_vehicle_is_in_the_way() -> None:
    walk = Route(line((0, -8), (0, 8)), 2.0, "pedestrian")
    place = intersection([STREET, walk])
    traffic = waypoint_traffic(place, radius=50, count=10, frames=150, seed=1)
    assert overlapping(traffic) == []
    walking = traffic.valid & (traffic.kind == PEDESTRIAN)
    assert (np.abs(traffic.center[..., 1]) < 1)[walking].any()
    assert (traffic.center[..., 0] > 10)[traffic.valid & (traffic.kind == CAR)].any()


def test_seed_repeats_and_another_differs() -> None:
    told: list[tuple[int, int]] = []
    given = dict(radius=50, count=40, frames=9, progress=lambda *at: told.append(at))
    again, other = (waypoint_traffic(crossing(), seed=k, **given) for k in (0, 1))
    assert told == [(done, 9) for done in range(1, 10)] * 2
    most = again.valid.shape[1]
    for name in ("center", "yaw", "size", "valid", "kind"):
        assert np.array_equal(getattr(again, name), getattr(usual(), name)[:9, :most])
    assert other.center.shape != again.center.shape or not np.allclose(other.center, again.center)


def test_turning_the_world_turns_the_traffic() -> None:
    angle, shift = np.radians(37), (120.0, -45.0, 3.0)
    place = intersection([turned(r, angle, shift) for r in crossing().routes], shift)
    here, there = usual(), waypoint_traffic(place, radius=50, count=40, frames=30)
    v = here.valid
    assert np.array_equal(v, there.valid)
    assert np.array_equal(here.kind, there.kind)
    x, y, z = here.center[v].T
    c, s = np.cos(angle), np.sin(angle)
    expected = np.stack([c * x - s * y, s * x + c * y, z], -1) + shift
    assert there.center[v] == pytest.approx(expected, abs=1e-6)
    wrapped = (there.yaw - here.yaw - angle + np.pi) % (2 * np.pi) - np.pi
    assert wrapped[v] == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(("change", "words"), [
    ({"mix": "mixd"}, "traffic mix 'mixd': one of mixed, fleet, largest; did you mean mixed?"),
    ({"count": -1}, "traffic count -1 is out of range: at least 0"),
    ({"frames": 0}, "traffic frames 0 is out of range: at least 1"),
    ({"seed": -1}, "traffic seed -1 is out of range: at least 0"),
    ({"radius": float("nan")}, "traffic radius nan is out of range: above 0"),
    ({"step": -1.0}, "traffic step -1.0 is out of range: above 0"),
])  # fmt: skip
def test_bad_input(change: dict, words: str) -> None:
    with pytest.raises(InspeError) as raised:
        waypoint_traffic(crossing(), **({"radius": 50.0, "count": 1, "frames": 1} | change))
    assert str(raised.value) == words


@pytest.mark.parametrize(("given", "words"), [
    (((1.0, 0.0, 0.0), 0.0), "shares: a share of each of car, truck, cyclist, pedestrian"),
    (((np.nan, 1.0, 0.0, 0.0), 0.0), "shares: .*none of them negative"),
    (((1.0, 0.0, 0.0, 0.0), -0.1), "spread -0.1"),
    (((1.0, 0.0, 0.0, 0.0), 0.0, {"tram": ()}), "bodies: road user 'tram'"),
    (((1.0, 0.0, 0.0, 0.0), 0.0, {"car": (BodySize(1, (4.0, 0.0, 2.0)),)}), "bodies: car: "),
])  # fmt: skip
def test_each_bad_mix_gets_its_message(given: tuple, words: str) -> None:
    with pytest.raises(InspeError, match=words):
        Mix(*given)


def test_no_route_within_reach() -> None:
    away = intersection([Route(line((500, 0), (600, 0)), LANE)])
    with pytest.raises(InspeError, match=r"test crossing: no route within 50 m .* mix 'mixed'"):
        waypoint_traffic(away, radius=50, count=1, frames=1)


def test_bends_slow_one_down_and_axles_are_on_the_path() -> None:
    radius = 10.0
    bend = [(-40.0, 0.0), *quarter_bend(0.0, 0.0, radius, True), (radius, 50.0)]
    paths = lay_paths(intersection([Route(line(*bend), LANE)]), 60)
    arc = 40 + radius * np.pi / 4
    middle = int(paths.start[0] + arc / SPACING)
    assert paths.limit[middle] == pytest.approx(np.sqrt(2.2 * radius), rel=0.1)
    assert paths.limit[paths.start[0]] > 10  # and not before it need be
    point, heading = paths.chord(np.array([0]), np.array([arc]), np.array([8.5]))
    # The middle of a chord of arc 0.6 · 8.5 m lies r · cos(arc / 2r) from the bend's centre.
    off = np.hypot(*(point[0, :2] - [0, radius]))
    assert off == pytest.approx(radius * np.cos(0.3 * 8.5 / radius), abs=0.03)
    assert np.arctan2(heading[0, 1], heading[0, 0]) == pytest.approx(np.pi / 4, abs=0.03)


@pytest.mark.parametrize("name", ["roundabout", "highway_ramp"])
def test_built_ins(name: str) -> None:
    traffic = waypoint_traffic(built_in(name), radius=50, count=20, frames=40)
    assert overlapping(traffic) == []
    assert traffic.mean_count == pytest.approx(20, rel=0.1)
    if name == "highway_ramp":  # nobody cycles where nobody walks
        assert set(traffic.kind[traffic.valid].tolist()) == {CAR, TRUCK}


@pytest.mark.slow
@pytest.mark.parametrize("density", [20, 40, 60])
def test_lorries_in_narrow_streets_do_not_stand_for_good(maps, density: int) -> None:
    """Where two sweep each other's corner one goes first; who is wedged in goes and comes again.

    Roads that fill let one vehicle out of each lane in 20 s at the slowest. Those queueing for it
    then move on by a lorry and its gap, 10.5 m, for which they need some 3.5 s at 3 m/s: they stand
    for at most 0.83 of the time.
    """
    place = read_map(maps / "Town04.xodr", junction=278, radius=50)
    shares = list[float]()
    for seed in range(3 if density == 20 else 1):  # few lorries: one drawing says little
        some = dict(radius=50, count=density, frames=100, mix="largest", seed=seed)
        traffic = waypoint_traffic(place, **some)
        assert overlapping(traffic) == []
        at = [xyz[there, :2] for xyz, there in zip(traffic.center, traffic.valid, strict=True)]
        stands = [(np.abs(b[:, None] - a).sum(-1).min(1) < 0.05).mean() for a, b in pairwise(at)]
        waits = "".join("." if share == 1 else "|" for share in stands).split("|")
        assert max(map(len, waits)) <= WEDGED
        shares += stands
    assert np.mean(shares) < (0.6 if density == 20 else 0.83)


def counted(counts: list[int]) -> TrafficFrames:
    """Frames with so many of each class."""
    kind = np.repeat(np.arange(4, dtype=np.int8), counts)
    n = len(kind)
    there = frames.Snapshot(
        np.zeros((n, 3)), np.zeros(n), np.ones((n, 3)), kind, np.arange(n), np.zeros((n, 3))
    )
    return frames.pack_frames([there] * 2, 1.0)


def test_a_full_place_has_as_many_as_asked_for_and_every_class() -> None:
    """Arms of 26 m with two lanes each way: 47 vehicles and cyclists do not fit; it repeats."""
    traffic, again = (waypoint_traffic(crossing(), radius=40, count=60, frames=n) for n in (40, 5))
    assert np.array_equal(again.center, traffic.center[:5, : again.valid.shape[1]])
    assert overlapping(traffic) == []
    assert traffic.mean_count == pytest.approx(60, rel=0.07)
    by_road = slice(0, PEDESTRIAN)
    part = traffic.mean_by_class[by_road] / quota(MIXES["mixed"], [True] * 4, 60)[by_road]
    assert part.min() > 0.7
    assert np.ptp(part) < 0.3  # what is missing is missing of all alike


def test_vehicles_leave_one_by_one_and_wait_at_the_end_of_their_lane() -> None:
    """More cars than a road of one lane holds: a queue stands at its end, and moves on."""
    paths = lay_paths(intersection([Route(line((-FAR, 0), (FAR, 0)), LANE)]), 50)
    kind = np.zeros(30, np.int8)
    model = CongestedModel(paths, kind, MIXES["largest"], np.random.default_rng(0))
    model.fill()
    left, ended = [], []
    for _ in range(750):
        was, arc = model.active.copy(), model.arc.copy()
        model.step(0.2)
        gone = was & ~model.active
        left += [model.time] * int(gone.sum())
        ended += arc[gone].tolist()
        front = (model.arc + model.size[:, 0] / 2)[model.active & ~model.may_leave]
        assert front.max() <= 100  # whoever may not leave stays before the end of the lane
    assert model.removed == 0
    assert np.min(ended) > 99 - ROAD_USERS[CAR].top_speed * 0.2
    assert len(left) >= 5
    # One a headway; how long each takes from the line to the end differs by a second or two.
    assert np.diff(left)[1:] == pytest.approx(LONGEST_HEADWAY, abs=2.5)
    # 100 m of lane; a car and its gap at a standstill are 6.1 m.
    assert 12 <= model.active.sum() <= 16


@cache
def without_walks() -> Intersection:
    """The crossing, without pedestrians, but with its four arms; the edge of lanes is at 7 m."""
    mouth = 13.0
    arms = tuple(
        Arm((mouth * np.cos(b), mouth * np.sin(b)), b, 4 * LANE) for b in np.arange(4) * np.pi / 2
    )
    return replace(crossing(walks=False), arms=arms)


def test_people_walk_beside_the_lanes_and_over_the_arms() -> None:
    place = without_walks()
    found = with_walkways(place, 50)
    walks = found.routes[len(place.routes) :]
    assert found.routes[: len(place.routes)] == place.routes
    assert found.regions is place.regions
    assert {w.user for w in walks} == {"pedestrian"}
    over = [w for w in walks if np.abs(w.waypoints[:, :2]).min(1).min() < 0.5]
    beside = [w for w in walks if not any(w is o for o in over)]
    assert len(over) == 4 * 2  # both ways
    lanes = np.concatenate([r.waypoints for r in place.routes])[:, None, :2]
    for walk in beside:
        away = np.linalg.norm(walk.waypoints[:, :2] - lanes, axis=-1).min(0)
        assert away.min() > LANE / 2 + BESIDE - SLACK - 0.05
    # From each of the eight rims: the kerb is at 7 m, the footpath 1.5 m behind.
    ends = np.concatenate([w.waypoints[[0, -1], :2] for w in beside])
    far = np.sort(np.abs(ends), 1)
    assert (np.abs(far[far[:, 1] > 60] - [7 + BESIDE, FAR]).max(1) < 1.0).sum() == 4 * 2 * 2


def test_traffic_has_every_class_without_sidewalks_on_the_map() -> None:
    traffic = waypoint_traffic(without_walks(), radius=50, count=40, frames=30)
    assert traffic.mean_by_class == pytest.approx(quota(MIXES["mixed"], [True] * 4, 40), abs=1)
    assert overlapping(traffic) == []


@pytest.mark.parametrize(
    "place", [crossing(), built_in("highway_ramp"), intersection([]), intersection([STREET, OVER])]
)
def test_other_places_stay_as_they_are(place: Intersection) -> None:
    """Where people walk already, on a motorway, and where no lane is or none on one level."""
    assert with_walkways(place, 50) is place


@pytest.mark.parametrize(("counts", "count", "words"), [
    ([40, 6, 6, 7], 60, ""),
    ([45, 6, 0, 0], 60, "asked 60, got 51.0: cyclists 0.0 of 6, pedestrians 0.0 of 7"),
    ([30, 4, 6, 20], 60,
     "asked 60, got 60.0: cars 30.0 of 41, trucks 4.0 of 6; pedestrians 20.0 instead of 7"),
])  # fmt: skip
def test_what_falls_short_is_said(counts: list[int], count: int, words: str) -> None:
    assert shortfall(counted(counts), count, "mixed") == words


def test_shortfall_is_of_the_mix_and_of_means() -> None:
    lorries = counted([0, 40, 0, 0])
    assert shortfall(lorries, 40, "largest") == ""
    valid = lorries.valid.copy()
    valid[0] = False
    said = shortfall(replace(lorries, valid=valid), 40, "largest")
    assert said == "asked 40, got 20.0: trucks 20.0 of 40"
    with pytest.raises(InspeError, match=r"traffic mix 'largst': one of .* did you mean largest"):
        shortfall(lorries, 40, "largst")
    # A scene says so of its own.
    size = dict(radius=30.0, voxel=2.0, frames=2, mix="largest")
    scene = build_scene(built_in("four_way"), density=60, **size)
    assert re.fullmatch(r"asked 60, got (\d+\.\d): trucks \1 of 60", scene.shortfall)
    recorded = tuple((k, AS_RECORDED if k == "density" else v) for k, v in scene.settings)
    assert replace(scene, settings=recorded).shortfall == ""
