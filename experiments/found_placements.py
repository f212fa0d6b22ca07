"""Claim: a detector finds more under placements that a search found than under those by hand.

At each of the ten intersections a search for P_sm, under the default profile, begins at each of the
paper's placements of LiDARs, and at that of its placements of cameras under which most is found,
with the same sensors. Where there are cameras, it follows the gradient. By hand, that profile has
cameras look level: what aiming alone brings is told by the same placement with all of them 25°
down. Then all is as in ``table1.py``: the same traffic is recorded, a detector is trained for as
many steps, and measured at two intersections that it has not seen, and on another time at all ten.
``readme_tables.py`` sets its mAP beside that under the placements by hand, with the mean gain over
placements of LiDARs. How much of a gain is due to gradients is not tested: there is no search
without them beside it.

Searches, sets and trainings are in the folder of --keep. A run that was stopped goes on there. A
training that is done has its rows in the CSV in --out.
"""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

from common import MAPS, arguments, kept_folder, need_maps, output, write_results
from table1 import (
    QUICK_HALF,
    SETS,
    TRAINED,
    Job,
    Rows,
    check_settings,
    done_in,
    measured,
    of_job,
    planned,
    predictor_of,
    recorded,
    rows_of,
    train_some,
    trained,
)
from table2 import QUICK_SIZE, Row, places, run

from inspe_jax.dataset import Cache
from inspe_jax.jobs.sources import LayoutSource
from inspe_jax.perception.inputs import BevGrid
from inspe_jax.perception.training import TrainingSettings
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
        **TRAINED,
        seeds=dict(type=int, default=3, help="trainings of each placement"),
        search=dict(type=float, default=SEARCH, help="in exact scores' work"),
    )  # fmt: skip
    given.scheduler = None  # its workers could not import table1.py
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
) -> None:
    """Every training that is not done yet, placement by placement."""
    done = {of_job(row) for row in done_in(path, given)}
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


def quick(given: argparse.Namespace, into: Path, found: Searched) -> Rows:
    """Two steps on eight frames."""
    [(name, layouts)] = found.items()
    data = recording_of(given, into, name, "train", layouts, f"from-{name}")
    job = Job(BY_HAND[name], found_from(name), 0)
    settings = TrainingSettings(model=job.model, steps=2, validate_frames=0, targets=given.targets)
    run = trained(data, into / job.folder, settings, BevGrid(half=QUICK_HALF))
    return rows_of(job, "training", measured(predictor_of(run), job.model, data, "train"), run, 0)


def main() -> None:
    """Search, record, train, measure."""
    given = options()
    path = output(given, "found_placements").with_suffix(".csv")
    if not given.quick:
        check_settings(path, given)
    with kept_folder(given.keep) as into:
        found, scored = searched(given, into / "searches")
        down, more = aimed(given, into / "aimed")
        scored += more
        if given.quick:
            write_results(path, quick(given, into, found), dict(vars(given)))
            return
        run_all(given, into, found, down, path)
    kept = ("layout", "scene", "surrogate_before", "surrogate")
    scores = [{key: row.get(key, "") for key in kept} for row in scored]
    write_results(path.with_name("found_placements_scores.csv"), scores, dict(vars(given)))


if __name__ == "__main__":
    main()
