"""The integer program against every subset there is."""

from itertools import combinations

import numpy as np
import pytest

from inspe_jax.core.errors import InspeError
from inspe_jax.placement.studies.discrete import best_subset
from inspe_jax.scoring.metrics import METRICS, Metric

WEIGHTS = (0.3, 0.5, 0.2)


def instance(seed, candidates=7, voxels=40, frames=3, density=0.25):
    """Random rows in which seen lies within f, and shares that sum to 1."""
    rng = np.random.default_rng(seed)
    f = rng.uniform(size=(candidates, voxels)) < density
    seen = f[:, None] & (rng.uniform(size=(candidates, frames, voxels)) < 0.6)
    weight, entropy, free = (rng.uniform(size=s) for s in (voxels, voxels, (frames, voxels)))
    entropy[rng.uniform(size=voxels) < 0.5] = 0
    return f, seen, weight / weight.sum(), entropy / entropy.sum(), free / free.sum()


def score(chosen, f, seen, weight, entropy, free, reliability, weights=WEIGHTS):
    """P_sm of a set, voxel by voxel."""
    c = o = ig = 0.0
    for i in range(f.shape[1]):
        n = sum(f[j, i] for j in chosen)
        c += weight[i] * (n > 0)
        ig += entropy[i] * (1 - (1 - reliability) ** n)
        o += sum(free[t, i] for t in range(len(free)) if any(seen[j, t, i] for j in chosen))
    return float(np.dot(weights, (c, o, ig)))


@pytest.mark.parametrize(
    ("k", "reliability", "weights"),
    [
        (1, 1.0, WEIGHTS),
        (2, 0.6, WEIGHTS),
        (3, 1.0, (1.0, 0.0, 0.0)),
        (3, 0.6, (0.0, 1.0, 0.0)),
        (4, 0.0, WEIGHTS),
        (7, 0.6, WEIGHTS),
    ],
)
def test_it_finds_the_best_of_all_subsets(k, reliability, weights):
    arrays = instance(k)
    found = best_subset(*arrays, reliability, k, weights)
    values = {c: score(c, *arrays, reliability, weights) for c in combinations(range(7), k)}
    best = max(values.values())
    assert values[tuple(found.chosen)] == pytest.approx(best, abs=1e-9)
    assert found.value == pytest.approx(best, abs=1e-9)
    assert best - 1e-9 <= found.bound <= best + 1e-5  # HiGHS closes the gap to 1e-6


def test_greedy_is_misled_where_the_program_is_not():
    """Two candidates that halve the voxels beat one that has most of them and another."""
    f = np.zeros((3, 8), bool)
    f[0, 1:7], f[1, :4], f[2, 4:] = True, True, True
    seen, even = f[:, None], np.full(8, 1 / 8)
    found = best_subset(f, seen, even, even, even[None], 1.0, 2)
    assert found.chosen.tolist() == [1, 2]
    assert found.value == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("k", "reliability", "says"),
    [(0, 1.0, "1 to 7"), (8, 1.0, "1 to 7"), (2, 1.5, "from 0 to 1")],
)
def test_bad_input_is_said(k, reliability, says):
    with pytest.raises(InspeError, match=says):
        best_subset(*instance(0), reliability, k)


def test_weight_on_another_metric_is_refused(monkeypatch):
    monkeypatch.setitem(METRICS, "toy", Metric("toy", "T", 0.0, "a toy", None))
    assert best_subset(*instance(0), 1.0, 2, {"coverage": 1.0}).value > 0
    with pytest.raises(InspeError, match="weights on toy: the integer program"):
        best_subset(*instance(0), 1.0, 2, {"coverage": 0.5, "toy": 0.5})
