"""Accelerated projected gradients on the soft score, in coordinates divided by their scale."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from inspe_jax.placement.methods.adam import Score, score_through
from inspe_jax.placement.methods.solver_rounds import (
    ITERATIONS,
    charged,
    jaxopt,
    method_in_rounds,
)
from inspe_jax.placement.problem import Problem, per_problem
from inspe_jax.placement.run import Run


def _solve(run: Run, x: np.ndarray, data: tuple) -> np.ndarray:
    problem = run.problem
    scale, score = _nonzero_scale(problem), scaled_score(problem)

    def project(z: Array) -> np.ndarray:
        return problem.space.project(scale * np.asarray(z, float), np)

    # All coordinates of a block, as a foot's, have one scale. So the nearest point is the same in
    # coordinates divided by their scale.
    solver = jaxopt.ProjectedGradient(
        charged(run, data[0], lambda z: score(z, *data), project),
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


PROJECTED_GRADIENT = method_in_rounds(
    "projected-gradient",
    "accelerated projected gradients on the soft score, in rounds",
    _solve,
)
