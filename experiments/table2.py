"""Claim: the surrogate metrics order the paper's nine placements as its Table 2 does.

Nine placements on ten intersections (``intersections.yaml``), at three densities and three light
levels, as one study: C, O, IG and P_sm of each placement as mean ± standard deviation, at midday
and medium density, and of all. Then what
the paper concludes from its table, yes or no with numbers: distributed beats centralised; a LiDAR
added to cameras helps, cameras added to a LiDAR help less; cameras vary more; P_sm falls with
density. With ``--optimise WORK`` each placement is also where a search begins, on every
intersection, by so many exact scores' work, and what that gains over the best placement by hand is
told.

``--paper FILE`` gives the paper's own table to compare with, a CSV with the columns placement,
metric, mean and std (metric: coverage, occlusion, information_gain or surrogate). Its numbers are
not in this repository.

The study runs on all cores, or by a Dask scheduler, and goes on where it was stopped.
"""

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
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
    read_rows,
    say,
    write_results,
)
from matplotlib.figure import Figure
from scipy.stats import spearmanr

from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import write_text
from inspe_jax.mounting.strategies import STRATEGIES
from inspe_jax.scene.profiles import DEFAULT_PROFILE, profiles
from inspe_jax.study.plan import Study, make_study
from inspe_jax.study.sweep import sweep

HERE = Path(__file__).parent
LIGHTS, DENSITIES = ("midday", "dusk", "night"), ("low", "medium", "high")
USUAL = "midday", "medium"
"""What the table is of: over three lights cameras would vary four times as much as the paper's."""
QUICK = [
    {"built_in": "four_way", "tags": {"kind": "four-way"}},
    {"built_in": "t_junction", "tags": {"kind": "T"}},
]
"""Intersections of a quick run: they need no map."""
QUICK_SIZE: dict[str, Any] = dict(radius=15.0, voxel=1.0, frames=3, density=8)

Row = Mapping[str, str]
Stats = dict[tuple[str, str], tuple[float, float]]
"""(mean, standard deviation) by placement and metric."""


def options() -> argparse.Namespace:
    """The command line."""
    found = arguments(
        __doc__,
        *("seed", "paper", "workers", "scheduler"),
        profile=dict(default=DEFAULT_PROFILE, choices=list(profiles())),
        radius=dict(type=float, help="of the region of interest [m]"),
        voxel=dict(type=float, help="size [m]"),
        frames=dict(type=int, default=100),
        mix=dict(help="mixed, or largest; the profile's if not given"),
        lights=dict(nargs="+", default=list(LIGHTS), choices=LIGHTS),
        densities=dict(nargs="+", default=list(DENSITIES), choices=DENSITIES),
        optimise=dict(type=float, default=0.0, metavar="WORK",
                      help="search from every placement; in exact scores' work"),
    )  # fmt: skip
    need_maps(found)
    return found


def places(given: argparse.Namespace) -> list[dict[str, Any]]:
    """The intersections, as a study file has them."""
    if given.quick:
        return QUICK
    text = (HERE / "intersections.yaml").read_text(encoding="utf-8")
    return list(yaml.safe_load(text))


def plan(given: argparse.Namespace, **settings: Any) -> Study:
    """The study: every placement on every intersection."""
    wanted = dict(radius=given.radius, voxel=given.voxel, frames=given.frames, mix=given.mix)
    if given.quick:
        wanted |= QUICK_SIZE
    size = {key: value for key, value in wanted.items() if value is not None}
    size |= dict(profile=given.profile, seed=given.seed)
    scenes = places(given)[: 1 if given.quick else None]
    content = dict(scenes=scenes, layouts=list(STRATEGIES), settings=size | settings)
    return make_study(content, MAPS, "intersections.yaml", "table2")


def run(study: Study, folder: Path, given: argparse.Namespace) -> list[Row]:
    """All jobs, with a bar; failures are told, and tried again by the next run."""
    with progress(study.name) as report:
        rows = sweep(
            study,
            folder,
            scheduler=given.scheduler,
            workers=processes(given),
            progress=report,
        )
    for row in rows:
        if row["status"] != "done":
            console.print(f"{row['layout']} on {row['scene']}: {row['error']}", highlight=False)
    return [row for row in rows if row["status"] == "done"]


def statistics(
    rows: Sequence[Mapping[str, Any]],
    by: Callable[[Row], str] = lambda row: row["layout"],
    metrics: Iterable[str] = METRICS,
) -> Stats:
    """Mean and standard deviation of every metric, of the rows that ``by`` puts together."""
    values: dict[tuple[str, str], list[float]] = {}
    for row in rows:
        for metric in metrics:
            values.setdefault((by(row), metric), []).append(float(row[metric]))
    return {at: (float(np.mean(x)), float(np.std(x))) for at, x in values.items()}


def read_paper(path: Path) -> Stats:
    """The paper's table from a CSV."""
    return {
        (row["placement"], row["metric"]): (float(row["mean"]), float(row["std"]))
        for row in read_rows(path)
    }


def table(stats: Stats, paper: Stats) -> str:
    """Placements × metrics in Markdown; beside the paper's, with the differences, if given."""
    rows = []
    for name in STRATEGIES:
        cells = []
        for metric in METRICS:
            mean, std = stats.get((name, metric), (np.nan, np.nan))
            words = f"{mean:.3f} ± {std:.3f}"
            if (name, metric) in paper:
                theirs, spread = paper[name, metric]
                words += f" (paper {theirs:.3f} ± {spread:.3f}, {mean - theirs:+.3f})"
            cells.append(words)
        rows.append((name, *cells))
    text = markdown(("placement", *METRICS.values()), rows) + "\n"
    for metric, symbol in METRICS.items():
        both = [name for name in STRATEGIES if (name, metric) in paper and (name, metric) in stats]
        if len(both) > 2:
            rank, off = (
                correlation(stats, paper, both, metric),
                difference(stats, paper, both, metric),
            )
            text += f"\n{symbol}: Spearman {rank:.3f}, mean absolute difference {off:.3f}\n"
    return text


def difference(ours: Stats, paper: Stats, placements: Sequence[str], metric: str) -> float:
    """Mean absolute difference of a metric over placements."""
    return float(np.mean([abs(ours[p, metric][0] - paper[p, metric][0]) for p in placements]))


def correlation(ours: Stats, paper: Stats, placements: Sequence[str], metric: str) -> float:
    """Spearman's, of a metric over placements."""
    return float(
        spearmanr(*([of[p, metric][0] for p in placements] for of in (ours, paper))).statistic
    )


def orderings(rows: list[Row], stats: Stats) -> str:
    """What the paper concludes, yes or no with numbers: of the table in ``stats``, and of all
    ``rows`` where light and density vary."""
    if missing := [name for name in STRATEGIES if (name, "surrogate") not in stats]:
        return f"No conclusions: no job is done of {', '.join(missing)}.\n"
    mean = {name: stats[name, "surrogate"][0] for name in STRATEGIES}
    by_day = statistics([row for row in rows if row["light"] == "midday"])
    density = statistics(rows, lambda row: row["density"])
    levels = [name for name in DENSITIES if (name, "surrogate") in density]
    pairs = [name for name in STRATEGIES if "/" in name]

    def gain(pair: str, part: int) -> float:
        return mean[pair] - mean[pair.split("/")[part]]

    lines = []

    def says(claim: str, holds: bool, facts: str) -> None:
        lines.append(f"- {claim}: **{'yes' if holds else 'no'}** ({facts})")

    for kind in ("Cam", "L"):
        central, spread = mean[f"{kind}-c"], [mean[f"{kind}-{d}"] for d in ("d1", "d2")]
        says(
            f"distributed beats centralised, {kind}",
            min(spread) > central,
            f"{kind}-c {central:.3f}, d1 {spread[0]:.3f}, d2 {spread[1]:.3f}",
        )
    lidar, camera = [gain(pair, 0) for pair in pairs], [gain(pair, 1) for pair in pairs]
    says("adding LiDAR beats cameras alone", min(lidar) > 0, _each(pairs, lidar))
    says(
        "adding cameras to LiDAR helps less",
        all(a < b for a, b in zip(camera, lidar, strict=True)),
        _each(pairs, camera),
    )
    for when, of in (("in all lights", statistics(rows)), ("at midday alone", by_day)):
        cameras, lidars = (
            [of[f"{kind}-{d}", "surrogate"][1] for d in ("c", "d1", "d2")] for kind in ("Cam", "L")
        )
        says(
            f"standard deviation larger for cameras, {when}",
            min(cameras) > max(lidars),
            f"cameras {min(cameras):.3f} to {max(cameras):.3f}, "
            f"LiDARs {min(lidars):.3f} to {max(lidars):.3f}",
        )
    falls = [density[name, "surrogate"][0] for name in levels]
    if len(falls) > 1:
        words = ", ".join(f"{n} {x:.3f}" for n, x in zip(levels, falls, strict=True))
        says("P_sm falls with density", bool((np.diff(falls) < 0).all()), words)
    return "\n".join(lines) + "\n"


def _each(names: list[str], values: list[float]) -> str:
    return ", ".join(f"{name} {value:+.3f}" for name, value in zip(names, values, strict=True))


def optimised(rows: list[Row]) -> str:
    """What searches gain, on every intersection, over the best placement by hand."""
    lines = []
    for place in dict.fromkeys(row["scene"] for row in rows):
        own = [row for row in rows if row["scene"] == place]
        before = {row["layout"]: float(row["surrogate_before"]) for row in own}
        after = {row["layout"]: float(row["surrogate"]) for row in own}
        hand, found = (max(x, key=x.__getitem__) for x in (before, after))
        each = np.mean([after[name] - before[name] for name in before])
        cells = f"{before[hand]:.4f} ({hand})", f"{after[found]:.4f}"
        gain = f"{after[found] - before[hand]:+.4f}"
        lines.append((place, *cells, gain, found, f"{each:+.4f}"))
    heads = ("best by hand", "best found", "gain", "from", "mean gain of a placement")
    after_all, both = statistics(rows), []
    for name in dict.fromkeys(row["layout"] for row in rows):
        starts = [float(row["surrogate_before"]) for row in rows if row["layout"] == name]
        both.append((name, f"{np.mean(starts):.4f}", f"{after_all[name, 'surrogate'][0]:.4f}"))
    text = markdown(("intersection", *heads), lines)
    return f"{text}\n\n{markdown(('placement', 'by hand', 'found from it'), both)}\n"


def draw(stats: Stats, paper: Stats) -> Figure:
    """Mean and standard deviation of every placement, a panel a metric."""
    figure = Figure(figsize=(8.4, 5.6), layout="constrained")
    names = list(STRATEGIES)
    at = np.arange(len(names))
    axes = figure.subplots(2, 2, sharex=True, sharey=True).ravel()
    for ax, (metric, symbol) in zip(axes, METRICS.items(), strict=True):
        ax.set_title(symbol, fontsize=10)
        ax.grid(axis="y", color="#e0e0e0", lw=0.5)
        ax.set_xticks(at, names, rotation=45, ha="right", fontsize=8)
        ax.set_ylim(0, 1.03)
        both = [("inspe_jax", stats, "#0072b2", -0.12 if paper else 0.0)]
        both += [("paper", paper, "#d55e00", 0.12)] if paper else []
        for label, values, color, aside in both:
            rows = np.array([values.get((name, metric), (np.nan, np.nan)) for name in names])
            ax.errorbar(at + aside, rows[:, 0], rows[:, 1], fmt="o", ms=4, capsize=2.5,
                        color=color, label=label)  # fmt: skip
    for ax in figure.axes[::2]:
        ax.set_ylabel("mean ± standard deviation", fontsize=8)
    if paper:
        figure.axes[0].legend(fontsize=8, loc="lower right")
    return figure


def main() -> None:
    """The study, its table, what follows from it, and the figure."""
    given = options()
    stem = output(given, "table2")
    if given.quick:
        given.lights, given.densities = USUAL[:1], USUAL[1:]
    study = plan(given, density=list(given.densities), light=list(given.lights))
    rows = run(study, Path(f"{stem}_jobs"), given)
    usual = [row for row in rows if (row["light"], row["density"]) == USUAL]
    stats, paper = statistics(usual), read_paper(given.paper) if given.paper else {}
    text = f"Of {len(usual)} scores at {USUAL[0]}, {USUAL[1]} density:\n\n{table(stats, paper)}\n"
    if len(rows) > len(usual):
        text += f"Of all {len(rows)}:\n\n{table(statistics(rows), {})}\n"
    text += orderings(rows, stats)
    if given.optimise:
        searches = plan(given, density="medium", light="midday", method="greedy-adam",
                        evaluations=given.optimise, search_seed=given.seed)  # fmt: skip
        text += "\n" + optimised(run(searches, Path(f"{stem}_searches"), given))
    say(text)
    write_text(stem.with_suffix(".md"), text)
    summary = [
        dict(placement=name, metric=metric, mean=f"{mean:.6f}", std=f"{std:.6f}")
        for (name, metric), (mean, std) in stats.items()
    ]
    write_results(stem, summary, vars(given) | dict(jobs=len(rows)), draw(stats, paper))


if __name__ == "__main__":
    try:
        main()
    except InspeError as e:
        raise SystemExit(f"Error: {e}") from e
