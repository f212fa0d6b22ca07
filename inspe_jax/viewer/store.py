"""A layout in hand on disk: its file, one beside it while it is not saved, its report.

No file is written over that this run has neither read nor written: it may hold somebody's work.
"""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from inspe_jax.errors import InspeError
from inspe_jax.files import write_text
from inspe_jax.placement.problem import Case
from inspe_jax.report.page import entry_of, report_page
from inspe_jax.scene.scene import Scene
from inspe_jax.sensing.layout import Layout, layout_text, load_layout, save_layout

UNSAVED = "unsaved"
"""Goes into the name of the file that keeps what is not saved."""


@dataclass(frozen=True)
class Earlier:
    """A layout file of an earlier run: where it is, and when it was written."""

    path: Path
    written: datetime

    @property
    def words(self) -> str:
        """For people, in Markdown."""
        return f"`{self.path.name}` of {self.written:%d %B, %H:%M}"


class Store:
    """The files of one layout: ``path``, where it is saved, and ``unsaved`` beside it."""

    def __init__(self, path: Path, opened: Layout, scene: Scene | None = None) -> None:
        """``scene`` gives the ground to units whose files do not say how high they stand."""
        self.path, self._scene = Path(path), scene
        self._kept = opened
        self._known: dict[Path, bytes] = {}  # what this run has read or written, as it then was
        self._unsaved: Path | None = None
        self._taken_up: Path | None = None  # an earlier run's, until this one saves
        self._report: threading.Thread | None = None
        if self.path.is_file() and self._is(self.path, opened):
            self._know(self.path)
        beside = self._unsaved_name(0)
        found = [at for at in (self.path, beside) if at.is_file() and at not in self._known]
        self.earlier = tuple(
            Earlier(at, datetime.fromtimestamp(at.stat().st_mtime)) for at in found
        )

    @property
    def unsaved(self) -> Path:
        """Where a changed layout is kept while it is not saved: no earlier run's file."""
        if self._unsaved is None:
            names = (self._unsaved_name(k) for k in range(1000))
            self._unsaved = next((at for at in names if not at.exists()), self._unsaved_name(0))
        return self._unsaved

    @property
    def page(self) -> Path:
        """Where a report goes: beside the one that another run wrote."""
        at = self.path.with_suffix(".html")
        own = [page for page in self._known if page.stem.startswith(at.stem)]
        pages = [page for page in own if page.suffix == at.suffix]
        return pages[-1] if pages else _free(at) if at.exists() else at

    @property
    def beside(self) -> Path:
        """The next free name beside :attr:`path`."""
        return _free(self.path)

    def holds(self, layout: Layout) -> bool:
        """Whether a layout is as it was opened, or saved last."""
        return layout is self._kept

    def would_replace(self) -> bool:
        """Whether saving would write over what this run has neither read nor written."""
        return self.path.exists() and self._known.get(self.path) != self.path.read_bytes()

    def open(self, earlier: Earlier) -> Layout:
        """The layout of an earlier run, to go on from. Raises InspeError where it is none."""
        layout = load_layout(earlier.path, self._scene, unit_rule=False)
        if earlier.path == self.path:
            self._kept = layout
            self._know(self.path)
        else:
            self._taken_up = earlier.path
        return layout

    def save(self, layout: Layout, path: Path | None = None) -> None:
        """Write the layout's file; with ``path``, from now on that one. It writes over what is
        there: see :meth:`would_replace`."""
        save_layout(layout, path or self.path)
        self.path = path or self.path
        self._know(self.path)
        self._kept = layout
        self.keep(layout)
        if self._taken_up is not None:  # it is saved now, or what became of it
            self._taken_up.unlink(missing_ok=True)
            self._taken_up = None

    def keep(self, layout: Layout) -> None:
        """Keep a layout that is not saved; the file goes when there is none."""
        if not self.holds(layout):
            save_layout(layout, self.unsaved)
        elif self._unsaved is not None:
            self._unsaved.unlink(missing_ok=True)

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
        ended: Callable[[Path, Exception | None], None],
    ) -> bool:
        """Write a report on a thread, which tells its file and its end; False where one is being
        written."""
        page = self.page

        def work() -> None:
            wrong = None
            try:
                entry = entry_of(case, layout, weights)
                write_text(page, report_page(case.scene, [entry], frame=frame))
                self._know(page)
            except Exception as e:
                wrong = e
            ended(page, wrong)

        if self._report is not None and self._report.is_alive():
            return False
        self._report = threading.Thread(target=work, name="report")
        self._report.start()
        return True

    def close(self) -> None:
        """Wait for a report that is being written."""
        if self._report is not None:
            self._report.join()

    def _know(self, path: Path) -> None:
        self._known[path] = path.read_bytes()

    def _is(self, path: Path, layout: Layout) -> bool:
        """Whether a file holds a layout, as when it was opened from there."""
        try:
            found = load_layout(path, self._scene, unit_rule=False)
            return layout_text(found) == layout_text(layout)
        except InspeError:
            return False

    def _unsaved_name(self, number: int) -> Path:
        mark = f"{UNSAVED}-{number + 1}" if number else UNSAVED
        return self.path.with_name(f"{self.path.stem}.{mark}{self.path.suffix}")


def _free(path: Path) -> Path:
    """The first name beside a path, with a number from 2, that is no file's."""
    names = (path.with_name(f"{path.stem}-{k}{path.suffix}") for k in range(2, 1000))
    return next(at for at in names if not at.exists())
