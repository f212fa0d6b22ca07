"""The catalogue against the makers' figures, and the one message of every bad file."""

import tomllib

import numpy as np
import pytest

from inspe_jax.core.errors import InspeError
from inspe_jax.sensing.catalogue import device, devices, spec_of
from inspe_jax.sensing.sensors import CameraSpec, LidarSpec

DEVICES = devices()
LIDARS = [name for name, d in DEVICES.items() if d.kind == "lidar"]

# name, channels, lowest and highest ring, azimuths in a sweep, reach: from the data sheets.
# Hesai print -25..+15 for both; their tables' ends are the rings behind those rounded figures.
SHEETS = [
    ("paper-lidar-32", 32, -19.4, 7.7, 1280, 50),
    ("ideal-lidar-32", 32, -25, 2, 1800, 50),
    ("paper-lidar-64", 64, -19.4, 7.7, 640, 100),
    ("ideal-lidar-64", 64, -25, 2, 1800, 100),
    ("velodyne-vlp-16", 16, -15, 15, 1800, 100),
    ("velodyne-vlp-32c", 32, -25, 15, 1800, 200),
    ("velodyne-hdl-64e", 64, -24.33, 2, 2083, 50),
    ("ouster-os1-64", 64, -21.2, 21.2, 1024, 90),
    ("ouster-os1-128", 128, -21.2, 21.2, 1024, 90),
    ("hesai-pandar64", 64, -24.897, 14.882, 1800, 200),
    ("hesai-xt32", 32, -16, 15, 2000, 80),
    ("hesai-pandar128", 128, -25.016, 14.436, 1800, 200),
    ("robosense-ruby-128", 128, -25, 15, 1800, 200),
    ("robosense-helios-32", 32, -55, 15, 1800, 90),
    ("livox-horizon", 101, -12.55, 12.55, 327, 90),
    ("livox-mid-360", 119, -7, 52, 720, 40),
]


def rings(name):
    """Elevations of a LiDAR in degrees."""
    return np.degrees(DEVICES[name].spec.elevations)


@pytest.mark.parametrize(("name", "channels", "lowest", "highest", "azimuths", "reach"), SHEETS)
def test_lidars_match_their_sheets(name, channels, lowest, highest, azimuths, reach):
    assert {row[0] for row in SHEETS} == set(LIDARS)
    spec = DEVICES[name].spec
    elevations = rings(name)
    assert len(elevations) == channels
    assert (elevations[0], elevations[-1]) == pytest.approx((lowest, highest), abs=1e-9)
    assert (np.diff(elevations) > 0).all()
    assert (spec.azimuth_count, spec.reach) == (azimuths, reach)
    turn = np.radians(81.7) if name == "livox-horizon" else 2 * np.pi
    assert spec.azimuth_fov == pytest.approx(turn)
    assert spec.grid.wraps == (name != "livox-horizon")


@pytest.mark.parametrize(("name", "outer", "slack"), [
    # A calibrated Ruby Plus, which has the Ruby's design.
    ("robosense-ruby-128", [-25.05, -19.65, -16.06, -13.58, -11.75, -10.36, -9.25], 0.07),
    ("robosense-ruby-128", [4.16, 4.41, 4.71, 5.06, 5.46, 5.96, 6.56, 7.41, 9.01, 11.52], 0.03),
    ("velodyne-vlp-32c", [-15.639, -11.31, -8.843, -7.254, -6.148, -5.333, 3.333, 4.667, 7], 0),
    # A calibrated Pandar64, less its constant of 0.018 degrees.
    ("hesai-pandar64", [-24.897, -18.889, 3.04, 5.057, 8.059, 11.032, 14.882], 0.001),
])  # fmt: skip
def test_outer_rings_are_near_those_of_a_unit(name, outer, slack):
    away = np.abs(rings(name)[:, None] - outer).min(axis=0)
    assert away.max() <= slack + 1e-9


@pytest.mark.parametrize(("name", "low", "high", "step", "slack"), [
    ("hesai-pandar128", -6.11, 2.02, 0.125, 0.007),
    ("hesai-pandar128", 2.0, 13.6, 0.5, 0.06),
    ("hesai-pandar128", -24.2, -6.05, 0.5, 0.06),
    ("hesai-pandar64", -6.07, 2.03, 1 / 6, 0.012),
    ("hesai-pandar64", -14.0, -6.05, 1.0, 0.05),  # with the table's -9.885 one gap is 1.15
    ("robosense-ruby-128", -6.4, 3.82, 0.1, 1e-6),
    ("robosense-helios-32", -8.1, 4.1, 4 / 3, 0.011),
    ("robosense-helios-32", -55, -10, 3.0, 1e-6),
    ("hesai-xt32", -16, 15, 1.0, 1e-6),
    ("velodyne-vlp-16", -15, 15, 2.0, 1e-6),
    ("velodyne-vlp-32c", -4, 1.667, 1 / 3, 0.0011),  # of the manual's uneven table
    ("velodyne-hdl-64e", -24.33, -8.83, 0.5, 1e-6),  # two blocks
    ("velodyne-hdl-64e", -8.34, 2, 1 / 3, 0.0011),
])  # fmt: skip
def test_resolution_is_the_published_one(name, low, high, step, slack):
    elevations = rings(name)
    gaps = np.diff(elevations[(elevations > low - 1e-9) & (elevations < high + 1e-9)])
    assert len(gaps) >= 5
    np.testing.assert_allclose(gaps, step, atol=slack)


@pytest.mark.parametrize(
    ("name", "rows", "field"), [("paper-camera", 120, 100), ("basler-aca1600-60gc", 90, 70)]
)
def test_camera_rays_span_its_field_of_view_a_degree_apart(name, rows, field):
    """CARLA's 100° across 800 pixels: the edge rays lie half an enlarged pixel inside ±50°."""
    grid = DEVICES[name].spec.grid
    rays = grid.directions().reshape(rows, 160, 3)
    edge = np.degrees(np.arctan(np.tan(np.radians(field / 2)) * (1 - 1 / 160)))
    azimuths = np.degrees(np.arctan2(rays[..., 1], rays[..., 0]))
    np.testing.assert_allclose([azimuths.min(), azimuths.max()], [-edge, edge], atol=1e-9)
    for neighbours in (rays[:, :-1] * rays[:, 1:], rays[:-1] * rays[1:]):
        assert np.degrees(np.arccos(neighbours.sum(-1))).max() < 1.0


@pytest.mark.parametrize("name", DEVICES)
def test_every_device_says_where_its_figures_come_from(name):
    d = DEVICES[name]
    assert d.name == d.spec.name == name
    assert min(map(len, (d.title, d.maker, d.source, d.note))) >= 4
    assert d.product == (d.maker != "InSPE paper")
    if d.price_usd is not None:
        assert "rice" in d.note  # of which year, or by whom


def test_an_unknown_name_gets_the_nearest():
    message = r"no device 'Velodyne-VLP16': run 'inspe devices' for the list; did you mean .*vlp-16"
    with pytest.raises(InspeError, match=message):
        device("Velodyne-VLP16")


# ── Devices of one's own ────────────────────────────────────────────────────

LIDAR = """
kind = "lidar"
channels = 4
elevations_deg = [-30, -10.5, 0, 2]
azimuth_fov_deg = 90
azimuth_step_deg = 0.5
range_m = 25
reliability = 0.8
"""
CAMERA = """
kind = "camera"
width = 640
height = 480
focal_px = 320
downsample = 0.5
depth_m = 40
"""
EVEN = ("elevations_deg = [-30, -10.5, 0, 2]", "elevation_range_deg = [-30, 0]")


def read(text):
    return spec_of(tomllib.loads(text), "mine", "here: mine")


def test_specs_are_in_radians_with_both_ends_of_even_elevations():
    elevations = (-np.pi / 6, pytest.approx(-0.18325957145940461), 0, pytest.approx(np.pi / 90))
    assert read(LIDAR) == LidarSpec("mine", elevations, 180, np.pi / 2, 25.0, 0.8)
    assert read(CAMERA) == CameraSpec("mine", 640, 480, 320.0, (320.0, 240.0), 0.5, 40.0)
    even = np.degrees(read(LIDAR.replace(*EVEN)).elevations)
    np.testing.assert_allclose(even, [-30, -20, -10, 0])
    square = read(CAMERA.replace("focal_px = 320", "hfov_deg = 90"))
    assert square.focal == pytest.approx(320)  # half the width


@pytest.mark.parametrize(("old", "new", "message"), [
    ("range_m = 25", "range = 25", r"range: unknown key; did you mean range_m\?; allowed"),
    ("range_m = 25\n", "", "mine: range_m: missing key"),
    ("range_m = 25", "range_m = -5", r"mine: range_m: .*greater than 0, got -5"),
    ("range_m = 25", "range_m = inf", r"mine: range_m: .*finite.*got inf"),
    ("reliability = 0.8", "reliability = 1.5", r"mine: reliability: .*equal to 1, got 1.5"),
    ("azimuth_step_deg = 0.5", "azimuth_step_deg = 0", "mine: azimuth_step_deg: .*0.001"),
    ("azimuth_step_deg = 0.5", "azimuth_step_deg = 91", "azimuth_step_deg: 91 is wider.* 90"),
    ("azimuth_fov_deg = 90", "azimuth_fov_deg = 400", "azimuth_fov_deg: .*360, got 400"),
    ("channels = 4", "channels = 5", "mine: channels: 5, but elevations_deg has 4"),
    ("-10.5, 0, 2]", "-40, 0, 2]", "elevations_deg: must ascend strictly, but -40 follows -30"),
    ("-10.5, 0, 2]", "-10.5, 0, 92]", r"elevations_deg\[3\]: .*equal to 90, got 92"),
    ("[-30, -10.5, 0, 2]", "[]", "mine: elevations_deg: .*at least 1"),
    ("elevations_deg = [-30, -10.5, 0, 2]\n", "", "mine: give either elevations_deg or elev"),
    ("range_m", "elevation_range_deg = [0, 1]\nrange_m", "mine: give either elevations_deg or"),
    (f"channels = 4\n{EVEN[0]}", EVEN[1], "channels: elevation_range_deg needs 2 or more"),
    (EVEN[0], "elevation_range_deg = [2, -30]", "elevation_range_deg: must ascend strictly"),
    (EVEN[0], "elevation_range_deg = [2]", "elevation_range_deg: .*at least 2"),
    ('kind = "lidar"', 'kind = "sonar"', "must be 'lidar' .*or 'thermal', got 'sonar'"),
    ('kind = "lidar"\n', "", "mine: kind: missing key"),
    ('kind = "lidar"', 'kind = "camera"', "mine: .*unknown key"),
    ("focal_px = 320", "hfov_deg = 180", "hfov_deg: only a 'lens: fisheye' sees 180° or more"),
    ("focal_px = 320\n", "", "give either hfov_deg or focal_px"),
    ("focal_px = 320", "focal_px = 320\nhfov_deg = 90", "give either hfov_deg or"),
])  # fmt: skip
def test_bad_keys_get_one_clear_message(old, new, message):
    (text,) = (text for text in (LIDAR, CAMERA) if old in text)
    with pytest.raises(InspeError, match=message) as caught:
        read(text.replace(old, new, 1))
    assert str(caught.value).startswith("here: mine: ")
