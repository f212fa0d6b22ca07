"""Curves of detection: their values by hand, and found again from boxes that they decide."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from inspe_jax import fit_detection
from inspe_jax.core.errors import InspeError
from inspe_jax.scene.traffic.frames import CLASSES
from inspe_jax.scoring.detection import DetectionCurve, detection_curves


@pytest.mark.parametrize("slope", [1.0, 1.5, 2.2, 10.0])
def test_a_curve_is_a_logistic_function_of_the_logarithm(slope):
    curve = DetectionCurve(0.9, 8.0, slope)
    number = jnp.asarray([0.0, 1.0, 8.0, 30.0, 1e6])
    expected = 0.9 / (1 + np.exp(-slope * np.log(np.array([1.0, 8.0, 30.0]) / 8.0)))
    found = np.asarray(curve.chance(number))
    np.testing.assert_allclose(found[1:4], expected, rtol=1e-5)
    assert found[0] == 0
    assert found[2] == pytest.approx(0.45)
    assert found[4] == pytest.approx(0.9, abs=1e-3)
    slopes = jax.vmap(jax.grad(curve.chance))(number)
    assert np.isfinite(slopes).all()
    assert (slopes[2:4] > 0).all()


def test_every_class_and_kind_has_a_curve():
    curves = detection_curves()
    assert sorted(curves) == ["camera", "lidar"]
    assert all(len(of) == len(CLASSES) for of in curves.values())
    assert all(0.9 <= curve.most <= 1 for of in curves.values() for curve in of)
    with pytest.raises(InspeError, match="most is in 0 … 1"):
        DetectionCurve(1.2, 8.0, 1.0)


def test_a_curve_is_found_again_from_boxes():
    """Two thousand boxes, found or missed by chance: within three standard errors or so."""
    rng = np.random.default_rng(1)
    truth = DetectionCurve(0.93, 12.0, 1.8)
    number = np.exp(rng.uniform(0, 6, 2000))
    found = rng.uniform(size=2000) < np.asarray(truth.chance(jnp.asarray(number)))
    rows = [
        dict(sensor="lidar", road_user="car", number=n, found=int(hit))
        for n, hit in zip(number, found, strict=True)
    ]
    curve = fit_detection([*rows, dict(sensor="lidar", road_user="car", number=0, found=0)])
    curve = curve["lidar", "car"]
    assert curve.most == pytest.approx(truth.most, abs=0.03)
    assert curve.half == pytest.approx(truth.half, rel=0.12)
    assert curve.slope == pytest.approx(truth.slope, rel=0.15)


def test_boxes_that_tell_nothing_are_refused():
    row = dict(sensor="camera", road_user="car", number="120", found="1")
    with pytest.raises(InspeError, match="40 of them found"):
        fit_detection([row] * 40)
    with pytest.raises(InspeError, match="box 2: a row needs"):
        fit_detection([row, {}])
    with pytest.raises(InspeError, match="found 0 or 1"):
        fit_detection([row | dict(found=0.5)])
    with pytest.raises(InspeError, match="did you mean camera"):
        fit_detection([row | dict(sensor="camra")])
    with pytest.raises(InspeError, match="no boxes"):
        fit_detection([])
