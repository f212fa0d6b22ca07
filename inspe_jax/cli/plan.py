"""One budget for the junctions of a map: `inspe plan`.

Imports are inside the command: Dask and matplotlib load slowly.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from inspe_jax.cli.claims import claims
from inspe_jax.cli.common import busy, note, note_some, out, run_study
from inspe_jax.cli.options import (
    DEFAULT_DEVICES,
    MapOptions,
    WeightOptions,
    command,
    counts,
    numbers,
    prices,
)
from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import write_text
from inspe_jax.core.words import counted
from inspe_jax.mounting.mixes import mix_name
from inspe_jax.placement.objective import Objective
from inspe_jax.placement.studies.pareto import device_mixes
from inspe_jax.scene.georeference import Georeference
from inspe_jax.scene.maps.registry import georeference_of, read_map, road_lines
from inspe_jax.sensing.layout import load_layout
from inspe_jax.study.plan import SCORE_ONLY

if TYPE_CHECKING:
    from inspe_jax.study.city import CityPlan


METHOD, EVALUATIONS = "greedy", 100.0
"""Method of the searches, and the budget of each in exact scores."""
FILES = ("plan.csv", "plan.png", "plan.geojson")
SHOWN = 5
"""Number of mixes that failed whose error is printed."""


@command()
def plan(
    source: Path,
    *,
    budget: float,
    junctions: str = "signals",
    device: list[str] | None = None,
    price: list[str] | None = None,
    worst: bool = False,
    importance: list[str] | None = None,
    build: MapOptions,
    light: str = "midday",
    weather: str = "clear",
    profile: str | None = None,
    method: str = METHOD,
    evaluations: float | None = None,
    seconds: float | None = None,
    seed: int = 0,
    scheduler: str | None = None,
    workers: int | None = None,
    retry: bool = False,
    dry_run: bool = False,
    folder: Path = Path("plan"),
    force: bool = False,
    options: WeightOptions,
) -> None:
    """Share one budget out among the junctions of a map, where it does most.

    For every junction and every mix of devices a search places the sensors, from a start at the
    junction's corners and roadsides. The mixes that are worth their money are the junction's
    options, and so is nothing. Then one option is chosen for each junction: the greatest weighted
    sum of scores, or with --worst the greatest least score, that the budget allows.

    The folder of --out gets plan.csv, plan.png, plan.geojson where the map has coordinates,
    results.csv with a row for each search, and the layouts. To resume a run that was stopped or
    killed, give the same command again. Another --budget, --price, --importance or --worst uses the
    searches of the folder; more junctions or mixes only add theirs.

    Examples:

    - `inspe plan city.osm --budget 250000 --device hesai-xt32:0-2 --device paper-camera:0,2,4
      --price hesai-xt32=5000 --price paper-camera=800`
    - `inspe plan town.net.xml --junctions 189,401,53 --importance 189=3 --budget 20000 --worst`
    - `inspe plan city.osm --junctions all --budget 250000 --dry-run`

    Args:
        source (MAP): A map (.xodr, .net.xml, .osm).
        budget (USD): What all junctions together may cost.
        junctions (signals|all|ID,…): Junctions of the map: those with signals, all, or ids with
            commas between; `inspe scene MAP --list` lists them.
        worst: Maximise the least score of a junction, and then the sum; without it, the
            weighted sum.
        importance (ID=WEIGHT): Weight of a junction in the sum, 1 if not given; repeat it for
            other junctions.
        profile (NAME): Profile; paper if not given. See `inspe profiles`.
        method: Method of each search; `inspe compare` lists all methods.
        evaluations: Work of each search, in exact scores; 100 without a budget. A run that was
            stopped then ends with the same plan.
        seconds: Time of each search [s].
        seed: Seed of the traffic and of the searches.
        retry: Search again where an earlier run failed.
        dry_run: Only check the input, and print how many searches it has.
    """
    from inspe_jax.study.budget import check_budget
    from inspe_jax.study.city import (
        check_importance,
        choose_junctions,
        city_study,
        close_pairs,
        fronts_of,
        plan_city,
    )

    if not dry_run:
        claims.folder(folder, FILES, force=force)
    check_budget(budget)
    if method == SCORE_ONLY:
        raise InspeError(f"--method {method}: a plan needs a search")
    given = numbers("--importance", importance, "ID=WEIGHT, such as 189=2")
    options.curves()
    mixes = device_mixes(counts(device or list(DEFAULT_DEVICES)), Objective(prices=prices(price)))
    if evaluations is None and seconds is None:
        evaluations = EVALUATIONS
    settings = dict(
        profile=profile,
        seed=seed,
        light=light,
        weather=weather,
        weights=options.weights(),
        method=method,
        evaluations=evaluations,
        seconds=seconds,
        search_seed=seed,
    )
    more: dict[str, Any] = dict(metrics=list(options.further()))
    if options.detection is not None:
        more["detection"] = str(options.detection.resolve())
    with busy(f"reading {source}"):
        places = choose_junctions(source, junctions)
        check_importance(given, places)
        study = city_study(
            source,
            places,
            [row for _, row in mixes],
            {key: value for key, value in settings.items() if value is not None} | build.given,
            **more,
        )
    size = float(study.jobs[0].settings["radius"])
    if pairs := close_pairs(places, 2 * size):
        note(
            f"{counted(pairs, 'pair')} of junctions are nearer to each other than twice the "
            "radius: their regions overlap, and each counts its own sensors alone"
        )
    if dry_run:
        out.print(
            f"{source.name}: {counted(len(places), 'junction')}, mixes of devices: {len(mixes)}, "
            f"searches: {len(study.jobs):,}"
        )
        return
    rows = run_study(study, folder, "searches", scheduler=scheduler, workers=workers, retry=retry)
    costs = {mix_name(row): cost for cost, row in mixes}
    with busy("sharing out the budget"):
        fronts = fronts_of(study, rows, places, costs)
        found = plan_city(fronts, budget, worst=worst, importance=given)
    georeference = _projection(source)
    if georeference and (doubt := georeference.doubt(places[0].center)):
        note(doubt)
    _show(found, georeference)
    with busy("drawing"):
        written = _write(found, source, folder, size, georeference)
    out.print(f"wrote {', '.join(written)} into {folder}")


def _show(found: "CityPlan", georeference: Georeference | None) -> None:
    """Print the plan, and which searches failed."""
    from inspe_jax.study.city_report import plan_table, plan_words

    out.print(plan_table(found, georeference))
    out.print("\n".join(plan_words(found)))
    note(*(f"junction {name} is left out: {why}" for name, why in found.left_out.items()))
    failed = [f"junction {one.name}: {words}" for one in found.fronts for words in one.errors]
    note_some(failed, SHOWN, "results.csv has their errors")
    if failed or found.left_out:
        note("some searches failed; --retry runs them again")


def _write(
    found: "CityPlan",
    source: Path,
    folder: Path,
    radius: float,
    georeference: Georeference | None,
) -> list[str]:
    """Write the plan's files, in place of those of an earlier plan; returns their names."""
    from inspe_jax.core.sheet import save_figure
    from inspe_jax.study.city_report import city_view

    write_text(folder / "plan.csv", found.text(georeference))
    save_figure(city_view(found, source.name, road_lines(source)), folder / "plan.png")
    if georeference is None:
        return list(FILES[:2])
    write_text(folder / "plan.geojson", _geojson(found, source, folder, radius, georeference))
    return list(FILES)


def _projection(source: Path) -> Georeference | None:
    """The projection of a map; None where it has none, and with a note where it cannot be used."""
    georeference = georeference_of(source)
    if georeference is not None:
        try:
            georeference.check()
        except InspeError as e:
            note(f"no coordinates: {e}")
            return None
    return georeference


def _geojson(
    found: "CityPlan", source: Path, folder: Path, radius: float, georeference: Georeference
) -> str:
    """The plan as GeoJSON. Each junction that gets devices is read once more for its ground."""
    from inspe_jax.report.handover import city_geojson

    layouts, points = {}, []
    for front, option in zip(found.fronts, found.chosen, strict=True):
        lon, lat = georeference.to_degrees(np.array(front.junction.center[:2])[None])[0].tolist()
        about = dict(mix=option.mix, cost_usd=option.cost, score=option.score)
        points.append(dict(junction=front.name, longitude=lon, latitude=lat, **about))
        if option.key:
            place = read_map(source, junction=front.junction.id, radius=radius)
            layouts[front.name] = load_layout(folder / option.layout), place
    return city_geojson(layouts, points)
