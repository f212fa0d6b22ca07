"""Greedy placement, then bursts of Adam and finer moves of the best: the default.

Candidates find the places, which gradients do not jump between; gradients the poses, which
candidates do not resolve; and the moves, which are judged hard, what the soft score cannot tell.
"""

import numpy as np

from inspe_jax.placement.compile_ahead import CompileJob
from inspe_jax.placement.methods import greedy, polish
from inspe_jax.placement.methods.adam import advance, charted
from inspe_jax.placement.run import Method, Run, State

TRIAL = 0.12
"""Share of the budget in which a round's placement is improved, …"""
AGAIN = 0.5
"""… and until which another round must be through with that to be begun."""
PLACING = 0.4
"""Share of the budget at which the first round's placement ends at the latest."""
UNTIL = 0.85
"""Share of the budget after which Adam does not begin."""
VAIN = 6
"""So many turns in a row that gained nothing end a round too; the widths begin again then."""
COMPILES = 1.5
"""How long the gradient compiles beside greedy placement, in what all that came before took."""

GRADIENT = "gradient"
"""What is compiled ahead, after what greedy placement needs."""

_WITHIN = "greedy "  # what a state of greedy placement has before its keys
_KEPT = ("count", "passes", "placing", *polish.LEARNT)


def begin(run: Run) -> State:
    """Before greedy placement.

    ``count`` and ``passes`` as in :func:`polish.turn`; ``began``, when this round did, ``placed``,
    when its placement was done, and ``placing``, what that took.
    """
    return {
        "count": 0,
        "passes": 0,
        "began": run.spent,
        "placing": np.zeros(2),
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
        advance(trial, burst, lambda: (polish.SOFTNESS, polish.RATE), 1)
        return True

    return jobs | {GRADIENT: gradient}


def step(run: Run, state: State) -> State | None:
    """Rounds of greedy placement and exchanges, each improved for a while; then the best of all.

    A round has other candidates than those before and often ends elsewhere.
    """
    if "path" in state:
        return _turn(run, state)
    placing = _placing(state)
    if placing["phase"] == "move":
        return _before_turns(run, state, placing["x"], placing["value"])
    if placing["round"] == 0 and len(run.history) > 1 and run.done >= PLACING:
        return _before_turns(run, state, run.best_x, run.best)
    return _beside(state) | _within(greedy.step(run, placing))


def _before_turns(run: Run, state: State, x: np.ndarray, value: float) -> State:
    """Before the first turn of a round; from the start of the search if placement is behind."""
    if _placing(state)["round"] == 0 and value < run.best:
        x, value = run.best_x, run.best
    took = {"placing": run.spent - state["began"], "placed": run.spent}
    learnt = {key: state[key] for key in polish.LEARNT if key in state}
    return state | polish.begin(x, value) | learnt | took


def _turn(run: Run, state: State) -> State:
    """A turn of Adam or of finer moves; Adam's only once the gradient is compiled, and in time."""
    known = np.isfinite(state["worth"][polish.ADAM])
    gradient = run.ready(GRADIENT) and (known or run.done < UNTIL)
    state = polish.turn(run, state, bool(gradient))
    tried = run.share(run.spent - state["placed"]) >= TRIAL
    again = run.share(run.spent + state["placing"]) + TRIAL <= AGAIN
    if tried and again:
        return _kept(run, state) | _within(greedy.next_round(_placing(state)))
    behind = tried and state["value"] < run.best
    if behind or state["vain"] >= VAIN:
        improved = polish.begin(run.best_x, run.best) | _kept(run, state)
        return improved | _within(_placing(state)) | {"placed": run.spent}
    return state


def _kept(run: Run, state: State) -> State:
    """What a search keeps from one round, or from one layout that it improves, to the next."""
    return {key: state[key] for key in _KEPT} | {"began": run.spent}


def _within(placing: State) -> State:
    return {_WITHIN + key: value for key, value in placing.items()}


def _beside(state: State) -> State:
    return {key: value for key, value in state.items() if not key.startswith(_WITHIN)}


def _placing(state: State) -> State:
    """The state of greedy placement within a state."""
    return {k.removeprefix(_WITHIN): v for k, v in state.items() if k.startswith(_WITHIN)}


GREEDY_ADAM = Method(
    "greedy-adam",
    "rounds of greedy placement over candidate poses, improved by Adam and by finer moves",
    begin,
    step,
    ahead,
)
