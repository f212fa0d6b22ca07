"""Local search: bursts of gradient steps of all sensors, and moves of single units judged hard."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
from jaxtyping import Float

from inspe_jax.placement.candidates import COLUMNS, FRAMES, of_unit, poses, project
from inspe_jax.placement.methods import adam
from inspe_jax.placement.methods.adam import Slope, advance, charted, layouts
from inspe_jax.placement.problem import Problem
from inspe_jax.placement.run import Run
from inspe_jax.placement.sampled_objective import LEAST, Rows, SampledObjective, joined, rows_at

WIDTH = 1.0
"""Length of the first moves, in typical steps."""
FINER = 0.6
"""What the width shrinks by where less than half of the units moved, or it was for nothing."""
NARROW = 0.1
"""Where moves get narrower, in typical steps, they and bursts begin again at the widest."""
ENOUGH = 0.003
"""Gain in score for which a round begins again at the widest moves, and does not end."""
TRIES, GENERATIONS = 7, 8
"""Moves of each unit that are tried at once, and how often for each sensor."""
UNTIL = 0.85
"""Share of the budget at which bursts end."""
BURST = 12
"""Gradient steps from one look at what they gain to the next."""
STEPS = 2**20
"""More gradient steps than a round has: those of the next are numbered from here on."""
SOFTNESS, RATE = 0.5, 0.3
"""Softness [m] and length of a step, in typical steps, of the first burst of a round."""
CALMER = 0.6
"""What both shrink by where a burst gained nothing."""
VIEW_COST = 0.6
"""What one sensor sees, in its share of a rough score: 0.25 to 0.5 with AVX-512, 0.8 to 0.9 with
AVX2."""
MOVE_COST = 1.5
"""A move of one sensor, in views."""

Sighted = tuple[Float[np.ndarray, " N"], dict[int, Rows]]
"""A layout, and what its sensors see of a sample."""


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class LocalSearch:
    """Before a pass of bursts and moves from the layout ``x`` (N,) with the exact score ``value``.

    Moves are at most ``width`` typical steps; the next burst has this ``softness`` [m] and
    ``rate``, and its first step the number ``count``. ``careful``: what is found is judged piece by
    piece, since a pass gained nothing. ``widest`` is the exact score when moves last were widest.
    """

    round: int
    x: Float[np.ndarray, " N"]
    value: float
    count: int
    widest: float
    width: float = WIDTH
    passes: int = 0
    softness: float = SOFTNESS
    rate: float = RATE
    careful: bool = False


def improve(run: Run, state: LocalSearch, by: Slope | None) -> LocalSearch | None:
    """Bursts while they gain, then moves of every unit, on a sample of its own; judged exactly
    together, or, once that gained nothing, piece by piece. None if no width gained
    :data:`ENOUGH`."""
    problem, key, careful = run.problem, (state.round, state.passes), state.careful
    sampled = SampledObjective(problem, problem.sample(run.rng(1, *key), COLUMNS, FRAMES))
    members = problem.layout.members()
    charge(run, sampled, len(problem.layout))
    first = state.x, sights(sampled, state.x)
    at, value, moved, start = first, state.value, 0, state.value
    if by is not None and bursts_fit(run, by):
        new, state = _bursts(run, state, sampled, first[1], by)
        at, value = _better(run, at, value, new) if careful else (new, value)
    new, rng = at, run.rng(2, *key)
    for k in range(GENERATIONS * max(map(len, members))):
        units = [u for u, sensors in enumerate(members) if k < GENERATIONS * len(sensors)]
        charge(run, sampled, MOVE_COST * TRIES * sum(len(members[u]) for u in units))
        before, new = new, finer(sampled, *new, units, state.width, rng, TRIES)
        if new[0] is not before[0]:
            run.hold(new[0])
    differs = new[0] != at[0]
    changed = [u for u in range(len(members)) if differs[of_unit(problem.space, u)].any()]
    if careful:
        for k, u in enumerate(changed):
            before = at
            run.hold(reduce(lambda on, v: with_unit(problem, on, new, v), changed[k:], at)[0])
            at, value = _better(run, at, value, with_unit(problem, at, new, u))
            moved += at is not before
    else:
        at, value = _better(run, first, value, new)
        moved = len(changed)
    gained = value > start
    width = state.width * (FINER if not gained or 2 * moved < len(members) else 1.0)
    careful |= not gained
    state = replace(state, x=at[0], value=value, passes=state.passes + 1, careful=careful)
    if width >= NARROW:
        return replace(state, width=width)
    if value <= state.widest + ENOUGH:
        return None
    return replace(state, widest=value, width=WIDTH, softness=SOFTNESS, rate=RATE)


def _better(run: Run, at: Sighted, value: float, new: Sighted) -> tuple[Sighted, float]:
    """The better of two layouts by their exact scores, of which one is known."""
    if new[0] is at[0] or (score := run.offer(new[0])) <= value:
        return at, value
    return new, score


def _bursts(
    run: Run, state: LocalSearch, sampled: SampledObjective, rows: dict[int, Rows], by: Slope
) -> tuple[Sighted, LocalSearch]:
    """Bursts of Adam until one gains nothing on the sample, of which the sensors see ``rows``, or
    does not fit. Returns the layout, and the state with what the next burst begins with."""
    problem, x = run.problem, state.x
    count, softness, rate = state.count, state.softness, state.rate
    while bursts_fit(run, by):
        start = charted(problem, x[None], np.zeros(1, int), count)
        after = advance(run, start, lambda: (softness, rate), BURST, by)
        count, new = after.count, layouts(problem, after)[0]
        charge(run, sampled, len(problem.layout))
        seen = sights(sampled, new)
        paid = (problem.pole_costs(new) - problem.pole_costs(x)).sum()
        if sampled.value(seen) - paid <= sampled.value(rows):
            break
        run.hold(new)
        x, rows = new, seen
    calmer = replace(state, count=count, softness=softness * CALMER, rate=rate * CALMER)
    return (x, rows), calmer


def bursts_fit(run: Run, by: Slope) -> bool:
    """Whether a burst ends before :data:`UNTIL`."""
    drawn = run.problem.draw(run.rng(0), adam.STEP_COLUMNS, adam.STEP_FRAMES)
    burst = BURST * by.cost(run.problem, drawn) * run.exact_cost
    return run.share(run.spent + burst) < UNTIL


def charge(run: Run, sampled: SampledObjective, views: float) -> None:
    """Charge for looking at what one sensor sees, so many times."""
    run.charge(views * VIEW_COST * sampled.sample.cost / len(run.problem.layout))


# ── Moves: random ones of single units, each judged on a sample ─────────────


def sights(sampled: SampledObjective, x: Float[np.ndarray, " N"]) -> dict[int, Rows]:
    """What the sensors of a layout see."""
    stand = poses(sampled.problem.space, x[None])[0]
    found = sampled.views({s: pose[None] for s, pose in enumerate(stand)})
    return {s: rows_at(rows, 0) for s, rows in found.items()}


def finer(
    sampled: SampledObjective,
    x: Float[np.ndarray, " N"],
    rows: dict[int, Rows],
    units: Sequence[int],
    width: float,
    rng: np.random.Generator,
    tries: int,
) -> tuple[Float[np.ndarray, " N"], dict[int, Rows]]:
    """For each of some units, the best of so many random moves of it and its sensors, if better.

    Each changes half of the unit's coordinates by 0.1 to 1 times ``width`` typical steps. All are
    looked at together; then each unit is judged in turn, beside the others as they are by then.
    """
    problem = sampled.problem
    space, members = problem.space, problem.layout.members()
    tried = np.tile(x, (len(units), tries, 1))
    for u, part in zip(units, tried, strict=True):
        at = of_unit(problem.space, u)
        at = at[space.scale[at] > 0]
        length = width * 10 ** rng.uniform(-1, 0, (tries, 1))
        moves = rng.normal(size=(tries, len(at))) * (rng.uniform(size=(tries, len(at))) < 0.5)
        part[:, at] += length * moves * space.scale[at]
    flat = project(space, tried.reshape(-1, space.size))
    tried = flat.reshape(tried.shape)
    stand = poses(space, flat)
    stand = stand.reshape(len(units), tries, *stand.shape[1:])
    new = sampled.views(
        {s: at[:, s] for u, at in zip(units, stand, strict=True) for s in members[u]}
    )
    for u, part in zip(units, tried, strict=True):
        choice = [joined([rows_at(rows[s], None), new[s]]) for s in members[u]]
        costs = problem.pole_costs(np.concatenate([x[None], part]))[:, u]
        at = np.tile(members[u], (1 + tries, 1))
        now, *scores = sampled.scores(rows, at, choice) - costs
        best = int(np.argmax(scores))
        if scores[best] > now + LEAST:
            moved = part[best], {s: rows_at(new[s], best) for s in members[u]}
            x, rows = with_unit(problem, (x, rows), moved, u)
    return x, rows


def with_unit(problem: Problem, at: Sighted, other: Sighted, u: int) -> Sighted:
    """A layout with unit ``u`` as another layout has it."""
    x, own = np.array(at[0]), of_unit(problem.space, u)
    x[own] = other[0][own]
    return x, at[1] | {s: other[1][s] for s in problem.layout.members()[u]}
