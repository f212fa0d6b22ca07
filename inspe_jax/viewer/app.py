"""The page: the scene in three dimensions, handles on its sensors, scores that follow.

What changes is the session's, what is scored the scorer's, what is drawn the stage's. Browsers
share all of it, and what they ask for is done in turn on one thread, the desk's.
"""

import threading
import time
import traceback
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt

from inspe_jax.errors import InspeError
from inspe_jax.files import write_text
from inspe_jax.geometry import rotation
from inspe_jax.placement.constraints import Constraints
from inspe_jax.placement.problem import Case
from inspe_jax.placement.result import STATUSES, Result
from inspe_jax.report.page import entry_of, report_page
from inspe_jax.report.stage import Stage, look_from, quaternion, quiet, serve, turn_of
from inspe_jax.sensing.layout import Layout, save_layout
from inspe_jax.viewer.board import board
from inspe_jax.viewer.desk import Desk
from inspe_jax.viewer.panel import Panel, put
from inspe_jax.viewer.scorer import Scored, Scorer
from inspe_jax.viewer.searcher import Heard, Searcher
from inspe_jax.viewer.session import Session

HANDLE = 90.0
"""Length of the handle's arrows [pixel]."""
NARROW = 0.8
"""A window's width to its height, below which it is one of a telephone."""
PLAYED = 0.25
"""Between two frames that are played, at least [s]."""
UNSAVED = "unsaved"
"""Goes into the name of the file that keeps what is not saved yet."""


class Viewer:
    """A layout on a scene, served to browsers.

    ``layout`` is the one in hand, ``url`` and ``port`` where to look at it.
    """

    def __init__(
        self,
        case: Case,
        layout: Layout,
        path: Path,
        *,
        weights: tuple[float, float, float] = (0.3, 0.5, 0.2),
        host: str = "127.0.0.1",
        port: int = 8080,
    ) -> None:
        """Serve at once. ``path`` is where the layout is saved. Where the port is taken, the next.

        Raises InspeError where nothing can be served there.
        """
        self.case, self.path, self.weights = case, Path(path), weights
        self.frames = case.scene.traffic.frame_count
        self.session = Session(case.scene, layout, Constraints())
        self._saved: Layout | None = layout
        self._picked = 0
        self._grip: np.ndarray | None = None
        self._scored: Scored | None = None
        self._opened: dict[int, float] = {}  # by how many frames it is of
        self._first = layout
        self._sight: tuple[int, UInt[np.ndarray, " V"]] | None = None
        self._drawn_frame = -1
        self._began = 0.0
        self.desk = Desk(self._failed)
        self.server = serve(host, port)
        self.port = self.server.get_port()
        self.url = f"http://{'localhost' if host == '0.0.0.0' else host}:{self.port}"
        self.server.gui.configure_theme(
            show_logo=False, show_share_button=False, brand_color=(0, 114, 178)
        )
        self.server.gui.set_panel_label(f"{layout.name} at {case.scene.name}")
        self.stage = Stage(self.server.scene, case.scene)
        look_from(self.server.initial_camera, case.scene, back=1.25)
        self.server.on_client_connect(self._greet)
        self.server.gui.main_panel.dock_right()
        self.panel = Panel(self.server.gui, self, self.frames)
        self.panel.file.content = f"`{self.path}`"
        self.scorer = Scorer(case, weights, self._hear_scores, self._hear_sight)
        self.searcher = Searcher(
            case,
            weights,
            self.session.constraints,
            Heard(self._hear_progress, self._hear_better, self._hear_end),
        )
        self._handle = self._add_handle()
        self.desk.ask(lambda: self._draw_users(0))
        self.desk.ask(self._show)

    @property
    def layout(self) -> Layout:
        """The layout in hand."""
        return self.session.layout

    @property
    def unsaved(self) -> Path:
        """Where the layout is kept while it is not saved."""
        return self.path.with_name(f"{self.path.stem}.{UNSAVED}{self.path.suffix}")

    def _greet(self, client: Any) -> None:
        """On a narrow screen the controls lie over the lower part: look at the scene above them."""
        if client.camera.aspect < NARROW:
            radius = self.case.scene.voxels.radius
            client.camera.position = (0.0, -2.3 * radius, 2.2 * radius)
            client.camera.look_at = (0.0, -1.5 * radius, 0.0)

    def close(self) -> None:
        """End the search with its best, and stop serving."""
        self.searcher.close()
        self.scorer.close()
        self.desk.close()
        with quiet():
            self.server.stop()

    # ── What a browser asks for ──

    def select(self, s: int) -> None:
        """Take another sensor in hand."""

        def job() -> None:
            self._picked = min(s, len(self.layout) - 1)
            self._show_controls()

        self.desk.ask(job)

    def undo_or_redo(self, which: str) -> None:
        """Take the last change back, or do it again."""
        self._change({"Undo": self.session.undo, "Redo": self.session.redo}[which])

    def swap(self, name: str) -> None:
        """Another device for the sensor in hand."""
        self._change(lambda: self.session.swap(self._picked, name))

    def type_pose(self) -> None:
        """The sensor in hand goes where its numbers say."""
        values = {key: float(number.value) for key, number in self.panel.pose.items()}

        def job() -> None:
            s = self._picked
            pose = np.array(self.layout.poses[s], float)
            pose[2] += values["height"] - self.session.height(s)
            pose[:2] = values["x"], values["y"]
            pose[4], pose[5] = np.radians([values["pitch"], values["yaw"]])
            self.session.move(s, pose)

        self._change(job, key="pose")

    def copy_or_remove(self, which: str) -> None:
        """Another one like the sensor in hand; or one less."""

        def job() -> None:
            if which == "Duplicate":
                self._picked = self.session.duplicate(self._picked)
            else:
                self.session.remove(self._picked)
                self._picked = min(self._picked, len(self.layout) - 1)

        self._change(job)

    def add(self, name: str, client: Any) -> None:
        """A new sensor, as near as can be to what a browser's camera looks at."""
        at = np.array(client.camera.look_at, float)[:2] + self.stage.shift[:2]

        def job() -> None:
            self._picked = self.session.add(name, self._inside(at))

        self._change(job)

    def watch(self) -> None:
        """See the frame that the slider says."""
        frame = int(self.panel.frame.value)
        self.scorer.watch(min(frame, self.frames - 1))

    def show_voxels(self) -> None:
        """Show those kinds of voxels that are ticked."""
        self.desk.ask(self._draw_sight, key="sight")

    def optimise(self) -> None:
        """Search from here."""
        method, seconds = self.panel.method.value, float(self.panel.seconds.value)

        def job() -> None:
            if self.searcher.running:
                return
            self._began = time.monotonic()
            self.panel.searching(True)
            put(self.panel.bar, 0.0)
            self.panel.course.content = "compiling …"
            self._show_handle()
            self.searcher.start(self.layout, method, seconds)

        self.desk.ask(job)

    def stop(self) -> None:
        """End the search."""
        self.panel.course.content = "stopping …"
        self.searcher.stop()

    def save(self) -> None:
        """Write the layout's file."""

        def job() -> None:
            save_layout(self.layout, self.path)
            self._saved = self.layout
            self.unsaved.unlink(missing_ok=True)
            self._tell("Saved", str(self.path), "green")
            self._show_file()

        self.desk.ask(job)

    def write_report(self) -> None:
        """Write a page on the layout beside its file."""
        layout, scene = self.layout, self.case.scene
        frame, path = min(int(self.panel.frame.value), self.frames - 1), self.path

        def work() -> None:
            try:
                entry = entry_of(self.case, layout, self.weights)
                page = path.with_suffix(".html")
                write_text(page, report_page(scene, [entry], frame=frame))
                self._tell("Report", f"wrote {page}", "green")
            except Exception as e:
                self._failed(e)

        self._tell("Report", "drawing …", None)
        threading.Thread(target=work, name="report", daemon=True).start()

    # ── The handle ──

    def _add_handle(self) -> Any:
        """A gizmo on the sensor in hand: arrows ahead, to its left and up, planes, and rings."""
        handle = self.server.scene.add_transform_controls(
            "handle", scale=HANDLE, fixed=True, line_width=3.5, depth_test=False
        )  # fmt: skip

        @handle.on_update
        async def _(event: Any) -> None:
            if event.client is None:
                return
            at, turn = np.array(handle.position), turn_of(handle.wxyz)
            key = "drag" if event.phase == "update" else None
            self.desk.ask(lambda: self._pull(event.phase, at, turn), key=key)

        return handle

    def _pull(self, phase: str, at: np.ndarray, turn: np.ndarray) -> None:
        """The handle is at ``at``, turned by ``turn``: the sensor in hand follows.

        Meanwhile where it would be is drawn and scored; at the end it is there.
        """
        if self.searcher.running:
            return
        before = np.asarray(self.layout.poses[self._picked], float)
        if phase == "start" or self._grip is None:
            self._grip = _upright(before)
        ahead = turn @ self._grip.T @ rotation(before[3:], np)[:, 0]
        pose = before.copy()
        pose[:3] = at + self.stage.shift
        pose[:2] = self._inside(pose[:2])
        pose[4] = np.arcsin(np.clip(ahead[2], -1, 1))
        pose[5] = np.arctan2(ahead[1], ahead[0])
        where = self.session.moved(self._picked, pose)
        if phase == "end":
            self._grip = None
            self.session.take(where)
            self._after_change()
        elif phase == "update":
            self._draw(where)
            self.scorer.score(where, whole=False)

    def _inside(self, at: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
        """The nearest point within the region of interest."""
        center, radius = self.case.scene.voxels.center[:2], self.case.scene.voxels.radius
        away = at - center
        return center + away * min(1.0, radius / max(float(np.hypot(*away)), 1e-9))

    # ── What the scorer and the search tell, from their threads ──

    def _hear_scores(self, scored: Scored) -> None:
        def job() -> None:
            self._scored = scored
            if scored.layout is self._first and scored.scores is not None:
                self._opened[scored.frames] = scored.scores.surrogate
            self._show_board()

        self.desk.ask(job, key="scores")

    def _hear_sight(self, frame: int, sight: UInt[np.ndarray, " V"]) -> None:
        def job() -> None:
            self._sight = frame, sight
            self._draw_sight()
            if self.panel.play.value:
                timer = threading.Timer(PLAYED, self._next)
                timer.daemon = True
                timer.start()

        self.desk.ask(job, key="sight")

    def _next(self) -> None:
        if self.panel.play.value:
            put(self.panel.frame, (int(self.panel.frame.value) + 1) % self.frames)
            self.watch()

    def _hear_progress(self, done: float, best: float) -> None:
        spent = time.monotonic() - self._began
        left = f", {spent * (1 - done) / done:.0f} s left" if done > 0.02 else ""

        def job() -> None:
            put(self.panel.bar, 100.0 * done)
            self.panel.course.content = f"best {best:.4f}{left}"

        self.desk.ask(job, key="progress")

    def _hear_better(self, layout: Layout, score: float) -> None:
        save_layout(layout, self.unsaved)  # whatever becomes of the page

        def job() -> None:
            self._draw(layout)
            self.scorer.score(layout, whole=False)

        self.desk.ask(job, key="better")

    def _hear_end(self, result: Result | None, wrong: str) -> None:
        def job() -> None:
            self.panel.searching(False)
            if result is None:
                self._tell("Search", wrong, "red")
            else:
                self.session.take(result.layout)
                self.session.notes = result.notes
                gain = result.objective - result.objective_before
                words = f"{gain:+.4f}: {STATUSES[result.status]}"
                self._tell("Search", words, "green" if gain > 0 else None)
            self._after_change()

        self.desk.ask(job)

    # ── What is shown; on the desk's thread ──

    def _change(self, change: Any, key: str | None = None) -> None:
        def job() -> None:
            if self.searcher.running:
                return
            change()
            self._after_change()

        self.desk.ask(job, key=key)

    def _after_change(self) -> None:
        if self.layout is not self._saved:
            save_layout(self.layout, self.unsaved)
        self._show()

    def _show(self) -> None:
        self._picked = min(self._picked, len(self.layout) - 1)
        self._faults = self.session.faults()
        self._draw(self.layout)
        self._show_controls()
        self._show_board()
        self._show_file()
        self.scorer.score(self.layout, whole=True)

    def _draw(self, layout: Layout) -> None:
        broken = {s for fault in self._faults for s in fault.sensors}
        shown = self.case.conditions.layout(layout)
        for s, body in self.stage.draw_layout(shown, broken).items():
            self._bind_body(s, body)

    def _bind_body(self, s: int, body: Any) -> None:
        @body.on_click
        async def _(_: Any) -> None:
            self.select(s)

    def _show_controls(self) -> None:
        s, layout = self._picked, self.layout
        sensor, pose = layout.sensors[s], np.asarray(layout.poses[s], float)
        self.panel.list_sensors([sensor.name for sensor in layout.sensors], s)
        self.panel.offer_device(sensor.spec.name)
        pitch, yaw = np.degrees(pose[4:6])
        numbers = dict(x=pose[0], y=pose[1], height=self.session.height(s), yaw=yaw, pitch=pitch)
        for key, value in numbers.items():
            put(self.panel.pose[key], round(float(value), 2))
        self._show_handle()

    def _show_handle(self) -> None:
        pose = np.asarray(self.layout.poses[self._picked], float)
        self._handle.position = pose[:3] - self.stage.shift
        self._handle.wxyz = quaternion(_upright(pose))
        self._handle.visible = not self.searcher.running

    def _show_board(self) -> None:
        scored = self._scored
        self.panel.board.content = board(
            self.layout if scored is None else scored.layout,
            scored,
            frames=self.frames,
            opened=None if scored is None else self._opened.get(scored.frames),
            faults=[fault.words for fault in self._faults],
            notes=self.session.notes,
        )

    def _show_file(self) -> None:
        kept = "" if self.layout is self._saved else f", not saved yet; kept in `{self.unsaved}`"
        self.panel.file.content = f"`{self.path}`{kept}"

    def _draw_users(self, frame: int) -> None:
        if frame != self._drawn_frame:
            self.stage.draw_users(frame)
            self._drawn_frame = frame

    def _draw_sight(self) -> None:
        if self._sight is None:
            return
        frame, sight = self._sight
        with self.server.atomic():
            self._draw_users(frame)
            boxes = self.panel.shown.items()
            self.stage.draw_voxels(sight, [kind for kind, box in boxes if box.value])

    def _tell(self, title: str, words: str, color: Any) -> None:
        for client in self.server.get_clients().values():
            client.add_notification(title, words, color=color, auto_close_seconds=8.0)

    def _failed(self, wrong: Exception) -> None:
        if not isinstance(wrong, InspeError | OSError):
            traceback.print_exception(wrong)
        self._tell("That did not work", str(wrong) or repr(wrong), "red")


def _upright(pose: Float[np.ndarray, "6"]) -> Float[np.ndarray, "3 3"]:
    """Turned by a pose's yaw alone: arrows ahead, to the left and up."""
    return rotation(np.array([0.0, 0.0, pose[5]]), np)
