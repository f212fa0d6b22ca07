"""The files of the viewer's layout: the saved one, one that keeps unsaved changes, the report.

A file that this run has not written may hold somebody's work: it is never removed, and replaced
only when the user says so.
"""

import re
from collections.abc import Iterator
from contextlib import suppress
from itertools import count
from pathlib import Path

from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import write_text
from inspe_jax.scene.scene import Scene
from inspe_jax.sensing.layout import Layout, layout_text, load_layout, save_layout

UNSAVED = "unsaved"  # part of the name of the file that keeps unsaved changes
OFFERED = 4  # most files of earlier runs that are offered


class LayoutStore:
    """The files of one layout: ``path``, where it is saved, and ``unsaved`` beside it, which keeps
    unsaved changes if there are any and is never a file of an earlier run. ``earlier`` are files
    that earlier runs have left, the newest first."""

    def __init__(self, path: Path, opened: Layout, scene: Scene | None = None) -> None:
        """``opened`` is the layout at the start; ``scene`` gives ground heights that files lack."""
        self.path, self._scene = Path(path).resolve(), scene
        self._saved = opened
        self._known: dict[Path, bytes] = {}  # this run's own files, as it has written them
        self.unsaved: Path | None = None
        self._written: Layout | None = None  # what is in that file
        self._wrong = ""  # why the newest layout is not
        self._taken_up: tuple[Path, Layout] | None = None
        if self._is(self.path, opened):  # it was opened from there
            self._know(self.path)
        self.earlier = [at for at in self._others() if not self._is(at, opened)][:OFFERED]

    @property
    def beside(self) -> Path:
        """The next free name beside :attr:`path`."""
        return next(at for at in _numbered(self.path) if not at.exists())

    def holds(self, layout: Layout) -> bool:
        """Whether a layout has no unsaved changes."""
        return layout is self._saved

    def would_replace(self, layout: Layout) -> bool:
        """Whether saving would replace another layout that this run has not written."""
        return not (self._owns(self.path) or self._is(self.path, layout)) and self.path.exists()

    def open(self, earlier: Path) -> Layout:
        """Read a layout of an earlier run. Raises InspeError if the file is not a layout."""
        layout = load_layout(earlier, self._scene, unit_rule=False)
        if earlier == self.path:
            self._saved = layout
        elif UNSAVED in earlier.name:
            self._taken_up = earlier, layout
        return layout

    def kept(self, layout: Layout) -> Path | None:
        """The file that keeps the unsaved changes of a layout; None if none does."""
        return self.unsaved if self._written is layout and self._owns(self.unsaved) else None

    def save(self, layout: Layout, path: Path | None = None) -> None:
        """Save the layout to ``path``, or to the present file. A file there is replaced. ``path``
        is the layout's file from now on. Ask :meth:`would_replace` before."""
        save_layout(layout, path or self.path)
        self.path = path or self.path
        self._know(self.path)
        self._saved = layout
        self.keep(layout)
        if self._taken_up is not None and self._taken_up[1] is layout:  # it is saved now
            self._taken_up[0].unlink(missing_ok=True)
            self._taken_up = None

    def keep(self, layout: Layout) -> None:
        """Keep the unsaved changes of a layout; remove their file if there are none. Raises
        InspeError or OSError if they cannot be kept: :meth:`words` then say so."""
        if not self._owns(self.unsaved):
            self.unsaved = self._written = None
        at, new = self.unsaved, self.unsaved is None
        if self.holds(layout):
            if at is not None:
                at.unlink(missing_ok=True)
                self.unsaved = None
        elif self._written is not layout:
            try:
                at = at or self._new_unsaved()
                save_layout(layout, at)
            except (InspeError, OSError) as e:
                self._wrong = str(e)
                if new and at is not None:  # it is empty
                    at.unlink(missing_ok=True)
                raise
            self.unsaved, self._written = at, layout
            self._know(at)

    def words(self, layout: Layout) -> str:
        """Where the layout is: in its file, in the one that keeps it until then, or in none."""
        if self.holds(layout):
            new = "" if self.path.exists() else "nothing changed; to be saved in "
            return f"{new}{self.path}"
        kept = self.kept(layout)
        where = f"kept in {kept}" if kept else f"and kept in no file: {self._wrong}"
        return f"{self.path}, not saved yet, {where}"

    def write_page(self, text: str) -> Path:
        """Write a report beside :attr:`path`; returns its file. A report of another run is not
        replaced: the name gets a number."""
        pages = _numbered(self.path.with_suffix(".html"))
        page = next(page for page in pages if page in self._known or not page.exists())
        write_text(page, text)
        self._know(page)
        return page

    def _know(self, path: Path) -> None:
        self._known[path] = path.read_bytes()

    def _owns(self, path: Path | None) -> bool:
        """Whether this run has written a file, and nobody has changed it since."""
        with suppress(OSError):
            return path in self._known and path.read_bytes() == self._known[path]
        return False

    def _is(self, path: Path, layout: Layout) -> bool:
        with suppress(InspeError, OSError):
            found = load_layout(path, self._scene, unit_rule=False)
            return layout_text(found) == layout_text(layout)
        return False

    def _others(self) -> list[Path]:
        """Files that earlier runs may have left, the newest first."""
        stem, suffix = re.escape(self.path.stem), re.escape(self.path.suffix)
        name = re.compile(rf"{stem}(-\d+)?(\.{UNSAVED}(-\d+)?)?{suffix}")
        found = [at for at in self.path.parent.iterdir() if name.fullmatch(at.name)]
        found = [at for at in found if at.is_file()]
        return sorted(found, key=lambda at: at.stat().st_mtime, reverse=True)

    def _new_unsaved(self) -> Path:
        """A new file for unsaved changes; another run may be choosing a name at the same time."""
        first = self.path.with_name(f"{self.path.stem}.{UNSAVED}{self.path.suffix}")
        for at in _numbered(first):
            with suppress(FileExistsError):
                at.touch(exist_ok=False)
                self._know(at)
                return at
        raise AssertionError("unreachable: there is always a free name")


def _numbered(path: Path) -> Iterator[Path]:
    yield path
    for k in count(2):
        yield path.with_name(f"{path.stem}-{k}{path.suffix}")
