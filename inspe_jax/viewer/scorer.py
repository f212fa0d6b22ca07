"""Scores the newest layout while it is dragged: on a few frames first, and then on all."""

import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import UInt

from inspe_jax.core.errors import InspeError
from inspe_jax.placement.objective import Objective
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
