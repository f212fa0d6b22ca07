"""The page: the session changes the layout, the scorer scores it, the display shows it. What
browsers ask for runs in turn on one thread, that of the job queue."""

import math
import time
import traceback
import warnings
from collections.abc import Callable
from contextlib import suppress
from html import escape
from pathlib import Path
from typing import Any

from inspe_jax.core.errors import InspeError
from inspe_jax.placement.objective import Objective
from inspe_jax.placement.problem import Case
from inspe_jax.report.page import report_entry, report_page, template
from inspe_jax.sensing.layout import Layout, layout_text
from inspe_jax.viewer.browser_view import BrowserView
from inspe_jax.viewer.display import BACK, Display
from inspe_jax.viewer.job_queue import JobQueue
from inspe_jax.viewer.page_views import VIEWS
from inspe_jax.viewer.panel import Panel, set_value
from inspe_jax.viewer.scene3d import look_from
from inspe_jax.viewer.server import HOST, new_token, quiet, serve
from inspe_jax.viewer.session import LayoutSession
from inspe_jax.viewer.store import LayoutStore
from inspe_jax.viewer.workers import Scorer, SearchEnding, Searcher

_FILE = '<div data-file style="padding:.2em 1em;font-size:.875em;overflow-wrap:anywhere">{}</div>'


class Viewer:
    """A layout on a scene, served to browsers on this machine. ``url`` is the page's address, on
    ``port``. ``views`` are what each browser has of its own, by the ids of its clients."""

    def __init__(
        self,
        case: Case,
        layout: Layout,
        path: Path,
        *,
        objective: Objective | None = None,
        token: str | None = None,
        port: int = 8080,
    ) -> None:
        """Serve the page at once. ``path`` is the layout's file, ``token`` the secret in ``url``,
        a new one if not given. If ``port`` is taken, the next free one is used."""
        self.case, self.objective = case, objective or Objective()
        self.store = LayoutStore(path, layout, case.scene)
        self.frames = case.scene.traffic.frame_count
        self.session = LayoutSession(case.scene, layout)
        self.views: dict[int, BrowserView] = {}
        self.searching = False
        self._began = 0.0  # when the search began
        self.queue = JobQueue(self._failed)
        self._reports = JobQueue(self._failed)  # a report takes seconds to draw
        token = token or new_token()
        title = f"{layout.name} at {case.scene.name} – inspe_jax"
        self.server = serve(port, token, template("viewer", "head.html.j2").render(title=title))
        self.port = self.server.get_port()
        self.url = f"http://{HOST}:{self.port}/{token}/"
        self.panel = Panel(self.server.gui, self, self.frames)
        self.display = Display(self)
        self.scene3d = self.display.scene3d
        shown = self.display.show_scores, self.display.show_sight
        later = self._in_turn(shown[0], "scores"), self._in_turn(shown[1], "sight")
        self.scorer = Scorer(case, self.objective, *later)
        self.searcher = Searcher(
            case,
            self.objective,
            self.session.constraints,
            progress=self._in_turn(self._on_progress, "progress"),
            found=self._in_turn(self._on_better, "better"),
            ended=self._in_turn(self._on_end),
        )
        self.panel.offer_earlier(self.store.earlier)
        self.queue.submit(lambda: self.display.draw_users(0))
        self.queue.submit(self.show)
        # viser warns of what is shown to a browser that is just leaving.
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection")
        self.server.on_client_disconnect(self._on_disconnect)
        self.server.on_client_connect(self._on_connect)

    @property
    def layout(self) -> Layout:
        """The layout as it is now."""
        return self.session.layout

    def close(self, *, wait: bool = True) -> None:
        """Apply what is typed, stop the search, finish a report that is being written, and stop.
        Without ``wait``, scores that are being computed are dropped."""
        self.settle()
        self.searcher.close()
        self.scorer.close(wait=wait)
        self.queue.close()
        with suppress(InspeError, OSError):  # the store has why
            self.store.keep(self.layout)
        self._reports.close()
        self.display.close()
        for view in list(self.views.values()):
            view.sensor_view.close(wait=True)
        with quiet():
            self.server.stop()

    # ── Browsers come and go ──

    async def _on_connect(self, client: Any) -> None:
        def job() -> None:
            if client.client_id in self.server.get_clients():
                self.open_view(client)
            if client.client_id not in self.server.get_clients():  # it has left meanwhile
                self._close_view(client)

        self.queue.submit(job)

    async def _on_disconnect(self, client: Any) -> None:
        self._close_view(client)

    def _close_view(self, client: Any) -> None:
        """Keep what a browser has typed and dragged."""
        if view := self.views.get(client.client_id):
            view.settle()
            self.views.pop(client.client_id, None)
            self.queue.submit(lambda: view.sensor_view.close(wait=False))

    def open_view(self, client: Any) -> BrowserView:
        """Show a browser a selection of its own; on the thread of the queue."""
        view = BrowserView(client, self)
        view.show()
        self.display.show_selection(view)
        self.views[client.client_id] = view
        return view

    def remove(self, client: Any) -> None:
        """Remove what a browser has selected."""
        if view := self.views.get(client.client_id):
            view.remove()

    # ── What any browser asks for ──

    def settle(self) -> None:
        """Apply the numbers that are typed, before another action."""
        for view in list(self.views.values()):
            view.settle()

    def undo_or_redo(self, which: str) -> None:
        """Undo the last change, or redo it; ``which`` is "Undo" or "Redo"."""

        def change() -> None:
            if not (self.session.undo() if which == "Undo" else self.session.redo()):
                self.display.notify(which, f"there is nothing more to {which.lower()}", None)

        self.change(change)

    def look_at_all(self, client: Any) -> None:
        """Point a browser's camera at the whole scene again."""
        look_from(client.camera, self.case.scene, back=BACK)

    def optimise(self) -> None:
        """Start a search from the present layout. It ends with the target, if there is one."""
        method, seconds = self.panel.method.value, float(self.panel.seconds.value)
        target = float(self.panel.target.value) or math.inf

        def job() -> None:
            if self.searching:
                return
            self.searching = True
            self.panel.searching(True)
            set_value(self.panel.bar, 0.0)
            self.panel.course.content = "starting; compiles first, for half a minute or so"
            self._began = time.monotonic()
            dropped = [view.drop_outdated() for view in list(self.views.values())]
            if any(dropped):
                self.show()  # and not what was being dragged
            else:
                self.show_controls()
            self.searcher.start(self.layout, method, seconds, target)

        self.queue.submit(job)

    # ── Files ──

    def save(self, path: Path | None = None) -> None:
        """Save the layout in this file from now on, or in its own; of an earlier run's file, ask
        before it is replaced."""

        def job() -> None:
            if path is None and self.store.would_replace(self.layout):
                self.panel.ask_replace(self.store.path, self.store.beside)
                return
            self.store.save(self.layout, path)
            self._keep(self.layout)
            self.display.notify("Saved", str(self.store.path), "green")

        self.unless_searching(job)

    def open_earlier(self, number: int) -> None:
        """Open a layout that an earlier run has left."""

        def change() -> None:
            earlier = self.store.earlier[number]
            self.session.take(self.store.open(earlier))
            self.panel.withdraw(number)
            self.display.notify("Opened", earlier.name, None)

        self.change(change)

    def download(self, client: Any) -> None:
        """Send a browser the layout, as it would be saved."""
        self.queue.submit(lambda: _send(client, self.store.path.name, layout_text(self.layout)))

    def write_report(self, client: Any) -> None:
        """Write a report beside the layout's file, and send it to the browser that asks for it:
        with before and after where the layout is not as opened, and the target if one is set."""

        def job() -> None:
            self.panel.report.disabled = True
            self.display.notify("Report", "It is being drawn …", None)
            layout, opened, frame = self.layout, self.display.opened, self.panel.shown_frame
            start = None if opened is layout else opened
            target = float(self.panel.target.value) or None

            def write() -> None:
                try:
                    entry = report_entry(
                        self.case, layout, self.objective, start=start, target=target
                    )
                    text = report_page(self.case.scene, [entry], frame=frame, views=VIEWS)
                    page = self.store.write_page(text)
                    self.display.notify("Report", f"It is in {page}", "green")
                    _send(client, page.name, text)
                finally:
                    self.queue.submit(allow)

            self._reports.submit(write, key="report")

        def allow() -> None:
            self.panel.report.disabled = self.searching

        self.unless_searching(job)

    # ── What the scorer and the search find; on the thread of the queue ──

    def _in_turn(self, show: Callable[..., Any], key: str | None = None) -> Callable[..., None]:
        """A callback for other threads, which has this done by the queue."""
        return lambda *found: self.queue.submit(lambda: show(*found), key=key)

    def _on_progress(self, done: float, best: float) -> None:
        if self.searching:
            left = (1 - done) * float(self.panel.seconds.value)
            set_value(self.panel.bar, 100.0 * done)
            self.panel.course.content = f"best {best:.4f}, {left:.0f} s left"

    def _on_better(self, layout: Layout, score: float) -> None:
        if self.searching:
            self.show_held(layout)
            self._keep(layout)

    def _on_end(self, ending: SearchEnding) -> None:
        self.searching = False
        self.panel.searching(False)
        if ending.layout is not None and (ending.gain > 0 or ending.failed):
            self.session.take(ending.layout, ending.notes)
        words = ending.words(time.monotonic() - self._began)
        words = f"failed: {words}" if ending.failed else words
        self.panel.course.content = f"{words[0].upper()}{words[1:]}"
        color = "red" if ending.failed else "green" if ending.gain > 0 else None
        self.display.notify("Search", words, color)
        self.changed()

    # ── What is shown; on the thread of the queue ──

    def unless_searching(self, job: Callable[[], Any]) -> None:
        """Submit an action, to be done unless a search runs: the page then shows its layout."""
        self.queue.submit(lambda: None if self.searching else job())

    def change(self, change: Callable[[], Any]) -> None:
        """Change the layout, unless a search runs; then show it, keep it and have it scored."""

        def job() -> None:
            before = self.layout
            try:
                change()
            finally:
                if self.layout is before:
                    self.queue.submit(self.show_controls, key="controls")
                else:
                    self.changed()

        self.unless_searching(job)

    def changed(self) -> None:
        """Have views follow the layout, and show it soon: once for many changes in a row."""
        for view in list(self.views.values()):
            view.follow()
        self.queue.submit(self.show, key="show")

    def show(self) -> None:
        """Keep the layout as it is now, show it, and have it scored."""
        try:
            self._keep(self.layout)
        finally:
            self.display.draw(self.layout, self.session.faults(), self.session.notes)
            self.show_controls()
            self.scorer.score(self.layout, whole=True)

    def show_held(self, layout: Layout) -> None:
        """Show a layout in which a sensor is being moved, and have some frames of it scored."""
        self.display.draw(layout)
        self.scorer.score(layout, whole=False)

    def show_controls(self) -> None:
        """Show the controls of every browser as they should be."""
        for view in list(self.views.values()):
            view.show()

    def _keep(self, layout: Layout) -> None:
        """Keep a layout that is not saved, and say which file has it."""
        try:
            self.store.keep(layout)
        finally:
            self.panel.file.content = _FILE.format(escape(self.store.words(layout)))

    def _failed(self, wrong: Exception) -> None:
        if not isinstance(wrong, InspeError | OSError):
            traceback.print_exception(wrong)
        self.display.notify("That failed", str(wrong) or repr(wrong), "red")


def _send(client: Any, name: str, text: str) -> None:
    client.send_file_download(name, text.encode(), save_immediately=True)
