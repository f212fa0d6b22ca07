"""The gradient methods: that they climb, that a seed repeats, that a checkpoint goes on."""

import gc
import weakref
from functools import cache, partial
from itertools import pairwise
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checkpoints import Checkpoint
from dense_reference import measure
from mounts import assert_mountable, lanes_of

from inspe_jax.core.arrays import on_host
from inspe_jax.core.numerics import Softness
from inspe_jax.placement.candidates import poses
from inspe_jax.placement.methods import greedy_adam, polish
from inspe_jax.placement.methods.adam import annealed, charted_score
from inspe_jax.placement.methods.projected_gradient import scaled_score
from inspe_jax.placement.methods.registry import GRADIENTS
from inspe_jax.placement.problem import Problem, take
from inspe_jax.placement.run import BudgetSpent, Run
from inspe_jax.placement.strategies import strategy
from inspe_jax.scene.procedural.built_ins import built_in
from inspe_jax.scene.scene import build_scene
from inspe_jax.scoring.metrics import surrogate, weights_of
from inspe_jax.sensing.layout import Layout
from inspe_jax.visibility.centered_scene import poses_about_center

METHODS = {method.name: method for method in GRADIENTS}
BUDGET = {"adam": 120, "greedy-adam": 1400, "lbfgsb": 150, "projected-gradient": 300}
"""Exact scores' work in which each takes several of its steps; where a score is known, 4 times."""
FOLLOWING = [name for name in METHODS if name != "greedy-adam"]
"""Those that need nothing but scores and slopes."""


def cameras(scene, turned=0.0):
    """Two cameras on one unit and one on another, that look to the junction or are turned away."""
    whole = strategy(scene, "Cam-d1")
    poses = np.asarray(whole.poses)[:3] + [0, 0, 0, 0, 0, turned]
    return Layout(poses, whole.sensors[:3], whole.units[:2], "three cameras")


@pytest.fixture(scope="module")
def scene():
    return build_scene(built_in("four_way"), radius=30, voxel=1.0, frames=4, density=20)


@pytest.fixture(scope="module")
def problem(scene):
    return Problem(scene, cameras(scene, turned=2.0))


class Known(Problem):
    """A score of which all is known: how near the sensors are to where they were asked to be.

    1 for the layout ``at``; a sample moves its optimum by up to 0.2 m, as samples of scenes do.
    """

    REACH = np.array([30.0, 30.0, 6.0, 2.0, 2.0, 2.0])  # of a sensor's near poses [m, rad]

    def __init__(self, scene, layout, at):
        super().__init__(scene, layout)
        self.at = jnp.asarray(poses_about_center(scene, at), float)

    def exact_of(self, layout):
        return float(nearness(poses_about_center(self.cases[0].scene, layout), self.at))

    def rough(self, x, sample):
        at = self.at + moved(sample.arrays)
        return np.array([float(nearness(row, at)) for row in poses(self.space, x)])

    def slope(self, poses, on, softness):
        value, slope = slope_of_nearness(poses, self.at + moved(on))
        return float(value), np.asarray(slope)


def moved(fields):
    return 0.2 * jnp.sin(jnp.sum(jnp.asarray(fields[0].centered.columns[0], float)))


@jax.jit
def nearness(poses, at):
    away = (jnp.asarray(poses, float) - at) / jnp.asarray(Known.REACH, float)[None]
    return jnp.exp(-0.5 * (away**2).sum(-1)).mean()


slope_of_nearness = jax.jit(jax.value_and_grad(nearness))


@pytest.fixture(scope="module")
def known(scene):
    return Known(scene, cameras(scene, turned=2.0), cameras(scene))


def go(problem, name, seed=0, state=None, run=None, steps=10**9):
    """A method from its start or a state: the run, and every state on the way."""
    method = METHODS[name]
    if run is None:
        start = problem.space.start(problem.layout)[0]
        run = Run(problem, start, seed=seed, evaluations=budget(problem, name))
        run.offer(run.start)
    way = []

    def passed(state):
        way.append(Checkpoint.of(run, state))
        return state

    try:
        state = passed(method.begin(run) if state is None else state)
        while state is not None and len(way) <= steps:
            state = passed(method.step(run, state))
    except BudgetSpent:
        pass
    return run, way


def budget(problem, name):
    return BUDGET[name] * (4 if isinstance(problem, Known) else 1)


@pytest.fixture(scope="module")
def ran(problem):
    """A method's run on the real score, and its way; worked out where it is asked for."""
    return cache(partial(go, problem))


@pytest.fixture(scope="module")
def tried(problem, known, ran):
    """A problem for the method, its run and its way: on a known score, where that is enough."""

    def on(name):
        return (known, *go(known, name)) if name in FOLLOWING else (problem, *ran(name))

    return cache(on)


@pytest.mark.parametrize("name", METHODS)
def test_it_climbs_to_a_layout_that_can_be_mounted(problem, ran, name):
    run, _ = ran(name)
    assert run.best > run.history[0].score + 0.05
    found = problem.space.layout(run.best_x)
    assert problem.exact_of(found) == pytest.approx(run.best, abs=1e-6)
    scene = problem.cases[0].scene
    assert_mountable(scene, found, lanes_of(scene.intersection))


@pytest.mark.parametrize(
    ("name", "score"),
    # L-BFGS-B ends where a unit is at the edge of its piece of ground.
    [("adam", 0.999), ("lbfgsb", 0.75), ("projected-gradient", 0.99)],
)
def test_it_comes_to_the_optimum_of_a_known_score(tried, name, score):
    known, run, _ = tried(name)
    assert run.history[0].score < 0.3
    assert run.best > score
    scene = known.cases[0].scene
    assert_mountable(scene, known.space.layout(run.best_x), lanes_of(scene.intersection))


def test_bursts_and_moves_gain_what_greedy_placement_left(ran):
    """Every exact score between two states of one layout is of one arm's turn, and both gain."""
    states = [at.state for at in ran("greedy-adam")[1]]
    gained = {"count": 0, "passes": 0}
    for before, after in pairwise(state for state in states if "path" in state):
        for arm in gained:
            gained[arm] += after[arm] > before[arm] and after["value"] > before["value"]
    assert min(gained.values()) > 0


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_what_is_compiled_goes_with_its_problem(name):
    """Thousands of problems can be searched one after another: nothing outside keeps any."""
    scene = build_scene(built_in("four_way"), radius=15, voxel=2.0, frames=2, density=20)
    problem = Problem(scene, strategy(scene, "L-c"))
    run = Run(problem, problem.space.start(problem.layout)[0], evaluations=2000)
    run.offer(run.start)
    state = METHODS[name].begin(run)
    while not problem.compiled:
        state = METHODS[name].step(run, state)
    alive = weakref.ref(problem)
    del problem, run
    gc.collect()
    assert alive() is None


@pytest.mark.slow
@pytest.mark.parametrize("way", [charted_score, scaled_score])
def test_a_slope_is_that_of_every_vehicle_against_every_column(problem, way):
    """What gradients are of, against the same measures in the open; to rounding."""
    space, x = problem.space, problem.space.random(np.random.default_rng(1), 1)[0]
    drawn, softness = problem.draw(np.random.default_rng(0), 300, 3), jnp.asarray(0.5, float)
    field = take(problem.arrays, drawn)[0]

    @jax.jit
    def expected(x):
        at = field, space.poses(x), problem.sensor_sets[0], 1.0, Softness.of(0.5)
        found = measure(*at, **problem.options)
        return -surrogate(found.values, weights_of())[0]

    scale = np.where(space.scale > 0, space.scale, 1)
    if way is charted_score:
        v, place = space.chart(x)
        at = on_host(np.zeros_like(v), float), on_host(v, float), place
        x, slopes = space.from_chart(v, place, np), jax.jacobian(space.from_chart)(at[1], place)
    else:
        at, slopes = (on_host(x / scale, float),), np.eye(len(x))
    value, slope = way(problem)(*at, drawn, softness)
    assert -0.99 < value < -0.1
    assert value == pytest.approx(float(expected(jnp.asarray(x, float))), abs=2e-6)
    plain = np.asarray(jax.grad(expected)(jnp.asarray(x, float)))
    np.testing.assert_allclose(slope, scale * (plain @ slopes), atol=1e-5)


@pytest.mark.parametrize("name", METHODS)
def test_a_seed_repeats_and_another_does_not(tried, name):
    """That greedy-adam repeats, its checkpoints show."""
    problem, run, way = tried(name)
    first = [row.score for row in run.history]
    if name in FOLLOWING:
        assert [row.score for row in go(problem, name)[0].history] == first
    other, _ = go(problem, name, seed=1, steps=len(way) // 3)
    assert 1 < len(other.history) <= len(first)
    assert [row.score for row in other.history] != first[: len(other.history)]


@pytest.mark.parametrize(
    ("name", "at"),
    [
        *((name, "half way") for name in METHODS),
        pytest.param("greedy-adam", "before the first turn", marks=pytest.mark.slow),
        pytest.param("greedy-adam", "after the first turn", marks=pytest.mark.slow),
    ],
)
def test_from_a_checkpoint_it_goes_on_as_if_nothing_had_come_between(tried, name, at):
    """Through a file: no pickle, all as it was."""
    problem, whole, way = tried(name)
    first = next((n for n, row in enumerate(way) if "path" in (row.state or {})), 0)
    after = len(way) // 2 if at == "half way" else first + at.startswith("after")
    again = Run(problem, whole.start, seed=0, evaluations=whole.limits[1])
    way[after].take_up(again, whole)
    go(problem, name, state=way[after].state, run=again)
    assert 1 < way[after].scores < len(whole.history)
    assert [row.score for row in again.history] == [row.score for row in whole.history]


def test_with_a_larger_budget_it_goes_on_in_shares_of_that(tried):
    """Adam looks at an exact score after each 0.15 of the budget, not of the one it had before."""
    problem, part, way = tried("adam")
    state = way[-1].state or way[-2].state
    again = Run(problem, part.start, seed=0, evaluations=5 * part.limits[1])
    again.take_up(part.seconds, part.evaluations, part.history, part.path)
    while len(again.history) == len(part.history):
        state = METHODS["adam"].step(again, state)
    assert again.evaluations < part.evaluations + 0.3 * again.limits[1]


def test_greedy_adam_goes_through_all_its_parts(ran):
    """Placement, exchanges, and turns of Adam and of finer moves from there."""
    states = [at.state for at in ran("greedy-adam")[1] if at.state]
    parts = ["turns" if "path" in s else s["greedy phase"] for s in states]
    order = [part for part in dict.fromkeys(parts) if part != "move"]  # there at once, or not
    assert order == ["look", "place", "exchange", "turns"]
    assert states[-1]["count"] > 0
    assert states[-1]["passes"] > 0


class Flat(Problem):
    """A score without a slope: gradients are of nothing, and what they cost is not what counts."""

    def slope(self, poses, on, softness):
        return 0.5, np.zeros((len(poses), 6), jnp.zeros((), float).dtype)


def test_an_arm_that_gains_nothing_is_given_up_but_for_a_try_now_and_then():
    """While there is time for both: at the end, bursts fill what is too short for a pass."""
    scene = build_scene(built_in("four_way"), radius=15, voxel=2.0, frames=2, density=20)
    problem = Flat(scene, strategy(scene, "L-c"))
    run = Run(problem, problem.space.start(problem.layout)[0], evaluations=3000)
    run.offer(run.start)
    state = METHODS["greedy-adam"].begin(run)
    while run.done < 0.8:
        state = METHODS["greedy-adam"].step(run, state)
    bursts, passes = state["count"] / polish.BURST, state["passes"]
    assert run.best > run.history[0].score
    assert passes > 5
    assert 1 <= bursts <= 1 + passes / 3


def test_turns_go_to_the_arm_that_gained_more_of_late():
    both, idle = (polish.ADAM, polish.MOVES), np.zeros(2, int)
    assert polish.choose(np.array([0.2, 0.1]), idle, both) == polish.ADAM
    assert polish.choose(np.array([0.1, 0.2]), idle, both) == polish.MOVES
    assert polish.choose(np.array([0.1, np.inf]), idle, both) == polish.MOVES  # not tried yet
    assert polish.choose(np.zeros(2), np.array([0, 1]), both) == polish.MOVES  # in turns
    assert polish.choose(np.array([0.1, 0.2]), np.array([polish.RETRY, 0]), both) == polish.ADAM
    assert polish.choose(np.array([0.2, 0.1]), idle, (polish.MOVES,)) == polish.MOVES


@pytest.mark.parametrize(
    ("spent", "then"),
    [(0.30, "look"), (0.40, "turns of its own"), (0.45, "turns of the best")],
)
def test_rounds_go_on_while_there_is_time_for_another(problem, monkeypatch, spent, then):
    """The last took 0.05 of the budget to place: another is tried until 0.17 later."""
    start = problem.space.start(problem.layout)[0]
    best = problem.space.random(np.random.default_rng(0), 1)[0]
    run = SimpleNamespace(
        spent=np.array([spent, 0.0]), done=spent, share=lambda s: s[0], ready=lambda name: True,
        best_x=best, best=0.5 if then == "turns of the best" else 0.4,
    )  # fmt: skip
    monkeypatch.setattr(polish, "turn", lambda run, state, gradient: state)
    state = polish.begin(start, 0.4) | {"count": 7, "passes": 3, "began": np.zeros(2)}
    state |= {"placing": np.array([0.05, 0.0]), "placed": np.array([spent - 0.13, 0.0])}
    state |= {"greedy round": 0, "greedy phase": "move", "worth": np.ones(2)}
    after = greedy_adam.step(run, state)
    assert (after["count"], after["passes"]) == (7, 3)
    np.testing.assert_array_equal(after["worth"], np.ones(2))
    if then == "look":
        assert (after["greedy phase"], after["greedy round"]) == ("look", 1)
        assert "path" not in after
    else:
        np.testing.assert_array_equal(after["x"], best if then == "turns of the best" else start)


def test_softness_falls_geometrically():
    assert annealed((3.0, 0.3), 0.0) == 3.0
    assert annealed((3.0, 0.3), 0.5) == pytest.approx(np.sqrt(0.9))
    assert annealed((3.0, 0.3), 2.0) == pytest.approx(0.3)
