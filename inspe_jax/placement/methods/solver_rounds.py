"""What L-BFGS-B and projected gradients share: rounds of one sample each on the soft score.

These solvers search along a line and cannot work with noise. So a round keeps its sample and its
softness, and ends when the solver ends.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from inspe_jax.placement.candidates import COLUMNS, FRAMES
from inspe_jax.placement.methods.adam import SCREENED, SOFTNESS, annealed
from inspe_jax.placement.problem import Drawn
from inspe_jax.placement.run import Method, Run

with warnings.catch_warnings():
    # On import it warns that it is no longer maintained; the parts used here are tested here.
    warnings.simplefilter("ignore", DeprecationWarning)
    import jaxopt as jaxopt  # the one import of it: the methods take it from here

ROUND_COLUMNS, ROUND_FRAMES = 1536, 8
"""Size of the sample of one round: larger than Adam's, because a round keeps its sample."""
ITERATIONS = 8
"""Iterations of the solver in a round."""
_LAST_ROUND = 0.9  # share of the budget after which no new round begins

Solve = Callable[[Run, np.ndarray, tuple[Any, Any]], np.ndarray]
"""A solver's run in one round: from coordinates (N,), on a sample and a softness, to others."""


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class RoundState:
    """Coordinates ``x`` (N,) at the end of the last round, and the ``count`` of rounds."""

    x: Float[np.ndarray, " N"]
    count: int = 0


def method_in_rounds(name: str, summary: str, solve: Solve) -> Method:
    """A row of the registry for a solver that works in rounds."""
    return Method(name, summary, (RoundState,), begin, lambda run, at: _step(run, at, solve))


def begin(run: Run) -> RoundState:
    """The better of the given start and the best of some random ones."""
    problem = run.problem
    sample = problem.sample(run.rng(0), COLUMNS, FRAMES)
    x = np.concatenate([run.start[None], problem.space.random(run.rng(1), SCREENED)])
    return RoundState(x[run.rough(x, sample).argmax()])


def _step(run: Run, state: RoundState, solve: Solve) -> RoundState | None:
    """One round: a fresh sample, a softness, and some iterations of the solver on them."""
    done = run.done
    if done >= _LAST_ROUND:
        run.offer(state.x)
        return None
    problem = run.problem
    drawn = problem.draw(run.rng(2, state.count), ROUND_COLUMNS, ROUND_FRAMES)
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
    """A loss and its slope, charged to the budget at every call.

    What is better than the first is held, in the coordinates (N,) that ``layout`` gives.
    """
    best: float | None = None

    def evaluate(z: Array) -> tuple[Array, Array]:
        nonlocal best
        run.charge_gradient(drawn)
        loss, slope = score(z)
        if best is not None and loss < best:
            run.hold(layout(z))
        best = float(loss) if best is None else min(best, float(loss))
        return loss, slope

    return evaluate
