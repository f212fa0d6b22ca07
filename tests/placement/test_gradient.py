"""The gradient methods: that they climb, that a seed repeats, that a checkpoint goes on."""

import contextlib
import gc
import weakref
from functools import cache, partial
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checkpoints import Checkpoint
from dense_reference import measure
from mounts import assert_mountable, lanes_of

from inspe_jax.core.arrays import on_host
from inspe_jax.core.numerics import Softness
from inspe_jax.mounting.strategies import strategy
from inspe_jax.placement.candidates import poses
from inspe_jax.placement.methods import greedy, greedy_adam
from inspe_jax.placement.methods.adam import annealed, charted_score
from inspe_jax.placement.methods.greedy import GREEDY
from inspe_jax.placement.methods.projected_gradient import scaled_score
from inspe_jax.placement.methods.registry import GRADIENTS
from inspe_jax.placement.problem import Problem, take
from inspe_jax.placement.run import BudgetSpent, Run
from inspe_jax.scene.procedural.built_ins import built_in
from inspe_jax.scene.scene import build_scene
from inspe_jax.scoring.metrics import surrogate, weights_of
from inspe_jax.sensing.layout import Layout
from inspe_jax.visibility.centered_scene import poses_about_center

METHODS = {method.name: method for method in GRADIENTS}
BUDGET = {"adam": 140, "greedy-adam": 1800, "lbfgsb": 690, "projected-gradient": 1700}
"""Exact scores' work in which each takes several of its steps; where a score is known, 8 times."""
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
    return BUDGET[name] * (8 if isinstance(problem, Known) else 1)


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


@pytest.mark.parametrize(
    ("strategy_name", "ratios"), [("Cam-d1", (8, 23, 59)), ("L-d1", (6, 16, 41))]
)
def test_a_gradient_is_charged_by_the_size_of_its_sample(scene, strategy_name, ratios):
    """In hard scores of the same sample: those of GRADIENT_COST's docstring."""
    problem = Problem(scene, strategy(scene, strategy_name))
    for size, ratio in zip([(384, 3), (768, 6), (2048, 8)], ratios, strict=True):
        drawn = (tuple(map(np.arange, size)),)
        assert problem.gradient_cost(drawn) == pytest.approx(
            ratio * problem.sample_cost(drawn), abs=0.5 * problem.sample_cost(drawn)
        )


@pytest.mark.parametrize("name", FOLLOWING)
def test_every_method_is_charged_that_for_every_gradient(known, name, monkeypatch):
    """And its hard scores for the rest; nothing else."""
    due, charged = [], []

    def spied(cls, does, price):
        inner = getattr(cls, does)

        def call(self, *given):
            found = inner(self, *given)
            price(self, *given)
            return found

        monkeypatch.setattr(cls, does, call)

    def gradient(problem, poses, on, softness):
        sizes = len(on[0].centered.columns), len(on[0].centered.prisms.top)
        due.append(problem.gradient_cost((tuple(map(np.arange, sizes)),)))

    spied(Known, "slope", gradient)
    spied(Known, "rough", lambda problem, x, sample: due.append(len(x) * sample.cost))
    spied(Run, "charge", lambda run, evaluations: charged.append(evaluations))
    go(known, name)
    assert sum(due) == pytest.approx(sum(charged))
    assert len(due) > 10


def test_bursts_and_moves_gain_what_greedy_placement_left(ran):
    """Bursts are taken, else each pass has one; and passes gain, judged together or one by one."""
    states = [at.state for at in ran("greedy-adam")[1] if at.state]
    passes = [
        (before, after)
        for before, after in pairwise(states)
        if before["phase"] == after["phase"] == "improve"
    ]
    assert any(b["count"] > a["count"] + greedy_adam.BURST for a, b in passes)
    assert any(b["value"] > a["value"] for a, b in passes)
    for before, after in passes:
        assert after["value"] >= before["value"]


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_what_is_compiled_goes_with_its_problem(name):
    """Thousands of problems can be searched one after another: nothing outside keeps any."""
    scene = build_scene(built_in("four_way"), radius=15, voxel=2.0, frames=2, density=20)
    problem = Problem(scene, strategy(scene, "Cam-c"))
    run = Run(problem, problem.space.start(problem.layout)[0], evaluations=20_000)
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
    @jax.value_and_grad
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
    plain, slope_of_plain = expected(jnp.asarray(x, float))
    assert value == pytest.approx(float(plain), abs=2e-6)
    np.testing.assert_allclose(slope, scale * (np.asarray(slope_of_plain) @ slopes), atol=1e-5)


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
    first = next((n for n, row in enumerate(way) if (row.state or {}).get("phase") == "improve"), 0)
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
    """Placement, and passes of bursts and finer moves from there."""
    states = [at.state for at in ran("greedy-adam")[1] if at.state]
    order = list(dict.fromkeys(state["phase"] for state in states))
    assert order[:3] == ["look", "place", "improve"]
    assert max(state.get("count", 0) for state in states) > 0
    assert max(state.get("pass", 0) for state in states) > 1


class Flat(Problem):
    """A score without a slope: gradients are of nothing, and what they cost is not what counts."""

    def slope(self, poses, on, softness):
        return 0.5, np.zeros((len(poses), 6), jnp.zeros((), float).dtype)


@pytest.fixture(scope="module")
def small():
    return build_scene(built_in("four_way"), radius=15, voxel=2.0, frames=2, density=20)


def passes(problem, evaluations, method=METHODS["greedy-adam"]):
    """States of a method, one after another, while there is time for gradients."""
    run = Run(problem, problem.space.start(problem.layout)[0], evaluations=evaluations)
    run.offer(run.start)
    states = [method.begin(run)]
    with contextlib.suppress(BudgetSpent):
        while run.done < 0.8:
            states.append(method.step(run, states[-1]))
    return run, states


def test_one_burst_a_pass_where_they_gain_nothing(small, monkeypatch):
    """It is not taken, and the next one is shorter, until moves begin again at the widest. They do
    if they gained since they last did; else there is another round."""
    monkeypatch.setattr(greedy_adam, "NARROW", 0.5)  # after two passes that gain nothing
    run, states = passes(Flat(small, cameras(small)), 5000)
    moves = [state for state in states if state["phase"] == "improve"]
    first = [state for state in moves if state["round"] == 0]
    assert run.best > run.history[0].score
    assert len(first) > 3
    for k, state in enumerate(first):
        assert state["count"] == k * greedy_adam.BURST
    again = 0
    for before, after in pairwise(first):
        if after["width"] > before["width"]:
            again += 1
            assert after["value"] == after["widest"] > before["widest"]
            assert (after["width"], after["rate"]) == (greedy.WIDTH, greedy_adam.RATE)
        else:
            assert after["widest"] == before["widest"]
            assert after["rate"] == pytest.approx(before["rate"] * greedy_adam.CALMER)
    assert again
    more = Run(run.problem, run.start, evaluations=10**6)
    more.offer(more.start)
    stuck = first[-1] | dict(value=2.0, width=0.5)  # above any score
    step = METHODS["greedy-adam"].step
    wide = step(more, stuck | dict(widest=1.9))
    assert (wide["phase"], wide["width"], wide["widest"]) == ("improve", greedy.WIDTH, 2.0)
    ended = step(more, stuck | dict(widest=2.0))
    assert (ended["phase"], ended["round"]) == ("look", 1)


def test_where_no_sensor_is_aimed_it_is_greedy(small):
    """Score by score; and no gradient is compiled."""
    problem = Problem(small, strategy(small, "L-c"))
    assert not greedy.aimed(problem)
    assert greedy_adam.GRADIENT not in METHODS["greedy-adam"].ahead(
        Run(problem, problem.space.start(problem.layout)[0], seconds=1e6)
    )
    run, _ = passes(problem, 3000)
    other, _ = passes(problem, 3000, GREEDY)
    assert [row.score for row in run.history] == [row.score for row in other.history]
    assert run.best > run.history[0].score
    assert "slope" not in problem.known


def test_softness_falls_geometrically():
    assert annealed((3.0, 0.3), 0.0) == 3.0
    assert annealed((3.0, 0.3), 0.5) == pytest.approx(np.sqrt(0.9))
    assert annealed((3.0, 0.3), 2.0) == pytest.approx(0.3)
