"""Curves of detection: their values by hand, and found again from boxes that they decide."""

import json
import pickle
from importlib.resources import files

import jax
import numpy as np
import pytest

from inspe_jax import fit_detection, load_detection, save_detection
from inspe_jax.core.errors import InspeError
from inspe_jax.scene.traffic.frames import CLASSES
from inspe_jax.scoring.detection import DetectionCurve, detection_curves
from inspe_jax.scoring.options import ScoreOptions
from inspe_jax.sensing.kinds import SENSOR_KINDS


@pytest.mark.parametrize("slope", [1.5, 10.0])
def test_a_curve_is_a_logistic_function_of_the_logarithm(slope):
    curve = DetectionCurve(0.9, 8.0, slope)
    number = np.float32([0.0, 1.0, 8.0, 30.0, 1e6])
    expected = 0.9 / (1 + np.exp(-slope * np.log(np.array([1.0, 8.0, 30.0]) / 8.0)))
    found, slopes = map(np.asarray, jax.jit(jax.vmap(jax.value_and_grad(curve.chance)))(number))
    np.testing.assert_allclose(found[1:4], expected, rtol=1e-5)
    assert found[0] == 0
    assert found[2] == pytest.approx(0.45)
    assert found[4] == pytest.approx(0.9, abs=1e-3)
    assert np.isfinite(slopes).all()
    assert (slopes[2:4] > 0).all()


def test_every_class_and_kind_has_a_curve():
    curves = [detection_curves().of(kind) for kind in SENSOR_KINDS]
    assert all(len(of) == len(CLASSES) for of in curves)
    assert all(0.9 <= curve.most <= 1 for of in curves for curve in of)
    with pytest.raises(InspeError, match="most is in 0 … 1"):
        DetectionCurve(1.2, 8.0, 1.0)


def test_a_curve_is_found_again_from_boxes():
    """Two thousand boxes, found or missed by chance: within three standard errors or so."""
    rng = np.random.default_rng(1)
    truth = DetectionCurve(0.93, 12.0, 1.8)
    number = np.exp(rng.uniform(0, 6, 2000))
    found = rng.uniform(size=2000) < np.asarray(jax.jit(truth.chance)(number))
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
    for rows, words in (
        ([row] * 40, "40 of them found"),
        ([row, {}], "box 2: a row needs"),
        ([row | dict(found=0.5)], "found 0 or 1"),
        ([row | dict(sensor="camra")], "did you mean camera"),
        ([], "no boxes"),
    ):
        with pytest.raises(InspeError, match=words):
            fit_detection(rows)


def test_a_file_of_curves_replaces_those_that_it_has(tmp_path):
    text = "[lidar.pedestrian]\nmost = 0.8\nhalf = 30\nslope = 2.5\n"
    (tmp_path / "mine.toml").write_text(text)
    curves, usual = load_detection(tmp_path / "mine.toml"), detection_curves()
    at = CLASSES.index("pedestrian")
    assert curves.of("lidar")[at] == DetectionCurve(0.8, 30.0, 2.5)
    assert curves.of("camera") == usual.of("camera")
    assert [a == b for a, b in zip(curves.of("lidar"), usual.of("lidar"), strict=True)] == [
        k != at for k in range(len(CLASSES))
    ]
    assert hash(curves) != hash(usual)
    assert pickle.loads(pickle.dumps(curves)) == curves
    asked = ScoreOptions.of(detection=curves)
    assert asked.detection == curves
    whole = tmp_path / "whole.toml"
    whole.write_bytes(files("inspe_jax.scoring").joinpath("detection.toml").read_bytes())
    assert ScoreOptions.of(detection=load_detection(whole)) == ScoreOptions.of()  # the usual ones


def test_fitted_curves_are_written_and_read(tmp_path):
    fitted = {("camera", "car"): DetectionCurve(0.9, 250.0, 1.2)}
    path = tmp_path / "fitted.json"
    save_detection(fitted, path)
    curves = load_detection(path)
    assert curves == detection_curves().with_curves(fitted)
    assert curves.of("camera")[CLASSES.index("car")] == fitted["camera", "car"]
    assert json.loads(path.read_text())["camera"]["car"]["half"] == 250.0
    save_detection(curves, path)
    assert load_detection(path) == curves
    with pytest.raises(InspeError, match="did you mean lidar"):
        save_detection({("lidr", "car"): DetectionCurve(0.9, 250.0, 1.2)}, path)
    with pytest.raises(InspeError, match=r"must end in \.json"):
        save_detection(fitted, tmp_path / "fitted.toml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[lidar.pedestrain]\nmost = 0.9\nhalf = 8\nslope = 1", "did you mean pedestrian"),
        (
            "[sonar.car]\nmost = 0.9\nhalf = 8\nslope = 1",
            "unknown key.*allowed: camera, lidar, radar",
        ),
        ("[lidar.car]\nmost = 0.9\nhalf = 8", r"lidar.car.slope: missing key"),
        ("[lidar.car]\nmost = 1.2\nhalf = 8\nslope = 1", r"lidar.car: .*most is in 0 … 1"),
        ("[lidar.car]\nmost = '0.9'\nhalf = 8\nslope = 1", "most: must be a number .* got '0.9'"),
        ("[lidar.car]\nmost = nan\nhalf = 8\nslope = 1", "lidar.car.most: .*finite"),
        ("[lidar.car\n", "not TOML"),
        ("", "it has no curve"),
    ],
)
def test_a_file_of_anything_else_is_refused(tmp_path, text, message):
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(InspeError, match=rf"mine.toml: .*{message}"):
        load_detection(path)


def test_a_file_that_is_missing_or_of_another_kind_is_refused(tmp_path):
    with pytest.raises(InspeError, match="no such file"):
        load_detection(tmp_path / "mine.toml")
    with pytest.raises(InspeError, match=r"ending .toml or .json"):
        load_detection(tmp_path / "mine.yaml")
    (tmp_path / "mine.json").write_text("[1]")
    with pytest.raises(InspeError, match="must hold keys with values: camera, lidar"):
        load_detection(tmp_path / "mine.json")
