"""Find better places for a layout's sensors, with any search method."""

import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from inspe_jax.core.digest import digest
from inspe_jax.core.errors import InspeError, check_known, wrong_kind
from inspe_jax.core.files import check_output, check_writable, json_value
from inspe_jax.core.version import versions
from inspe_jax.placement.checkpoint import SUFFIXES, CheckpointWriter
from inspe_jax.placement.constraints import Constraints
from inspe_jax.placement.methods import greedy
from inspe_jax.placement.methods.registry import METHODS
from inspe_jax.placement.objective import Objective
from inspe_jax.placement.problem import AnyScene, Problem, cases_of
from inspe_jax.placement.result import STATUSES, Result
from inspe_jax.placement.run import (
    BudgetSpent,
    Method,
    Run,
    TargetReached,
    check_budget,
    check_seed,
)
from inspe_jax.scoring.evaluate import Scores, evaluate
from inspe_jax.sensing.conditions import Conditions
from inspe_jax.sensing.layout import Layout

DEFAULT_METHOD = "greedy-adam"
"""It finds places among candidates, and poses by gradients."""
DEFAULT_SECONDS = 60.0
"""Budget if none is given [s]."""
STARTS = ("given", "random")
"""Where a search can begin, besides at a layout of one's own."""
LIBRARIES = ("jax", "numpy", "scipy", "optax", "jaxopt", "cmaes")
"""Libraries on which the outcome of a method depends; a result has their versions."""

_ENDING = 0.1
"""A method that stops with at most this share of the budget left has used its budget."""


def methods() -> dict[str, str]:
    """The names of all search methods, each with a line about it.

    >>> inspe_jax.methods()["random"]
    'random feasible layouts'
    """
    return {row.name: row.summary for row in METHODS.values()}


def optimise(
    scene: AnyScene | Sequence[AnyScene],
    layout: Layout | str,
    method: str = DEFAULT_METHOD,
    seconds: float | None = None,
    evaluations: float | None = None,
    seed: int = 0,
    objective: Objective | None = None,
    constraints: Constraints | None = None,
    start: str | Layout = "given",
    progress: Callable[[float, float], None] | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    found: Callable[[Layout, float], None] | None = None,
    target: float = np.inf,
    conditions: Conditions | str | None = None,
) -> Result:
    """Search better places for the sensors of a layout, under constraints and within a budget.

    Ctrl-C ends a search with the best layout so far; so does a KeyboardInterrupt in ``progress``.

    Args:
        scene: One scene, or several of one intersection, as in :func:`inspe_jax.evaluate`; several
            scenes in several conditions are a list of :class:`~inspe_jax.sensing.conditions.Case`.
        layout: The sensors and their units, also by name.
        method: One of :func:`methods`, ``greedy-adam`` if not given.
        seconds: Budget of wall time [s], from the first exact score on, without the time in which a
            program is compiled; 60 if no budget is given.
        evaluations: Budget in exact scores, with all other work in their equivalents. With it
            alone, the same ``seed`` gives the same result on the same machine.
        seed: Of the search.
        objective: What is maximised; ``objective.over`` says how scores of scenes are combined.
        constraints: What mounting allows.
        start: "given" (the layout itself), "random", or a layout of the same sensors. If mounting
            does not allow it, the search begins at the nearest layout that it allows, and the
            result's ``notes`` say so.
        progress: Called with the share of the budget that is spent and the best score so far.
        checkpoint: An ``.npz`` file, written every 10 s and at the end. If it exists, the search
            goes on from it as if never stopped, and further with a larger budget.
        found: Called with every layout that is the best so far, and its score.
        target: A best score of this or more ends the search.
        conditions: Light and weather, as in :func:`inspe_jax.evaluate`.

    Returns:
        A result that is feasible, as checked on the map's polygons; its exact score is never below
        that of the start.

    Raises:
        InspeError: An option is unknown or out of range, a unit has nowhere to stand, or the
            checkpoint is of another search.

    >>> result = inspe_jax.optimise(scene, layout, "random", evaluations=2)
    >>> result.objective >= result.objective_before, result.status
    (True, 'budget spent')
    """
    (row,) = check_search((method,), start, (seed,))
    seconds = _seconds(seconds, evaluations)
    check_output(checkpoint, SUFFIXES)
    if checkpoint is not None:
        check_writable(Path(checkpoint).parent)
    problem = Problem(cases_of(scene, conditions), layout, objective, constraints)
    return _search(
        problem,
        row,
        seed,
        start,
        checkpoint,
        seconds=seconds,
        evaluations=evaluations,
        progress=progress,
        found=None if found is None else lambda x, best: found(problem.space.layout(x), best),
        target=target,
    )


def compare(
    scene: AnyScene | Sequence[AnyScene],
    layout: Layout | str,
    methods: Sequence[str] | None = None,
    seconds: float | None = None,
    evaluations: float | None = None,
    seeds: int | Sequence[int] = 3,
    objective: Objective | None = None,
    constraints: Constraints | None = None,
    start: str | Layout = "given",
    progress: Callable[[str, int, float, float], None] | None = None,
    conditions: Conditions | str | None = None,
) -> list[Result]:
    """Search by several methods on equal terms, once for each seed.

    All searches use the same compiled scores. Ctrl-C ends the comparison with the searches so far,
    the last one as it stands.

    Args:
        scene, layout, seconds, evaluations, objective, constraints, start, conditions: As in
            :func:`optimise`.
        methods: Names of :func:`methods`; None means all.
        seeds: A number of seeds, from 0 on, or the seeds.
        progress: Called with the method, the seed, the share of its budget and its best score.

    Returns:
        The results, method by method.

    Raises:
        InspeError: As :func:`optimise`.

    >>> found = inspe_jax.compare(scene, layout, ["random"], evaluations=2, seeds=2)
    >>> [(result.method, result.seed) for result in found]
    [('random', 0), ('random', 1)]
    """
    several = range(seeds) if isinstance(seeds, int) else seeds
    rows = check_search(tuple(METHODS) if methods is None else methods, start, several)
    seconds = _seconds(seconds, evaluations)
    problem = Problem(cases_of(scene, conditions), layout, objective, constraints)
    search = partial(_search, problem, start=start, seconds=seconds, evaluations=evaluations)
    results: list[Result] = []
    try:
        for row, seed in product(rows, several):
            notify = None if progress is None else partial(progress, row.name, seed)
            results.append(search(row, seed, progress=notify))
            if results[-1].status == "interrupted":
                break
    except KeyboardInterrupt:
        if not results:
            raise
    return results


# ── One search ──────────────────────────────────────────────────────────────


def _search(
    problem: Problem,
    row: Method,
    seed: int,
    start: str | Layout,
    checkpoint: str | os.PathLike[str] | None = None,
    **options: Any,
) -> Result:
    """A search from a start; ``options`` are those of :class:`Run`."""
    space, notes = problem.space, tuple[str, ...]()
    if start == "random":
        x = space.random(np.random.default_rng([seed, 11]), 1)[0]
    else:
        x, notes = space.start(problem.layout if isinstance(start, str) else start)
    run = Run(problem, x, seed=seed, **options)
    run.notes += notes
    writer = None
    if checkpoint is not None:
        of = {
            "scene": digest(problem.cases),
            "layout": digest(problem.layout),
            "objective": digest(problem.objective),
            "constraints": digest(problem.space.constraints),
            "start": start if isinstance(start, str) else digest(start),
            "method": row.name,
            "seed": str(seed),
        }
        writer = CheckpointWriter(checkpoint, of, run)
    status = _drive(run, row, writer)
    try:
        return _result(run, row, status, start)
    except KeyboardInterrupt:  # the search is over; its result is kept
        return _result(run, row, "interrupted", start)


def _drive(run: Run, row: Method, writer: CheckpointWriter | None = None) -> str:
    """Run a method step by step to its end and return the status."""
    state = writer.take_up(row.states) if writer else None
    if writer and writer.ended:
        return _settled(run, writer.ended)
    try:
        if not run.history:
            run.offer(run.start)
        following = row.begin(run) if state is None else state
        while following is not None:
            state = following
            if writer:
                writer.mark(state)
            following = row.step(run, state)
            run.report()
        status = "converged" if run.done < 1 - _ENDING else "budget spent"
    except BudgetSpent:
        status = "budget spent"
    except TargetReached:
        status = "target reached"
    except KeyboardInterrupt:
        if not run.history:  # nothing to hand back
            raise
        status = "interrupted"
    status = _settled(run, status)
    if writer:
        writer.end(state, status)
    return status


def _settled(run: Run, status: str) -> str:
    """The status of a search that ended, once what it held has its exact score."""
    try:
        run.settle()
    except TargetReached:
        return "target reached"
    except KeyboardInterrupt:
        return "interrupted"
    return status


def _result(run: Run, row: Method, status: str, begun: str | Layout) -> Result:
    seconds, problem, objective = run.seconds, run.problem, run.problem.objective
    found, start = problem.space.layout(run.best_x), problem.space.layout(run.start)
    # These would be errors of this package: a result must be feasible and no worse than its start.
    wrong = problem.space.violations(found)
    if wrong:
        raise AssertionError(f"{row.name} found a layout that is not feasible: {'; '.join(wrong)}")
    before = run.history[0].score
    if not run.best >= before:
        raise AssertionError(f"{row.name}: {run.best} is worse than the start's {before}")
    notes = list(run.notes)
    if run.evaluations <= 1.0:
        more = "; give a larger budget" if status == "budget spent" else ""
        notes.append(f"nothing was searched, only the start was scored: {STATUSES[status]}{more}")
    elif run.best == before:
        notes.append("nothing better than the start was found; try a larger budget or start")
    if greedy.Placing in row.states and not problem.submodular:
        notes.append(greedy.GROWS)
    if objective.pole_price:
        began, paid = (float(problem.pole_costs(x).sum()) for x in (run.start, run.best_x))
        count = round(paid / objective.pole_price)
        words = f"{count} of {len(found.units)} units stand on new poles, which the objective pays"
        notes.append(f"{words} {paid:g} for; {began:g} at the start")
    case = problem.cases[0]
    options = ("weights", "occlusion_reference", "visibility", "metrics", "detection")
    readings: dict[str, Any] = {name: getattr(objective, name) for name in options}

    def scores(of: Layout) -> Scores:
        return evaluate(case.scene, of, conditions=case.conditions, **readings)

    return Result(
        layout=replace(named_optimised(found), goal=objective.goal),
        start=start,
        scores_before=scores(start),
        scores=scores(found),
        objective_before=before,
        objective=run.best,
        history=tuple(run.history),
        path=np.stack([np.asarray(problem.space.layout(x).poses) for x in run.path]),
        evaluations=run.evaluations,
        seconds=seconds,
        status=status,
        method=row.name,
        seed=run.seed,
        settings={
            "budget": dict(zip(("seconds", "evaluations"), run.limits, strict=True)),
            "start": begun if isinstance(begun, str) else begun.name,
            **_settings(problem),
        },
        versions=versions(LIBRARIES),
        notes=tuple(notes),
    )


_SUFFIX = ", optimised"


def named_optimised(layout: Layout) -> Layout:
    """A layout that a search found, with a name that says so."""
    return replace(layout, name=f"{layout.name.removesuffix(_SUFFIX)}{_SUFFIX}")


def _settings(problem: Problem) -> dict[str, Any]:
    """The settings of a search for its record: lengths in metres, angles in degrees."""
    limits = problem.space.constraints
    return {
        "layout": problem.layout.name,
        "scenes": [
            {
                "name": case.scene.name,
                "source": case.scene.intersection.source,
                "settings": dict(case.scene.settings),
                **case.conditions.record,
            }
            for case in problem.cases
        ],
        "objective": json_value(asdict(problem.objective)),
        "constraints": {
            "heights": list(limits.heights),
            "span_heights": list(limits.span_heights),
            "clearance": limits.clearance,
            "pitch_deg": {k: np.degrees(v).round(6).tolist() for k, v in limits.pitch.items()},
            "yaw_deg": {k: np.degrees(v).round(6).tolist() for k, v in limits.yaw.items()},
            "places": limits.places if isinstance(limits.places, str) else dict(limits.places),
            "area": None if limits.area is None else limits.area.wkt,
        },
    }


# ── Options ─────────────────────────────────────────────────────────────────


def _seconds(seconds: float | None, evaluations: float | None) -> float | None:
    """The budget in seconds, with the default where there is none at all."""
    if seconds is None and evaluations is None:
        seconds = DEFAULT_SECONDS
    check_budget(seconds, evaluations)
    return seconds


def check_search(
    methods: Sequence[str], start: str | Layout = "given", seeds: Sequence[int] = (0,)
) -> list[Method]:
    """The methods of these names. Raises InspeError for what needs no scene to be seen."""
    for name in methods:
        check_known(name, METHODS, "method")
    rows = [METHODS[name] for name in methods]
    if not rows:
        raise InspeError(f"no method to compare: give some of {', '.join(METHODS)}")
    if len(set(methods)) < len(rows):
        raise InspeError(f"methods {', '.join(methods)}: one is named twice")
    if not seeds:
        raise InspeError(f"seeds {len(seeds)}: give at least 1")
    for seed in seeds:
        check_seed(seed)
    if isinstance(start, str):
        check_known(start, STARTS, "start")
    elif not isinstance(start, Layout):
        raise wrong_kind("start", start, f"a Layout, or one of {', '.join(STARTS)}")
    return rows
