"""The metrics on arrays small enough to work out, and entropy against NumPy."""

import jax.numpy as jnp
import numpy as np
import pytest

from inspe_jax import metrics
from inspe_jax.errors import InspeError
from inspe_jax.scene.regions import WEIGHTS


def test_region_weights_sum_to_one():
    assert sum(WEIGHTS.values()) == pytest.approx(1)


def test_coverage_is_the_weighted_share():
    f, w = jnp.array([1.0, 0.0, 1.0]), jnp.array([0.22, 0.25, 0.13])
    assert float(metrics.coverage(f, w)) == pytest.approx(0.35 / 0.60)
    assert float(metrics.coverage(jnp.ones(3), w)) == pytest.approx(1)


@pytest.mark.parametrize(
    ("reference", "seen", "original"),
    # Voxels: 0 visible, 1 covered but hidden, 2 not covered, 3 solid and in sight.
    [("roi", 1, 3), ("covered", 1, 2), ("targets", 1, 1)],
)
def test_occlusion_references_by_hand(reference, seen, original):
    visible, covered = jnp.array([1.0, 0, 0, 1]), jnp.array([1.0, 1, 0, 1])
    solid = jnp.array([0.0, 0, 0, 1])
    terms = metrics.occlusion_terms(visible, covered, 1 - solid, solid, reference)
    assert tuple(map(float, terms)) == (seen, original)


def test_occlusion_is_a_mean_over_frames_that_have_a_target():
    assert float(metrics.occlusion(jnp.array([1.0, 0, 3]), jnp.array([2.0, 0, 4]))) == 0.625
    assert float(metrics.occlusion(jnp.zeros(2), jnp.zeros(2))) == 0


def test_unknown_occlusion_reference():
    with pytest.raises(InspeError, match="'all': one of roi, covered, targets"):
        metrics.occlusion_terms(jnp.ones(2), jnp.ones(2), jnp.ones(2), jnp.ones(2), "all")


def test_entropy_against_numpy():
    p = np.random.default_rng(0).uniform(0, 1, 50)
    expected = -p * np.log(p) - (1 - p) * np.log(1 - p)
    np.testing.assert_allclose(metrics.entropy(jnp.array(p)), expected, rtol=1e-5)
    assert metrics.entropy(jnp.array([0.0, 1.0])).tolist() == [0, 0]


def test_information_gain_by_hand():
    """p̂ = ½, ½, 0: two voxels carry one bit each. Seeing one of them resolves half."""
    p = jnp.array([0.5, 0.5, 0.0])
    assert float(metrics.information_gain(jnp.array([1.0, 0, 1]), p)) == pytest.approx(0.5)
    assert float(metrics.information_gain(jnp.array([0.4, 0.4, 0]), p)) == pytest.approx(0.4)
    assert float(metrics.information_gain(jnp.ones(3), p)) == pytest.approx(1)


def test_the_printed_formula_falls_as_sensors_see_more():
    p = jnp.array([0.5, 0.5, 0.0])
    assert float(metrics.information_gain_literal(jnp.array([1.0, 0, 1]), p)) == pytest.approx(0.5)
    assert float(metrics.information_gain_literal(jnp.ones(3), p)) == pytest.approx(0)


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
    ours = float(metrics.information_gain(jnp.array(q), jnp.array(p)))
    assert ours == pytest.approx(mutual / total, rel=1e-5)


def test_no_entropy_is_no_gain_and_no_nan():
    for p in (jnp.zeros(3), jnp.ones(3)):
        assert float(metrics.information_gain(jnp.ones(3), p)) == 0
        assert float(metrics.information_gain_literal(jnp.ones(3), p)) == 1


def test_surrogate_and_its_weights():
    assert metrics.surrogate(1.0, 0.5, 0.25) == pytest.approx(0.3 + 0.25 + 0.05)
    assert metrics.surrogate(1.0, 0.5, 0.25, (1, 0, 0)) == 1.0
    for weights in ((0.3, 0.5, 0.3), (1.5, -0.5, 0.0), (0.5, 0.5)):
        with pytest.raises(InspeError, match="sum to 1"):
            metrics.surrogate(1.0, 0.5, 0.25, weights)
