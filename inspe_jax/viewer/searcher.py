"""Runs a search on a thread beside the page. It stops at once, with its best layout so far: XLA
compiles and scores without a way to interrupt it, so the thread of a search that is stopped is left
alone, and ends when it next reports."""

import math
import threading
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from inspe_jax.core.errors import InspeError
from inspe_jax.placement.constraints import Constraints
from inspe_jax.placement.objective import Objective
from inspe_jax.placement.optimise import named_optimised, optimise
from inspe_jax.placement.problem import Case
from inspe_jax.sensing.layout import Layout


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


class _Stopped(Exception):
    """The search was stopped: its thread ends here."""


class Searcher:
    """Runs one search at a time; ``running`` is true until ``ended`` is called.

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
        self._closed = False
        self._best: tuple[Layout, float] | None = None
        self._first = 0.0  # score of the start
        self.thread: threading.Thread | None = None  # of the search that runs, if one does

    @property
    def running(self) -> bool:
        """Whether a search runs."""
        return self.thread is not None

    def start(self, layout: Layout, method: str, seconds: float, target: float = math.inf) -> None:
        """Start a search, if none runs. It also ends with a score of ``target`` or more."""
        search = dict(layout=layout, method=method, seconds=seconds, target=target)
        with self._lock:
            if not (self.running or self._closed):
                self._best, self._first = None, 0.0
                thread = threading.Thread(target=self._search, kwargs=search, daemon=True)
                thread.start()
                self.thread = thread

    def stop(self) -> None:
        """End the search now, whatever it is doing, with the best layout so far."""
        with self._lock:
            if self.running:
                self._end("interrupted")

    def close(self) -> None:
        """Stop the search, and start no other."""
        with self._lock:
            self._closed = True
            self.stop()

    def _search(self, **options: Any) -> None:
        """A search from its begin to its end, on its thread."""
        try:
            result = optimise(
                self.case,
                objective=self.objective,
                constraints=self.constraints,
                progress=partial(self._tell, self._progress),
                found=partial(self._tell, self._keep),
                **options,
            )
            scores = result.objective_before, result.objective
            ending = SearchEnding(result.layout, *scores, result.status, notes=result.notes)
            end = partial(self._end_with, ending)
        except _Stopped:
            return
        except Exception as e:
            end = partial(self._fail, e)
        with self._lock:
            if threading.current_thread() is self.thread:
                end()

    def _fail(self, error: Exception) -> None:
        why = str(error)
        if not isinstance(error, InspeError):
            traceback.print_exception(error)
            why = f"the search failed: {error!r}"
        self._end(why, failed=True)

    def _tell(self, listener: Callable[..., None], *content: Any) -> None:
        """Call a listener, unless the search has been stopped."""
        with self._lock:
            if threading.current_thread() is not self.thread:
                raise _Stopped
            listener(*content)

    def _keep(self, layout: Layout, score: float) -> None:
        if self._best is None:
            self._first = score
        self._best = layout, score
        self._found(layout, score)

    def _end(self, reason: str, *, failed: bool = False) -> None:
        """Report the end of a search that has no result."""
        if self._best is None:
            reason = reason if failed else "stopped before there was a score"
        layout, score = self._best or (None, 0.0)
        layout = None if layout is None else named_optimised(layout)
        self._end_with(SearchEnding(layout, self._first, score, reason, failed))

    def _end_with(self, ending: SearchEnding) -> None:
        self.thread = None
        self._ended(ending)
