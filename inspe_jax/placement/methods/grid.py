"""Grid search: one unit or sensor at a time, on ever finer grids."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from inspe_jax.placement.candidates import (
    BATCH,
    COLUMNS,
    FRAMES,
    SPACING,
    above_ground,
    coordinates,
    lattice,
    project,
    set_heights,
)
from inspe_jax.placement.run import Method, Run
from inspe_jax.placement.space import Space

STEPS = {"yaw": np.pi / 4, "pitch": np.pi / 18, "height": 2.0}
"""Steps of the first grid [rad, rad, m]. Each finer grid has half the steps of the one before."""
STANDS = 24
"""Most feet on the first grid."""
FINEST = 5
"""How often the grid is made finer."""


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class GridState:
    """The place of the search on the grid of one block.

    ``x`` (N,) is the present layout and ``value`` its exact score. ``scores`` are those of the
    block's grid so far. ``level`` counts how often the grid was made finer. ``sweep`` and ``block``
    are the numbers of the sweep and of the block in it. ``moved`` tells whether this sweep has
    found anything better.
    """

    x: Float[np.ndarray, " N"]
    value: float
    scores: Float[np.ndarray, " G"]
    level: int = 0
    sweep: int = 0
    block: int = 0
    moved: bool = False


def begin(run: Run) -> GridState:
    """The start, before the first grid."""
    return GridState(np.array(run.best_x), run.best, np.zeros(0))


def step(run: Run, state: GridState) -> GridState | None:
    """Score some more points of the block's grid; score the best exactly when all are done.

    One block is searched at a time: yaw × pitch × height for each sensor of a unit, then where the
    unit stands and which way it is turned, then the next unit. Sweeps over all units follow until
    one finds nothing better. Then the grid is made finer, about the present layout.
    """
    problem = run.problem
    blocks = _blocks(problem.layout.members())
    x = _grid(problem.space, state.x, blocks[state.block], state.level)
    done, key = len(state.scores), (state.sweep, state.block)
    sample = problem.sample(run.rng(*key), COLUMNS, FRAMES)
    scores = np.append(state.scores, run.rough(x[done : done + BATCH], sample))
    run.hold(x[np.argmax(scores)])
    if len(scores) < len(x):
        return replace(state, scores=scores)
    best, value = run.offer_better(x, scores, state.value)
    moved = bool(state.moved or best)
    block = state.block + 1
    state = replace(state, x=x[best], value=value, moved=moved, block=block, scores=np.zeros(0))
    if block < len(blocks):
        return state
    level = state.level + (not moved)
    if level > FINEST:
        return None
    return replace(state, level=level, sweep=state.sweep + 1, block=0, moved=False)


@dataclass(frozen=True)
class _Block:
    """The coordinates of one grid: those of ``unit`` as a whole, or of its ``sensor``."""

    unit: int
    sensors: tuple[int, ...]
    sensor: int | None = None


def _blocks(members: Sequence[tuple[int, ...]]) -> list[_Block]:
    return [_Block(u, sensors, s) for u, sensors in enumerate(members) for s in (*sensors, None)]


def _grid(space: Space, x: Float[np.ndarray, " N"], block: _Block, level: int) -> np.ndarray:
    """The present layout, and then the other layouts of a block's grid; all are feasible."""
    found = (_stand if block.sensor is None else _aim)(space, x, block, level)
    found = np.concatenate([x[None], found])
    # Projection may make some of them equal.
    first = np.unique(found.round(4), axis=0, return_index=True)[1]
    return found[np.sort(first)]


def _stand(space: Space, x: np.ndarray, block: _Block, level: int) -> np.ndarray:
    """Feet × turns of a whole unit. At level 0 feet are everywhere, then near the present foot."""
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
    """Yaws × pitches × heights of one sensor, near the present ones; at level 0 all yaws."""
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


GRID = Method(
    "grid", "one unit or sensor at a time, on ever finer grids", (GridState,), begin, step
)
