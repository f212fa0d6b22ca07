"""The plan view on the page, and the worst blind spots beside it: a click on one looks at it.

Both are means over all frames. They are drawn on a thread of their own, so that a sensor can be
dragged meanwhile.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import viser

from inspe_jax.core.sheet import png_text
from inspe_jax.report.plan_picture import DOTS, LETTERS, plan_picture
from inspe_jax.scene.scene import Scene
from inspe_jax.scoring.blind_spots import BlindSpot, blind_spots
from inspe_jax.scoring.evaluate import Scores
from inspe_jax.sensing.layout import Layout
from inspe_jax.viewer.bindings import bind
from inspe_jax.viewer.job_queue import JobQueue
from inspe_jax.viewer.panel import BLIND_SPOTS, SLATE

_IMAGE = (
    '<img style="width:100%" alt="Plan view: how often each place is seen, mean over all frames" '
    'src="data:image/png;base64,{}"><div style="padding:.2em 1em;font-size:.875em;color:#5c5c61">'
    "Most is missed at A, by area, weight, and share of time and height unseen. The letters are "
    "given anew after every change:</div>"
)
AWAY = np.array([0.0, -22.0, 20.0])
"""From a blind spot to the camera that looks at it [m]."""


class BlindSpotPanel:
    """A folder of the page with the plan view of the newest scores and their blind spots.

    ``spots`` are those that are listed, the worst first.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        folder: Any,
        scene: Scene,
        failed: Callable[[Exception], None],
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

    def outdated(self) -> None:
        """Say that what is shown is of a layout before."""
        self._drawing.submit(lambda: self._title(", before the last change"), key="title")

    def close(self) -> None:
        """Finish what is being drawn."""
        self._drawing.close()

    def _show(self, layout: Layout, scores: Scores) -> None:
        self.spots = blind_spots(self._scene, scores.seen_share)[: len(LETTERS)]
        figure = plan_picture(self._scene, layout, scores, self.spots)
        self.picture.content = _IMAGE.format(png_text(figure, DOTS))
        for k, button in enumerate(self.buttons):
            button.visible = k < len(self.spots)
            if button.visible:
                spot = self.spots[k]
                button.label = f"{LETTERS[k]}  {spot.name}: {spot.unseen:.0%} unseen"
        self._title("")
        self._folder.visible = True

    def _title(self, when: str) -> None:
        self._folder.label = BLIND_SPOTS + when

    def _look_at(self, k: int, client: Any) -> None:
        if k < len(self.spots):
            at = np.array(self.spots[k].at)
            ground = self._scene.intersection.ground(at[None])
            look_at = np.append(at, ground) - self._scene.voxels.center
            client.camera.position, client.camera.look_at = look_at + AWAY, look_at
