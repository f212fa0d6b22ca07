"""Figures of searches: the layout before and after, and the best score against time and work."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import FancyArrowPatch

from inspe_jax.core.errors import InspeError
from inspe_jax.core.sheet import (
    HALO,
    KEYS,
    SIDE,
    SIDE_LEFT,
    TITLE,
    WIDTH,
    fit,
    frame_map,
    house_style,
    setting_words,
    sheet_of_two,
)
from inspe_jax.placement.result import Result
from inspe_jax.placement.run import Progress
from inspe_jax.report.figures import draw_badges, draw_layer, in_math, layer_raster, plan_keys
from inspe_jax.report.layers import seen_layer
from inspe_jax.scene.scene import Scene
from inspe_jax.scoring.evaluate import Scores
from inspe_jax.scoring.metrics import listed_in
from inspe_jax.sensing.layout import Layout

MOVED = 0.5
"""Units that moved further than this get an arrow [m]."""
WENT = "where a unit went, step by step"
COLORS = (
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#808080",
)  # fmt: skip
"""One colour for each method: those of Okabe and Ito that stand out from white, and grey."""
LINES = ("-", (0, (5, 1.5)), (0, (1.2, 1.2)), (0, (6, 1.5, 1.2, 1.5)))
"""Line styles, so that methods differ not only in colour."""

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
    new place of each unit. ``path`` is that of :class:`~inspe_jax.placement.result.Result`; if
    given, arrows follow the places in between. Raises InspeError if the layouts have different
    sensors, or if the scores are of another scene.
    """
    if not same_sensors(before, after):
        raise InspeError(f"{before.name} and {after.name} are not of the same sensors")
    moved = not np.array_equal(before.poses, after.poses)
    maps = [
        (
            of_scores.conditions.layout(of),
            np.asarray(of.poses, float),
            layer := seen_layer(of_scores.seen_share, scene),
            *layer_raster(scene.voxels, layer),
        )
        for of, of_scores in ((before, scores_before), (after, scores))[: 1 + moved]
    ]
    center, radius = scene.voxels.center[:2], scene.voxels.radius
    reach = max(radius, *(np.hypot(*(poses[:, :2] - center).T).max() for _, poses, *_ in maps))
    with house_style():
        title = f"{before.name} at {scene.name}"
        facts = (
            f"radius {radius:g} m, {scene.voxels.words}; frame {frame} of the traffic; "
            f"{setting_words(scores.settings)}"
        )
        keys = plan_keys(scene, before)
        below = _BELOW + _ROW * np.ceil((len(keys) + 1) / 2)
        fig, axes = sheet_of_two(title, facts, len(maps), _HEAD, below)
        height = fig.get_figheight()
        captions = [_caption("before" if moved else "nothing moved", scores_before)]
        captions.append(_caption("after", scores))
        for k, (layout, poses, layer, raster, extent) in enumerate(maps):
            ax = axes[k]
            frame_map(ax, scene.voxels.center, scene.voxels.radius, reach)
            image = draw_layer(ax, scene, layout, poses, layer, raster, extent, frame)
            ax.set_title(captions[k], size=7.5, loc="left", pad=4)
            if k == 1:
                ax.set(ylabel="")
                way = np.stack([maps[0][1], poses]) if path is None else np.asarray(path, float)
                moved = _draw_moves(ax, before, way)
            draw_badges(ax, layout, poses, SIDE)
        bar = fig.add_axes((SIDE_LEFT / WIDTH, 0.30 / height, 1.75 / WIDTH, 0.09 / height))
        fig.colorbar(image, cax=bar, orientation="horizontal", ticks=[0, 0.25, 0.5, 0.75, 1])
        bar.set_xticklabels(["0", "0.25", "0.5", "0.75", "1"])
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
        ax.add_patch(
            FancyArrowPatch(
                tuple(track[-2]), tuple(track[-1]), connectionstyle=f"arc3,rad={bend}",
                arrowstyle="-|>,head_width=1.6,head_length=3", shrinkA=2, shrinkB=6, zorder=5.4,
                path_effects=HALO, **_ARROW,
            )
        )  # fmt: skip
    return moved


def _thinned(track: Float[np.ndarray, "K 2"]) -> Float[np.ndarray, "J 2"]:
    """The points of a track that are further than :data:`MOVED` from the one kept before.

    The end of the track replaces the last of them. If no point is so far, only the first is kept.
    """
    kept = [track[0]]
    for at in track[1:]:
        if np.hypot(*(at - kept[-1])) > MOVED:
            kept.append(at)
    if len(kept) > 1:
        kept[-1] = track[-1]
    return np.array(kept)


def history_view(results: Sequence[Result]) -> Figure:
    """Best exact score against wall time and against work.

    Each method has a line, the median over its seeds, and a band from the worst to the best seed.
    A search that ended early keeps its score. Raises InspeError if there is no result.
    """
    if not results:
        raise InspeError("no result to draw")
    by: dict[str, list[Result]] = {}
    for result in results:
        by.setdefault(result.method, []).append(result)
    panels: tuple[tuple[str, Callable[[Progress], float]], ...] = (
        ("wall time [s]", lambda row: row.seconds),
        ("work [exact scores]", lambda row: row.evaluations),
    )
    with house_style():
        fig = Figure(figsize=(WIDTH, 3.6), facecolor="white")
        first, second = fig.subplots(1, 2, sharey=True)
        fig.subplots_adjust(left=0.085, right=0.985, top=0.74, bottom=0.13, wspace=0.06)
        for ax, (name, along) in zip((first, second), panels, strict=True):
            end = max(along(result.history[-1]) for result in results)
            end = max(end, *(_ended(result, name) for result in results))
            for k, of in enumerate(by.values()):
                x, low, middle, high = _course([r.history for r in of], along, end)
                color, line = COLORS[k % len(COLORS)], LINES[k % len(LINES)]
                ax.fill_between(x, low, high, step="post", color=color, alpha=0.15, lw=0)
                ax.step(x, middle, where="post", color=color, ls=line, lw=1.3)
            ax.set(xlabel=name, xlim=(0, end))
            ax.grid(color="#e0e0e0", lw=0.4)
            ax.set_axisbelow(True)
        first.set_ylabel("best exact score")
        seeds = max(len(of) for of in by.values())
        scenes = " and ".join(dict.fromkeys(r["name"] for r in results[0].settings["scenes"]))
        title = f"Searches for {results[0].start.name} at {scenes}"
        fig.text(0.085, 0.975, **fit(title, TITLE, 10), weight="bold", va="top", parse_math=False)
        words = f"median of {seeds} seeds and all between the worst and the best"
        words = words if seeds > 1 else "one seed"
        words += f"; {setting_words(results[0].scores.settings)}"
        fig.text(0.085, 0.922, words, va="top")
        handles = [
            Line2D([], [], color=COLORS[k % len(COLORS)], ls=LINES[k % len(LINES)], lw=1.3,
                   label=f"{name}, {np.median([r.objective for r in of]):.4f}")
            for k, (name, of) in enumerate(by.items())
        ]  # fmt: skip
        fig.legend(
            handles=handles, loc="upper left", bbox_to_anchor=(0.085, 0.875), ncols=4,
            columnspacing=1.6, **{**KEYS, "handlelength": 2.6},
        )  # fmt: skip
    return fig


def _ended(result: Result, name: str) -> float:
    return result.seconds if name.startswith("wall") else result.evaluations


Curve = Float[np.ndarray, " P"]


def _course(
    histories: Sequence[Sequence[Progress]], along: Callable[[Progress], float], end: float
) -> tuple[Curve, Curve, Curve, Curve]:
    """(x, lowest, median, highest best score so far) at every x where one of them changes.

    From the first x at which all searches have a score, to ``end``.
    """
    steps = [np.array([[along(row), row.best] for row in history]) for history in histories]
    first = max(row[0, 0] for row in steps)
    x = np.unique(np.concatenate([row[:, 0] for row in steps] + [[first, end]]))
    x = x[x >= first]
    best = [row[np.searchsorted(row[:, 0], x, side="right") - 1, 1] for row in steps]
    return x, np.min(best, 0), np.median(best, 0), np.max(best, 0)
