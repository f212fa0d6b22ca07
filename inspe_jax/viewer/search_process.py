"""A search in a process of its own, which can be ended at once, whatever it is doing.

XLA compiles for many seconds and cannot be interrupted, but a process can be killed.
:class:`~inspe_jax.viewer.searcher.Searcher` runs it as
``python -m inspe_jax.viewer.search_process``. It reads pickled :class:`SearchTask` records from
its input. For each it writes messages to its output, pickled tuples of a kind and its content:

- ``("ready",)`` once
- ``("progress", fraction of the budget that is spent, best score)``
- ``("found", layout, score)`` with every layout that is the best so far
- ``("compiling", seconds so far)`` while it compiles
- ``("ended", result)`` or ``("failed", why)`` at the end

The process ends when its input does. It has the metrics that ``import inspe_jax`` registers; an
objective with weight on another one fails in it.
"""

import os
import pickle
import signal
import sys
import threading
import time
import traceback
from functools import partial
from queue import SimpleQueue
from typing import IO, Any, NamedTuple

import jax

from inspe_jax.core.compiling import compiled, leave
from inspe_jax.core.errors import InspeError
from inspe_jax.placement.optimise import optimise

SETTINGS = (
    "jax_compilation_cache_dir",
    "jax_compilation_cache_max_size",
    "jax_enable_compilation_cache",
    "jax_enable_x64",
    "jax_persistent_cache_min_compile_time_secs",
)
"""Settings of JAX that a search takes over from the page's process."""
EVERY = 0.25
"""Time between two messages that it compiles [s]."""
NICE = 5
"""How much the search's priority is lowered, so that the page gets the cores first."""


class SearchTask(NamedTuple):
    """A search: the ``arguments`` of :func:`~inspe_jax.placement.optimise.optimise` by name, and
    the ``settings`` of JAX."""

    arguments: dict[str, Any]
    settings: dict[str, Any]


def search_task(**arguments: Any) -> SearchTask:
    """A search with these arguments, and with the settings of this process."""
    return SearchTask(arguments, {name: getattr(jax.config, name) for name in SETTINGS})


class _MessageWriter:
    """Writes messages to the page's process, from any thread."""

    def __init__(self, sink: IO[bytes]) -> None:
        self._sink, self._lock = sink, threading.Lock()
        self.compiled = 0.0  # compile time before the present search began [s]

    def send(self, *message: object) -> None:
        with self._lock:
            pickle.dump(message, self._sink)
            self._sink.flush()


def main() -> None:
    """Run the searches that come in, until the input ends."""
    out = _MessageWriter(os.fdopen(os.dup(1), "wb"))
    os.dup2(2, 1)  # what libraries print must not look like a message
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends the page's process
    if hasattr(os, "nice"):  # not on Windows
        os.nice(NICE)
    tasks = SimpleQueue[SearchTask]()
    threading.Thread(target=_read, args=(sys.stdin.buffer, tasks), daemon=True).start()
    out.send("ready")
    threading.Thread(target=_report_compiling, args=(out,), daemon=True).start()
    while True:
        _search(tasks.get(), out)


def _read(source: IO[bytes], tasks: SimpleQueue[SearchTask]) -> None:
    """Read the input on a thread of its own: at its end the process ends at once."""
    while True:
        try:
            tasks.put(pickle.load(source))
        except EOFError:
            leave(0)
        except Exception as e:
            traceback.print_exception(e)
            leave(1)


def _search(task: SearchTask, out: _MessageWriter) -> None:
    for name, value in task.settings.items():
        jax.config.update(name, value)
    out.compiled = compiled().seconds
    try:
        result = optimise(
            **task.arguments,
            progress=partial(out.send, "progress"),
            found=partial(out.send, "found"),
        )
    except InspeError as e:
        out.send("failed", str(e))
    except Exception as e:
        traceback.print_exception(e)
        out.send("failed", f"the search failed: {e!r}")
    else:
        out.send("ended", result)


def _report_compiling(out: _MessageWriter) -> None:
    while True:
        time.sleep(EVERY)
        state = compiled()
        if state.now:
            out.send("compiling", state.seconds - out.compiled)


if __name__ == "__main__":
    main()
