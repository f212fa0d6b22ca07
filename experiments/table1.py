"""Claim: detectors find more where the surrogate metrics rank a placement higher (Table 1, Fig. 4).

Records the ten intersections under the paper's three placements of cameras and LiDARs, of which the
other six are parts, and trains the eight detectors on three placements each, all for the same
number of steps. Each is measured on two intersections that it has not seen, and on another time at
all ten. Tells nuScenes' mAP by detector, placement and class beside the paper's (``--paper1 FILE``,
with the columns model, placement, class, map_percent); the correlation of the mean mAP of each
placement with P_sm, C, O, IG and D, and with what needs no model of perception: the numbers of
sensors, of LiDARs and of rays, and the area in range; and what the paper concludes from its table,
yes or no with numbers. All but the first are told for another time, too, and for the paper's own
mAP. Correlations are over the nine placements, and within a kind of sensors; a placement is one
observation of their intervals, by Fisher's z, and of Williams' test of each beside P_sm and beside
the best of what needs no model.

Scores are of the default profile, the mean over the intersections where mAP is measured, and over
the lights, densities and mix of road users of the recordings; beside them are those of midday,
medium density and the profile's mix, as in ``table2.csv``. Over which lights and densities the
paper's mAP is, is not known here: it is compared with the latter, at all ten.

Detectors are to find those road users that their sensors see (``--targets seen``), or all, as in
the rows of ``table1.csv``. AP is of all road users, and in the last columns of those that are seen.

All sets, caches and trainings are in the folder of --keep. A run that was stopped goes on there. A
training that is done has its rows in the CSV in --out: with that file at hand, on any machine and
with an empty --keep, the run goes on with those that are left. Trainings run on all cores, or by a
Dask scheduler. ``--models`` does some of the detectors.

``--quick`` scores three placements at a small intersection, and trains detectors until they overfit
eight frames: one of LiDARs and one of cameras, or those of ``--models``.
"""

import argparse
import itertools
import json
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from common import (
    MAPS,
    SCORES,
    append_rows,
    arguments,
    console,
    kept_folder,
    markdown,
    need_maps,
    on_maps,
    output,
    processes,
    progress,
    read_rows,
    say,
    with_interval,
    write_results,
    write_settings,
)
from matplotlib.figure import Figure
from scipy.stats import norm, pearsonr, spearmanr
from scipy.stats import t as student
from table2 import QUICK_SIZE, Row, Stats, places, run, statistics

from inspe_jax import Layout, Scene
from inspe_jax.dataset import Cache, Generation, cache, generate, open_cache
from inspe_jax.dataset.plan import make_generation
from inspe_jax.jobs.sources import place_layout, scene_of
from inspe_jax.mounting.strategies import STRATEGIES
from inspe_jax.perception.detector import MODELS, TEACHER, loader_of, model_of
from inspe_jax.perception.evaluation import Evaluation
from inspe_jax.perception.inputs import BevGrid
from inspe_jax.perception.training import (
    Predictor,
    Report,
    Training,
    TrainingRun,
    TrainingSettings,
    open_run,
    train,
    train_all,
)
from inspe_jax.perception.training.run import VALIDATION
from inspe_jax.simulation.frame import KINDS
from inspe_jax.study.plan import make_study

BY_SENSORS = {
    ("camera",): ("Cam-c", "Cam-d1", "Cam-d2"),
    ("lidar",): ("L-c", "L-d1", "L-d2"),
    ("lidar", "camera"): ("Cam-c/L-c", "Cam-d1/L-d1", "Cam-d2/L-d2"),
}
"""The three placements that a detector is trained on, by its sensors."""
RECORDED = BY_SENSORS["lidar", "camera"]
"""What is recorded: the LiDARs of Cam-d1/L-d1 are those of L-d1, the cameras those of Cam-d1."""
NAMES = {
    "lss-eff": "LSS-Eff", "lss-resnet": "LSS-ResNet", "v2vnet": "V2VNet", "v2x-vit": "V2X-ViT",
    "coalign": "CoAlign", "attfuse": "AttFuse", "disconet": "DiscoNet", "hm-vit": "HM-ViT",
}  # fmt: skip
"""The paper's names of the detectors."""
SPREAD = ("lss-resnet", "coalign", "attfuse")
"""One detector of each modality, trained from three seeds."""
PICTURES = (400, 300)
"""Width and height that models take [pixels]."""
SETS: dict[str, dict[str, Any]] = {
    "train": dict(
        seed=0, seconds=15, splits=dict(train=7, validate=1, test=2), split_by="intersection"
    ),
    "later": dict(seed=1, seconds=5, splits=dict(test=1)),
}
"""Held-out intersections are a split of the first set; held-out time is the second, on all. Each
scenario has a frame a second."""
HELD_OUT = {"places": "On other intersections", "time": "At another time"}
"""Titles, by what rows are of."""
MIX = "fleet"
"""Of the road users that are recorded."""
DECISIVE = ("steps", "targets", "lights", "densities", "search")
"""Options that rows depend on, of this study and of ``found_placements.py``."""
TRAINED: dict[str, dict[str, Any]] = dict(
    steps=dict(type=int, default=600, help="of each training"),
    targets=dict(default="seen", choices=("seen", "all"), help="road users that are to be found"),
    lights=dict(nargs="+", default=["midday", "night"]),
    densities=dict(nargs="+", default=["medium", "high"]),
)
"""Options of both."""
BASELINES = {"sensors": "sensors", "log_lidars": "log(1 + LiDARs)", "rays": "rays", "area": "area"}
"""What needs no model of perception: names in records, and symbols."""
COMPARED = SCORES | BASELINES
KNOWN = 0.95
"""AP of cars that a detector must reach on the eight frames that it was trained on."""
QUICK_MODELS = ("coalign", "lss-resnet")
QUICK_STEPS = {("camera",): 240, ("lidar",): 120, ("lidar", "camera"): 240}
QUICK_HALF = 12.8
"""What --quick trains if ``--models`` does not say, and for how many steps, by sensors."""

Rows = list[dict[str, Any]]


class Job(NamedTuple):
    """A training."""

    model: str
    placement: str
    seed: int

    @property
    def recorded(self) -> str:
        """The placement of :data:`RECORDED` that its own is a part of."""
        return RECORDED[BY_SENSORS[model_of(self.model).sensors].index(self.placement)]

    @property
    def folder(self) -> str:
        """Name of its folder."""
        return f"{self.model}__{self.placement.replace('/', '_')}__{self.seed}"


def options() -> argparse.Namespace:
    """The command line."""
    given = arguments(
        __doc__,
        *("keep", "workers", "scheduler"),
        **TRAINED,
        models=dict(metavar="NAMES", help="only these detectors, with commas"),
        record=dict(action="store_true", help="only record and decode"),
        paper1=dict(type=Path, metavar="FILE", help="the paper's Table 1 as CSV"),
    )
    for name in given.models.split(",") if given.models else ():
        if name not in NAMES:
            raise SystemExit(f"--models {name}: some of {', '.join(NAMES)}")
    need_maps(given)
    return given


# ── Data ────────────────────────────────────────────────────────────────────


def planned(given: argparse.Namespace, placement: str, part: str) -> Generation:
    """What is recorded of a placement: a part of :data:`SETS`."""
    lights, densities, size, content = given.lights, given.densities, PICTURES, dict(SETS[part])
    seconds = content.pop("seconds")
    settings: dict[str, Any] = dict(mix=MIX, seed=content.pop("seed"))
    if given.quick:
        content = dict(splits=dict(train=1))
        lights, densities, size, seconds = ["midday"], ["high"], (200, 150), 8
        settings |= dict(radius=25.0, voxel=1.0)
    settings |= dict(density=densities, light=lights, seconds=seconds)
    scenes = places(given)[:1] if given.quick else on_maps(places(given))
    content |= dict(
        name=part, scenes=scenes, layouts=[placement], settings=settings, rate_hz=1,
        pictures="jpeg", image_size=list(size),
    )  # fmt: skip
    return make_generation(content, MAPS)


def recorded(given: argparse.Namespace, plan: Generation, stem: Path) -> Cache:
    """A plan's frames, recorded and decoded as far as they are not there.

    They are in the folder ``stem``, and what is decoded is beside it.
    """
    with progress(stem.name) as report:
        made = generate(plan, stem, workers=processes(given), progress=report)
    assert not made.failures, made.failures
    pictures = plan.scenarios[0].recording.image_size
    with progress(f"decoding {stem.name}") as report:
        size = pictures and (pictures[1], pictures[0])
        return cache(stem, f"{stem}_cache", pictures=size, progress=report)


def recording_of(given: argparse.Namespace, into: Path, placement: str, part: str) -> Cache:
    """A part of :data:`SETS` under a placement."""
    stem = into / f"{part}__{placement.replace('/', '_')}"
    return recorded(given, planned(given, placement, part), stem)


# ── Trainings ───────────────────────────────────────────────────────────────


def every_job() -> list[Job]:
    """All trainings: each detector on its placements, and some of them from more seeds."""
    return [
        Job(name, placement, seed)
        for seed in range(3)
        for name in NAMES
        for placement in BY_SENSORS[model_of(name).sensors]
        if seed == 0 or name in SPREAD
    ]


def of_job(row: dict[str, str]) -> Job:
    """The training that a row is of."""
    return Job(row["model"], row["placement"], int(row["seed"]))


def trained(data: Cache, folder: Path, settings: TrainingSettings, grid: BevGrid) -> TrainingRun:
    """The training in a folder, with a bar."""
    with progress(folder.name) as bar:

        def report(now: Report) -> None:
            mean_ap = "" if now.mean_ap is None else f", mAP {now.mean_ap:.1%}"
            bar(now.step, now.steps, folder.name, f"loss {now.loss:.2f}{mean_ap}")

        return train(data, folder, settings, grid=grid, progress=report)


def predictor_of(run: TrainingRun) -> Predictor:
    """The detector of a training."""
    return Predictor(run.last()[1], run.content.agents, run.content.grid)


def measured(predictor: Predictor, model: str, data: Cache, split: str) -> Evaluation:
    """What a detector of the model ``model`` finds in a split."""
    loader = loader_of(model, data, split, predictor.grid, batch=1, shuffle=False)
    return predictor.evaluate(loader)


def rows_of(job: Job, of: str, found: Evaluation, run: TrainingRun, seconds: float) -> Rows:
    """A row for each class."""
    seen = found.seen
    return [
        dict(
            model=job.model, placement=job.placement, seed=job.seed, frames_of=of, road_user=kind,
            road_users=int(found.users[k]), steps=run.steps, ap=round(float(found.class_ap[k]), 5),
            **{f"ap_{d}m": round(float(found.ap[k, n]), 5) for n, d in enumerate((0.5, 1, 2, 4))},
            seconds=round(seconds), targets=run.content.settings.targets,
            seen=int(seen.users[k]) if seen else 0,
            ap_seen=round(float(seen.class_ap[k]), 5) if seen else "",
        )
        for k, kind in enumerate(KINDS)
    ]  # fmt: skip


def done_in(path: Path, given: argparse.Namespace) -> Rows:
    """The rows of trainings that are done. Raises SystemExit if they had other steps or targets."""
    rows = read_rows(path)
    for key in ("steps", "targets"):
        now = str(getattr(given, key))
        for other in {row.get(key) for row in rows} - {now}:
            raise SystemExit(f"{path} has rows with {key} {other}, not {now}: use another --out")
    return rows


def check_settings(path: Path, given: argparse.Namespace) -> None:
    """Raise SystemExit if there are rows of other settings; else write down those of now."""
    record, rows = path.with_suffix(".json"), done_in(path, given)
    if rows and record.exists():
        before = json.loads(record.read_text(encoding="utf-8"))["settings"]
        for key in DECISIVE:
            now = getattr(given, key, None)
            if before.get(key) != now:
                raise SystemExit(
                    f"{path} has rows with {key} {before.get(key)}, not {now}: use another --out"
                )
    write_settings(record, dict(vars(given)))


def run_all(given: argparse.Namespace, into: Path, path: Path) -> Rows:
    """Every training that is not done yet, recording by recording; gives all rows."""
    wanted = given.models.split(",") if given.models else NAMES
    done = {of_job(row) for row in done_in(path, given)}
    todo = [job for job in every_job() if job.model in wanted and job not in done]
    for seed, placement in dict.fromkeys((job.seed, job.recorded) for job in todo):
        data, later = (recording_of(given, into, placement, part) for part in SETS)
        if given.record:
            continue
        some = [job for job in todo if (job.seed, job.recorded) == (seed, placement)]
        train_some(given, {into.resolve() / job.folder: job for job in some}, data, later, path)
    return done_in(path, given)


def train_some(
    given: argparse.Namespace, jobs: dict[Path, Job], data: Cache, later: Cache, path: Path
) -> None:
    """The trainings on one recording, by folder; appends their rows as they come."""
    how = dict(steps=given.steps, targets=given.targets)
    trainings = [
        Training(
            data.path,
            folder,
            TrainingSettings(model=job.model, seed=job.seed, **how),
            BevGrid(),
        )
        for folder, job in jobs.items()
    ]
    with progress(data.path.name) as bar:
        for training, found in train_all(
            trainings,
            work=partial(train_and_measure, jobs, later.path),
            scheduler=given.scheduler,
            workers=processes(given),
            progress=bar,
        ):
            if isinstance(found, Exception):
                console.print(f"{training.folder.name}: {found}", highlight=False)
                continue
            append_rows(path, found)
            for of in dict.fromkeys(row["frames_of"] for row in found):
                ap = np.mean([row["ap"] for row in found if row["frames_of"] == of])
                console.print(f"{training.folder.name}, other {of}: mAP {ap:.1%}", highlight=False)


def train_and_measure(
    jobs: dict[Path, Job], later: Path, training: Training, report: Callable[[Report], None]
) -> Rows:
    """The rows of a training."""
    job = jobs[training.folder]
    began = time.monotonic()
    run = training.train(report)
    seconds = time.monotonic() - began
    rows, predictor = [], predictor_of(run)
    for of, frames in (("places", training.data), ("time", later)):
        found = measured(predictor, job.model, open_cache(frames), "test")
        rows += rows_of(job, of, found, run, seconds)
    return rows


def quick(given: argparse.Namespace, into: Path) -> Rows:
    """Some detectors, until they overfit eight frames."""
    rows = []
    for model in given.models.split(",") if given.models else QUICK_MODELS:
        sensors = model_of(model).sensors
        job, steps = Job(model, BY_SENSORS[sensors][1], 0), QUICK_STEPS[sensors]
        data = recording_of(given, into, job.placement, "train")
        settings = TrainingSettings(
            model=model, steps=steps, every=steps, rate=4e-3, augment=False, validate_frames=0,
            targets=given.targets,
        )  # fmt: skip
        began = time.monotonic()
        run = trained(data, into / job.folder, settings, BevGrid(half=QUICK_HALF))
        seconds = time.monotonic() - began
        found = measured(predictor_of(run), model, data, "train")
        console.print(
            f"{model}: AP of cars {found.class_ap[0]:.1%}, {seconds:.0f} s", highlight=False
        )
        assert found.class_ap[0] >= KNOWN, found.class_ap
        rows += rows_of(job, "training", found, run, seconds)
    return rows


def curves(into: Path) -> Rows:
    """mAP on the split ``validate`` in the course of each training whose folder is there."""
    there = [job for job in every_job() if (into / job.folder).is_dir()]
    return [
        dict(model=job.model, placement=job.placement, seed=job.seed, step=row["step"],
             mean_ap=round(row["mean_ap"], 5))
        for job in there
        for row in open_run(into / job.folder).rows(VALIDATION)
    ]  # fmt: skip


# ── Scores ──────────────────────────────────────────────────────────────────


Scores = dict[tuple[str, str], Stats]
"""By the frames that mAP is of, and the conditions: "recorded", or the "usual" ones."""


def baselines(scene: Scene, layout: Layout) -> dict[str, float]:
    """What needs no model of perception. ``rays`` are a LiDAR's channels × azimuths and a camera's
    downsampled pixels; ``area`` is the share of the region's columns of voxels that are, in plan,
    within a sensor's range at midday and between the sides of its view."""
    specs = [sensor.spec for sensor in layout.sensors]
    inside = np.zeros(len(scene.voxels.columns), bool)
    for spec, pose in zip(specs, np.asarray(layout.poses), strict=True):
        east, north = (scene.voxels.columns - pose[:2]).T
        bearing = (np.arctan2(north, east) - pose[5] + np.pi) % (2 * np.pi) - np.pi
        right, left = spec.azimuth_limits
        near = np.hypot(east, north) <= spec.grid.reach
        inside |= near & (right <= bearing) & (bearing <= left)
    return dict(
        sensors=len(specs),
        log_lidars=float(np.log1p(sum(spec.kind == "lidar" for spec in specs))),
        rays=sum(len(spec.grid.rows) * spec.grid.column_count for spec in specs),
        area=float(inside.mean()),
    )


def scores_of(given: argparse.Namespace, into: Path) -> Scores:
    """What is compared with mAP, of the nine placements where detectors are measured: at the
    intersections that are held out, and at all."""
    scenes, layouts, size = places(given), list(STRATEGIES), dict[str, Any](seed=0)
    conditions: dict[str, dict[str, Any]] = {
        "recorded": dict(mix=MIX, density=given.densities, light=given.lights),
        "usual": {},
    }
    if given.quick:
        scenes, layouts, size = scenes[:1], list(RECORDED), size | QUICK_SIZE
        conditions = {"recorded": dict(mix=MIX, light=given.lights)}
    rows: dict[str, list[Row]] = {}
    for name, own in conditions.items():
        content = dict(scenes=scenes, layouts=layouts, metrics=["detectability"])
        study = make_study(content | dict(settings=size | own), MAPS, "intersections.yaml", name)
        rows[name] = run(study, into / f"scores_{name}", given)
        if len(rows[name]) < len(study.jobs):
            raise SystemExit("some scores failed, see above; the same command does those again")
    simple: dict[tuple[str, str], dict[str, float]] = {}
    for source, jobs in itertools.groupby(study.jobs, lambda job: job.source):
        scene = None
        for job in jobs:
            scene = scene or scene_of(source, job.build | dict(frames=1))
            simple[source.name, job.layout.name] = baselines(scene, place_layout(job.layout, scene))
    held_out = {s.source.name for s in planned(given, "L-c", "train").splits.get("test", ())}
    found: Scores = {}
    for name, of in itertools.product(rows, HELD_OUT if held_out else ("time",)):
        at = [row for row in rows[name] if of == "time" or row["scene"] in held_out]
        whole = [{**row, **simple[row["scene"], row["layout"]]} for row in at]
        means = statistics(whole, metrics=COMPARED)
        found[of, name] = {key: (round(mean, 5), spread) for key, (mean, spread) in means.items()}
    written = [
        dict(frames_of=of, conditions=name, placement=placement, metric=metric, mean=mean)
        for (of, name), stats in found.items()
        for (placement, metric), (mean, _) in stats.items()
    ]
    write_results(output(given, "table1_scores"), written, dict(vars(given)))
    return found


# ── What it tells ───────────────────────────────────────────────────────────

Means = dict[tuple[str, str, str], float]
"""AP in percent by detector, placement and class."""


def means(rows: Rows, of: str) -> Means:
    """The mean over seeds, on frames of other places or of another time."""
    found: dict[tuple[str, str, str], list[float]] = {}
    for row in rows:
        if row["frames_of"] == of:
            at = row["model"], row["placement"], row["road_user"]
            found.setdefault(at, []).append(100 * float(row["ap"]))
    return {at: float(np.mean(values)) for at, values in found.items()}


def read_paper1(path: Path | None) -> Means:
    """The paper's Table 1."""
    if path is None:
        return {}
    ours = {paper: name for name, paper in NAMES.items()}
    return {
        (ours[row["model"]], row["placement"], row["class"]): float(row["map_percent"])
        for row in read_rows(path)
    }


def table(found: Means, paper: Means) -> str:
    """Detectors and placements × classes in Markdown, the paper's in brackets."""
    lines = []
    there = {at[:2] for at in found}
    for model, placement in dict.fromkeys(job[:2] for job in every_job() if job[:2] in there):
        cells = []
        for get in (found, paper):
            own = [get.get((model, placement, kind), np.nan) for kind in KINDS]
            cells.append([*own, float(np.mean(own))])
        beside = [
            f"{a:.1f}" + ("" if np.isnan(b) else f" ({b:.1f})") for a, b in zip(*cells, strict=True)
        ]
        lines.append((NAMES[model], placement, *beside))
    return markdown(("detector", "placement", *KINDS, "mean"), lines)


def of_placements(found: Means, kind: str | None = None) -> dict[str, float]:
    """The mean mAP of each placement, over its detectors and over classes, or of one class."""
    there = {placement for _, placement, _ in found}
    return {
        p: float(np.mean([v for (_, at, k), v in found.items() if at == p and kind in (None, k)]))
        for p in itertools.chain(*BY_SENSORS.values())
        if p in there
    }


def less_group_means(values: np.ndarray, groups: Sequence[Any]) -> np.ndarray:
    """Values less the mean of their group."""
    of = np.unique([str(group) for group in groups], return_inverse=True)[1]
    return values - (np.bincount(of, values) / np.bincount(of))[of]


def correlation(
    x: np.ndarray, y: np.ndarray, groups: Sequence[Any], name: str
) -> tuple[float, float, float]:
    """Pearson's or Spearman's correlation within groups, and its interval of 95 %.

    By Fisher's z, whose variance is 1 / (n - g - 2) of n pairs less the means of g groups, and for
    Spearman's 1 + r² / 2 times that (Bonett and Wright 2000): of nine placements, the middle 95 %
    over placements drawn anew is too narrow. NaN where it is not defined: the interval of ±1, and
    all if x or y is the same within each group.
    """
    x, y = (less_group_means(values, groups) for values in (x, y))
    if min(np.ptp(x), np.ptp(y)) < 1e-9:
        return np.nan, np.nan, np.nan
    value = float((spearmanr if name == "spearman" else pearsonr)(x, y)[0])
    if abs(value) > 1 - 1e-9:
        return value, np.nan, np.nan
    variance = 1 / (len(x) - len({*map(str, groups)}) - 2)
    half = norm.ppf(0.975) * np.sqrt(variance * (1 + value**2 / 2 * (name == "spearman")))
    low, high = np.tanh(np.arctanh(value) + [-half, half])
    return value, float(low), float(high)


def p_beside(x: np.ndarray, other: np.ndarray, y: np.ndarray, groups: Sequence[Any]) -> float:
    """The p, two-sided, with which ``y`` correlates within groups as well with ``other`` as with x.

    By Williams' test of two correlations with one variable (Steiger 1980), for n - g + 1
    observations. NaN where a correlation is not defined.
    """
    parts = np.stack([less_group_means(values, groups) for values in (y, x, other)])
    if np.ptp(parts, 1).min() < 1e-9 or np.allclose(parts[1], parts[2]):
        return np.nan
    r = np.corrcoef(parts)
    (own, theirs), both, count = r[0, 1:], r[1, 2], len(y) - len({*map(str, groups)}) + 1
    spread = 2 * np.linalg.det(r) * (count - 1) / (count - 3)
    spread += (own + theirs) ** 2 / 4 * (1 - both) ** 3
    value = (own - theirs) * np.sqrt((count - 1) * (1 + both) / spread)
    return float(2 * student.sf(abs(value), count - 3))


def compared(each: dict[str, np.ndarray], y: np.ndarray, groups: Sequence[Any]) -> Rows:
    """The correlations of y with each of :data:`COMPARED`; and for Pearson's the p beside that of
    the best of :data:`BASELINES`, and beside that of P_sm."""
    of = {name: correlation(each[name], y, groups, "pearson")[0] for name in BASELINES}
    best = each[max(of, key=lambda name: -1 if np.isnan(of[name]) else abs(of[name]))]
    rows = []
    for metric, name in itertools.product(COMPARED, ("pearson", "spearman")):
        row: dict[str, Any] = dict(metric=metric, correlation=name, p_baseline="", p_surrogate="")
        found = correlation(each[metric], y, groups, name)
        row |= dict(zip(("value", "low", "high"), (round(part, 3) for part in found), strict=True))
        if name == "pearson":
            row["p_baseline"] = round(p_beside(each[metric], best, y, groups), 4)
            row["p_surrogate"] = round(p_beside(each[metric], each["surrogate"], y, groups), 4)
        rows.append(row)
    return rows


def correlations(found: Means, ours: Stats) -> Rows:
    """Of mAP over placements with what is compared: of all classes, also less the means of kinds of
    sensors, and of each."""
    rows = []
    for less, kind in (("", None), ("kind of sensors", None), *(("", kind) for kind in KINDS)):
        own = of_placements(found, kind)
        groups = [
            less and next(n for n, group in enumerate(BY_SENSORS.values()) if placement in group)
            for placement in own
        ]
        each = {metric: np.array([ours[p, metric][0] for p in own]) for metric in COMPARED}
        of = dict(less=less, road_user=kind or "all")
        rows += [of | row for row in compared(each, np.array([*own.values()]), groups)]
    return rows


def conclusions(found: Means) -> list[str]:
    """What the paper concludes from its table: yes or no, with numbers."""
    of = of_placements(found)
    small = {p: np.mean([of_placements(found, k)[p] for k in KINDS[2:]]) for p in of}
    large = {p: np.mean([of_placements(found, k)[p] for k in KINDS[:2]]) for p in of}
    gains = [
        of[f"{cam}/{lidar}"] - of[cam]
        for cam, lidar in zip(*list(BY_SENSORS.values())[:2], strict=True)
    ]
    distributed = (
        min(of["L-d1"], of["L-d2"]) - of["L-c"],
        min(of["Cam-d1"], of["Cam-d2"]) - of["Cam-c"],
    )
    second, fourth = of["L-d2"] - of["L-c"], of["L-d1"] - of["L-d2"]
    claims = (
        ("LiDARs add 20 to 40 points to cameras", all(20 <= g <= 40 for g in gains), gains),
        ("distributed beats centralised", min(distributed) > 0, distributed),
        (
            "Cam-d1 is better than Cam-d2 for cars and trucks, and worse for the small",
            large["Cam-d1"] > large["Cam-d2"] and small["Cam-d1"] < small["Cam-d2"],
            (large["Cam-d1"] - large["Cam-d2"], small["Cam-d1"] - small["Cam-d2"]),
        ),
        ("four LiDARs over two gain less than two over one", fourth < second, (second, fourth)),
    )
    return [
        f"{'yes' if right else 'no'}: {claim} ({', '.join(f'{n:+.1f}' for n in numbers)})"
        for claim, right, numbers in claims
    ]


def draw(found: Means, ours: Stats, paper: Means, theirs: Stats) -> Figure:
    """Fig. 4: mean mAP of each placement over its scores, and over a baseline; hollow, the paper's
    mAP over the scores that it is compared with."""
    figure = Figure(figsize=(12, 7), layout="constrained")
    shown = SCORES | {"log_lidars": BASELINES["log_lidars"]}
    for ax, (metric, symbol) in zip(
        figure.subplots(2, 3, sharey=True).flat, shown.items(), strict=True
    ):
        both = ((of_placements(found), ours, "full"), (of_placements(paper), theirs, "none"))
        for own, scores, fill in both:
            at = {p: scores[p, metric][0] for p in own}
            for n, (sensors, group) in enumerate(BY_SENSORS.items()):
                name = " and ".join(sensors).replace("lidar", "LiDAR")
                there = [p for p in group if p in own]
                ax.plot(
                    [at[p] for p in there], [own[p] for p in there], f"C{n}o",
                    label=name if fill == "full" else None, fillstyle=fill,
                )  # fmt: skip
            if fill == "none":
                continue
            for p in own:
                beside, where = ((-6, -3), "right") if p.startswith("L") else ((6, -3), "left")
                ax.annotate(
                    p, (at[p], own[p]), beside, textcoords="offset points", ha=where, fontsize=7
                )
            x, y = np.array([*at.values()]), np.array([*own.values()])
            each = [correlation(x, y, [0] * len(x), name) for name in ("pearson", "spearman")]
            first, second = (with_interval(*given) for given in each)
            ax.set_title(f"Pearson {first}\nSpearman {second}", fontsize=9)
        ax.margins(x=0.32)
        ax.set_xlabel(symbol)
    for ax in figure.axes[::3]:
        ax.set_ylabel("mean mAP [%]")
    if paper:
        words = "the paper's; scores at midday,\nmedium density"
        figure.axes[0].plot([], [], "o", color="0.3", fillstyle="none", label=words)
    figure.axes[0].legend(fontsize=8)
    return figure


def main() -> None:
    """Record, train, measure, tell."""
    given = options()
    path = output(given, "table1").with_suffix(".csv")
    with kept_folder(given.keep) as into:
        if given.quick:
            scores_of(given, into)
            write_results(path, quick(given, into), dict(vars(given)))
            return
        check_settings(path, given)
        tell(given, into, path, run_all(given, into, path))


def tell(given: argparse.Namespace, into: Path, path: Path, rows: Rows) -> None:
    """Print, write and draw what the rows say, as far as trainings are done."""
    paper = read_paper1(given.paper1)
    of_own = {of: means(rows, of) for of in HELD_OUT}
    for of, title in HELD_OUT.items():
        beside = paper if of == "places" else {}
        say(f"# {title}\n\n{table(of_own[of], beside)}\n")
    left = set(every_job()) - {of_job(row) for row in rows}
    if left:
        console.print(
            f"{len(left)} trainings are left, {sum(not job.seed for job in left)} of seed 0"
        )
    if any(job.seed == 0 for job in left):
        console.print("what the placements tell together comes with the last of seed 0")
        return
    if course := curves(into):
        write_results(path.with_name("table1_validation.csv"), course, dict(vars(given)))
    scored = scores_of(given, into)
    related = []
    for of, found in (of_own | ({"paper": paper} if paper else {})).items():
        say("\n".join([f"# What the paper concludes: {of}", *conclusions(found)]))
        for conditions in ("recorded", "usual"):
            if (of, conditions) != ("paper", "recorded"):
                ours = scored["time" if of == "paper" else of, conditions]
                own = dict(frames_of=of, conditions=conditions)
                related += [own | row for row in correlations(found, ours)]
    write_results(path.with_name("table1_correlations.csv"), related, dict(vars(given)))
    of_all = [row.values() for row in related if row["road_user"] == "all"]
    say(f"# Correlations of mAP over placements\n\n{markdown(list(related[0]), map(list, of_all))}")
    theirs = scored["time", "usual"]
    figure = draw(of_own["places"], scored["places", "recorded"], paper, theirs)
    figure.savefig(path.with_suffix(".png"), dpi=150)


if __name__ == "__main__":
    assert set(NAMES) == set(MODELS) - {TEACHER}
    main()
