"""Claim: one set of what the paper leaves open brings the metrics to its Table 2.

The paper does not say how large its voxels are, how far its cameras see, where LiDARs' beams
point, and so on. Here those are settings, each the same for all placements and all intersections,
and the mean absolute difference to the paper's C, O and IG is made small: of each that is a choice
(``CHOICES``) all values are tried, one choice after the other, and the numbers (``KNOBS``) are
searched by CMA-ES, those of cameras and those of LiDARs in turn, until neither helps any more.
That is done nine times more, each time without one of the placements, which is then predicted:
what is fitted to all nine says how near the model can come, what is left out says whether that
means anything. The search looks at voxels that stand apart (``--spacing``) and few frames; what it
found is then scored in full.

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
from common import MAPS, command_line, write_results
from matplotlib.figure import Figure
from rich.console import Console
from table2 import (
    LIGHTS,
    QUICK_SIZE,
    Stats,
    begin,
    correlation,
    difference,
    panels,
    places,
    read_paper,
    statistics,
)

from inspe_jax.cli.common import progress
from inspe_jax.errors import InspeError
from inspe_jax.files import write_text
from inspe_jax.placement.checkpoint import digest
from inspe_jax.placement.strategies import STRATEGIES
from inspe_jax.report.tables import METRICS
from inspe_jax.study.cluster import client
from inspe_jax.study.plan import Job, Study, make_study
from inspe_jax.study.sweep import sweep
from inspe_jax.study.work import Row

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
START |= {name: start for block in KNOBS.values() for name, (_, start, _) in block.items()}
QUICK_CHOICES = ("camera_downsample", "azimuths")
GENERATIONS, POPULATION = 8, 8
"""Of a search among the numbers of a block."""
SIGMA = 0.15
"""Its first steps, beside the range of a number."""
FITTED = ("coverage", "occlusion", "information_gain")
"""The metrics whose differences are made small; P_sm follows from them."""
PASSES = 5
FOUND = 0.005
"""A table of the model's own is met if nothing is further off in the mean."""

console = Console()
Setting = dict[str, Any]


def options() -> argparse.Namespace:
    """The command line."""
    parser = command_line(__doc__)
    parser.add_argument("--seed", type=int, default=0, help="of the traffic and of the stand-in")
    parser.add_argument("--paper", type=Path, metavar="FILE", help="the paper's Table 2 as CSV")
    parser.add_argument("--frames", type=int, default=20, help="in the search; 100 at the end")
    parser.add_argument("--spacing", type=float, default=0.8, help="of voxels in the search [m]")
    parser.add_argument("--folds", type=int, default=9, help="placements left out in turn")
    parser.add_argument("--passes", type=int, default=PASSES, help="through all, at most")
    parser.add_argument("--generations", type=int, default=GENERATIONS, help="of CMA-ES")
    parser.add_argument("--scenes", type=int, default=10, help="only the first so many of the ten")
    parser.add_argument("--lights", nargs="+", default=["midday"], choices=LIGHTS,
                        help="midday if not given: cameras vary more over all of them")  # fmt: skip
    parser.add_argument("--only", nargs="+", default=list(CHOICES), choices=list(CHOICES),
                        metavar="SETTING", help=f"of {', '.join(CHOICES)}")  # fmt: skip
    parser.add_argument("--workers", type=int, help="processes; one a core if not given")
    parser.add_argument("--scheduler", metavar="ADDRESS", help="a running Dask scheduler")
    given = parser.parse_args()
    if given.quick:
        given.only, given.paper, given.folds, given.passes = QUICK_CHOICES, None, 1, 3
    given.out.mkdir(parents=True, exist_ok=True)
    return given


# ── A setting's table ───────────────────────────────────────────────────────


def layouts(at: Setting) -> dict[str, Any]:
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
    for name, row in STRATEGIES.items():
        entry: dict[str, Any] = {"strategy": name}
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


def jobs(at: Setting, given: argparse.Namespace, full: bool = False) -> tuple[Job, ...]:
    """What is to be scored at a setting, of a sample or in ``full``: LiDARs alone, which need no
    light, once."""
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
    found = make_study(content | layouts(at), MAPS, "calibrate").jobs
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
    return float(np.mean([difference(ours, paper, placements, metric) for metric in FITTED]))


ALL = "all"


@dataclass
class Fit:
    """Each fold's best setting so far, from the first of all choices and the middle of all numbers.

    All folds go side by side, and each takes the best of what any of them asked for.
    """

    tables: Tables
    paper: Stats
    folds: Mapping[str, Sequence[str]]
    given: argparse.Namespace

    def __post_init__(self) -> None:
        self.best = {fold: dict(START) for fold in self.folds}

    def go(self) -> dict[str, Setting]:
        """Through all choices and all numbers, until nothing helps any more."""
        for number in range(self.given.passes):
            before = dict(self.best)
            for name in self.given.only:
                self.take([at | {name: x} for at in self.best.values() for x in CHOICES[name]])
                self.say(number, [name])
            for block in KNOBS.values():
                self.evolve(block, number)
                self.say(number, block)
            if self.best == before:
                break
        return self.best

    def off(self, at: Setting, fold: str) -> float:
        """What is made small: how far a setting is off what the fold is fitted to."""
        return loss(self.tables.of([at])[0], self.paper, self.folds[fold])

    def take(self, tried: Sequence[Setting]) -> None:
        """Let each fold take the best. One that is no better than another by more than rounding
        does not take its place."""
        every = [*self.best.values(), *tried]
        self.tables.of(every)
        for fold, at in self.best.items():
            least = self.off(at, fold)
            for other in every:
                its = self.off(other, fold)
                if its < least - 1e-6:
                    self.best[fold], least = other, its

    def evolve(self, block: Knobs, number: int) -> None:
        """CMA-ES among the numbers of a block, which begins at each fold's best."""
        low, high = (np.array([limits[k] for limits in block.values()]) for k in (0, 2))
        begun = dict(self.best)
        searches = {
            fold: CMA(
                mean=(np.array([at[name] for name in block]) - low) / (high - low),
                sigma=SIGMA / (1 + number),
                bounds=np.tile([0.0, 1.0], (len(block), 1)),
                seed=self.given.seed + number,
                population_size=POPULATION,
            )
            for fold, at in begun.items()
        }

        def setting(fold: str, x: np.ndarray) -> Setting:
            values = map(_round, low + x * (high - low))
            return begun[fold] | dict(zip(block, values, strict=True))

        for _ in range(self.given.generations):
            asked = {
                fold: [search.ask() for _ in range(POPULATION)] for fold, search in searches.items()
            }
            self.take([setting(fold, x) for fold, rows in asked.items() for x in rows])
            for fold, search in searches.items():
                search.tell([(x, self.off(setting(fold, x), fold)) for x in asked[fold]])

    def say(self, number: int, names: Iterable[str]) -> None:
        """Where the search is."""
        at, off = self.best[ALL], self.off(self.best[ALL], ALL)
        values = ", ".join(f"{name} {at[name]}" for name in names)
        console.print(f"pass {number + 1}: {values}; {off:.4f} off", highlight=False)


def _round(x: float) -> float:
    """To three digits: finer means nothing, and a table that was made is found again."""
    return float(f"{x:.3g}")


def stand_in(tables: Tables, given: argparse.Namespace) -> tuple[Setting, Stats]:
    """A setting drawn by the seed, and its table."""
    random = np.random.default_rng(given.seed)
    truth = dict(START)
    truth |= {name: CHOICES[name][random.integers(len(CHOICES[name]))] for name in given.only}
    for block in KNOBS.values():
        for name, (low, start, high) in block.items():
            truth[name] = _round(start + random.uniform(-0.2, 0.2) * (high - low))
            truth[name] = min(max(truth[name], low), high)
    return truth, tables.of([truth])[0]


# ── What is told ────────────────────────────────────────────────────────────


def told(
    best: dict[str, Setting], fitted: Stats, out: Stats, paper: Stats, truth: Setting | None
) -> str:
    """Settings and differences, in Markdown; ``out`` has each placement as it was predicted."""
    names, left = list(dict.fromkeys(name for name, _ in paper)), list(best)[1:]
    text = "| setting | fitted to all | where one was left out |" + (" truth |" if truth else "")
    text += "\n|---|---|---|" + ("---|" if truth else "") + "\n"
    for key, value in best[ALL].items():
        counts = Counter(str(best[name][key]) for name in left)
        each = ", ".join(f"{other} ({count})" for other, count in counts.items())
        text += f"| {key} | {value} | {each} |" + (f" {truth[key]} |" if truth else "") + "\n"
    text += (
        "\n| metric | Spearman | mean absolute difference, fitted | left out |\n|---|---|---|---|\n"
    )
    for metric, symbol in METRICS.items():
        off = [
            f"{difference(of, paper, some, metric):.4f}"
            for of, some in ((fitted, names), (out, left))
        ]
        rank = correlation(fitted, paper, names, metric)
        text += f"| {symbol} | {rank:.3f} | {' | '.join(off)} |\n"
    return text


def draw(names: Sequence[str], fitted: Stats, out: Stats, paper: Stats, path: Path) -> None:
    """Fitted and left-out values of every placement beside the paper's, a panel a metric."""
    figure = Figure(figsize=(8.4, 5.6), layout="constrained")
    marks: list[tuple[str, Stats, dict[str, Any]]] = [
        ("table to be met", paper, dict(marker="_", ms=16, mew=2, color="#555555")),
        ("fitted to all", fitted, dict(marker="o", ms=6, color="#0072b2")),
        ("fitted to the others", out, dict(marker="x", color="#d55e00")),
    ]
    for ax, metric in panels(figure, names):
        for label, of, style in marks:
            rows = [of.get((name, metric), (np.nan, 0.0))[0] for name in names]
            ax.plot(rows, ls="", label=label, **style)
    figure.axes[0].legend(fontsize=8, loc="lower right")
    figure.savefig(path, dpi=150)


def main() -> None:
    """The search, with workers that stay for all of it."""
    given = options()
    stem = begin(given, "calibrate")
    with client(given.scheduler, given.workers) as workers:  # the same ones for every study
        address = str(workers.scheduler_info()["address"])
        calibrate(given, stem, Tables(given, given.out / f"{stem}_jobs", address))


def calibrate(given: argparse.Namespace, stem: str, tables: Tables) -> None:
    """The search, and what is told of it."""
    truth, paper = (None, read_paper(given.paper)) if given.paper else stand_in(tables, given)
    names = [name for name in STRATEGIES if (name, "surrogate") in paper]
    if len(names) < 3:
        raise SystemExit(f"{given.paper}: {len(names)} placements; at least 3 are needed")
    folds = {ALL: names}
    folds |= {name: [n for n in names if n != name] for name in names[: given.folds]}
    best = Fit(tables, paper, folds, given).go()
    fitted, *without = tables.of(list(best.values()), full=not given.quick)
    out = {
        (name, metric): fold[name, metric]
        for name, fold in zip(names, without, strict=False)
        for metric in METRICS
    }
    text = told(best, fitted, out, paper, truth)
    console.print(text, highlight=False, soft_wrap=True)
    write_text(given.out / f"{stem}.md", text)
    rows = [dict(fitted_without=fold if fold != ALL else "", **at) for fold, at in best.items()]
    write_results(given.out / f"{stem}.csv", rows, vars(given) | dict(jobs=len(tables.rows)))
    draw(names, fitted, out, paper, given.out / f"{stem}.png")
    off = loss(fitted, paper, names)
    if truth and off > FOUND:
        raise SystemExit(f"a table that is reachable was missed by {off:.4f}")


if __name__ == "__main__":
    try:
        main()
    except InspeError as e:
        raise SystemExit(f"Error: {e}") from e
