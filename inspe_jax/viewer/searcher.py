"""A search beside the page: stopped at once, and what it has found so far is told at once."""

import contextlib
import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from inspe_jax.placement.constraints import Constraints
from inspe_jax.placement.optimise import named_optimised
from inspe_jax.placement.problem import Case, Objective
from inspe_jax.placement.result import STATUSES
from inspe_jax.scoring.metrics import Weights
from inspe_jax.sensing.layout import Layout
from inspe_jax.viewer.search_process import Task

PATIENCE = 0.4
"""How long a process may take to end by itself before it is killed [s]."""
KILLED = -9
"""Status of a process that the system killed; none on Windows."""
SHARED = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
"""For the process: on a graphics card, the page's has most of the memory already."""


@dataclass(frozen=True)
class Ending:
    """How a search ended: its best ``layout`` so far, or None; what it gained by its objective.

    ``words`` say how it came to its end, and whether it ``failed``; ``notes`` are those of its
    result.
    """

    layout: Layout | None
    gain: float
    words: str
    failed: bool = False
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Heard:
    """What a search tells, from a thread of its own.

    ``progress`` with the share of the budget spent and the best score; ``found`` with every
    layout that is the best so far and its score; ``compiling`` while it compiles, with how long it
    has so far [s]; ``ended`` once.
    """

    progress: Callable[[float, float], None]
    found: Callable[[Layout, float], None]
    compiling: Callable[[float], None]
    ended: Callable[[Ending], None]


class Searcher:
    """One search at a time; ``running`` until its end is told.

    Searches run in a process beside this one, which is kept from one to the next: what is compiled
    for one serves the others.
    """

    def __init__(
        self,
        case: Case,
        weights: Weights,
        constraints: Constraints,
        heard: Heard,
    ) -> None:
        self.case, self.weights, self.constraints = case, weights, constraints
        self._heard, self._lock = heard, threading.RLock()
        self._process: subprocess.Popen[bytes] | None = None
        self._closed = self._ready = False
        self._best: tuple[Layout, float] | None = None
        self._first = 0.0  # the start's score
        self.running = False

    @property
    def gain(self) -> float:
        """What the search has gained so far, by its objective."""
        best = self._best
        return 0.0 if best is None else best[1] - self._first

    def warm(self) -> None:
        """Start the process, so that a search need not wait for it."""
        with self._lock:
            if self._process is not None or self._closed:
                return
            # -P: modules are not looked for in the folder that the user works in.
            command = [sys.executable, "-P", "-m", "inspe_jax.viewer.search_process"]
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                env=os.environ | SHARED,
                start_new_session=True,  # Ctrl-C is for the page
            )
            self._ready = False
            threading.Thread(
                target=self._listen, args=(self._process,), name="search", daemon=True
            ).start()

    def start(self, layout: Layout, method: str, seconds: float) -> None:
        """Search from a layout; nothing where a search is under way."""
        with self._lock:
            if self.running or self._closed:
                return
            self.running, self._best = True, None
            try:
                self.warm()
            except OSError as e:
                self._end(f"no process can be started for it: {e.strerror}", failed=True)
                return
            objective = Objective(weights=self.weights)
            task = Task(self.case, layout, method, seconds, objective, self.constraints)
            # The process reads once it has started, for which nobody should wait.
            threading.Thread(target=self._send, args=(self._process, task), daemon=True).start()

    def stop(self) -> None:
        """End the search now, with the best so far, whatever it is at."""
        with self._lock:
            if not self.running:
                return
            self._end_process()
            self._end(STATUSES["interrupted"])
        self.warm()  # for the next

    def close(self) -> None:
        """Stop, and end the process."""
        with self._lock:
            self._closed = True
            self._end_process()
            if self.running:
                self._end(STATUSES["interrupted"])

    def _end_process(self) -> None:
        process, self._process = self._process, None
        if process is None:
            return
        if self._ready:  # it ends when its input does, but not in the midst of writing a file
            assert process.stdin is not None
            with contextlib.suppress(OSError, ValueError):
                process.stdin.close()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(PATIENCE)
        process.kill()
        _release(process)

    def _end(self, words: str, *, failed: bool = False) -> None:
        """Tell the end of a search that has no result."""
        self.running = False
        if self._best is None:
            words = words if failed else "stopped before there was a score"
            self._heard.ended(Ending(None, 0.0, words, failed))
        else:
            ending = Ending(named_optimised(self._best[0]), self.gain, words, failed)
            self._heard.ended(ending)

    def _send(self, process: "subprocess.Popen[bytes]", task: Task) -> None:
        """Hand a search to its process. Where that has ended, who listens to it tells."""
        assert process.stdin is not None
        try:
            process.stdin.write(pickle.dumps(task))
            process.stdin.flush()
        except (OSError, ValueError):  # ended, closed
            return
        except Exception as e:
            with self._lock:
                if process is self._process and self.running:
                    self._end(f"it cannot be handed to a process: {e}", failed=True)

    def _listen(self, process: "subprocess.Popen[bytes]") -> None:
        assert process.stdout is not None
        with process.stdout as source:
            while True:
                try:
                    message = pickle.load(source)
                except Exception:  # its end, mostly
                    break
                with self._lock:
                    if process is not self._process:  # it was ended meanwhile
                        continue
                    self._ready = True
                    if self.running:
                        self._hear(*message)
        with self._lock:
            if process is not self._process:
                return
            process.kill()
            self._process, status = None, _release(process)
            if self.running:
                self._end(f"the search's process ended by itself ({_reason(status)})", failed=True)

    def _hear(self, word: str, *told: Any) -> None:
        if word == "progress":
            self._heard.progress(*told)
        elif word == "compiling":
            self._heard.compiling(*told)
        elif word == "found":
            if self._best is None:
                self._first = told[1]
            self._best = told
            self._heard.found(*told)
        elif word == "failed":
            self._end(told[0], failed=True)
        elif word == "ended":
            result, self.running = told[0], False
            gain = result.objective - result.objective_before
            words = STATUSES[result.status]
            self._heard.ended(Ending(result.layout, gain, words, notes=result.notes))


def _release(process: "subprocess.Popen[bytes]") -> int:
    """Wait for a process that is ending, and give its status."""
    assert process.stdin is not None
    with contextlib.suppress(OSError):  # what it has not read is lost
        process.stdin.close()
    return process.wait()


def _reason(status: int) -> str:
    """What a process's status says."""
    if status == KILLED:
        return "killed, as it is where memory runs out"
    return f"status {status}"
