"""What a browser asks of files: to save the layout, to open one, to write and to send them."""

from pathlib import Path
from typing import Any

from inspe_jax.report.page import Start, report_entry, report_page
from inspe_jax.sensing.layout import layout_text
from inspe_jax.viewer.job_queue import JobQueue
from inspe_jax.viewer.page_views import VIEWS


class FileActions:
    """The part of a :class:`~inspe_jax.viewer.app.Viewer` that has to do with files."""

    def __init__(self, viewer: Any) -> None:
        self._viewer = viewer
        self._report: Path | None = None
        self._writing = False
        self._reports = JobQueue(self._report_failed)  # a report takes seconds to draw

    def close(self) -> None:
        """Finish a report that is being written."""
        self._reports.close()

    def save(self) -> None:
        """Save the layout; ask first if that would replace a file of an earlier run."""

        def job() -> None:
            store = self._viewer.store
            if store.would_replace(self._viewer.layout):
                self._viewer.panel.ask_replace(store.path.name, store.beside.name)
            else:
                self._save(None)

        self._viewer.unless_searching(job)

    def replace(self) -> None:
        """Save the layout in place of the file that is there."""
        self._viewer.unless_searching(lambda: self._save(None))

    def save_beside(self) -> None:
        """Save the layout under a new name, and keep that name from now on."""
        self._viewer.unless_searching(lambda: self._save(self._viewer.store.beside))

    def _save(self, path: Path | None) -> None:
        viewer = self._viewer
        viewer.store.save(viewer.layout, path)
        viewer.show_file(viewer.layout)
        viewer.display.notify("Saved", str(viewer.store.path), "green")

    def open_earlier(self, number: int) -> None:
        """Open a layout that an earlier run has left."""
        viewer = self._viewer

        def change() -> None:
            earlier = viewer.store.earlier[number]
            viewer.session.take(viewer.store.open(earlier))
            viewer.panel.withdraw(number)
            viewer.display.notify("Opened", earlier.path.name, None)

        viewer.change(change)

    def download(self, client: Any) -> None:
        """Send a browser the layout, as it would be saved."""
        viewer = self._viewer
        viewer.queue.submit(
            lambda: _send(client, viewer.store.path.name, layout_text(viewer.layout))
        )

    def write_report(self) -> None:
        """Write a report beside the layout's file, and offer it to browsers; one at a time.

        It has before and after where the layout is not the reference, and the target if one is set.
        """
        viewer = self._viewer

        def job() -> None:
            if self._writing:
                return
            self._writing = viewer.panel.report.disabled = True
            viewer.panel.show_report("The report is being drawn …", ready=False)
            case, layout, frame = viewer.case, viewer.layout, viewer.panel.shown_frame
            before = viewer.display.reference
            start = None if before.layout is layout else Start(before.layout, before.words)
            target = float(viewer.panel.target.value) or None

            def write() -> None:
                entry = report_entry(
                    case, layout, viewer.weights, start=start, target=target, **viewer.further
                )
                text = report_page(case.scene, [entry], frame=frame, views=VIEWS)
                page = viewer.store.write_page(text)
                viewer.queue.submit(lambda: self._show_report(page))

            self._reports.submit(write)

        viewer.unless_searching(job)

    def download_report(self, client: Any) -> None:
        """Send a browser the report that was written last."""

        def job() -> None:
            if self._report is not None:
                _send(client, self._report.name, self._report.read_text(encoding="utf-8"))

        self._viewer.queue.submit(job)

    def _report_failed(self, wrong: Exception) -> None:
        def job() -> None:
            self._show_report(None)
            raise wrong

        self._viewer.queue.submit(job)

    def _show_report(self, page: Path | None) -> None:
        """Offer a report that is written; None offers none."""
        panel = self._viewer.panel
        self._writing, panel.report.disabled = False, self._viewer.searching
        if page is None:
            panel.show_report("", ready=False)
        else:
            self._report = page
            panel.show_report(f"The report is ready: `{page.name}`", ready=True)
            self._viewer.display.notify("Report", "The report is ready", "green")


def _send(client: Any, name: str, text: str) -> None:
    """Have a browser save a file among its downloads."""
    client.send_file_download(name, text.encode(), save_immediately=True)
