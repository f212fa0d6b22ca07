"""The sheet that maps are drawn on, 180 mm wide: the map on the left, a panel for the legend on the
right, a heading above, notes below. And how figures are saved."""

import base64
import io
import itertools
import os
import textwrap
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib import patheffects, style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from inspe_jax.core.files import check_output, whole_file

FORMATS: dict[str, dict[str, None]] = {
    ".png": {},
    ".svg": {"Date": None},
    ".pdf": {"CreationDate": None},
}
"""Suffixes that :func:`save_figure` knows. Each has the metadata to leave out: the date, which
would make two files differ."""

STYLE: dict[str, Any] = {
    "font.size": 7.0, "legend.fontsize": 7.0, "axes.labelsize": 7.0, "axes.linewidth": 0.5,
    "xtick.labelsize": 6.5, "xtick.major.width": 0.5, "xtick.major.size": 2.5,
    "ytick.labelsize": 6.5, "ytick.major.width": 0.5, "ytick.major.size": 2.5,
    "hatch.linewidth": 0.4, "pdf.fonttype": 42, "svg.hashsalt": "inspe_jax",
}  # fmt: skip
WIDTH, MAP, LEFT, PANEL, ASIDE = 180 / 25.4, 4.75, 0.52, 5.40, 1.65  # [inch]
HEAD, FOOT, NOTE_LINE = 0.62, 0.42, 0.125  # [inch]
SIDE, SIDE_LEFT, SIDE_GAP = 3.10, 0.48, 0.30  # of two maps, before the first, between them [inch]
ROW_GAP = 0.45  # between two rows of maps [inch]
TITLE, LINE = 68, 126
"""Characters that fit on a line: of a figure's title, and of the facts below it."""
READABLE = 0.6  # least share of the usual size of letters on one line
CIRCLE: dict[str, Any] = dict(color="#404040", lw=0.8, ls=(0, (6, 3)))
HALO = [patheffects.withStroke(linewidth=2.0, foreground="white", alpha=0.7)]

CLASS_COLORS: tuple[str, ...] = ("#0072b2", "#d55e00", "#cc79a7", "#000000")
"""Blue, vermilion, reddish purple and black, in the order of the road-user classes."""

KEYS: dict[str, Any] = dict(borderpad=0.0, borderaxespad=0.0, frameon=False, handlelength=1.6)

_DRAWING = threading.RLock()


def save_figure(fig: Figure, path: str | os.PathLike[str]) -> None:
    """Write a figure as ``.png``, ``.svg`` or ``.pdf``, whole or not at all. The same figure gives
    the same bytes. Raises InspeError for another suffix, or if the folder is missing."""
    check_output(path, FORMATS)
    suffix = Path(path).suffix.lower()
    with house_style(), whole_file(path) as f:
        fig.savefig(f, format=suffix[1:], dpi=300, metadata=FORMATS[suffix])


def image_text(fig: Figure, dpi: float, kind: str = "png") -> str:
    """A figure in base64, for a page that holds it: as PNG, or as JPEG, for one that is mostly a
    photograph. The same figure gives the same text."""
    made = io.BytesIO()
    with house_style():
        fig.savefig(made, dpi=dpi, format=kind, pil_kwargs={"quality": 85})  # of JPEG
    return base64.b64encode(made.getvalue()).decode()


@contextmanager
def house_style() -> Iterator[None]:
    """Matplotlib's defaults with :data:`STYLE`, which all threads share: one draws at a time."""
    with _DRAWING, style.context(["default", STYLE]):
        yield


def sheet(
    title: str, facts: str, notes: Sequence[str], panel_height: float, math: bool = False
) -> tuple[Figure, Axes, Axes]:
    """An empty sheet (figure, map, panel), as high as the notes and the panel, of ``panel_height``
    [inch], need; with ``math``, dollar signs in ``facts`` begin formulas."""
    lines = [line for note in notes for line in textwrap.wrap(note, LINE, subsequent_indent="  ")]
    below = FOOT + (len(lines) * NOTE_LINE + 0.12 if lines else 0.0)
    body = max(MAP, panel_height)
    height = HEAD + body + below
    fig = Figure(figsize=(WIDTH, height), facecolor="white")
    left, bottom = LEFT / WIDTH, (height - HEAD - MAP) / height
    ax = fig.add_axes((left, bottom, MAP / WIDTH, MAP / height))
    panel = fig.add_axes((PANEL / WIDTH, below / height, ASIDE / WIDTH, body / height))
    panel.set(xlim=(0, ASIDE * 72), ylim=(-body * 72, 0))  # in points
    panel.axis("off")
    heading(fig, title, facts, parse_math=math, linespacing=1.35)
    fig.text(
        left, (below - FOOT) / height, "\n".join(lines),
        size=6.5, color="#404040", va="top", linespacing=1.3, parse_math=False,
    )  # fmt: skip
    return fig, ax, panel


def sheet_of_two(
    title: str, facts: str, count: int, head: float, below: float, rows: int = 1
) -> tuple[Figure, list[Axes]]:
    """A sheet for two maps side by side, of which ``count`` are there, in some ``rows``: the figure
    and their axes, row by row. ``head`` and ``below`` are the room above and below [inch]."""
    height = head + rows * SIDE + (rows - 1) * ROW_GAP + below
    fig = Figure(figsize=(WIDTH, height), facecolor="white")
    heading(fig, title, facts, SIDE_LEFT / WIDTH)
    axes = []
    for row in reversed(range(rows)):
        bottom = (below + row * (SIDE + ROW_GAP)) / height
        for k in range(count):
            beside = (SIDE_LEFT + k * (SIDE + SIDE_GAP)) / WIDTH
            axes.append(fig.add_axes((beside, bottom, SIDE / WIDTH, SIDE / height)))
    return fig, axes


def heading(fig: Figure, title: str, facts: str, left: float = LEFT / WIDTH, **how: Any) -> None:
    """Write a title and ``facts`` below it, from ``left`` of the width on; facts with a line that
    is longer than the sheet are smaller. ``how`` is the look of the facts."""
    height = fig.get_figheight()
    look: dict[str, Any] = dict(x=left, va="top", parse_math=False)
    fig.text(y=1 - 0.10 / height, **fit(title, TITLE, 10), weight="bold", **look)
    longest = max(map(len, facts.splitlines()), default=0)
    size = STYLE["font.size"] * min(1.0, LINE / max(longest, 1))
    fig.text(y=1 - 0.29 / height, s=facts, size=size, **look | how)


def frame_map(ax: Axes, middle: Float[np.ndarray, "..."], radius: float, reach: float) -> None:
    """Frame ``reach`` [m] about the ``middle``; draw a circle of ``radius`` [m], scale and
    arrow."""
    x, y = map(float, middle[:2])
    limit = 1.06 * reach
    ax.set(xlim=(x - limit, x + limit), ylim=(y - limit, y + limit), aspect="equal")
    ax.set(xlabel="x, east [m]", ylabel="y, north [m]")
    ax.add_patch(Circle((x, y), radius, fill=False, **CIRCLE, zorder=5))
    draw_scale(ax, limit)


def draw_scale(ax: Axes, limit: float) -> None:
    """Draw a scale bar and a north arrow on a map that reaches ``limit`` [m] from its middle."""
    bars = (k * 10**n for n in range(6) for k in (1, 2, 5))
    bar = max((m for m in bars if m <= 0.4 * limit), default=1)
    words = f"{bar} m" if bar < 1000 else f"{bar / 1000:g} km"
    at: dict[str, Any] = dict(transform=ax.transAxes, zorder=9, path_effects=HALO)
    start, end = 0.98 - bar / (2 * limit), 0.98
    ax.plot([start, end], [0.02, 0.02], "k-", lw=2.2, solid_capstyle="butt", **at)
    ax.text((start + end) / 2, 0.03, words, ha="center", va="bottom", **at)
    ax.plot([0.965, 0.965], [0.90, 0.965], "k-", lw=1.0, **at)
    ax.plot(0.965, 0.965, "k^", ms=4, **at)
    ax.text(0.965, 0.89, "N", ha="center", va="top", weight="bold", **at)


def fit(words: str, length: int, size: float) -> dict[str, Any]:
    """Text that is never cut: what to pass to matplotlib for its words and their size [pt].
    ``length`` characters of this ``size`` fit on a line; longer words are smaller, and below
    :data:`READABLE` of the size on several lines, together 1.2 times as high."""
    if READABLE * len(words) <= length:
        return dict(s=words, size=size * min(1.0, length / max(len(words), 1)))
    for lines in itertools.count(2):
        share = 1.2 / lines
        broken = textwrap.wrap(words, int(length / share))
        if len(broken) <= lines:
            return dict(s="\n".join(broken), size=size * share, linespacing=1.05)
    raise AssertionError("some number of lines is enough")


def setting_words(settings: Mapping[str, Any]) -> str:
    """The light, the weather and the profile of scores or of a scene: they stand on its figure."""
    words = dict(light="", weather="", profile="profile ")
    return ", ".join(f"{word}{settings[key]}" for key, word in words.items() if key in settings)
