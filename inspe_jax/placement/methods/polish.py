"""A layout improved by bursts of Adam and by finer moves, whichever gained more of late.

Gradients move all sensors at once, at a small price, where the score has a slope. Finer moves are
judged hard, and gain where it has none, as where rays are further apart than voxels are wide. Which
of both pays depends on the sensors, the scene and how far the search has come, so the search
measures it: both end with an exact score.
"""

import numpy as np
from jaxtyping import Float, Int

from inspe_jax.placement.candidates import COLUMNS, FRAMES
from inspe_jax.placement.methods.adam import advance, charted, layouts
from inspe_jax.placement.methods.greedy import FINER, MOVE_COST, charge, finer, sights
from inspe_jax.placement.run import Run, State
from inspe_jax.placement.sample_score import SampleScore

ADAM, MOVES = 0, 1
"""The two arms: a burst of gradient steps, and a pass of finer moves over all units."""
BURST = 12
"""Gradient steps from one exact score to the next."""
SOFTNESS, RATE = 0.5, 0.3
"""Softness [m] and length of a step, in typical steps, of the first burst."""
CALMER = 0.6
"""What both shrink by where a burst gained nothing."""
WIDTH = 1.0
"""Width of the first finer moves, in typical steps; it shrinks by :data:`greedy.FINER`."""
TRIES, GENERATIONS = 8, 8
"""Moves of a unit that are tried at once, from the best so far, and how often for each sensor.

Eight times eight come as far as 64 at once in about half the charged work, on two scenes."""
MEMORY = 0.5
"""Share of an arm's gain that is remembered from before."""
RETRY = 8
"""An arm is tried again after so many turns without one."""
LEARNT = ("worth", "idle", "cost")
"""What a state knows of the arms, of use for other layouts too."""


def begin(x: Float[np.ndarray, " N"], value: float) -> State:
    """Before the first turn, from a layout and its exact score.

    ``worth`` (2,) is what each arm gains in the whole budget, at the pace of late; ``idle`` (2,)
    the turns since its last one; ``cost`` (2, 2) what that took, in seconds and evaluations;
    ``vain`` the turns in a row without a gain; ``path`` the best score after each turn.
    """
    return {
        "x": x,
        "value": value,
        "width": WIDTH,
        "softness": SOFTNESS,
        "rate": RATE,
        "worth": np.full(2, np.inf),
        "idle": np.zeros(2, int),
        "cost": np.zeros((2, 2)),
        "vain": 0,
        "path": np.zeros(0),
    }


def choose(
    worth: Float[np.ndarray, "2"], idle: Int[np.ndarray, "2"], possible: tuple[int, ...]
) -> int:
    """The arm of the next turn: one that was not tried for long, or the one that gains most."""
    overdue = [arm for arm in possible if idle[arm] >= RETRY]
    return max(overdue or possible, key=lambda arm: (worth[arm], idle[arm]))


def turn(run: Run, state: State, gradient: bool) -> State:
    """One turn: a burst or a pass of moves, as :func:`choose` says, then an exact score.

    A burst of Adam is possible only with ``gradient``. ``state`` is that of :func:`begin`, with
    ``count`` and ``passes`` added: the gradient steps and the passes of moves of the whole search
    so far. They select the random numbers. Near the end of the budget, an arm that would not reach
    its exact score in time is not chosen, unless no arm would.
    """
    left = 1.0 - run.share(run.spent)
    arms = (ADAM, MOVES) if gradient else (MOVES,)
    in_time = tuple(arm for arm in arms if run.share(state["cost"][arm]) <= left)
    arm = choose(state["worth"], state["idle"], in_time or arms)
    before = run.spent
    x, changed = (_burst, _moves)[arm](run, state)
    value = run.offer(x)
    gain = max(value - state["value"], 0.0)
    cost = run.spent - before
    worth, idle, costs = state["worth"].copy(), state["idle"] + 1, state["cost"].copy()
    pace = gain / max(run.share(cost), 1e-12)
    known = np.isfinite(worth[arm])
    worth[arm] = MEMORY * worth[arm] + (1 - MEMORY) * pace if known else pace
    idle[arm], costs[arm] = 0, cost
    state = state | changed | {"worth": worth, "idle": idle, "cost": costs}
    if gain > 0:
        state |= {"x": x, "value": value, "vain": 0}
    else:
        for key in ("softness", "rate") if arm == ADAM else ("width",):
            state[key] = state[key] * (CALMER if arm == ADAM else FINER)
        state["vain"] += 1
    return state | {"path": np.append(state["path"], state["value"])}


def _burst(run: Run, state: State) -> tuple[Float[np.ndarray, " N"], State]:
    """A burst of Adam, at rest at first; where it ends, and what is kept of it."""
    count = state["count"]
    start = charted(run.problem, state["x"][None]) | {"line": np.zeros(1, int), "count": count}
    after = advance(run, start, lambda: (state["softness"], state["rate"]), BURST)
    return layouts(run.problem, after)[0], {"count": after["count"]}


def _moves(run: Run, state: State) -> tuple[Float[np.ndarray, " N"], State]:
    """A pass of moves over the units, on a sample of its own; where it ends, and the next width."""
    problem, number = run.problem, state["passes"]
    tally = SampleScore(problem, problem.sample(run.rng(5, number), COLUMNS, FRAMES))
    x, members = state["x"], problem.layout.members()
    charge(run, tally, len(problem.layout))
    rows, moved = sights(problem, tally, x, range(len(problem.layout))), 0
    for u, sensors in enumerate(members):
        rng, before = run.rng(6, number, u), x
        for _ in range(GENERATIONS * len(sensors)):
            charge(run, tally, MOVE_COST * TRIES * len(sensors))
            x, rows = finer(problem, tally, x, rows, u, state["width"], rng, TRIES)
        moved += x is not before
    few = 2 * moved < len(members)
    return x, {"passes": number + 1, "width": state["width"] * (FINER if few else 1.0)}
