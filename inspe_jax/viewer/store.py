"""A layout in hand on disk: its file, one beside it while it is not saved, its report."""

import threading
from collections.abc import Callable
from pathlib import Path

from inspe_jax.files import write_text
from inspe_jax.placement.problem import Case
from inspe_jax.report.page import entry_of, report_page
from inspe_jax.sensing.layout import Layout, save_layout

UNSAVED = "unsaved"
"""Goes into the name of the file that keeps what is not saved."""


class Store:
    """The files of one layout: ``path``, where it is saved, and ``unsaved`` beside it."""

    def __init__(self, path: Path, opened: Layout) -> None:
        self.path, self._kept = Path(path), opened
        self._report: threading.Thread | None = None

    @property
    def unsaved(self) -> Path:
        """Where a changed layout is kept while it is not saved."""
        return self.path.with_name(f"{self.path.stem}.{UNSAVED}{self.path.suffix}")

    @property
    def page(self) -> Path:
        """Where a report goes."""
        return self.path.with_suffix(".html")

    def holds(self, layout: Layout) -> bool:
        """Whether a layout is as it was opened, or saved last."""
        return layout is self._kept

    def save(self, layout: Layout) -> None:
        """Write the layout's file."""
        save_layout(layout, self.path)
        self._kept = layout
        self.keep(layout)

    def keep(self, layout: Layout) -> None:
        """Keep a layout that is not saved; the file goes when there is none."""
        if self.holds(layout):
            self.unsaved.unlink(missing_ok=True)
        else:
            save_layout(layout, self.unsaved)

    def words(self, layout: Layout) -> str:
        """Where it is, for people, in Markdown."""
        kept = "" if self.holds(layout) else f", not saved yet; kept in `{self.unsaved}`"
        return f"`{self.path}`{kept}"

    def report(
        self,
        case: Case,
        layout: Layout,
        weights: tuple[float, float, float],
        frame: int,
        ended: Callable[[Exception | None], None],
    ) -> bool:
        """Write a report on a thread, which tells its end; False where one is being written."""

        def work() -> None:
            wrong = None
            try:
                entry = entry_of(case, layout, weights)
                write_text(self.page, report_page(case.scene, [entry], frame=frame))
            except Exception as e:
                wrong = e
            ended(wrong)

        if self._report is not None and self._report.is_alive():
            return False
        self._report = threading.Thread(target=work, name="report")
        self._report.start()
        return True

    def close(self) -> None:
        """Wait for a report that is being written."""
        if self._report is not None:
            self._report.join()
