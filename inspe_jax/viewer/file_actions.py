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
        self._reports = JobQueue(viewer.queue.failed)  # a report takes seconds to draw

    def close(self) -> None:
        """Finish a report that is being written."""
        self._reports.close()

    def save(self) -> None:
        """Save the layout; ask first if that would replace a file of an earlier run."""
        store = self._viewer.store

        def job() -> None:
            if store.would_replace(self._viewer.layout):
                self._viewer.panel.ask_replace(store.path, store.beside)
            else:
                self._save(store.path)

        self._viewer.unless_searching(job)

    def save_in(self, path: Path) -> None:
        """Save the layout in this file, which may be there, and in no other from now on."""
        self._viewer.unless_searching(lambda: self._save(path))

    def _save(self, path: Path) -> None:
        viewer = self._viewer
        viewer.store.save(viewer.layout, path)
        viewer.show_file(viewer.layout)
        viewer.display.notify("Saved", str(path), "green")

    def open_earlier(self, number: int) -> None:
        """Open a layout that an earlier run has left."""
        viewer = self._viewer

        def change() -> None:
            earlier = viewer.store.earlier[number]
            viewer.session.take(viewer.store.open(earlier))
            viewer.panel.withdraw(number)
            viewer.display.notify("Opened", earlier.name, None)

        viewer.change(change)

    def download(self, client: Any) -> None:
        """Send a browser the layout, as it would be saved."""
        viewer = self._viewer
        viewer.queue.submit(
            lambda: _send(client, viewer.store.path.name, layout_text(viewer.layout))
        )

    def write_report(self, client: Any) -> None:
        """Write a report beside the layout's file, and send it to the browser that asks for it.

        It has before and after where the layout is not as it was opened, and the target if one is
        set.
        """
        viewer = self._viewer

        def job() -> None:
            viewer.panel.report.disabled = True
            viewer.display.notify("Report", "It is being drawn …", None)
            case, layout, frame = viewer.case, viewer.layout, viewer.panel.shown_frame
            opened = viewer.display.opened
            start = None if opened is layout else Start(opened, "the layout as it was opened")
            target = float(viewer.panel.target.value) or None

            def write() -> None:
                try:
                    entry = report_entry(
                        case, layout, viewer.weights, start=start, target=target, **viewer.further
                    )
                    text = report_page(case.scene, [entry], frame=frame, views=VIEWS)
                    page = viewer.store.write_page(text)
                    viewer.display.notify("Report", f"It is in {page}", "green")
                    _send(client, page.name, text)
                finally:
                    viewer.queue.submit(self._allow_report)

            self._reports.submit(write, key="report")

        viewer.unless_searching(job)

    def _allow_report(self) -> None:
        self._viewer.panel.report.disabled = self._viewer.searching


def _send(client: Any, name: str, text: str) -> None:
    """Have a browser save a file among its downloads."""
    client.send_file_download(name, text.encode(), save_immediately=True)
