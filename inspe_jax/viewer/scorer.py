"""Scores the newest layout while it is dragged, on a thread of its own: on a few frames first, and
then on all. Scores of a layout that is already out of date are not begun.
"""

import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np
from jaxtyping import UInt

from inspe_jax.core.errors import InspeError
from inspe_jax.placement.problem import Case
from inspe_jax.scoring.detection import DetectionCurves
from inspe_jax.scoring.evaluate import Scores, evaluate
from inspe_jax.scoring.metrics import Weights
from inspe_jax.scoring.viewshed import sight_in
from inspe_jax.sensing.layout import Layout

SHOWN = 20
"""Number of frames that are scored first, evenly spread over all."""
LONGEST_REST = 0.3
"""From one scoring to the next while a sensor is dragged, at most [s]: the first one compiles."""
_JOBS = ("end", "few", "sight", "whole")  # the first of them is done first


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
    """Scores the newest layout, and finds which voxels it sees in the selected frame."""

    def __init__(
        self,
        case: Case,
        weights: Weights,
        scored: Callable[[ScoredLayout], None],
        sighted: Callable[[Layout, int, UInt[np.ndarray, " V"]], None],
        metrics: Sequence[str] = (),
        detection: DetectionCurves | None = None,
    ) -> None:
        """The callbacks run on the scorer's thread.

        ``scored`` gets scores; ``sighted`` gets a layout, a frame and the Visibility of each voxel.
        ``weights``, ``metrics`` and ``detection`` as in :func:`inspe_jax.evaluate`.
        """
        self.case = case
        self._options: dict[str, Any] = dict(weights=weights, metrics=metrics, detection=detection)
        self._scored, self._sighted = scored, sighted
        traffic = case.scene.traffic
        step = max(1, -(-traffic.frame_count // SHOWN))
        self.few = replace(case.scene, traffic=jax.tree.map(lambda leaf: leaf[::step], traffic))
        self._layout: Layout | None = None
        self._frame, self._since = 0, 0.0
        self._todo: set[str] = set()
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._work, name="scorer", daemon=True)
        self._thread.start()

    def score(self, layout: Layout, *, whole: bool) -> None:
        """Score a layout on a few frames, and with ``whole`` on all; find which voxels it sees."""
        with self._changed:
            self._layout, self._since = layout, time.monotonic()
            self._todo |= {"few", "sight", "whole"}
            if not whole:
                self._todo.remove("whole")
            self._changed.notify()

    def select_frame(self, frame: int) -> None:
        """Select the frame whose voxels are found from now on."""
        self._frame = frame
        self._do("sight")

    def close(self, *, wait: bool = True) -> None:
        """End the thread, once it has done what it is at; with ``wait``, come back then."""
        self._do("end")
        if wait:
            self._thread.join()

    def _do(self, job: str) -> None:
        with self._changed:
            self._todo.add(job)
            self._changed.notify()

    def _work(self) -> None:
        resumed = 0.0
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._todo)
                # While a sensor is dragged, half of the time is left to what else follows it.
                rest = resumed - time.monotonic()
                if rest > 0 and not self._todo & {"whole", "end"}:
                    self._changed.wait(rest)
                    continue
                job = next(j for j in _JOBS if j in self._todo)
                self._todo.remove(job)
                layout, frame, since = self._layout, self._frame, self._since
            if job == "end":
                return
            if layout is None:
                continue
            if job in ("few", "whole"):
                begun = time.monotonic()
                self._score(layout, job == "whole", since)
                ended = time.monotonic()
                resumed = ended + (min(ended - begun, LONGEST_REST) if job == "few" else 0.0)
                continue
            with suppress(Exception):  # the scores report it
                sight = sight_in(self.case.scene, layout, frame, conditions=self.case.conditions)
                self._sighted(layout, frame, sight)

    def _score(self, layout: Layout, whole: bool, since: float) -> None:
        scene, scores, wrong = self.case.scene if whole else self.few, None, ""
        try:
            scores = evaluate(scene, layout, conditions=self.case.conditions, **self._options)
        except InspeError as e:
            wrong = str(e)
        except Exception as e:  # such as out of memory: the next layout may succeed
            wrong = f"it could not be scored: {e!r}"
        frames = scene.traffic.frame_count
        self._scored(ScoredLayout(layout, scores, frames, time.monotonic() - since, wrong))
