"""CMA-ES: an evolution strategy on samples of the score, with restarts (IPOP)."""

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float

from inspe_jax.placement.candidates import COLUMNS, FRAMES, project
from inspe_jax.placement.methods.states import KEY, method_of
from inspe_jax.placement.run import Run

if TYPE_CHECKING:
    from cmaes import CMA

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
"""A restart also follows where a generation spreads less than this in every coordinate, in
typical steps."""
SCREENED = 16
"""Random layouts of which the best is where a restart begins."""

_live: "WeakKeyDictionary[Run, tuple[tuple[int, int], CMA]]" = WeakKeyDictionary()
"""The strategy of each run with the (restart, generation) it has come to."""


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class CmaState:
    """The losses that a strategy was told since its last restart, from which it can be made again.

    ``restart``, its number; ``origin`` (N,), the layout where it began; ``losses`` (G, P), those
    of G generations of P; ``best``, its best exact score; ``waited``, the exact scores
    since then.
    """

    restart: int
    origin: Float[np.ndarray, " N"] = field(metadata={KEY: "from"})
    losses: Float[np.ndarray, "G P"] = field(metadata={KEY: "told"})
    best: float = -np.inf
    waited: int = 0


def begin(run: Run) -> CmaState:
    """The start, before the first generation."""
    free = max(len(run.problem.space.free), 1)
    size = 4 + int(3 * np.log(free))  # Hansen's
    return _restart(run.start, 0, size)


def _restart(x: Float[np.ndarray, " N"], count: int, size: int) -> CmaState:
    return CmaState(count, np.array(x), np.zeros((0, size)))


def step(run: Run, state: CmaState) -> CmaState | None:
    """One generation; sometimes an exact score; and a restart where scores stop to improve.

    The variables are the free coordinates, in typical steps from where the strategy began. A point
    that the strategy asks for may lie outside the feasible set. Then the nearest feasible layout is
    scored, and the strategy is told that score, less a penalty for the distance, at the point it
    asked for. If it were told the projected points, its covariance would become flat across the
    bounds.

    All layouts of a generation share one sample, because only their order counts. The next
    generation has a fresh sample, so that noise averages out; a sample kept until the next restart
    would be fitted instead. Every :data:`LOOK` generations, and before a
    restart, the strategy's mean and the best of the last generation are compared, and the best of
    them is scored exactly.

    A restart begins at the best of some random layouts, with twice the population (IPOP).
    """
    problem, losses = run.problem, state.losses
    if not len(problem.space.free):
        return None
    key = (state.restart, len(losses))
    strategy = _strategy(run, state)
    asked = np.array([strategy.ask() for _ in range(losses.shape[1])])
    x, away = _layouts(run, state, asked)
    sample = problem.sample(run.rng(0, *key), COLUMNS, FRAMES)
    loss = PENALTY * away - run.rough(x, sample)
    strategy.tell(list(zip(asked, loss.tolist(), strict=True)))
    state = replace(state, losses=np.concatenate([losses, loss[None]]))
    narrow = asked.std(0).max() < NARROW or strategy.should_stop()
    if narrow or (key[1] + 1) % LOOK == 0:
        mean = _layouts(run, state, strategy.mean[None])[0]
        state = _look(run, state, np.concatenate([mean, x[np.argsort(loss)[:FOLLOWED]]]))
    if state.waited >= PATIENCE or narrow:
        return _begin_again(run, state)
    _live[run] = ((key[0], key[1] + 1), strategy)
    return state


def _look(run: Run, state: CmaState, x: Float[np.ndarray, "M N"]) -> CmaState:
    """Score exactly the layout that is best on a sample."""
    sample = run.problem.sample(run.rng(1, state.restart, len(state.losses)), COLUMNS, FRAMES)
    value = run.offer(x[np.argmax(run.rough(x, sample))])
    waited = 0 if value > state.best else state.waited + 1
    return replace(state, best=max(value, state.best), waited=waited)


def _begin_again(run: Run, state: CmaState) -> CmaState:
    count = state.restart + 1
    x = run.problem.space.random(run.rng(2, count), SCREENED)
    sample = run.problem.sample(run.rng(3, count), COLUMNS, FRAMES)
    return _restart(x[np.argmax(run.rough(x, sample))], count, 2 * state.losses.shape[1])


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


def _strategy(run: Run, state: CmaState) -> "CMA":
    """The strategy at this state; where it is not at hand, made again by asking and telling.

    So a checkpoint needs only what was told, and the search goes on as if it had not been stopped.
    The strategy is taken out of the register, so that a generation that is cut short leaves none
    behind that has asked and was not told.
    """
    from cmaes import CMA  # only here: its import takes a third as long as all others

    losses, restart = state.losses, state.restart
    at, strategy = _live.pop(run, ((-1, -1), None))
    if strategy is not None and at == (restart, len(losses)):
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


CMA_ES = method_of("cma-es", "evolution strategy with restarts", CmaState, begin, step)
