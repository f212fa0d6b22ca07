"""Figures of searches: the layout before and after; score against time, work and cost."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import FancyArrowPatch
from matplotlib.ticker import StrMethodFormatter

from inspe_jax.core import sheet
from inspe_jax.core.errors import InspeError
from inspe_jax.core.sheet import KEYS, SIDE, SIDE_LEFT, WIDTH, house_style, setting_words
from inspe_jax.placement.result import Result
from inspe_jax.placement.run import Progress
from inspe_jax.placement.studies.pareto import DeviceMix
from inspe_jax.report.figures import draw_plan, in_math, plan_keys, reach_of
from inspe_jax.report.layers import seen_layer
from inspe_jax.report.tables import by_method
from inspe_jax.scene.scene import Scene
from inspe_jax.scoring.evaluate import Scores
from inspe_jax.scoring.metrics import listed_in
from inspe_jax.sensing.layout import Layout

COLORS = (
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#808080",
)  # fmt: skip
"""One colour for each method: those of Okabe and Ito that stand out from white, and grey."""
LINES = ("-", (0, (5, 1.5)), (0, (1.2, 1.2)), (0, (6, 1.5, 1.2, 1.5)))
"""Line styles, so that methods differ not only in colour."""
FRONT, BEATEN = "#0072b2", "#808080"
NAMED = 12  # most mixes on the front that are named; those that add most to the score are chosen
_LEFT = 0.085  # left edge of headings and axes, as a share of the width

Curve = Float[np.ndarray, " P"]

MOVED = 0.5  # units that moved further than this get an arrow [m]
WENT = "where a unit went, step by step"
_HEAD, _BELOW, _ROW = 0.66, 0.64, 0.17  # above and below the maps, and for a row of keys [inch]
_CAPTION = 60  # characters that fit on a line above a map
_ARROW: dict[str, Any] = dict(color="#202020", lw=0.9)


def before_after(
    scene: Scene,
    before: Layout,
    after: Layout,
    scores_before: Scores,
    scores: Scores,
    *,
    path: Float[np.ndarray, "K S 6"] | None = None,
    frame: int = 0,
) -> Figure:
    """Two plan views side by side, on one scale: a layout before and after a search.

    One view where nothing moved. Colours are those of
    :func:`~inspe_jax.report.figures.plan_view`. Arrows in the right view lead from the old to the
    new place of each unit.

    Args:
        scene: The scene of both.
        before, after: Layouts of the same sensors.
        scores_before, scores: Their scores.
        path: (K, S, 6) poses that arrows follow, as of :class:`~inspe_jax.placement.result.Result`.
        frame: Number of the frame of traffic that is drawn.

    Raises:
        InspeError: The layouts have different sensors, or the scores are of another scene.
    """
    if not same_sensors(before, after):
        raise InspeError(f"{before.name} and {after.name} are not of the same sensors")
    moved = not np.array_equal(before.poses, after.poses)
    when = (("before" if moved else "nothing moved", before, scores_before),
            ("after", after, scores))[: 1 + moved]  # fmt: skip
    with house_style():
        title = f"{before.name} at {scene.name}"
        facts = f"radius {scene.voxels.radius:g} m, {scene.voxels.words}; frame {frame} of the "
        facts += f"traffic; {setting_words(scores.settings)}"
        keys = plan_keys(scene, before)
        below = _BELOW + _ROW * np.ceil((len(keys) + 1) / 2)
        fig, axes = sheet.sheet_of_two(title, facts, len(when), _HEAD, below)
        height, reach = fig.get_figheight(), reach_of(scene, before, after)
        for ax, (words, layout, of) in zip(axes, when, strict=True):
            layer, shown = seen_layer(of.seen_share, scene), of.conditions.layout(layout)
            image = draw_plan(ax, scene, shown, layer, reach, frame, side=SIDE)
            ax.set_title(_caption(words, of), size=7.5, loc="left", pad=4)
        if moved:
            ax.set(ylabel="")
            way = [before.poses, after.poses] if path is None else path
            moved = _draw_moves(ax, before, np.asarray(way, float))
        bar = fig.add_axes((SIDE_LEFT / WIDTH, 0.30 / height, 1.75 / WIDTH, 0.09 / height))
        ticks = [0, 0.25, 0.5, 0.75, 1]
        fig.colorbar(image, cax=bar, orientation="horizontal", ticks=ticks, format="{x:g}")
        bar.set_title(layer.label.replace("\n", " ", 1), loc="left", size=7)
        if moved:
            keys.insert(0, Line2D([], [], **_ARROW, marker=">", ms=3, label=WENT))
        keys_left = (SIDE_LEFT + SIDE) / WIDTH
        fig.legend(
            handles=keys, loc="lower left", bbox_to_anchor=(keys_left, 0.10 / height), ncols=2,
            columnspacing=1.6, **KEYS,
        )  # fmt: skip
    return fig


def same_sensors(before: Layout, after: Layout) -> bool:
    """Whether two layouts have sensors of the same names on the same units."""
    first, second = ([(s.name, s.unit) for s in of.sensors] for of in (before, after))
    return first == second


def _caption(when: str, scores: Scores) -> str:
    """The scores of a map, P_sm first; on two lines where there are many."""
    *metrics, surrogate = listed_in(scores)
    each = ", ".join(f"{in_math(m)} {scores.value(m.name):.3f}" for m in metrics)
    first = f"{when}: {in_math(surrogate)} {scores.surrogate:.3f}"
    return f"{first}  ({each})" if len(first) + len(each) <= _CAPTION else f"{first}\n({each})"


def _draw_moves(ax: Axes, layout: Layout, path: Float[np.ndarray, "K S 6"]) -> bool:
    """Draw every unit's way from the first poses to the last; returns whether any has moved."""
    moved = False
    for members in layout.members():
        track = _thinned(path[:, list(members), :2].mean(1))
        if len(track) == 1:
            continue
        moved = True
        ax.plot(*track[0], "o", ms=4, mfc="white", mec=_ARROW["color"], mew=0.8, zorder=5.5)
        ax.plot(*track[:-1].T, "-", marker=".", ms=2.5, zorder=5.4, **{**_ARROW, "lw": 0.5})
        bend = 0.12 if len(track) == 2 else 0.0
        arrow = FancyArrowPatch(
            tuple(track[-2]), tuple(track[-1]), connectionstyle=f"arc3,rad={bend}",
            arrowstyle="-|>,head_width=1.6,head_length=3", shrinkA=2, shrinkB=6, zorder=5.4,
            path_effects=sheet.HALO, **_ARROW,
        )  # fmt: skip
        ax.add_patch(arrow)
    return moved


def _thinned(track: Float[np.ndarray, "K 2"]) -> Float[np.ndarray, "J 2"]:
    """The points of a track further than :data:`MOVED` from the one kept before, its end in place
    of the last of them; the first alone if none is so far."""
    kept = [track[0]]
    for at in track[1:]:
        if np.hypot(*(at - kept[-1])) > MOVED:
            kept.append(at)
    if len(kept) > 1:
        kept[-1] = track[-1]
    return np.array(kept)


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
        sheet.heading(fig, f"Cost against score at {mixes[0].scene}", facts, _LEFT)
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
            fig.text(0.11, y, **sheet.fit(words, 110, 7), va="bottom", parse_math=False)
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
        sheet.heading(fig, f"Searches for {results[0].start.name} at {scenes}", facts, _LEFT)
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
