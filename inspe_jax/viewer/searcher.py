"""A search beside the page: it can be stopped, and what it has found so far is told at once."""

import threading
import traceback
from collections.abc import Callable
from dataclasses import dataclass

from inspe_jax.errors import InspeError
from inspe_jax.placement.constraints import Constraints
from inspe_jax.placement.optimise import optimise
from inspe_jax.placement.problem import Case, Objective
from inspe_jax.placement.result import Result
from inspe_jax.sensing.layout import Layout


@dataclass(frozen=True)
class Heard:
    """What a search tells, from its thread.

    ``progress`` with the share of the budget spent and the best score; ``found`` with every
    layout that is the best so far and its score; ``ended`` with the result, or with None and why
    there is none.
    """

    progress: Callable[[float, float], None]
    found: Callable[[Layout, float], None]
    ended: Callable[[Result | None, str], None]


class Searcher:
    """One search at a time; ``running`` until its end is told."""

    def __init__(
        self,
        case: Case,
        weights: tuple[float, float, float],
        constraints: Constraints,
        heard: Heard,
    ) -> None:
        self.case, self.weights, self.constraints = case, weights, constraints
        self._heard = heard
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self.running = False

    def start(self, layout: Layout, method: str, seconds: float) -> None:
        """Search from a layout; nothing where a search is under way."""
        if self.running:
            return
        self.running = True
        self._stop.clear()
        self._thread = threading.Thread(
            target=self._search, args=(layout, method, seconds), name="search", daemon=True
        )
        self._thread.start()

    def stop(self) -> None:
        """End the search with the best so far, at its next report."""
        self._stop.set()

    def close(self) -> None:
        """Stop, and wait for the end."""
        self.stop()
        if self._thread is not None:
            self._thread.join()

    def _search(self, layout: Layout, method: str, seconds: float) -> None:
        def progress(done: float, best: float) -> None:
            self._heard.progress(done, best)
            if self._stop.is_set():
                raise KeyboardInterrupt  # as by hand: the search ends with the best so far

        result, wrong = None, ""
        try:
            result = optimise(
                self.case,
                layout,
                method,
                seconds,
                objective=Objective(weights=self.weights),
                constraints=self.constraints,
                progress=progress,
                found=self._heard.found,
            )
        except KeyboardInterrupt:
            wrong = "stopped before there was a score"
        except InspeError as e:
            wrong = str(e)
        except Exception as e:
            traceback.print_exception(e)
            wrong = f"the search failed: {e!r}"
        self.running = False
        self._heard.ended(result, wrong)
