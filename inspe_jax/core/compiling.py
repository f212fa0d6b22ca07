"""What XLA compiles in this process: how many programs, for how long, and who waits for it. The
clock of a search stands still meanwhile. :mod:`~inspe_jax.core.kept` lets JAX tell of it."""

import contextlib
import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NoReturn

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
hear, compiled = _watch.hear, _watch.compiled


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


# ── Ending the process while something is compiled ──────────────────────────

WRITING = 0.3  # time that JAX has at the end for what it writes to its cache [s]


def leave(status: int) -> NoReturn:
    """End the process, after a moment in which JAX ends what it writes to its cache: it writes in
    place and never again, so an incomplete file would stay unusable."""
    time.sleep(WRITING)
    os._exit(status)
