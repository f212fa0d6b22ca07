"""L-BFGS-B on the soft score: in charts, within a box about the last round's end."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from inspe_jax.core.arrays import on_host
from inspe_jax.placement.methods.adam import charted_score
from inspe_jax.placement.methods.solver_rounds import (
    ITERATIONS,
    charged,
    jaxopt,
    method_in_rounds,
)
from inspe_jax.placement.run import Run

TRUST = 2.0
"""How far a coordinate may go in one round, in typical steps."""


def _solve(run: Run, x: np.ndarray, data: tuple) -> np.ndarray:
    problem = run.problem
    v, place = problem.space.chart(x)
    anchor, scale = on_host(v, float), problem.space.scale
    score = charted_score(problem)

    def layout(z: Any) -> np.ndarray:
        # The solver stays within its bounds, because it starts within them; but for rounding.
        z = np.clip(np.asarray(z), -TRUST, TRUST)
        return problem.space.from_chart(anchor + scale * z, place, np)

    # SciPy's solver through jaxopt's interface: jaxopt's own compiles for half a minute.
    solver = jaxopt.ScipyBoundedMinimize(
        fun=charged(
            run, data[0], lambda z: score(jnp.asarray(z, float), anchor, place, *data), layout
        ),
        method="L-BFGS-B",
        value_and_grad=True,
        jit=False,
        maxiter=ITERATIONS,
        options={"maxfun": 2 * ITERATIONS},
    )
    still = np.zeros_like(anchor)
    return layout(solver.run(still, bounds=(still - TRUST, still + TRUST)).params)


LBFGSB = method_in_rounds(
    "lbfgsb",
    "L-BFGS-B on the soft score in rounds, each on a fresh sample of the scene",
    _solve,
)
