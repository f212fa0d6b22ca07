"""What a browser asks of files: to save the layout, to open one, to write and to send them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from inspe_jax.placement.problem import Case
from inspe_jax.report.page import Start
from inspe_jax.scoring.metrics import Weights
from inspe_jax.sensing.layout import Layout, layout_text
from inspe_jax.viewer.display import Display
from inspe_jax.viewer.job_queue import JobQueue
from inspe_jax.viewer.panel import Panel
from inspe_jax.viewer.session import LayoutSession
from inspe_jax.viewer.store import EarlierFile, LayoutStore


class FileActions:
    """The part of a :class:`~inspe_jax.viewer.app.Viewer` that has to do with files."""

    case: Case
    weights: Weights
    further: dict[str, Any]
    store: LayoutStore
    session: LayoutSession
    queue: JobQueue
    panel: Panel
    display: Display
    searching: bool
    layout: Any
    _report: Path | None = None
    _unless_searching: Callable[[Callable[[], Any]], None]
    change: Callable[[Callable[[], Any]], None]
    _show_file: Callable[[Layout], None]
    _failed: Callable[[Exception], None]

    def save(self) -> None:
        """Save the layout; ask first if that would replace a file of an earlier run."""

        def job() -> None:
            if self.store.would_replace(self.layout):
                self.panel.ask_replace(self.store.path.name, self.store.beside.name)
            else:
                self._save(None)

        self._unless_searching(job)

    def replace(self) -> None:
        """Save the layout in place of the file that is there."""
        self._unless_searching(lambda: self._save(None))

    def save_beside(self) -> None:
        """Save the layout under a new name, and keep that name from now on."""
        self._unless_searching(lambda: self._save(self.store.beside))

    def _save(self, path: Path | None) -> None:
        self.store.save(self.layout, path)
        self._show_file(self.layout)
        self.display.notify("Saved", str(self.store.path), "green")

    def open_earlier(self, number: int) -> None:
        """Open a layout that an earlier run has left."""

        def change() -> None:
            earlier: EarlierFile = self.store.earlier[number]
            self.session.take(self.store.open(earlier))
            self.panel.withdraw(number)
            self.display.notify("Opened", earlier.path.name, None)

        self.change(change)

    def download(self, client: Any) -> None:
        """Send a browser the layout, as it would be saved."""
        self.queue.submit(lambda: send(client, self.store.path.name, layout_text(self.layout)))

    def write_report(self) -> None:
        """Write a report beside the layout's file, and offer it to browsers; one at a time.

        It has before and after where the layout is not the reference, and the target if one is set.
        """

        def ended(page: Path, wrong: Exception | None) -> None:
            self.queue.submit(lambda: show(page, wrong))

        def show(page: Path, wrong: Exception | None) -> None:
            self.panel.report.disabled = self.searching
            if wrong is None:
                self._report = page
                self.panel.show_report(f"The report is ready: `{page.name}`", ready=True)
                self.display.notify("Report", "The report is ready", "green")
            else:
                self.panel.show_report("", ready=False)
                self._failed(wrong)

        def job() -> None:
            given = self.case, self.layout, self.weights, self.panel.shown_frame, ended
            before = self.display.reference
            start = None if before.layout is self.layout else Start(before.layout, before.words)
            target = float(self.panel.target.value) or None
            if self.store.report(*given, **self.further, start=start, target=target):
                self.panel.report.disabled = True
                self.panel.show_report("The report is being drawn …", ready=False)

        self._unless_searching(job)

    def download_report(self, client: Any) -> None:
        """Send a browser the report that was written last."""

        def job() -> None:
            if self._report is not None:
                send(client, self._report.name, self._report.read_text(encoding="utf-8"))

        self.queue.submit(job)


def send(client: Any, name: str, text: str) -> None:
    """Have a browser save a file among its downloads."""
    client.send_file_download(name, text.encode(), save_immediately=True)
