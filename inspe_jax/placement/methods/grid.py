"""Grid search: one unit or sensor at a time, on ever finer grids."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from inspe_jax.placement.candidates import (
    BATCH,
    SPACING,
    above_ground,
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
    """The place of the search on the grid of one ``block`` of one ``sweep``. ``x`` (N,) is the
    present layout and ``value`` its exact score; ``scores`` are those of the grid so far; it was
    made finer ``level`` times; ``moved``: this sweep has found better."""

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

    A block is yaw × pitch × height of a sensor, or, after a unit's sensors, its foot × turns.
    Sweeps follow until one finds nothing better; the next grid, about that layout, is finer.
    """
    problem = run.problem
    members = problem.layout.members()
    blocks = [(u, s) for u, sensors in enumerate(members) for s in (*sensors, None)]
    x = _grid(problem.space, state.x, *blocks[state.block], state.level)
    done, key = len(state.scores), (state.sweep, state.block)
    scores = np.append(state.scores, run.rough(x[done : done + BATCH], *key))
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


def _grid(
    space: Space, x: Float[np.ndarray, " N"], unit: int, sensor: int | None, level: int
) -> Float[np.ndarray, "G N"]:
    """The present layout, and then the others of the grid of a unit or of its sensor; feasible."""
    found = _stand(space, x, unit, level) if sensor is None else _aim(space, x, unit, sensor, level)
    found = np.concatenate([x[None], found])
    # Projection may make some of them equal.
    first = np.unique(found.round(4), axis=0, return_index=True)[1]
    return found[np.sort(first)]


def _stand(space: Space, x: np.ndarray, u: int, level: int) -> np.ndarray:
    """Feet × turns of a whole unit. At level 0 feet are everywhere, then near the present foot."""
    index, sensors = space.index, list(space.given.members()[u])
    if level:
        about = np.stack(np.meshgrid(*[np.arange(-2, 3)] * 2), -1).reshape(-1, 2)
        feet = x[index.base[u]] + about * SPACING / 2**level
    else:
        feet = lattice(space, STANDS)
        feet = feet[space.can_stand(feet)[u]]
    turns = STEPS["yaw"] / 2**level * (np.arange(-1, 2) if level else np.arange(8))
    found = np.tile(x, (len(feet), len(turns), 1))
    found[..., index.base[u]] = feet[:, None]
    found[..., index.yaw[sensors]] += turns[:, None]
    return project(space, found.reshape(-1, len(x)))


def _aim(space: Space, x: np.ndarray, u: int, s: int, level: int) -> np.ndarray:
    """Yaws × pitches × heights of one sensor, near the present ones; at level 0 all yaws."""
    index, sensors = space.index, list(space.given.members()[u])
    ranges = (np.arange(-2, 3) if level else np.arange(8), *[np.arange(-1, 2)] * 2)
    yaw, pitch, height = (
        np.stack(np.meshgrid(*ranges, indexing="ij"), -1).reshape(-1, 3).T / 2.0**level
    )
    found = np.tile(x, (len(yaw), 1))
    found[:, index.yaw[s]] += yaw * STEPS["yaw"]
    found[:, index.pitch[s]] += pitch * STEPS["pitch"]
    above = np.tile(above_ground(space, x)[sensors], (len(yaw), 1))
    above[:, sensors.index(s)] += height * STEPS["height"]
    return set_heights(space, found, u, sensors, above)


GRID = Method(
    "grid", "one unit or sensor at a time, on ever finer grids", (GridState,), begin, step
)
