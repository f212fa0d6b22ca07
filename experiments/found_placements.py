"""Claim: a detector finds more under placements that a search found than under those by hand.

At each of the ten intersections a search for P_sm, under the default profile, begins at each of the
paper's placements of LiDARs, and at that of its placements of cameras under which most is found,
with the same sensors. Where there are cameras, it follows the gradient. By hand, that profile has
cameras look level: what aiming alone brings is told by the same placement with all of them 25°
down. Then all is as in ``table1.py``: the same traffic is recorded, a detector is trained for as
many steps, and measured at two intersections that it has not seen, and on another time at all ten.
Tells its mAP beside that under the placements by hand (``--beside``, the rows of ``table1.py``), of
the seeds that all have, and the mean gain over placements of LiDARs. How much of a gain is due to
gradients is not tested: there is no search without them beside it.

Searches, sets and trainings are in the folder of --keep. A run that was stopped goes on there. A
training that is done has its rows in the CSV in --out.
"""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from common import MAPS, arguments, kept_folder, markdown, need_maps, output, say, write_results
from scipy.stats import ttest_1samp
from table1 import (
    BY_SENSORS,
    HELD_OUT,
    QUICK_HALF,
    SETS,
    STEPS,
    Job,
    Rows,
    check_settings,
    done_in,
    means_of_seeds,
    measured,
    of_job,
    planned,
    predictor_of,
    recorded,
    rows_of,
    train_some,
    trained,
)
from table2 import HERE, QUICK_SIZE, Row, places, run

from inspe_jax.dataset import Cache
from inspe_jax.jobs.sources import LayoutSource
from inspe_jax.perception.inputs import BevGrid
from inspe_jax.perception.training import TrainingSettings
from inspe_jax.simulation.frame import KINDS
from inspe_jax.study.plan import Study, make_study

BY_HAND = {"L-d1": "coalign", "L-d2": "coalign", "L-c": "coalign", "Cam-d2": "lss-resnet"}
"""The placements that searches begin at, and the detector that is trained under each."""
AIMED = "Cam-d2, 25° down"
LOOKS_DOWN: dict[str, Any] = {"strategy": "Cam-d2", "camera_pitch_deg": -25.0, "name": AIMED}
"""The placement of cameras, aimed by hand, as a study file has it."""
SEARCH = 150.0


def options() -> argparse.Namespace:
    """The command line."""
    given = arguments(
        __doc__,
        *("keep", "workers"),
        steps=dict(type=int, default=STEPS, help="of each training"),
        seeds=dict(type=int, default=3, help="trainings of each placement"),
        search=dict(type=float, default=SEARCH, help="in exact scores' work"),
        lights=dict(nargs="+", default=["midday", "night"]),
        densities=dict(nargs="+", default=["medium", "high"]),
        beside=dict(type=Path, default=HERE / "table1.csv", metavar="FILE",
                    help="rows of trainings by hand, of as many steps"),
    )  # fmt: skip
    given.scheduler = None  # its workers could not import table1.py
    if not given.beside.is_file():
        raise SystemExit(f"--beside {given.beside}: no such file; table1.py writes it")
    need_maps(given)
    return given


def study_of(given: argparse.Namespace, name: str, layouts: list[Any], **settings: Any) -> Study:
    """Layouts at each intersection; one of them at a small one if quick."""
    scenes = places(given)
    if given.quick:
        scenes, layouts, settings = scenes[:1], layouts[:1], settings | QUICK_SIZE
    content = dict(scenes=scenes, layouts=layouts, settings=dict(seed=0) | settings)
    return make_study(content, MAPS, "intersections.yaml", name)


def searches(given: argparse.Namespace) -> Study:
    """A search from each placement at each intersection."""
    work = 4 if given.quick else given.search
    how = dict(method="greedy-adam", evaluations=work)
    return study_of(given, "found_placements", list(BY_HAND), **how)


Layouts = dict[str, LayoutSource]
Searched = dict[str, Layouts]


def searched(given: argparse.Namespace, folder: Path) -> tuple[Searched, list[Row]]:
    """What was found, by placement and intersection, and the rows of the searches."""
    study = searches(given)
    rows = run(study, folder, given)
    if len(rows) < len(study.jobs):
        raise SystemExit("some searches failed, see above; the same command does those again")
    found: Searched = {}
    for job in study.jobs:
        text = (folder / "layouts" / f"{job.key}.yaml").read_text(encoding="utf-8")
        own = LayoutSource(found_from(job.layout.name), text=text)
        found.setdefault(job.layout.name, {})[job.source.name] = own
    return found, rows


def aimed(given: argparse.Namespace, folder: Path) -> tuple[Layouts, list[Row]]:
    """The placement of cameras that look down, by intersection, and the rows of its scores."""
    study = study_of(given, "aimed_cameras", [LOOKS_DOWN])
    return {job.source.name: job.layout for job in study.jobs}, run(study, folder, given)


def found_from(placement: str) -> str:
    """The name of what was found from a placement."""
    return f"found from {placement}"


# ── Data and trainings ──────────────────────────────────────────────────────


def recording_of(
    given: argparse.Namespace, into: Path, placement: str, part: str, found: Layouts, name: str
) -> Cache:
    """A part of the sets of ``table1.py``, under other layouts than a placement's; ``name`` is of
    these."""
    plan = planned(given, placement, part)
    own = tuple(
        replace(s, layout=found[s.source.name], name=s.name.replace(placement, name))
        for s in plan.scenarios
    )
    return recorded(given, replace(plan, scenarios=own), into / f"{part}__{name}")


def run_all(
    given: argparse.Namespace, into: Path, found: Searched, down: Layouts, path: Path
) -> Rows:
    """Every training that is not done yet, placement by placement; gives all rows."""
    done = {of_job(row) for row in done_in(path, given.steps)}
    each = [(name, found_from(name), f"from-{name}", layouts) for name, layouts in found.items()]
    each.append((LOOKS_DOWN["strategy"], AIMED, "aimed", down))
    for placement, title, name, layouts in each:
        jobs = [Job(BY_HAND[placement], title, seed) for seed in range(given.seeds)]
        todo = [job for job in jobs if job not in done]
        if todo:
            data, later = (
                recording_of(given, into, placement, part, layouts, name) for part in SETS
            )
            train_some(given, {into.resolve() / job.folder: job for job in todo}, data, later, path)
    return done_in(path, given.steps)


def quick(given: argparse.Namespace, into: Path, found: Searched) -> Rows:
    """Two steps on eight frames."""
    [(name, layouts)] = found.items()
    data = recording_of(given, into, name, "train", layouts, f"from-{name}")
    job = Job(BY_HAND[name], found_from(name), 0)
    settings = TrainingSettings(model=job.model, steps=2, validate_frames=0)
    predictor = predictor_of(trained(data, into / job.folder, settings, BevGrid(half=QUICK_HALF)))
    return rows_of(job, "training", measured(predictor, job.model, data, "train"), 2, 0)


# ── What it tells ───────────────────────────────────────────────────────────


def scores_of(rows: list[Row], placement: str, scenes: set[str]) -> dict[str, float]:
    """P_sm of the placement and of all that is compared with it, the mean over intersections."""

    def mean(layout: str, column: str) -> float:
        own = [row for row in rows if row["layout"] == layout and row["scene"] in scenes]
        return float(np.mean([float(row[column]) for row in own]))

    found = {placement: mean(placement, "surrogate_before")}
    if placement == LOOKS_DOWN["strategy"]:
        found[AIMED] = mean(AIMED, "surrogate")
    return found | {found_from(placement): mean(placement, "surrogate")}


def gain_with_lidars(rows: Rows, of: str) -> str:
    """The mean gain of mAP over placements of LiDARs, with its 95 % interval by Student's t.

    A placement is one observation: its seeds are trained under the same one, and are averaged.
    """
    seeds = means_of_seeds(rows, of).values()
    each = [
        [
            own[model, found_from(name), kind] - own[model, name, kind]
            for own in seeds
            if (model, found_from(name), KINDS[0]) in own
            for kind in KINDS
        ]
        for name, model in BY_HAND.items()
        if name in BY_SENSORS["lidar",]
    ]
    gains = [np.mean(differences) for differences in each if differences]
    found = ttest_1samp(gains, 0.0)
    low, high = found.confidence_interval()
    return (
        f"{of}: with LiDARs, what was found gains {np.mean(gains):+.1f} points "
        f"[{low:.1f}, {high:.1f}] over {len(gains)} placements, p = {found.pvalue:.2f}"
    )


def table(given: argparse.Namespace, rows: Rows, scored: list[Row]) -> str:
    """By placement: P_sm and AP by hand and as found, the mean over the seeds of both, in
    Markdown."""
    lines = []
    for of, part in {"places": "train", "time": "later"}.items():
        # Splits are of intersections: the same ones for every placement.
        held_out = {s.source.name for s in planned(given, "L-d1", part).splits["test"]}
        for placement, model in BY_HAND.items():
            scores = scores_of(scored, placement, held_out)
            each = [
                own
                for own in means_of_seeds(rows, of).values()
                if all((model, name, KINDS[0]) in own for name in scores)
            ]
            for name, score in scores.items() if each else ():
                ap = np.array([[own[model, name, kind] for kind in KINDS] for own in each])
                cells = [f"{score:.3f}", *(f"{x:.1f}" for x in (*ap.mean(0), ap.mean()))]
                by_seed = ", ".join(f"{x:.1f}" for x in ap.mean(1))
                lines.append((of, name, *cells, by_seed))
    return markdown(("held out", "placement", "P_sm", *KINDS, "mean", "each seed"), lines)


def main() -> None:
    """Search, record, train, measure, tell."""
    given = options()
    path = output(given, "found_placements").with_suffix(".csv")
    if not given.quick:
        check_settings(path, given)
    by_hand = [
        row
        for row in done_in(given.beside, given.steps)
        if BY_HAND.get(row["placement"]) == row["model"]
    ]
    with kept_folder(given.keep) as into:
        found, scored = searched(given, into / "searches")
        down, more = aimed(given, into / "aimed")
        scored += more
        if given.quick:
            write_results(path, quick(given, into, found), dict(vars(given)))
            return
        rows = by_hand + run_all(given, into, found, down, path)
    kept = ("layout", "scene", "surrogate_before", "surrogate")
    scores = [{key: row.get(key, "") for key in kept} for row in scored]
    write_results(path.with_name("found_placements_scores.csv"), scores, dict(vars(given)))
    parts = [table(given, rows, scored), *(gain_with_lidars(rows, of) for of in HELD_OUT)]
    say("\n\n".join(parts))


if __name__ == "__main__":
    main()
