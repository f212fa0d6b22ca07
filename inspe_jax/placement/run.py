"""One run of a search: its start, its budget, exact and rough scores, and the best so far. A step
goes from one state to the next, so a search can be stopped after any step and resumed."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any

import numpy as np
from jaxtyping import Float

from inspe_jax.core.compiling import working_clock
from inspe_jax.core.errors import InspeError, wrong_kind
from inspe_jax.placement.candidates import COLUMNS, FRAMES
from inspe_jax.placement.problem import Problem

AT_ONCE = 32
"""Number of rough scores between two checks of the budget: mostly some tenths of a second."""


class BudgetSpent(Exception):
    """The budget is used up: the search ends here, with the best so far."""


class TargetReached(Exception):
    """The best layout is as good as was asked for: the search ends here."""


@dataclass(frozen=True)
class Method:
    """A search method, a row of the registry.

    ``states`` are the frozen dataclasses of its states. Their fields are NumPy arrays, numbers and
    strings, as a checkpoint holds them. ``begin`` gives the first state. ``step`` does about a
    second of work and gives the next state, or None if nothing is left to do.

    >>> inspe_jax.METHODS["greedy-adam"].summary
    'greedy placement, then Adam and moves of single units'
    """

    name: str
    summary: str
    states: tuple[type[Any], ...]
    begin: "Callable[[Run], Any]"
    step: "Callable[[Run, Any], Any]"


@dataclass(frozen=True)
class Progress:
    """One exact score of a search, ``seconds`` after the first; ``evaluations`` so far, all work
    counted in exact scores; the ``score``, and the ``best`` so far."""

    seconds: float
    evaluations: float
    score: float
    best: float


class Run:
    """One search: its problem, its budget, and what it has found.

    It begins at the feasible coordinates ``start`` (N,). ``path`` has those of every layout that
    was the best so far, ``best`` the score of the last, ``history`` every exact score. ``limits``
    is the budget in seconds and evaluations, ``target`` the score that ends it. ``held`` (N,) is a
    layout that the method prefers, not scored yet. ``cache`` has what can be computed again.
    """

    def __init__(
        self,
        problem: Problem,
        start: Float[np.ndarray, " N"],
        *,
        seed: int = 0,
        seconds: float | None = None,
        evaluations: float | None = None,
        clock: Callable[[], float] | None = None,
        progress: Callable[[float, float], None] | None = None,
        found: Callable[[Float[np.ndarray, " N"], float], None] | None = None,
        target: float = np.inf,
    ) -> None:
        """As :func:`~inspe_jax.placement.optimise.optimise`; ``found`` gets coordinates."""
        check_budget(seconds, evaluations)
        self.problem, self.seed, self.start = problem, seed, np.array(start, float)
        self.evaluations = 0.0
        self.path: list[Float[np.ndarray, " N"]] = []
        self.best = -np.inf
        self.held: Float[np.ndarray, " N"] | None = None
        self.history: list[Progress] = []
        self.notes: list[str] = []
        self.cache: dict[str, Any] = {}
        self.limits = (seconds, evaluations)
        self._clock, self._progress, self._found = clock or working_clock(), progress, found
        self.target = target
        self._began = self._clock()
        self._took: list[float] = []  # by exact scores of this process [s]

    @property
    def best_x(self) -> Float[np.ndarray, " N"]:
        """The best coordinates (N,) so far; the start's before there is a score."""
        return self.path[-1] if self.path else self.start

    @property
    def seconds(self) -> float:
        """Time since the first exact score, with that before the search was resumed [s]."""
        return self._clock() - self._began

    @property
    def done(self) -> float:
        """Share of the budget that is spent, from 0 to 1."""
        return min(max(self.share(self.spent), 0.0), 1.0)

    @property
    def spent(self) -> Float[np.ndarray, "2"]:
        """Seconds and evaluations so far. States keep these, not shares: a budget may grow."""
        return np.array([self.seconds, self.evaluations])

    def share(self, spent: Float[np.ndarray, "2"]) -> float:
        """What share of the budget so many seconds and evaluations are."""
        parts = zip(spent.tolist(), self.limits, strict=True)
        return max(used / limit for used, limit in parts if limit is not None)

    def rng(self, *key: int) -> np.random.Generator:
        """Random numbers of the seed and the key alone: by the step's number, they repeat on
        resuming."""
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=key))

    def offer(self, x: Float[np.ndarray, " N"]) -> float:
        """The exact score of feasible coordinates (N,), for one evaluation. May end the search."""
        if self.history:
            self._check_left()
        return self._score(np.array(x, float))

    def offer_better(
        self, x: Float[np.ndarray, "M N"], scores: Float[np.ndarray, " M"], value: float
    ) -> tuple[int, float]:
        """Score exactly the row of ``x`` that has the best of ``scores``, unless that is row 0,
        whose exact score is ``value``. Returns the better row's index, and its score."""
        best = int(np.argmax(scores))
        if best and (exact := self.offer(x[best])) > value:
            return best, exact
        return 0, value

    def hold(self, x: Float[np.ndarray, " N"]) -> None:
        """Keep the feasible coordinates (N,) that the method would end with, were it stopped now.
        They are scored if the search ends before the next :meth:`offer`; the budget keeps room."""
        self.held = None if np.array_equal(x, self.best_x) else np.array(x, float)

    def settle(self) -> None:
        """Score what is held, after the search. Raises TargetReached."""
        if self.held is not None:
            self._score(self.held)

    def _score(self, x: Float[np.ndarray, " N"]) -> float:
        began = self._clock()
        score = self.problem.exact(x)
        self._took.append(self._clock() - began)
        if not self.history:
            self._began = self._clock()
        self.evaluations, self.held = self.evaluations + 1.0, None
        better = score > self.best
        if better:
            self.best = score
            self.path.append(x)
        self.history.append(Progress(self.seconds, self.evaluations, score, self.best))
        if better and self._found is not None:
            self._found(x, score)
        self.report()
        if self.best >= self.target:
            raise TargetReached
        return score

    def rough(
        self, x: Float[np.ndarray, "M N"], *key: int, size: int = 1
    ) -> Float[np.ndarray, " M"]:
        """Hard scores of M layouts on the sample of ``key``, charged M times its cost; ``size``
        times the usual columns and frames. The best so far is held. May end the search,
        BudgetSpent."""
        sample = self.problem.sample(self.rng(*key), size * COLUMNS, size * FRAMES)
        scores: list[np.ndarray] = []
        for first in range(0, len(x), AT_ONCE):
            part = np.asarray(x[first : first + AT_ONCE], float)
            self.charge(len(part) * sample.cost)
            scores.append(self.problem.rough(part, sample))
            self.hold(x[np.argmax(np.concatenate(scores))])
        return np.concatenate(scores)

    def charge(self, evaluations: float) -> None:
        """Charge for work before it is done, in exact scores. Raises BudgetSpent."""
        self._check_left(0.0 if self.held is None else self.exact_cost)
        self.evaluations += float(evaluations)

    @property
    def exact_cost(self) -> Float[np.ndarray, "2"]:
        """Seconds and evaluations of an exact score. The first of a process may compile."""
        return np.array([min(self._took[1:], default=0.0), 1.0])

    def report(self) -> None:
        """Call ``progress`` with the share of the budget and the best score."""
        if self._progress is not None:
            self._progress(self.done, self.best)

    def take_up(
        self,
        seconds: float,
        evaluations: float,
        history: Sequence[Progress],
        path: Float[np.ndarray, "K N"],
        held: Float[np.ndarray, " N"] | None = None,
    ) -> None:
        """Continue a run that had spent so many seconds and evaluations, and held a layout."""
        self._began = self._clock() - seconds
        self.evaluations, self.history, self.path = evaluations, list(history), list(path)
        self.best, self.held = history[-1].best if history else -np.inf, held

    def _check_left(self, room: Float[np.ndarray, "2"] | float = 0.0) -> None:
        if self.share(self.spent + room) >= 1:
            raise BudgetSpent


def check_budget(seconds: float | None, evaluations: float | None) -> None:
    """Raise InspeError where there is no budget, or one that is not more than nothing."""
    for name, value in dict(seconds=seconds, evaluations=evaluations).items():
        if value is not None and (isinstance(value, bool) or not isinstance(value, Real)):
            raise wrong_kind(name, value, "a number above 0")
        if value is not None and not 0 < value < np.inf:
            raise InspeError(f"{name} {value:g}: a budget must be more than 0, and finite")
    if seconds is None and evaluations is None:
        raise InspeError("no budget: give seconds, evaluations or both")


def check_seed(seed: int) -> None:
    """Raise InspeError where a seed is not a whole number from 0."""
    if not (isinstance(seed, int) and seed >= 0):
        raise InspeError(f"seed {seed!r}: a whole number, 0 or more")
