"""L-BFGS-B and projected gradients on the soft score, in rounds: these solvers cannot work with
noise, so a round keeps its sample and its softness, and ends when the solver ends."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from inspe_jax.core.arrays import on_host
from inspe_jax.placement.methods.adam import SOFTNESS, annealed, screened
from inspe_jax.placement.problem import Drawn
from inspe_jax.placement.run import Method, Run


@cache
def _jaxopt() -> Any:
    with warnings.catch_warnings():
        # On import it warns that it is no longer maintained; the parts used here are tested here.
        warnings.simplefilter("ignore", DeprecationWarning)
        import jaxopt
    return jaxopt


ROUND_COLUMNS, ROUND_FRAMES = 1536, 8
"""Size of the sample of one round: larger than Adam's, because a round keeps its sample."""
ITERATIONS = 8
"""Iterations of the solver in a round."""
TRUST = 2.0
"""How far a coordinate may go in one round of L-BFGS-B, in typical steps."""
_LAST_ROUND = 0.9  # share of the budget after which no new round begins


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class RoundState:
    """Coordinates ``x`` (N,) at the end of the last round, and the ``count`` of rounds."""

    x: Float[np.ndarray, " N"]
    count: int = 0


def begin(run: Run) -> RoundState:
    """The better of the given start and the best of some random ones."""
    x, scores = screened(run)
    return RoundState(x[scores.argmax()])


def _step(solve: Callable[..., np.ndarray], run: Run, state: RoundState) -> RoundState | None:
    """One round: a fresh sample, a softness, and some iterations of the solver on them."""
    done = run.done
    if done >= _LAST_ROUND:
        run.offer(state.x)
        return None
    drawn = run.problem.draw(run.rng(2, state.count), ROUND_COLUMNS, ROUND_FRAMES)
    softness = jnp.asarray(annealed(SOFTNESS, done / _LAST_ROUND), float)
    x = solve(run, state.x, (drawn, softness))
    run.offer(x)
    return RoundState(x, state.count + 1)


def charged(
    run: Run,
    drawn: Drawn,
    score: Callable[[Array], tuple[Array, Array]],
    layout: Callable[[Array], Float[np.ndarray, " N"]],
) -> Callable[[Array], tuple[Array, Array]]:
    """A loss and its slope, charged at every call; a better ``layout`` than the first is held."""
    best: float | None = None

    def evaluate(z: Array) -> tuple[Array, Array]:
        nonlocal best
        run.charge(run.problem.gradient_cost(drawn))
        loss, slope = score(z)
        if best is not None and loss < best:
            run.hold(layout(z))
        best = float(loss) if best is None else min(best, float(loss))
        return loss, slope

    return evaluate


# ── L-BFGS-B: in charts, within a box about the last round's end ────────────


def _lbfgsb(run: Run, x: np.ndarray, data: tuple) -> np.ndarray:
    problem = run.problem
    v, place = problem.chart(x)
    anchor, scale = on_host(v, float), problem.space.scale

    def layout(z: Any) -> np.ndarray:
        # The solver stays within its bounds, because it starts within them; but for rounding.
        z = np.clip(np.asarray(z), -TRUST, TRUST)
        return problem.space.from_chart(anchor + scale * z, place, np)

    # SciPy's solver through jaxopt's interface: jaxopt's own compiles for half a minute.
    solver = _jaxopt().ScipyBoundedMinimize(
        fun=charged(
            run,
            data[0],
            lambda z: problem.charted_loss(jnp.asarray(z, float), anchor, place, *data),
            layout,
        ),
        method="L-BFGS-B",
        value_and_grad=True,
        jit=False,
        maxiter=ITERATIONS,
        options={"maxfun": 2 * ITERATIONS},
    )
    still = np.zeros_like(anchor)
    return layout(solver.run(still, bounds=(still - TRUST, still + TRUST)).params)


LBFGSB = Method(
    "lbfgsb",
    "L-BFGS-B on the soft score in rounds, each on a fresh sample of the scene",
    (RoundState,),
    begin,
    partial(_step, _lbfgsb),
)

# ── Accelerated projected gradients: in coordinates divided by their scale ──


def _projected_gradient(run: Run, x: np.ndarray, data: tuple) -> np.ndarray:
    problem = run.problem
    scale = problem.nonzero_scale

    def project(z: Array) -> np.ndarray:
        return problem.space.project(scale * np.asarray(z, float), np)

    # All coordinates of a block, as a foot's, have one scale. So the nearest point is the same in
    # coordinates divided by their scale.
    solver = _jaxopt().ProjectedGradient(
        charged(run, data[0], lambda z: problem.scaled_loss(z, *data), project),
        projection=lambda z, _: jnp.asarray(project(z) / scale, float),
        value_and_grad=True,
        maxiter=ITERATIONS,
        maxls=6,
        implicit_diff=False,
        jit=False,  # its loops are Python's, as for L-BFGS-B: nothing of them is compiled
    )
    return project(solver.run(jnp.asarray(x / scale, float), None).params)


PROJECTED_GRADIENT = Method(
    "projected-gradient",
    "accelerated projected gradients on the soft score, in rounds",
    (RoundState,),
    begin,
    partial(_step, _projected_gradient),
)
