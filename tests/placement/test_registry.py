"""Adding a search method: one file and a row. Here the file is the first part of this test."""

from dataclasses import dataclass

import numpy as np
import pytest
from mounts import team

import inspe_jax
from inspe_jax.placement.candidates import project
from inspe_jax.placement.methods import registry
from inspe_jax.placement.optimise import compare, methods, optimise
from inspe_jax.placement.run import Method

# ── What the file of a method holds ─────────────────────────────────────────


@dataclass(frozen=True, eq=False)
class ClimbState:
    """The best layout so far and its exact score, after ``count`` trials."""

    x: np.ndarray
    value: float
    count: int = 0


def begin(run):
    return ClimbState(np.array(run.best_x), run.best)


def step(run, state):
    """Keep a random step of half a typical length if it scores better."""
    space = run.problem.space
    moved = state.x + 0.5 * space.scale * run.rng(state.count).normal(size=space.size)
    x = project(space, moved[None])[0]
    value = run.offer(x)
    if value <= state.value:
        x, value = state.x, state.value
    return ClimbState(x, value, state.count + 1)


TOY = Method("toy", "hill climbing by random steps", (ClimbState,), begin, step)

# ── Its row, and what follows from it ───────────────────────────────────────


@pytest.fixture(scope="module")
def layout(scene):
    return team(scene)


@pytest.fixture
def toy(monkeypatch):
    monkeypatch.setitem(registry.METHODS, "toy", TOY)


def test_a_row_is_all_that_a_method_needs(toy, scene, layout):
    assert methods()["toy"] == inspe_jax.methods()["toy"] == "hill climbing by random steps"
    found = optimise(scene, layout, method="toy", evaluations=25)
    assert found.method == "toy"
    assert found.objective > found.objective_before + 0.005
    assert found.evaluations == 25
    results = compare(scene, layout, ("toy",), evaluations=4, seeds=2)
    assert [(result.method, result.seed) for result in results] == [("toy", 0), ("toy", 1)]
