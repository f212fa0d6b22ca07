"""Adam on the soft score, with a new sample at every step. The softness is large at first, where
distant traffic then has a slope, and small at the end, where edges of views are precise."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from inspe_jax.core.arrays import on_host
from inspe_jax.core.parallel import run as on_all_cores
from inspe_jax.placement.problem import Drawn, Problem
from inspe_jax.placement.run import Method, Run

SOFTNESS = (3.0, 0.3)
"""Softness at the start and at the end of a search [m]."""
STARTS = 4
"""Number of layouts that Adam improves at once."""
STEP_COLUMNS, STEP_FRAMES = 384, 3
"""Size of the sample of one gradient. Many rough steps gain more than few precise ones."""
RATE = (0.2, 0.01)
"""Length of a step at the start and at the end, in typical steps of each coordinate."""
LOOKS = 0.15
"""Share of the budget from one exact score of the best layout to the next."""
CULLS = (0.15, 0.3, 0.5)
"""Shares of the budget at which copies of the better half replace the worse half of the layouts."""
CHUNK = 4
"""Gradient steps between two checks of the budget."""
LARGER = 4
"""How many times as many columns, and as many frames, the layouts are then compared on."""
SCREENED = 32
"""Number of random layouts, the best of which become starts."""
_LAST = 0.95  # share of the budget at which the search ends, to leave time for the last scores


@cache
def _adam() -> Any:
    import optax  # takes longer to import than all of this room

    return optax.chain(optax.clip_by_global_norm(10.0), optax.scale_by_adam(b1=0.9, b2=0.98))


class Slope(NamedTuple):
    """What steps follow: ``at`` gives a score and its slope in poses, of a problem and what
    :meth:`Problem.slope` takes; ``cost`` is what one costs on a sample, in exact scores."""

    at: Callable[..., tuple[float, Float[np.ndarray, "S 6"]]]
    cost: Callable[[Problem, Drawn], float]


GRADIENT = Slope(lambda problem, *at: problem.slope(*at), Problem.gradient_cost)
"""That of the soft score."""


def annealed(ends: Any, done: float) -> float:
    """Geometric interpolation between two ends, by the share of the budget that is spent."""
    first, last = ends
    return first * (last / first) ** min(max(done, 0.0), 1.0)


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class ChartedLayouts:
    """M layouts in charts, and what Adam remembers of their slopes.

    A layout stands ``z`` (M, N) typical steps from ``anchor`` (M, N) in the charts ``place`` (M,
    U). ``steps`` (M,) are Adam's, ``mean`` and ``square`` (M, N) its running means. Layouts of one
    ``line`` (M,) take their mean slope. ``count`` steps were done since the search began.
    """

    anchor: Float[np.ndarray, "M N"]
    z: Float[np.ndarray, "M N"]
    place: Int[np.ndarray, "M U"]
    steps: Int[np.ndarray, " M"]
    mean: Float[np.ndarray, "M N"]
    square: Float[np.ndarray, "M N"]
    line: Int[np.ndarray, " M"]
    count: int


@dataclass(frozen=True, eq=False)
class AdamState(ChartedLayouts):
    """Adam's layouts, the best when last compared first; how often some were ``culled``; and what
    was spent [s, exact scores] when the search ``began`` and when it ``looked`` at the best."""

    culled: int
    began: Float[np.ndarray, "2"]
    looked: Float[np.ndarray, "2"]


L = TypeVar("L", bound=ChartedLayouts)


def begin_adam(run: Run) -> AdamState:
    """The given start and the best of some random layouts, in their charts."""
    x, scores = screened(run)
    ranked = np.argsort(-scores, kind="stable")
    kept = [0, *ranked[ranked > 0][: STARTS - 1]]
    now = run.spent
    first = charted(run.problem, x[ranked[np.isin(ranked, kept)]], np.arange(STARTS))
    return AdamState(**vars(first), culled=0, began=now, looked=now)


def screened(run: Run) -> tuple[Float[np.ndarray, "M N"], Float[np.ndarray, " M"]]:
    """The start and :data:`SCREENED` random layouts, with their scores on a sample."""
    x = np.concatenate([run.start[None], run.problem.space.random(run.rng(1), SCREENED)])
    return x, run.rough(x, 0)


def charted(
    problem: Problem, x: Float[np.ndarray, "M N"], line: Int[np.ndarray, " M"], count: int = 0
) -> ChartedLayouts:
    """Layouts (M, N) in new charts, with Adam at rest."""
    v, place = zip(*map(problem.chart, x), strict=True)
    anchor = on_host(np.stack(v), float)
    still, steps = np.zeros_like(anchor), np.zeros(len(x), np.int32)
    return ChartedLayouts(anchor, still, np.stack(place), steps, still, still, line, count)


def step_adam(run: Run, state: AdamState) -> AdamState | None:
    """Some gradient steps of all layouts; at :data:`CULLS` the better ones replace the worse."""
    problem, done = run.problem, run.done
    if done >= _LAST:
        x = layouts(problem, state)
        _, first = np.unique(state.line, return_index=True)
        for row in x[np.sort(first)]:  # the one that is held comes first
            run.offer(row)
        return None
    began = run.share(state.began)
    if state.culled < len(CULLS) and done >= CULLS[state.culled]:
        state = _cull(run, state)
    elif done >= run.share(state.looked) + LOOKS:
        x = layouts(problem, state)
        order = _ranked(run, x, state.count)
        run.offer(x[order[0]])
        # In new charts: a unit at the edge of a region can go on into the next.
        fresh = vars(charted(problem, x[order], state.line[order], state.count))
        moments = {name: getattr(state, name)[order] for name in ("steps", "mean", "square")}
        state = replace(state, **fresh | moments, looked=run.spent)

    def now() -> tuple[float, float]:
        through = (run.done - began) / (_LAST - began)
        return annealed(SOFTNESS, through), annealed(RATE, through)

    state = advance(run, state, now, CHUNK)
    run.hold(layouts(problem, state)[0])
    return state


def advance(
    run: Run, state: L, now: Callable[[], tuple[float, float]], count: int, by: Slope = GRADIENT
) -> L:
    """Do ``count`` gradient steps, each on new samples; ``now`` gives softness [m] and rate."""
    problem, line, z = run.problem, state.line, state.z
    tree = jax.tree.structure(jax.eval_shape(_adam().init, z))
    optimiser = jax.tree.unflatten(tree, (state.steps, state.mean, state.square))
    loss = partial(problem.charted_loss, of=partial(by.at, problem))
    together = (line[:, None] == line[None]).astype(z.dtype)
    mean = together / together.sum(1, keepdims=True)
    for k in range(state.count, state.count + count):
        softness, rate = (jnp.asarray(x, float) for x in now())
        rng = run.rng(2, k)
        drawn = [problem.draw(rng, STEP_COLUMNS, STEP_FRAMES) for _ in line]
        run.charge(len(line) * by.cost(problem, drawn[0]))
        # One by one, on all cores: faster than all lines in one array.
        rows = zip(z, state.anchor, state.place, drawn, strict=True)
        jobs = [("slope", partial(loss, *row, softness)) for row in rows]
        slopes = [slope for _, slope in on_all_cores(jobs, problem.known)]
        moved, optimiser = _move(z, mean @ np.stack(slopes), optimiser, rate)
        z = np.asarray(moved)
    steps, running, square = map(np.asarray, jax.tree.leaves(optimiser))
    return replace(state, z=z, steps=steps, mean=running, square=square, count=state.count + count)


@jax.jit
def _move(z, slope, optimiser, rate):  # type: ignore[no-untyped-def]
    """One step of Adam for each layout, and its state after it."""
    with jax.numpy_dtype_promotion("standard"):  # optax's own, whatever the caller's is
        update, optimiser = jax.vmap(_adam().update)(slope, optimiser)
    return z - rate * update, optimiser


def layouts(problem: Problem, state: ChartedLayouts) -> Float[np.ndarray, "M N"]:
    """Coordinates (M, N) of the layouts of a state."""
    rows = zip(state.anchor + problem.space.scale * state.z, state.place, strict=True)
    return np.stack([problem.space.from_chart(v, place, np) for v, place in rows])


def _ranked(run: Run, x: np.ndarray, key: int) -> np.ndarray:
    """Indices of layouts, best first, by hard scores on a larger sample."""
    return np.argsort(-run.rough(x, 3, key, size=LARGER), kind="stable")


def _cull(run: Run, state: AdamState) -> AdamState:
    """Keep the better half of the layouts, twice as often, in new charts, with Adam at rest."""
    x = layouts(run.problem, state)
    kept = max(1, STARTS // 2 ** (state.culled + 1))
    best = _ranked(run, x, state.culled)[:kept]
    run.offer(x[best[0]])
    line = np.arange(STARTS) % kept
    fresh = charted(run.problem, np.resize(x[best], x.shape), line, state.count)
    return AdamState(**vars(fresh), culled=state.culled + 1, began=state.began, looked=run.spent)


ADAM = Method(
    "adam",
    "Adam on the soft score, from 3 m to 0.3 m softness, several layouts at once",
    (AdamState,),
    begin_adam,
    step_adam,
)
