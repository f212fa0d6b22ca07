"""The page: the scene in three dimensions, a handle on its sensors, scores that follow.

What changes is the session's, what is scored the scorer's, what is shown the display's. Browsers
share all of it, and what they ask for is done in turn on one thread, the desk's.
"""

import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt

from inspe_jax.core.compiling import usual_seconds, waiting_words
from inspe_jax.core.errors import InspeError
from inspe_jax.placement.problem import Case
from inspe_jax.report.server import Door, quiet, serve
from inspe_jax.scoring.metrics import Weights
from inspe_jax.sensing.layout import Layout
from inspe_jax.viewer.display import Display
from inspe_jax.viewer.handle import Handle, Pull
from inspe_jax.viewer.job_queue import JobQueue, Later
from inspe_jax.viewer.panel import POSE, Panel, put
from inspe_jax.viewer.scorer import Scored, Scorer
from inspe_jax.viewer.searcher import Ending, Heard, Searcher
from inspe_jax.viewer.session import Session
from inspe_jax.viewer.store import Earlier, Store

NARROW = 0.8
"""A window's width to its height, below which it is one of a telephone."""
PLAYED = 0.25
"""Between two frames that are played, at least [s]."""
TYPED = 0.7
"""A number that is typed counts when nothing was typed for so long, or something else is done
[s]."""
SEARCH_COMPILES = 40.0
"""How long compiling a search takes, roughly [s]."""


class Viewer:
    """A layout on a scene, served to browsers.

    ``layout`` is the one in hand, ``url`` and ``port`` where to look at it, ``other_urls`` where
    other machines may.
    """

    def __init__(
        self,
        case: Case,
        layout: Layout,
        path: Path,
        *,
        weights: Weights = None,
        door: Door | None = None,
        port: int = 8080,
    ) -> None:
        """Serve at once. ``path`` is where the layout is saved. Where the port is taken, the next.

        ``door`` says where to listen and who is let in: this machine, and who has the token, if
        not given. Raises InspeError where nothing can be served there.
        """
        self.case, self.weights = case, weights
        self.store = Store(path, layout, case.scene)
        self.frames = case.scene.traffic.frame_count
        self.session = Session(case.scene, layout)
        self._picked = 0
        self._grip: tuple[int, Layout, bool] | None = None  # which, of what, whether it was pulled
        self._searching, self._best = False, layout
        self.desk = JobQueue(self._failed)
        self._typing, self._playing = {key: Later() for key in POSE}, Later()
        self.door = Door("127.0.0.1") if door is None else door
        self.server = serve(self.door, port)
        self.port = self.server.get_port()
        self.url, *self.other_urls = self.door.urls(self.port)
        self.server.gui.configure_theme(
            show_logo=False, show_share_button=False, brand_color=(0, 114, 178)
        )
        self.server.gui.set_panel_label(f"{layout.name} at {case.scene.name}")
        self.server.on_client_connect(self._greet)
        self.server.gui.main_panel.dock_right()
        self.panel = Panel(self.server.gui, self, self.frames)
        self.display = Display(self.server, case, layout, self.panel, self.desk, self._click)
        self.stage = self.display.stage
        self.scorer = Scorer(case, weights, self._hear_scores, self._hear_sight)
        self.searcher = Searcher(
            case,
            weights,
            self.session.constraints,
            Heard(self._hear_progress, self._hear_better, self._hear_compiling, self._hear_end),
        )
        self.handle = Handle(self.server.scene, self._hear_pull)
        self.panel.offer_earlier(self.store.earlier)
        self.desk.ask(lambda: self.display.draw_users(0))
        self.desk.ask(self._show)

    @property
    def layout(self) -> Layout:
        """The layout in hand."""
        return self.session.layout

    @property
    def _frame(self) -> int:
        """That the slider says; of one frame alone it has two places."""
        return min(max(int(self.panel.frame.value), 0), self.frames - 1)

    def _greet(self, client: Any) -> None:
        """On a narrow screen the controls lie over the lower part: look at the scene above them."""
        if client.camera.aspect < NARROW:
            radius = self.case.scene.voxels.radius
            client.camera.position = (0.0, -2.3 * radius, 2.2 * radius)
            client.camera.look_at = (0.0, -1.5 * radius, 0.0)

    def close(self) -> None:
        """Count what is typed, end the search with its best, finish a report, and stop serving."""
        self.settle()
        self._playing.cancel()
        self.searcher.close()
        self.scorer.close()
        self.store.close()
        self.display.close()
        self.desk.close()
        with quiet():
            self.server.stop()

    # ── What a browser asks for: each says of which sensor ──

    def settle(self) -> None:
        """Let the numbers count that are typed, before anything else is done."""
        for waiting in self._typing.values():
            waiting.now()

    def restore(self) -> None:
        """Show the controls as they are: a browser set one to what it cannot be."""
        self.desk.ask(self._show_controls)

    def select(self, s: int) -> None:
        """Take another sensor in hand."""

        def job() -> None:
            self._picked = min(s, len(self.layout) - 1)
            self._show_controls()

        self.desk.ask(job)

    def _click(self, s: int) -> None:
        self.settle()
        self.select(s)

    def undo_or_redo(self, which: str) -> None:
        """Take the last change back, or do it again."""

        def job() -> None:
            if not {"Undo": self.session.undo, "Redo": self.session.redo}[which]():
                self._tell(which, "there is nothing more", None)

        self._change(job)

    def swap(self, s: int, name: str) -> None:
        """Another device for a sensor."""
        self._change(lambda: self.session.swap(s, name))

    def type_number(self, s: int, key: str, value: float) -> None:
        """A number of a sensor's pose, once nothing more is typed."""

        def job() -> None:
            if not np.isfinite(value):
                raise InspeError(f"{key}: {value} is no number")
            pose = np.array(self.layout.poses[s], float)
            if key == "height":
                pose[2] += value - self.session.height(s)
            elif key in ("x", "y"):
                pose["xy".index(key)] = value
                pose[:2] = self._inside(pose[:2])
            else:
                pose[{"pitch": 4, "yaw": 5}[key]] = np.radians(value)
            self.session.move(s, pose)

        self._typing[key].do(TYPED, lambda: self._change(job))

    def duplicate(self, s: int) -> None:
        """Another one like a sensor."""

        def job() -> None:
            self._picked = self.session.duplicate(s)

        self._change(job)

    def remove(self, s: int) -> None:
        """One sensor less."""
        self._change(lambda: self.session.remove(s))

    def add(self, name: str, client: Any) -> None:
        """A new sensor, as near as can be to what a browser's camera looks at."""
        at = np.array(client.camera.look_at, float)[:2] + self.stage.shift[:2]

        def job() -> None:
            self._picked = self.session.add(name, self._inside(at))

        self._change(job)

    def watch(self) -> None:
        """See the frame that the slider says."""
        self.scorer.watch(self._frame)

    def show_voxels(self) -> None:
        """Show those kinds of voxels that are ticked."""
        self.desk.ask(self.display.draw_voxels, key="ticks")

    def optimise(self) -> None:
        """Search from here."""
        method, seconds = self.panel.method.value, float(self.panel.seconds.value)

        def job() -> None:
            if self._searching:
                return
            self._searching, self._best = True, self.layout
            self.panel.searching(True)
            put(self.panel.bar, 0.0)
            self.panel.course.content = "starting …"
            self._show_handle()
            self.searcher.start(self.layout, method, seconds)

        self.desk.ask(job)

    def stop(self) -> None:
        """End the search, with its best so far."""
        self.desk.ask(self.searcher.stop)

    def save(self) -> None:
        """Write the layout's file; ask first where that would replace an earlier run's."""

        def job() -> None:
            if self.store.would_replace(self.layout):
                self.panel.ask_replace(self.store.path.name, self.store.beside.name)
            else:
                self._save(None)

        self._alone(job)

    def replace(self) -> None:
        """Write the layout's file in place of what is there."""
        self._alone(lambda: self._save(None))

    def save_beside(self) -> None:
        """Write the layout to a file of a new name, and from now on to that one."""
        self._alone(lambda: self._save(self.store.beside))

    def _save(self, path: Path | None) -> None:
        self.store.save(self.layout, path)
        self._show_file()
        self._tell("Saved", str(self.store.path), "green")

    def open_earlier(self, number: int) -> None:
        """Go on from a layout that an earlier run has left."""

        def change() -> None:
            earlier: Earlier = self.store.earlier[number]
            self.session.take(self.store.open(earlier))
            self.panel.withdraw(number)
            self._tell("Opened", earlier.path.name, None)

        self._change(change)

    def write_report(self) -> None:
        """Write a page on the layout beside its file; one at a time."""

        def ended(page: Path, wrong: Exception | None) -> None:
            self.panel.report.disabled = self._searching
            if wrong is None:
                self._tell("Report", f"wrote {page}", "green")
            else:
                self._failed(wrong)

        def job() -> None:
            if self.store.report(self.case, self.layout, self.weights, self._frame, ended):
                self.panel.report.disabled = True
                self._tell("Report", "drawing …", None)

        self._alone(job)

    # ── The handle ──

    def _hear_pull(self, pull: Pull) -> None:
        if pull.phase == "start":
            self.settle()
        key = "pull" if pull.phase == "update" else None
        self.desk.ask(lambda: self._pull(pull), key=key)

    def _pull(self, pull: Pull) -> None:
        """The sensor that the handle was on when it was gripped follows it.

        Meanwhile where it would be is drawn and scored; at the end it is there.
        """
        if pull.phase == "start":
            self._grip = self._picked, self.layout, False
        if self._grip is None or self._searching:
            return
        s, of, pulled = self._grip
        if of is not self.layout:  # somebody else changed it meanwhile
            self._grip = None
            self._show()
            return
        if pull.phase == "update":
            self._grip = s, of, True
            where, _ = self.session.moved(s, self._pulled(s, pull))
            self.display.draw(where)
            self.scorer.score(where, whole=False)
        elif pull.phase == "end":
            self._grip = None
            if pulled:  # and not only clicked
                self.session.move(s, self._pulled(s, pull))
                self._after_change()

    def _pulled(self, s: int, pull: Pull) -> Float[np.ndarray, "6"]:
        pose = pull.on(np.array(self.layout.poses[s], float), self.stage.shift)
        pose[:2] = self._inside(pose[:2])
        return pose

    def _inside(self, at: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
        """The nearest point within the region of interest."""
        center, radius = self.case.scene.voxels.center[:2], self.case.scene.voxels.radius
        away = at - center
        return center + away * min(1.0, radius / max(float(np.hypot(*away)), 1e-9))

    # ── What the scorer and the search tell, from their threads ──

    def _hear_scores(self, scored: Scored) -> None:
        self.desk.ask(lambda: self.display.hear_scores(scored), key="scores")

    def _hear_sight(self, layout: Layout, frame: int, sight: UInt[np.ndarray, " V"]) -> None:
        def job() -> None:
            self.display.hear_sight(layout, frame, sight)
            if self.panel.play.value:
                self._playing.do(PLAYED, self._next)

        self.desk.ask(job, key="sight")

    def _next(self) -> None:
        if self.panel.play.value:
            put(self.panel.frame, (int(self.panel.frame.value) + 1) % self.frames)
            self.watch()

    def _hear_progress(self, done: float, best: float) -> None:
        def job() -> None:
            if not self._searching:
                return
            left = (1 - done) * float(self.panel.seconds.value)
            put(self.panel.bar, 100.0 * done)
            self.panel.course.content = f"best {best:.4f}, {left:.0f} s left"

        self.desk.ask(job, key="progress")

    def _hear_compiling(self, seconds: float) -> None:
        def job() -> None:
            if self._searching:
                what = f"search by {self.panel.method.value}"
                words = waiting_words(seconds, usual_seconds(what, SEARCH_COMPILES))
                self.panel.course.content = f"{words}; the search's time stands still"

        self.desk.ask(job, key="progress")

    def _hear_better(self, layout: Layout, score: float) -> None:
        def job() -> None:
            if not self._searching:
                return
            self._best = layout
            self.display.draw(layout)
            self.scorer.score(layout, whole=False)
            self.store.keep(layout)  # whatever becomes of the page

        self.desk.ask(job, key="better")

    def _hear_end(self, ending: Ending) -> None:
        def job() -> None:
            self._searching = False
            self.panel.searching(False)
            if ending.layout is None:
                self._tell("Search", ending.words, "red" if ending.failed else None)
            else:
                self.session.take(ending.layout, ending.notes)
                color = "red" if ending.failed else "green" if ending.gain > 0 else None
                self._tell("Search", f"{ending.gain:+.4f}: {ending.words}", color)
            self._after_change()

        self.desk.ask(job)

    # ── What is shown; on the desk's thread ──

    def _alone(self, job: Callable[[], None]) -> None:
        """Do it, unless a search is under way: then the layout in hand is not the one shown."""
        self.desk.ask(lambda: None if self._searching else job())

    def _change(self, change: Callable[[], Any]) -> None:
        def job() -> None:
            try:
                change()
            except Exception:
                self._show_controls()  # as they were
                raise
            self._after_change()

        self._alone(job)

    def _after_change(self) -> None:
        try:
            self.store.keep(self.layout)
        finally:
            self._show()

    def _show(self) -> None:
        self._picked = min(self._picked, len(self.layout) - 1)
        self.display.draw(self.layout, self.session.faults(), self.session.notes)
        self._show_controls()
        self._show_file()
        self.scorer.score(self.layout, whole=True)

    def _show_controls(self) -> None:
        s, layout = self._picked, self.layout
        sensor, pose = layout.sensors[s], np.asarray(layout.poses[s], float)
        pitch, yaw = np.degrees(pose[4:6])
        numbers = dict(x=pose[0], y=pose[1], height=self.session.height(s), yaw=yaw, pitch=pitch)

        def show() -> None:
            self.panel.list_sensors([sensor.name for sensor in layout.sensors], s)
            self.panel.offer_device(sensor.spec.name)
            for key, value in numbers.items():
                put(self.panel.pose[key], round(float(value), 1))

        # Where browsers are heard: not between a number that is typed and who reads it.
        self.server.get_event_loop().call_soon_threadsafe(show)
        self._show_handle()

    def _show_handle(self) -> None:
        pose = np.asarray(self.layout.poses[self._picked], float)
        self.handle.show(pose, self.stage.shift, visible=not self._searching)

    def _show_file(self) -> None:
        self.panel.file.content = self.store.words(self.layout)

    def _tell(self, title: str, words: str, color: Any) -> None:
        for client in self.server.get_clients().values():
            client.add_notification(title, words, color=color, auto_close_seconds=8.0)

    def _failed(self, wrong: Exception) -> None:
        if not isinstance(wrong, InspeError | OSError):
            traceback.print_exception(wrong)
        self._tell("That did not work", str(wrong) or repr(wrong), "red")
