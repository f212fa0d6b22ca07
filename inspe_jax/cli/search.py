"""Search for better placements, and compare search methods: `inspe optimise` and `inspe compare`.

Imports are inside the commands: gradient libraries and matplotlib load slowly.
"""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from inspe_jax.cli.common import (
    DEFAULT_LAYOUT,
    DEFAULT_SCENE,
    LayoutArgument,
    SceneArgument,
    app,
    busy,
    err,
    note,
    out,
    scene_and_layout,
    search_bar,
)
from inspe_jax.cli.options import (
    MethodOption,
    OutOption,
    PriceOption,
    SearchOptions,
    counts,
    prices,
    takes,
)
from inspe_jax.core.errors import InspeError

if TYPE_CHECKING:
    from inspe_jax.placement.result import Result
    from inspe_jax.scene.scene import Scene

StartOption = Annotated[
    str,
    typer.Option(help="Start of a search: given (the layout), random, or the name of a strategy."),
]


@app.command()
@takes(SearchOptions)
def optimise(
    source: SceneArgument = DEFAULT_SCENE,
    sensors: LayoutArgument = DEFAULT_LAYOUT,
    method: MethodOption = None,
    seed: Annotated[int, typer.Option(help="Seed of the search.")] = 0,
    start: StartOption = "given",
    target: Annotated[
        float | None,
        typer.Option(
            help="Search for the cheapest mix of devices that reaches this score, in place of a "
            "better layout. The score is detectability if no --weight is given.",
        ),
    ] = None,
    device: Annotated[
        list[str] | None,
        typer.Option(
            metavar="DEVICE:COUNTS",
            help="With --target: a device of the catalogue, and the numbers of it to try, such as "
            "0-4 or 0,4,8; repeat it for other devices. Those of the layout if not given.",
        ),
    ] = None,
    price: PriceOption = None,
    checkpoint: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.npz",
            help="Save the state of the search every 10 s; resume from the file if it exists.",
        ),
    ] = None,
    folder: OutOption = Path("optimised"),
    *,
    options: SearchOptions,
) -> None:
    """Search for a better layout of the same sensors, one that can be mounted.

    Ctrl-C ends the search with the best layout so far. The folder of --out gets layout.yaml,
    start.yaml, result.json, history.csv, path.csv and before_after.png.

    Examples:

    - `inspe optimise`  (the built-in four-way, from cameras at its corners, in a minute)
    - `inspe optimise roundabout Cam-d1/L-d1 --method grid --seconds 120 --out grid`
    - `inspe optimise j189.npz layout.yaml --also j189_night.npz --worst --places poles`
    - `inspe optimise j189.npz layout.yaml --light midday,night --weather rain:10`
    - `inspe optimise --weight coverage=0.3 --weight occlusion=0.7`
    - `inspe optimise j189.npz layout.yaml --seconds 3600 --checkpoint search.npz`
    - `inspe optimise roundabout L-d1 --weight detectability=1 --region crosswalk`
    - `inspe optimise four_way --target 0.95 --region crosswalk --device velodyne-vlp-16:1-4`
    """
    from inspe_jax.core.files import check_folder, check_output
    from inspe_jax.placement import optimise as search
    from inspe_jax.placement.result import save_result
    from inspe_jax.scoring.metrics import METRICS
    from inspe_jax.sensing.conditions import FAIR

    check_folder(folder)
    check_output(checkpoint, (".npz",))
    if target is not None:
        if checkpoint is not None or start != "given":
            raise InspeError("--target searches many mixes: leave out --checkpoint and --start")
        _find_cheapest(source, sensors, target, device, price, method, seed, folder, options)
        return
    if device or price:
        raise InspeError("--device and --price are for --target: a layout has its devices")
    objective, constraints = options.checked()
    with busy(f"reading {source}"):
        world, placed = scene_and_layout(source, sensors, options.profile)
        cases = options.cases(world)
    with search_bar("searching") as callback:
        result = search.optimise(
            cases,
            placed,
            method or search.DEFAULT_METHOD,
            options.seconds,
            options.evaluations,
            seed,
            objective,
            constraints,
            start,
            progress=lambda done, best: callback(done, best, ""),
            checkpoint=checkpoint,
        )
    save_result(result, folder)
    _show(result)
    with busy("drawing"):
        drawn = _draw(world, result, folder)
    names = "layout.yaml, start.yaml, result.json, history.csv and path.csv"
    out.print(f"wrote {names} into {folder}; drew {drawn}", highlight=False, soft_wrap=True)
    around = "".join(
        f" --{key} {value}"
        for key, value in result.scores.conditions.record.items()
        if value != FAIR.record[key]
    )
    if further := [name for name in result.scores.metrics if not METRICS[name].usual]:
        around += f" --metrics {','.join(further)}"
    out.print(
        f"next: inspe score {source} {folder / 'layout.yaml'}{around} --plot plan.png",
        highlight=False,
        soft_wrap=True,
    )


@app.command()
@takes(SearchOptions)
def compare(
    source: SceneArgument = DEFAULT_SCENE,
    sensors: LayoutArgument = DEFAULT_LAYOUT,
    methods: Annotated[
        str,
        typer.Option(
            metavar="A,B,…", help="Search methods, separated by commas; all if not given."
        ),
    ] = "",
    seeds: Annotated[
        int, typer.Option(help="Number of searches by each method; their seeds count from 0.")
    ] = 3,
    start: StartOption = "given",
    folder: OutOption = Path("compared"),
    *,
    options: SearchOptions,
) -> None:
    """Compare search methods on equal terms: how good their layouts are, and how soon.

    The time of a method begins after it has compiled. Ctrl-C ends with the searches so far. The
    folder of --out gets compare.csv, history.csv, compare.png and layout.yaml, the best layout
    found.

    Examples:

    - `inspe compare --methods greedy-adam,grid --seconds 10 --seeds 1`
    - `inspe compare j189.npz layout.yaml --seconds 60 --seeds 5 --out j189_methods`
    """
    from inspe_jax.core.files import check_folder
    from inspe_jax.placement import optimise as search
    from inspe_jax.placement.result import save_comparison
    from inspe_jax.report.progress import history_view
    from inspe_jax.report.sheet import save_figure
    from inspe_jax.report.tables import comparison_table

    check_folder(folder)
    objective, constraints = options.checked()
    names = [name.strip() for name in methods.split(",") if name.strip()]
    names = names or list(search.methods(objective))
    with busy(f"reading {source}"):
        world, placed = scene_and_layout(source, sensors, options.profile)
        cases = options.cases(world)
    runs = [(name, seed) for name in names for seed in range(seeds)]

    def fraction(name: str, seed: int, done: float) -> float:
        return (runs.index((name, seed)) + done) / len(runs)

    with search_bar("comparing") as callback:
        results = search.compare(
            cases,
            placed,
            names,
            options.seconds_each(),
            options.evaluations,
            seeds,
            objective,
            constraints,
            start,
            progress=lambda name, seed, done, best: callback(
                fraction(name, seed, done), best, f"{name}, seed {seed}"
            ),
        )
    save_comparison(results, folder)
    out.print(comparison_table(results))
    note(note for note in dict.fromkeys(note for result in results for note in result.notes))
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


def _find_cheapest(
    source: str,
    sensors: str,
    target: float,
    device: list[str] | None,
    price: list[str] | None,
    method: str | None,
    seed: int,
    folder: Path,
    options: SearchOptions,
) -> None:
    """`inspe optimise --target`: the cheapest mix of devices that reaches a score."""
    from inspe_jax.placement.result import save_result
    from inspe_jax.placement.studies.cheapest import cheapest, check_target
    from inspe_jax.report.tables import cheapest_table

    check_target(target)
    if not options.weight and not options.three_weights:
        options = replace(options, weight=["detectability=1"])
    objective, constraints = options.checked(prices=prices(price))
    with busy(f"reading {source}"):
        world, placed = scene_and_layout(source, sensors, options.profile)
        cases = options.cases(world)
    names = [sensor.spec.name for sensor in placed.sensors]
    wanted = counts(device) if device else {n: range(names.count(n) + 1) for n in sorted({*names})}
    with search_bar("searching") as callback:
        found = cheapest(
            cases,
            wanted,
            target,
            objective=objective,
            constraints=constraints,
            **options.of_mixes(method, seed, callback),
        )
    out.print(cheapest_table(found))
    best = found.best
    save_result(best.result, folder)
    if found.found is None:
        words = f"none of {len(found.searched)} mixes reaches {target:g}; the best is {best.name}"
    else:
        others = len(found.searched) - 1
        words = f"{best.name} reaches {target:g}; of mixes that cost no more, {others} searched"
        words += ", none reaches it" if others else ""
    if found.found is None and (left := found.total - len(found.searched)):
        words += f"; {left} were not searched"
    out.print(words, highlight=False, soft_wrap=True)
    with busy("drawing"):
        drawn = _draw(world, best.result, folder)
    out.print(
        f"wrote its layout.yaml, start.yaml, result.json, history.csv and path.csv into {folder}; "
        f"drew {drawn}",
        highlight=False,
        soft_wrap=True,
    )


# ── What is printed of a search ───────────────────────────────────────────────


def _show(result: "Result") -> None:
    """Print the scores before and after a search, what moved, and its notes."""
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
    note(result.notes)


def _draw(world: "Scene", result: "Result", folder: Path) -> Path:
    from inspe_jax.report.progress import before_after
    from inspe_jax.report.sheet import save_figure

    path = folder / "before_after.png"
    parts = (result.start, result.layout, result.scores_before, result.scores)
    save_figure(before_after(world, *parts, path=result.path), path)
    return path
