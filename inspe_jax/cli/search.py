"""Search for better places, and compare the methods that do: `inspe optimise`, `compare`.

Imports stay inside the commands, as of the gradient libraries and matplotlib.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.text import Text

from inspe_jax.cli.common import (
    DEFAULT_LAYOUT,
    DEFAULT_SCENE,
    LayoutArgument,
    SceneArgument,
    app,
    busy,
    err,
    out,
    scene_and_layout,
)
from inspe_jax.errors import InspeError

if TYPE_CHECKING:
    from inspe_jax.placement.constraints import Constraints
    from inspe_jax.placement.problem import Objective
    from inspe_jax.placement.result import Result
    from inspe_jax.scene.scene import Scene

SecondsOption = Annotated[
    float | None,
    typer.Option(help="Wall time of a search [s]; if no budget is given, 60, or 20 to compare."),
]
EvaluationsOption = Annotated[
    float | None,
    typer.Option(help="Work of a search, in exact scores; a seed then repeats on one machine."),
]
StartOption = Annotated[
    str, typer.Option(help="Where to begin: given (by the layout), random, or a strategy's name.")
]
WeightsOption = Annotated[
    tuple[float, float, float],
    typer.Option(metavar="C O IG", help="Weights in P_sm; they sum to 1."),
]
AlsoOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="SCENE",
        help="Another scene of the same intersection, with other traffic; as often as you like. "
        "The mean over the scenes is maximised.",
    ),
]
WorstOption = Annotated[
    bool, typer.Option("--worst", help="Maximise the worst of several scenes, not their mean.")
]
FailuresOption = Annotated[
    bool, typer.Option("--failures", help="N−1: the mean score when any one unit fails.")
]
PlacesOption = Annotated[
    str, typer.Option(help="Where units may stand: any, areas, poles, or keep where they are.")
]
HeightsOption = Annotated[
    tuple[float, float],
    typer.Option(metavar="LOW HIGH", help="Heights of sensors above the ground [m]."),
]
OutOption = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the results.")]


@app.command()
def optimise(
    source: SceneArgument = DEFAULT_SCENE,
    sensors: LayoutArgument = DEFAULT_LAYOUT,
    method: Annotated[
        str | None,
        typer.Option(
            help="greedy-adam (if not given), adam, lbfgsb, projected-gradient, grid, random, "
            "greedy or cma-es."
        ),
    ] = None,
    seconds: SecondsOption = None,
    evaluations: EvaluationsOption = None,
    seed: Annotated[int, typer.Option(help="Seed of the search.")] = 0,
    start: StartOption = "given",
    weights: WeightsOption = (0.3, 0.5, 0.2),
    also: AlsoOption = None,
    worst: WorstOption = False,
    failures: FailuresOption = False,
    places: PlacesOption = "any",
    heights: HeightsOption = (3.0, 12.0),
    checkpoint: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.npz", help="Write every 10 s where the search stands; go on from there."
        ),
    ] = None,
    folder: OutOption = Path("optimised"),
) -> None:
    """Find better places for a layout's sensors, that can be mounted.

    Ctrl-C ends the search with the best so far. Into --out go layout.yaml, start.yaml,
    result.json, history.csv and before_after.png.

    Examples:

    - `inspe optimise`  (the built-in four-way, from cameras at its corners, in a minute)
    - `inspe optimise roundabout Cam-d1/L-d1 --method grid --seconds 120 --out grid`
    - `inspe optimise j189.npz layout.yaml --also j189_night.npz --worst --places poles`
    - `inspe optimise j189.npz layout.yaml --seconds 3600 --checkpoint search.npz`
    """
    from inspe_jax.files import check_output
    from inspe_jax.placement import optimise as search
    from inspe_jax.placement.result import check_folder, save_result

    check_folder(folder)
    check_output(checkpoint, (".npz",))
    objective, constraints = _options(also, weights, worst, failures, places, heights)
    with busy(f"reading {source}"):
        scenes, placed = _scenes_and_layout(source, sensors, also)
    with _search_bar("searching") as tell:
        result = search.optimise(
            scenes,
            placed,
            method or search.DEFAULT_METHOD,
            seconds,
            evaluations,
            seed,
            objective,
            constraints,
            start,
            progress=None if tell is None else lambda done, best: tell(done, best, ""),
            checkpoint=checkpoint,
        )
    save_result(result, folder)
    _show(result)
    with busy("drawing"):
        drawn = _draw(scenes[0], result, folder)
    names = "layout.yaml, start.yaml, result.json and history.csv"
    out.print(f"wrote {names} into {folder}; drew {drawn}", highlight=False, soft_wrap=True)
    out.print(
        f"next: inspe score {source} {folder / 'layout.yaml'} --plot plan.png",
        highlight=False,
        soft_wrap=True,
    )


@app.command()
def compare(
    source: SceneArgument = DEFAULT_SCENE,
    sensors: LayoutArgument = DEFAULT_LAYOUT,
    methods: Annotated[
        str, typer.Option(metavar="A,B,…", help="Methods, with commas; all if not given.")
    ] = "",
    seconds: SecondsOption = None,
    evaluations: EvaluationsOption = None,
    seeds: Annotated[int, typer.Option(help="Searches by each method, with seeds from 0.")] = 3,
    start: StartOption = "given",
    weights: WeightsOption = (0.3, 0.5, 0.2),
    also: AlsoOption = None,
    worst: WorstOption = False,
    failures: FailuresOption = False,
    places: PlacesOption = "any",
    heights: HeightsOption = (3.0, 12.0),
    folder: OutOption = Path("compared"),
) -> None:
    """Search by several methods on equal terms, and show which gets how far, how soon.

    Every method compiles before its time begins. Ctrl-C ends with the searches so far. Into --out
    go compare.csv, history.csv, compare.png and layout.yaml, the best layout found.

    Examples:

    - `inspe compare --methods greedy-adam,grid --seconds 10 --seeds 1`
    - `inspe compare j189.npz layout.yaml --seconds 60 --seeds 5 --out j189_methods`
    """
    from inspe_jax.placement import optimise as search
    from inspe_jax.placement.result import check_folder, save_comparison
    from inspe_jax.report.progress import history_view
    from inspe_jax.report.sheet import save_figure
    from inspe_jax.report.tables import comparison_table

    check_folder(folder)
    names = [name.strip() for name in methods.split(",") if name.strip()] or list(search.METHODS)
    objective, constraints = _options(also, weights, worst, failures, places, heights)
    with busy(f"reading {source}"):
        scenes, placed = _scenes_and_layout(source, sensors, also)
    runs = [(name, seed) for name in names for seed in range(seeds)]

    def share(name: str, seed: int, done: float) -> float:
        return (runs.index((name, seed)) + done) / len(runs)

    with _search_bar("comparing") as tell:
        results = search.compare(
            scenes,
            placed,
            names,
            20.0 if seconds is None and evaluations is None else seconds,
            evaluations,
            seeds,
            objective,
            constraints,
            start,
            progress=None
            if tell is None
            else lambda name, seed, done, best: tell(
                share(name, seed, done), best, f"{name}, seed {seed}"
            ),
        )
    save_comparison(results, folder)
    out.print(comparison_table(results))
    _note(note for note in dict.fromkeys(note for result in results for note in result.notes))
    if len(results) < len(runs):
        err.print(f"[yellow]Note:[/] stopped after {len(results)} of {len(runs)} searches")
    with busy("drawing"):
        save_figure(history_view(results), folder / "compare.png")
    files = f"compare.csv, history.csv and layout.yaml into {folder}"
    out.print(
        f"wrote {files}; drew {folder / 'compare.png'}",
        highlight=False,
        soft_wrap=True,
    )


# ── What the searching commands share ───────────────────────────────────────


def _options(
    also: list[str] | None,
    weights: tuple[float, float, float],
    worst: bool,
    failures: bool,
    places: str,
    heights: tuple[float, float],
) -> "tuple[Objective, Constraints]":
    """What to maximise within what, checked before any scene is read."""
    from inspe_jax.placement.constraints import Constraints
    from inspe_jax.placement.problem import Objective

    if worst and not also:
        raise InspeError("--worst: the worst of several scenes; name more with --also")
    objective = Objective(weights=weights, over="worst" if worst else "mean", failures=failures)
    constraints = Constraints(places=places, heights=heights)
    objective.check()
    constraints.check()
    return objective, constraints


def _scenes_and_layout(
    source: str, sensors: str, also: list[str] | None
) -> "tuple[list[Scene], Any]":
    from inspe_jax.scene.scene import load_scene

    world, placed = scene_and_layout(source, sensors)
    return [world, *(load_scene(other) for other in also or ())], placed


def _show(result: "Result") -> None:
    """Scores before and after, what moved, and what a person should know."""
    from inspe_jax.placement.result import STATUSES
    from inspe_jax.report.tables import before_after_table, moves_table

    out.print(before_after_table(result))
    out.print(moves_table(result.start, result.layout))
    out.print(
        f"{result.method}, seed {result.seed}: {result.status} "
        f"({STATUSES[result.status]}) after {result.seconds:.0f} s, "
        f"{result.evaluations:.0f} exact scores' work",
        highlight=False,
        soft_wrap=True,
    )
    _note(result.notes)


def _note(notes: Any) -> None:
    for note in notes:
        err.print(Text.assemble(("Note: ", "yellow"), note), soft_wrap=True)


def _draw(world: "Scene", result: "Result", folder: Path) -> Path:
    from inspe_jax.report.progress import before_after
    from inspe_jax.report.sheet import save_figure

    path = folder / "before_after.png"
    parts = (result.start, result.layout, result.scores_before, result.scores)
    save_figure(before_after(world, *parts), path)
    return path


@contextmanager
def _search_bar(what: str) -> Iterator[Callable[[float, float, str], None] | None]:
    """A bar with the best score and the time left, on a terminal.

    Gives a callback of the share done, the best score and a word on what is under way; or None.
    """
    if not err.is_terminal:
        yield None
        return
    from rich.progress import BarColumn, Progress, TextColumn

    began = time.monotonic()
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[facts]}"))
    with Progress(*columns, console=err, transient=True) as bar:
        task = bar.add_task(what, total=1.0, facts="compiling …")

        def tell(done: float, best: float, now: str) -> None:
            spent = time.monotonic() - began
            left = f", {spent * (1 - done) / done:.0f} s left" if done > 0.02 else ""
            name = f"{what}: {now}" if now else what
            bar.update(task, completed=done, description=name, facts=f"best {best:.4f}{left}")

        yield tell
