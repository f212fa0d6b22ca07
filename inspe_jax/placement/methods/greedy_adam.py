"""Greedy placement, Adam from there, and finer moves of the best: the default.

Candidates find the places, which gradients do not jump between; gradients the poses, which
candidates do not resolve; and the moves, which are judged hard, what the soft score cannot tell.
One burst of gradients from the first draft says early what they will find.
"""

import numpy as np

from inspe_jax.placement.compile_ahead import CompileJob
from inspe_jax.placement.methods import greedy
from inspe_jax.placement.methods.adam import advance, charted, charted_again, layouts
from inspe_jax.placement.run import Method, Run, State

DRAFT = 0.05
"""Share of the budget within which the first draft must be had for a burst from there."""
BEFORE = 0.5
"""Share of the budget, less that burst, at which Adam takes over at the latest."""
AGAIN = 0.7
"""Another round is begun if it will be on trial until this share of the budget."""
UNTIL = 0.85
"""Share of the budget after which Adam is not given more than one burst."""
BURST = 24
"""Gradient steps from one exact score to the next."""
SOFTNESS, RATE = 0.5, 0.3
"""Softness [m] and length of a step, in typical steps, of the first burst."""
CALMER = 0.6
"""What both shrink by where a burst was for nothing."""
VAIN = 3
"""A round ends after so many bursts in a row that were for nothing, …"""
TRIAL = 3
"""… or if it is behind the best round after as many bursts, of this many at least."""
COMPILES = 1.5
"""How long the gradient compiles beside greedy placement, in what all that came before took."""
WIDTH = 0.36
"""Width of the first finer moves, in typical steps."""

GRADIENT = "gradient"
"""What is compiled ahead, after what greedy placement needs."""

_WITHIN = "greedy "  # what a state of greedy placement has before its keys


def begin(run: Run) -> State:
    """Before greedy placement."""
    return {
        "polished": -1,
        "count": 0,
        "pace": np.full(1, -np.inf),
        "began": run.spent,
        "drafted": False,
        "draft": np.inf,
        "aside": np.zeros(2),
    } | _within(greedy.begin(run))


def ahead(run: Run) -> dict[str, CompileJob]:
    """What greedy placement needs compiled; then the gradient, if it will be of use in time."""
    jobs, problem, began = greedy.ahead(run), run.problem, run.spent
    if "slope" in problem.known:
        return jobs
    _ = problem.arrays

    def gradient() -> bool:
        took = run.spent - began
        if run.share(run.spent + COMPILES * took) >= UNTIL:
            return False
        trial = Run(problem, run.start, evaluations=np.finfo(float).max)
        burst = charted(problem, run.start[None]) | {"line": np.zeros(1, int), "count": 0}
        advance(trial, burst, lambda: (SOFTNESS, RATE), 1)
        return True

    return jobs | {GRADIENT: gradient}


def _has_gradients(run: Run, state: State) -> bool:
    """Whether there is a gradient: not while it compiles, nor where that took too long.

    Until there is, the search is greedy placement, step by step.
    """
    too_late = state["polished"] < 0 and run.done >= UNTIL
    return run.ready(GRADIENT) and not too_late


def step(run: Run, state: State) -> State | None:
    """Rounds of greedy placement, exchanges and Adam; then finer moves, and rounds again.

    A round has other candidates than those before and often ends elsewhere, so there are as many
    as leave time for the moves, which are of the best layout of all.
    """
    if "line" in state:
        run.wait(GRADIENT)  # of a search taken up again in another process
        return _burst(run, state)
    placing = _placing(state)
    if _has_gradients(run, state):
        late = placing["round"] == 0 and run.share(run.spent - state["aside"]) >= BEFORE
        if state["polished"] < placing["round"] and (placing["phase"] == "move" or late):
            return _before_adam(run, state, placing)
        if state["drafted"]:
            return _from_draft(run, state)
    scored = len(run.history)
    after = greedy.step(run, placing)
    began = state["began"] if after["round"] == placing["round"] else run.spent
    drafted = after["phase"] == "look" and len(run.history) > scored
    drafted = drafted and run.share(run.spent - began) <= DRAFT
    drafted = drafted or state["drafted"]  # its burst waits for the gradient
    return _beside(state) | {"began": began, "drafted": drafted} | _within(after)


def _from_draft(run: Run, state: State) -> State:
    """A burst from the best so far; then placement goes on as if it had taken no time.

    ``draft`` is the score that it began at, ``aside`` what it took.
    """
    before, score = run.spent, run.best
    burst = state | charted(run.problem, run.best_x[None]) | {"line": np.zeros(1, int)}
    burst = advance(run, burst, lambda: (SOFTNESS, RATE), BURST)
    run.offer(layouts(run.problem, burst)[0])
    aside = run.spent - before
    return state | {
        "count": burst["count"],
        "drafted": False,
        "draft": score,
        "aside": aside,
        "began": state["began"] + aside,
    }


def _before_adam(run: Run, state: State, placing: State) -> State:
    """Before Adam, from where the round's placement ended; in the first one from the best so far.

    If that has had a burst, then from where placement ended if it came further without one.
    """
    further = placing["phase"] == "move" and placing["value"] > state["draft"]
    own = state["polished"] >= 0 or further
    x, value = (placing["x"], placing["value"]) if own else (run.best_x, run.best)
    return (
        state
        | charted(run.problem, x[None])
        | {
            "polished": placing["round"],
            "drafted": False,
            "placed": run.spent,
            "line": np.zeros(1, int),
            "softness": SOFTNESS,
            "rate": RATE,
            "x": x,
            "value": value,
            "vain": 0,
            "path": np.zeros(0),
        }
    )


def _burst(run: Run, state: State) -> State:
    """Some gradient steps and an exact score; from the best of the round, and softer if in vain.

    ``path`` has the round's best score after each burst, ``pace`` that of the best round.
    """
    state = advance(run, state, lambda: (state["softness"], state["rate"]), BURST)
    x = layouts(run.problem, state)
    value = run.offer(x[0])
    if value > state["value"]:
        state = charted_again(run.problem, state, x) | {"vain": 0, "x": x[0], "value": value}
    else:
        calmer = {key: CALMER * state[key] for key in ("softness", "rate")}
        calmer["vain"] = state["vain"] + 1
        state = state | charted(run.problem, state["x"][None]) | calmer
    path = np.append(state["path"], state["value"])
    pace = path if path[-1] > state["pace"][-1] else state["pace"]
    state = state | {"path": path, "pace": pace}
    behind = len(path) >= TRIAL and path[-1] < pace[min(len(path), len(pace)) - 1]
    over = behind or state["vain"] == VAIN or run.done >= UNTIL
    return _after_adam(run, state) if over else state


def _after_adam(run: Run, state: State) -> State:
    """Before the next round if there is time for one, and else before the finer moves."""
    placing = _placing(state)
    trial = TRIAL * (run.spent - state["placed"]) / len(state["path"])
    ends = run.spent + (state["placed"] - state["began"]) + trial
    kept = {key: state[key] for key in ("polished", "count", "pace", "drafted", "draft", "aside")}
    kept["began"] = run.spent
    if run.share(ends) <= AGAIN:
        return kept | _within(greedy.next_round(placing))
    return kept | _within(greedy.moving(placing, run.best_x, run.best, WIDTH))


def _within(placing: State) -> State:
    return {_WITHIN + key: value for key, value in placing.items()}


def _beside(state: State) -> State:
    return {key: value for key, value in state.items() if not key.startswith(_WITHIN)}


def _placing(state: State) -> State:
    """The state of greedy placement within a state."""
    return {k.removeprefix(_WITHIN): v for k, v in state.items() if k.startswith(_WITHIN)}


GREEDY_ADAM = Method(
    "greedy-adam",
    "rounds of greedy placement over candidate poses and Adam from there, then finer moves",
    begin,
    step,
    ahead,
)
