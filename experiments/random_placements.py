"""Claim: of placements that nobody picked, a detector finds more under those with a higher P_sm.

The paper has nine placements, made by hand. Here one detector of LiDARs is trained on random
placements that can be mounted, of one to four LiDARs, at eight of the ten intersections, some of
each for every one. It is then measured at the two others: under thirty random placements, the
paper's three by hand with LiDARs, and what searches for P_sm and for detectability D found from
each of those three. All placements at a place see the same traffic. Tells the correlation of mAP,
of all classes and of each, with P_sm, C, O, IG and D, and with what needs no model of perception:
less the means of the two places, and less those of places and numbers of LiDARs. A placement is one
observation of the intervals, by Fisher's z. The scores that are correlated are of the densities and
the mix of road users of the recordings; those in the CSV beside mAP, and in the picture of mAP over
scores, are of what was searched on: medium density, the profile's mix. Another picture shows the
four placements that P_sm ranks worst: how often each place is seen, and which road users the
detector finds and which it misses.

Sets, caches, scores and the training are in the folder of --keep. A run that was stopped goes on
there. ``--rescore`` scores the poses in the CSV in --out, and correlates the mAP there, without a
search or a training.
"""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from common import (
    SCORES,
    arguments,
    kept_folder,
    need_maps,
    on_maps,
    output,
    progress,
    read_rows,
    with_interval,
    write_results,
)
from matplotlib.figure import Figure
from table1 import (
    COMPARED,
    MIX,
    QUICK_HALF,
    baselines,
    compared,
    correlation,
    less_group_means,
    predictor_of,
    recorded,
    trained,
)
from table2 import places, run, statistics

import inspe_jax
from inspe_jax import Layout, Objective, Scene
from inspe_jax.core.files import csv_text, write_text
from inspe_jax.core.words import counted
from inspe_jax.dataset import Cache, Generation, Loader
from inspe_jax.dataset.plan import make_generation
from inspe_jax.jobs.sources import SceneSource, scene_of
from inspe_jax.mounting.mixes import starting_layout
from inspe_jax.perception.detector import loader_of
from inspe_jax.perception.evaluation import (
    Detections,
    Evaluation,
    evaluate,
    matched,
    truth_of,
)
from inspe_jax.perception.inputs import BevGrid
from inspe_jax.perception.training import TrainingRun, TrainingSettings
from inspe_jax.placement.problem import Problem
from inspe_jax.report.figures import OUTLINE, column_raster, draw_regions
from inspe_jax.sensing.layout import save_layout
from inspe_jax.sensing.sensors import Pose
from inspe_jax.simulation.frame import KINDS
from inspe_jax.study.plan import make_study

TEST_PLACES = ("Town05 four-way", "Town10HD four-way")
"""Where the detector is measured: one of two roads of many lanes, and one with crosswalks."""
LIDAR = "paper-lidar-32"
COUNTS = (1, 2, 3, 4)
"""Numbers of LiDARs, in turns."""
SEARCHED = ("surrogate", "detectability")
"""What is searched for, from each placement by hand."""
MODEL = "coalign"
FOUND: dict[bool, dict[str, Any]] = {
    True: dict(c="#0072b2", marker="o", s=10),
    False: dict(c="#d55e00", marker="x", s=22),
}
"""Marks of road users that are found, and missed."""
FOUND_BY = {"*": "found for P_sm", "P": "found for D"}
"""Marks of placements that a search found, and what their names begin with."""
SURE = 0.3
"""Least score of a detection that is drawn as found; as in ``inspe detect``."""

Rows = list[dict[str, Any]]


class Size(NamedTuple):
    """How much is recorded, searched and trained."""

    trained_on: int  # random placements at each intersection of the training, of all COUNTS
    measured_on: int  # and at each that is held out
    train_seconds: int  # of each scenario, with a frame a second
    test_seconds: int
    densities: tuple[str | int, ...]
    by_hand: tuple[str, ...]
    search: float  # the work of a search, in exact scores
    steps: int
    scene: dict[str, Any]
    grid: BevGrid


WHOLE = Size(
    *(8, 15, 5, 12, ("medium", "high"), ("L-c", "L-d2", "L-d1"), 150, 600),
    *(dict(frames=100, radius=50.0), BevGrid()),
)
QUICK = Size(
    *(4, 4, 1, 2, (8,), ("L-c",), 4, 2),
    dict(frames=3, radius=15.0, voxel=1.0, density=8),
    BevGrid(half=QUICK_HALF),
)


# ── Placements ──────────────────────────────────────────────────────────────


def random_layouts(scene: Scene, number: int, seed: int) -> dict[str, Layout]:
    """Random placements that can be mounted, of one to four LiDARs in turns."""
    found = {}
    for count in COUNTS:
        problem = Problem(scene, starting_layout(scene, {LIDAR: count}))
        own = range(count - 1, number, len(COUNTS))
        rng = np.random.default_rng([seed, count])
        for k, x in zip(own, problem.space.random(rng, len(own)), strict=True):
            found[f"random {k}"] = problem.space.layout(x)
    return found


def picked(scene: Scene, size: Size, seed: int) -> dict[str, Layout]:
    """The placements by hand, and what a search for each of :data:`SEARCHED` found from each."""
    found = {}
    for name in size.by_hand:
        start = inspe_jax.strategy(scene, name)
        found[name] = start
        for metric in SEARCHED:
            objective = None if metric == "surrogate" else Objective(weights={metric: 1.0})
            result = inspe_jax.optimise(
                scene, start, evaluations=size.search, seed=seed, objective=objective
            )
            found[searched_from(name, metric)] = result.layout
    return found


def searched_from(name: str, metric: str) -> str:
    """The name of what a search for a metric found from a placement."""
    return f"found for {SCORES[metric]} from {name}"


def placed(
    source: SceneSource, settings: dict[str, Any], test: bool, size: Size, seed: int, into: Path
) -> list[Path]:
    """The files of a place's placements, with their scores in a CSV beside them if measured on."""
    folder = into / "layouts" / source.name
    scores = folder / "scores.csv"
    number = size.measured_on if test else size.trained_on
    names = [f"random {k}" for k in range(number)]
    if test:
        for name in size.by_hand:
            names += [name, *(searched_from(name, metric) for metric in SEARCHED)]
    files = [folder / f"{name}.yaml" for name in names]
    if all(file.is_file() for file in files) and scores.is_file() == test:
        return files
    folder.mkdir(parents=True, exist_ok=True)
    scene = scene_of(source, settings)
    layouts = random_layouts(scene, number, seed)
    if test:
        layouts |= picked(scene, size, seed)
        rows = []
        for name, layout in layouts.items():
            own = inspe_jax.evaluate(scene, layout, metrics=("detectability",))
            rows.append(
                dict(layout=name, lidars=len(layout)) | {key: own.value(key) for key in SCORES}
            )
        write_text(scores, csv_text(rows))
    for name, layout in layouts.items():
        save_layout(replace(layout, name=name), folder / f"{name}.yaml")
    jax.clear_caches()  # else the compiled code of many places exhausts the memory maps
    return files


# ── Data, training, measuring ───────────────────────────────────────────────


def scored_on(given: argparse.Namespace, size: Size) -> dict[str, Any]:
    """The settings of the scenes that placements are drawn, searched and scored on."""
    return dict(seed=given.seed, **size.scene)


def scenes_of(given: argparse.Namespace, test: bool) -> list[dict[str, Any]]:
    """The intersections to train on, or to ``test``."""
    scenes = places(given) if given.quick else on_maps(places(given))
    held_out = [scenes[-1]["built_in"]] if given.quick else TEST_PLACES
    return [s for s in scenes if test == (s.get("name", s.get("built_in")) in held_out)]


def planned(given: argparse.Namespace, size: Size, test: bool, into: Path) -> Generation:
    """The set to train on, or to ``test``: each place's own placements in the same traffic."""
    scenarios: list[Any] = []
    for scene in scenes_of(given, test):
        settings: dict[str, Any] = dict(
            mix=MIX, density=list(size.densities), seed=given.seed,
            seconds=size.test_seconds if test else size.train_seconds,
        )  # fmt: skip
        settings |= {k: v for k, v in size.scene.items() if k != "frames"}
        content = dict(
            name="random", scenes=[scene], layouts=["L-c"], settings=settings, rate_hz=1,
            splits={"test" if test else "train": 1},
        )  # fmt: skip
        source = make_generation(content, into).scenarios[0].source
        own = placed(source, scored_on(given, size), test, size, given.seed, into)
        content["layouts"] = [dict(file=str(path), name=path.stem) for path in own]
        scenarios += make_generation(content, into).scenarios
    return Generation("random", tuple(scenarios))


def poses_of(rows: Rows, into: Path) -> Rows:
    """A row for each LiDAR of the random placements that rows are of."""
    found = []
    for row in filter(at_random, rows):
        at = dict(place=row["place"], layout=row["layout"])
        layout = inspe_jax.load_layout(into / "layouts" / at["place"] / f"{at['layout']}.yaml")
        found += [at | dict(zip(Pose._fields, pose, strict=True)) for pose in layout.poses.tolist()]
    return found


def scored(given: argparse.Namespace, size: Size, poses: Rows, into: Path) -> Rows:
    """What is compared with mAP, of random placements with these poses."""
    found = []
    for scene in scenes_of(given, True):
        content: dict[str, Any] = dict(scenes=[scene], layouts=["L-c"])
        content["settings"] = scored_on(given, size)
        job = make_study(content, into).jobs[0]
        place, built = job.source.name, scene_of(job.source, job.build)
        folder, layouts = into / "scored" / place, {}
        folder.mkdir(parents=True, exist_ok=True)
        for name in dict.fromkeys(row["layout"] for row in poses if row["place"] == place):
            own = [row for row in poses if (row["place"], row["layout"]) == (place, name)]
            layout = starting_layout(built, {LIDAR: len(own)})
            layout = layout.with_poses(np.array([[float(r[k]) for k in Pose._fields] for r in own]))
            layouts[name] = replace(layout, name=name)
            save_layout(layouts[name], folder / f"{name}.yaml")
        content["layouts"] = [
            dict(file=str(folder / f"{name}.yaml"), name=name) for name in layouts
        ]
        content["settings"] |= dict(mix=MIX, density=list(size.densities))
        study = make_study(content | dict(metrics=["detectability"]), into, "study", place)
        means = statistics(run(study, folder / "jobs", given), metrics=SCORES)
        for name, layout in layouts.items():
            row: dict[str, Any] = dict(place=place, layout=name) | baselines(built, layout)
            found.append(row | {metric: round(means[name, metric][0], 5) for metric in SCORES})
    return found


ByPlacement = dict[tuple[str, str], tuple[list[Detections], list[Detections], list[Detections]]]


def detected(run: TrainingRun, data: Cache, which: dict[str, tuple[str, str]]) -> ByPlacement:
    """Detections, truth, and what of it LiDARs see, of each place and placement; ``which`` these
    are, by scenario."""
    predictor = predictor_of(run)
    loader: Loader = loader_of(MODEL, data, "test", predictor.grid, batch=1, shuffle=False)
    found: ByPlacement = {}
    with progress("measuring") as bar:
        for done, batch in enumerate(loader, 1):
            at = which[loader.scenarios[int(batch.scenario[0])].name]
            detections, truth, seen = found.setdefault(at, ([], [], []))
            detections += predictor(batch)
            truth.append(truth_of(batch.targets, 0))
            seen.append(truth_of(batch.targets, 0, ["lidar"]))
            bar(done, len(loader))
    return found


def row_of(place: str, scores: dict[str, str], found: Evaluation) -> dict[str, Any]:
    """A placement's scores and its AP in percent, of all classes and of each."""
    row: dict[str, Any] = dict(place=place, layout=scores["layout"], lidars=int(scores["lidars"]))
    row |= {metric: round(float(scores[metric]), 5) for metric in SCORES}
    row |= dict(frames=found.frames, mean_ap=round(100 * found.mean_ap, 3))
    each = zip(KINDS, found.class_ap, strict=True)
    row |= {f"ap_{kind}": round(100 * float(ap), 3) for kind, ap in each}
    return row | dict(mean_ap_seen=round(100 * found.seen.mean_ap, 3) if found.seen else "")


# ── What it tells ───────────────────────────────────────────────────────────


def at_random(row: dict[str, Any]) -> bool:
    """Whether a row's placement was drawn."""
    return bool(row["layout"].startswith("random"))


def correlations(rows: Rows, scores: Rows) -> Rows:
    """Of AP with what it is compared with, over random placements."""
    own = {(row["place"], row["layout"]): row for row in rows}
    chosen = [own[row["place"], row["layout"]] for row in scores]
    each = {metric: np.array([float(row[metric]) for row in scores]) for metric in COMPARED}
    found = []
    for less, keys in (("place", ["place"]), ("place and number", ["place", "lidars"])):
        groups = [[row[key] for key in keys] for row in chosen]
        for kind in ("mean", *KINDS):
            ap = "mean_ap" if kind == "mean" else f"ap_{kind}"
            y = np.array([float(row[ap]) for row in chosen])
            found += [dict(less=less, road_user=kind) | row for row in compared(each, y, groups)]
    return found


def off_the_line(rows: Rows) -> np.ndarray:
    """How far mAP is off the line over P_sm, without the mean of each place, in points."""
    x, y = (
        less_group_means(np.array([float(r[key]) for r in rows]), [r["place"] for r in rows])
        for key in ("surrogate", "mean_ap")
    )
    return y - np.polyval(np.polyfit(x, y, 1), x)


def draw_furthest(rows: Rows, found: ByPlacement, scenes: dict[str, Scene], into: Path) -> Figure:
    """The two placements furthest above the line and the two furthest below it: how often each
    column is seen, and the road users that the detector finds, and misses."""
    off = off_the_line(rows)
    order = np.argsort(off)
    figure = Figure(figsize=(12.4, 12.6), layout="constrained")
    for ax, k in zip(figure.subplots(2, 2).ravel(), [*order[:-3:-1], *order[:2]], strict=True):
        row = rows[int(k)]
        scene, at = scenes[row["place"]], (row["place"], row["layout"])
        layout = inspe_jax.load_layout(into / "layouts" / row["place"] / f"{row['layout']}.yaml")
        scores = inspe_jax.evaluate(scene, layout)
        raster, extent = column_raster(scene.voxels, np.asarray(scores.seen_share))
        image = ax.imshow(
            raster, extent=extent, origin="lower", cmap="gray", vmin=-0.5, vmax=1.05, zorder=0
        )
        draw_regions(ax, scene, lambda _: OUTLINE)
        poses = np.asarray(layout.poses)
        ax.plot(*poses[:, :2].T, "w*", ms=16, mec="k", zorder=8, label="LiDAR")
        for hit, look in FOUND.items():
            own = np.concatenate(
                [boxes[taken == hit, :2] for boxes, taken in map(taken_of, *found[at][:2])]
            )
            there = scene.intersection.center[:2] + own
            words = f"{'found' if hit else 'missed'}: {len(own)} road users"
            ax.scatter(*there.T, zorder=6, label=words, **look)
        ax.legend(loc="lower left", fontsize=8)
        ax.set_title(
            f"{row['place']}, {row['layout']}, {counted(int(row['lidars']), 'LiDAR')}\nP_sm "
            f"{float(row['surrogate']):.2f}, mAP {float(row['mean_ap']):.1f}: {off[k]:+.1f} points",
            fontsize=10,
        )
        ax.set_xticks([])
        ax.set_yticks([])
    look = dict(location="bottom", shrink=0.4, aspect=40, boundaries=np.linspace(0, 1))
    bar = figure.colorbar(image, ax=figure.axes, **look)
    bar.set_ticks([0, 0.5, 1])
    bar.set_label("share of frames and levels in which a column is seen")
    return figure


def taken_of(found: Detections, truth: Detections) -> tuple[np.ndarray, np.ndarray]:
    """The road users of a frame, and whether a detection that is sure enough is of each."""
    sure = Detections(*(part[found.score >= SURE] for part in found))
    return truth.boxes, np.isin(np.arange(len(truth.kind)), matched(sure, truth))


def draw(rows: Rows) -> Figure:
    """mAP over each metric and over the number of LiDARs: colours are places, signs the numbers of
    LiDARs. Correlations are those of the random placements that are drawn, less means of places."""
    figure = Figure(figsize=(12, 7.4), layout="constrained")
    places_ = list(dict.fromkeys(row["place"] for row in rows))
    random = [row for row in rows if at_random(row)]
    shown = SCORES | {"lidars": "LiDARs"}
    panels = figure.subplots(2, 3, sharey=True)
    for ax, (metric, symbol) in zip(panels.flat, shown.items(), strict=True):
        for row in rows:
            sign = f"${row['lidars']}$" if at_random(row) else "s"
            sign = next(
                (m for m, words in FOUND_BY.items() if row["layout"].startswith(words)), sign
            )
            look = dict(color=f"C{places_.index(row['place'])}", ms=7, ls="none")
            fill = "none" if sign == "s" else None
            ax.plot(float(row[metric]), float(row["mean_ap"]), marker=sign, mfc=fill, **look)
        x, y = (np.array([float(row[key]) for row in random]) for key in (metric, "mean_ap"))
        each = correlation(x, y, [row["place"] for row in random], "pearson")
        ax.set_xlabel(symbol)
        ax.set_title(f"r = {with_interval(*each)}", fontsize=10)
    for n, place in enumerate(places_):
        figure.axes[0].plot([], [], "o", color=f"C{n}", label=place)
    signs = {"$4$": "4 LiDARs at random", "s": "by hand", **FOUND_BY}
    for sign, words in signs.items():
        fill = "none" if sign == "s" else None
        figure.axes[0].plot([], [], marker=sign, ls="none", color="0.3", mfc=fill, label=words)
    for ax in panels[:, 0]:
        ax.set_ylabel("mAP [%]")
    figure.legend(loc="outside upper center", ncols=6, fontsize=9)
    return figure


def measure(given: argparse.Namespace, size: Size, into: Path) -> Rows:
    """Place, record, train, detect: the rows of all placements. Draws the furthest off."""
    plan = planned(given, size, True, into)
    training = recorded(given, planned(given, size, False, into), into / "training")
    testing = recorded(given, plan, into / "testing")
    settings = TrainingSettings(
        model=MODEL, steps=given.steps or size.steps, seed=given.seed, validate_frames=0
    )
    run = trained(training, into / "run", settings, size.grid)
    which = {s.name: (s.source.name, s.layout.name) for s in plan.scenarios}
    found = detected(run, testing, which)
    rows = [
        row_of(place, scores, evaluate(*found[place, scores["layout"]]))
        | dict(targets=settings.targets)
        for place in dict.fromkeys(at[0] for at in found)
        for scores in read_rows(into / "layouts" / place / "scores.csv")
    ]
    sources = {s.source.name: s.source for s in plan.scenarios}
    scenes = {
        place: scene_of(sources[place], scored_on(given, size))
        for place in dict.fromkeys(row["place"] for row in rows)
    }
    furthest = draw_furthest(rows, found, scenes, into)
    furthest.savefig(f"{output(given, 'random_placements')}_furthest.png", dpi=110)
    return rows


def main() -> None:
    """Place, record, train, measure, tell."""
    steps = dict(type=int, help=f"of the training; {WHOLE.steps} if not given")
    rescore = dict(action="store_true", help="correlate the mAP of before again")
    given = arguments(__doc__, "keep", "seed", "workers", steps=steps, rescore=rescore)
    given.scheduler = None
    need_maps(given)
    stem = output(given, "random_placements")
    size = QUICK if given.quick else WHOLE
    with kept_folder(given.keep) as into:
        if given.rescore:
            rows, poses = read_rows(stem.with_suffix(".csv")), read_rows(Path(f"{stem}_poses.csv"))
        else:
            rows = measure(given, size, into)
            poses = poses_of(rows, into)
        scores = scored(given, size, poses, into)
    write_results(Path(f"{stem}_poses"), poses, dict(vars(given)))
    write_results(stem, rows, dict(vars(given), size=size._asdict()), draw(rows))
    write_results(Path(f"{stem}_scores"), scores, dict(vars(given)))
    write_results(Path(f"{stem}_correlations"), correlations(rows, scores), dict(vars(given)))


if __name__ == "__main__":
    main()
