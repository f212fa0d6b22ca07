"""Figures of curves: score against time and work, and score against cost."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import StrMethodFormatter

from inspe_jax.core.errors import InspeError
from inspe_jax.core.sheet import KEYS, WIDTH, fit, heading, house_style, setting_words
from inspe_jax.placement.result import Result
from inspe_jax.placement.run import Progress
from inspe_jax.placement.studies.pareto import DeviceMix
from inspe_jax.report.tables import by_method

COLORS = (
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#808080",
)  # fmt: skip
"""One colour for each method: those of Okabe and Ito that stand out from white, and grey."""
LINES = ("-", (0, (5, 1.5)), (0, (1.2, 1.2)), (0, (6, 1.5, 1.2, 1.5)))
"""Line styles, so that methods differ not only in colour."""
FRONT, BEATEN = "#0072b2", "#808080"
NAMED = 12  # most mixes on the front that are named; those that add most to the score are chosen
_LEFT = 0.085  # left edge of headings and axes, as a share of the width


def _look(k: int) -> dict[str, Any]:
    return dict(color=COLORS[k % len(COLORS)], ls=LINES[k % len(LINES)], lw=1.3)


def _with_grid(ax: Axes, **labels: Any) -> None:
    ax.set(**labels)
    ax.grid(color="#e0e0e0", lw=0.4)
    ax.set_axisbelow(True)


def pareto_view(mixes: Sequence[DeviceMix]) -> Figure:
    """Score against cost of every mix of devices. The front is a staircase with named mixes. Raises
    InspeError if there is no mix."""
    if not mixes:
        raise InspeError("no mix to draw")
    front = sorted((mix for mix in mixes if mix.front), key=lambda mix: mix.cost)
    beaten = [mix for mix in mixes if not mix.front]
    cost = np.array([mix.cost for mix in front])
    score = np.array([mix.objective for mix in front])
    # Named, in the order of the front: the first, and those that add most to the score.
    adds = np.diff(score, prepend=-np.inf)
    names = [front[k] for k in np.sort(np.argsort(-adds, kind="stable")[:NAMED])]
    height = 3.75 + 0.155 * len(names)
    facts = f"{len(mixes)} mixes of devices, each searched by {mixes[0].method}"
    with house_style():
        fig = Figure(figsize=(WIDTH, height), facecolor="white")
        heading(fig, f"Cost against score at {mixes[0].scene}", facts, _LEFT)
        ax = fig.add_axes((_LEFT, 1 - 3.22 / height, 0.885, 2.7 / height))
        end = max(mix.cost for mix in mixes)
        end += 0.04 * max(end - cost[0], 0.05 * end, 1.0)
        ax.step([*cost, end], [*score, score[-1]], where="post", color=FRONT, lw=1.2, zorder=2)
        ax.plot(cost, score, "o", ms=4.5, color=FRONT, zorder=3, label="no other mix is better")
        if beaten:
            ax.plot(
                [mix.cost for mix in beaten], [mix.objective for mix in beaten], "o",
                ms=4, mfc="white", mec=BEATEN, zorder=2, label="another is better or cheaper",
            )  # fmt: skip
        _with_grid(ax, xlabel="cost of the sensors [US dollars]", ylabel="objective, exact")
        ax.margins(y=0.12)
        ax.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
        ax.legend(loc="lower right", frameon=False)
        for k, mix in enumerate(names):
            look: dict[str, Any] = dict(color=FRONT, weight="bold")
            ax.annotate(
                str(k + 1), (mix.cost, mix.objective), (0, 5), size=6.5, ha="center",
                textcoords="offset points", **look,
            )  # fmt: skip
            words = f"{mix.name}: {mix.cost:,.0f} US dollars, {mix.objective:.4f}"
            y = 1 - (3.8 + 0.155 * k) / height
            fig.text(_LEFT, y, str(k + 1), va="bottom", **look)
            fig.text(0.11, y, **fit(words, 110, 7), va="bottom", parse_math=False)
    return fig


def history_view(results: Sequence[Result]) -> Figure:
    """Best exact score against wall time and against work.

    Each method has a line, the median over its seeds, and a band from the worst to the best seed.
    A search that ended early keeps its score. Raises InspeError if there is no result.
    """
    if not results:
        raise InspeError("no result to draw")
    by = by_method(results)
    panels: tuple[tuple[str, Callable[[Any], float]], ...] = (
        ("wall time [s]", lambda row: row.seconds),
        ("work [exact scores]", lambda row: row.evaluations),
    )
    scenes = " and ".join(dict.fromkeys(r["name"] for r in results[0].settings["scenes"]))
    seeds = max(len(of) for of in by.values())
    facts = f"median of {seeds} seeds and all between the worst and the best"
    facts = facts if seeds > 1 else "one seed"
    facts += f"; {setting_words(results[0].scores.settings)}"
    with house_style():
        fig = Figure(figsize=(WIDTH, 3.6), facecolor="white")
        heading(fig, f"Searches for {results[0].start.name} at {scenes}", facts, _LEFT)
        first, second = fig.subplots(1, 2, sharey=True)
        fig.subplots_adjust(left=0.085, right=0.985, top=0.74, bottom=0.13, wspace=0.06)
        for ax, (name, along) in zip((first, second), panels, strict=True):
            end = max(along(row) for result in results for row in (result, result.history[-1]))
            for k, of in enumerate(by.values()):
                x, low, middle, high = _course([r.history for r in of], along, end)
                look = _look(k)
                ax.fill_between(x, low, high, step="post", color=look["color"], alpha=0.15, lw=0)
                ax.step(x, middle, where="post", **look)
            _with_grid(ax, xlabel=name, xlim=(0, end))
        first.set_ylabel("best exact score")
        handles = [
            Line2D([], [], **_look(k), label=f"{name}, {np.median([r.objective for r in of]):.4f}")
            for k, (name, of) in enumerate(by.items())
        ]
        fig.legend(
            handles=handles, loc="upper left", bbox_to_anchor=(0.085, 0.875), ncols=4,
            columnspacing=1.6, **{**KEYS, "handlelength": 2.6},
        )  # fmt: skip
    return fig


Curve = Float[np.ndarray, " P"]


def _course(
    histories: Sequence[Sequence[Progress]], along: Callable[[Any], float], end: float
) -> tuple[Curve, Curve, Curve, Curve]:
    """(x, lowest, median, highest best score so far) at every x where one of them changes. From the
    first x at which all searches have a score, to ``end``."""
    steps = [np.array([[along(row), row.best] for row in history]) for history in histories]
    first = max(row[0, 0] for row in steps)
    x = np.unique(np.concatenate([row[:, 0] for row in steps] + [[first, end]]))
    x = x[x >= first]
    best = [row[np.searchsorted(row[:, 0], x, side="right") - 1, 1] for row in steps]
    return x, np.min(best, 0), np.median(best, 0), np.max(best, 0)
