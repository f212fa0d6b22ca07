"""Claim: a detector finds more under placements that a search found than under those by hand.

At each of the ten intersections a search for P_sm, under the default profile, begins at each of the
paper's placements of LiDARs, and at that of its placements of cameras under which most is found,
with the same sensors. Where there are cameras, it follows the gradient. By hand, that profile has
cameras look level: what aiming alone brings is told by the same placement with all of them 25°
down, and hung as InSPE's first author hung his, from which a search begins as well, and one without
gradients at equal work. Then all is as in ``table1.py``: the same traffic is recorded, a detector
is trained for as many steps, and measured at two intersections that it has not seen, and on another
time at all ten. ``readme_tables.py`` sets its mAP beside that under the placements by hand, with
the mean gain over placements of LiDARs.

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
"""The paper's placements that searches begin at, and the detector that is trained under each."""
AIMED, HUNG = "Cam-d2, 25° down", "Cam-d2, hung as InSPE's"
LOOK_DOWN: list[dict[str, Any]] = [
    dict(name=AIMED, strategy="Cam-d2", camera_pitch_deg=-25.0),
    dict(name=HUNG, strategy="Cam-d2", camera_pitch_deg=-30.6, camera_height=5.7),
]
"""The placement of cameras, aimed by hand, as a study file has it: the second has the mean height
and pitch of the cameras that InSPE's first author hung (``real_deployments.yaml``)."""
SEARCHES = {"from": "greedy-adam", "without gradient from": "greedy"}
"""Methods, by what a placement is called that one found. The second is for HUNG alone."""
SEARCH = 150.0


def options() -> argparse.Namespace:
    """The command line."""
    given = arguments(
        __doc__,
        *("keep", "workers"),
        **TRAINED,
        seeds=dict(type=int, default=3, help="trainings of each placement"),
        search=dict(type=float, default=SEARCH, help="in exact scores' work"),
        hung=dict(action="store_true", help=f"only {HUNG}, and what is found from it"),
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


Placements = dict[str, dict[str, LayoutSource]]
"""Layouts by the placement's name and the intersection's."""


def searched(given: argparse.Namespace, folder: Path) -> tuple[Placements, list[Row]]:
    """What was found, and the rows of the searches."""
    work = 4 if given.quick else given.search
    found: Placements = {}
    rows: list[Row] = []
    for how, method in SEARCHES.items():
        begin: list[Any] = [] if method == "greedy" or given.hung else [*BY_HAND]
        begin.append(LOOK_DOWN[1])
        study = study_of(given, "found_placements", begin, method=method, evaluations=work)
        own = run(study, folder.with_name(method), given)
        if len(own) < len(study.jobs):
            raise SystemExit("some searches failed, see above; the same command does those again")
        for job in study.jobs:
            path = folder.with_name(method) / "layouts" / f"{job.key}.yaml"
            text = path.read_text(encoding="utf-8")
            name = f"found {how} {job.layout.name}"
            found.setdefault(name, {})[job.source.name] = LayoutSource(name, text=text)
        rows += [{**row, "method": method} for row in own]
        if given.quick:
            break
    return found, rows


def aimed(given: argparse.Namespace, folder: Path) -> tuple[Placements, list[Row]]:
    """The placements of cameras that look down, and the rows of their scores."""
    study = study_of(given, "aimed_cameras", LOOK_DOWN[given.hung :])
    down: Placements = {}
    for job in study.jobs:
        down.setdefault(job.layout.name, {})[job.source.name] = job.layout
    return down, run(study, folder, given)


# ── Data and trainings ──────────────────────────────────────────────────────


def recording_of(
    given: argparse.Namespace, into: Path, title: str, part: str, layouts: dict[str, LayoutSource]
) -> Cache:
    """A part of the sets of ``table1.py``, under layouts with the sensors of a placement."""
    placement, name = by_hand(title), title.replace(" ", "-").replace(",", "")
    plan = planned(given, placement, part)
    own = tuple(
        replace(s, layout=layouts[s.source.name], name=s.name.replace(placement, name))
        for s in plan.scenarios
    )
    return recorded(given, replace(plan, scenarios=own), into / f"{part}__{name}")


def by_hand(title: str) -> str:
    """The paper's placement that a placement began at, or aims anew."""
    return next(name for name in BY_HAND if name in title)


def run_all(given: argparse.Namespace, into: Path, each: Placements, path: Path) -> None:
    """Every training that is not done yet, placement by placement."""
    done = {of_job(row) for row in done_in(path, given)}
    for title, layouts in each.items():
        jobs = [Job(BY_HAND[by_hand(title)], title, seed) for seed in range(given.seeds)]
        todo = [job for job in jobs if job not in done]
        if todo:
            data, later = (recording_of(given, into, title, part, layouts) for part in SETS)
            train_some(given, {into.resolve() / job.folder: job for job in todo}, data, later, path)


def quick(given: argparse.Namespace, into: Path, found: Placements) -> Rows:
    """Two steps on eight frames."""
    [(title, layouts)] = found.items()
    data = recording_of(given, into, title, "train", layouts)
    job = Job(BY_HAND[by_hand(title)], title, 0)
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
        run_all(given, into, found | down, path)
    kept = ("layout", "scene", "method", "surrogate_before", "surrogate")
    scores = [{key: row.get(key, "") for key in kept} for row in scored]
    write_results(path.with_name("found_placements_scores.csv"), scores, dict(vars(given)))


if __name__ == "__main__":
    main()
