"""A figure of a data set: classes, sizes, road users per frame, and points by range."""

import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import (
    FixedLocator,
    MaxNLocator,
    NullFormatter,
    NullLocator,
    StrMethodFormatter,
)

from inspe_jax.core.sheet import CLASS_COLORS, KEYS, NOTE_LINE, TITLE, WIDTH, fit, house_style
from inspe_jax.core.words import counted
from inspe_jax.dataset.statistics import RANGE_EDGES, Band, Statistics, bands
from inspe_jax.simulation.frame import KINDS

FEWEST = 5
"""Range bands with fewer boxes than this are left out of the curves."""

MOST_DOTS = 2000
"""Largest number of boxes of a class that are drawn as dots; of more, every n-th is drawn."""

_LEFT, _RIGHT, _GAP = 0.72, 0.12, 0.42  # margins and between panels [inch]
_HEAD, _BETWEEN, _SHARE = 0.84, 0.66, 0.53  # above, between rows, of the lower panels [inch]
_GRID: dict[str, Any] = dict(color="#e0e0e0", lw=0.4)
_MERGED: dict[str, Any] = dict(color="#303030", lw=1.0, ls=(0, (4, 1.5)))
_TICKS = np.array([1, 2, 5]) * 10.0 ** np.arange(-2, 4)[:, None]
_FINE_TICKS = np.array([1, 1.5, 2, 3, 4, 5, 7]) * 10.0 ** np.arange(-2, 4)[:, None]


def statistics_view(found: Statistics) -> Figure:
    """A figure of a data set: objects per class and per frame, their sizes, and points by range.

    Sizes count each road user once per scenario. Points are shown for single scans, and for all
    scans of a frame together; this part is left out if the data set has no point clouds.
    """
    clouds = found.total.clouds > 0
    notes = [
        line for note in _notes(found) for line in textwrap.wrap(note, 130, subsequent_indent="  ")
    ]
    foot = 0.06 + NOTE_LINE * len(notes)
    rows = [1.05, 1.40, *([1.65 + _SHARE] if clouds else [])]
    height = _HEAD + sum(rows) + _BETWEEN * (len(rows) - 1) + (0.2 if clouds else 0.0) + 0.56 + foot
    with house_style():
        fig = Figure(figsize=(WIDTH, height), facecolor="white")
        _heading(fig, found)
        top = _HEAD
        left, right = _row(fig, top, rows[0], 2)
        _draw_classes(left, found)
        _draw_per_frame(right, found)
        top += rows[0] + _BETWEEN
        _draw_sizes(_row(fig, top, rows[1], 3), found)
        top += rows[1] + _BETWEEN
        if clouds:
            _points_heading(fig, top)
            top += 0.2
            panels = _row(fig, top, 1.65, len(KINDS), 0.12)
            shares = _row(fig, top + 1.65 + 0.08, _SHARE - 0.08, len(KINDS), 0.12)
            _draw_points(panels, shares, found)
        fig.text(
            _LEFT / WIDTH, foot / height, "\n".join(notes), size=6.5, color="#404040", va="top",
            linespacing=1.3, parse_math=False,
        )  # fmt: skip
    return fig


def _heading(fig: Figure, found: Statistics) -> None:
    height, total = fig.get_figheight(), found.total
    title = fit(f"Data set {found.name}", TITLE, 10)
    fig.text(_LEFT / WIDTH, 1 - 0.10 / height, **title, weight="bold", va="top", parse_math=False)
    users = sum(found.tracks.values())
    what = [
        counted(len(found.splits), "split"),
        counted(total.scenarios, "scenario"),
        counted(total.frames, "frame"),
        f"{total.boxes:,} boxes of {counted(users, 'road user')}",
    ]
    seen = [counted(total.images, "image"), counted(total.clouds, "point cloud")]
    if total.clouds:
        seen[-1] += f" of {found.mean_points:,.0f} points on average"
    facts = f"{', '.join(what)}\n{', '.join(seen)}"
    fig.text(_LEFT / WIDTH, 1 - 0.29 / height, facts, va="top", linespacing=1.35, parse_math=False)


def _notes(found: Statistics) -> list[str]:
    notes = ["Sizes: each road user counts once per scenario; numbers are median and quartiles."]
    if not found.total.clouds:
        return [*notes, "The data set has no point clouds."]
    return [
        *notes,
        "Points: the range is from the LiDAR to the middle of the box; for all scans of a frame, "
        "from the nearest LiDAR. Median and quartiles are of the boxes with at least one point, in "
        f"range bands a factor of √2 wide that have {FEWEST} boxes or more.",
    ]


def _row(fig: Figure, top: float, height: float, count: int, gap: float = _GAP) -> list[Axes]:
    """Panels side by side; their upper edge is ``top`` inches below that of the figure."""
    whole = fig.get_figheight()
    width = (WIDTH - _LEFT - _RIGHT - gap * (count - 1)) / count
    return [
        fig.add_axes(
            (
                (_LEFT + k * (width + gap)) / WIDTH,
                1 - (top + height) / whole,
                width / WIDTH,
                height / whole,
            )
        )
        for k in range(count)
    ]


def _title(ax: Axes, words: str) -> None:
    ax.set_title(words, loc="left", size=7, weight="bold", pad=4)


def _class_rows(ax: Axes) -> None:
    """One row per class, the first at the top."""
    ax.set(ylim=(len(KINDS) - 0.5, -0.5), yticks=range(len(KINDS)), yticklabels=KINDS)
    ax.tick_params(axis="y", length=0)


def _draw_classes(ax: Axes, found: Statistics) -> None:
    _title(ax, "Objects per class")
    boxes, tracks = found.boxes, found.tracks
    ax.barh(range(len(KINDS)), list(boxes.values()), height=0.62, color=CLASS_COLORS)
    most = max(1, *boxes.values())
    for k, kind in enumerate(KINDS):
        words = f"{boxes[kind]:,} ({tracks[kind]:,})" if boxes[kind] else "0"
        ax.text(boxes[kind] + 0.02 * most, k, words, va="center", size=6.5)
    _class_rows(ax)
    ax.set(xlim=(0, 1.35 * most), xlabel="boxes (road users)")
    _counts(ax.xaxis)
    ax.grid(axis="x", **_GRID)
    ax.set_axisbelow(True)


def _draw_per_frame(ax: Axes, found: Statistics) -> None:
    _title(ax, "Objects per frame")
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
    ax.grid(axis="y", **_GRID)
    ax.set_axisbelow(True)


def _counts(axis: Any) -> None:
    """Ticks at whole numbers, with a comma after thousands."""
    axis.set_major_locator(MaxNLocator(5, integer=True, steps=[1, 2, 5, 10]))
    axis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))


def _draw_sizes(panels: Sequence[Axes], found: Statistics) -> None:
    """Length, width and height: a histogram per class, scaled to its highest bin."""
    for axis, (ax, name) in enumerate(zip(panels, ("Length", "Width", "Height"), strict=True)):
        _title(ax, name)
        every = found.users.size[:, axis]
        low, high = (every.min(), every.max()) if len(every) else (1.0, 1.0)
        low, high = low / 1.15, high * 1.15
        ends = np.geomspace(low, high, 61)
        for k, color in enumerate(CLASS_COLORS):
            own = every[found.users.kind == k]
            ax.axhline(k + 0.4, color="#c0c0c0", lw=0.4, zorder=1)
            if not len(own):
                continue
            share = np.histogram(own, ends)[0]
            ax.stairs(
                k + 0.4 - 0.75 * share / share.max(), ends, baseline=k + 0.4, fill=True,
                color=color, lw=0, zorder=2,
            )  # fmt: skip
            first, middle, last = np.percentile(own, [25, 50, 75])
            words = f"{middle:.2f} ({first:.2f}–{last:.2f})"
            room = middle * middle > low * high  # on the left
            ax.annotate(
                words, (0.0 if room else 1.0, k + 0.4), (2 if room else -2, 3), size=6,
                xycoords=("axes fraction", "data"), ha="left" if room else "right",
                textcoords="offset points",
            )  # fmt: skip
        _class_rows(ax)
        if axis:
            ax.set_yticklabels([])
        ax.set(xscale="log", xlim=(low, high), xlabel=f"{name.lower()} [m]")
        _log_ticks(ax.xaxis, fine=high / low < 8)
        ax.grid(axis="x", **_GRID)
        ax.set_axisbelow(True)


def _log_ticks(axis: Any, fine: bool = False) -> None:
    """Ticks at 1, 2, 5, 10 … or, if ``fine``, at more numbers, without powers of ten."""
    axis.set_major_locator(FixedLocator((_FINE_TICKS if fine else _TICKS).ravel()))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_locator(NullLocator())


def _points_heading(fig: Figure, top: float) -> None:
    """The title and the legend above the panels of points."""
    above = 1 - (top - 0.17) / fig.get_figheight()
    words: dict[str, Any] = dict(size=7, weight="bold", va="center")
    fig.text(_LEFT / WIDTH, above, "Points per object by range", **words)
    handles = [
        Line2D([], [], color="#606060", lw=1.4, marker="o", ms=2.2, label="one scan, median"),
        Patch(fc="#606060", alpha=0.25, label="quartiles"),
        Line2D([], [], ls="", marker="o", ms=2, mfc="#a8a8a8", mec="none", label="a box"),
        Line2D([], [], **_MERGED, label="all scans of a frame"),
    ]
    fig.legend(
        handles=handles, loc="center right", ncols=4, columnspacing=1.1,
        bbox_to_anchor=(1 - _RIGHT / WIDTH, above), **{**KEYS, "handlelength": 2.2},
    )  # fmt: skip


def _draw_points(panels: Sequence[Axes], shares: Sequence[Axes], found: Statistics) -> None:
    """For each class the points in its boxes by range, and below the share of boxes with a
    point."""
    every = found.single
    shown = [band for k in range(len(KINDS)) for band in bands(every, k)]
    near = min((band.low for band in shown), default=RANGE_EDGES[0])
    far = max((band.high for band in shown), default=RANGE_EDGES[-1])
    most = max(10.0, float(found.merged.points.max(initial=0)))
    for k, (kind, color) in enumerate(zip(KINDS, CLASS_COLORS, strict=True)):
        ax, below = panels[k], shares[k]
        _title(ax, kind)
        own = np.flatnonzero((every.kind == k) & (every.points > 0))
        own = own[:: max(1, -(-len(own) // MOST_DOTS))]
        ax.plot(
            every.range[own], every.points[own], "o", ms=1.2, mfc="#a8a8a8", mec="none",
            alpha=0.5, zorder=1, rasterized=True,
        )  # fmt: skip
        one, all_ = (_drawn(bands(counts, k)) for counts in (every, found.merged))
        x, quartiles = _curve(one)
        if len(x):
            ax.fill_between(x, quartiles[:, 0], quartiles[:, 2], color=color, alpha=0.25, lw=0)
            ax.plot(x, quartiles[:, 1], color=color, lw=1.4, marker="o", ms=2.2)
        x, quartiles = _curve(all_)
        ax.plot(x, quartiles[:, 1], **_MERGED)
        for of, look in ((one, dict(color=color, lw=1.4)), (all_, _MERGED)):
            below.plot([_middle(band) for band in of], [band.share for band in of], **look)
        if not (every.kind == k).any():
            ax.text(0.5, 0.5, "none", transform=ax.transAxes, ha="center", color="#808080")
        for each in (ax, below):
            each.set(xscale="log", xlim=(near, far))
            _log_ticks(each.xaxis)
            each.grid(**_GRID)
            each.set_axisbelow(True)
            if k:
                each.tick_params(labelleft=False)
        ax.set(yscale="log", ylim=(0.8, 1.5 * most))
        ax.yaxis.set_major_locator(FixedLocator([10.0**k for k in range(7)]))
        ax.yaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
        ax.yaxis.set_minor_formatter(NullFormatter())
        ax.tick_params(labelbottom=False)
        below.set(ylim=(-0.06, 1.06), yticks=[0, 0.5, 1], xlabel="range [m]")
    panels[0].set_ylabel("points in the box")
    shares[0].set_ylabel("share\nwith any")


def _drawn(of: Sequence[Band]) -> list[Band]:
    return [band for band in of if band.boxes >= FEWEST]


def _middle(band: Band) -> float:
    return float(np.sqrt(band.low * band.high))


def _curve(of: Sequence[Band]) -> tuple[np.ndarray, np.ndarray]:
    """Ranges (N,), and quartiles of the points there (N, 3), of bands where a box has a point."""
    nonempty = [band for band in of if band.quartiles]
    return (
        np.array([_middle(band) for band in nonempty]),
        np.array([band.quartiles for band in nonempty]).reshape(-1, 3),
    )
