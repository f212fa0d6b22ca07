"""Search along the gradient of the soft score: Adam, L-BFGS-B and projected gradients.

All three read the score softly on a sample of columns and frames, 3 m wide at first and
0.3 m at last, so that a sensor feels at first where the traffic and the voxels are at
all, and at last where an edge of its view lies.
"""

import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from inspe_jax.cores import run as on_all_cores
from inspe_jax.placement import greedy
from inspe_jax.placement.candidates import COLUMNS, FRAMES
from inspe_jax.placement.problem import Problem, per_problem, take
from inspe_jax.placement.run import Method, Run, State

with warnings.catch_warnings():
    # It says on import that it is no longer maintained; what is used of it is old and tested here.
    warnings.simplefilter("ignore", DeprecationWarning)
    import jaxopt

SOFTNESS = (3.0, 0.3)
"""Softness at the start and at the end of a search [m]."""
STARTS = 4
"""Layouts that Adam improves at once."""


def annealed(ends: Any, done: float) -> float:
    """Geometrically from one end to the other as the budget is used up."""
    first, last = ends
    return first * (last / first) ** min(max(done, 0.0), 1.0)


# ── Adam ────────────────────────────────────────────────────────────────────

STEP_COLUMNS, STEP_FRAMES = 384, 3
"""Size of the sample of one gradient: many rough steps come further than few good ones."""
RATE = (0.2, 0.01)
"""Length of a step at the start and at the end, in typical steps of each coordinate."""
LOOKS = 0.15
"""Share of the budget from one exact score of the best layout to the next."""
CULLS = (0.15, 0.3, 0.5)
"""Shares of the budget at which the worse half of the layouts gives way to the better."""
CHUNK = 4
"""Gradient steps between two looks at the budget."""
SCREENED = 32
"""Random layouts of which the best become starts."""
_LAST = 0.95  # share of the budget at which the search ends, to leave time for the last scores

_adam = optax.chain(optax.clip_by_global_norm(10.0), optax.scale_by_adam(b1=0.9, b2=0.98))


def begin_adam(run: Run) -> State:
    """The given start and the best of some random layouts, in their charts."""
    problem = run.problem
    sample = problem.sample(run.rng(0), COLUMNS, FRAMES)
    others = problem.space.random(run.rng(1), SCREENED)
    ranked = others[np.argsort(-run.rough(others, sample), kind="stable")]
    return _charted(problem, np.concatenate([run.start[None], ranked[: STARTS - 1]])) | {
        "line": np.arange(STARTS),
        "count": 0,
        "culled": 0,
        "began": 1.0 - run.left,
        "looked": 1.0 - run.left,
    }


def _charted(problem: Problem, x: Float[np.ndarray, "M N"]) -> State:
    """Layouts in charts, standing still."""
    v, place = zip(*(problem.space.chart(row) for row in x), strict=True)
    anchor = jnp.asarray(np.stack(v), float)
    state = jax.vmap(_adam.init)(jnp.zeros_like(anchor))
    return {
        "anchor": np.asarray(anchor),
        "z": np.zeros_like(anchor),
        "place": np.stack(place),
        **_kept(state),
    }


def _kept(optimiser: Any) -> State:
    """The optimiser's arrays as a state keeps them; :func:`_optimiser_state` puts them back."""
    return {f"optax {i}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(optimiser))}


def _optimiser_state(state: State) -> Any:
    shape = jax.eval_shape(jax.vmap(_adam.init), jnp.zeros_like(jnp.asarray(state["z"])))
    leaves, tree = jax.tree.flatten(shape)
    return jax.tree.unflatten(tree, [jnp.asarray(state[f"optax {i}"]) for i in range(len(leaves))])


def step_adam(run: Run, state: State) -> State | None:
    """Some gradient steps of all layouts; now and then the better replace the worse."""
    problem, done = run.problem, 1.0 - run.left
    if done >= _LAST:
        _offer_best(run, state)
        return None
    state = dict(state)
    began = state["began"]
    if state["culled"] < len(CULLS) and done >= CULLS[state["culled"]]:
        state = _cull(run, state)
    elif done >= state["looked"] + LOOKS:
        x = _layouts(problem, state)
        run.offer(x[_ranked(run, x, state["count"])[0]])
        state = _charted_again(problem, state, x) | {"looked": done}

    def now() -> tuple[float, float]:
        done = (1.0 - run.left - began) / (_LAST - began)
        return annealed(SOFTNESS, done), annealed(RATE, done)

    return _advance(run, state, now, CHUNK)


def _advance(run: Run, state: State, now: Callable[[], tuple[float, float]], count: int) -> State:
    """So many gradient steps, each on its own samples, of the softness and rate of that moment."""
    problem, line = run.problem, state["line"]
    optimiser, slope, move = _optimiser_state(state), _slope(problem), _mover(problem)
    z, anchor, place = (jnp.asarray(state[k]) for k in ("z", "anchor", "place"))
    together = (line[:, None] == line[None]).astype(z.dtype)
    mean = together / together.sum(1, keepdims=True)
    for k in range(state["count"], state["count"] + count):
        softness, rate = (jnp.asarray(x, float) for x in now())
        rng = run.rng(2, k)
        drawn = [problem.draw(rng, STEP_COLUMNS, STEP_FRAMES) for _ in line]
        run.charge(len(line) * run.gradient_cost * problem.share(drawn[0]))
        # One by one, on all cores: faster than all lines in one array.
        rows = zip(z, anchor, place, drawn, strict=True)
        jobs = [("slope", partial(slope, *row, problem.fields, softness)) for row in rows]
        slopes = on_all_cores(jobs, problem.known)
        z, optimiser = move(z, mean @ jnp.stack(slopes), optimiser, rate)
    return state | _kept(optimiser) | {"z": np.asarray(z), "count": state["count"] + count}


def _charted_loss(problem: Problem) -> Callable[..., Any]:
    """What is minimised, in typical steps from an anchor in charts."""
    scale = jnp.asarray(problem.space.scale, float)

    def loss(z, anchor, place, drawn, fields, softness):  # type: ignore[no-untyped-def]
        x = problem.space.from_chart(anchor + scale * z, place)
        return -problem.soft(x, take(fields, drawn), softness)

    return loss


@per_problem
def _slope(problem: Problem) -> Callable[..., Any]:
    return jax.jit(jax.grad(_charted_loss(problem)))


@per_problem
def _mover(problem: Problem) -> Callable[..., Any]:
    def move(z, slope, optimiser, rate):  # type: ignore[no-untyped-def]
        with jax.numpy_dtype_promotion("standard"):  # optax's own, whatever the caller's is
            update, optimiser = jax.vmap(_adam.update)(slope, optimiser)
        return z - rate * update, optimiser

    return jax.jit(move)


def _layouts(problem: Problem, state: State) -> Float[np.ndarray, "M N"]:
    scale = problem.space.scale
    v = jnp.asarray(state["anchor"] + scale * state["z"], float)
    return np.asarray(jax.vmap(problem.space.from_chart)(v, jnp.asarray(state["place"])))


def _ranked(run: Run, x: np.ndarray, key: int, size: int = 4) -> np.ndarray:
    """Indices of layouts, best first, by hard scores on a larger sample."""
    sample = run.problem.sample(run.rng(3, key), size * COLUMNS, size * FRAMES)
    return np.argsort(-run.rough(x, sample), kind="stable")


def _cull(run: Run, state: State) -> State:
    """The better half goes on, on as many more samples a step, in new charts.

    Copies of one layout take the mean of their gradients. A new chart lets a unit that has come to
    the end of a piece of ground go on in the next.
    """
    x = _layouts(run.problem, state)
    kept = max(1, STARTS // 2 ** (state["culled"] + 1))
    best = _ranked(run, x, state["culled"])[:kept]
    run.offer(x[best[0]])
    return (
        state
        | _charted(run.problem, np.resize(x[best], x.shape))
        | {
            "line": np.arange(STARTS) % kept,
            "culled": state["culled"] + 1,
            "looked": 1.0 - run.left,
        }
    )


def _charted_again(problem: Problem, state: State, x: Float[np.ndarray, "M N"]) -> State:
    """The same layouts in new charts, with the momentum they have.

    A unit that has come to the end of a piece of ground can go on in the next.
    """
    fresh = _charted(problem, x)
    return state | {key: fresh[key] for key in ("anchor", "z", "place")}


def _offer_best(run: Run, state: State) -> None:
    x = _layouts(run.problem, state)
    _, first = np.unique(state["line"], return_index=True)
    for row in x[first]:
        run.offer(row)


# ── Greedy placement, Adam, finer moves ─────────────────────────────────────

BEFORE, UNTIL = 0.5, 0.75
"""Shares of the budget at which Adam takes over at the latest, and after which it is not given
more than one burst a round."""
BURST = 24
"""Gradient steps from one exact score to the next."""
BURST_SOFTNESS, BURST_RATE = 1.0, 0.3
"""Softness [m] and length of a step, in typical steps, of the first burst."""
CALMER = 0.6
"""What both shrink by where a burst was for nothing."""
VAIN = 3
"""Adam ends after so many bursts in a row that were for nothing, or after the first if that was."""
AFTER = 0.36
"""Width of the first finer moves after Adam where it found something, in typical steps."""
_WITHIN = "greedy "  # what a state of greedy placement has before its keys


def begin_greedy_adam(run: Run) -> State:
    """Before greedy placement."""
    return _within(greedy.begin(run)) | {"polished": -1}


def step_greedy_adam(run: Run, state: State) -> State | None:
    """Greedy placement and exchanges; from the best layout so far, Adam; after it, finer moves.

    Candidates find the places, which gradients do not jump between; gradients the poses, which
    candidates do not resolve; and the moves, which are judged hard, what the soft score
    cannot tell. So in every round of greedy placement: a later one, with other candidates, begins
    anew where it places better than all that was found before, and else refines that once more.
    """
    if "line" in state:
        return _burst(run, state)
    sub, done = _without(state), 1.0 - run.left
    late = sub["round"] == 0 and done >= BEFORE
    if state["polished"] == sub["round"] or not (sub["phase"] == "move" or late):
        return _beside(state) | _within(greedy.step(run, sub))
    return (
        state
        | _charted(run.problem, run.best_x[None])
        | {
            "polished": sub["round"],
            "line": np.zeros(1, int),
            "count": state.get("count", 0),
            "softness": BURST_SOFTNESS,
            "rate": BURST_RATE,
            "vain": 0,
            "gained": False,
        }
    )


def _burst(run: Run, state: State) -> State:
    """Some gradient steps and an exact score; from the best so far, and softer if it is no better.

    How soft is soft enough depends on the sensors: cameras are led on by a metre, LiDARs that see
    nearly all astray. So the exact score decides, and not the budget.
    """
    best = run.best
    state = _advance(run, state, lambda: (state["softness"], state["rate"]), BURST)
    x = _layouts(run.problem, state)
    if run.offer(x[0]) > best:
        state = _charted_again(run.problem, state, x) | {"vain": 0, "gained": True}
    else:
        calmer = {key: CALMER * state[key] for key in ("softness", "rate")}
        calmer["vain"] = state["vain"] + 1
        state = state | _charted(run.problem, run.best_x[None]) | calmer
    if state["vain"] < (VAIN if state["gained"] else 1) and 1.0 - run.left < UNTIL:
        return state
    ended = {"polished": state["polished"], "count": state["count"]}
    width = AFTER if state["gained"] else greedy.WIDTH
    return ended | _within(greedy.moving(_without(state), run.best_x, run.best, width))


def _within(sub: State) -> State:
    return {_WITHIN + key: value for key, value in sub.items()}


def _beside(state: State) -> State:
    return {key: value for key, value in state.items() if not key.startswith(_WITHIN)}


def _without(state: State) -> State:
    return {k.removeprefix(_WITHIN): v for k, v in state.items() if k.startswith(_WITHIN)}


# ── jaxopt: one sample a round, and a solver that trusts it ──────────────────

ROUND_COLUMNS, ROUND_FRAMES = 1536, 8
"""Size of the sample of one round: these solvers search along a line and want no noise."""
ITERATIONS = 8
"""Iterations of the solver in a round."""
TRIALS = 3
"""Gradients that one accelerated projected iteration takes on average, with its line search."""
TRUST = 2.0
"""How far a coordinate may go in one round of L-BFGS-B, in typical steps."""
_ROUNDS_LAST = 0.9  # share of the budget after which no new round begins


def begin_rounds(run: Run) -> State:
    """The better of the given start and the best of some random ones."""
    problem = run.problem
    sample = problem.sample(run.rng(0), COLUMNS, FRAMES)
    x = np.concatenate([run.start[None], problem.space.random(run.rng(1), SCREENED)])
    return {"x": x[run.rough(x, sample).argmax()], "count": 0}


def _step_round(run: Run, state: State, solve: Callable[..., np.ndarray]) -> State | None:
    """One round: a fresh sample, a softness, and some iterations of a solver on it."""
    done = 1.0 - run.left
    if done >= _ROUNDS_LAST:
        run.offer(state["x"])
        return None
    problem = run.problem
    drawn = problem.draw(run.rng(2, state["count"]), ROUND_COLUMNS, ROUND_FRAMES)
    softness = jnp.asarray(annealed(SOFTNESS, done / _ROUNDS_LAST), float)
    x = solve(run, state["x"], (drawn, problem.fields, softness))
    run.offer(x)
    return state | {"x": x, "count": state["count"] + 1}


def step_lbfgsb(run: Run, state: State) -> State | None:
    """One round of L-BFGS-B in charts, within a box about the last round's end."""
    return _step_round(run, state, _solve_lbfgsb)


def _solve_lbfgsb(run: Run, x: np.ndarray, data: tuple) -> np.ndarray:
    problem = run.problem
    v, place = problem.space.chart(x)
    anchor, scale = jnp.asarray(v, float), jnp.asarray(problem.space.scale, float)
    score = _charted_score(problem)

    def evaluate(z: Array) -> tuple[Array, Array]:
        run.charge(run.gradient_cost * problem.share(data[0]))
        return score(jnp.asarray(z, float), anchor, jnp.asarray(place), *data)

    # SciPy's solver through jaxopt's interface: jaxopt's own compiles for half a minute.
    solver = jaxopt.ScipyBoundedMinimize(
        fun=evaluate,
        method="L-BFGS-B",
        value_and_grad=True,
        jit=False,
        maxiter=ITERATIONS,
        options={"maxfun": 2 * ITERATIONS},
    )
    still = jnp.zeros_like(anchor)
    z = solver.run(still, bounds=(still - TRUST, still + TRUST)).params
    # It keeps its bounds from a start within them, as 0 is; rounding is mended.
    z = jnp.clip(jnp.asarray(z, float), -TRUST, TRUST)
    return np.asarray(problem.space.from_chart(anchor + scale * z, jnp.asarray(place)))


def step_projected(run: Run, state: State) -> State | None:
    """One round of accelerated projected gradients, in coordinates divided by their scale."""
    return _step_round(run, state, _solve_projected)


def _solve_projected(run: Run, x: np.ndarray, data: tuple) -> np.ndarray:
    problem = run.problem
    run.charge(ITERATIONS * TRIALS * run.gradient_cost * problem.share(data[0]))
    scale = _nonzero_scale(problem)
    z = _projected_solver(problem)(jnp.asarray(x / scale, float), *data)
    return np.asarray(problem.space.project(z * jnp.asarray(scale, z.dtype)))


@per_problem
def _charted_score(problem: Problem) -> Callable[..., Any]:
    """Loss and its slope in charts."""
    return jax.jit(jax.value_and_grad(_charted_loss(problem)))


@per_problem
def _projected_solver(problem: Problem) -> Callable[..., Any]:
    """Some iterations from z, on a sample, at a softness."""
    scale = jnp.asarray(_nonzero_scale(problem), float)

    def loss(z, drawn, fields, softness):  # type: ignore[no-untyped-def]
        return -problem.soft(scale * z, take(fields, drawn), softness)

    # Within each block, as a foot, one scale serves all coordinates: the nearest point is the
    # same in coordinates over their scale.
    solver = jaxopt.ProjectedGradient(
        jax.value_and_grad(loss),
        projection=lambda z, _: problem.space.project(scale * z) / scale,
        value_and_grad=True,
        maxiter=ITERATIONS,
        maxls=6,
        implicit_diff=False,
    )
    return jax.jit(lambda z, *data: solver.run(z, None, *data).params)


def _nonzero_scale(problem: Problem) -> Float[np.ndarray, " N"]:
    return np.where(problem.space.scale > 0, problem.space.scale, 1.0)


GRADIENTS: tuple[Method, ...] = (
    Method(
        "adam",
        "Adam on the soft score, from 3 m to 0.3 m softness, several layouts at once",
        begin_adam,
        step_adam,
    ),
    Method(
        "greedy-adam",
        "greedy placement over candidate poses, Adam from there, then finer moves",
        begin_greedy_adam,
        step_greedy_adam,
    ),
    Method(
        "lbfgsb",
        "L-BFGS-B on the soft score in rounds, each on a fresh sample of the scene",
        begin_rounds,
        step_lbfgsb,
    ),
    Method(
        "projected-gradient",
        "accelerated projected gradients on the soft score, in rounds",
        begin_rounds,
        step_projected,
    ),
)
"""The gradient methods, rows of the registry."""
