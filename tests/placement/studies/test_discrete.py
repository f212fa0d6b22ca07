"""The integer program of an experiment against every subset there is."""

from itertools import combinations

import numpy as np
import pytest
from discrete_reference import best_subset


@pytest.mark.parametrize("k", [1, 2, 4, 7])
def test_it_finds_the_best_of_all_subsets(k):
    rng = np.random.default_rng(k)
    seen, worth = rng.uniform(size=(7, 160)) < 0.25, rng.uniform(size=160)
    worth[rng.uniform(size=160) < 0.3] = 0
    chosen, value, bound = best_subset(seen, worth, k, seconds=60.0)
    values = {
        some: sum(worth[e] for e in range(160) if any(seen[j, e] for j in some))
        for some in combinations(range(7), k)
    }
    best = max(values.values())
    assert values[tuple(chosen)] == pytest.approx(best, abs=1e-9)
    assert value == pytest.approx(best, abs=1e-9)
    assert best - 1e-9 <= bound <= best * (1 + 1e-5)  # HiGHS closes the gap to 1e-6
