"""Random search: many random feasible layouts, of which the best are scored exactly."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from inspe_jax.placement.candidates import BATCH
from inspe_jax.placement.run import Method, Run


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class RandomState:
    """``count`` batches done; the best layout so far ``x`` (N,) and its exact score ``value``."""

    count: int
    x: Float[np.ndarray, " N"]
    value: float


def begin(run: Run) -> RandomState:
    """The start; no batch done."""
    return RandomState(0, np.array(run.best_x), run.best)


def step(run: Run, state: RandomState) -> RandomState:
    """Compare a batch of random feasible layouts with the best so far."""
    count = state.count
    tried = run.problem.space.random(run.rng(0, count), BATCH - 1)
    x = np.concatenate([state.x[None], tried])
    best, value = run.offer_better(x, run.rough(x, 1, count), state.value)
    return RandomState(count + 1, x[best], value)


RANDOM = Method("random", "random feasible layouts", (RandomState,), begin, step)
