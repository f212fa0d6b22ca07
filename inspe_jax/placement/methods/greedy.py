"""The default search and the same without its gradient: greedy placement, then local search.

Greedy placement and a pass of exchanges find the poles, to which gradients cannot jump, among
candidates (:mod:`inspe_jax.placement.sampled_objective`). Bursts of Adam then move all sensors at
once: not in ``greedy``, not where no sensor is aimed, since there moves gain as much, and not where
the budget has no room. Moves of single units, judged hard, gain where the score has no slope. The
next round places some units of the best layout anew, with other candidates and another sample
(large neighbourhood search, Shaw 1998).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from inspe_jax.placement.candidate_table import AS_IT_IS, HEIGHTS, Picks, Table
from inspe_jax.placement.candidates import COLUMNS
from inspe_jax.placement.greedy_placement import exchange, lazy_greedy
from inspe_jax.placement.methods.adam import GRADIENT, Slope
from inspe_jax.placement.methods.local_search import (
    STEPS,
    LocalSearch,
    bursts_fit,
    charge,
    improve,
    sights,
)
from inspe_jax.placement.run import Method, Run

PLACE_COST, EXCHANGE_COST = 0.4, 0.2
"""In views: greedy placement, for each candidate; and exchanging a unit, for each candidate of each
of its sensors. Measured as :data:`~.local_search.VIEW_COST`."""
MOST = 0.5
"""Share of the units that a round takes out at most, if it is one or more; the first places all."""

GROWS = (
    "a sensor may add more to this objective the more others there are, or take away: greedy "
    "placement tries all candidates for every sensor, and where none adds anything alone, chance "
    "places the first; exchanges mend that"
)
"""A note of searches whose objective is not submodular."""


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class Placing:
    """Before the units ``out`` (U,) of the layout ``x`` (N,) are placed anew. ``part`` parts of the
    candidates were looked at; ``looked``: whether that is all of them."""

    round: int
    x: Float[np.ndarray, " N"]
    out: Bool[np.ndarray, " U"]
    part: int = 0
    looked: bool = False


@dataclass(frozen=True, eq=False)
class Exchanging:
    """All sensors are at the candidates ``picks`` (S,); next, ``unit`` chooses again, ``moved``
    have in this pass. ``x`` (N,) is the best layout of the round and ``value`` its exact score."""

    round: int
    x: Float[np.ndarray, " N"]
    value: float
    picks: Int[np.ndarray, " S"]
    unit: int = 0
    moved: int = 0


State = Placing | Exchanging | LocalSearch


def begin(run: Run) -> Placing:
    """The state that a search begins in: all units are placed."""
    return Placing(0, run.start, np.ones(len(run.problem.layout.units), bool))


def _again(run: Run, number: int) -> Placing:
    """Another round: some units of the best layout are placed anew."""
    rng, units = run.rng(3, number), len(run.problem.layout.units)
    out = np.zeros(units, bool)
    out[rng.permutation(units)[: rng.integers(1, max(1, int(MOST * units)) + 1)]] = True
    return Placing(number, run.best_x, out)


def step(run: Run, state: State, by: Slope | None = None) -> State:
    """A piece of a round, see the module; placing and exchanges end with an exact score."""
    if not _aimed(run):
        by = None
    match state:
        case LocalSearch():
            return improve(run, state, by) or _again(run, state.round + 1)
        case Placing() if not state.looked:
            return look(run, state)
        case Placing():
            found = place(run, state)
        case Exchanging():
            found = _exchange(run, state)
            through = isinstance(found, Exchanging) and not found.unit
            if through and (by is None or bursts_fit(run, by)):
                found = _local(found.round, found.x, found.value)
    if isinstance(found, LocalSearch):
        run.cache.pop("table", None)  # some 100 MB
    return found


def _local(number: int, x: Float[np.ndarray, " N"], value: float) -> LocalSearch:
    return LocalSearch(number, x, value, count=number * STEPS, widest=value)


def _aimed(run: Run) -> bool:
    return any(sensor.spec.aimed for sensor in run.problem.layout.sensors)


def _table(
    run: Run,
    number: int,
    x: Float[np.ndarray, " N"],
    kept: list[int],
    looked: int | None = None,
) -> Table:
    """A round's candidates beside ``kept`` sensors, ``looked`` parts or all looked at; cached."""
    held, table = run.cache.get("table", (-1, None))
    if held == number:
        looked = len(table.parts) if looked is None else looked
        if sum(len(kind.rows) for kind in table.kinds) == looked:
            return table
    times = 1 if _aimed(run) else 2
    sizes = times * COLUMNS, times * HEIGHTS
    table = Table.of(run.problem, run.rng(0, number), *sizes, first=number == 0)
    if kept:
        rows = sights(table.sampled, x)
        table.own, table.paid = {s: rows[s] for s in kept}, run.problem.pole_costs(x)
    for part in range(len(table.parts) if looked is None else looked):
        table.look(part)
    run.cache["table"] = number, table
    return table


def _kept(run: Run, state: Placing) -> list[int]:
    return [s for s, of in enumerate(run.problem.layout.sensors) if not state.out[of.unit]]


def look(run: Run, state: Placing) -> Placing:
    """Look at a further part of the candidates."""
    table, part = _table(run, state.round, state.x, _kept(run, state), state.part), state.part + 1
    own = len(run.problem.layout) if table.own and not state.part else 0
    charge(run, table.sampled, table.look(part - 1) + own)
    # A first layout soon: as soon as some candidates of every kind have been looked at.
    if state.round == 0 and part == len(table.kinds) < len(table.parts):
        _placed(run, table, state.x)
    return replace(state, part=part, looked=part == len(table.parts))


def place(run: Run, state: Placing) -> Exchanging | LocalSearch:
    """Place the units greedily at candidates looked at; exchanges follow if all found a place."""
    table = _table(run, state.round, state.x, _kept(run, state), state.part)
    sensors = range(len(run.problem.layout))
    views = PLACE_COST * sum(len(kind.foot) for kind in table.kinds)
    pay = partial(charge, run, table.sampled, views)
    if run.problem.submodular:
        pay()
    picks, x, value = _placed(
        run, table, state.x, (lambda: None) if run.problem.submodular else pay
    )
    if len(picks) < len(sensors):
        return _local(state.round, x, value)
    return Exchanging(state.round, x, value, np.array([picks[s] for s in sensors]))


def _placed(
    run: Run, table: Table, x: Float[np.ndarray, " N"], before: Callable[[], None] = lambda: None
) -> tuple[Picks, Float[np.ndarray, " N"], float]:
    """The candidates that greedy placement picks, their coordinates (N,) and exact score."""
    picks, _ = lazy_greedy(table, before)
    x = table.layout(x, picks)
    run.hold(x)
    return picks, x, run.offer(x)


def _exchange(run: Run, state: Exchanging) -> Exchanging | LocalSearch:
    kept = np.flatnonzero(state.picks == AS_IT_IS).tolist()
    table = _table(run, state.round, state.x, kept)
    members = run.problem.layout.members()[state.unit]
    looked = sum(len(table.kind_of(s).foot) for s in members)
    charge(run, table.sampled, EXCHANGE_COST * looked)
    before = dict(enumerate(state.picks.tolist()))
    picks = exchange(table, before, state.unit)
    if picks != before:
        run.hold(table.layout(state.x, picks))
    state = replace(
        state,
        picks=np.array([picks[s] for s in range(len(picks))]),
        moved=state.moved + (picks != before),
        unit=state.unit + 1,
    )
    if state.unit < len(run.problem.layout.units):
        return state
    if not state.moved:
        return _local(state.round, state.x, state.value)
    x, value = table.layout(state.x, picks), state.value
    if (score := run.offer(x)) > value:
        state = replace(state, x=x, value=score)
    return replace(state, unit=0, moved=0)


def method(name: str, summary: str, by: Slope | None) -> Method:
    """The search whose bursts follow such a slope."""
    states: tuple[type[Any], ...] = (Placing, Exchanging, LocalSearch)
    return Method(name, summary, states, begin, partial(step, by=by))


GREEDY = method("greedy", "greedy placement, then moves of single units: no gradient", None)
GREEDY_ADAM = method(
    "greedy-adam", "greedy placement, then Adam and moves of single units", GRADIENT
)
