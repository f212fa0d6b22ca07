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

import numpy as np
from jaxtyping import UInt

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
from inspe_jax.viewer.scorer import ScoredLayout, Scorer
from inspe_jax.viewer.searcher import SearchEnding, Searcher
from inspe_jax.viewer.server import HOST, new_token, quiet, serve
from inspe_jax.viewer.session import LayoutSession
from inspe_jax.viewer.store import LayoutStore

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
        """Serve the page at once.

        ``path`` is the layout's file. Of the ``objective``, weights, metrics and curves count.
        ``token`` is the secret that ``url`` contains, a new one if not given: only who has it can
        open the page. If ``port`` is taken, the next free one is used.
        """
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
        self.scorer = Scorer(case, self.objective, self._on_scores, self._on_sight)
        self.searcher = Searcher(
            case,
            self.objective,
            self.session.constraints,
            progress=self._on_progress,
            found=self._on_better,
            ended=self._on_end,
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

        Without ``wait``, scores that are being computed are dropped: compiling may take a minute,
        and cannot be interrupted.
        """
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
        view = self.views.get(client.client_id)
        if view is not None:
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
        view = self.views.get(client.client_id)
        if view is not None:
            view.remove()

    # ── What any browser asks for ──

    def settle(self) -> None:
        """Apply the numbers that are typed, before another action."""
        for view in list(self.views.values()):
            view.settle()

    def restore(self) -> None:
        """Show the controls as they were: a browser has asked in vain."""
        self.queue.submit(self._show_controls, key="controls")

    def undo_or_redo(self, which: str) -> None:
        """Undo the last change, or redo it; ``which`` is "Undo" or "Redo"."""

        def change() -> None:
            if not (self.session.undo() if which == "Undo" else self.session.redo()):
                self.display.notify(which, f"there is nothing more to {which.lower()}", None)

        self.change(change)

    def select_frame(self) -> None:
        """Show the slider's frame."""
        self.scorer.select_frame(self.panel.shown_frame)

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
                self._show_controls()
            self.searcher.start(self.layout, method, seconds, target)

        self.queue.submit(job)

    def stop(self) -> None:
        """Stop the search with its best layout so far."""
        self.queue.submit(self.searcher.stop)

    # ── Files ──

    def save(self, path: Path | None = None) -> None:
        """Save the layout in this file, which may be there, and in no other from now on; without
        one in its own, but ask first if that would replace a file of an earlier run."""

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
        """Write a report beside the layout's file, and send it to the browser that asks for it.

        It has before and after where the layout is not as opened, and the target if one is set.
        """

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

    # ── Callbacks of the scorer and the search, from their threads ──

    def _on_scores(self, scored: ScoredLayout) -> None:
        self.queue.submit(lambda: self.display.show_scores(scored), key="scores")

    def _on_sight(self, layout: Layout, frame: int, sight: UInt[np.ndarray, " V"]) -> None:
        self.queue.submit(lambda: self.display.show_sight(frame, sight), key="sight")

    def _on_progress(self, done: float, best: float) -> None:
        def job() -> None:
            if not self.searching:
                return
            left = (1 - done) * float(self.panel.seconds.value)
            set_value(self.panel.bar, 100.0 * done)
            self.panel.course.content = f"best {best:.4f}, {left:.0f} s left"

        self.queue.submit(job, key="progress")

    def _on_better(self, layout: Layout, score: float) -> None:
        def job() -> None:
            if not self.searching:
                return
            self.show_held(layout)
            self._keep(layout)

        self.queue.submit(job, key="better")

    def _on_end(self, ending: SearchEnding) -> None:
        def job() -> None:
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

        self.queue.submit(job)

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
                    self.restore()
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
            self._show_controls()
            self.scorer.score(self.layout, whole=True)

    def show_held(self, layout: Layout) -> None:
        """Show a layout in which a sensor is being moved, and have some frames of it scored."""
        self.display.draw(layout)
        self.scorer.score(layout, whole=False)

    def _show_controls(self) -> None:
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
