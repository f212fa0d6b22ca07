"""Many searches or scores at once: `inspe plan` and `inspe sweep`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import typer

from inspe_jax.cli import common
from inspe_jax.cli.claims import claims
from inspe_jax.cli.options import MapOptions, WeightOptions, command, device_counts, numbers, prices
from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import check_folder, write_text
from inspe_jax.core.words import counted
from inspe_jax.mounting.mixes import mix_name
from inspe_jax.placement.objective import Objective
from inspe_jax.placement.studies.pareto import device_mixes
from inspe_jax.scene.georeference import Georeference
from inspe_jax.scene.maps.registry import open_map
from inspe_jax.scene.maps.road_map import RoadMap
from inspe_jax.sensing.layout import load_layout
from inspe_jax.sensing.layout_geojson import DIGITS, point_feature
from inspe_jax.study.plan import SCORE_ONLY, Study, load_study
from inspe_jax.study.sweep import Row
from inspe_jax.study.sweep import sweep as run

if TYPE_CHECKING:
    from inspe_jax.study.city import CityPlan

METHOD, EVALUATIONS = "greedy", 100.0
"""Method of the searches of a plan, and the budget of each in exact scores."""
FILES = ("plan.csv", "plan.png", "plan.geojson")
SHOWN = 5  # number of failures whose error is printed


@dataclass(frozen=True)
class RunOptions:
    """How a study is run.

    Attributes:
        dry_run: Only check the input, and print how many jobs it has.
    """

    scheduler: str | None = None
    workers: int | None = None
    dry_run: bool = False

    def rows(self, study: Study, folder: Path, what: str) -> list[Row]:
        """The rows of a study, run with a bar that counts ``what``."""
        with common.resumable(), common.progress(what) as tell:
            return run(study, folder, scheduler=self.scheduler, workers=self.workers, progress=tell)


@command()
def plan(
    source: Path,
    *,
    budget: float,
    junctions: str = "signals",
    driving_side: str | None = None,
    device: list[str] | None = None,
    price: list[str] | None = None,
    worst: bool = False,
    importance: list[str] | None = None,
    build: MapOptions,
    method: str = METHOD,
    evaluations: float | None = None,
    seconds: float | None = None,
    seed: int = 0,
    options: WeightOptions,
    running: RunOptions,
    folder: Path = Path("plan"),
    force: bool = False,
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
        method: Method of each search; `inspe compare` lists all methods.
        evaluations: Work of each search, in exact scores; 100 without a budget. A run that was
            stopped then ends with the same plan.
        seconds: Time of each search [s].
        seed: Seed of the traffic and of the searches.
    """
    from inspe_jax.core.sheet import save_figure
    from inspe_jax.study import city
    from inspe_jax.study.budget import check_budget
    from inspe_jax.study.city_report import city_view

    if not running.dry_run:
        claims.folder(folder, FILES, force=force)
    check_budget(budget)
    if method == SCORE_ONLY:
        raise InspeError(f"--method {method}: a plan needs a search")
    given = numbers("--importance", importance, "ID=WEIGHT, such as 189=2")
    scored = options.objective()
    mixes = device_mixes(device_counts(device), Objective(prices=prices(price)))
    if evaluations is None and seconds is None:
        evaluations = EVALUATIONS
    settings = dict(
        profile=options.profile,
        seed=seed,
        light=options.light,
        weather=options.weather,
        weights=scored.weights,
        method=method,
        evaluations=evaluations,
        seconds=seconds,
        search_seed=seed,
    )
    more: dict[str, Any] = dict(metrics=list(scored.metrics))
    if options.detection is not None:
        more["detection"] = str(options.detection.resolve())
    with common.busy(f"reading {source}"):
        places = city.choose_junctions(source, junctions, driving_side)
        city.check_importance(given, places)
        study = city.city_study(
            source,
            places,
            [row for _, row in mixes],
            {key: value for key, value in settings.items() if value is not None} | build.given,
            driving_side,
            **more,
        )
    size = float(study.jobs[0].settings["radius"])
    if pairs := city.close_pairs(places, 2 * size):
        common.note(
            f"{counted(pairs, 'pair')} of junctions are nearer to each other than twice the "
            "radius: their regions overlap, and each counts its own sensors alone"
        )
    if running.dry_run:
        common.out.print(
            f"{source.name}: {counted(len(places), 'junction')}, mixes of devices: {len(mixes)}, "
            f"searches: {len(study.jobs):,}"
        )
        return
    rows = running.rows(study, folder, "searches")
    costs = {mix_name(row): cost for cost, row in mixes}
    with common.busy("sharing out the budget"):
        fronts = city.fronts_of(study, rows, places, costs)
        found = city.plan_city(fronts, budget, worst=worst, importance=given)
    place = open_map(source, driving_side)
    georeference = _projection(place)
    if georeference and (doubt := georeference.doubt(places[0].center)):
        common.note(doubt)
    _show(found, georeference)
    with common.busy("drawing"):
        write_text(folder / "plan.csv", found.text(georeference))
        save_figure(city_view(found, source.name, place.road_lines()), folder / "plan.png")
        if georeference:
            text = _geojson(found, place, folder, size, georeference)
            write_text(folder / "plan.geojson", text)
    common.out.print(f"wrote {', '.join(FILES if georeference else FILES[:2])} into {folder}")


def _show(found: "CityPlan", georeference: Georeference | None) -> None:
    """Print the plan, and which searches failed."""
    from inspe_jax.study.city_report import plan_table, plan_words

    common.out.print(plan_table(found, georeference))
    common.out.print("\n".join(plan_words(found)))
    common.note(*(f"junction {name} is left out: {why}" for name, why in found.left_out.items()))
    failed = [f"junction {one.name}: {words}" for one in found.fronts for words in one.errors]
    common.note_some(failed, SHOWN, "results.csv has their errors")
    if failed or found.left_out:
        common.note("some searches failed; the same command tries them again")


def _projection(place: RoadMap) -> Georeference | None:
    """The projection of a map; None where it has none, and with a note where it cannot be used."""
    try:
        if place.georeference is not None:
            place.georeference.check()
        return place.georeference
    except InspeError as e:
        common.note(f"no coordinates: {e}")
        return None


def _geojson(
    found: "CityPlan", place: RoadMap, folder: Path, radius: float, georeference: Georeference
) -> str:
    """The plan as GeoJSON. Each junction that gets devices is read once more for its ground."""
    from inspe_jax.report.handover import city_geojson

    layouts, points = {}, []
    for front, option in zip(found.fronts, found.chosen, strict=True):
        at = georeference.to_degrees(np.array(front.junction.center[:2])[None])[0].round(DIGITS)
        about = dict(mix=option.mix, cost_usd=option.cost, score=option.score)
        points.append(point_feature(at.tolist(), feature="junction", junction=front.name, **about))
        if option.key:
            here = place.read(front.junction.id, None, radius)
            layouts[front.name] = load_layout(folder / option.layout), here
    return city_geojson(layouts, points)


@command()
def sweep(source: Path, *, running: RunOptions, folder: Path = Path("sweep")) -> None:
    """Score every layout on every scene in every setting, or run a search from each.

    A study says what to combine. Every setting is one value or a list of values:

        scenes:
          - built_in: four_way
          - {map: Town05.xodr, junction: 53, radius: 60}
          - file: saved.npz
        layouts: [Cam-d1, Cam-d1/L-d1, layout.yaml, {mix: {hesai-xt32: 2, paper-camera: 4}}]
        settings:
          density: [low, medium, high]
          light: [midday, night]
          weather: [clear, "rain:10"]
          weights: [{coverage: 0.3, occlusion: 0.7}, {information_gain: 1}]
        metrics: [detectability]
        detection: mine.toml

    A mix has as many sensors of each device, at corners and roadsides, where a search begins.
    Curves of detectability are those of `inspe score --detection`; a job's key depends on them.
    The folder of --out gets results.csv, with one row for each job and all its settings. To resume
    a run that was stopped or killed, give the same command again. If a job fails, its row has the
    error, and the exit status is 1.

    Examples:

    - `inspe sweep study.yaml --dry-run`
    - `inspe sweep study.yaml --out results --workers 8`
    - `inspe sweep study.yaml --out results --scheduler tcp://cluster:8786`

    Args:
        source (STUDY.yaml): Scenes, layouts and settings; see above.
    """
    from inspe_jax.report.tables import sweep_table

    check_folder(folder)
    with common.busy(f"reading {source}"):
        study = load_study(source)
    if running.dry_run:
        scenes = {job.scene for job in study.jobs}
        layouts = {job.layout for job in study.jobs}
        common.out.print(
            f"{study.name}: {counted(len(study.jobs), 'job')}, "
            f"{counted(len(layouts), 'layout')} on {counted(len(scenes), 'scene')}"
        )
        return
    rows = running.rows(study, folder, "jobs")
    common.out.print(sweep_table(rows))
    failures = [row for row in rows if row["status"] != "done"]
    errors = [f"{row['layout']} on {row['scene']}: {row['error']}" for row in failures]
    common.note_some(errors, SHOWN, "results.csv has their errors")
    common.out.print(f"wrote {folder / 'results.csv'}")
    if failures:
        common.err.print("some jobs failed; the same command tries them again")
        raise typer.Exit(1)
