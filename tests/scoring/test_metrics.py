"""The metrics on arrays small enough to work out, and entropy against NumPy."""

import jax
import numpy as np
import pytest

from inspe_jax.core.errors import InspeError
from inspe_jax.scoring import metrics


def test_coverage_is_the_weighted_share():
    coverage, w = jax.jit(metrics.coverage), np.array([0.22, 0.25, 0.13])
    assert float(coverage(np.array([1.0, 0.0, 1.0]), w)) == pytest.approx(0.35 / 0.60)
    assert float(coverage(np.ones(3), w)) == pytest.approx(1)


def test_occlusion_is_a_mean_over_frames_that_have_a_target():
    occlusion = jax.jit(metrics.occlusion)
    assert float(occlusion(np.array([1.0, 0, 3]), np.array([2.0, 0, 4]))) == 0.625
    assert float(occlusion(np.zeros(3), np.zeros(3))) == 0


def test_entropy_against_numpy():
    p = np.random.default_rng(0).uniform(0, 1, 50)
    expected = -p * np.log(p) - (1 - p) * np.log(1 - p)
    found = np.asarray(entropy(np.concatenate([p, [0.0, 1.0]])))
    np.testing.assert_allclose(found[:-2], expected, rtol=1e-5)
    assert found[-2:].tolist() == [0, 0]


entropy = jax.jit(metrics.entropy)
information_gain = jax.jit(lambda q, p: metrics.information_gain(*metrics.entropy_terms(q, p)))


def gain(q, p):
    return float(information_gain(np.array(q), np.array(p)))


def test_information_gain_by_hand():
    """p̂ = ½, ½, 0: two voxels carry one bit each. Seeing one of them resolves half."""
    p = [0.5, 0.5, 0.0]
    assert gain([1.0, 0, 1], p) == pytest.approx(0.5)
    assert gain([0.4, 0.4, 0], p) == pytest.approx(0.4)
    assert gain([1.0, 1, 1], p) == pytest.approx(1)


def test_information_gain_is_the_mutual_information_of_an_erasure_channel():
    """By enumeration: a voxel's occupancy X is read with chance q, else erased."""
    p, q = np.array([0.3, 0.8]), np.array([0.6, 0.9])
    mutual = total = 0.0
    for pi, qi in zip(p, q, strict=True):
        joint = np.array([[(1 - pi) * qi, 0, (1 - pi) * (1 - qi)], [0, pi * qi, pi * (1 - qi)]])
        product = joint.sum(1, keepdims=True) * joint.sum(0, keepdims=True)
        on = joint > 0
        mutual += (joint[on] * np.log(joint[on] / product[on])).sum()
        total += -pi * np.log(pi) - (1 - pi) * np.log(1 - pi)
    assert gain(q, p) == pytest.approx(mutual / total, rel=1e-5)


def test_no_entropy_is_no_gain_and_no_nan():
    for p in (np.zeros(3), np.ones(3)):
        assert gain([1.0, 1, 1], p) == 0


def test_surrogate_and_its_weights():
    scores = dict(coverage=1.0, occlusion=0.5, information_gain=0.25)
    assert metrics.surrogate(scores, metrics.weights_of()) == pytest.approx(0.3 + 0.25 + 0.05)
    assert metrics.surrogate(scores, metrics.weights_of((1, 0, 0))) == 1.0
    assert metrics.surrogate(scores, metrics.weights_of({"occlusion": 1})) == 0.5


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ((0.3, 0.5, 0.3), "sum to 1"),
        ((1.5, -0.5, 0.0), "no weight may be negative"),
        (
            (0.5, 0.5),
            "give 3 numbers, for coverage, occlusion, information_gain; or weights by name",
        ),
        ({"coverage": 0.5, "oclusion": 0.5}, "did you mean occlusion"),
    ],
)
def test_weights_that_can_be_none(given, words):
    with pytest.raises(InspeError, match=words):
        metrics.weights_of(given)


@pytest.mark.parametrize(
    ("placement", "c", "o", "ig", "surrogate"),
    # InSPE (arXiv 2504.08240), Table 2, means.
    [
        ("Cam-c", 0.605, 0.502, 0.253, 0.483),
        ("Cam-d1", 0.680, 0.549, 0.295, 0.538),
        ("Cam-d2", 0.691, 0.514, 0.306, 0.526),
        ("L-c", 0.626, 0.609, 0.442, 0.581),
        ("L-d1", 0.872, 0.794, 0.679, 0.794),
        ("L-d2", 0.794, 0.721, 0.555, 0.710),
        ("Cam-c/L-c", 0.815, 0.703, 0.509, 0.698),
        ("Cam-d1/L-d1", 0.917, 0.901, 0.724, 0.871),
        ("Cam-d2/L-d2", 0.899, 0.870, 0.637, 0.832),
    ],
)
def test_the_weights_are_those_of_the_papers_table(placement, c, o, ig, surrogate):
    """P_sm of the paper's own C, O and IG is the paper's P_sm, to what it rounds off."""
    scores = dict(zip(metrics.METRICS, (c, o, ig), strict=False))
    ours = metrics.surrogate(scores, metrics.weights_of())
    assert ours == pytest.approx(surrogate, abs=1e-3)
