"""The figure of coverage against height."""

from collections.abc import Sequence
from textwrap import fill

import numpy as np
from matplotlib.figure import Figure

from inspe_jax.core.sheet import TITLE, WIDTH, fit, house_style, setting_words
from inspe_jax.report.progress import COLORS, LINES
from inspe_jax.scene.scene import Scene
from inspe_jax.scoring.evaluate import Scores


def height_view(scene: Scene, scored: Sequence[tuple[str, Scores]]) -> Figure:
    """Share of each level's voxels that is in view, against height above the ground.

    ``scored`` has the name and the scores of each layout.
    """
    grid = scene.voxels
    middle = grid.levels
    with house_style():
        fig = Figure(figsize=(WIDTH, 2.9), facecolor="white")
        ax = fig.add_axes((0.085, 0.14, 0.56, 0.64))
        for k, (name, scores) in enumerate(scored):
            ax.plot(
                scores.level_coverage, middle, color=COLORS[k % len(COLORS)],
                ls=LINES[k % len(LINES)], lw=1.3, marker="o", ms=3, label=fill(name, 30),
            )  # fmt: skip
        low = min(min(scores.level_coverage) for _, scores in scored)
        ax.set(
            xlim=(min(0.9, np.floor(10 * low) / 10), 1.005),
            ylim=(0, grid.spacing * grid.level_count),
            xlabel="share of the level's voxels in view",
            ylabel="height above the ground [m]",
        )
        ax.grid(color="#e0e0e0", lw=0.4)
        ax.set_axisbelow(True)
        title = fit(f"Coverage against height at {scene.name}", TITLE, 10)
        fig.text(0.085, 0.965, **title, weight="bold", va="top", parse_math=False)
        facts = f"radius {grid.radius:g} m, {grid.words}; traffic does not matter here"
        facts += f"; {setting_words(scored[0][1].settings)}"
        fig.text(0.085, 0.88, facts, va="top", parse_math=False)
        fig.legend(loc="upper left", bbox_to_anchor=(0.66, 0.80), frameon=False)
    return fig
