"""A search in a process of its own, which can be killed while XLA compiles.

:class:`~inspe_jax.viewer.searcher.Searcher` runs it. It reads searches from its input, the
arguments of :func:`~inspe_jax.placement.optimise.optimise` by name, pickled. For each it writes
messages to its output, pickled tuples of a kind and its content:

- ``("ready",)`` once
- ``("progress", fraction of the budget that is spent, best score)``
- ``("found", layout, score)`` with every layout that is the best so far
- ``("ended", result)`` or ``("failed", why)`` at the end

The process ends when its input does. It has the metrics that ``import inspe_jax`` registers; an
objective with weight on another one fails in it.
"""

import os
import pickle
import signal
import sys
import threading
import traceback
from collections.abc import Callable
from functools import partial
from queue import SimpleQueue
from typing import IO, Any

from inspe_jax.core.compiling import leave
from inspe_jax.core.errors import InspeError
from inspe_jax.placement.optimise import optimise

NICE = 5
"""How much the search's priority is lowered, so that the page gets the cores first."""


def main() -> None:
    """Run the searches that come in, until the input ends."""
    sink, lock = os.fdopen(os.dup(1), "wb"), threading.Lock()
    os.dup2(2, 1)  # what libraries print must not look like a message
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends the page's process
    if hasattr(os, "nice"):  # not on Windows
        os.nice(NICE)

    def send(*message: object) -> None:
        with lock:
            pickle.dump(message, sink)
            sink.flush()

    searches = SimpleQueue[dict[str, Any]]()
    threading.Thread(target=_read, args=(sys.stdin.buffer, searches), daemon=True).start()
    send("ready")
    while True:
        _search(searches.get(), send)


def _read(source: IO[bytes], searches: SimpleQueue[dict[str, Any]]) -> None:
    """Read the input on a thread of its own: at its end the process ends at once."""
    while True:
        try:
            searches.put(pickle.load(source))
        except EOFError:
            leave(0)
        except Exception as e:
            traceback.print_exception(e)
            leave(1)


def _search(arguments: dict[str, Any], send: Callable[..., None]) -> None:
    try:
        result = optimise(
            **arguments, progress=partial(send, "progress"), found=partial(send, "found")
        )
    except InspeError as e:
        send("failed", str(e))
    except Exception as e:
        traceback.print_exception(e)
        send("failed", f"the search failed: {e!r}")
    else:
        send("ended", result)


if __name__ == "__main__":
    main()
