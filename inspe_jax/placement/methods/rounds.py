"""L-BFGS-B and projected gradients on the soft score, in rounds of one sample each.

These solvers search along a line and want no noise: a round holds its sample and its softness,
and ends where the solver does.
"""

import warnings
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from inspe_jax.core.arrays import on_host
from inspe_jax.placement.candidates import COLUMNS, FRAMES
from inspe_jax.placement.methods.adam import (
    SCREENED,
    SOFTNESS,
    Score,
    annealed,
    charted_score,
    score_through,
)
from inspe_jax.placement.problem import Problem, per_problem
from inspe_jax.placement.run import GRADIENT_COST, Method, Run, State

with warnings.catch_warnings():
    # It says on import that it is no longer maintained; what is used of it is old and tested here.
    warnings.simplefilter("ignore", DeprecationWarning)
    import jaxopt

ROUND_COLUMNS, ROUND_FRAMES = 1536, 8
"""Size of the sample of one round: these solvers search along a line and want no noise."""
ITERATIONS = 8
"""Iterations of the solver in a round."""
TRUST = 2.0
"""How far a coordinate may go in one round of L-BFGS-B, in typical steps."""
_ROUNDS_LAST = 0.9  # share of the budget after which no new round begins


def begin_rounds(run: Run) -> State:
    """The better of the given start and the best of some random ones."""
    problem = run.problem
    sample = problem.sample(run.rng(0), COLUMNS, FRAMES)
    x = np.concatenate([run.start[None], problem.space.random(run.rng(1), SCREENED)])
    return {"x": x[run.rough(x, sample).argmax()], "count": 0}


def _step_round(run: Run, state: State, solve: Callable[..., np.ndarray]) -> State | None:
    """One round: a fresh sample, a softness, and some iterations of a solver on it."""
    done = run.done
    if done >= _ROUNDS_LAST:
        run.offer(state["x"])
        return None
    problem = run.problem
    drawn = problem.draw(run.rng(2, state["count"]), ROUND_COLUMNS, ROUND_FRAMES)
    softness = jnp.asarray(annealed(SOFTNESS, done / _ROUNDS_LAST), float)
    x = solve(run, state["x"], (drawn, softness))
    run.offer(x)
    return state | {"x": x, "count": state["count"] + 1}


def step_lbfgsb(run: Run, state: State) -> State | None:
    """One round of L-BFGS-B in charts, within a box about the last round's end."""
    return _step_round(run, state, _solve_lbfgsb)


def _solve_lbfgsb(run: Run, x: np.ndarray, data: tuple) -> np.ndarray:
    problem = run.problem
    v, place = problem.space.chart(x)
    anchor, scale = on_host(v, float), problem.space.scale
    score = charted_score(problem)

    def evaluate(z: Array) -> tuple[Array, Array]:
        run.charge(GRADIENT_COST * problem.sample_cost(data[0]))
        return score(jnp.asarray(z, float), anchor, place, *data)

    # SciPy's solver through jaxopt's interface: jaxopt's own compiles for half a minute.
    solver = jaxopt.ScipyBoundedMinimize(
        fun=evaluate,
        method="L-BFGS-B",
        value_and_grad=True,
        jit=False,
        maxiter=ITERATIONS,
        options={"maxfun": 2 * ITERATIONS},
    )
    still = np.zeros_like(anchor)
    z = solver.run(still, bounds=(still - TRUST, still + TRUST)).params
    # It keeps its bounds from a start within them, as 0 is; rounding is mended.
    z = np.clip(np.asarray(z), -TRUST, TRUST)
    return problem.space.from_chart(anchor + scale * z, place, np)


def step_projected(run: Run, state: State) -> State | None:
    """One round of accelerated projected gradients, in coordinates divided by their scale."""
    return _step_round(run, state, _solve_projected)


def _solve_projected(run: Run, x: np.ndarray, data: tuple) -> np.ndarray:
    problem = run.problem
    scale, score = _nonzero_scale(problem), scaled_score(problem)

    def project(z: Array) -> np.ndarray:
        return problem.space.project(scale * np.asarray(z, float), np)

    def evaluate(z: Array) -> tuple[Array, Array]:
        run.charge(GRADIENT_COST * problem.sample_cost(data[0]))
        return score(z, *data)

    # Within each block, as a foot, one scale serves all coordinates: the nearest point is the
    # same in coordinates over their scale.
    solver = jaxopt.ProjectedGradient(
        evaluate,
        projection=lambda z, _: jnp.asarray(project(z) / scale, float),
        value_and_grad=True,
        maxiter=ITERATIONS,
        maxls=6,
        implicit_diff=False,
        jit=False,  # its loops are Python's, as for L-BFGS-B: nothing of them is compiled
    )
    return project(solver.run(jnp.asarray(x / scale, float), None).params)


@per_problem
def scaled_score(problem: Problem) -> Score:
    """What is minimised, and its slope, in coordinates divided by their scale."""
    scale = jnp.asarray(_nonzero_scale(problem), float)
    return score_through(problem, lambda z: problem.space.poses(scale * z))


def _nonzero_scale(problem: Problem) -> Float[np.ndarray, " N"]:
    return np.where(problem.space.scale > 0, problem.space.scale, 1.0)


ROUNDS = (
    Method(
        "lbfgsb",
        "L-BFGS-B on the soft score in rounds, each on a fresh sample of the scene",
        begin_rounds,
        step_lbfgsb,
    ),
    Method(
        "projected-gradient",
        "accelerated projected gradients on the soft score, in rounds",
        begin_rounds,
        step_projected,
    ),
)
