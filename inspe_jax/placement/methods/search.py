"""The baselines that know no gradient: random, grid and CMA-ES; and greedy, from its own file.

They compete on equal terms with the gradient methods. Like them they look at a sample of
columns and frames, of the same size, and score exactly only what looks best on it. Layouts
that are compared share a sample, so that what it gets wrong it gets wrong for all alike;
the next comparison has a fresh one, so that nothing is chosen for one sample's luck.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float

from inspe_jax.placement.candidates import (
    COLUMNS,
    FRAMES,
    SPACING,
    above_ground,
    coordinates,
    lattice,
    project,
    set_heights,
)
from inspe_jax.placement.methods.greedy import GREEDY
from inspe_jax.placement.run import Method, Run, State
from inspe_jax.placement.space import Space

if TYPE_CHECKING:
    from cmaes import CMA

CHUNK = 32
"""Layouts in one step, which takes about half a second on a large scene."""


def _offer_better(
    run: Run, x: Float[np.ndarray, "M N"], scores: Float[np.ndarray, " M"], value: float
) -> tuple[int, float]:
    """Offer the best row on a sample, unless it is row 0, whose exact score is ``value``.

    Gives that row if its exact score is better, else row 0; and the exact score.
    """
    best = int(np.argmax(scores))
    if best and (exact := run.offer(x[best])) > value:
        return best, exact
    return 0, value


# ── Random ──────────────────────────────────────────────────────────────────


def begin_random(run: Run) -> State:
    """Nothing tried yet."""
    return {"count": 0, "x": np.array(run.best_x), "value": run.best}


def step_random(run: Run, state: State) -> State:
    """A batch of random feasible layouts beside the best so far."""
    count, problem = state["count"], run.problem
    tried = problem.space.random(run.rng(0, count), CHUNK - 1)
    x = np.concatenate([state["x"][None], tried])
    sample = problem.sample(run.rng(1, count), COLUMNS, FRAMES)
    best, value = _offer_better(run, x, run.rough(x, sample), state["value"])
    return {"count": count + 1, "x": x[best], "value": value}


# ── Grid ────────────────────────────────────────────────────────────────────

STEPS = {"yaw": np.pi / 4, "pitch": np.pi / 18, "height": 2.0}
"""Steps of the first grid [rad, rad, m]; every finer grid has half of the last one's."""
STANDS = 24
"""Feet on the first grid, at most."""
FINEST = 5
"""Times that the grid is made finer."""


def begin_grid(run: Run) -> State:
    """The start, before the first grid."""
    return {
        "x": np.array(run.best_x),
        "value": run.best,
        "level": 0,
        "sweep": 0,
        "block": 0,
        "moved": False,
        "scores": np.zeros(0),
    }


def step_grid(run: Run, state: State) -> State | None:
    """Some more points of the present block's grid; at its end the best are scored exactly.

    A grid over all sensors at once is out of the question: 24 feet, 8 yaws, 3 pitches and 3
    heights for each of 8 cameras are 10^26 layouts. So what is gridded is one block at a time,
    with all else as it is: for each sensor of a unit yaw × pitch × height, then where the unit
    stands and which way it is turned, then the next unit. Sweeps over all units follow until one
    brings nothing; then the grid is made finer, about the present layout.
    """
    problem = run.problem
    blocks = _blocks(problem.layout.members())
    x = _grid(problem.space, state["x"], blocks[state["block"]], state["level"])
    done, key = len(state["scores"]), (state["sweep"], state["block"])
    sample = problem.sample(run.rng(*key), COLUMNS, FRAMES)
    scores = np.append(state["scores"], run.rough(x[done : done + CHUNK], sample))
    if len(scores) < len(x):
        return state | {"scores": scores}
    best, value = _offer_better(run, x, scores, state["value"])
    moved = bool(state["moved"] or best)
    block = state["block"] + 1
    state = state | {"x": x[best], "value": value, "moved": moved, "block": block}
    state |= {"scores": np.zeros(0)}
    if block < len(blocks):
        return state
    level = state["level"] + (not moved)
    if level > FINEST:
        return None
    return state | {"level": level, "sweep": state["sweep"] + 1, "block": 0, "moved": False}


@dataclass(frozen=True)
class _Block:
    """What is gridded at a time: unit ``unit`` as a whole, or its ``sensor``."""

    unit: int
    sensors: tuple[int, ...]
    sensor: int | None = None


def _blocks(members: Sequence[tuple[int, ...]]) -> list[_Block]:
    return [_Block(u, sensors, s) for u, sensors in enumerate(members) for s in (*sensors, None)]


def _grid(space: Space, x: Float[np.ndarray, " N"], block: _Block, level: int) -> np.ndarray:
    """The present layout and after it the others of a block's grid, all feasible."""
    found = (_stand if block.sensor is None else _aim)(space, x, block, level)
    found = np.concatenate([x[None], found])
    # Some are the same once they are projected.
    first = np.unique(found.round(4), axis=0, return_index=True)[1]
    return found[np.sort(first)]


def _stand(space: Space, x: np.ndarray, block: _Block, level: int) -> np.ndarray:
    """Feet × turns of a whole unit: feet everywhere at first, then about the present one."""
    index = coordinates(space)
    if level:
        about = np.stack(np.meshgrid(*[np.arange(-2, 3)] * 2), -1).reshape(-1, 2)
        feet = x[index.base[block.unit]] + about * SPACING / 2**level
    else:
        feet = lattice(space, STANDS)
        feet = feet[space.can_stand(feet)[block.unit]]
    turns = STEPS["yaw"] / 2**level * (np.arange(-1, 2) if level else np.arange(8))
    found = np.tile(x, (len(feet), len(turns), 1))
    found[..., index.base[block.unit]] = feet[:, None]
    found[..., index.yaw[list(block.sensors)]] += turns[:, None]
    return project(space, found.reshape(-1, len(x)))


def _aim(space: Space, x: np.ndarray, block: _Block, level: int) -> np.ndarray:
    """Yaws all round at first, then about the present one × pitches × heights about theirs."""
    index, s = coordinates(space), block.sensor
    ranges = (np.arange(-2, 3) if level else np.arange(8), *[np.arange(-1, 2)] * 2)
    yaw, pitch, height = (
        np.stack(np.meshgrid(*ranges, indexing="ij"), -1).reshape(-1, 3).T / 2.0**level
    )
    found = np.tile(x, (len(yaw), 1))
    found[:, index.yaw[s]] += yaw * STEPS["yaw"]
    found[:, index.pitch[s]] += pitch * STEPS["pitch"]
    above = np.tile(above_ground(space, x)[list(block.sensors)], (len(yaw), 1))
    above[:, block.sensors.index(s)] += height * STEPS["height"]
    return set_heights(space, found, block.unit, block.sensors, above)


# ── CMA-ES ──────────────────────────────────────────────────────────────────

SPREAD = (0.5, 1.0)
"""Standard deviation of the first generation, in typical steps: from the start, after restarts."""
PULL = 2e-3
"""Score that a layout loses for each squared typical step outside the feasible set."""
LOOK = 10
"""Generations from one exact score to the next."""
FOLLOWED = 7
"""The generation's best that are looked at then, beside the strategy's mean."""
PATIENCE = 8
"""Exact scores without a better one after which a restart follows."""
NARROW = 0.01
"""… or the spread of a generation in every coordinate, in typical steps."""
SCREENED = 16
"""Random layouts of which the best is where a restart begins."""

_live: "WeakKeyDictionary[Run, tuple[tuple[int, int], CMA]]" = WeakKeyDictionary()
"""The strategy of each run with the (restart, generation) it has come to."""


def begin_cma(run: Run) -> State:
    """The start, before the first generation."""
    free = max(len(run.problem.space.free), 1)
    size = 4 + int(3 * np.log(free))  # Hansen's
    return _restart(run.start, 0, size)


def _restart(x: Float[np.ndarray, " N"], count: int, size: int) -> State:
    return {
        "restart": count,
        "from": np.array(x),
        "told": np.zeros((0, size)),
        "best": -np.inf,
        "waited": 0,
    }


def step_cma(run: Run, state: State) -> State | None:
    """One generation; now and then an exact score, and a restart where none got better.

    The variables are the free coordinates in typical steps from where the strategy began. What
    is asked may lie outside the feasible set; what is scored is the layout nearest to it, and
    what is told is the point that was asked for, with that score less a pull for its distance.
    Told the projections instead, the strategy would take its covariance for flat across the
    bounds. All of a generation share one sample, all that is used of their scores is their order,
    and the next generation has a fresh sample: the noise averages out over generations, and a
    sample held until the next restart would be fitted instead. Exactly scored is, every
    :data:`LOOK` generations, the best of the mean of the strategy and of the last generation.
    IPOP: restarts begin at the best of some random layouts with twice the population.
    """
    problem, told = run.problem, state["told"]
    if not len(problem.space.free):
        return None
    key = (state["restart"], len(told))
    strategy = _strategy(run, state)
    asked = np.array([strategy.ask() for _ in range(told.shape[1])])
    x, away = _layouts(run, state, asked)
    sample = problem.sample(run.rng(0, *key), COLUMNS, FRAMES)
    loss = PULL * away - run.rough(x, sample)
    strategy.tell(list(zip(asked, loss.tolist(), strict=True)))
    state = state | {"told": np.concatenate([told, loss[None]])}
    if (key[1] + 1) % LOOK == 0:
        mean = _layouts(run, state, strategy.mean[None])[0]
        state |= _look(run, state, np.concatenate([mean, x[np.argsort(loss)[:FOLLOWED]]]))
    narrow = asked.std(0).max() < NARROW
    if state["waited"] >= PATIENCE or narrow or strategy.should_stop():
        return _begin_again(run, state)
    _live[run] = ((key[0], key[1] + 1), strategy)
    return state


def _look(run: Run, state: State, x: Float[np.ndarray, "M N"]) -> State:
    sample = run.problem.sample(run.rng(1, state["restart"], len(state["told"])), COLUMNS, FRAMES)
    value = run.offer(x[np.argmax(run.rough(x, sample))])
    better = value > state["best"]
    return {"best": max(value, state["best"]), "waited": 0 if better else state["waited"] + 1}


def _begin_again(run: Run, state: State) -> State:
    count = state["restart"] + 1
    x = run.problem.space.random(run.rng(2, count), SCREENED)
    sample = run.problem.sample(run.rng(3, count), COLUMNS, FRAMES)
    return _restart(x[np.argmax(run.rough(x, sample))], count, 2 * state["told"].shape[1])


def _layouts(
    run: Run, state: State, z: Float[np.ndarray, "M n"]
) -> tuple[Float[np.ndarray, "M N"], Float[np.ndarray, " M"]]:
    """The feasible layout nearest to each point, and how far it is, in squared typical steps."""
    space = run.problem.space
    free, step = space.free, space.scale[space.free]
    x = np.tile(state["from"], (len(z), 1))
    x[:, free] += z * step
    inside = project(space, x)
    return inside, (((inside - x)[:, free] / step) ** 2).sum(1)


def _strategy(run: Run, state: State) -> "CMA":
    """The strategy as it stands; where it is not at hand, by asking and telling all over again.

    So a checkpoint needs only what was told, and goes on as if nothing had come between. It is
    taken out of the register, so that a generation cut short leaves none half asked.
    """
    from cmaes import CMA  # only here: its import takes a third as long as all others

    told, restart = state["told"], state["restart"]
    at, strategy = _live.pop(run, ((-1, -1), None))
    if strategy is not None and at == (restart, len(told)):
        return strategy
    strategy = CMA(
        mean=np.zeros(len(run.problem.space.free)),
        sigma=SPREAD[min(restart, 1)],
        population_size=told.shape[1],
        seed=int(run.rng(4, restart).integers(2**31)),
    )
    for losses in told:
        asked = [strategy.ask() for _ in losses]
        strategy.tell(list(zip(asked, losses.tolist(), strict=True)))
    return strategy


SEARCHES = (
    Method("grid", "one unit or sensor at a time, on ever finer grids", begin_grid, step_grid),
    Method("random", "random feasible layouts", begin_random, step_random),
    GREEDY,
    Method("cma-es", "evolution strategy with restarts", begin_cma, step_cma),
)
"""The baselines."""
