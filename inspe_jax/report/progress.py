"""The figure of a search: the layout before and after it."""

from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import FancyArrowPatch

from inspe_jax.core import sheet
from inspe_jax.core.errors import InspeError
from inspe_jax.core.sheet import SIDE, SIDE_LEFT, WIDTH
from inspe_jax.report.figures import draw_plan, in_math, plan_keys, reach_of
from inspe_jax.report.layers import seen_layer
from inspe_jax.scene.scene import Scene
from inspe_jax.scoring.evaluate import Scores
from inspe_jax.scoring.metrics import listed_in
from inspe_jax.sensing.layout import Layout

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
    with sheet.house_style():
        title = f"{before.name} at {scene.name}"
        facts = f"radius {scene.voxels.radius:g} m, {scene.voxels.words}; frame {frame} of the "
        facts += f"traffic; {sheet.setting_words(scores.settings)}"
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
            columnspacing=1.6, **sheet.KEYS,
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
