"""The plan view of a page: a small picture without a heading, with the worst blind spots on it."""

from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from inspe_jax.core.sheet import house_style
from inspe_jax.report.figures import draw_plan, reach_of, spread_badges
from inspe_jax.report.layers import seen_layer
from inspe_jax.scene.scene import Scene
from inspe_jax.scoring.blind_spots import BlindSpot
from inspe_jax.scoring.evaluate import Scores
from inspe_jax.sensing.layout import Layout

LETTERS = "ABCDE"
"""Of the worst blind spots, on the plan view and in the list."""
SIDE, DOTS = 3.4, 160
"""Side of the plan view [inch], and pixels per inch."""
APART = 0.07
"""Least distance between two letters, as a share of the side."""


def plan_picture(
    scene: Scene, layout: Layout, scores: Scores, spots: tuple[BlindSpot, ...]
) -> Figure:
    """A plan view without a heading: how often each column is seen, sensors, and blind spots."""
    layer = replace(seen_layer(scores.seen_share, scene), users=False)
    layout = scores.conditions.layout(layout)
    with house_style():
        fig = Figure(figsize=(SIDE, SIDE), facecolor="white")
        ax = fig.add_axes((0.0, 0.0, 1.0, 1.0))
        draw_plan(ax, scene, layout, layer, reach_of(scene, layout), side=SIDE)
        ax.axis("off")
        at = np.array([spot.at for spot in spots]).reshape(-1, 2)
        apart = APART * np.ptp(ax.get_xlim())
        for letter, (x, y) in zip(LETTERS, spread_badges(at, 0.0 * at, apart), strict=False):
            ax.text(
                x, y, letter, size=9, weight="bold", ha="center", va="center_baseline",
                zorder=10, bbox=dict(boxstyle="circle", fc="white", ec="black", lw=0.8),
            )  # fmt: skip
        behind = Rectangle((0.015, 0.015), 0.29, 0.085, transform=ax.transAxes)
        ax.add_patch(behind).set(facecolor="white", edgecolor="none", zorder=9)
        key = ax.inset_axes((0.03, 0.03, 0.26, 0.022), zorder=10)
        key.imshow(np.linspace(0, 1, 64)[None], cmap=layer.colors, aspect="auto")
        key.axis("off")
        for x, words, side in ((0.03, "never", "left"), (0.29, "always seen", "right")):
            ax.text(
                x, 0.06, words, size=6.5, ha=side, va="bottom", transform=ax.transAxes, zorder=10
            )
    return fig
