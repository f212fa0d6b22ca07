"""What XLA compiles in this process: how many programs, for how long, and whether it does now.

Progress displays use it to tell users what they are waiting for. It is measured from the events
that JAX records.
"""

import contextlib
import json
import os
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import NoReturn

import jax
import jax.monitoring

from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import write_text

TRACED = "/jax/core/compile/jaxpr_trace_duration"
"""Event that JAX records when a function has been traced."""
LOWERED = "/jax/core/compile/jaxpr_to_mlir_module_duration"
"""Event when its program goes to XLA."""
COMPILED = "/jax/core/compile/backend_compile_duration"
"""Event when the program is compiled, or read from the cache on disk."""


@dataclass(frozen=True)
class Compiled:
    """Number of ``programs`` compiled so far, in ``seconds`` of wall time with tracing.

    ``now`` tells whether one is being compiled at this moment.
    """

    programs: int
    seconds: float
    now: bool


class _Watch:
    """Counts the programs that are compiled since it was created."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._programs = 0
        # Times at which something was traced or compiled, in order and without overlaps.
        self._stretches: list[tuple[float, float]] = []
        self._seconds = 0.0  # sum of all stretches
        self._since: dict[int, float] = {}  # when XLA began, by the thread that waits for it
        self._whole: set[int] = set()  # threads whose whole time counts

    def hear(self, event: str, duration_secs: float, **_: str | int) -> None:
        """Listens to JAX's events. The thread that waits for a program records its events."""
        if event not in (TRACED, LOWERED, COMPILED):
            return
        thread, now = threading.get_ident(), time.monotonic()
        with self._lock:
            self._programs += event == COMPILED
            if thread in self._whole:
                return
            if event == LOWERED:
                self._since[thread] = now
            else:
                self._since.pop(thread, None)
            self._add(now - duration_secs, now)

    @contextlib.contextmanager
    def whole(self) -> Iterator[None]:
        """Count all time of this thread in the block, with tracing from its beginning on."""
        thread, began = threading.get_ident(), time.monotonic()
        with self._lock:
            self._whole.add(thread)
            self._since[thread] = began
        try:
            yield
        finally:
            with self._lock:
                self._whole.discard(thread)
                self._since.pop(thread, None)
                self._add(began, time.monotonic())

    def _add(self, begin: float, end: float) -> None:
        """Add a stretch of time that ends last; it may contain earlier stretches."""
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
            seconds = self._seconds
            if self._since:
                since = min(self._since.values())
                for first, last in reversed(self._stretches):
                    if last <= since:
                        break
                    seconds -= last - max(first, since)
                seconds += time.monotonic() - since
            return Compiled(self._programs, seconds, bool(self._since))


_watch = _Watch()
jax.monitoring.register_event_duration_secs_listener(_watch.hear)


def compiled() -> Compiled:
    """What this process has compiled since this module was imported."""
    return _watch.compiled()


def counts_as_compiling() -> contextlib.AbstractContextManager[None]:
    """Count all time of this thread in the block as compiling: for a thread that only compiles."""
    return _watch.whole()


# ── About how long it takes ─────────────────────────────────────────────────

TIMES = "compile_times.json"
"""File in JAX's cache folder: seconds that compiling took the last time, by purpose."""
NOTICED = 1.0
"""Faster compiling is not remembered, because the program was read from the cache [s]."""


def usual_seconds(what: str, default: float) -> float:
    """Seconds that compiling ``what`` took last time on this machine; ``default`` if unknown."""
    try:
        return float(_times()[what])
    except (KeyError, TypeError, ValueError):
        return default


def remember_seconds(what: str, seconds: float) -> None:
    """Remember the seconds that compiling ``what`` took, if JAX has a cache on disk."""
    path = _times_file()
    if path is None or seconds < NOTICED:
        return
    with contextlib.suppress(OSError, InspeError):  # it is only an estimate
        write_text(path, json.dumps(_times() | {what: round(seconds, 1)}))


def waiting_words(seconds: float, usual: float) -> str:
    """The message to a user who has waited ``seconds`` for compiling that takes ``usual`` [s]."""
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


# ── Ending the process while something is compiled ──────────────────────────

CACHE = "lru_cache.py"
"""The file of JAX's code that writes its cache."""
WRITING = 0.3
"""Longest time to wait for a write to the cache at the end [s]."""


def leave(status: int) -> NoReturn:
    """End the process now, but wait briefly while JAX writes to its cache on disk.

    JAX writes a cache file in place, and never again: an incomplete file would stay unusable.
    """
    deadline = time.monotonic() + WRITING
    while time.monotonic() < deadline and any(map(_is_writing, sys._current_frames().values())):
        time.sleep(0.005)
    os._exit(status)


def _is_writing(frame: FrameType | None) -> bool:
    """Whether a thread is writing to JAX's cache."""
    while frame is not None:
        if frame.f_code.co_filename.endswith(CACHE) and frame.f_code.co_name == "put":
            return True
        frame = frame.f_back
    return False
