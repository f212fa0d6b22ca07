"""Greedy placement, then bursts of Adam and finer moves: the default.

1. Greedy placement and one pass of exchanges find the poles: gradients cannot jump to another pole,
   candidates can.
2. Bursts of Adam move all sensors at once. Where the budget has no room for a burst, units are
   exchanged further instead.
3. Finer moves, judged hard, gain where the score has no slope.

With LiDARs alone it is :data:`~inspe_jax.placement.methods.greedy.GREEDY`, whose exchanges gain
more there.
"""

from dataclasses import dataclass, replace
from functools import reduce
from typing import Any

import numpy as np
from jaxtyping import Float

from inspe_jax.placement.candidates import COLUMNS, FRAMES
from inspe_jax.placement.methods import adam, greedy
from inspe_jax.placement.methods.adam import GRADIENT, Slope, advance, charted, layouts
from inspe_jax.placement.methods.greedy import FINER, MOVE_COST, Placing, Sighted, charge
from inspe_jax.placement.run import Method, Run
from inspe_jax.placement.sampled_objective import Rows, SampledObjective

UNTIL = 0.85
"""Share of the budget at which bursts of Adam end."""
BURST = 12
"""Gradient steps from one look at what they gain to the next."""
STEPS = 2**20
"""More gradient steps than a round has: those of the next are numbered from here on, and so are
the samples that they draw."""
SOFTNESS, RATE = 0.5, 0.3
"""Softness [m] and length of a step, in typical steps, of the first burst of a round."""
CALMER = 0.6
"""What both shrink by where a burst gained nothing."""
NARROW = 0.1
"""Where moves get narrower, in typical steps, they and bursts begin again at the widest."""
TRIES, GENERATIONS = 7, 8
"""Moves of each unit that are tried at once, and how often for each sensor."""


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class LocalSearch:
    """Before a pass of bursts and moves: ``x`` (N,) is the layout and ``value`` its exact score.

    Moves are at most ``width`` typical steps. The next burst has this ``softness`` [m] and
    ``rate``, in typical steps, and its first gradient step the number ``count``. ``careful``: what
    is found is judged exactly piece by piece, since a pass gained nothing. ``widest`` is the exact
    score when moves were last at their widest.
    """

    round: int
    x: Float[np.ndarray, " N"]
    value: float
    count: int
    widest: float
    width: float = greedy.WIDTH
    passes: int = 0
    softness: float = SOFTNESS
    rate: float = RATE
    careful: bool = False


def begin(run: Run) -> Any:
    """Before greedy placement."""
    return greedy.GREEDY.begin(run)


def step(run: Run, state: Any, by: Slope | None = GRADIENT) -> Any:
    """A piece of greedy placement, or a pass of bursts and moves; then the next round.

    Where bursts fit, they follow the first pass of exchanges: that gains the most, and after it
    they gain more in the same time. They follow the slope ``by``; without one there are none.
    """
    if not greedy.aimed(run.problem):
        return greedy.step(run, state)
    if isinstance(state, LocalSearch):
        return _pass(run, state, by)
    found = greedy.step(run, state)
    if isinstance(found, Placing):
        return found
    exchanged = isinstance(state, greedy.Exchanging) and found.unit == 0
    if isinstance(found, greedy.Moving) or (exchanged and (by is None or _bursts_fit(run, by))):
        run.cache.pop("table", None)  # of candidates, some 100 MB
        first = state.round * STEPS
        return LocalSearch(state.round, found.x, found.value, first, widest=found.value)
    return found


def _bursts_fit(run: Run, by: Slope) -> bool:
    """Whether a burst ends before :data:`UNTIL`."""
    drawn = run.problem.draw(run.rng(0), adam.STEP_COLUMNS, adam.STEP_FRAMES)
    burst = BURST * by.cost(run.problem, drawn) * run.exact_cost
    return run.share(run.spent + burst) < UNTIL


def _pass(run: Run, state: LocalSearch, by: Slope | None) -> Placing | LocalSearch:
    """Bursts while they gain, then moves of every unit, on a sample of its own; judged exactly.

    At first all together; once that gained nothing, the bursts and each unit's moves on their own.
    A round ends when moves of all widths, from the widest on, gained nothing.
    """
    problem, key, careful = run.problem, (state.round, state.passes), state.careful
    sampled = SampledObjective(problem, problem.sample(run.rng(1, *key), COLUMNS, FRAMES))
    members = problem.layout.members()
    charge(run, sampled, len(problem.layout))
    first = state.x, greedy.sights(sampled, state.x)
    at, value, moved, start = first, state.value, 0, state.value
    if by is not None and _bursts_fit(run, by):
        new, state = _bursts(run, state, sampled, first[1], by)
        at, value = _better(run, at, value, new) if careful else (new, value)
    new, rng = at, run.rng(2, *key)
    for k in range(GENERATIONS * max(map(len, members))):
        units = [u for u, sensors in enumerate(members) if k < GENERATIONS * len(sensors)]
        charge(run, sampled, MOVE_COST * TRIES * sum(len(members[u]) for u in units))
        before, new = new, greedy.finer(sampled, *new, units, state.width, rng, TRIES)
        if new[0] is not before[0]:
            run.hold(new[0])
    differs = new[0] != at[0]
    changed = [u for u in range(len(members)) if differs[greedy.of_unit(problem, u)].any()]
    if careful:
        for k, u in enumerate(changed):
            before = at
            run.hold(
                reduce(lambda on, v: greedy.with_unit(problem, on, new, v), changed[k:], at)[0]
            )
            at, value = _better(run, at, value, greedy.with_unit(problem, at, new, u))
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
    if value <= state.widest:  # since then, nothing was gained
        return Placing(state.round + 1)
    return replace(state, widest=value, width=greedy.WIDTH, softness=SOFTNESS, rate=RATE)


def _better(run: Run, at: Sighted, value: float, new: Sighted) -> tuple[Sighted, float]:
    """The better of two layouts by their exact scores, of which one is known."""
    if new[0] is at[0] or (score := run.offer(new[0])) <= value:
        return at, value
    return new, score


def _bursts(
    run: Run, state: LocalSearch, sampled: SampledObjective, rows: dict[int, Rows], by: Slope
) -> tuple[Sighted, LocalSearch]:
    """Bursts of Adam, each at rest at first, until one gains nothing on the sample or does not fit.

    Returns the layout, and the state with what the next burst begins with; ``rows`` are what the
    sensors see of the sample now.
    """
    problem, x = run.problem, state.x
    count, softness, rate = state.count, state.softness, state.rate
    while _bursts_fit(run, by):
        start = charted(problem, x[None], np.zeros(1, int), count)
        after = advance(run, start, lambda: (softness, rate), BURST, by)
        count, new = after.count, layouts(problem, after)[0]
        charge(run, sampled, len(problem.layout))
        seen = greedy.sights(sampled, new)
        paid = (problem.pole_costs(new) - problem.pole_costs(x)).sum()
        if sampled.value(seen) - paid <= sampled.value(rows):
            break
        run.hold(new)
        x, rows = new, seen
    calmer = replace(state, count=count, softness=softness * CALMER, rate=rate * CALMER)
    return (x, rows), calmer


GREEDY_ADAM = Method(
    "greedy-adam",
    "greedy placement, then Adam and finer moves; greedy with LiDARs only",
    (*greedy.GREEDY.states, LocalSearch),
    begin,
    step,
)
