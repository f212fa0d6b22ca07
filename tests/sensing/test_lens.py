"""Lenses against OpenCV's own projection, back again, and where a calibration does not hold."""

import numpy as np
import pytest

from inspe_jax.core.errors import InspeError
from inspe_jax.sensing.catalogue import spec_of, table_of
from inspe_jax.sensing.layout import load_layout, save_layout
from inspe_jax.sensing.lens import Lens
from inspe_jax.sensing.sensors import CameraSpec

from worlds import CEILING, place_sensors  # isort: skip

BROWN = (-0.28, 0.09, 1e-3, -2e-3, -0.013)
RATIONAL = (0.3, 0.05, 5e-4, -3e-4, 0.01, 0.5, 0.02, 0.001)
KANNALA = (-0.03, 0.004, -0.002, 3e-4)
AHEAD = [[0.1, -0.2, 1.0], [-0.55, 0.3, 1.0], [0.6, 0.32, 1.0], [2.4, -1.6, 4.0]]
WIDE = [[0.1, -0.2, 1.0], [-3.0, 2.0, 1.0], [5.0, 1.0, 0.2], [-0.5, -4.0, 0.5]]
KEYS = dict(kind="camera", width=1280, height=960, depth_m=30.0, downsample=0.1)


@pytest.mark.parametrize(("distortion", "fisheye", "points", "pixels"), [
    (BROWN, False, AHEAD, [[1058.4423375, 344.93567175], [460.926555234, 809.464335174],
                           [1491.110776676, 821.372560485], [1483.1848576, 194.526393984]]),
    (RATIONAL, False, AHEAD, [[1058.990864417, 343.993138454], [443.164266412, 819.221998638],
                              [1518.475596563, 835.177247145], [1514.527204894, 174.16648477]]),
    ((), True, WIDE, [[1058.381614338, 345.204403611], [-121.870536135, 1254.034553849],
                      [2461.850690719, 837.366436762], [780.473134791, -881.852772456]]),
    (KANNALA, True, WIDE, [[1058.239679364, 345.485434858], [-71.563702006, 1220.832043324],
                           [2364.087852726, 818.00939484], [790.868320417, -799.522902301]]),
])  # fmt: skip
def test_pixels_are_opencvs_and_their_rays_lead_back(distortion, fisheye, points, pixels):
    """cv2.projectPoints and cv2.fisheye.projectPoints of OpenCV 5.0.0 printed the pixels."""
    lens, points = Lens(1000.0, 990.0, 960.0, 540.0, distortion, fisheye), np.array(points)
    np.testing.assert_allclose(lens.pixels(points), pixels, atol=1e-6)
    body = points[:, [2, 0, 1]] * [1, -1, -1]
    ways = body / np.linalg.norm(body, axis=1)[:, None]
    np.testing.assert_allclose(lens.rays(np.array(pixels)), ways, atol=1e-9)


def test_a_grid_has_the_rays_of_its_pixels_and_none_beyond_the_circle():
    """Pixels of 10 × 10, from the lowest row up and from right to left."""
    u, v = np.meshgrid(np.arange(1275.0, 0, -10), np.arange(955.0, 0, -10))
    at = np.column_stack([u.ravel(), v.ravel()])
    shown = np.hypot(*(at - CEILING.principal).T) <= CEILING.focal * np.radians(185 / 2)
    assert 0.5 < shown.mean() < 0.9
    ways = CEILING.grid.directions()
    np.testing.assert_allclose(ways, CEILING.optics.rays(at[shown]), atol=1e-12)
    assert np.degrees(np.arccos(ways[:, 0].min())) == pytest.approx(92.5, abs=1)
    assert np.degrees(CEILING.azimuth_limits) == pytest.approx([-92.5, 92.5])
    assert (CEILING.optics.beyond_circle(at) == ~shown).all()


def test_keys_of_a_lens_are_read_and_saved(tmp_path):
    fisheye = KEYS | dict(lens="fisheye", hfov_deg=200.0, image_circle_deg=190.0)
    spec = spec_of(fisheye | dict(distortion=list(KANNALA)), "eye", "here")
    edge = spec.optics.pixels(np.array([[np.cos(np.radians(10)), 0.0, -np.sin(np.radians(10))]]))
    assert edge[0] == pytest.approx([1280, 480])
    assert spec_of(table_of(spec), "eye", "here") == spec
    bent = spec_of(KEYS | dict(hfov_deg=80.0, distortion=[-0.28, 0.09, 0.0, 0.0]), "bent", "here")
    assert np.degrees(bent.field_of_view[0]) == pytest.approx(80.0)
    layout = place_sensors((spec, [0, 0, 6, 0, -1.5, 0]), (bent, [9, 0, 6, 0, -0.3, 0]))
    save_layout(layout, tmp_path / "layout.yaml")
    again = load_layout(tmp_path / "layout.yaml")
    assert [one.spec for one in again.sensors] == [spec, bent]


@pytest.mark.parametrize(("given", "message"), [
    (dict(distortion=(-0.5,)), "device 'x': distortion: folds the picture, .*image_circle_deg"),
    (dict(distortion=(0.0, 0.0, 0.8)), "folds the picture"),
    (dict(distortion=(0.0,) * 8 + (0.1,)), "only k1, k2, p1, p2, k3, k4, k5, k6 are known"),
    (dict(distortion=(0.0,) * 4 + (0.1,), fisheye=True), "only k1, k2, k3, k4 of a fisheye"),
    (dict(distortion=(-0.4,), fisheye=True, image_circle_deg=185), "folds the picture"),
    (dict(image_circle_deg=180), "only a 'lens: fisheye' sees 180° or more"),
])  # fmt: skip
def test_lenses_that_show_a_direction_twice_are_refused(given, message):
    with pytest.raises(InspeError, match=message):
        CameraSpec.from_intrinsics("x", 1920, 1080, fx=1000.0, depth=30.0, **given)


@pytest.mark.parametrize("degrees", [0, -50, 500, np.nan])
def test_an_image_circle_is_one_that_a_lens_has(degrees):
    given = dict(fx=1000.0, depth=30.0, fisheye=True, image_circle_deg=degrees)
    with pytest.raises(InspeError, match="image_circle_deg: must be above 0 and at most 220"):
        CameraSpec.from_intrinsics("x", 1920, 1080, **given)


def test_a_fisheyes_image_circle_is_as_wide_as_its_view():
    for view, circle in ((200.0, 200.0), (170.0, None)):
        spec = spec_of(KEYS | dict(lens="fisheye", hfov_deg=view), "eye", "here")
        by_view = CameraSpec.from_intrinsics("eye", 1280, 960, hfov_deg=view, depth=30.0,
                                             fisheye=True)  # fmt: skip
        assert spec == by_view
        assert np.degrees(spec.field_of_view[0]) == pytest.approx(view)
        assert spec.image_circle == (circle and pytest.approx(np.radians(circle)))


def test_a_field_of_view_is_what_a_bent_lens_shows():
    """One rule for a catalogue's keys and for a calibration, along a row and down a column."""
    keys = KEYS | dict(hfov_deg=80.0, distortion=list(BROWN[:2]))
    given = dict(depth=30.0, distortion=BROWN[:2])
    spec = CameraSpec.from_intrinsics("bent", 1280, 960, hfov_deg=80.0, **given)
    assert spec == spec_of(keys, "bent", "here")
    tall = CameraSpec.from_intrinsics("bent", 1280, 960, vfov_deg=60.0, **given)
    np.testing.assert_allclose(np.degrees(tall.field_of_view[1]), 60.0)


@pytest.mark.parametrize("fisheye", [False, True])
def test_what_is_straight_behind_is_far_off(fisheye):
    """And lists will do in place of arrays."""
    lens = Lens(1000.0, 1000.0, 960.0, 540.0, fisheye=fisheye)
    seen = lens.pixels([[0.0, 0.0, -5.0], [1e-9, 0.0, -5.0], [0.0, 0.0, 5.0]])
    assert (np.hypot(*(seen[:2] - [960, 540]).T) > 3000).all()
    np.testing.assert_allclose(seen[2], [960, 540])
    np.testing.assert_allclose(lens.rays([[960.0, 540.0]]), [[1, 0, 0]], atol=1e-9)
    assert not lens.beyond_circle([[960.0, 540.0]]).any()


def test_distortion_is_also_opencvs_array():
    given = dict(fx=1200.0, depth=30.0)
    one, other = (
        CameraSpec.from_intrinsics("x", 1920, 1080, distortion=own, **given)
        for own in (BROWN, np.array([BROWN]))
    )
    assert one == other
    with pytest.raises(InspeError, match="device 'x': distortion: must be numbers"):
        CameraSpec.from_intrinsics("x", 1920, 1080, distortion="abcd", **given)


def test_within_an_image_circle_a_lens_holds_that_folds_further_out():
    given = dict(fx=1000.0, depth=30.0, distortion=(-0.4,), image_circle_deg=60)
    spec = CameraSpec.from_intrinsics("x", 1920, 1080, **given)
    assert np.degrees(spec.azimuth_limits) == pytest.approx([-30, 30])
    with pytest.raises(InspeError, match="a varifocal lens is a pinhole"):
        spec_of(KEYS | dict(hfov_deg=[40.0, 90.0], distortion=[0.1]), "zoom", "here")
