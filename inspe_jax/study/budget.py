"""One budget for many places: one option of each, so that all together are worth most: the
multiple-choice knapsack problem, which HiGHS solves (:func:`scipy.optimize.milp`)."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import floor, gcd

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import csr_array

from inspe_jax.core.errors import InspeError
from inspe_jax.core.words import counted

SECONDS = 60.0
"""Longest time of a solution [s]. The best by then is taken, with how far off it may be."""
DEAREST = 1e10  # largest budget and largest cost of an option [US dollars]
_SCALE = 1e4  # HiGHS ends within 1e-6 of the optimum, whatever the gap that is asked for
_TRIES = 20


@dataclass(frozen=True)
class Share:
    """The option of each place, by number, and their cost [US dollars]; ``total`` is the weighted
    sum of their scores, ``worst`` the least. No choice within the budget exceeds ``bound`` in
    ``total``, of all or, where the worst is maximised, of those with this ``worst``."""

    options: tuple[int, ...]
    cost: float
    total: float
    worst: float
    bound: float

    @property
    def gap(self) -> float:
        """How much more than ``total``, as a share of it, a better choice could have."""
        over = self.bound - self.total
        if over <= 1e-9 * max(abs(self.total), 1.0):
            return 0.0
        return over / abs(self.total) if self.total else float("inf")


def share_out(
    costs: Sequence[Sequence[float]],
    scores: Sequence[Sequence[float]],
    budget: float,
    weights: Sequence[float],
    *,
    worst: bool = False,
) -> Share:
    """Choose one option for each place within a budget: the greatest weighted sum of scores.

    ``costs`` [US dollars, to the cent] and ``scores`` have a row for each place. With ``worst``,
    the least score is maximised, and then the sum. Cents are exact, and never exceed the budget.
    Raises InspeError if an amount is wrong, the budget too small, or HiGHS too slow.
    """
    check_budget(budget)
    for cost in (cost for row in costs for cost in row):
        if not 0 <= cost <= DEAREST or abs(100 * cost - round(100 * cost)) > 1e-3:
            raise InspeError(f"cost {cost}: 0 or more US dollars, to the cent")
    cents = [np.array([round(100 * cost) for cost in row], np.int64) for row in costs]
    limit = floor(100 * budget + 1e-6)
    least = sum(int(row.min()) for row in cents)
    if least > limit:
        raise InspeError(
            f"a budget of {budget:,.2f} US dollars is too small: the cheapest options of "
            f"{counted(len(costs), 'place')} cost {least / 100:,.2f}"
        )
    values = [np.array(row, float) for row in scores]
    least_score = _greatest_worst(cents, values, limit) if worst else -np.inf
    allowed = [np.flatnonzero(row >= least_score) for row in values]
    chosen, bound = _greatest_sum(
        [row[kept] for row, kept in zip(cents, allowed, strict=True)],
        [w * row[kept] for w, row, kept in zip(weights, values, allowed, strict=True)],
        limit,
    )
    options = [int(kept[k]) for kept, k in zip(allowed, chosen, strict=True)]
    found = [float(row[k]) for row, k in zip(values, options, strict=True)]
    cost = sum(int(row[k]) for row, k in zip(cents, options, strict=True)) / 100
    total = sum(w * score for w, score in zip(weights, found, strict=True))
    return Share(tuple(options), cost, total, min(found), bound)


def check_budget(budget: float) -> None:
    """Raise InspeError for a budget that is no sum of money [US dollars]."""
    if not 0 <= budget <= DEAREST:
        raise InspeError(f"budget {budget:g}: 0 to {DEAREST:g} US dollars")


def _greatest_worst(
    cents: Sequence[Int[np.ndarray, " K"]], values: Sequence[Float[np.ndarray, " K"]], limit: int
) -> float:
    """The greatest score that every place can reach within the limit, by halving all scores."""
    steps = np.unique(np.concatenate(values))
    low, high = 0, len(steps) - 1  # the lowest score is reached by all options
    while low < high:
        middle = (low + high + 1) // 2
        reach = [row[value >= steps[middle]] for row, value in zip(cents, values, strict=True)]
        fits = all(map(len, reach)) and sum(int(row.min()) for row in reach) <= limit
        low, high = (middle, high) if fits else (low, middle - 1)
    return float(steps[low])


def _greatest_sum(
    cents: Sequence[Int[np.ndarray, " K"]], worth: Sequence[Float[np.ndarray, " K"]], limit: int
) -> tuple[list[int], float]:
    """(The option of each place with the greatest sum within the limit, what no sum can exceed).
    HiGHS works in floating point: a choice that exceeds the limit in whole cents after all is
    forbidden, and the program is solved again."""
    sizes = np.array([len(row) for row in cents])
    place = np.repeat(np.arange(len(sizes)), sizes)
    cost, value = np.concatenate(cents), np.concatenate(worth)
    unit = gcd(*map(int, cost)) or 1  # small whole numbers are exact to the solver
    scale = _SCALE / max(float(np.abs(value).max()), 1e-12)
    number = np.arange(len(place))
    once = csr_array((np.ones(len(place)), (place, number)), shape=(len(sizes), len(place)))
    rules = [
        LinearConstraint(once, 1, 1),
        LinearConstraint((cost // unit)[None].astype(float), -np.inf, limit // unit),
    ]
    for _ in range(_TRIES):
        found = milp(
            -scale * value,
            integrality=np.ones(len(place)),
            bounds=Bounds(0, 1),
            constraints=rules,
            options=dict(mip_rel_gap=0.0, time_limit=SECONDS),
        )
        if found.x is None:
            raise InspeError(f"the budget was not shared out: HiGHS says: {found.message}")
        starts = np.cumsum(sizes) - sizes
        parts = np.split(found.x, starts[1:])
        chosen = np.array([int(part.argmax()) for part in parts]) + starts
        if int(cost[chosen].sum()) <= limit:
            total, bound = float(value[chosen].sum()), -float(found.mip_dual_bound) / scale
            return (chosen - starts).tolist(), max(bound, total)
        taken = np.zeros((1, len(place)))
        taken[0, chosen] = 1.0
        rules.append(LinearConstraint(taken, -np.inf, len(sizes) - 1))
    raise InspeError(f"the budget was not shared out: {_TRIES} choices of HiGHS exceed it")
