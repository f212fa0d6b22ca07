"""Random moves of single units, each judged on a sample by what it adds beside all others."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from inspe_jax.placement.candidates import poses, project
from inspe_jax.placement.problem import Problem
from inspe_jax.placement.sample_score import LEAST, Rows, SampleScore

Sighted = tuple[Float[np.ndarray, " N"], dict[int, Rows]]
"""A layout, and what its sensors see of a sample."""


def sights(sampled: SampleScore, x: Float[np.ndarray, " N"]) -> dict[int, Rows]:
    """What the sensors of a layout see."""
    stand = poses(sampled.problem.space, x[None])[0]
    found = sampled.views({s: pose[None] for s, pose in enumerate(stand)})
    return {s: rows[0] for s, rows in found.items()}


def finer(
    sampled: SampleScore,
    x: Float[np.ndarray, " N"],
    rows: dict[int, Rows],
    units: Sequence[int],
    width: float,
    rng: np.random.Generator,
    tries: int,
) -> tuple[Float[np.ndarray, " N"], dict[int, Rows]]:
    """For each of some units, the best of so many random moves of it and its sensors, if better.

    Each changes half of the unit's coordinates, by 0.1 to 1 times ``width`` typical steps. What the
    sensors see after all these moves is found at once; then each unit is judged in turn, beside the
    others as they are by then.
    """
    problem = sampled.problem
    space, members = problem.space, problem.layout.members()
    tried = np.tile(x, (len(units), tries, 1))
    for u, part in zip(units, tried, strict=True):
        at = of_unit(problem, u)
        at = at[space.scale[at] > 0]
        length = width * 10 ** rng.uniform(-1, 0, (tries, 1))
        moves = rng.normal(size=(tries, len(at))) * (rng.uniform(size=(tries, len(at))) < 0.5)
        part[:, at] += length * moves * space.scale[at]
    flat = project(space, tried.reshape(-1, space.size))
    tried = flat.reshape(tried.shape)
    stand = poses(space, flat).reshape(len(units), tries, -1, 6)
    new = sampled.views(
        {s: at[:, s] for u, at in zip(units, stand, strict=True) for s in members[u]}
    )
    for u, part in zip(units, tried, strict=True):
        others = {s: row for s, row in rows.items() if s not in members[u]}
        choice = {s: Rows.joined([rows[s][None], new[s]]) for s in members[u]}
        now, *gains = sampled.gains(others, choice)
        best = int(np.argmax(gains))
        if gains[best] > now + LEAST:
            moved = part[best], {s: new[s][best] for s in members[u]}
            x, rows = with_unit(problem, (x, rows), moved, u)
    return x, rows


def of_unit(problem: Problem, u: int) -> Int[np.ndarray, " n"]:
    """The coordinates of a unit and its sensors: their indices."""
    index, members = problem.space.index, list(problem.layout.members()[u])
    own = [index.base[u], index.arm[u], index.height[[u]]]
    return np.concatenate([*own, *(part[members].ravel() for part in index[3:])])


def with_unit(problem: Problem, at: Sighted, other: Sighted, u: int) -> Sighted:
    """A layout with unit ``u`` as another layout has it."""
    x, own = np.array(at[0]), of_unit(problem, u)
    x[own] = other[0][own]
    return x, at[1] | {s: other[1][s] for s in problem.layout.members()[u]}
