"""Searches for better placements: `inspe optimise`, `compare` and `pareto`."""

from dataclasses import replace
from functools import partial
from pathlib import Path

from inspe_jax.cli import common
from inspe_jax.cli.claims import claims
from inspe_jax.cli.options import DeviceOptions, SearchOptions, command, device_counts
from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import check_output
from inspe_jax.mounting.mixes import starting_layout
from inspe_jax.placement import optimise as search
from inspe_jax.placement.methods.registry import CONTROLS
from inspe_jax.placement.result import FILES, STATUSES, Result, save_comparison, save_result
from inspe_jax.placement.studies import pareto as studies
from inspe_jax.scene.scene import Scene, load_scene
from inspe_jax.scoring.metrics import METRICS
from inspe_jax.sensing import catalogue
from inspe_jax.sensing.conditions import FAIR

PICTURE = "before_after.png"


@command()
def optimise(
    source: str = common.DEFAULT_SCENE,
    sensors: str | None = None,
    *,
    options: DeviceOptions,
    start: str = "given",
    target: float | None = None,
    poles: int | None = None,
    pole_price: float = 0.0,
    checkpoint: Path | None = None,
    folder: Path = Path("optimised"),
    force: bool = False,
) -> None:
    """Search for a better layout of the same sensors, one that can be mounted.

    Ctrl-C ends the search with the best layout so far. The folder of --out gets layout.yaml,
    start.yaml, result.json, history.csv, path.csv and before_after.png.

    Examples:

    - `inspe optimise`  (the built-in four-way, from cameras at its corners, in a minute)
    - `inspe optimise roundabout Cam-d1/L-d1 --method grid --seconds 120 --out grid`
    - `inspe optimise j189.npz layout.yaml --also j189_night.npz --worst --places poles`
    - `inspe optimise j189.npz layout.yaml --seconds 3600 --checkpoint search.npz`
    - `inspe optimise roundabout L-d1 --weight detectability=1 --region crosswalk`
    - `inspe optimise four_way --device velodyne-vlp-16:2 --device paper-camera:4 --poles 3`
    - `inspe optimise four_way --target 0.95 --region crosswalk --device velodyne-vlp-16:1-4`

    Args:
        sensors (LAYOUT): A layout file, or the name of a strategy; Cam-d1 if not given.
        target: Search for the cheapest mix of devices that reaches this score, in place of a
            better layout. The score is detectability if no --weight is given.
        device (DEVICE:COUNTS): In place of a layout: a device of the catalogue, and the number
            of it, at the junction's corners and roadsides where the search begins; repeat it
            for others. With --target the numbers to try, such as 0-4 or 0,4,8; those of the
            layout if not given.
        poles: With --device, the most poles that carry the sensors; one each if not given.
        pole_price (--pole-price SCORE): What a new pole must gain, such as 0.01: it is taken from
            the score of a layout for each unit that stands on no pole of the map.
        checkpoint (FILE.npz): Save the state of the search every 10 s; resume from the file if
            it exists.
    """
    from inspe_jax.report.tables import before_after_table, moves_table

    claims.folder(folder, (*FILES, PICTURE), force=force)
    check_output(checkpoint, (".npz",))
    if target is not None:
        if checkpoint is not None or start != "given":
            raise InspeError("--target searches many mixes: leave out --checkpoint and --start")
        if poles is not None or pole_price:
            raise InspeError("--poles and --pole-price are for one mix: leave out --target")
        _find_cheapest(source, sensors or common.DEFAULT_LAYOUT, target, folder, options)
        return
    if options.price:
        raise InspeError("--price is for --target: other searches do not count what devices cost")
    objective, constraints = options.checked(start, pole_price=pole_price)
    mix = _mix(options.device, sensors)
    if poles is not None and not mix:
        raise InspeError("--poles is for a mix: give --device; a layout has its poles already")
    if mix:
        with common.busy(f"reading {source}"):
            world = load_scene(source, options.profile)
            placed = starting_layout(world, mix, poles=poles)
    else:
        given = sensors or common.DEFAULT_LAYOUT
        world, placed = common.scene_and_layout(source, given, options.profile)
    cases = options.cases(world)
    with common.search_bar("searching") as callback:
        result = search.optimise(
            cases,
            placed,
            options.method,
            options.seconds,
            options.evaluations,
            options.seed,
            objective,
            constraints,
            start,
            progress=lambda done, best: callback(done, best, ""),
            checkpoint=checkpoint,
        )
    common.out.print(before_after_table(result))
    common.out.print(moves_table(result.start, result.layout))
    common.out.print(
        f"{result.method}, seed {result.seed}: {result.status} "
        f"({STATUSES[result.status]}) after {result.seconds:.0f} s, "
        f"{result.evaluations:.0f} exact scores' work"
    )
    common.note(*result.notes)
    folder, around = _save(world, result, folder), ""
    for key, value in result.scores.conditions.record.items():
        around += f" --{key} {value}" if value != FAIR.record[key] else ""
    if further := [name for name in result.scores.metrics if not METRICS[name].usual]:
        around += f" --metrics {','.join(further)}"
    common.out.print(f"next: inspe score {source} {folder / 'layout.yaml'}{around} --plot plan.png")


@command()
def compare(
    source: str = common.DEFAULT_SCENE,
    sensors: str = common.DEFAULT_LAYOUT,
    *,
    methods: str = "",
    seeds: int = 3,
    start: str = "given",
    folder: Path = Path("compared"),
    force: bool = False,
    options: SearchOptions,
) -> None:
    """Compare search methods on equal terms: how good their layouts are, and how soon.

    The time of a method begins after it has compiled. Ctrl-C ends with the searches so far. The
    folder of --out gets compare.csv, history.csv, compare.png and layout.yaml, the best layout
    found.

    Examples:

    - `inspe compare --methods greedy-adam,grid --seconds 10 --seeds 1`
    - `inspe compare j189.npz layout.yaml --seconds 60 --seeds 5 --out j189_methods`

    Args:
        methods (A,B,…): Search methods, separated by commas; all but the controls if not given.
        seeds: Number of searches by each method; their seeds count from 0.
    """
    from inspe_jax.report.searches import history_view
    from inspe_jax.report.tables import comparison_table

    files = ("compare.csv", "history.csv", "layout.yaml", "compare.png")
    claims.folder(folder, files, force=force)
    objective, constraints = options.checked()
    names = [name.strip() for name in methods.split(",") if name.strip()]
    controls = {method.name for method in CONTROLS}
    names = names or [name for name in search.methods() if name not in controls]
    search.check_search(names, start, range(seeds))
    world, placed = common.scene_and_layout(source, sensors, options.profile)
    cases = options.cases(world)
    runs = [(name, seed) for name in names for seed in range(seeds)]
    with common.search_bar("comparing") as callback:
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
                (runs.index((name, seed)) + done) / len(runs), best, f"{name}, seed {seed}"
            ),
        )
    common.out.print(comparison_table(results))
    folder = claims.keep(partial(save_comparison, results), folder)
    common.note(*dict.fromkeys(words for result in results for words in result.notes))
    if len(results) < len(runs):
        common.note(f"stopped after {len(results)} of {len(runs)} searches")
    common.out.print(f"wrote compare.csv, history.csv and layout.yaml into {folder}")
    common.draw(lambda: history_view(results), folder / "compare.png")


@command()
def pareto(
    source: str = common.DEFAULT_SCENE,
    *,
    options: DeviceOptions,
    budget: float | None = None,
    folder: Path = Path("pareto"),
    force: bool = False,
) -> None:
    """Compare mixes of devices by cost and score, and show which are worth their money.

    For every mix a search places the sensors, from a start at the junction's corners and
    roadsides. Ctrl-C ends with the mixes so far. The folder of --out gets pareto.csv, pareto.png
    and a layout file for each mix on the Pareto front.

    Examples:

    - `inspe pareto`  (one to four 16-channel LiDARs at the built-in four-way)
    - `inspe pareto j189.npz --device hesai-xt32:0-2 --device paper-camera:0,4,8
      --price hesai-xt32=5000 --price paper-camera=800 --seconds 30`
    - `inspe pareto roundabout --budget 10000 --failures`

    Args:
        budget (USD): Leave out mixes of devices that cost more.
    """
    from inspe_jax.report.searches import pareto_view
    from inspe_jax.report.tables import pareto_table

    objective, constraints = options.checked(budget=budget)
    wanted = device_counts(options.device)
    mixes = [row for _, row in studies.device_mixes(wanted, objective)]
    names = ("pareto.csv", "pareto.png", *map(studies.layout_file, mixes))
    claims.folder(folder, names, force=force)
    with common.busy(f"reading {source}"):
        world = load_scene(source, options.profile)
    cases = options.cases(world)
    with common.search_bar("searching") as callback:
        how = options.of_mixes(callback, objective=objective, constraints=constraints)
        found = studies.pareto(cases, wanted, **how)
    common.out.print(pareto_table(found))
    folder = claims.keep(partial(studies.save_pareto, found), folder)
    common.note(*(f"{mix.name}: {words}" for mix in found for words in mix.result.notes))
    if len(found) < len(mixes):
        common.note(f"stopped after {len(found)} of {len(mixes)} mixes")
    common.out.print(f"wrote pareto.csv and the layouts of the front into {folder}")
    common.draw(lambda: pareto_view(found), folder / "pareto.png")


def _mix(device: list[str] | None, sensors: str | None) -> dict[str, int]:
    """The number of each device of ``--device``; raises InspeError where it is not one number."""
    mix = device_counts(device) if device else {}
    for name, several in mix.items():
        catalogue.device(name)
        if len(several) > 1 or several[0] < 0:
            raise InspeError(f"--device {name}: one number of it; several are for --target")
    if mix and (sensors or not sum(n for (n,) in mix.values())):
        what = f"{sensors} has its own devices: give one of them" if sensors else "no sensor"
        raise InspeError(f"--device: {what}")
    return {name: n for name, (n,) in mix.items()}


def _find_cheapest(
    source: str, sensors: str, target: float, folder: Path, options: DeviceOptions
) -> None:
    """`inspe optimise --target`: the cheapest mix of devices that reaches a score."""
    from inspe_jax.report.tables import cheapest_table

    studies.check_target(target)
    if not options.weight:
        options = replace(options, weight=["detectability=1"])
    objective, constraints = options.checked()
    given = device_counts(options.device) if options.device else None
    if given:
        studies.device_mixes(given, objective)
    world, placed = common.scene_and_layout(source, sensors, options.profile)
    cases = options.cases(world)
    names = [sensor.spec.name for sensor in placed.sensors]
    of_layout = {name: range(names.count(name) + 1) for name in sorted({*names})}
    with common.search_bar("searching") as callback:
        how = options.of_mixes(callback, objective=objective, constraints=constraints)
        found = studies.cheapest(cases, given or of_layout, target, **how)
    common.out.print(cheapest_table(found))
    best = found.best
    words = f"{best.name} reaches {target:g}"
    if len(found.searched) > 1:
        words += ", and no mix before it, which cost no more"
    if found.found is None:
        words = f"none reaches {target:g}; the best is {best.name}"
    common.out.print(f"{words}; {len(found.searched)} of {found.total} mixes were searched")
    _save(world, best.result, folder)


def _save(world: Scene, result: Result, folder: Path) -> Path:
    """Write and draw a search, in the folder that is returned."""
    from inspe_jax.report.searches import before_after

    folder = claims.keep(partial(save_result, result), folder)
    common.out.print(
        f"wrote layout.yaml, start.yaml, result.json, history.csv and path.csv into {folder}"
    )
    parts = (result.start, result.layout, result.scores_before, result.scores)
    common.draw(lambda: before_after(world, *parts, path=result.path), folder / PICTURE)
    return folder
