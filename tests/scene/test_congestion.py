"""Places whose roads fill: shares of classes, dense traffic, footpaths of one's own, and words."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from streets import FAR, LANE, crossing, intersection, line, overlapping, place_in

from inspe_jax.core.errors import InspeError
from inspe_jax.scene.intersection import Arm, Intersection, Route
from inspe_jax.scene.procedural.built_ins import built_in
from inspe_jax.scene.scene import AS_RECORDED, build_scene
from inspe_jax.scene.traffic.frames import (
    MIXES,
    ROAD_USERS,
    Snapshot,
    TrafficFrames,
    pack_frames,
    quota,
    shortfall,
)
from inspe_jax.scene.traffic.waypoint.generate import (
    LONGEST_HEADWAY,
    SHORTEST_HEADWAY,
    CongestedModel,
    waypoint_traffic,
)
from inspe_jax.scene.traffic.waypoint.paths import BESIDE, SLACK, lay_paths, with_walkways

CAR, TRUCK, CYCLIST, PEDESTRIAN = range(4)
RADIUS, COUNT = 40.0, 60
"""Arms of 26 m with two lanes each way: 47 vehicles and cyclists do not fit."""


@cache
def full() -> TrafficFrames:
    return waypoint_traffic(crossing(), radius=RADIUS, count=COUNT, frames=40)


def of(counts: list[int], frames: int = 2) -> TrafficFrames:
    """Frames with so many of each class."""
    kind = np.repeat(np.arange(4, dtype=np.int8), counts)
    n = len(kind)
    there = Snapshot(
        np.zeros((n, 3)), np.zeros(n), np.ones((n, 3)), kind, np.arange(n), np.zeros((n, 3))
    )
    return pack_frames([there] * frames, 1.0)


def test_a_full_place_has_as_many_as_asked_for_and_every_class() -> None:
    traffic = full()
    assert overlapping(traffic) == []
    assert traffic.mean_count == pytest.approx(COUNT, rel=0.07)
    by_road = slice(0, PEDESTRIAN)
    part = traffic.mean_by_class[by_road] / quota(MIXES["mixed"], [True] * 4, COUNT)[by_road]
    assert part.min() > 0.7
    assert np.ptp(part) < 0.3  # what is missing is missing of all alike


@pytest.mark.slow
def test_high_density_holds_in_a_narrow_town() -> None:
    """Where the roads alone hold 34 to 43, without trucks or without people."""
    traffic = waypoint_traffic(place_in("Town04", junction=278), radius=50, count=60, frames=100)
    assert traffic.mean_count == pytest.approx(60, rel=0.05)
    assert traffic.mean_by_class[[TRUCK, CYCLIST, PEDESTRIAN]].min() >= 4


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


def test_where_nobody_is_missing_vehicles_leave_freely() -> None:
    """From the shortest headway on nothing differs from the other model but who comes in."""
    paths, mix = lay_paths(crossing(), RADIUS), MIXES["mixed"]
    kind = np.repeat(np.arange(4, dtype=np.int8), quota(mix, [True] * 4, 8))
    model = CongestedModel(paths, kind, mix, np.random.default_rng(0))
    model.fill()
    for _ in range(300):
        model.step(0.2)
    assert model.headway == SHORTEST_HEADWAY
    assert (model.active & model.is_spare).sum() == 0
    assert model.active.sum() >= 7


def test_a_longer_run_of_a_full_place_begins_with_a_shorter() -> None:
    again = waypoint_traffic(crossing(), radius=RADIUS, count=COUNT, frames=5)
    most = again.valid.shape[1]
    for name in (*Snapshot._fields, "valid"):
        assert np.array_equal(getattr(again, name), getattr(full(), name)[:5, :most])


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


@pytest.mark.parametrize("place", [crossing(), built_in("highway_ramp"), intersection([])])
def test_other_places_stay_as_they_are(place: Intersection) -> None:
    """Where people walk already, on a motorway, and where no lane is."""
    assert with_walkways(place, 50) is place


def test_lanes_above_each_other_do_not_cross() -> None:
    below = Route(line((-FAR, 0), (FAR, 0)), LANE)
    above = Route(line((0, -FAR), (0, FAR)) + [0, 0, 6], LANE)
    place = intersection([below, above])
    assert with_walkways(place, 50) is place


@pytest.mark.parametrize(
    ("counts", "count", "words"),
    [
        ([40, 6, 6, 7], 60, ""),
        ([45, 6, 0, 0], 60, "asked 60, got 51.0: cyclists 0.0 of 6, pedestrians 0.0 of 7"),
        (
            [30, 4, 6, 20],
            60,
            "asked 60, got 60.0: cars 30.0 of 41, trucks 4.0 of 6; pedestrians 20.0 instead of 7",
        ),
        ([38, 6, 6, 6], 60, "asked 60, got 56.0: pedestrians 6.0 of 7"),
        ([14, 1, 2, 2], 20, "asked 20, got 19.0: trucks 1.0 of 2"),
    ],
)
def test_what_falls_short_is_said(counts: list[int], count: int, words: str) -> None:
    assert shortfall(of(counts), count, "mixed") == words


def test_shortfall_is_of_the_mix_and_of_means() -> None:
    lorries = of([0, 40, 0, 0])
    assert shortfall(lorries, 40, "largest") == ""
    valid = lorries.valid.copy()
    valid[0] = False
    said = shortfall(replace(lorries, valid=valid), 40, "largest")
    assert said == "asked 40, got 20.0: trucks 20.0 of 40"
    with pytest.raises(InspeError, match=r"traffic mix 'largst': one of .* did you mean largest"):
        shortfall(lorries, 40, "largst")


def test_a_scene_says_what_its_traffic_falls_short_of() -> None:
    size = dict(radius=30.0, voxel=2.0, frames=2, mix="largest")
    scene = build_scene(built_in("four_way"), density=60, **size)
    assert re.fullmatch(r"asked 60, got (\d+\.\d): trucks \1 of 60", scene.shortfall)
    recorded = tuple((k, AS_RECORDED if k == "density" else v) for k, v in scene.settings)
    assert replace(scene, settings=recorded).shortfall == ""
