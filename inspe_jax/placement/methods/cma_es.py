"""CMA-ES: an evolution strategy on samples of the score, with restarts (IPOP)."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from inspe_jax.placement.candidates import project
from inspe_jax.placement.run import Method, Run

SPREAD = (0.5, 1.0)
"""Standard deviation of the first generation, in typical steps: from the start, after restarts."""
PENALTY = 2e-3
"""Score that a layout loses for each squared typical step outside the feasible set."""
LOOK = 10
"""Generations from one exact score to the next."""
FOLLOWED = 7
"""How many of a generation's best are compared then, with the strategy's mean."""
PATIENCE = 8
"""Exact scores without a better one after which a restart follows."""
NARROW = 0.01
"""A restart also follows where a generation spreads less in all coordinates [typical steps]."""
SCREENED = 16
"""Random layouts of which the best is where a restart begins."""


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class CmaState:
    """The ``losses`` (G, P) of G generations of P since the last restart, its number, ``origin``
    (N,) and ``best`` exact score; and ``waited``, the exact scores since that."""

    restart: int
    origin: Float[np.ndarray, " N"]
    losses: Float[np.ndarray, "G P"]
    best: float = -np.inf
    waited: int = 0


def begin(run: Run) -> CmaState:
    """The start, before the first generation."""
    free = max(len(run.problem.space.free), 1)
    size = 4 + int(3 * np.log(free))  # Hansen's
    return CmaState(0, run.start, np.zeros((0, size)))


def step(run: Run, state: CmaState) -> CmaState | None:
    """One generation; sometimes an exact score; and a restart where scores stop to improve.

    1. The strategy asks for points, in typical steps of the free coordinates from where it began.
       The nearest feasible layouts are scored on one sample, less a penalty for their distance.
    2. Every :data:`LOOK` generations, and before a restart, the strategy's mean and the best of the
       generation are compared on another sample, and the best of them is scored exactly.
    3. A restart begins at the best of some random layouts, with twice the population (IPOP).
    """
    problem, losses = run.problem, state.losses
    if not len(problem.space.free):
        return None
    key = (state.restart, len(losses))
    strategy = _strategy(run, state)
    asked = np.array([strategy.ask() for _ in range(losses.shape[1])])
    x, away = _layouts(run, state, asked)
    loss = PENALTY * away - run.rough(x, 0, *key)
    strategy.tell(list(zip(asked, loss.tolist(), strict=True)))
    state = replace(state, losses=np.concatenate([losses, loss[None]]))
    narrow = asked.std(0).max() < NARROW or strategy.should_stop()
    if narrow or (key[1] + 1) % LOOK == 0:
        mean = _layouts(run, state, strategy.mean[None])[0]
        state = _look(run, state, np.concatenate([mean, x[np.argsort(loss)[:FOLLOWED]]]))
    if state.waited >= PATIENCE or narrow:
        count = state.restart + 1
        x = problem.space.random(run.rng(2, count), SCREENED)
        best = x[np.argmax(run.rough(x, 3, count))]
        return CmaState(count, best, np.zeros((0, 2 * losses.shape[1])))
    run.cache["strategy"] = (key[0], key[1] + 1), strategy
    return state


def _look(run: Run, state: CmaState, x: Float[np.ndarray, "M N"]) -> CmaState:
    """Score exactly the layout that is best on a sample."""
    value = run.offer(x[np.argmax(run.rough(x, 1, state.restart, len(state.losses)))])
    waited = 0 if value > state.best else state.waited + 1
    return replace(state, best=max(value, state.best), waited=waited)


def _layouts(
    run: Run, state: CmaState, z: Float[np.ndarray, "M n"]
) -> tuple[Float[np.ndarray, "M N"], Float[np.ndarray, " M"]]:
    """The feasible layout nearest to each point, and its distance in squared typical steps."""
    space = run.problem.space
    free, step = space.free, space.scale[space.free]
    x = np.tile(state.origin, (len(z), 1))
    x[:, free] += z * step
    inside = project(space, x)
    return inside, (((inside - x)[:, free] / step) ** 2).sum(1)


def _strategy(run: Run, state: CmaState) -> Any:
    """The strategy at this state. It leaves the cache: a generation may be cut short."""
    from cmaes import CMA  # only here: its import takes a third as long as all others

    losses, restart = state.losses, state.restart
    at, strategy = run.cache.pop("strategy", (None, None))
    if at == (restart, len(losses)):
        return strategy
    strategy = CMA(
        mean=np.zeros(len(run.problem.space.free)),
        sigma=SPREAD[min(restart, 1)],
        population_size=losses.shape[1],
        seed=int(run.rng(4, restart).integers(2**31)),
    )
    for generation in losses:
        asked = [strategy.ask() for _ in generation]
        strategy.tell(list(zip(asked, generation.tolist(), strict=True)))
    return strategy


CMA_ES = Method("cma-es", "evolution strategy with restarts", (CmaState,), begin, step)
