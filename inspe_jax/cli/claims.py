"""Files that a command may write: new ones, and those that the same command wrote and nobody
changed since. All others are replaced only with --force.

What was written is listed in ``written.txt`` in the user's state folder: a line for each file, with
the SHA-256 of its content, the command and the path. Without such a folder nothing is known to be
a command's own.
"""

import tempfile
from collections.abc import Callable, Collection, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import typer
from platformdirs import user_state_path

from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import check_folder, check_output, check_writable, digest_of, write_text

MOST = 5000  # lines that stay of a list of twice as many; the oldest go


class Claims:
    """The files that the running ``command`` may write, and how each was before it."""

    def __init__(self) -> None:
        self.begin("")

    def begin(self, command: str) -> None:
        """A command begins: it has claimed nothing."""
        self.command, self.failed = command, False
        self._before: dict[Path, tuple[int, int] | None] = {}

    def file(self, path: str | Path | None, suffixes: Collection[str] = (), *, force: bool) -> None:
        """Raise InspeError unless the command may write a file with one of the ``suffixes``, and
        could: before the work for it. A ``path`` of None or "-" is accepted."""
        if path is not None and str(path) != "-":
            check_output(path, suffixes)
            check_writable(Path(path).parent)
            self._claim([Path(path)], force)

    def outputs(self, plot: Path | None, record: str | None = None, *, force: bool) -> None:
        """The same for the files of ``--plot`` and ``--json``."""
        from inspe_jax.core.sheet import FORMATS

        self.file(plot, FORMATS, force=force)
        self.file(record, force=force)

    def folder(self, folder: Path, names: Iterable[str], *, force: bool) -> None:
        """The same for the files of these ``names`` in a folder, which may be new."""
        check_folder(folder)
        self._claim([folder / name for name in names], force)

    def _claim(self, paths: list[Path], force: bool) -> None:
        own = {} if force else _listed()
        for path in paths:
            if path.exists() and not force:
                command, digest = own.get(str(path.resolve()), ("", ""))
                if command != self.command:
                    how = f"and `inspe {self.command}` did not write it"
                elif digest != digest_of(path):
                    how = f"and was changed since `inspe {self.command}` wrote it"
                else:
                    continue
                raise InspeError(
                    f"{path}: is there already, {how}: name another file, or give --force to "
                    "replace it"
                )
        self._before |= {path: _stamp(path) for path in paths}

    def keep(self, save: Callable[[Path], Any], path: Path) -> Path:
        """Save what the command has worked for, and return its path: where that fails, in a folder
        for temporary files, which the command says, and its exit status is 1."""
        try:
            save(path)
            return path
        except (InspeError, OSError) as e:
            spare = Path(tempfile.mkdtemp(prefix="inspe_")) / path.name
            save(spare)
            self.failed = True
            typer.echo(f"Error: {e}; kept in {spare} instead", err=True)
            return spare

    def end(self) -> None:
        """List what was written. Raises typer.Exit where a result is not where it was wanted."""
        self.record()
        if self.failed:
            raise typer.Exit(1)

    def record(self) -> None:
        """List what was written so far: also where the command does not come to its end."""
        written = [path for path, old in self._before.items() if _stamp(path) not in (None, old)]
        if not written:
            return
        with suppress(OSError, RuntimeError, InspeError):  # there is no such folder, or it is full
            _list().parent.mkdir(parents=True, exist_ok=True)
            new = [f"{digest_of(path)} {self.command} {path.resolve()}\n" for path in written]
            with _list().open("a", encoding="utf-8") as f:  # whole lines, of all that write at once
                f.write("".join(new))
            if len(lines := _list().read_text("utf-8").splitlines(keepends=True)) > 2 * MOST:
                write_text(_list(), "".join(lines[-MOST:]))


claims = Claims()


def _list() -> Path:
    return user_state_path("inspe_jax", appauthor=False) / "written.txt"


def _listed() -> dict[str, tuple[str, str]]:
    """Command and digest of every file that was written, by its path; a later line counts."""
    try:
        rows = [line.split(" ", 2) for line in _list().read_text("utf-8").splitlines()]
    except (OSError, RuntimeError, ValueError):
        return {}
    return {row[2]: (row[1], row[0]) for row in rows if len(row) == 3}


def _stamp(path: Path) -> tuple[int, int] | None:
    """What changes when a file is written; None where there is none."""
    try:
        return (stat := path.stat()).st_mtime_ns, stat.st_ino
    except OSError:
        return None
