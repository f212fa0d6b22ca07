"""Units and sensors keep out of static bodies: strategies, random layouts, and what is reported."""

import numpy as np
import pytest
from shapely.geometry import Point
from worlds import LIDAR, place_sensors

import inspe_jax
from inspe_jax.mounting.site import Site
from inspe_jax.placement.constraints import Constraints
from inspe_jax.placement.problem import Problem
from inspe_jax.placement.sample_score import SampleScore
from inspe_jax.placement.space import Space
from inspe_jax.scene.placed_bodies import body_at
from inspe_jax.scene.statics import tree, upright_box
from inspe_jax.sensing.layout import UNIT_PLAN
from inspe_jax.visibility.centered_scene import poses_about_center


@pytest.fixture(scope="module")
def scene():
    size = dict(radius=30, voxel=1.0, spacing=2.0, frames=5, density=12, seed=4)
    return inspe_jax.build_scene(inspe_jax.built_in("four_way"), **size)


@pytest.fixture(scope="module")
def planted(scene):
    """A tree where a pole of the nine placements stands, a car on another's, a house on the side
    of a third."""
    site = Site(scene.intersection, 30.0, 30.0)
    a, b, c = site.corners[:3]
    return scene.with_statics(
        [
            tree(a, radius=1.8, height=7, base=2.5),
            upright_box("parked vehicle", b, (4.6, 1.8, 1.5), 0.7),
            upright_box("building", c + 3.0 * (c - site.center) / 20, (6, 6, 9), 0.2),
        ]
    )


def test_poles_of_placements_and_of_random_layouts_stand_clear(scene, planted):
    before, after = (inspe_jax.strategy(of, "Cam-d1/L-d1") for of in (scene, planted))
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
    space = Space(planted, inspe_jax.strategy(planted, "L-c"))
    high = place_sensors((LIDAR, [*crown.middle, 6.0, 0.0, 0.0, 0.0]))
    low = place_sensors((LIDAR, [*car.middle, 6.0, 0.0, 0.0, 0.0]))
    for layout, words in (
        (high, f"is within 2 m of a body, the {crown.words}"),
        (high, f"sensor 's0' is inside a body, the {crown.words}"),
        (low, f"is inside a body, the {car.words}"),
    ):
        own = Space(planted, layout, Constraints(places="any"))
        assert any(words in wrong for wrong in own.violations(layout)), own.violations(layout)
    assert not any(
        "inside a body" in wrong for wrong in space.violations(inspe_jax.strategy(planted, "L-c"))
    )


def test_samples_of_searches_know_the_bodies(planted):
    """Of all columns and frames, a sample has the exact score, sensor by sensor too."""
    layout = inspe_jax.strategy(planted, "L-d1")
    problem = Problem(planted, layout)
    x, _ = problem.space.start(layout)
    sample = problem.sample(np.random.default_rng(0), columns=10**6, frames=10**6)
    exact = problem.exact(x)
    bare = Problem(planted.with_statics([]), layout).exact_of(problem.space.layout(x))
    assert exact < bare - 0.005
    assert problem.rough(x[None], sample)[0] == pytest.approx(exact, abs=1e-6)
    poses = poses_about_center(planted, problem.space.layout(x))
    score = SampleScore(problem, sample)
    views = score.views({s: poses[s][None] for s in range(len(layout))})
    assert score.value({s: rows[0] for s, rows in views.items()}) == pytest.approx(exact, abs=1e-6)
