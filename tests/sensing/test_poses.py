"""Poses of matrices, cameras of intrinsics, and poses solved from pixels."""

import csv
import json
import re

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from worlds import DEPLOYMENTS, needs_deployments

from inspe_jax import CameraSpec, InspeError, Lens, Pose, layouts_from, solve_pose
from inspe_jax.core import carla_frame
from inspe_jax.core.geometry import pose_matrix
from inspe_jax.sensing.catalogue import check_spec, spec_of, table_of

rng = np.random.default_rng(5)
POSES = [[1, -2, 6, 0.2, -0.5, 2.5], [0, 0, 8, 0, -np.pi / 2, 1.0], [3, 4, 5, -3.0, 1.2, -3.1]]
LENS = Lens(1200.0, 1210.0, 950.0, 545.0)
OPTICAL = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # columns: right, down, ahead in the body


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("direction", ["sensor_to_world", "world_to_sensor"])
def test_a_matrix_of_any_axes_and_direction_gives_its_pose(pose, direction):
    body = pose_matrix(pose)
    optical = body.copy()
    optical[:3, :3] = body[:3, :3] @ OPTICAL
    unreal = carla_frame.matrix(carla_frame.to_carla(pose))
    for axes, matrix in (("body", body), ("optical", optical), ("carla", unreal)):
        given = matrix if direction == "sensor_to_world" else np.linalg.inv(matrix)
        found = Pose.from_matrix(given.tolist(), convention=axes, direction=direction)
        np.testing.assert_allclose(pose_matrix(found), body, atol=1e-12)
        rounded = Pose.from_matrix(np.round(given, 3), convention=axes, direction=direction)
        assert np.abs(pose_matrix(rounded) - body).max() < 0.01


@pytest.mark.parametrize(("change", "message"), [
    (lambda m: m.T, "is transposed: its translation is in the last row; transpose it"),
    (lambda m: m @ np.diag([1, -1, 1, 1]), "is mirrored: its determinant is −1"),
    (lambda m: np.diag([0.9, 1, 1, 1]) @ m, r"not a rotation: its rows have lengths 0.900, 1.000"),
    (lambda m: m + [[0], [0], [0], [1]], r"has the last row \[1.0, 1.0, 1.0, 2.0\]"),
    (lambda m: m[:2], r"must be 3 × 4 or 4 × 4 numbers, got shape \(2, 4\)"),
    (lambda m: m * np.nan, "has a number that is not finite"),
    (lambda m: [["x"]], "must be 3 × 4"),
])  # fmt: skip
def test_no_pose_is_made_of_a_matrix_that_has_none(change, message):
    with pytest.raises(InspeError, match=message):
        Pose.from_matrix(change(pose_matrix(POSES[0])), convention="body",
                         direction="sensor_to_world")  # fmt: skip


def test_a_camera_has_the_views_of_its_intrinsics_and_is_saved():
    """The edges of its picture are where the pinhole has them; its table is read back."""
    spec = CameraSpec.from_intrinsics("x", 1920, 1200, fx=1345.62, fy=1500.0, cx=975.88, cy=632.31,
                                      depth=80.0)  # fmt: skip
    edges = np.arctan2([975.88, 1920 - 975.88], 1345.62), np.arctan2([632.31, 1200 - 632.31], 1500)
    np.testing.assert_allclose(spec.field_of_view, [np.sum(one) for one in edges])
    rows = np.arctan(spec.grid.rows)
    half = 5 / 1500  # of a ray's ten pixels
    assert rows[-1] == pytest.approx(np.arctan(632.31 / 1500 - half))
    assert spec_of(table_of(spec), "x", "test") == spec
    check_spec(spec)
    by_view = CameraSpec.from_intrinsics("x", 800, 600, hfov_deg=90, vfov_deg=60, depth=30.0)
    np.testing.assert_allclose(np.degrees(by_view.field_of_view), [90, 60])
    square = CameraSpec.from_intrinsics("x", 800, 600, vfov_deg=60, depth=30.0)
    assert square.focals == (square.focal, square.focal)
    assert square.focal_y is None


@pytest.mark.parametrize(("given", "message"), [
    (dict(), "give either fx and fy, or a field of view"),
    (dict(fx=900, hfov_deg=60), "give either"),
    (dict(hfov_deg=400), "must be positive, a field of view below 180°"),
    (dict(fx=900, fy=np.nan), "its numbers must be positive"),
    (dict(fx=900, cx=600, cy=960), r"\(600, 960\) in a picture of 1920 × 1200: width and height"),
    (dict(fx=900, cx=-1), "is outside of it: give the size that the lens was found for"),
])  # fmt: skip
def test_no_camera_is_made_of_intrinsics_that_do_not_fit(given, message):
    with pytest.raises(InspeError, match=message):
        CameraSpec.from_intrinsics("x", 1920, 1200, depth=30.0, **given)


# ── Poses from pixels ───────────────────────────────────────────────────────


@pytest.mark.parametrize(("lens", "held"), [
    (LENS, False), (LENS._replace(distortion=(-0.2, 0.1, 1e-3, -2e-3, 0.01)), True),
    (Lens(340.0, 340.0, 634.0, 460.0, (-0.03, 0.004, -2e-3, 3e-4), fisheye=True), False),
])  # fmt: skip
def test_a_pose_is_found_again_from_its_own_pixels(lens, held):
    """Noise of half a pixel moves it by as much as its covariance says."""
    pose = Pose(4.0, -12.0, 7.5, 0.03, -0.5, 1.9)
    matrix = pose_matrix(pose)
    ahead = rng.uniform([8, -5, -6], [30, 5, 0], (25, 3))
    points = ahead @ matrix[:3, :3].T + matrix[:3, 3]
    points[:, 2] *= 0.2  # nearly on a plane, as roads are
    seen = lens.pixels((points - matrix[:3, 3]) @ matrix[:3, :3] @ OPTICAL)
    place = pose[:3] if held else None
    np.testing.assert_allclose(solve_pose(seen, points, lens, place=place).pose, pose, atol=1e-5)
    noisy = solve_pose(seen + rng.normal(0, 0.5, seen.shape), points, lens, place=place)
    turn = Rotation.from_matrix(pose_matrix(noisy.pose)[:3, :3] @ matrix[:3, :3].T).as_rotvec()
    off = np.concatenate([np.subtract(noisy.pose[:3], pose[:3]), turn])
    np.testing.assert_array_less(np.abs(off), 4 * np.sqrt(np.diag(noisy.covariance)) + 1e-12)
    assert 0.4 < noisy.rms < 1.0


@pytest.mark.parametrize(("pixels", "points", "lens", "message"), [
    (np.ones((3, 2)), np.eye(3), LENS, "pairs: 3, but a pose needs 4"),
    (np.ones((5, 2)), np.outer(np.arange(5), [1, 2, 0]), LENS, "all points lie on one line"),
    (np.ones((5, 2)), np.ones((4, 3)), LENS, r"pixels: must be 4 × 2 numbers, got shape \(5, 2\)"),
    (5, 5, LENS, "points: must be 0 × 3"),
    (np.ones((4, 2)), np.eye(4, 3), LENS._replace(distortion=(0.0,) * 8 + (1.0,)), "only k1, k2"),
])  # fmt: skip
def test_pairs_without_a_pose_are_refused(pixels, points, lens, message):
    with pytest.raises(InspeError, match=message):
        solve_pose(pixels, points, lens)


CAMERA = dict(name="a", width=1920, height=1080)
LEVEL = np.eye(4)
LEVEL[:3] = np.column_stack([OPTICAL, [4, 3, 6]])
CAMERA |= dict(camera_matrix=[[1200, 0, 960], [0, 1210, 545], [0, 0, 1]])


def calibrated(folder, *, devices=(), unit="m", **camera):
    """What is read of a calibration with one camera."""
    content = dict(devices=dict(devices), sensors=[CAMERA | camera])
    (folder / "in.json").write_text(json.dumps(content, default=np.ndarray.tolist))
    return layouts_from(folder / "in.json", unit=unit)


@pytest.mark.parametrize("place", [None, [4.0, 3.0, 6.0]])
def test_pairs_in_millimetres_give_the_pose_and_deviations_in_metres(tmp_path, place):
    at = np.array([[20, -5, 0], [20, 5, 0], [40, -8, 0], [40, 8, 0], [30, 0, 2], [25, 3, 1]], float)
    seen = Lens(1200.0, 1210.0, 960.0, 545.0).pixels((at - [4, 3, 6]) @ OPTICAL)
    seen += np.random.default_rng(1).normal(0, 1, seen.shape)
    metres, again = (
        calibrated(
            tmp_path, pairs=np.column_stack([seen, at / scale]), unit=unit,
            **({} if place is None else dict(position=np.divide(place, scale))),
        )
        for unit, scale in (("m", 1.0), ("mm", 0.001))
    )  # fmt: skip
    np.testing.assert_allclose(again.layout.poses, metres.layout.poses, atol=1e-6)
    np.testing.assert_allclose(again.fits["a"].pose, metres.fits["a"].pose, atol=1e-6)
    assert again.notes == metres.notes


def test_a_calibrated_camera_is_its_device_only_with_the_same_picture(tmp_path):
    """Another size of the picture or image circle is another camera, with the device's depth."""
    ceiling = dict(kind="camera", width=1920, height=1080, depth_m=33.0, downsample=0.1)
    ceiling |= dict(focal_px=1200.0, focal_y_px=1210.0, principal_px=[960.0, 545.0])
    ceiling |= dict(lens="fisheye", image_circle_deg=150.0)
    for change, same in (
        (dict(), True), (dict(image_circle_deg=150), True), (dict(image_circle_deg=120), False),
        (dict(width=1900), False), (dict(height=1090), False),
    ):  # fmt: skip
        own = CAMERA | dict(model="fisheye", device="eye", sensor_to_frame=LEVEL) | change
        spec = calibrated(tmp_path, **own, devices=dict(eye=ceiling)).layout.sensors[0].spec
        assert (spec.name == "eye", spec.depth) == (same, 33.0)
        for key in change.keys() - {"image_circle_deg"}:
            assert getattr(spec, key) == change[key]
        circle = change.get("image_circle_deg", 150 if same else None)
        assert spec.image_circle == (circle and pytest.approx(np.radians(circle)))


def pairs(name, camera, *columns):
    """Columns of the pairs of a camera in a file of test input."""
    lines = (DEPLOYMENTS / name).read_text().splitlines()
    rows = csv.DictReader(line for line in lines if not line.startswith("#"))
    own = [row for row in rows if row["camera"] == camera and row.get("set") != "old"]
    return np.array([[float(row[key]) for key in columns] for row in own])


@needs_deployments
@pytest.mark.parametrize("k", [0, 1])
def test_mcitys_fisheyes_hang_where_its_solution_has_them(k):
    """By plain least squares the same to a centimetre; robust ones within its uncertainty."""
    given = yaml.safe_load((DEPLOYMENTS / "mcity/sensors.yaml").read_text())["cameras"][k]
    u, v, x, y = pairs("mcity/point_pairs.csv", given["name"], "u_px", "v_px", "east_m",
                       "north_m").T  # fmt: skip
    own, lens = np.column_stack([x, y, 0 * x]), given["intrinsics"]
    lens = Lens(lens["f"], lens["f"], lens["cx"], lens["cy"], fisheye=True)
    at = [given[key] for key in ("east_m", "north_m", "height_m")]
    right = np.array(given["rotation_world_to_camera"]).T @ OPTICAL.T
    sure = given["uncertainty"]
    rough = 5.0, sure["position_m"], sure["azimuth_deg"]
    for robust, place, turned in ((1e6, 0.01, 0.1), rough):
        fit = solve_pose(np.column_stack([u, v]), own, lens, robust=robust)
        np.testing.assert_allclose(fit.pose[:3], at, atol=place)
        turn = Rotation.from_matrix(pose_matrix(fit.pose)[:3, :3] @ right.T)
        assert np.degrees(turn.magnitude()) < turned
        assert fit.rms == pytest.approx(given["solution"]["rms_px"], abs=0.4)


@needs_deployments
@pytest.mark.parametrize("k", range(4))
def test_the_a9s_long_lenses_look_as_its_independent_check_has_them(k):
    """With the place free. It is weak along the road there, and only the ray is compared."""
    content = yaml.safe_load((DEPLOYMENTS / "a9_s040_s050.yaml").read_text())
    focal = float(re.findall(r"\d{4}\.\d+", content["independent_check"]["what"])[k])
    given = content["cameras"][k]
    columns = "u_px", "v_px", "east_m", "north_m", "z_m"
    rows = pairs("a9_pairs.csv", given["name"], *columns)
    fit = solve_pose(rows[:, :2], rows[:, 2:], Lens(focal, focal, 960.0, 600.0))
    expected = content["independent_check"]["centre_ray_place_free"][given["name"]]
    sure, azimuth = given["uncertainty"], (90 - np.degrees(fit.pose.yaw)) % 360
    for of, atol in ((expected, 0.1), (given, None)):
        pitch, turn = atol or sure["pitch_deg"], atol or sure["azimuth_deg"] + 0.01
        assert np.degrees(fit.pose.pitch) == pytest.approx(of["pitch_deg"], abs=pitch)
        assert azimuth == pytest.approx(of["azimuth_deg"], abs=turn)
