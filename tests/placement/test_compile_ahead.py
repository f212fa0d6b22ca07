"""What is compiled beside a search: that the search does not wait for it, and goes on with it."""

import subprocess
import sys
import threading
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from inspe_jax.mounting.strategies import strategy
from inspe_jax.placement.compile_ahead import Ahead
from inspe_jax.placement.methods import greedy_adam
from inspe_jax.placement.methods.greedy import GREEDY, Exchanging
from inspe_jax.placement.methods.greedy_adam import GRADIENT, GREEDY_ADAM, Improving
from inspe_jax.placement.problem import Problem
from inspe_jax.placement.run import BudgetSpent, Run
from inspe_jax.scene.procedural.built_ins import built_in
from inspe_jax.scene.scene import build_scene
from inspe_jax.sensing.layout import Layout

SECONDS = 2500.0
"""By a clock that counts work, so that a search repeats; several passes of finer moves."""


@pytest.fixture(scope="module")
def scene():
    return build_scene(built_in("four_way"), radius=15, voxel=2.0, frames=2, density=20)


class Late(Problem):
    """A gradient, of nothing, whose first one takes until ``go`` is set."""

    def __init__(self, scene):
        whole = strategy(scene, "Cam-d1")
        super().__init__(
            scene, Layout(whole.poses[:2], whole.sensors[:2], whole.units[:1], "two cameras")
        )
        self.go, self.callers = threading.Event(), []

    def slope(self, poses, on, softness):
        self.callers.append(threading.get_ident())
        assert self.go.wait(60)
        return 0.5, np.zeros((len(poses), 6), jnp.zeros((), float).dtype)


@pytest.fixture
def late(scene):
    problem = Late(scene)
    yield problem
    problem.go.set()


def search(problem, method, each=lambda run, state: None, **budget):
    """A method within a budget; ``each`` sees every state."""
    work = SimpleNamespace(evaluations=0.0)
    budget = budget or {"seconds": SECONDS}
    run = Run(
        problem, problem.space.start(problem.layout)[0], clock=lambda: work.evaluations, **budget
    )
    work = run
    try:
        run.compile_ahead(method)
        run.offer(run.start)
        state = method.begin(run)
        while state is not None:
            each(run, state)
            state = method.step(run, state)
    except BudgetSpent:
        pass
    finally:
        run.close()
    return run


def test_where_the_gradient_is_never_ready_units_are_exchanged_and_moved(late):
    """Score by score it is greedy placement, up to the first moves; those are its own."""
    states, scores = [], []

    def each(run, state):
        states.append(state)
        if isinstance(state, Improving):
            scores.append(len(run.history))
        if run.done >= greedy_adam.UNTIL:  # too late
            late.go.set()
            run.wait(GRADIENT)

    found = search(late, GREEDY_ADAM, each)
    assert len(late.callers) == 1  # and that one waits
    assert {type(state).__name__ for state in states} == {"Placing", "Exchanging", "Improving"}
    other = search(late, GREEDY)
    alike = [[row.score for row in run.history[: scores[0]]] for run in (found, other)]
    assert alike[0] == alike[1]
    assert scores[-1] > scores[0]
    assert not any(getattr(state, "count", 0) for state in states)  # of gradient steps


@pytest.mark.parametrize("phase", [Exchanging, Improving])
def test_adam_is_tried_as_soon_as_the_gradient_is_ready(late, phase):
    """From the best layout so far, whatever greedy placement is at."""
    states, at = [], []

    def each(run, state):
        states.append(state)
        if isinstance(state, phase) and not late.go.is_set():
            late.go.set()
            run.wait(GRADIENT)
            at.append((len(states), run.best))
        if at and len(states) > at[0][0] + 2:
            raise BudgetSpent

    search(late, GREEDY_ADAM, each)
    (number, best), *_ = at
    if phase is Exchanging:
        assert states[number].value == best
        number += 1
    assert isinstance(states[number], Improving)
    assert states[number].count == greedy_adam.BURST


def test_a_gradient_that_will_not_be_ready_in_time_is_not_begun(late, monkeypatch):
    monkeypatch.setattr(greedy_adam, "COMPILES", np.inf)
    run = Run(late, late.space.start(late.layout)[0], seconds=SECONDS)
    jobs = GREEDY_ADAM.ahead(run)
    run.offer(run.start)
    assert jobs[GRADIENT]() is False
    assert not late.callers


def test_nothing_is_done_beside_a_search_of_evaluations_or_once_it_is_compiled(late):
    late.go.set()
    search(late, GREEDY_ADAM, evaluations=1500.0)
    assert set(late.callers) == {threading.get_ident()}
    assert not GREEDY_ADAM.ahead(Run(late, late.space.start(late.layout)[0], seconds=1.0))


def test_an_error_there_is_one_of_the_search(late, monkeypatch):
    def broken(*_):
        raise ZeroDivisionError("of the gradient")

    monkeypatch.setattr(late, "slope", broken)
    with pytest.raises(ZeroDivisionError, match="of the gradient"):
        search(late, GREEDY_ADAM)


def test_jobs_are_done_in_turn_and_none_is_begun_after_the_end():
    go, begun = threading.Event(), []

    def job(name, result=True):
        begun.append(name)
        assert go.wait(60)
        return result

    ahead = Ahead({"a": lambda: job("a"), "b": lambda: job("b", False), "c": lambda: job("c")})
    assert not ahead.ready("a")
    assert ahead.ready("of no job")
    ahead.wait("of no job")
    stopped = Ahead({"d": lambda: job("d")})
    stopped.close()
    go.set()
    for name in "abc":
        ahead.wait(name)
    assert [ahead.ready(name) for name in "abc"] == [True, False, True]
    assert not stopped.ready("d")
    assert begun == ["a", "b", "c"]


@pytest.mark.parametrize("double", [False, True])
def test_it_compiles_for_the_precision_of_the_search(double):
    switch = jax if hasattr(jax, "enable_x64") else jax.experimental
    with switch.enable_x64(double):
        ahead = Ahead(
            {"a": lambda: jax.dtypes.canonicalize_dtype(float).itemsize == 4 + 4 * double}
        )
        ahead.wait("a")
        assert ahead.ready("a")


def test_the_end_of_the_process_waits_for_xla():
    """A job that is in C and comes back to Python, as XLA does."""
    code = (
        "import time; from inspe_jax.placement.compile_ahead import Ahead\n"
        "Ahead({'a': lambda: time.sleep(0.5) or print('over', flush=True) or True})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (0, "over\n")
