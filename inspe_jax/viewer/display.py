"""What browsers see: a layout in three dimensions, its voxels, and its scores beside them. Every
public method runs on the queue's thread."""

from collections.abc import Sequence
from typing import Any

from jaxtyping import UInt

from inspe_jax.core.compiling import compiled
from inspe_jax.core.words import visible
from inspe_jax.placement.feasibility import Fault
from inspe_jax.scoring.evaluate import Scores
from inspe_jax.sensing.layout import Layout
from inspe_jax.viewer.blind_spot_panel import BlindSpotPanel
from inspe_jax.viewer.browser_view import BrowserView
from inspe_jax.viewer.job_queue import DelayedAction
from inspe_jax.viewer.scene3d import Scene3D, look_from
from inspe_jax.viewer.score_panel import score_panel
from inspe_jax.viewer.workers import ScoredLayout

BACK = 1.25  # how far the camera is at first, in the usual distance
STALE = 0.5  # what is being done is said anew after this time [s]


class Display:
    """A layout as browsers see it. ``shown`` is the layout, ``opened`` that at the start,
    ``scored`` the newest scores: its own, or those of a layout before."""

    def __init__(self, viewer: Any) -> None:
        """Draw the scene. ``viewer`` has the server, the panel, and the views of browsers."""
        self.shown = self.opened = viewer.layout
        self.scored: ScoredLayout | None = None
        self._viewer, server, case = viewer, viewer.server, viewer.case
        self._faults: Sequence[Fault] = ()
        self._notes: Sequence[str] = ()
        self._reference: dict[int, Scores] = {}  # scores of the opened layout, by number of frames
        self._sight: tuple[int, UInt[Any, " V"]] | None = None
        self._drawn_frame = -1
        self._compiled = compiled().seconds  # when the newest scores came
        self._waiting = DelayedAction()
        server.gui.set_panel_label(f"{visible(self.opened.name)} at {visible(case.scene.name)}")
        self.scene3d = Scene3D(server.scene, case.scene)
        where, failed = viewer.panel.blind_spots, viewer.queue.failed
        self.blind_spots = BlindSpotPanel(server.gui, where, case.scene, failed)
        self.scene3d.draw_mounting()
        look_from(server.initial_camera, case.scene, back=BACK)

    def draw(self, layout: Layout, faults: Sequence[Fault] = (), notes: Sequence[str] = ()) -> None:
        """Show a layout, the rules of mounting that it breaks, and notes on the last change."""
        self.shown, self._faults, self._notes = layout, faults, notes
        broken = {s for fault in faults for s in fault.sensors}
        seen = self._viewer.case.conditions.layout(layout)
        for s, body in self.scene3d.draw_layout(seen, broken).items():
            self._bind(body, s)
        for view in list(self._viewer.views.values()):
            view.show_outlines()
            self._look(view)
        self.update_panel()
        self._wait()

    def show_selection(self, view: BrowserView) -> None:
        """Show a browser what its selected sensors see, and which they are."""
        view.show_outlines()
        self._look(view)
        view.show_table(self.shown, self.scored if self._current else None)

    def draw_users(self, frame: int) -> None:
        """Show the road users of a frame."""
        if frame != self._drawn_frame:
            self.scene3d.draw_users(frame)
            self._drawn_frame = frame
            for view in list(self._viewer.views.values()):
                self._look(view)

    def draw_voxels(self) -> None:
        """Show the kinds of voxels that are ticked, in the frame that is shown."""
        if self._sight is None:
            return
        frame, sight = self._sight
        with self._viewer.server.atomic():
            self.draw_users(frame)
            ticked = [kind for kind, box in self._viewer.panel.shown.items() if box.value]
            self.scene3d.draw_voxels(sight, ticked)

    def show_scores(self, scored: ScoredLayout) -> None:
        """Show new scores."""
        self.scored, self._compiled = scored, compiled().seconds
        if scored.scores is not None:
            if scored.frames == self._viewer.frames:
                self.blind_spots.show(scored.layout, scored.scores)
            if scored.layout is self.opened:
                self._reference[scored.frames] = scored.scores
        self.update_panel()

    def show_sight(self, frame: int, sight: UInt[Any, " V"]) -> None:
        """Show which voxels a layout sees in a frame; ``sight`` is a Visibility for each."""
        self._sight = frame, sight
        self.draw_voxels()

    def notify(self, title: str, words: str, color: Any) -> None:
        """Show every browser a message for a while, in its turn; of one title the newest."""

        def job() -> None:
            for client in self._viewer.server.get_clients().values():
                client.add_notification(title, words, color=color, auto_close_seconds=8.0)

        self._viewer.queue.submit(job, key=("message", title))

    def close(self) -> None:
        """Cancel the action that waits, and finish what is being drawn."""
        self._waiting.cancel()
        self.blind_spots.close()

    def _bind(self, body: Any, s: int) -> None:
        """Have a click on a sensor's body select it, and one with Shift or Ctrl toggle it."""
        for modifier in (None, "shift", "cmd/ctrl"):

            async def clicked(event: Any, toggle: bool = modifier is not None) -> None:
                view = self._viewer.views.get(event.client_id)
                if view is not None:
                    view.select(s, toggle)

            body.on_click(modifier=modifier)(clicked)

    @property
    def _current(self) -> bool:
        return self.scored is not None and self.scored.layout is self.shown

    def _look(self, view: BrowserView) -> None:
        view.look(self.shown, max(self._drawn_frame, 0))

    def _wait(self) -> None:
        """Until the shown layout has scores, say what is being done."""

        def job() -> None:
            if not self._current:
                self.update_panel()
                self._wait()

        self._waiting.start(STALE, lambda: self._viewer.queue.submit(job, key="waiting"))

    def update_panel(self) -> None:
        """Show what is known of the shown layout, and the target, in the panel."""
        scored, panel = self.scored, self._viewer.panel
        for view in list(self._viewer.views.values()):
            view.show_table(self.shown, scored if self._current else None)
        state, waiting = compiled(), "scoring …"
        if state.now:
            waiting = f"compiling: {state.seconds - self._compiled:.0f} s"
        page = score_panel(
            self.shown,
            scored,
            frames=self._viewer.frames,
            reference=None if scored is None else self._reference.get(scored.frames),
            faults=[fault.words for fault in self._faults],
            notes=self._notes,
            waiting=waiting,
            target=float(panel.target.value),
        )
        panel.headline.content, panel.scores.content, panel.notes.content = page
        panel.notes.visible = bool(page[2])
