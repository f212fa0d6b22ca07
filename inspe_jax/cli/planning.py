"""What sensors cost, and what their installation may get wrong: `inspe pareto`, `tolerance`.

Imports stay inside the commands, as of the gradient libraries and matplotlib.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from inspe_jax.cli.common import (
    DEFAULT_LAYOUT,
    DEFAULT_SCENE,
    LayoutArgument,
    LightOption,
    ProfileOption,
    SceneArgument,
    WeatherOption,
    app,
    busy,
    check_record,
    err,
    note,
    out,
    progress,
    scene_and_layout,
    search_bar,
    show,
)
from inspe_jax.cli.options import (
    MethodOption,
    OutOption,
    PriceOption,
    SearchOptions,
    WeightOptions,
    counts,
    prices,
    takes,
)

DEFAULT_DEVICES = ("velodyne-vlp-16:1-4",)


@app.command()
@takes(SearchOptions)
def pareto(
    source: SceneArgument = DEFAULT_SCENE,
    device: Annotated[
        list[str] | None,
        typer.Option(
            metavar="DEVICE:COUNTS",
            help="A device of the catalogue and how many of it to try: 0-4, or 0,4,8; as often as "
            f"you like. {DEFAULT_DEVICES[0]} if none is given.",
        ),
    ] = None,
    price: PriceOption = None,
    budget: Annotated[
        float | None, typer.Option(metavar="USD", help="Leave out mixes that cost more.")
    ] = None,
    method: MethodOption = None,
    seed: Annotated[int, typer.Option(help="Seed of the searches.")] = 0,
    folder: OutOption = Path("pareto"),
    *,
    options: SearchOptions,
) -> None:
    """Cost against score: search for places for every mix of devices, and show which are worth it.

    Every mix starts at the junction's corners and roadsides and gets a search of its own. Ctrl-C
    ends with the mixes so far. Into --out go pareto.csv, pareto.png and a layout for each mix that
    no other beats.

    Examples:

    - `inspe pareto`  (one to four 16-channel LiDARs at the built-in four-way)
    - `inspe pareto j189.npz --device hesai-xt32:0-2 --device paper-camera:0,4,8
      --price hesai-xt32=5000 --price paper-camera=800 --seconds 30`
    - `inspe pareto roundabout --budget 10000 --failures`
    """
    from inspe_jax.core.files import check_folder
    from inspe_jax.placement.optimise import DEFAULT_METHOD
    from inspe_jax.placement.studies.pareto import device_mixes, mix_name, save_pareto
    from inspe_jax.placement.studies.pareto import pareto as search
    from inspe_jax.report.cost import pareto_view
    from inspe_jax.report.sheet import save_figure
    from inspe_jax.report.tables import pareto_table
    from inspe_jax.scene.scene import load_scene

    check_folder(folder)
    objective, constraints = options.checked(prices=prices(price), budget=budget)
    wanted = counts(device or list(DEFAULT_DEVICES))
    total = len(device_mixes(wanted, objective))
    with busy(f"reading {source}"):
        cases = options.cases(load_scene(source, options.profile))
    with search_bar("searching") as tell:
        found = search(
            cases,
            wanted,
            method=method or DEFAULT_METHOD,
            seconds=options.seconds_each(),
            evaluations=options.evaluations,
            seed=seed,
            objective=objective,
            constraints=constraints,
            progress=None
            if tell is None
            else lambda row, done, best: tell(done, best, mix_name(row)),
        )
    save_pareto(found, folder)
    out.print(pareto_table(found))
    note(f"{mix.name}: {words}" for mix in found for words in mix.result.notes)
    if len(found) < total:
        err.print(f"[yellow]Note:[/] stopped after {len(found)} of {total} mixes")
    with busy("drawing"):
        save_figure(pareto_view(found), folder / "pareto.png")
    out.print(
        f"wrote pareto.csv and the layouts of the front into {folder}; "
        f"drew {folder / 'pareto.png'}",
        highlight=False,
        soft_wrap=True,
    )


@app.command()
@takes(WeightOptions)
def tolerance(
    source: SceneArgument = DEFAULT_SCENE,
    sensors: LayoutArgument = DEFAULT_LAYOUT,
    position: Annotated[
        float, typer.Option(help="Standard deviation of each of x, y and z [m].")
    ] = 0.1,
    angle: Annotated[
        float, typer.Option(help="Standard deviation of yaw and of pitch [degrees].")
    ] = 1.0,
    samples: Annotated[int, typer.Option(help="Random installations.")] = 50,
    seed: Annotated[int, typer.Option(help="Seed of their errors.")] = 0,
    light: LightOption = "midday",
    weather: WeatherOption = "clear",
    profile: ProfileOption = None,
    record: Annotated[
        str | None,
        typer.Option("--json", metavar="FILE|-", help="Write it all as JSON; - for stdout."),
    ] = None,
    *,
    options: WeightOptions,
) -> None:
    """What an installation error costs: slopes by sensor, and the P_sm that random errors leave.

    Slopes say what P_sm gains when one sensor is moved by 10 cm or turned by 1°; the scores after
    random errors are exact.

    Examples:

    - `inspe tolerance`  (the built-in four-way with cameras at its corners)
    - `inspe tolerance j189.npz better/layout.yaml --position 0.2 --angle 2`
    - `inspe tolerance j189.npz layout.yaml --json tolerance.json`
    """
    from inspe_jax.placement.problem import Case, Objective
    from inspe_jax.placement.studies.tolerance import tolerance as installed
    from inspe_jax.report.tables import tolerance_record, tolerance_table
    from inspe_jax.sensing.conditions import Conditions

    check_record(record)
    objective = Objective(weights=options.weights())
    objective.check()
    conditions = Conditions.of(light, weather)
    with busy(f"reading {source}"):
        world, placed = scene_and_layout(source, sensors, profile)
    with progress("installations") as report:
        found = installed(
            Case(world, conditions),
            placed,
            position=position,
            angle=float(np.radians(angle)),
            samples=samples,
            seed=seed,
            objective=objective,
            progress=report,
        )
    show(tolerance_table(found, placed), tolerance_record(found, world, placed), record)
