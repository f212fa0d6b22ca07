"""What XLA compiles in this process: how many programs, for how long, and who waits for it. The
clock of a search stands still meanwhile. The programs are kept on disk for the next process."""

import atexit
import contextlib
import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import jax
import jax.monitoring
from platformdirs import user_cache_path

from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import check_writable

TRACED = "/jax/core/compile/jaxpr_trace_duration"
LOWERED = "/jax/core/compile/jaxpr_to_mlir_module_duration"
COMPILED = "/jax/core/compile/backend_compile_duration"
"""Events that JAX records when a function has been traced, when its program goes to XLA, and when
that is compiled, or read from the cache on disk."""


@dataclass(frozen=True)
class Compiled:
    """``programs`` compiled so far, in ``seconds`` of wall time, and whether one is ``now``."""

    programs: int
    seconds: float
    now: bool


class Stretches:
    """Stretches of time, in order and without overlaps, and the ``seconds`` of them all."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self._stretches: list[tuple[float, float]] = []

    def add(self, begin: float, end: float) -> None:
        """Add a stretch that ends last; it may contain earlier stretches."""
        while self._stretches and self._stretches[-1][1] >= begin:
            first, last = self._stretches.pop()
            self.seconds -= last - first
            begin = min(begin, first)
        self._stretches.append((begin, end))
        self.seconds += end - begin

    def before(self, time: float) -> float:
        """The seconds before a time."""
        seconds = self.seconds
        for first, last in reversed(self._stretches):
            if last <= time:
                break
            seconds -= last - max(first, time)
        return seconds


class _Local(threading.local):
    def __init__(self) -> None:
        self.waits = Stretches()


class _Watch:
    """Counts the programs that are compiled since it was created."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._programs = 0
        self._all = Stretches()
        self.since: dict[int, float] = {}  # when XLA began, by the thread that waits for it
        self.local = _Local()

    def hear(self, event: str, duration_secs: float, **_: str | int) -> None:
        """Listens to JAX's events. The thread that waits for a program records its events."""
        if event not in (TRACED, LOWERED, COMPILED):
            return
        thread = threading.get_ident()
        with self._lock:
            now = time.monotonic()
            self._programs += event == COMPILED
            if event == LOWERED:
                self.since[thread] = now
            else:
                self.since.pop(thread, None)
            for stretches in (self._all, self.local.waits):
                stretches.add(now - duration_secs, now)

    def compiled(self) -> Compiled:
        """What this process has compiled since this module was imported."""
        alive = {thread.ident for thread in threading.enumerate()}
        with self._lock:
            self.since = {thread: at for thread, at in self.since.items() if thread in alive}
            seconds = self._all.seconds
            if self.since:
                since = min(self.since.values())
                seconds = self._all.before(since) + time.monotonic() - since
            return Compiled(self._programs, seconds, bool(self.since))


_watch = _Watch()
jax.monitoring.register_event_duration_secs_listener(_watch.hear)
compiled = _watch.compiled


def holds_main_thread() -> bool:
    """Whether XLA compiles in the main thread now, which then does not hear Ctrl-C."""
    return threading.main_thread().ident in _watch.since


# ── A clock that stands still while something is compiled ───────────────────


def working_clock() -> Callable[[], float]:
    """A clock [s] that stands still while the thread that calls this waits for a program: while it
    traces, and while it or a job of its :func:`inspe_jax.core.parallel.run` compiles or reads a
    program from disk. What other threads compile meanwhile does not stop the clock."""
    waits = this_thread()
    return lambda: time.monotonic() - waits.seconds


def this_thread() -> Stretches:
    """What this thread has waited, for :func:`on_behalf_of` in another thread."""
    return _watch.local.waits


@contextlib.contextmanager
def on_behalf_of(waits: Stretches) -> Iterator[None]:
    """In the block, a thread that compiles lets the thread wait that has handed it the work."""
    own, _watch.local.waits = this_thread(), waits
    try:
        yield
    finally:
        _watch.local.waits = own


# ── Programs that are kept on disk ──────────────────────────────────────────

KEPT = 512 * 2**20
"""Size of the folder of compiled programs [bytes]. The least recently used go as a process ends."""
NOTHING = ("0", "false", "f", "no", "n", "off")  # values of INSPE_CACHE that keep nothing
CACHE_SETTINGS = (
    "jax_enable_compilation_cache",
    "jax_compilation_cache_dir",
    "jax_compilation_cache_max_size",
    "jax_persistent_cache_min_compile_time_secs",
)
"""JAX's settings of its cache of compiled programs."""


def keep_programs() -> None:
    """Keep all programs that this process compiles in the user's cache folder for the next one. A
    folder that the user sets for JAX stays. If no folder can be written, nothing is kept."""
    if jax.config.jax_compilation_cache_dir is not None:  # type: ignore[attr-defined]
        return
    try:
        folder = user_cache_path("inspe_jax", appauthor=False)
        if not folder.is_absolute():  # there is no home folder
            return
        folder.mkdir(parents=True, exist_ok=True)
        check_writable(folder)
    except (InspeError, OSError, RuntimeError):
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    atexit.register(prune, folder)


def kept_in() -> Path | None:
    """The folder that programs are kept in; None if they are not."""
    on = jax.config.jax_enable_compilation_cache  # type: ignore[attr-defined]
    folder = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    return Path(folder) if on and folder else None


def prune(folder: Path, most: int = KEPT) -> None:
    """Remove programs of a folder, the least recently used first, down to so many bytes. JAX's own
    limit locks all processes out of the folder for every program."""
    found: list[tuple[float, int, Path]] = []
    for path in folder.glob("*-cache"):
        with contextlib.suppress(OSError):  # another process removes some too
            stat = path.stat()
            found.append((max(stat.st_atime, stat.st_mtime), stat.st_size, path))
    size = 0
    for _, own, path in sorted(found, reverse=True):
        size += own
        if size > most:
            with contextlib.suppress(OSError):
                path.unlink()


# ── Ending the process while something is compiled ──────────────────────────

WRITING = 0.3  # time that JAX has at the end for what it writes to its cache [s]


def leave(status: int) -> NoReturn:
    """End the process, after a moment in which JAX ends what it writes to its cache: it writes in
    place and never again, so an incomplete file would stay unusable."""
    time.sleep(WRITING)
    os._exit(status)
