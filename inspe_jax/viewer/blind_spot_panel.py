"""The plan view on the page, and the worst blind spots beside it: a click on one looks at it. Both
are means over all frames, and are drawn on a thread of their own."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import viser
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from inspe_jax.core.sheet import house_style, image_text
from inspe_jax.report.figures import draw_plan, reach_of, spread_badges
from inspe_jax.report.layers import seen_layer
from inspe_jax.report.page import template
from inspe_jax.scene.scene import Scene
from inspe_jax.scoring.blind_spots import BlindSpot, blind_spots
from inspe_jax.scoring.evaluate import Scores
from inspe_jax.sensing.layout import Layout
from inspe_jax.viewer.job_queue import JobQueue
from inspe_jax.viewer.panel import SLATE, bind

LETTERS = "ABCDE"  # of the worst blind spots, on the plan view and in the list
SIDE, DOTS = 3.4, 160  # side of the plan view [inch], and pixels per inch
APART = 0.07  # least distance between two letters, as a share of the side
_IMAGE = template("viewer", "blind_spots.html.j2")
AWAY = np.array([0.0, -22.0, 20.0])  # from a blind spot to the camera that looks at it [m]


class BlindSpotPanel:
    """A folder of the page with the plan view of the newest scores and their blind spots. ``spots``
    are those that are listed, the worst first."""

    def __init__(
        self, gui: viser.GuiApi, folder: Any, scene: Scene, failed: Callable[[Exception], None]
    ) -> None:
        """``folder`` is empty and invisible until there are scores. ``failed`` gets errors."""
        self.spots: tuple[BlindSpot, ...] = ()
        self._folder, self._scene, self._drawing = folder, scene, JobQueue(failed)
        with folder:
            self.picture = gui.add_html("")
            self.buttons = [
                gui.add_button(letter, color=SLATE, visible=False, hint="Look at this place")
                for letter in LETTERS
            ]
        for k, button in enumerate(self.buttons):
            bind(button, partial(self._look_at, k))

    def show(self, layout: Layout, scores: Scores) -> None:
        """Show the scores of all frames of a layout, as soon as they are drawn."""
        self._drawing.submit(lambda: self._show(layout, scores), key="show")

    def close(self) -> None:
        """Finish what is being drawn."""
        self._drawing.close()

    def _show(self, layout: Layout, scores: Scores) -> None:
        self.spots = blind_spots(self._scene, scores.seen_share)[: len(LETTERS)]
        figure = plan_picture(self._scene, layout, scores, self.spots)
        self.picture.content = _IMAGE.render(png=image_text(figure, DOTS))
        for k, button in enumerate(self.buttons):
            button.visible = k < len(self.spots)
        for letter, button, spot in zip(LETTERS, self.buttons, self.spots, strict=False):
            button.label = f"{letter}  {spot.name}: {spot.unseen:.0%} unseen"
        self._folder.visible = True

    def _look_at(self, k: int, client: Any) -> None:
        if k < len(self.spots):
            at = np.array(self.spots[k].at)
            ground = self._scene.intersection.ground(at[None])
            look_at = np.append(at, ground) - self._scene.voxels.center
            client.camera.position, client.camera.look_at = look_at + AWAY, look_at


def plan_picture(
    scene: Scene, layout: Layout, scores: Scores, spots: tuple[BlindSpot, ...]
) -> Figure:
    """A plan view without a heading: how often each column is seen, sensors, and blind spots."""
    layer = seen_layer(scores.seen_share, scene)
    layout = scores.conditions.layout(layout)
    with house_style():
        fig = Figure(figsize=(SIDE, SIDE), facecolor="white")
        ax = fig.add_axes((0.0, 0.0, 1.0, 1.0))
        draw_plan(ax, scene, layout, layer, reach_of(scene, layout), None, side=SIDE)
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
        look: dict[str, Any] = dict(size=6.5, va="bottom", transform=ax.transAxes, zorder=10)
        for x, words, side in ((0.03, "never", "left"), (0.29, "always seen", "right")):
            ax.text(x, 0.06, words, ha=side, **look)
    return fig
