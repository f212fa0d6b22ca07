"""Claim: one set of what the paper leaves open brings the metrics to its Table 2.

The paper does not say how large its voxels are, how far its cameras see, where LiDARs' beams
point, and so on. Here those are settings, each the same for all placements and all intersections,
and the mean absolute difference to the paper's C, O, IG and P_sm is made small. Of each that is a
choice (``CHOICES``) all values are tried, one choice after the other. The numbers (``KNOBS``) are
searched by CMA-ES on a surrogate of the table: radial basis functions through the tables of some
settings all over the ranges, and of what the search proposes, round by round. Then the choices
again, until nothing helps any more. That is done nine times more, each time without one of the
placements, which is then predicted: what is fitted to all nine says how near the model can come,
what is left out says whether that means anything. The search looks at voxels that stand apart
(``--spacing``) and few frames; what it found is then scored in full.

``--paper FILE`` is the paper's table as in ``table2.py``; its numbers are not in this repository.
Without it, or with ``--quick``, a table of the model's own stands in, made at settings drawn by
``--seed``: then the claim is that the search finds its way back to a table that is reachable.

Every step is a study (see ``inspe sweep``) whose jobs are kept, so that a run which was stopped
goes on where it was; jobs that a setting does not touch are not done again.
"""

import argparse
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from cmaes import CMA
from common import (
    MAPS,
    METRICS,
    arguments,
    console,
    markdown,
    need_maps,
    output,
    processes,
    progress,
    say,
    write_results,
)
from scipy.interpolate import RBFInterpolator
from scipy.stats import qmc
from table2 import (
    LIGHTS,
    QUICK_SIZE,
    Stats,
    correlation,
    difference,
    places,
    read_paper,
    statistics,
)

from inspe_jax.core.digest import digest
from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import write_text
from inspe_jax.jobs.cluster import client
from inspe_jax.mounting.strategies import STRATEGIES
from inspe_jax.study.plan import Study, StudyJob, make_study
from inspe_jax.study.sweep import Row, sweep

CHOICES: dict[str, tuple[Any, ...]] = {
    "visibility": ("past_others", "in_view", "line_of_sight"),
    "occlusion_reference": ("roi", "covered", "targets"),
    "voxel": (0.2, 0.5),
    "radius": (50.0, 75.0),  # the paper's D_inf
    "camera_aim": ("pitch", "aimed"),  # all at camera_pitch, or each at what it is for
    "camera_downsample": (0.2, 0.44),  # 160 × 120 rays; what 128 × 352 pixels see of a row
    "azimuths": ("points a second", "alike"),  # shared among the channels, as CARLA has it
    "beams_of_L-d2": (64, 32),
    "mix": ("mixed", "largest"),
    "density": ("medium", "low", "high"),
}
"""What the paper leaves open, and the values tried; the first is what the search begins with."""
Knobs = dict[str, tuple[float, float, float]]
KNOBS: dict[str, Knobs] = {
    "cameras": {
        "camera_depth": (20.0, 35.0, 50.0),  # [m]
        "camera_pitch": (-25.0, -10.0, 0.0),  # [degrees]
        "camera_height": (5.0, 6.0, 8.0),  # [m]
        "camera_reliability": (0.2, 0.45, 1.0),
    },
    "LiDARs": {
        "lidar_lowest": (-30.0, -15.0, -10.0),  # elevation of a channel [degrees]
        "lidar_highest": (2.0, 15.0, 20.0),
        "azimuth_step": (0.2, 0.355, 0.6),  # of 64 channels [degrees]
        "lidar_height": (6.0, 6.5, 8.0),  # [m]
        "lidar_reliability": (0.3, 0.8, 1.0),
    },
}
"""Numbers that the paper leaves open: (least, what the search begins with, most)."""
START = {name: values[0] for name, values in CHOICES.items()}
QUICK_CHOICES = ("camera_downsample", "azimuths")
QUICK_PLACEMENTS = ("Cam-d1", "L-d1", "Cam-d2/L-d2")
NUMBERS = {name: limits for block in KNOBS.values() for name, limits in block.items()}
LOW, FIRST, HIGH = np.array(list(NUMBERS.values())).T
START |= dict(zip(NUMBERS, FIRST.tolist(), strict=True))
QUICK_SEARCH = 1, 16, 6, 2
"""Scenes, design, rounds and passes of a quick run: 0.0017 off the stand-in's table with seed 0."""
DESIGN, ROUNDS = 64, 8
"""Settings that a surrogate begins with, and rounds in which the search proposes more."""
GENERATIONS, POPULATION, SIGMA = 80, 16, 0.15
"""Of CMA-ES on a surrogate; its first steps are beside the range of a number."""
SMOOTH = 1e-5
"""How far a surrogate may pass a table by: scores jump a little from ray to ray."""
PASSES = 3
HOPELESS = 0.03
"""A choice that was worse by more is not tried again."""
RANK = dict.fromkeys(METRICS, 0.9) | {"surrogate": 0.95}
OFF, OFF_LEFT_OUT = 0.05, 0.07
"""What is aimed at: Spearman's at least, differences at most."""
FOUND = 0.005
"""A table of the model's own is met if nothing is further off in the mean."""

Setting = dict[str, Any]


def options() -> argparse.Namespace:
    """The command line."""
    given = arguments(
        __doc__,
        *("seed", "paper", "workers", "scheduler"),
        frames=dict(type=int, default=20, help="in the search; 100 at the end"),
        spacing=dict(type=float, default=0.8, help="of voxels in the search [m]"),
        folds=dict(type=int, default=9, help="placements left out in turn"),
        passes=dict(type=int, default=PASSES, help="through all, at most"),
        pitch=dict(type=float, help="at which all cameras are held [degrees]"),
        design=dict(type=int, default=DESIGN, help="settings of a surrogate"),
        rounds=dict(type=int, default=ROUNDS, help="in which it proposes more"),
        scenes=dict(type=int, default=10, help="only the first so many of the ten"),
        lights=dict(nargs="+", default=["midday"], choices=LIGHTS,
                    help="midday if not given: cameras vary more over all of them"),
        only=dict(nargs="+", default=list(CHOICES), choices=list(CHOICES),
                  metavar="SETTING", help=f"of {', '.join(CHOICES)}"),
    )  # fmt: skip
    given.placements = QUICK_PLACEMENTS if given.quick else tuple(STRATEGIES)
    if given.quick:
        given.only, given.paper, given.folds = QUICK_CHOICES, None, 1
        given.scenes, given.design, given.rounds, given.passes = QUICK_SEARCH
    need_maps(given)
    return given


# ── A setting's table ───────────────────────────────────────────────────────


def layouts(at: Setting, placements: Sequence[str]) -> dict[str, Any]:
    """A setting's devices and placements, as a study file has them."""
    devices: dict[str, Any] = {}
    for n in (32, 64):
        step = at["azimuth_step"] * (n / 64 if at["azimuths"] == "points a second" else 1)
        devices[f"lidar-{n}"] = dict(
            like=f"ideal-lidar-{n}",
            elevation_range_deg=[at["lidar_lowest"], at["lidar_highest"]],
            azimuth_step_deg=step,
            reliability=at["lidar_reliability"],
        )
    devices["camera"] = dict(
        like="ideal-camera",
        depth_m=at["camera_depth"],
        downsample=at["camera_downsample"],
        reliability=at["camera_reliability"],
    )
    entries = []
    for name in placements:
        row, entry = STRATEGIES[name], dict[str, Any](strategy=name)
        if row.cameras:
            entry |= dict(camera="camera", camera_height=at["camera_height"])
            if at["camera_aim"] == "pitch":
                entry |= dict(camera_pitch_deg=at["camera_pitch"])
        if row.lidars:
            beams_ = at["beams_of_L-d2"] if name.endswith("L-d2") else row.beams
            entry |= dict(lidar=f"lidar-{beams_}", lidar_height=at["lidar_height"])
        entries.append(entry)
    return dict(devices=devices, layouts=entries)


SCORED = ("visibility", "occlusion_reference", "voxel", "radius", "mix", "density")


def held(at: Setting, given: argparse.Namespace) -> Setting:
    """A setting with all cameras at ``--pitch``, if that is given."""
    return at if given.pitch is None else at | dict(camera_aim="pitch", camera_pitch=given.pitch)


def jobs(at: Setting, given: argparse.Namespace, full: bool = False) -> tuple[StudyJob, ...]:
    """What is to be scored at a setting, of a sample or in ``full``: LiDARs alone, which need no
    light, once."""
    at = held(at, given)
    whole = full or given.quick
    apart = at["voxel"] if whole else max(given.spacing, at["voxel"])
    settings = dict(
        profile="ideal", spacing=apart, frames=100 if full else given.frames, seed=given.seed
    )
    settings |= {key: at[key] for key in SCORED}
    if given.quick:
        settings |= QUICK_SIZE
        del settings["spacing"]
    content = dict(
        scenes=places(given)[: given.scenes], settings=settings | dict(light=list(given.lights))
    )
    found = make_study(content | layouts(at, given.placements), MAPS, "calibrate").jobs
    return tuple(
        job
        for job in found
        if STRATEGIES[job.layout.name].cameras or job.settings["light"] == given.lights[0]
    )


class Tables:
    """Tables of settings, all that are asked for at once as one study; none is done twice."""

    def __init__(self, given: argparse.Namespace, folder: Path, scheduler: str) -> None:
        self.given, self.folder, self.scheduler = given, folder, scheduler
        self.rows: dict[str, Row] = {}
        self.known: dict[tuple[str, bool], Stats] = {}
        self.tried: dict[str, Setting] = {}

    def of(self, settings: Sequence[Setting], full: bool = False) -> list[Stats]:
        """The table of each setting, of a sample or in ``full``."""
        wanted = {
            (str(at), full): jobs(at, self.given, full)
            for at in settings
            if (str(at), full) not in self.known
        }
        new = {
            job.key: job for group in wanted.values() for job in group if job.key not in self.rows
        }
        if new:
            self._do(Study("calibrate", tuple(sorted(new.values(), key=lambda job: job.scene))))
        for at, group in wanted.items():
            self.known[at] = statistics([self.rows[job.key] for job in group])
        if not full:
            self.tried |= {str(at): dict(at) for at in settings}
        return [self.known[str(at), full] for at in settings]

    def _do(self, study: Study) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        name = digest([job.key for job in study.jobs])[:16]
        with progress(f"{len(study.jobs)} jobs") as report:
            rows = sweep(study, self.folder / name, scheduler=self.scheduler, progress=report)
        for row in rows:
            if row["status"] != "done":
                raise InspeError(f"{row['layout']} on {row['scene']}: {row['error']}")
        self.rows |= {row["key"]: row for row in rows}


# ── The search ──────────────────────────────────────────────────────────────


def loss(ours: Stats, paper: Stats, placements: Sequence[str]) -> float:
    """What is made small."""
    return float(np.mean([difference(ours, paper, placements, metric) for metric in METRICS]))


class Surrogate:
    """The table at any numbers, from the tables at some.

    Cubic radial basis functions and a polynomial for each placement. ``x`` (N, K) are the numbers
    from 0 to 1 within their ranges, ``tables`` the N tables there.
    """

    def __init__(self, x: np.ndarray, tables: Sequence[Stats], names: Sequence[str]) -> None:
        self.fits = {}
        for name in names:
            own, first = np.unique(x[:, numbers_of(name)], axis=0, return_index=True)
            found = np.array([[tables[i][name, metric][0] for metric in METRICS] for i in first])
            count = own.shape[1]
            degree = 2 if len(own) > (count + 1) * (count + 2) else 1  # twice as many as terms
            self.fits[name] = RBFInterpolator(
                own, found, kernel="cubic", degree=degree, smoothing=SMOOTH
            )

    def loss(self, x: np.ndarray, paper: Stats, placements: Sequence[str]) -> np.ndarray:
        """:func:`loss` of the tables at each of some numbers (N, K)."""
        off = []
        for name in placements:
            wanted = [paper[name, metric][0] for metric in METRICS]
            off.append(np.abs(self.fits[name](x[:, numbers_of(name)]) - wanted).mean(1))
        return np.mean(off, axis=0)


def numbers_of(placement: str) -> list[int]:
    """Which of the numbers a placement depends on: those of the sensors that it has."""
    row = STRATEGIES[placement]
    own = KNOBS["cameras"] if row.cameras else {}
    own = own | (KNOBS["LiDARs"] if row.lidars else {})
    return [i for i, name in enumerate(NUMBERS) if name in own]


ALL = "all"


@dataclass
class Fit:
    """Each fold's best setting so far, from the first of all choices and the middle of all numbers.

    All folds go side by side. Each takes the best of what it asked for itself, and of what was
    asked without looking at the paper.
    """

    tables: Tables
    paper: Stats
    folds: Mapping[str, Sequence[str]]
    given: argparse.Namespace

    def __post_init__(self) -> None:
        self.best = {fold: dict(START) for fold in self.folds}
        self.hopeless: set[tuple[str, str, Any]] = set()

    def go(self) -> dict[str, Setting]:
        """Through all choices and all numbers, until nothing helps any more."""
        for number in range(self.given.passes):
            before = dict(self.best)
            for name in self.given.only:
                self.choose(name)
                self.say(number, [name])
            if number and all(map(same_choices, self.best.values(), before.values())):
                break
            self.evolve(number)
            self.say(number, NUMBERS)
        return self.best

    def off(self, at: Setting, fold: str) -> float:
        """What is made small: how far a setting is off what the fold is fitted to."""
        return loss(self.tables.of([at])[0], self.paper, self.folds[fold])

    def choose(self, name: str) -> None:
        """Try all values of a choice, with each fold's numbers."""
        asked = {
            fold: [at | {name: x} for x in CHOICES[name] if (fold, name, x) not in self.hopeless]
            for fold, at in self.best.items()
        }
        self.take(asked)
        for fold, tried in asked.items():
            least = self.off(self.best[fold], fold)
            far = [at[name] for at in tried if self.off(at, fold) > least + HOPELESS]
            self.hopeless |= {(fold, name, x) for x in far}

    def take(self, asked: Mapping[str, Sequence[Setting]]) -> None:
        """Let each fold take the best of what it asked for. One that is no better than another by
        more than rounding does not take its place."""
        self.tables.of([at for of in (self.best.values(), *asked.values()) for at in of])
        for fold, tried in asked.items():
            least = self.off(self.best[fold], fold)
            for at in tried:
                if (its := self.off(at, fold)) < least - 1e-6:
                    self.best[fold], least = at, its

    def evolve(self, number: int) -> None:
        """CMA-ES among the numbers, on a surrogate for each set of choices that a fold has."""
        spread = qmc.Sobol(len(NUMBERS), seed=self.given.seed).random(self.given.design)
        groups: dict[str, list[str]] = {}
        for fold, at in self.best.items():
            groups.setdefault(str(choices_of(at)), []).append(fold)
        for folds in groups.values():
            choices = choices_of(self.best[folds[0]])
            self.take({fold: [choices | numbers(x) for x in spread] for fold in folds})
            for turn in range(self.given.rounds):
                known = [at for at in self.tables.tried.values() if choices_of(at) == choices]
                x = np.array([coordinates(at) for at in known])
                surrogate = Surrogate(x, self.tables.of(known), self.folds[ALL])
                seed = self.given.seed + 100 * number + turn
                proposed = {
                    fold: [choices | numbers(self._least(surrogate, fold, seed))] for fold in folds
                }
                self.take(proposed)
                if all(at in known for of in proposed.values() for at in of):
                    break

    def _least(self, surrogate: Surrogate, fold: str, seed: int) -> np.ndarray:
        """Where a surrogate is least, from the fold's best."""
        search = CMA(
            mean=coordinates(self.best[fold]),
            sigma=SIGMA,
            bounds=np.tile([0.0, 1.0], (len(NUMBERS), 1)),
            seed=seed,
            population_size=POPULATION,
        )
        least, best = np.inf, coordinates(self.best[fold])
        for _ in range(GENERATIONS):
            rows = np.array([search.ask() for _ in range(POPULATION)])
            off = surrogate.loss(rows, self.paper, self.folds[fold])
            search.tell(list(zip(rows, off.tolist(), strict=True)))
            if off.min() < least:
                least, best = off.min(), rows[off.argmin()]
        return best

    def say(self, number: int, names: Iterable[str]) -> None:
        """Where the search is."""
        at, off = self.best[ALL], self.off(self.best[ALL], ALL)
        values = ", ".join(f"{name} {at[name]}" for name in names)
        console.print(f"pass {number + 1}: {values}; {off:.4f} off", highlight=False)


def choices_of(at: Setting) -> Setting:
    """A setting without its numbers."""
    return {name: at[name] for name in CHOICES}


def same_choices(one: Setting, other: Setting) -> bool:
    """Whether two settings have the same choices."""
    return choices_of(one) == choices_of(other)


def coordinates(at: Setting) -> np.ndarray:
    """A setting's numbers, from 0 to 1 within their ranges."""
    return (np.array([at[name] for name in NUMBERS]) - LOW) / (HIGH - LOW)


def numbers(x: np.ndarray) -> Setting:
    """The numbers at such a place."""
    return dict(zip(NUMBERS, map(_round, LOW + x * (HIGH - LOW)), strict=True))


def _round(x: float) -> float:
    """To three digits: finer means nothing, and a table that was made is found again."""
    return float(f"{x:.3g}")


def stand_in(tables: Tables, given: argparse.Namespace) -> tuple[Setting, Stats]:
    """A setting drawn by the seed, and its table."""
    random = np.random.default_rng(given.seed)
    truth = dict(START)
    truth |= {name: CHOICES[name][random.integers(len(CHOICES[name]))] for name in given.only}
    for name, (low, start, high) in NUMBERS.items():
        truth[name] = _round(start + random.uniform(-0.2, 0.2) * (high - low))
        truth[name] = min(max(truth[name], low), high)
    return truth, tables.of([truth])[0]


# ── What is told ────────────────────────────────────────────────────────────


def told(
    best: dict[str, Setting], fitted: Stats, out: Stats, paper: Stats, truth: Setting | None
) -> str:
    """Settings and differences, in Markdown; ``out`` has each placement as it was predicted."""
    names, left = list(dict.fromkeys(name for name, _ in paper)), list(best)[1:]
    settings, metrics = [], []
    for key, value in best[ALL].items():
        counts = Counter(str(best[name][key]) for name in left)
        each = ", ".join(f"{other} ({count})" for other, count in counts.items())
        settings.append((key, value, each, *([truth[key]] if truth else [])))
    for metric, symbol in METRICS.items():
        off = [
            f"{difference(of, paper, some, metric):.4f}"
            for of, some in ((fitted, names), (out, left))
        ]
        rank = correlation(fitted, paper, names, metric)
        met = rank >= RANK[metric], float(off[0]) <= OFF, float(off[1]) <= OFF_LEFT_OUT
        cells = [
            f"{x} ({'yes' if y else 'no'})" for x, y in zip((f"{rank:.3f}", *off), met, strict=True)
        ]
        metrics.append((symbol, *cells))
    heads = ["setting", "fitted to all", "where one was left out", *(["truth"] if truth else [])]
    others = (
        "metric",
        f"Spearman (at least {min(RANK.values())}, {max(RANK.values())} of P_sm)",
        f"mean absolute difference, fitted (at most {OFF})",
        f"left out (at most {OFF_LEFT_OUT})",
    )
    return f"{markdown(heads, settings)}\n\n{markdown(others, metrics)}\n"


def main() -> None:
    """The search, with workers that stay for all of it."""
    given = options()
    stem = output(given, "calibrate")
    with client(given.scheduler, processes(given)) as workers:  # the same ones for every study
        address = str(workers.scheduler_info()["address"])
        calibrate(given, stem, Tables(given, Path(f"{stem}_jobs"), address))


def calibrate(given: argparse.Namespace, stem: Path, tables: Tables) -> None:
    """The search, and what is told of it."""
    truth, paper = (None, read_paper(given.paper)) if given.paper else stand_in(tables, given)
    names = [name for name in STRATEGIES if (name, "surrogate") in paper]
    if len(names) < 3:
        raise SystemExit(f"{given.paper}: {len(names)} placements; at least 3 are needed")
    folds = {ALL: names}
    folds |= {name: [n for n in names if n != name] for name in names[: given.folds]}
    best = {fold: held(at, given) for fold, at in Fit(tables, paper, folds, given).go().items()}
    fitted, *without = tables.of(list(best.values()), full=not given.quick)
    out = {
        (name, metric): fold[name, metric]
        for name, fold in zip(names, without, strict=False)
        for metric in METRICS
    }
    text = told(best, fitted, out, paper, truth)
    say(text)
    write_text(stem.with_suffix(".md"), text)
    rows = [dict(fitted_without=fold if fold != ALL else "", **at) for fold, at in best.items()]
    write_results(stem, rows, vars(given) | dict(jobs=len(tables.rows)))
    off = loss(fitted, paper, names)
    if truth and off > FOUND:
        raise SystemExit(f"a table that is reachable was missed by {off:.4f}")


if __name__ == "__main__":
    try:
        main()
    except InspeError as e:
        raise SystemExit(f"Error: {e}") from e
