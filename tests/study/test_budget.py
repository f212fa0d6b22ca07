"""One budget for many places, against every choice there is, and against dynamic programming."""

from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest

from inspe_jax.core.errors import InspeError
from inspe_jax.study import budget as module
from inspe_jax.study.budget import share_out

Case = tuple[list[list[float]], list[list[float]], float, list[float]]


def random_case(seed: int) -> Case:
    """Up to five places with up to five options: prices to the cent or round, scores with ties."""
    rng = np.random.default_rng(seed)
    sizes = rng.integers(1, 6, rng.integers(2, 6))
    unit = (0.01, 37.5, 1000.0)[seed % 3]
    costs = [(unit * rng.integers(0, 40, n)).round(2).tolist() for n in sizes]
    scores = [rng.integers(0, 12, n) / 7 if seed % 2 else rng.uniform(0, 1, n) for n in sizes]
    for row in costs:
        row[0] = 0.0
    amount = round(float(rng.uniform(0.1, 0.8) * sum(map(max, costs))), 2)
    return costs, [row.tolist() for row in scores], amount, rng.uniform(0.2, 3, len(sizes)).tolist()


def every_choice(case: Case) -> list[tuple[float, float]]:
    """(least score, weighted sum) of each choice within the budget, counted in cents."""
    costs, scores, amount, weights = case
    cents = [[round(100 * cost) for cost in row] for row in costs]
    found = []
    for options in product(*(range(len(row)) for row in costs)):
        if sum(row[k] for row, k in zip(cents, options, strict=True)) <= round(100 * amount):
            got = [row[k] for row, k in zip(scores, options, strict=True)]
            found.append((min(got), float(np.dot(weights, got))))
    return found


@pytest.mark.parametrize("worst", [False, True], ids=["sum", "worst"])
@pytest.mark.parametrize("seed", range(6))
def test_no_choice_there_is_is_better(seed, worst):
    case = costs, scores, amount, weights = random_case(seed)
    found = share_out(costs, scores, amount, weights, worst=worst)
    chosen = [row[k] for row, k in zip(scores, found.options, strict=True)]
    spent = sum(round(100 * row[k]) for row, k in zip(costs, found.options, strict=True))
    assert found.worst == min(chosen)
    assert found.total == pytest.approx(float(np.dot(weights, chosen)), abs=1e-12)
    assert spent == round(100 * found.cost) <= round(100 * amount)
    assert found.gap == 0
    choices = every_choice(case)
    least, total = max(choices) if worst else (None, max(total for _, total in choices))
    assert found.total == pytest.approx(total, abs=1e-9)
    if worst:
        assert found.worst == least


def best_sum(costs: np.ndarray, scores: np.ndarray, amount: int) -> float:
    """The greatest sum by dynamic programming over whole amounts; the first option is free."""
    best = np.zeros(amount + 1)
    for cost, score in zip(costs, scores, strict=True):
        after = np.full(amount + 1, -np.inf)
        for c, s in zip(cost, score, strict=True):
            if c <= amount:
                after[c:] = np.maximum(after[c:], best[: amount + 1 - c] + s)
        best = after
    return float(best.max())


def test_more_places_than_can_be_enumerated():
    """200 places with 10 options: as dynamic programming finds it."""
    rng = np.random.default_rng(3)
    costs = np.sort(rng.integers(0, 60, (200, 10)), 1)
    scores = np.sort(rng.uniform(0, 1, (200, 10)), 1)
    costs[:, 0] = 0
    amount = int(0.4 * costs[:, -1].sum())
    found = share_out(costs * 250.0, scores, amount * 250.0, [1] * 200)
    assert found.gap == 0
    assert found.total == pytest.approx(best_sum(costs, scores, amount), abs=1e-9)


def test_cents_are_exact():
    """0.1 + 0.2 is more than 0.3 in binary, and 19.99 is not 1999 hundredths."""
    assert share_out([[0, 0.1], [0, 0.2]], [[0, 1]] * 2, 0.3, [1, 1]).options == (1, 1)
    assert share_out([[0, 19.99]] * 3, [[0, 1]] * 3, 59.97, [1] * 3).options == (1, 1, 1)
    short = share_out([[0, 19.99]] * 3, [[0, 1]] * 3, 59.96, [1] * 3)
    assert (sum(short.options), short.cost) == (2, 39.98)
    large = share_out([[0, 123_456_789.01], [0, 0.01]], [[0, 1]] * 2, 123_456_789.01, [1] * 2)
    assert sum(large.options) == 1


def test_a_choice_that_exceeds_the_budget_is_solved_again(monkeypatch):
    """A solver that takes what is a little too dear, as within a tolerance of its own."""
    real, asked = module.milp, []

    def loose(*given, **more):
        asked.append(more)
        if len(asked) == 1:
            return SimpleNamespace(x=np.array([0, 1, 0, 1.0]), mip_dual_bound=-1e9)
        return real(*given, **more)

    monkeypatch.setattr(module, "milp", loose)
    found = share_out([[0, 10], [0, 10.01]], [[0, 1], [0, 2]], 20, [1, 1])
    assert (found.options, found.total, found.gap, len(asked)) == ((0, 1), 2, 0, 2)


def test_how_far_from_the_best_it_may_be(monkeypatch):
    """What a solver that ran out of time has proved, and one that found nothing."""
    found = SimpleNamespace(x=np.array([1, 0.0]), mip_dual_bound=-1.25e4)
    monkeypatch.setattr(module, "milp", lambda *given, **more: found)
    assert share_out([[1, 5]], [[1.0, 0.5]], 2, [1]).gap == pytest.approx(0.25)
    monkeypatch.setattr(
        module, "milp", lambda *given, **more: SimpleNamespace(x=None, message="Time limit reached")
    )
    with pytest.raises(InspeError, match="the budget was not shared out: HiGHS says: Time limit"):
        share_out([[1, 5]], [[1.0, 0.5]], 2, [1])


@pytest.mark.parametrize(("costs", "amount", "message"), [
    ([[0]], -1, "budget -1: 0 to 1e"),
    ([[0]], float("nan"), "budget nan: 0 to 1e"),
    ([[-1]], 1, "cost -1: 0 or more US dollars, to the cent"),
    ([[float("inf")]], 1, "cost inf"),
    ([[0.001]], 1, "cost 0.001: 0 or more US dollars, to the cent"),
    ([[5], [7]], 11, r"budget of 11.00 US dollars is too small: .* 12.00"),
])  # fmt: skip
def test_bad_input(costs, amount, message):
    for worst in (False, True):
        with pytest.raises(InspeError, match=message):
            share_out(costs, [[1]] * len(costs), amount, [1] * len(costs), worst=worst)
