"""Claim: a detector finds more under placements that a search found than under those by hand.

At each of the ten intersections a search for P_sm, under the default profile, begins at each of the
paper's placements of LiDARs, with the same sensors. Then all is as in ``table1.py``: the same
traffic is recorded under what was found, a detector is trained for as many steps from the same
seeds, and measured at two intersections that it has not seen, and on another time at all ten. Tells
its mAP beside that under the placements by hand (``--beside``, the rows of ``table1.py``).

Searches, sets and trainings are in the folder of --keep. A run that was stopped goes on there. A
training that is done has its rows in the CSV in --out.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from common import command_line, kept_folder, read_rows, write_results, write_settings
from rich.console import Console
from table1 import (
    Job,
    Rows,
    done_in,
    measured,
    predictor_of,
    recorded,
    rows_of,
    train_some,
    trained,
)
from table2 import HERE, MAPS, QUICK_SIZE, begin, places, run

from inspe_jax.perception.inputs import BevGrid
from inspe_jax.perception.training import Settings
from inspe_jax.simulation.frame import KINDS
from inspe_jax.study.plan import Study, make_study
from inspe_jax.study.sources import LayoutSource

MODEL = "coalign"
BY_HAND = ("L-d1", "L-d2", "L-c")
STEPS, SEARCH = 600, 150.0

console = Console()


def options() -> argparse.Namespace:
    """The command line."""
    parser = command_line(__doc__)
    parser.add_argument("--keep", type=Path, help="folder that all stays in: 5 GB")
    parser.add_argument("--steps", type=int, default=STEPS, help="of each training")
    parser.add_argument("--seeds", type=int, default=2, help="trainings of each placement")
    parser.add_argument("--search", type=float, default=SEARCH, help="in exact scores' work")
    parser.add_argument("--lights", nargs="+", default=["midday", "night"])
    parser.add_argument("--densities", nargs="+", default=["medium", "high"])
    parser.add_argument("--beside", type=Path, default=HERE / "table1.csv", metavar="FILE")
    parser.add_argument(
        "--workers", type=int, help="processes that search, record and train; one a core"
    )
    parser.add_argument("--scheduler", metavar="ADDRESS", help="a running Dask scheduler")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    return given


def searches(given: argparse.Namespace) -> Study:
    """A search from each placement at each intersection."""
    settings: dict[str, Any] = dict(method="greedy-adam", evaluations=given.search, seed=0)
    scenes, placements = places(given), list(BY_HAND)
    if given.quick:
        settings |= QUICK_SIZE | dict(evaluations=4)
        scenes, placements = scenes[:1], placements[-1:]
    content = dict(scenes=scenes, layouts=placements, settings=settings)
    return make_study(content, MAPS, "intersections.yaml", "found_placements")


Searched = dict[str, dict[str, LayoutSource]]
Scores = dict[str, list[float]]


def searched(given: argparse.Namespace, folder: Path) -> tuple[Searched, Scores]:
    """What was found, by placement and intersection; and P_sm of each placement and of what was
    found from it, the mean over the intersections."""
    study = searches(given)
    rows = run(study, folder, given)
    assert len(rows) == len(study.jobs), "searches failed: see above"
    found: Searched = {}
    for job in study.jobs:
        text = (folder / "layouts" / f"{job.key}.yaml").read_text(encoding="utf-8")
        own = LayoutSource(f"found from {job.layout.name}", text=text)
        found.setdefault(job.layout.name, {})[job.source.name] = own
    scores = {
        name: [
            float(np.mean([float(row[key]) for row in rows if row["layout"] == name]))
            for key in ("surrogate_before", "surrogate")
        ]
        for name in found
    }
    return found, scores


def run_all(given: argparse.Namespace, into: Path, found: Searched, path: Path) -> Rows:
    """Every training that is not done yet, placement by placement; gives all rows."""
    done = {(row["placement"], int(row["seed"])) for row in done_in(path, given.steps)}
    for name, instead in found.items():
        jobs = [Job(MODEL, f"found from {name}", seed) for seed in range(given.seeds)]
        todo = [job for job in jobs if job[1:] not in done]
        if todo:
            data, later = (
                recorded(given, into, name, part, instead) for part in ("train", "later")
            )
            train_some(given, {into.resolve() / job.folder: job for job in todo}, data, later, path)
    return done_in(path, given.steps)


def quick(given: argparse.Namespace, into: Path, found: Searched) -> Rows:
    """A few steps on eight frames."""
    [(name, instead)] = found.items()
    data = recorded(given, into, name, "train", instead)
    job = Job(MODEL, f"found from {name}", 0)
    settings = Settings(model=MODEL, steps=8, validate_frames=0)
    run_ = trained(data, into / job.folder, settings, BevGrid(half=25.6))
    return rows_of(job, "training", measured(predictor_of(run_), MODEL, data, "train"), 8, 0)


def table(rows: Rows, beside: Rows, scores: Scores) -> str:
    """By placement: P_sm and AP by hand and as found, the mean over seeds, in Markdown."""
    lines = [
        "| frames of other | placement | P_sm | " + " | ".join(KINDS) + " | mean | each seed |",
        "|---" * 9 + "|",
    ]
    for of in dict.fromkeys(row["frames_of"] for row in rows):
        for name, both in scores.items():
            for at, own, score in zip(
                (name, f"found from {name}"), (beside, rows), both, strict=True
            ):
                here = [r for r in own if (r["placement"], r["frames_of"]) == (at, of)]
                ap = {
                    seed: [float(r["ap"]) * 100 for r in here if r["seed"] == seed]
                    for seed in dict.fromkeys(r["seed"] for r in here)
                }
                if not ap:
                    continue
                each = np.mean(list(ap.values()), axis=0)
                cells = [f"{score:.3f}", *(f"{x:.1f}" for x in (*each, each.mean()))]
                seeds = ", ".join(f"{np.mean(x):.1f}" for x in ap.values())
                lines.append(f"| {of} | {at} | {' | '.join(cells)} | {seeds} |")
    return "\n".join(lines)


def main() -> None:
    """Search, record, train, measure, tell."""
    given = options()
    stem = begin(given, "found_placements")
    path = given.out / f"{stem}.csv"
    with kept_folder(given.keep) as into:
        found, scores = searched(given, into / "searches")
        if given.quick:
            write_results(path, quick(given, into, found), dict(vars(given)))
            return
        rows = run_all(given, into, found, path)
    write_settings(path.with_suffix(".json"), dict(vars(given)))
    beside = [row for row in read_rows(given.beside) if row["model"] == MODEL]
    console.print(table(rows, beside, scores), highlight=False, soft_wrap=True)


if __name__ == "__main__":
    main()
