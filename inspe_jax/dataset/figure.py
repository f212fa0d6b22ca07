"""A figure of a data set: classes, sizes, road users per frame, and points by range."""

import textwrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator, StrMethodFormatter

from inspe_jax.core import sheet
from inspe_jax.core.sheet import CLASS_COLORS, HEAD, KEYS, LEFT, NOTE_LINE, WIDTH, house_style
from inspe_jax.core.words import counted
from inspe_jax.dataset.statistics import Statistics, bands
from inspe_jax.simulation.frame import KINDS

FEWEST = 5  # range bands with fewer boxes than this are left out of the curves
MOST_DOTS = 2000
"""Largest number of boxes of a class that are drawn as dots; of more, every n-th is drawn."""

_TITLE: dict[str, Any] = dict(loc="left", size=7, weight="bold", pad=4)
_GRID: dict[str, Any] = dict(color="#e0e0e0", lw=0.4)
_MEDIAN: dict[str, Any] = dict(lw=1.4, marker="o", ms=2.2)


def statistics_view(found: Statistics) -> Figure:
    """A figure of a data set: objects per class and frame, sizes, and points by range, if any."""
    scanned = len(found.points.kind) > 0
    notes = textwrap.wrap(_notes(found), 130)
    rows, foot = [1.5, 1.8, *[2.8] * scanned], 0.1 + NOTE_LINE * len(notes)
    height = HEAD + sum(rows) + foot
    with house_style():
        layout = ConstrainedLayoutEngine(rect=(0.0, foot / height, 1.0, sum(rows) / height))
        fig = Figure(figsize=(WIDTH, height), facecolor="white", layout=layout)
        _heading(fig, found)
        parts: Any = fig.subfigures(len(rows), 1, height_ratios=rows)
        left, right = parts[0].subplots(1, 2)
        _draw_classes(left, found)
        _draw_per_frame(right, found)
        for axis, ax in enumerate(parts[1].subplots(1, 3, sharey=True)):
            _draw_sizes(ax, found, axis)
        if scanned:
            _draw_points(parts[2], found)
        fig.text(
            LEFT / WIDTH, foot / height, "\n".join(notes), size=6.5, color="#404040", va="top",
            linespacing=1.3, parse_math=False,
        )  # fmt: skip
    return fig


def _heading(fig: Figure, found: Statistics) -> None:
    total = found.total
    seen = f"{counted(total.images, 'image')}, {counted(total.clouds, 'point cloud')}"
    if total.clouds:
        seen += f" of {found.mean_points:,.0f} points on average"
    facts = (
        f"{counted(len(found.splits), 'split')}, {counted(total.scenarios, 'scenario')}, "
        f"{counted(total.frames, 'frame')}, {total.boxes:,} boxes of "
        f"{counted(sum(found.tracks.values()), 'road user')}\n{seen}"
    )
    sheet.heading(fig, f"Data set {found.name}", facts, linespacing=1.35)


def _notes(found: Statistics) -> str:
    sizes = "Sizes: each road user counts once per scenario; numbers are median and quartiles."
    if not found.total.clouds:
        return f"{sizes} The data set has no point clouds."
    return (
        f"{sizes} Points: of all scans of a frame, by range from the nearest LiDAR to the middle "
        "of the box. Median and quartiles are of the boxes with at least one point, in range bands "
        f"a factor of √2 wide that have {FEWEST} boxes or more."
    )


def _class_rows(ax: Axes) -> None:
    ax.set(ylim=(len(KINDS) - 0.5, -0.5), yticks=range(len(KINDS)), yticklabels=KINDS)
    ax.tick_params(axis="y", length=0)


def _grid(ax: Axes, axis: Any = "both") -> None:
    ax.grid(axis=axis, **_GRID)
    ax.set_axisbelow(True)


def _counts(axis: Any) -> None:
    """Ticks at whole numbers, with a comma after thousands."""
    axis.set_major_locator(MaxNLocator(5, integer=True, steps=[1, 2, 5, 10]))
    axis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))


def _logarithmic(axis: Any, *subs: float) -> None:
    """Ticks at these multiples of powers of ten, in plain numbers."""
    axis.set_major_locator(LogLocator(subs=subs))
    axis.set_major_formatter(StrMethodFormatter("{x:,g}"))
    axis.set_minor_locator(NullLocator())


def _draw_classes(ax: Axes, found: Statistics) -> None:
    ax.set_title("Objects per class", **_TITLE)
    boxes, tracks = found.boxes, found.tracks
    bars = ax.barh(range(len(KINDS)), list(boxes.values()), height=0.62, color=CLASS_COLORS)
    words = [f"{boxes[kind]:,} ({tracks[kind]:,})" if boxes[kind] else "0" for kind in KINDS]
    ax.bar_label(bars, words, padding=2, size=6.5)
    _class_rows(ax)
    ax.set(xlim=(0, 1.35 * max(1, *boxes.values())), xlabel="boxes (road users)")
    _counts(ax.xaxis)
    _grid(ax, "x")


def _draw_per_frame(ax: Axes, found: Statistics) -> None:
    ax.set_title("Objects per frame", **_TITLE)
    low, high = int(found.crowd.min()), int(found.crowd.max())
    step = max(1, -(-(high - low + 1) // 40))  # at most 40 bars, each of whole numbers
    ends = np.arange(low, high + step + 1, step) - 0.5
    ax.hist(found.crowd, ends.tolist(), color="#808080", ec="white", lw=0.4)
    mean = float(found.crowd.mean())
    ax.axvline(mean, color="black", lw=0.8, ls=(0, (3, 2)))
    ax.set(xlabel=f"boxes in a frame (mean {mean:.1f})", ylabel="frames")
    ax.set_xlim(min(ends[0], mean - 3), max(ends[-1], mean + 3))
    _counts(ax.xaxis)
    _counts(ax.yaxis)
    _grid(ax, "y")


def _draw_sizes(ax: Axes, found: Statistics, axis: int) -> None:
    """Length, width or height: a histogram per class, scaled to its highest bin."""
    name = ("Length", "Width", "Height")[axis]
    ax.set_title(name, **_TITLE)
    every = found.users.size[:, axis]
    low, high = (every.min(), every.max()) if len(every) else (1.0, 1.0)
    low, high = low / 1.15, high * 1.15
    ends = np.geomspace(low, high, 61)
    for k, color in enumerate(CLASS_COLORS):
        own, foot = every[found.users.kind == k], k + 0.4
        ax.axhline(foot, color="#c0c0c0", lw=0.4, zorder=1)
        if not len(own):
            continue
        share = np.histogram(own, ends)[0]
        tops = foot - 0.75 * share / share.max()
        ax.stairs(tops, ends, baseline=foot, fill=True, color=color, lw=0, zorder=2)
        first, middle, last = np.percentile(own, [25, 50, 75])
        left = middle * middle > low * high  # where there is room for words
        ax.annotate(
            f"{middle:.2f} ({first:.2f}–{last:.2f})", (0.0 if left else 1.0, foot),
            (2 if left else -2, 3), size=6, xycoords=("axes fraction", "data"),
            ha="left" if left else "right", textcoords="offset points",
        )  # fmt: skip
    _class_rows(ax)
    ax.set(xscale="log", xlim=(low, high), xlabel=f"{name.lower()} [m]")
    _logarithmic(ax.xaxis, 1, 2, 3, 5)
    _grid(ax, "x")


def _draw_points(part: SubFigure, found: Statistics) -> None:
    part.suptitle("Points per object by range", x=LEFT / WIDTH, ha="left", size=7, weight="bold")
    handles = [
        Line2D([], [], color="#606060", **_MEDIAN, label="median"),
        Patch(fc="#606060", alpha=0.25, label="quartiles"),
        Line2D([], [], ls="", marker="o", ms=2, mfc="#a8a8a8", mec="none", label="a box"),
    ]
    part.legend(handles=handles, loc="outside lower center", ncols=3, **KEYS)
    panels = part.subplots(2, len(KINDS), sharex=True, sharey="row", height_ratios=(4, 1))
    every = found.points
    for k, (kind, color, (ax, below)) in enumerate(zip(KINDS, CLASS_COLORS, panels.T, strict=True)):
        ax.set_title(kind, **_TITLE)
        own = np.flatnonzero((every.kind == k) & (every.points > 0))
        own = own[:: max(1, -(-len(own) // MOST_DOTS))]
        ax.plot(
            every.range[own], every.points[own], "o", ms=1.2, mfc="#a8a8a8", mec="none",
            alpha=0.5, zorder=1, rasterized=True,
        )  # fmt: skip
        shown = [band for band in bands(every, k) if band.boxes >= FEWEST]
        shares = [band.share for band in shown]
        below.plot([band.middle for band in shown], shares, color=color, **_MEDIAN)
        hit = [(band.middle, *band.quartiles) for band in shown if band.quartiles]
        x, first, middle, last = np.array(hit).reshape(-1, 4).T
        ax.plot(x, middle, color=color, **_MEDIAN)
        ax.fill_between(x, first, last, color=color, alpha=0.25, lw=0)
        if not (every.kind == k).any():
            ax.text(0.5, 0.5, "none", transform=ax.transAxes, ha="center", color="#808080")
        below.set(xlabel="range [m]")
        _grid(ax)
        _grid(below)
    most = max(10.0, float(every.points.max(initial=0)))
    above, below = panels[:, 0]
    above.set(xscale="log", xlim=(0.9 * max(0.1, every.range.min()), 1.1 * every.range.max()))
    above.set(yscale="log", ylim=(0.8, 1.5 * most), ylabel="points in the box")
    below.set(ylim=(-0.06, 1.06), yticks=[0, 0.5, 1], ylabel="share\nwith any")
    _logarithmic(above.xaxis, 1, 2, 5)
    _logarithmic(above.yaxis, 1)
