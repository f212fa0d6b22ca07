"""Cost against score, and errors of installation: `inspe pareto` and `inspe tolerance`.

Imports are inside the commands: gradient libraries and matplotlib load slowly.
"""

from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from inspe_jax.cli.claims import ForceOption, claims
from inspe_jax.cli.common import (
    DEFAULT_LAYOUT,
    DEFAULT_SCENE,
    LayoutArgument,
    LightOption,
    ProfileOption,
    RecordOption,
    SceneArgument,
    WeatherOption,
    app,
    busy,
    err,
    note,
    out,
    progress,
    scene_and_layout,
    search_bar,
    show,
)
from inspe_jax.cli.options import (
    DEFAULT_DEVICES,
    DeviceCountsOption,
    MethodOption,
    OutOption,
    PriceOption,
    ScoreOptions,
    SearchOptions,
    counts,
    prices,
    takes,
)


@app.command()
@takes(SearchOptions)
def pareto(
    source: SceneArgument = DEFAULT_SCENE,
    device: DeviceCountsOption = None,
    price: PriceOption = None,
    budget: Annotated[
        float | None, typer.Option(metavar="USD", help="Leave out mixes of devices that cost more.")
    ] = None,
    method: MethodOption = None,
    seed: Annotated[int, typer.Option(help="Seed of the searches.")] = 0,
    folder: OutOption = Path("pareto"),
    force: ForceOption = False,
    *,
    options: SearchOptions,
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
    """
    from inspe_jax.core.sheet import save_figure
    from inspe_jax.placement.optimise import DEFAULT_METHOD, check_search
    from inspe_jax.placement.studies.pareto import device_mixes, layout_file, save_pareto
    from inspe_jax.placement.studies.pareto import pareto as search
    from inspe_jax.report.curves import pareto_view
    from inspe_jax.report.tables import pareto_table
    from inspe_jax.scene.scene import load_scene

    objective, constraints = options.checked(prices=prices(price), budget=budget)
    check_search((method or DEFAULT_METHOD,), objective, seeds=(seed,))
    wanted = counts(device or list(DEFAULT_DEVICES))
    mixes = [row for _, row in device_mixes(wanted, objective)]
    names = ("pareto.csv", "pareto.png", *map(layout_file, mixes))
    claims.folder(folder, names, force=force)
    with busy(f"reading {source}"):
        cases = options.cases(load_scene(source, options.profile))
    with search_bar("searching") as callback:
        found = search(
            cases,
            wanted,
            objective=objective,
            constraints=constraints,
            **options.of_mixes(method, seed, callback),
        )
    out.print(pareto_table(found))
    folder = claims.keep(partial(save_pareto, found), folder)
    note(f"{mix.name}: {words}" for mix in found for words in mix.result.notes)
    if len(found) < len(mixes):
        err.print(f"[yellow]Note:[/] stopped after {len(found)} of {len(mixes)} mixes")
    with busy("drawing"):
        save_figure(pareto_view(found), folder / "pareto.png")
    out.print(
        f"wrote pareto.csv and the layouts of the front into {folder}; drew {folder / 'pareto.png'}"
    )


@app.command()
@takes(ScoreOptions)
def tolerance(
    source: SceneArgument = DEFAULT_SCENE,
    sensors: LayoutArgument = DEFAULT_LAYOUT,
    position: Annotated[
        float, typer.Option(help="Standard deviation of each of x, y and z [m].")
    ] = 0.1,
    angle: Annotated[
        float, typer.Option(help="Standard deviation of yaw and of pitch [degrees].")
    ] = 1.0,
    samples: Annotated[int, typer.Option(help="Number of random installations.")] = 50,
    seed: Annotated[int, typer.Option(help="Seed of the random errors.")] = 0,
    light: LightOption = "midday",
    weather: WeatherOption = "clear",
    profile: ProfileOption = None,
    record: RecordOption = None,
    force: ForceOption = False,
    *,
    options: ScoreOptions,
) -> None:
    """Show how installation errors change the score: a slope for each sensor, and random errors.

    A slope says how much P_sm gains when one sensor is moved by 10 cm or turned by 1°. The scores
    after random errors are exact.

    Examples:

    - `inspe tolerance`  (the built-in four-way with cameras at its corners)
    - `inspe tolerance j189.npz better/layout.yaml --position 0.2 --angle 2`
    - `inspe tolerance j189.npz layout.yaml --json tolerance.json`
    """
    from inspe_jax.placement.problem import Case
    from inspe_jax.placement.studies.tolerance import check_errors
    from inspe_jax.placement.studies.tolerance import tolerance as installed
    from inspe_jax.report.tables import tolerance_record, tolerance_table
    from inspe_jax.sensing.conditions import Conditions

    claims.file(record, force=force)
    objective = options.objective()
    errors = dict[str, Any](
        position=position, angle=float(np.radians(angle)), samples=samples, seed=seed
    )
    check_errors(**errors)
    conditions = Conditions.of(light, weather)
    with busy(f"reading {source}"):
        world, placed = scene_and_layout(source, sensors, profile)
    with progress("installations") as report:
        found = installed(
            Case(world, conditions),
            placed,
            **errors,
            objective=objective,
            progress=report,
        )
    show(tolerance_table(found, placed), tolerance_record(found, world, placed), record)
