"""What a search method sees: a start, a budget, exact and rough scores, the best so far.

A method is a row of the registry: how it begins, and one step of it. Steps go from one flat
state to the next, so that a search can be stopped after any step and taken up again.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from inspe_jax.core.errors import InspeError
from inspe_jax.placement.compile_ahead import Ahead, CompileJob
from inspe_jax.placement.problem import Problem, Sample

State = dict[str, Any]
"""Numpy arrays, numbers and strings by name: what a checkpoint holds. Never changed in place."""

GRADIENT_COST = 3.4
"""What the gradient of one layout on a sample costs, in rough scores of it. As measured with
samples of 384 columns and 3 frames, at three places and with 4 LiDARs, 8 cameras and both, when
rough scores went to the cores in fours: a value and its gradient took as long as 2.9 to 4.3 of
them, 3.4 on average. One by one, on `four_way`, a gradient takes as long as 1.9 to 3.0."""
AT_ONCE = 32
"""Rough scores from one look at the budget to the next: some tenths of a second's, mostly."""


class BudgetSpent(Exception):
    """The budget is used up: the search ends here, with the best so far."""


@dataclass(frozen=True)
class Method:
    """A row of the registry: a name, a line about it, how it begins, and one step of it.

    ``step`` does about a second of work and gives the next state, or None where nothing is left
    to do. Neither changes the state that it is given. ``ahead`` gives, by name and in order, what
    is to be compiled while the start is scored and the first steps are done.
    """

    name: str
    summary: str
    begin: "Callable[[Run], State]"
    step: "Callable[[Run, State], State | None]"
    ahead: "Callable[[Run], Mapping[str, CompileJob]]" = lambda run: {}


@dataclass(frozen=True)
class Progress:
    """One exact score of a search: when, after how much work, how good, and the best so far.

    ``seconds`` are of wall time since the search began; ``evaluations`` count exact scores and
    all other work in their equivalents, this one included.
    """

    seconds: float
    evaluations: float
    score: float
    best: float


class Run:
    """One search: what it works on, what it may spend, and what it has found.

    ``seed``; ``start`` (N,), the feasible coordinates to begin at, offered first; ``path``, the
    coordinates (N,) of every one that was the best so far, and ``best``, the last one's exact
    score; ``history``, every exact score; ``evaluations`` spent so far; ``limits``, what may be
    spent, of seconds and of evaluations; ``notes`` for people.
    """

    def __init__(
        self,
        problem: Problem,
        start: Float[np.ndarray, " N"],
        *,
        seed: int = 0,
        seconds: float | None = None,
        evaluations: float | None = None,
        clock: Callable[[], float] = time.monotonic,
        began: float | None = None,
        progress: Callable[[float, float], None] | None = None,
        found: Callable[[Float[np.ndarray, " N"], float], None] | None = None,
    ) -> None:
        """Raises InspeError where there is no budget, or one of nothing.

        The budget is spent when the first of ``seconds`` and ``evaluations`` is. ``clock`` counts
        seconds, and ``began`` is when this search did by it, now if not given. ``progress`` is
        called with the share of the budget spent and the best score, ``found`` with coordinates
        that are the best so far and their score.
        """
        check_budget(seconds, evaluations)
        self.problem, self.seed, self.start = problem, seed, np.array(start, float)
        self.evaluations = 0.0
        self.path: list[Float[np.ndarray, " N"]] = []
        self.best = -np.inf
        self.history: list[Progress] = []
        self.notes: list[str] = []
        self.limits = (seconds, evaluations)
        self._clock, self._progress, self._found = clock, progress, found
        self._began = clock() if began is None else began
        self._ahead = Ahead({})

    @property
    def best_x(self) -> Float[np.ndarray, " N"]:
        """The best coordinates (N,) so far; the start's before there is a score."""
        return self.path[-1] if self.path else self.start

    @property
    def seconds(self) -> float:
        """Wall time since the search began, with what it took before it was last taken up [s]."""
        return self._clock() - self._began

    @property
    def left(self) -> float:
        """Share of the budget that is left, from 1 to 0; for schedules."""
        return 1.0 - self.done

    @property
    def done(self) -> float:
        """Share of the budget that is spent, from 0 to 1."""
        return min(max(self.share(self.spent), 0.0), 1.0)

    @property
    def spent(self) -> Float[np.ndarray, "2"]:
        """Seconds and evaluations so far: for a state, which may go on with a larger budget."""
        return np.array([self.seconds, self.evaluations])

    def share(self, spent: Float[np.ndarray, "2"]) -> float:
        """Share of the budget that so many seconds and evaluations are."""
        parts = zip(spent.tolist(), self.limits, strict=True)
        return max(used / limit for used, limit in parts if limit is not None)

    def rng(self, *key: int) -> np.random.Generator:
        """Random numbers that depend on the seed and the key alone.

        With a step's number in the key, a search that was taken up again draws the same ones.
        """
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=key))

    def offer(self, x: Float[np.ndarray, " N"]) -> float:
        """The exact score of feasible coordinates, which are kept if they are the best so far.

        Charges one evaluation. Raises BudgetSpent unless it is the first, the start's, which is
        found whatever the budget; and InspeError where ``x`` is not feasible.
        """
        x = np.array(x, float)
        if self.history:
            self._check_left()
        score = self.problem.exact(x)
        self.evaluations += 1.0
        better = score > self.best
        if better:
            self.best = score
            self.path.append(x)
        self.history.append(Progress(self.seconds, self.evaluations, score, self.best))
        if better and self._found is not None:
            self._found(x, score)
        self.report()
        return score

    def rough(self, x: Float[np.ndarray, "M N"], sample: Sample) -> Float[np.ndarray, " M"]:
        """Hard scores of layouts on a sample. Charges M · ``sample.cost``.

        Raises BudgetSpent, also after the first :data:`AT_ONCE` layouts or some more: what those
        scored is lost then.
        """
        scores: list[np.ndarray] = []
        for first in range(0, len(x), AT_ONCE):
            part = np.asarray(x[first : first + AT_ONCE], float)
            self.charge(len(part) * sample.cost)
            scores.append(self.problem.rough(part, sample))
        return np.concatenate(scores)

    def charge(self, evaluations: float) -> None:
        """Count work before it is done, in exact scores that take as long. Raises BudgetSpent."""
        self._check_left()
        self.evaluations += float(evaluations)

    def compile_ahead(self, method: Method) -> None:
        """Begin to compile what the method will need, in a thread of its own.

        Where seconds are counted: with evaluations alone a seed repeats, and what is found must
        not depend on how long compiling takes.
        """
        if self.limits[0] is not None:
            self._ahead = Ahead(method.ahead(self))

    def ready(self, name: str) -> bool:
        """Whether what the method named is compiled, or need not be ahead of its use.

        Raises what compiling it raised.
        """
        return self._ahead.ready(name)

    def wait(self, name: str) -> None:
        """Wait until what the method named is compiled, if that was begun; raises as it did."""
        self._ahead.wait(name)

    def close(self) -> None:
        """Compile nothing more than what has been begun."""
        self._ahead.close()

    def report(self) -> None:
        """Tell whoever listens how far the search has come."""
        if self._progress is not None:
            self._progress(self.done, self.best)

    def take_up(
        self,
        seconds: float,
        evaluations: float,
        history: Sequence[Progress],
        path: Float[np.ndarray, "K N"],
    ) -> None:
        """Go on from where another run stood, after so many seconds and evaluations."""
        self._began = self._clock() - seconds
        self.evaluations, self.history, self.path = evaluations, list(history), list(path)
        self.best = history[-1].best if history else -np.inf

    def _check_left(self) -> None:
        if self.left <= 0:
            raise BudgetSpent


def check_budget(seconds: float | None, evaluations: float | None) -> None:
    """Raise InspeError where there is no budget, or one that is not more than nothing."""
    for name, value in dict(seconds=seconds, evaluations=evaluations).items():
        if value is not None and not 0 < value < np.inf:
            raise InspeError(f"{name} {value:g}: a budget must be more than 0, and finite")
    if seconds is None and evaluations is None:
        raise InspeError("no budget: give seconds, evaluations or both")


def check_seed(seed: int) -> None:
    """Raise InspeError where a seed is not a whole number from 0."""
    if not (isinstance(seed, int) and seed >= 0):
        raise InspeError(f"seed {seed!r}: a whole number, 0 or more")
