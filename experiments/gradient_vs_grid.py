"""Claim: at equal wall time, searches along the gradient find better places than searches without.

Every method, several seeds, on three built-in and five town junctions under the default profile,
with 6 cameras, with 4 LiDARs, and with 4 cameras and 2 LiDARs, these also for detectability in
place of P_sm: 32 cells. ``--large`` has 6 to 48 cameras on one scene of five times the area. All
start from the same layout, work on samples of the same size, and get the same seconds; each is
compiled before its time begins, and what that takes is a column of its own. With ``--cold`` each
runs in a process of its own that keeps nothing compiled, and its time is its user's: it begins when
the search is called, and compiling is part of it. With ``--processor`` the seconds are processor
time, which other work on the machine does not lengthen: run it on one core. Scores are exact, of
the whole scene.

``rises`` has what a search reached at which second. The best layout that any run has found of each
cell is kept in ``best_known/``, with its score in ``best_known.csv``: a method's figure is the
share of it at a second, and the seconds to 99 % of it.

A run that is stopped goes on from what it has written: rows are appended as they come. To use
several cores, run it for some places on each, and put their CSVs together; each search then has
one core.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import numpy as np
from common import (
    MAPS,
    append_rows,
    arguments,
    console,
    in_fresh_process,
    read_rows,
    write_settings,
)
from filelock import FileLock
from matplotlib.figure import Figure

import inspe_jax
from inspe_jax import Layout, Scene
from inspe_jax.core.compiling import compiled
from inspe_jax.core.files import csv_text, write_text
from inspe_jax.mounting.mixes import starting_layout
from inspe_jax.placement.candidates import COLUMNS, FRAMES
from inspe_jax.placement.methods.registry import GRADIENTS, METHODS
from inspe_jax.placement.objective import Objective
from inspe_jax.placement.problem import Problem
from inspe_jax.placement.run import BudgetSpent, Method, Progress, Run
from inspe_jax.sensing.layout import save_layout

BUILT_INS = ("four_way", "t_junction", "roundabout")
TOWNS = (("Town03", 422), ("Town04", 53), ("Town05", 53), ("Town07", 725), ("Town10HD", 189))
MIXES = {
    "cameras": {"paper-camera": 6},
    "lidars": {"paper-lidar-32": 4},
    "both": {"paper-camera": 4, "paper-lidar-32": 2},
    "detectability": {"paper-camera": 4, "paper-lidar-32": 2},
}
"""So few that even the best places known leave something to gain: P_sm below 0.95."""
PLACES = (*BUILT_INS, *(f"{town} {junction}" for town, junction in TOWNS))
LARGE, SIZES = 110.0, {f"{n} cameras": {"paper-camera": n} for n in (6, 12, 24, 48)}
"""Radius of the large scene [m], and what stands there."""
SCORE = {"detectability": "D"}
OBJECTIVES = {"detectability": Objective(weights={"detectability": 1.0})}
"""What is searched for with a mix, if it is not P_sm."""
GRADIENT = [method.name for method in GRADIENTS]
FIELDS = (
    "place", "mix", "method", "seed", "budget", "start", "score", "evaluations", "seconds",
    "compiling", "clock", "rises",
)  # fmt: skip
BEST = ("place", "mix", "score", "method", "seed", "budget")

Clock = Callable[[], float]
"""Seconds by the clock that budgets are counted with."""
Found = Iterator[tuple[int, str, Layout, list[Progress], float, float]]
"""Searches as they come: seed, method, the layout found, scores, work in exact scores, and seconds
of compiling."""


def options() -> argparse.Namespace:
    """The command line."""
    found = arguments(
        __doc__,
        seconds=dict(type=float, default=10.0, help="for each search"),
        seeds=dict(type=int, default=5),
        methods=dict(default=",".join(METHODS), help="with commas"),
        places=dict(default="", help="only these, with commas"),
        cold=dict(action="store_true", help="compiling is part of the time"),
        processor=dict(action="store_true", help="seconds of processor time"),
        draw=dict(action="store_true", help="only the picture, from the CSV"),
        mixes=dict(default=",".join(MIXES), help="with commas"),
        large=dict(action="store_true", help="6 to 48 cameras on a scene of 110 m"),
    )
    for name, known in (("methods", METHODS), ("mixes", MIXES), ("places", PLACES)):
        for part in getattr(found, name).split(","):
            if part and part not in known:
                raise SystemExit(f"--{name} {part}: some of {', '.join(known)}")
    if found.large:
        found.places = found.places or "Town05 53"
        if found.mixes != ",".join(MIXES):
            raise SystemExit("--large has mixes of its own; leave out --mixes")
    if found.quick:
        found.seconds, found.seeds = 5.0 if found.cold else 0.5, 1
        if found.methods == ",".join(METHODS):
            found.methods = "greedy-adam,grid"  # the others compile for a minute
            if found.cold:  # each of them for a quarter of one
                found.methods = "greedy-adam,greedy"
    return found


def scenes(quick: bool, only: str, radius: float) -> Iterator[tuple[str, Scene]]:
    """The junctions, one after another; towns where their maps are at hand."""
    size: dict[str, Any] = dict(radius=radius, frames=40, seed=0)
    if quick:
        size |= dict(radius=15, voxel=1.0, frames=3, density=8)
    wanted = [name for name in only.split(",") if name]
    for name in BUILT_INS[:1] if quick else BUILT_INS:
        if not wanted or name in wanted:
            yield name, inspe_jax.build_scene(inspe_jax.built_in(name), **size)
    for town, junction in () if quick else TOWNS:
        name = f"{town} {junction}"
        if wanted and name not in wanted:
            continue
        path = MAPS / f"{town}.xodr"
        if not path.is_file():
            console.print(f"{name}: no map at hand, left out")
            continue
        from inspe_jax.scene.maps.registry import read_map

        place = read_map(path, junction=junction, radius=size["radius"])
        yield name, inspe_jax.build_scene(place, **size)


def warming(problem: Problem) -> float:
    """A budget in which any method comes to each of its parts [evaluations]."""
    drawn = problem.draw(np.random.default_rng(0), COLUMNS, FRAMES)
    return max(150.0, 400.0 * problem.sample_cost(drawn))


def search(
    problem: Problem, method: Method, seed: int, spent: Clock | None = None, **budget: Any
) -> tuple[Run, list[Progress]]:
    """One search from the given layout, without what comes before and after it.

    ``spent`` are the seconds that count once the start is scored, none if not given.
    """
    run = Run(problem, problem.space.start(problem.layout)[0], seed=seed, **budget)
    try:
        run.offer(run.start)
        if spent is not None:
            first = [replace(row, seconds=spent()) for row in run.history]
            run.take_up(spent(), run.evaluations, first, np.array(run.path))
        state: Any = method.begin(run)
        while state is not None:
            state = method.step(run, state)
    except BudgetSpent:
        pass
    run.settle()
    return run, run.history


def cold_search(
    make: Callable[[], Problem], name: str, seed: int, seconds: float, clock: Clock
) -> tuple[Layout, list[Progress], float, float]:
    """A search in a process that has compiled nothing: its layout, scores, work, and compiling."""
    jax.config.update("jax_enable_compilation_cache", False)
    before, began = compiled().seconds, clock()
    problem = make()
    spent = lambda: clock() - began  # noqa: E731
    run, history = search(problem, METHODS[name], seed, spent, seconds=seconds, clock=clock)
    found = problem.space.layout(run.best_x)
    return found, history, run.evaluations, compiled().seconds - before


def cold_cell(
    make: Callable[[], Problem], seconds: float, clock: Clock, todo: list[tuple[int, str]]
) -> Found:
    """Every search in a process of its own, which imports and gets the scene before it begins."""
    for seed, name in todo:
        found = in_fresh_process(cold_search, make, name, seed, seconds, clock)
        yield seed, name, *found


def warm_cell(
    make: Callable[[], Problem], seconds: float, clock: Clock, todo: list[tuple[int, str]]
) -> Found:
    """Every search in this process, each method compiled before."""
    problem = make()
    problem.exact(problem.space.start(problem.layout)[0])
    compiling = {}
    for name in dict.fromkeys(name for _, name in todo):
        before = compiled().seconds
        search(problem, METHODS[name], 0, evaluations=warming(problem))
        compiling[name] = compiled().seconds - before
    for seed, name in todo:
        run, history = search(problem, METHODS[name], seed, seconds=seconds, clock=clock)
        found = problem.space.layout(run.best_x)
        yield seed, name, found, history, run.evaluations, compiling[name]


def cell(
    place: str, mix: str, scene: Scene, layout: Layout, given: argparse.Namespace, done: set
) -> Iterator[dict[str, Any]]:
    """Every method and seed on one cell."""
    todo = [
        (seed, name)  # in turns: a machine that is busy for a while then slows all methods alike
        for seed in range(given.seeds)
        for name in given.methods.split(",")
        if (place, mix, name, str(seed)) not in done
    ]
    searches, words = (cold_cell, "cold") if given.cold else (warm_cell, "compiled")
    words += ", processor time" * given.processor
    clock = time.process_time if given.processor else time.monotonic
    make = partial(Problem, scene, layout, OBJECTIVES.get(mix))
    for seed, name, found, history, work, compiling in searches(make, given.seconds, clock, todo):
        first, last = history[0], history[-1]
        rises = [first] + [b for a, b in pairwise(history) if b.best > a.best]
        told = " ".join(f"{at.seconds:.2f}:{at.best:.4f}" for at in rises)
        ends = (given.seconds, first.best, last.best, work, last.seconds, compiling, words, told)
        row = dict(zip(FIELDS, (place, mix, name, seed, *ends), strict=True))
        if not given.quick and not given.large:
            keep_best(given.out, row, found)
        yield row


def keep_best(folder: Path, row: dict[str, Any], layout: Layout) -> None:
    """Keep a layout that is better than the best known of its cell."""
    path = folder / "best_known.csv"
    cell = row["place"], row["mix"]
    with FileLock(path.with_name(".best_known.lock")):
        best = {(r["place"], r["mix"]): r for r in read_rows(path)}
        if cell in best and float(best[cell]["score"]) >= row["score"]:
            return
        best[cell] = {key: row[key] for key in BEST}
        (folder / "best_known").mkdir(exist_ok=True)
        save_layout(layout, folder / "best_known" / f"{'_'.join(cell).replace(' ', '_')}.yaml")
        write_text(path, csv_text([best[one] for one in sorted(best)]))


def draw(rows: list[dict[str, str]], path: Path) -> None:
    """The final score of every search: a mark for the median of a method, a line from the worst
    seed to the best, a panel for each mix of devices."""
    places, mixes = (list(dict.fromkeys(row[key] for row in rows)) for key in ("place", "mix"))
    names = [name for name in METHODS if any(row["method"] == name for row in rows)]
    figure = Figure(figsize=(3.4 * len(mixes) + 1, 0.62 * len(places) + 1.4), layout="constrained")
    axes = figure.subplots(1, len(mixes), sharey=True, squeeze=False)[0]
    for ax, mix in zip(axes, mixes, strict=True):
        for k, name in enumerate(names):
            for y, place in enumerate(places):
                at = dict(place=place, mix=mix, method=name)
                found = [float(r["score"]) for r in rows if at.items() <= r.items()]
                if not found:
                    continue
                look: dict[str, Any] = dict(color=f"C{k}", zorder=3)
                up = y + 0.14 * (k - (len(names) - 1) / 2)
                ax.plot([min(found), max(found)], [up, up], lw=1.6, solid_capstyle="butt", **look)
                filled = f"C{k}" if name in GRADIENT else "white"
                mark = ax.plot(np.median(found), up, "o^sDv"[k % 5], ms=5, mfc=filled, **look)
                mark[0].set_label(name if y == 0 else "")
        ax.set(
            title=mix,
            xlabel=f"exact {SCORE.get(mix, 'P_sm')}",
            yticks=range(len(places)),
            yticklabels=places,
        )
        ax.hlines(np.arange(len(places) - 1) + 0.5, *ax.get_xlim(), color="#d0d0d0", lw=0.6)
        ax.margins(x=0)
        ax.invert_yaxis() if ax is axes[0] else None
    seeds, last = len({row["seed"] for row in rows}), rows[-1]
    spread = (
        f"median of {seeds} seeds at most, and from the worst to the best"
        if seeds > 1
        else "one seed"
    )
    figure.legend(
        *axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=len(names),
        title=f"after {float(last['budget']):g} s ({last['clock']}), midday, clear, profile paper: "
        f"{spread}",
    )  # fmt: skip
    figure.savefig(path, dpi=110)


def main() -> None:
    """Run what is missing; then the picture of all there is."""
    given = options()
    stem = "gradient_vs_grid" + "_large" * given.large + "_cold" * given.cold
    stem += "_quick" * given.quick
    path = given.out / f"{stem}.csv"
    if given.draw:
        draw(read_rows(path), path.with_suffix(".png"))
        return
    for row in read_rows(path):
        if missing := {*FIELDS} - {*row}:
            raise SystemExit(f"{path} is of before, without {', '.join(missing)}: delete it")
        if float(row["budget"]) != given.seconds:
            raise SystemExit(
                f"{path} has searches of {row['budget']} s, not {given.seconds:g} s: name another "
                "folder, or delete it to begin anew"
            )
    done = {(r["place"], r["mix"], r["method"], r["seed"]) for r in read_rows(path)}
    mixes = SIZES if given.large else {mix: MIXES[mix] for mix in given.mixes.split(",")}
    for place, scene in scenes(given.quick, given.places, LARGE if given.large else 50.0):
        for mix, devices in list(mixes.items())[: 1 if given.quick else None]:
            jax.clear_caches()  # else the compiled code of many cells exhausts the memory maps
            layout = starting_layout(scene, devices)
            for row in cell(place, mix, scene, layout, given, done):
                append_rows(path, [row])
                console.print(
                    f"{place}, {mix}, {row['method']} {row['seed']}: {row['score']:.4f}",
                    highlight=False,
                )
    write_settings(path.with_suffix(".json"), vars(given))
    draw(read_rows(path), path.with_suffix(".png"))


if __name__ == "__main__":
    main()
