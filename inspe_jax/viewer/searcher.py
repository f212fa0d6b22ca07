"""Runs a search in a process beside the page. It stops at once, with its best layout so far."""

import contextlib
import math
import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from inspe_jax.placement.constraints import Constraints
from inspe_jax.placement.objective import Objective
from inspe_jax.placement.optimise import named_optimised
from inspe_jax.placement.problem import Case
from inspe_jax.scoring.detection import DetectionCurves
from inspe_jax.scoring.metrics import Weights
from inspe_jax.sensing.layout import Layout
from inspe_jax.viewer.search_process import SearchTask, search_task

PATIENCE = 0.4
"""Time that a process gets to end by itself before it is killed [s]."""
KILLED, KILLED_WORDS = -9, "killed, as happens when memory runs out"
"""Exit status of a process that the system killed; does not occur on Windows."""
PROCESS_ENVIRONMENT = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
"""Of the search's process: the page's process already has most of a graphics card's memory."""


REASONS = {
    "converged": "ended, as it finds nothing better",
    "budget spent": "ended, as its time is over",
    "interrupted": "stopped",
    "target reached": "target reached",
}
"""How a search has ended, by its status."""


@dataclass(frozen=True)
class SearchEnding:
    """How a search ended.

    ``layout`` is the best one found, or None; ``before`` and ``after`` are the scores of the start
    and of that layout; ``reason`` says why it ended; ``notes`` are those of its result.
    """

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

    Searches run in a process beside this one. It is kept for the next search, which then finds
    the programs that are compiled already.

    Four functions are called on a thread of its own: ``progress`` with the fraction of the budget
    that is spent and the best score, ``found`` with every layout that is the best so far and its
    score, ``compiling`` with the time that compiling has taken so far [s], ``ended`` once.
    """

    def __init__(
        self,
        case: Case,
        weights: Weights,
        constraints: Constraints,
        *,
        progress: Callable[[float, float], None],
        found: Callable[[Layout, float], None],
        compiling: Callable[[float], None],
        ended: Callable[[SearchEnding], None],
        detection: DetectionCurves | None = None,
    ) -> None:
        self.case, self.constraints = case, constraints
        self.objective = Objective(weights=weights, detection=detection)
        self._progress, self._found, self._compiling = progress, found, compiling
        self._ended, self._lock = ended, threading.RLock()
        self._process: subprocess.Popen[bytes] | None = None
        self._closed = self._ready = False
        self._best: tuple[Layout, float] | None = None
        self._first = 0.0  # score of the start
        self.running = False

    @property
    def gain(self) -> float:
        """What the objective has gained over the start so far."""
        best = self._best
        return 0.0 if best is None else best[1] - self._first

    def warm(self) -> None:
        """Start the process ahead of time, so that a search does not wait for it."""
        with self._lock:
            if self._process is not None or self._closed:
                return
            # -P: modules are not looked for in the folder that the user works in.
            command = [sys.executable, "-P", "-m", "inspe_jax.viewer.search_process"]
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                env=os.environ | PROCESS_ENVIRONMENT,
                start_new_session=True,  # Ctrl-C is for the page
            )
            self._ready = False
            threading.Thread(
                target=self._listen, args=(self._process,), name="search", daemon=True
            ).start()

    def start(self, layout: Layout, method: str, seconds: float, target: float = math.inf) -> None:
        """Start a search from a layout, which also ends with a score of ``target`` or more. Does
        nothing while another one runs."""
        with self._lock:
            if self.running or self._closed:
                return
            self.running, self._best = True, None
            try:
                self.warm()
            except OSError as e:
                self._end(f"no process could be started for the search: {e.strerror}", failed=True)
                return
            task = search_task(
                scene=self.case, layout=layout, method=method, seconds=seconds, target=target,
                objective=self.objective, constraints=self.constraints,
            )  # fmt: skip
            # The process reads only once it has started; the caller should not wait for that.
            threading.Thread(target=self._send, args=(self._process, task), daemon=True).start()

    def stop(self) -> None:
        """End the search now, whatever it is doing, with the best layout so far."""
        with self._lock:
            if not self.running:
                return
            self._end_process()
            self._end(REASONS["interrupted"])
        self.warm()  # for the next

    def close(self) -> None:
        """Stop the search, and end the process."""
        with self._lock:
            self._closed = True
            self._end_process()
            if self.running:
                self._end(REASONS["interrupted"])

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

    def _end(self, reason: str, *, failed: bool = False) -> None:
        """Report the end of a search that has no result."""
        self.running = False
        if self._best is None:
            reason = reason if failed else "stopped before there was a score"
            self._ended(SearchEnding(None, 0.0, 0.0, reason, failed))
        else:
            layout, score = self._best
            self._ended(SearchEnding(named_optimised(layout), self._first, score, reason, failed))

    def _send(self, process: "subprocess.Popen[bytes]", task: SearchTask) -> None:
        """Send a search to its process. If the process has ended, :meth:`_listen` reports it."""
        assert process.stdin is not None
        try:
            process.stdin.write(pickle.dumps(task))
            process.stdin.flush()
        except (OSError, ValueError):  # ended, closed
            return
        except Exception as e:
            with self._lock:
                if process is self._process and self.running:
                    self._end(f"the search could not be sent to its process: {e}", failed=True)

    def _listen(self, process: "subprocess.Popen[bytes]") -> None:
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
            process.kill()
            self._process, status = None, _release(process)
            if self.running:
                why = KILLED_WORDS if status == KILLED else f"status {status}"
                self._end(f"the search's process ended by itself ({why})", failed=True)

    def _receive(self, kind: str, *content: Any) -> None:
        if kind == "progress":
            self._progress(*content)
        elif kind == "compiling":
            self._compiling(*content)
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
            self._ended(
                SearchEnding(result.layout, *scores, REASONS[result.status], notes=result.notes)
            )


def _release(process: "subprocess.Popen[bytes]") -> int:
    """Wait for a process that is ending; returns its exit status."""
    assert process.stdin is not None
    with contextlib.suppress(OSError):  # what it has not read is lost
        process.stdin.close()
    return process.wait()
