"""What browsers see: a layout in three dimensions, its voxels, and its scores beside them.

Scores and voxels come later than the layout that they are of; until then the last ones fade, and
the page says what takes so long. All is called on the desk's thread.
"""

from collections.abc import Callable, Sequence
from typing import Any

import viser
from jaxtyping import UInt

from inspe_jax.core.compiling import compiled, remember_seconds, usual_seconds, waiting_words
from inspe_jax.placement.feasibility import Fault
from inspe_jax.placement.problem import Case
from inspe_jax.report.scene3d import Stage, look_from
from inspe_jax.sensing.layout import Layout
from inspe_jax.viewer.job_queue import JobQueue, Later
from inspe_jax.viewer.panel import Panel
from inspe_jax.viewer.score_panel import score_panel
from inspe_jax.viewer.scorer import Scored

STALE = 0.5
"""Scores and voxels of another layout than the one shown fade after so long [s]."""
SCORES, SCORES_COMPILE = "scores", 10.0
"""What compiling them is called where it is remembered, and how long it takes, roughly [s]."""


class Display:
    """A layout as browsers see it.

    ``shown`` is the layout, ``scored`` the last scores there are, of it or of one before.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        case: Case,
        opened: Layout,
        panel: Panel,
        desk: JobQueue,
        clicked: Callable[[int], None],
    ) -> None:
        """Draw the scene. ``clicked`` is called with a sensor that somebody clicks on."""
        self.shown = opened
        self.scored: Scored | None = None
        self._server, self._case, self._opened = server, case, opened
        self._panel, self._desk, self._clicked = panel, desk, clicked
        self._frames = case.scene.traffic.frame_count
        self._faults: Sequence[Fault] = ()
        self._notes: Sequence[str] = ()
        self._first: dict[int, float] = {}  # scores of the opened layout, by frames
        self._sight: tuple[int, UInt[Any, " V"]] | None = None
        self._drawn_frame, self._faded = -1, False
        self._compiled = compiled().seconds  # when there were scores last
        self._waiting = Later()
        self.stage = Stage(server.scene, case.scene)
        self.stage.draw_mounting()
        look_from(server.initial_camera, case.scene, back=1.25)

    def draw(self, layout: Layout, faults: Sequence[Fault] = (), notes: Sequence[str] = ()) -> None:
        """Show a layout, what keeps it from being mounted, and what mounting made of it."""
        self.shown, self._faults, self._notes = layout, faults, notes
        broken = {s for fault in faults for s in fault.sensors}
        seen = self._case.conditions.layout(layout)
        for s, body in self.stage.draw_layout(seen, broken).items():
            self._bind(s, body)
        self._show_board()
        self._wait()

    def draw_users(self, frame: int) -> None:
        """Show the road users of a frame."""
        if frame != self._drawn_frame:
            self.stage.draw_users(frame)
            self._drawn_frame = frame

    def draw_voxels(self) -> None:
        """Show the kinds of voxels that are ticked, as they are in the frame that is shown."""
        if self._sight is None:
            return
        frame, sight = self._sight
        with self._server.atomic():
            self.draw_users(frame)
            ticked = [kind for kind, box in self._panel.shown.items() if box.value]
            self.stage.draw_voxels(sight, ticked, faint=self._faded)

    def hear_scores(self, scored: Scored) -> None:
        """Show scores."""
        self.scored, before = scored, self._compiled
        self._compiled = compiled().seconds
        remember_seconds(SCORES, self._compiled - before)
        if scored.layout is self._opened and scored.scores is not None:
            self._first[scored.frames] = scored.scores.surrogate
        self._show_board()

    def hear_sight(self, layout: Layout, frame: int, sight: UInt[Any, " V"]) -> None:
        """Show what each voxel is to a layout in a frame."""
        self._sight, self._faded = (frame, sight), self._faded and layout is not self.shown
        self.draw_voxels()

    def close(self) -> None:
        """Wait for nothing more."""
        self._waiting.cancel()

    def _bind(self, s: int, body: Any) -> None:
        @body.on_click
        async def _(_: Any) -> None:
            self._clicked(s)

    def _wait(self) -> None:
        """Fade what is of another layout, and say what takes so long, until it is there."""

        def job() -> None:
            if self.scored is None or self.scored.layout is not self.shown:
                if not self._faded:
                    self._faded = True
                    self.draw_voxels()
                self._show_board()
                self._wait()

        self._waiting.do(STALE, lambda: self._desk.ask(job, key="waiting"))

    def _show_board(self) -> None:
        scored = self.scored
        self._panel.board.content = score_panel(
            self.shown,
            scored,
            frames=self._frames,
            opened=None if scored is None else self._first.get(scored.frames),
            faults=[fault.words for fault in self._faults],
            notes=self._notes,
            waiting=self._waiting_words(),
            faded=self._faded,
        )

    def _waiting_words(self) -> str:
        """What is done while there are no scores yet."""
        state = compiled()
        if not state.now:
            return "scoring …"
        return waiting_words(state.seconds - self._compiled, usual_seconds(SCORES, SCORES_COMPILE))
