"""Greedy placement over candidate poses, with lazy evaluation; exchanges and finer moves after it.

What a candidate pose sees is found once, for one sensor and not for a whole layout; after that
any set of them is scored without geometry (:mod:`inspe_jax.placement.sampled_objective`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from inspe_jax.placement.candidate_table import HEIGHTS, Picks, Table
from inspe_jax.placement.candidates import COLUMNS, FRAMES, poses, project
from inspe_jax.placement.greedy_placement import exchange, lazy_greedy
from inspe_jax.placement.problem import Problem
from inspe_jax.placement.run import Method, Run
from inspe_jax.placement.sampled_objective import LEAST, Rows, SampledObjective, joined, rows_at

WIDTH = 1.0
"""Length of the first finer moves, in typical steps."""
FINER = 0.6
"""What the width shrinks by where less than half of the units moved, or it was for nothing."""
PASSES = 3
"""Passes over the units from one exact score to the next."""
VIEW_COST = 1.1
"""What one sensor sees of a sample, in a sensor's share of a rough score of it. This and the next
three are measured on 8 cameras, 4 LiDARs and both, 150,000 voxels."""
MOVE_COST, PLACE_COST, EXCHANGE_COST = 1.4, 0.45, 0.125
"""In views: a finer move of one sensor; placing all sensors greedily, for each candidate; and
exchanging a unit, for each candidate of each of its sensors."""

GROWS = (
    "a sensor may add more to this objective the more others there are, or take away: greedy "
    "placement tries all candidates for every sensor, and where none adds anything alone, chance "
    "places the first; exchanges mend that"
)
"""A note of searches whose objective is not submodular."""

Sighted = tuple[Float[np.ndarray, " N"], dict[int, Rows]]
"""A layout, and what its sensors see of a sample."""


class Effort(NamedTuple):
    """Columns of a sample, heights of candidates, finer moves of a unit tried in one step, and
    their length at which a round ends, in typical steps."""

    columns: int
    heights: int
    tries: int
    narrow: float


AIMED = Effort(COLUMNS, HEIGHTS, tries=63, narrow=0.02)
"""Where some sensor is aimed, as cameras are."""
LEVEL = Effort(2 * COLUMNS, 2 * HEIGHTS, tries=31, narrow=0.1)
"""Where none is."""


def aimed(problem: Problem) -> bool:
    """Whether some sensor is aimed."""
    return any(sensor.spec.aimed for sensor in problem.layout.sensors)


def _effort(problem: Problem) -> Effort:
    return AIMED if aimed(problem) else LEVEL


# ── Finer moves: random ones of single units, each judged on a sample ───────


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
        choice = [joined([rows_at(rows[s], None), new[s]]) for s in members[u]]
        costs = problem.pole_costs(np.concatenate([x[None], part]))[:, u]
        at = np.tile(members[u], (1 + tries, 1))
        now, *scores = sampled.scores(rows, at, choice) - costs
        best = int(np.argmax(scores))
        if scores[best] > now + LEAST:
            moved = part[best], {s: rows_at(new[s], best) for s in members[u]}
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


# ── The method ──────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class Placing:
    """Before a sensor is placed in a round; ``part`` parts of its candidates were looked at.

    ``looked``: whether that is all of them.
    """

    round: int = 0
    part: int = 0
    looked: bool = False


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class Exchanging:
    """All sensors are placed, at the candidates ``picks`` (S,); next, ``unit`` chooses again.

    ``x`` (N,) is the best layout of the round and ``value`` its exact score. ``moved`` units have
    chosen other candidates in this pass.
    """

    round: int
    x: Float[np.ndarray, " N"]
    value: float
    picks: Int[np.ndarray, " S"]
    unit: int = 0
    moved: int = 0


@dataclass(frozen=True, eq=False)
class Moving:
    """Next, finer moves of ``unit``, of at most ``width`` typical steps, after ``passes`` passes.

    ``x`` (N,) is the best layout of the round and ``value`` its exact score; ``now`` (N,) is the
    layout with the moves since that score, of which there are ``moved``.
    """

    round: int
    x: Float[np.ndarray, " N"]
    value: float
    now: Float[np.ndarray, " N"]
    width: float = WIDTH
    unit: int = 0
    moved: int = 0
    passes: int = 0


GreedyState = Placing | Exchanging | Moving


def step(run: Run, state: GreedyState) -> GreedyState:
    """A piece of a round.

    1. Look: find what the candidates see.
    2. Place sensors greedily.
    3. Exchange: take out unit after unit and put it back where it adds most, until nothing is
       gained.
    4. Move units by ever smaller steps, each pass on a fresh sample.

    Placing, every pass of exchanges and some passes of moves end with an exact score; moves that
    made it worse are taken back. The next round has another sample and other candidates.
    """
    match state:
        case Placing():
            return place(run, state) if state.looked else look(run, state)
        case Exchanging():
            return _exchange(run, state)
        case Moving():
            return _move(run, state)


def charge(run: Run, sampled: SampledObjective, views: float) -> None:
    """Charge for looking at what one sensor sees, so many times."""
    run.charge(views * VIEW_COST * sampled.sample.cost / len(run.problem.layout))


def _table(run: Run, number: int, looked: int | None = None) -> Table:
    """A round's candidates, with so many parts looked at, or all; from memory or once more."""
    held, table = run.cache.get("table", (-1, None))
    if held == number:
        looked = len(table.parts) if looked is None else looked
        if sum(len(kind.rows) for kind in table.kinds) == looked:
            return table
    wanted, rng = _effort(run.problem), run.rng(0, number)
    table = Table.of(run.problem, rng, wanted.columns, wanted.heights, first=number == 0)
    for part in range(len(table.parts) if looked is None else looked):
        table.look(part)
    run.cache["table"] = number, table
    return table


def look(run: Run, state: Placing) -> Placing:
    """Look at a further part of the candidates."""
    table, part = _table(run, state.round, state.part), state.part + 1
    charge(run, table.sampled, table.look(part - 1))
    # A first layout soon: as soon as some candidates of every kind have been looked at.
    if state.round == 0 and part == len(table.kinds) < len(table.parts):
        _placed(run, table)
    return replace(state, part=part, looked=part == len(table.parts))


def place(run: Run, state: Placing) -> Exchanging | Moving:
    """Place all sensors greedily at candidates looked at, and score the layout exactly.

    If some sensor found no place, candidates are not exchanged.
    """
    table, sensors = _table(run, state.round, state.part), range(len(run.problem.layout))
    views = PLACE_COST * sum(len(kind.foot) for kind in table.kinds)
    pay = partial(charge, run, table.sampled, views)
    if run.problem.submodular:
        pay()
    picks, x, value = _placed(run, table, (lambda: None) if run.problem.submodular else pay)
    if len(picks) < len(sensors):
        return Moving(state.round, x, value, x)
    return Exchanging(state.round, x, value, np.array([picks[s] for s in sensors]))


def _placed(
    run: Run, table: Table, before: Callable[[], None] = lambda: None
) -> tuple[Picks, Float[np.ndarray, " N"], float]:
    """The candidates that greedy placement picks, their coordinates (N,) and exact score."""
    picks, _ = lazy_greedy(table, before)
    x = table.layout(run.start, picks)
    run.hold(x)
    return picks, x, run.offer(x)


def _exchange(run: Run, state: Exchanging) -> Exchanging | Moving:
    table = _table(run, state.round)
    members = run.problem.layout.members()[state.unit]
    looked = sum(len(table.kind_of(s).foot) for s in members)
    passes = 1 if run.problem.submodular else 2  # then every foot is filled
    charge(run, table.sampled, EXCHANGE_COST * passes * looked)
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
        run.cache.pop("table")  # some 100 MB
        return Moving(state.round, state.x, state.value, state.x)
    x, value = table.layout(state.x, picks), state.value
    if (score := run.offer(x)) > value:
        state = replace(state, x=x, value=score)
    return replace(state, unit=0, moved=0)


def _move(run: Run, state: Moving) -> Moving | Placing:
    problem, u, wanted = run.problem, state.unit, _effort(run.problem)
    x, key = state.now, (state.round, state.passes, u)
    held, sampled, rows = run.cache.pop("pass", (None, None, None))
    if held != key:
        sampled = SampledObjective(
            problem, problem.sample(run.rng(1, *key[:2]), wanted.columns, FRAMES)
        )
        rows = sights(sampled, x)
    views = wanted.tries * len(problem.layout.members()[u])
    charge(run, sampled, (u == 0) * len(rows) + MOVE_COST * views)
    new, rows = finer(sampled, x, rows, (u,), state.width, run.rng(2, *key), wanted.tries)
    run.cache["pass"] = (*key[:2], u + 1), sampled, rows
    if new is not x:
        run.hold(new)
    moved = state.moved + (new is not x)
    state = replace(state, now=new, moved=moved, unit=u + 1)
    units = len(problem.layout.units)
    if u + 1 < units:
        return state
    state = replace(state, unit=0, passes=state.passes + 1)
    if state.passes % PASSES:
        return state
    better = bool(moved) and (value := run.offer(new)) > state.value
    if better:
        state = replace(state, x=new, value=value)
    narrower = not better or 2 * moved < units * PASSES
    width = state.width * (FINER if narrower else 1.0)
    if width < wanted.narrow:
        return Placing(state.round + 1)
    return replace(state, now=state.x, moved=0, width=width)


def begin(run: Run) -> Placing:
    """The state that a search begins in."""
    return Placing()


GREEDY = Method(
    "greedy",
    "sensor by sensor the best candidate pose, then exchanges and finer moves",
    (Placing, Exchanging, Moving),
    begin,
    step,
)
