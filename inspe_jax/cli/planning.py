"""Cost against score, and errors of installation: `inspe pareto` and `inspe tolerance`.

Imports are inside the commands: gradient libraries and matplotlib load slowly.
"""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from inspe_jax.cli.claims import claims
from inspe_jax.cli.common import (
    DEFAULT_LAYOUT,
    DEFAULT_SCENE,
    busy,
    draw,
    note,
    out,
    progress,
    scene_and_layout,
    search_bar,
    show,
)
from inspe_jax.cli.options import (
    DEFAULT_DEVICES,
    ScoreOptions,
    SearchOptions,
    command,
    counts,
    prices,
)
from inspe_jax.placement.optimise import DEFAULT_METHOD, check_search
from inspe_jax.placement.problem import Case
from inspe_jax.placement.studies import pareto as studies
from inspe_jax.placement.studies.pareto import device_mixes, layout_file, save_pareto
from inspe_jax.placement.studies.tolerance import check_errors
from inspe_jax.placement.studies.tolerance import tolerance as installed
from inspe_jax.scene.scene import load_scene
from inspe_jax.sensing.conditions import Conditions


@command()
def pareto(
    source: str = DEFAULT_SCENE,
    *,
    device: list[str] | None = None,
    price: list[str] | None = None,
    budget: float | None = None,
    method: str | None = None,
    seed: int = 0,
    folder: Path = Path("pareto"),
    force: bool = False,
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

    Args:
        budget (USD): Leave out mixes of devices that cost more.
        seed: Seed of the searches.
    """
    from inspe_jax.report.curves import pareto_view
    from inspe_jax.report.tables import pareto_table

    objective, constraints = options.checked(prices=prices(price), budget=budget)
    check_search((method or DEFAULT_METHOD,), objective, seeds=(seed,))
    wanted = counts(device or list(DEFAULT_DEVICES))
    mixes = [row for _, row in device_mixes(wanted, objective)]
    names = ("pareto.csv", "pareto.png", *map(layout_file, mixes))
    claims.folder(folder, names, force=force)
    with busy(f"reading {source}"):
        cases = options.cases(load_scene(source, options.profile))
    with search_bar("searching") as callback:
        found = studies.pareto(
            cases,
            wanted,
            objective=objective,
            constraints=constraints,
            **options.of_mixes(method, seed, callback),
        )
    out.print(pareto_table(found))
    folder = claims.keep(partial(save_pareto, found), folder)
    note(*(f"{mix.name}: {words}" for mix in found for words in mix.result.notes))
    if len(found) < len(mixes):
        note(f"stopped after {len(found)} of {len(mixes)} mixes")
    out.print(f"wrote pareto.csv and the layouts of the front into {folder}")
    draw(lambda: pareto_view(found), folder / "pareto.png")


@command()
def tolerance(
    source: str = DEFAULT_SCENE,
    sensors: str = DEFAULT_LAYOUT,
    *,
    position: float = 0.1,
    angle: float = 1.0,
    samples: int = 50,
    seed: int = 0,
    light: str = "midday",
    weather: str = "clear",
    profile: str | None = None,
    record: str | None = None,
    force: bool = False,
    options: ScoreOptions,
) -> None:
    """Show how installation errors change the score: a slope for each sensor, and random errors.

    A slope says how much P_sm gains when one sensor is moved by 10 cm or turned by 1°. The scores
    after random errors are exact.

    Examples:

    - `inspe tolerance`  (the built-in four-way with cameras at its corners)
    - `inspe tolerance j189.npz better/layout.yaml --position 0.2 --angle 2`
    - `inspe tolerance j189.npz layout.yaml --json tolerance.json`

    Args:
        position: Standard deviation of each of x, y and z [m].
        angle: Standard deviation of yaw and of pitch [degrees].
        samples: Number of random installations.
        seed: Seed of the random errors.
    """
    from inspe_jax.report.tables import tolerance_record, tolerance_table

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
        case = Case(world, conditions)
        found = installed(case, placed, **errors, objective=objective, progress=report)
    show(tolerance_table(found, placed), tolerance_record(found, world, placed), record)
