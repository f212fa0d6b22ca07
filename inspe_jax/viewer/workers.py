"""What computes beside the page, on threads of its own: scores of the newest layout, and a search.

A layout that is dragged is scored on a few frames first, and then on all. A search stops at once,
with its best layout so far: XLA compiles and scores without a way to interrupt it, so the thread of
a search that is stopped is left alone, and ends when it next reports.
"""

import math
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import UInt

from inspe_jax.core.errors import InspeError
from inspe_jax.placement.constraints import Constraints
from inspe_jax.placement.objective import Objective
from inspe_jax.placement.optimise import named_optimised, optimise
from inspe_jax.placement.problem import Case
from inspe_jax.report.tables import scores_of
from inspe_jax.scoring.evaluate import Scores
from inspe_jax.scoring.viewshed import sight_in
from inspe_jax.sensing.layout import Layout
from inspe_jax.viewer.job_queue import JobQueue

SHOWN = 20  # number of frames that are scored first, evenly spread over all
LONGEST_REST = 0.3
"""From one scoring to the next while a sensor is dragged, at most [s]: the first one compiles."""


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class ScoredLayout:
    """The exact scores of a layout on a number of ``frames``, ``seconds`` after it was given.
    ``scores`` is None if the layout cannot be scored; ``wrong`` then says why."""

    layout: Layout
    scores: Scores | None
    frames: int
    seconds: float
    wrong: str = ""


class Scorer:
    """Scores the newest layout, and finds which voxels it sees in the selected frame, on a thread
    of its own. Scores of a layout that is already out of date are not begun."""

    def __init__(
        self,
        case: Case,
        objective: Objective,
        scored: Callable[[ScoredLayout], None],
        sighted: Callable[[int, UInt[np.ndarray, " V"]], None],
    ) -> None:
        """On the scorer's thread, ``scored`` gets scores, and ``sighted`` a frame with the
        Visibility of each voxel."""
        self.case, self._objective = case, objective
        self._scored, self._sighted = scored, sighted
        traffic = case.scene.traffic
        step = max(1, -(-traffic.frame_count // SHOWN))
        some = jax.tree.map(lambda leaf: leaf[::step], traffic)
        self.few = replace(case, scene=replace(case.scene, traffic=some))
        self._layout: Layout | None = None
        self._frame = 0
        self._hurry = threading.Event()
        self._queue = JobQueue(self._failed)

    def score(self, layout: Layout, *, whole: bool) -> None:
        """Score a layout on a few frames, and with ``whole`` on all; find which voxels it sees."""
        self._layout, since = layout, time.monotonic()
        self._hurry.clear()
        self._queue.drop("few", "sight", "whole")
        self._queue.submit(lambda: self._score_few(layout, since), key="few")
        self._queue.submit(self._find_sight, key="sight")
        if whole:
            self._queue.submit(lambda: self._score(self.case, layout, since), key="whole")
            self._hurry.set()

    def select_frame(self, frame: int) -> None:
        """Select the frame whose voxels are found from now on."""
        self._frame = frame
        self._queue.submit(self._find_sight, key="sight", first=True)

    def close(self, *, wait: bool = True) -> None:
        """End the thread, once it has done what it is at; with ``wait``, come back then."""
        self._hurry.set()
        self._queue.close(0, wait=wait)

    def _failed(self, wrong: Exception) -> None:
        if not isinstance(wrong, InspeError):  # else scores say why voxels are not found
            traceback.print_exception(wrong)

    def _score_few(self, layout: Layout, since: float) -> None:
        """While a sensor is dragged, half of the time is left to what else follows it."""
        begun = time.monotonic()
        self._score(self.few, layout, since)
        self._hurry.wait(min(time.monotonic() - begun, LONGEST_REST))

    def _score(self, case: Case, layout: Layout, since: float) -> None:
        scores, wrong = None, ""
        try:
            scores = scores_of(case, layout, self._objective)
        except InspeError as e:
            wrong = str(e)
        except Exception as e:  # such as out of memory: the next layout may succeed
            wrong = f"it could not be scored: {e!r}"
        frames = case.scene.traffic.frame_count
        self._scored(ScoredLayout(layout, scores, frames, time.monotonic() - since, wrong))

    def _find_sight(self) -> None:
        layout, frame, case = self._layout, self._frame, self.case
        if layout is not None:
            self._sighted(frame, sight_in(case.scene, layout, frame, conditions=case.conditions))


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
