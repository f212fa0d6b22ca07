"""What XLA compiles in this process: how many programs, for how long, and whether it does now.

A user waits for it, so who shows progress says so. From the events that JAX records.
"""

import contextlib
import json
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.monitoring

from inspe_jax.errors import InspeError
from inspe_jax.files import write_text

TRACED = "/jax/core/compile/jaxpr_trace_duration"
"""Recorded when a function has been traced,"""
LOWERED = "/jax/core/compile/jaxpr_to_mlir_module_duration"
"""when its program goes to XLA,"""
COMPILED = "/jax/core/compile/backend_compile_duration"
"""and when that is compiled, or read from what was kept of an earlier run."""


@dataclass(frozen=True)
class Compiled:
    """What was compiled so far: ``programs``, in ``seconds`` of wall time, tracing included.

    ``now`` says whether one is being compiled at this moment.
    """

    programs: int
    seconds: float
    now: bool


class _Watch:
    """Counts what is compiled, from when it is made."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._programs = 0
        # When something was traced or compiled: stretches of time that do not overlap, in order.
        self._stretches: list[tuple[float, float]] = []
        self._seconds = 0.0  # of all of them
        self._since: dict[int, float] = {}  # when XLA began, by the thread that waits for it

    def hear(self, event: str, duration_secs: float, **_: str | int) -> None:
        """Both events of one program are recorded by the thread that waits for it."""
        if event not in (TRACED, LOWERED, COMPILED):
            return
        thread, now = threading.get_ident(), time.monotonic()
        with self._lock:
            if event == LOWERED:
                self._since[thread] = now
            else:
                self._since.pop(thread, None)
                self._programs += event == COMPILED
            self._add(now - duration_secs, now)

    def _add(self, begin: float, end: float) -> None:
        """One more stretch, no earlier in its end than the others: within it there may be some."""
        while self._stretches and self._stretches[-1][1] >= begin:
            first, last = self._stretches.pop()
            self._seconds -= last - first
            begin = min(begin, first)
        self._stretches.append((begin, end))
        self._seconds += end - begin

    def compiled(self) -> Compiled:
        alive = {thread.ident for thread in threading.enumerate()}
        with self._lock:
            self._since = {thread: at for thread, at in self._since.items() if thread in alive}
            seconds, known = self._seconds, self._stretches[-1][1] if self._stretches else 0.0
            if self._since:
                seconds += time.monotonic() - max(min(self._since.values()), known)
            return Compiled(self._programs, seconds, bool(self._since))


_watch = _Watch()
jax.monitoring.register_event_duration_secs_listener(_watch.hear)


def compiled() -> Compiled:
    """What this process has compiled since this module was imported."""
    return _watch.compiled()


# ── About how long it takes ─────────────────────────────────────────────────

TIMES = "compile_times.json"
"""Beside what JAX keeps compiled: how long it took the last time, by what it was for [s]."""
NOTICED = 1.0
"""What compiles faster, as when it was kept, says nothing of how long it takes [s]."""


def usual_seconds(what: str, default: float) -> float:
    """About how long it takes to compile something: as long as the last time on this machine."""
    try:
        return float(_times()[what])
    except (KeyError, TypeError, ValueError):
        return default


def remember_seconds(what: str, seconds: float) -> None:
    """Keep how long it took to compile something, if JAX keeps what it compiles."""
    path = _times_file()
    if path is None or seconds < NOTICED:
        return
    with contextlib.suppress(OSError, InspeError):  # it is only an estimate
        write_text(path, json.dumps(_times() | {what: round(seconds, 1)}))


def waiting_words(seconds: float, usual: float) -> str:
    """What to tell somebody who waits for what compiles, for so long by now [s]."""
    if seconds < usual:
        return f"compiling: {seconds:.0f} s of about {usual:.0f} s"
    return f"compiling: {seconds:.0f} s, longer than the usual {usual:.0f} s"


def _times() -> dict[str, float]:
    path = _times_file()
    try:
        found = json.loads(path.read_text()) if path is not None else {}
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _times_file() -> Path | None:
    folder = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    return None if folder is None else Path(folder) / TIMES
