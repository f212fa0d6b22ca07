"""Runs a search in a process beside the page. It stops at once, with its best layout so far.

The process can be killed while XLA compiles. It runs :func:`main`, which reads searches from its
input, pickled arguments of :func:`~inspe_jax.placement.optimise.optimise` by name. For each it
writes messages to its output, pickled tuples of a kind and its content:

- ``("ready",)`` once
- ``("progress", fraction of the budget that is spent, best score)``
- ``("found", layout, score)`` with every layout that is the best so far
- ``("ended", result)`` or ``("failed", why)`` at the end

It ends when its input does, and has the metrics that ``import inspe_jax`` registers; an objective
with weight on another one fails in it.
"""

import contextlib
import math
import os
import pickle
import signal
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from queue import SimpleQueue
from typing import IO, Any, TypeAlias

import jax

from inspe_jax.core.compiling import CACHE_SETTINGS, leave
from inspe_jax.core.errors import InspeError
from inspe_jax.placement.constraints import Constraints
from inspe_jax.placement.objective import Objective
from inspe_jax.placement.optimise import named_optimised, optimise
from inspe_jax.placement.problem import Case
from inspe_jax.sensing.layout import Layout

NICE = 5  # how much the search's priority is lowered, so that the page gets the cores first
PATIENCE = 0.4  # time that a process gets to end by itself before it is killed [s]
KILLED = -9  # exit status of a process that the system killed; does not occur on Windows
PROCESS_ENVIRONMENT = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
"""Of the search's process: the page's process already has most of a graphics card's memory."""
SETTINGS = (*CACHE_SETTINGS, "jax_enable_x64")
"""Settings of JAX that it takes over from this one, through its environment."""

Process: TypeAlias = "subprocess.Popen[bytes]"


@dataclass(frozen=True)
class SearchEnding:
    """How a search ended: the best ``layout`` found, or None, the scores of the start and of that
    layout, the ``reason``, such as a status, and the ``notes`` of its result."""

    layout: Layout | None
    before: float
    after: float
    reason: str
    failed: bool = False
    notes: tuple[str, ...] = ()

    @property
    def gain(self) -> float:
        """What the score has gained over the start."""
        return self.after - self.before

    def words(self, seconds: float) -> str:
        """Why it ended, and what it has gained in so many ``seconds``, for the page."""
        if self.layout is None:
            return f"{self.reason}, after {seconds:.0f} s"
        gained = f"{self.before:.4f} → {self.after:.4f} ({self.gain:+.4f})"
        score = gained if self.gain > 0 else f"stays at {self.before:.4f}"
        return f"{self.reason}: P_sm {score} in {seconds:.0f} s, with compiling"


class Searcher:
    """Runs one search at a time; ``running`` is true until ``ended`` is called.

    Its process is kept for the next search, which then finds programs compiled already.

    Three functions are called on a thread of its own: ``progress`` with the fraction of the budget
    spent and the best score, ``found`` with every best layout so far and its score, ``ended`` once.
    """

    def __init__(
        self,
        case: Case,
        objective: Objective,
        constraints: Constraints,
        *,
        progress: Callable[[float, float], None],
        found: Callable[[Layout, float], None],
        ended: Callable[[SearchEnding], None],
    ) -> None:
        self.case, self.constraints = case, constraints
        self.objective = replace(objective, metrics=())  # which only results have
        self._progress, self._found, self._ended = progress, found, ended
        self._lock = threading.RLock()
        self._process: Process | None = None
        self._closed = self._ready = False
        self._best: tuple[Layout, float] | None = None
        self._first = 0.0  # score of the start
        self.running = False

    def start(self, layout: Layout, method: str, seconds: float, target: float = math.inf) -> None:
        """Start a search, if none runs. It also ends with a score of ``target`` or more."""
        search = dict(
            scene=self.case, layout=layout, method=method, seconds=seconds, target=target,
            objective=self.objective, constraints=self.constraints,
        )  # fmt: skip
        with self._lock:
            if self.running or self._closed:
                return
            self.running, self._best = True, None
            try:
                given = pickle.dumps(search)
                process = self._warm()
            except Exception as e:  # such as a metric that cannot be pickled, or no memory
                self._end(f"the search could not be started: {e}", failed=True)
                return
            # The process reads only once it has started; the caller should not wait for that.
            threading.Thread(target=_write, args=(process, given), daemon=True).start()

    def stop(self) -> None:
        """End the search now, whatever it is doing, with the best layout so far."""
        with self._lock:
            if self.running:
                self._end_process()
                self._end("interrupted")
                self._warm()  # for the next

    def close(self) -> None:
        """Stop the search, and end the process."""
        with self._lock:
            self._closed = True
            self._end_process()
            if self.running:
                self._end("interrupted")

    def _warm(self) -> Process:
        """The process, which is started if there is none: a search need not wait for it."""
        if self._process is None:
            set_here = {name.upper(): getattr(jax.config, name) for name in SETTINGS}
            settings = {name: str(value) for name, value in set_here.items() if value is not None}
            # -P: modules are not looked for in the folder that the user works in.
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "inspe_jax.viewer.searcher"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                env=os.environ | PROCESS_ENVIRONMENT | settings,
                start_new_session=True,  # Ctrl-C is for the page
            )
            self._ready = False
            threading.Thread(target=self._listen, args=(self._process,), daemon=True).start()
        return self._process

    def _end_process(self) -> None:
        process, self._process = self._process, None
        if process is None:
            return
        if self._ready:  # it ends when its input does, but not in the midst of writing a file
            _write(process, b"")
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(PATIENCE)
        process.kill()
        _write(process, b"")
        process.wait()

    def _end(self, reason: str, *, failed: bool = False) -> None:
        """Report the end of a search that has no result."""
        self.running = False
        if self._best is None:
            reason = reason if failed else "stopped before there was a score"
            self._ended(SearchEnding(None, 0.0, 0.0, reason, failed))
        else:
            layout, score = self._best
            self._ended(SearchEnding(named_optimised(layout), self._first, score, reason, failed))

    def _listen(self, process: Process) -> None:
        assert process.stdout is not None
        with process.stdout as source:
            while True:
                try:
                    message = pickle.load(source)
                except Exception:  # mostly the end of the stream
                    break
                with self._lock:
                    if process is not self._process:  # it was ended meanwhile
                        continue
                    self._ready = True
                    if self.running:
                        self._receive(*message)
        with self._lock:
            if process is not self._process:
                return
            self._end_process()
            if self.running:
                status = process.returncode
                killed = status == KILLED
                why = "killed, as happens when memory runs out" if killed else f"status {status}"
                self._end(f"the search's process ended by itself ({why})", failed=True)

    def _receive(self, kind: str, *content: Any) -> None:
        if kind == "progress":
            self._progress(*content)
        elif kind == "found":
            if self._best is None:
                self._first = content[1]
            self._best = content
            self._found(*content)
        elif kind == "failed":
            self._end(content[0], failed=True)
        elif kind == "ended":
            result, self.running = content[0], False
            scores = result.objective_before, result.objective
            self._ended(SearchEnding(result.layout, *scores, result.status, notes=result.notes))


def _write(process: Process, search: bytes) -> None:
    """Send a search to its process, or without one end its input. That the process has ended is
    found by who listens to it."""
    assert process.stdin is not None
    with contextlib.suppress(OSError, ValueError):
        if search:
            process.stdin.write(search)
            process.stdin.flush()
        else:
            process.stdin.close()  # what it has not read is lost


# ── In the process ──


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
