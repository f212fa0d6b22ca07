"""The gradient methods: that they climb, that a seed repeats, that a checkpoint goes on."""

import gc
import io
import weakref
from functools import cache, partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mounts import assert_mountable, lanes_of
from worlds import slow_but

from inspe_jax.measures import measure
from inspe_jax.metrics import surrogate
from inspe_jax.numerics import Softness
from inspe_jax.placement import greedy_adam
from inspe_jax.placement.adam import annealed
from inspe_jax.placement.gradient import GRADIENTS
from inspe_jax.placement.problem import Problem, take
from inspe_jax.placement.run import BudgetSpent, Run
from inspe_jax.placement.strategies import strategy
from inspe_jax.scene.procedural import built_in
from inspe_jax.scene.scene import build_scene
from inspe_jax.sensing.layout import Layout

METHODS = {method.name: method for method in GRADIENTS}
WHERE = slow_but(METHODS, *(name for name in METHODS if name != "adam"))
"""All of them; where there is little time, Adam as a part of greedy-adam."""
BUDGET = {"adam": 120, "greedy-adam": 1000, "lbfgsb": 150, "projected-gradient": 600}
"""Exact scores' work in which each takes several of its steps."""


@pytest.fixture(scope="module")
def problem():
    """Two cameras on one unit and one on another, turned away from the junction."""
    scene = build_scene(built_in("four_way"), radius=40, voxel=1.0, frames=8, density=20)
    whole = strategy(scene, "Cam-d1")
    poses = np.asarray(whole.poses)[:3] + [0, 0, 0, 0, 0, 2.0]
    return Problem(scene, Layout(poses, whole.sensors[:3], whole.units[:2], "away"))


def go(problem, name, seed=0, state=None, run=None, steps=10**9):
    """A method from its start or a state: the run, and every state on the way."""
    method = METHODS[name]
    if run is None:
        start = problem.space.start(problem.layout)[0]
        run = Run(problem, start, seed=seed, evaluations=BUDGET[name])
        run.offer(run.start)
    states = []
    try:
        state = method.begin(run) if state is None else state
        states.append(state)
        while state is not None and len(states) <= steps:
            state = method.step(run, state)
            states.append(state)
    except BudgetSpent:
        pass
    return run, states


@pytest.fixture(scope="module")
def ran(problem):
    """A method's run and states, of which those are worked out that are asked for."""
    return cache(partial(go, problem))


@pytest.mark.parametrize("name", WHERE)
def test_it_climbs_to_a_layout_that_can_be_mounted(problem, ran, name):
    run, _ = ran(name)
    assert run.best > run.history[0].score + 0.05
    found = problem.space.layout(run.best_x)
    assert problem.exact_of(found) == pytest.approx(run.best, abs=1e-6)
    scene = problem.cases[0].scene
    assert_mountable(scene, found, lanes_of(scene.intersection))


def test_a_burst_of_gradients_gains_what_greedy_placement_left(ran):
    """Every exact score between the state of one burst and of the next is Adam's."""
    _, states = ran("greedy-adam")
    bursts = [state for state in states if "line" in state]
    assert len(bursts) > 1
    assert any(state["vain"] == 0 and len(state["path"]) for state in bursts)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in METHODS if name != "projected-gradient"])
def test_what_is_compiled_goes_with_its_problem(name):
    """Thousands of problems can be searched one after another: nothing outside keeps any.

    But JAX's caches keep what jaxopt compiled for projected gradients, until they are cleared.
    """
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
def test_a_soft_sample_is_every_vehicle_against_every_column(problem):
    """What gradients are of, against the same measures in the open; to rounding."""
    fields = take(problem.fields, problem.draw(np.random.default_rng(0), 300, 3))
    x = jnp.asarray(problem.space.random(np.random.default_rng(1), 1)[0], float)
    crew = problem.crews[0]

    @jax.jit
    def expected(poses):
        found = measure(fields[0], poses, crew, 1.0, Softness.of(0.5))
        return surrogate(found.coverage, found.occlusion, found.information_gain)[0]

    value = jax.jit(problem.soft)(x, fields, jnp.asarray(0.5, float))
    assert 0.1 < value < 0.99
    assert value == pytest.approx(float(expected(problem.space.poses(x))), abs=2e-6)


@pytest.mark.parametrize("name", slow_but(METHODS, "greedy-adam"))
def test_a_seed_repeats_and_another_does_not(problem, ran, name):
    first = [row.score for row in ran(name)[0].history]
    assert [row.score for row in go(problem, name)[0].history] == first
    assert [row.score for row in go(problem, name, seed=1)[0].history] != first


@pytest.mark.parametrize(
    ("name", "at"),
    [("lbfgsb", 0.5), ("greedy-adam", "before"), ("greedy-adam", "after")]
    + [pytest.param(name, 0.5, marks=pytest.mark.slow) for name in METHODS if name != "lbfgsb"],
)
def test_from_a_checkpoint_it_goes_on_as_if_nothing_had_come_between(problem, ran, name, at):
    """From half way, and about the draft's burst, through a file: no pickle, all as it was."""
    whole, states = ran(name)
    steps = len(states) // 2 if at == 0.5 else drafted(states) - (at == "before")
    part, (*_, state) = go(problem, name, steps=steps)
    file = io.BytesIO()
    np.savez(file, **state)
    file.seek(0)
    with np.load(file, allow_pickle=False) as held:
        read = {k: held[k] for k in held.files}
    state = {k: v.item() if v.ndim == 0 else v for k, v in read.items()}
    again = Run(problem, part.start, seed=0, evaluations=BUDGET[name])
    again.take_up(part.seconds, part.evaluations, part.history, part.path)
    go(problem, name, state=state, run=again)
    assert [row.score for row in again.history] == [row.score for row in whole.history]


@pytest.mark.slow
def test_with_a_larger_budget_it_goes_on_in_shares_of_that(problem, ran):
    """Adam looks at an exact score after each 0.15 of the budget, not of the one it had before."""
    part, states = ran("adam")
    state = states[-1] or states[-2]
    again = Run(problem, part.start, seed=0, evaluations=5 * BUDGET["adam"])
    again.take_up(part.seconds, part.evaluations, part.history, part.path)
    while len(again.history) == len(part.history):
        state = METHODS["adam"].step(again, state)
    assert again.evaluations < part.evaluations + 0.3 * again.limits[1]


def test_greedy_adam_goes_through_all_its_parts(ran):
    """Placement, gradient steps from there, and finer moves after them."""
    _, states = ran("greedy-adam")
    parts = ["adam" if "line" in s else s["greedy phase"] for s in states if s]
    assert list(dict.fromkeys(parts)) == ["look", "place", "exchange", "adam", "move"]


def drafted(states):
    """Number of the first state after the draft's burst."""
    return next(n for n, state in enumerate(states) if state["draft"] < np.inf)


def test_the_first_draft_has_a_burst_of_its_own(ran):
    """It gains, and placement goes on where it stood."""
    run, states = ran("greedy-adam")
    at = drafted(states)
    before, after = states[at - 1], states[at]
    _, draft, burst = run.history[:3]
    assert draft.best == after["draft"] < burst.score
    assert after["count"] == greedy_adam.BURST
    differ = {key for key in before if not np.array_equal(before[key], after[key])}
    assert differ == {"count", "drafted", "draft", "aside", "began"}
    assert before.keys() == after.keys()


@pytest.mark.parametrize(
    ("round", "draft", "begins"),
    [
        (0, np.inf, "best"),  # no burst: placement may be behind the start
        (0, 0.6, "placed"),  # the best is the draft's after its burst
        (0, 0.8, "best"),  # the best is the start's after the draft's burst
        (1, 0.6, "placed"),
    ],
)
def test_adam_begins_where_placement_ended_unless_that_is_behind(problem, round, draft, begins):
    start = problem.space.start(problem.layout)[0]
    at = {"best": start, "placed": problem.space.random(np.random.default_rng(0), 1)[0]}
    run = SimpleNamespace(problem=problem, best_x=start, best=0.9, spent=np.zeros(2))
    placing = {"phase": "move", "round": round, "x": at["placed"], "value": 0.7}
    began = greedy_adam._before_adam(run, {"draft": draft}, placing)
    np.testing.assert_array_equal(began["x"], at[begins])
    assert began["value"] == {"best": 0.9, "placed": 0.7}[begins]


def test_rounds_go_on_while_there_is_time_for_another():
    """The last took 0.1 of the budget to place and 0.05 a burst: the next is on trial for 0.25."""
    state = {"polished": 0, "count": 0, "pace": np.ones(2), "path": np.ones(2)}
    state |= {"greedy round": 0, "greedy phase": "move"}
    state |= {"drafted": False, "draft": np.inf, "aside": np.zeros(1)}
    for began, then in ((0.2, "look"), (0.3, "move")):
        state |= {"began": np.array([began]), "placed": np.array([began + 0.1])}
        spent = np.array([began + 0.2])
        run = SimpleNamespace(spent=spent, share=lambda s: s[0], best_x=np.zeros(3), best=0.5)
        after = greedy_adam._after_adam(run, state)
        assert (after["greedy phase"], after["greedy round"]) == (then, then == "look")


def test_softness_falls_geometrically():
    assert annealed((3.0, 0.3), 0.0) == 3.0
    assert annealed((3.0, 0.3), 0.5) == pytest.approx(np.sqrt(0.9))
    assert annealed((3.0, 0.3), 2.0) == pytest.approx(0.3)
