"""A search in a process of its own, which can be ended at once, whatever it is at.

XLA cannot be interrupted while it compiles, and it compiles for many seconds; a process can. Run as
``python -m inspe_jax.viewer.search_process`` by :class:`~inspe_jax.viewer.searcher.Searcher`: a
pickled :class:`Task` after the other comes in, and of each a row of messages goes out, each a
pickled tuple of a word and what belongs to it:

- ``("ready",)`` once
- ``("progress", share of the budget that is spent, best score)``
- ``("found", layout, score)`` with every layout that is the best so far
- ``("compiling", seconds so far)`` while it compiles
- ``("ended", result)`` or ``("failed", why)`` at the end

The process ends when its input does.
"""

import os
import pickle
import signal
import sys
import threading
import time
import traceback
from dataclasses import dataclass, field
from typing import IO, Any

import jax

from inspe_jax.core.compiling import compiled, leave, remember_seconds
from inspe_jax.core.errors import InspeError
from inspe_jax.placement.constraints import Constraints
from inspe_jax.placement.optimise import optimise
from inspe_jax.placement.problem import Case, Objective
from inspe_jax.sensing.layout import Layout

SETTINGS = (
    "jax_compilation_cache_dir",
    "jax_compilation_cache_max_size",
    "jax_enable_compilation_cache",
    "jax_enable_x64",
    "jax_persistent_cache_min_compile_time_secs",
)
"""Settings of JAX that a search takes over from the process that asks for it."""
EVERY = 0.25
"""Between two messages that it compiles [s]."""
NICE = 5
"""How far behind a page a search stands in line for the cores."""


@dataclass(frozen=True)
class Task:
    """A search: see :func:`~inspe_jax.placement.optimise.optimise`. Compiling is not part of
    ``seconds``."""

    case: Case
    layout: Layout
    method: str
    seconds: float
    objective: Objective
    constraints: Constraints
    settings: dict[str, Any] = field(
        default_factory=lambda: {name: getattr(jax.config, name) for name in SETTINGS}
    )


class _Out:
    """Messages to the process that asked, from any thread.

    ``compiled`` is what was compiled before the present search began [s].
    """

    def __init__(self, sink: IO[bytes]) -> None:
        self._sink, self._lock = sink, threading.Lock()
        self.compiled = 0.0

    def tell(self, *message: object) -> None:
        with self._lock:
            pickle.dump(message, self._sink)
            self._sink.flush()


def main() -> None:
    """Search for whoever writes to the input, until it ends."""
    out = _Out(os.fdopen(os.dup(1), "wb"))
    os.dup2(2, 1)  # what others print is no message
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the page's process
    if hasattr(os, "nice"):  # not on Windows
        os.nice(NICE)
    tasks = _Tasks(sys.stdin.buffer)
    out.tell("ready")
    threading.Thread(target=_tell_compiling, args=(out,), daemon=True).start()
    while True:
        _search(tasks.next(), out)


class _Tasks:
    """What comes in, read beside the search: at its end the process ends at once."""

    def __init__(self, source: IO[bytes]) -> None:
        self._source = source
        self._waiting: list[Task] = []
        self._changed = threading.Condition()
        threading.Thread(target=self._read, daemon=True).start()

    def next(self) -> Task:
        with self._changed:
            self._changed.wait_for(lambda: self._waiting)
            return self._waiting.pop(0)

    def _read(self) -> None:
        while True:
            try:
                task = pickle.load(self._source)
            except EOFError:
                leave(0)
            except Exception as e:
                traceback.print_exception(e)
                leave(1)
            with self._changed:
                self._waiting.append(task)
                self._changed.notify()


def _search(task: Task, out: _Out) -> None:
    for name, value in task.settings.items():
        jax.config.update(name, value)
    out.compiled = before = compiled().seconds
    try:
        result = optimise(
            task.case,
            task.layout,
            task.method,
            task.seconds,
            objective=task.objective,
            constraints=task.constraints,
            progress=lambda done, best: out.tell("progress", done, best),
            found=lambda layout, score: out.tell("found", layout, score),
            clock=lambda: time.monotonic() - (compiled().seconds - before),
        )
    except InspeError as e:
        out.tell("failed", str(e))
    except Exception as e:
        traceback.print_exception(e)
        out.tell("failed", f"the search failed: {e!r}")
    else:
        remember_seconds(f"search by {task.method}", compiled().seconds - before)
        out.tell("ended", result)


def _tell_compiling(out: _Out) -> None:
    while True:
        time.sleep(EVERY)
        state = compiled()
        if state.now:
            out.tell("compiling", state.seconds - out.compiled)


if __name__ == "__main__":
    main()
