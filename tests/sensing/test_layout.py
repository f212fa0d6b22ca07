"""Layout files: what a good one means, and the one message of every bad one."""

from dataclasses import replace

import jax
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from worlds import LIDAR, place_sensors, world

from inspe_jax.core.errors import InspeError
from inspe_jax.core.geometry import rotation
from inspe_jax.sensing.catalogue import device
from inspe_jax.sensing.layout import Sensor, Unit, load_layout, make_layout, save_layout

GOOD = """
units:
  - name: pole
    base: [12.0, -3.0, 0.5]
    sensors:
      - device: paper-camera
        height: 6.0
        offset: [0.5, -0.25]
        yaw_deg: 90
        pitch_deg: -15
      - {device: paper-lidar-32, height: 5.0, yaw_deg: 0}
"""


def write(tmp_path, text):
    path = tmp_path / "layout.yaml"
    path.write_text(text)
    return path


def test_a_file_gives_world_poses(tmp_path):
    layout = load_layout(write(tmp_path, GOOD))
    expected = [[12.5, -3.25, 6.5, 0, np.radians(-15), np.pi / 2], [12, -3, 5.5, 0, 0, 0]]
    np.testing.assert_allclose(layout.poses, expected, atol=1e-12)
    assert [s.spec for s in layout.sensors] == [
        device("paper-camera").spec,
        device("paper-lidar-32").spec,
    ]
    assert layout.units == (Unit("pole", (12.0, -3.0, 0.5)),)


@pytest.mark.parametrize(("old", "new", "message"), [
    ("height: 6.0", "heigth: 6.0", r"sensors\[0\].heigth: unknown key; did you mean height"),
    ("units:", "unit:", r"unit: unknown key; did you mean units\?"),
    ("        height: 6.0\n", "", r"units\[0\].sensors\[0\].height: missing key"),
    ("device: paper-camera", "device: paper-camera-middy", "paper-camera"),
    ("height: 6.0", "height: .nan", r"height: .*finite"),
    ("base: [12.0, -3.0, 0.5]", "base: [12.0]", r"units\[0\].base: needs at least 2, has 1"),
    ("pitch_deg: -15", "pitch_deg: -115", r"pitch_deg: .*-90.*-115"),
    ("offset: [0.5, -0.25]", "offset: [0.0, 2.1]", r"unit 'pole': sensors 'pole 1' and 'pole "
     "2' are 2.10 m apart in plan; at most 2 m"),
    ("height: 6.0", "height: 9.5", r"'pole 2' are 4.50 m apart in height; at most 4 m"),
    ("yaw_deg: 90", "yaw_deg: 1.0e+30", r"yaw_deg: .*360"),
    ("base: [12.0,", "base: [1.0e+200,", r"units\[0\].base\[0\]: "),
    ("height: 5.0,", "height: 5.0, name: pole 1,", "two sensors are named 'pole 1'"),
    ("units:", "order: [pole 2, pole 3]\nunits:", "order: must name each sensor once: pole 1"),
    (GOOD, "", "the layout is empty"),
    (GOOD, "units:\n  - base: [0, 0]\n    sensors: []", r"sensors: needs at least 1, has 0"),
    (GOOD, "just words", "the file: must hold keys with values: devices, name, order, profile, "
     "searched_for, units"),
    (GOOD, "units: [}", "not YAML"),
    *(("units:", f"devices:\n  x: {table}\nunits:", rf"devices.x: {message}")
      for table, message in (
        ("{like: paper-camara}", "like: no device 'paper-camara'.*mean paper-camera"),
        ("{depth_m: 3}", "kind: missing key"),
        ("{kind: [lidar]}", r"kind: must be 'lidar' .*or 'thermal', got \['lidar'\]"),
        ("{like: paper-camera, range_m: 3}", "range_m: unknown key"),
        ("{like: paper-lidar-32, channels: 3}", "channels: 3, but elevations_deg has"),
        ("3", "must be a table of one device, got 3"),
      )),
])  # fmt: skip
def test_each_bad_file_gets_one_clear_message(tmp_path, old, new, message):
    path = write(tmp_path, GOOD.replace(old, new))
    with pytest.raises(InspeError, match=message) as caught:
        load_layout(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_a_base_without_height_stands_on_the_scenes_ground(tmp_path):
    scene = world(slope=0.1, count=0)
    path = write(tmp_path, GOOD.replace("base: [12.0, -3.0, 0.5]", "base: [10.0, -5.0]"))
    assert load_layout(path, scene).poses[:, 2] == pytest.approx([7.0, 6.0], abs=1e-6)
    assert load_layout(path).poses[:, 2] == pytest.approx([6.0, 5.0])
    given = load_layout(write(tmp_path, GOOD), scene)
    assert given.poses[:, 2] == pytest.approx([6.5, 5.5])


pose = st.tuples(
    st.floats(-500, 500), st.floats(-500, 500), st.floats(0.5, 12), *[st.floats(-1.5, 1.5)] * 3
)


@settings(max_examples=40, deadline=None)
@given(poses=st.lists(pose, min_size=1, max_size=4))
def test_saved_layouts_load_to_the_same_poses(tmp_path_factory, poses):
    """To the nanometre and 1e-9° that the file keeps."""
    spec = device("paper-lidar-32").spec
    sensors = [Sensor(f"s{i}", spec, i) for i in range(len(poses))]
    units = [Unit(f"u{i}", (p[0], p[1], 0.25)) for i, p in enumerate(poses)]
    layout = make_layout(sensors, units, np.array(poses))
    path = tmp_path_factory.mktemp("layout") / "layout.yaml"
    save_layout(layout, path)
    again = load_layout(path)
    np.testing.assert_allclose(again.poses, layout.poses, atol=1e-8)
    assert again.sensors == layout.sensors


def test_a_unit_at_its_limit_and_sensors_out_of_order_reload_the_same(tmp_path):
    """Two sensors exactly 2 m apart at an odd angle; the units of the input interleave. Poses, and
    arrays of one's own, belong to the sensors as they were given, also when a file is read again.
    """
    spec = device("paper-lidar-32").spec
    way = 2.0 * np.array([np.cos(0.7), np.sin(0.7)])
    poses = np.array([[1 / 3, 0.1, 5, 0, 0, 1], [9, 9, 5, 0, 0, 2], [1 / 3, 0.1, 5, 0, 0, 3]])
    poses[2, :2] += way
    sensors = [Sensor(name, spec, unit) for name, unit in (("a", 0), ("b", 1), ("c", 0))]
    units = [Unit("u", (1 / 3, 0.1, 0.0)), Unit("v", (9e5, 9.5e6, 0.0))]  # a UTM northing
    poses[1, :2] = units[1].base[:2]
    layout = make_layout(sensors, units, poses)
    assert layout.sensors == tuple(sensors)
    np.testing.assert_array_equal(layout.poses, poses)
    assert layout.members() == ((0, 2), (1,))
    save_layout(layout, tmp_path / "l.yaml")
    again = load_layout(tmp_path / "l.yaml")
    assert again.sensors == layout.sensors
    np.testing.assert_allclose(again.poses, layout.poses, atol=1e-8)
    assert layout.pose(1).yaw == 2
    in_order = make_layout([sensors[k] for k in (0, 2, 1)], units, poses[[0, 2, 1]])
    save_layout(in_order, tmp_path / "m.yaml")
    assert "order" not in yaml.safe_load((tmp_path / "m.yaml").read_text())


def test_layouts_are_equal_and_have_one_hash_by_their_content():
    layout = place_sensors((LIDAR, [1.0, 2.0, 5.0, 0, 0, 0]), (LIDAR, [4.0, 2.0, 5.0, 0, 0, 0]))
    same = replace(layout, poses=jax.numpy.asarray(layout.poses, float))
    other = layout.with_poses((layout.poses + [0, 0, 0.5, 0, 0, 0]).tolist())
    assert layout == same != other
    assert len({layout, same, other}) == 2
    assert layout != replace(layout, name="another")
    with pytest.raises(InspeError, match=r"shape \(1, 6\), expected \(2, 6\)"):
        layout.with_poses(np.zeros((1, 6)))
    assert jax.jit(lambda a: a == a and a.poses.sum() > 0)(layout)
    leaves, structure = jax.tree.flatten(layout)
    assert jax.tree.unflatten(structure, leaves) == layout
    assert [leaf.shape for leaf in leaves] == [(2, 6)]


def test_devices_of_ones_own_go_along(tmp_path):
    """Those that the catalogue has not, and those that it has otherwise; no others."""
    catalogued = device("paper-camera").spec
    wide = replace(catalogued, name="wide", focal=200.0, principal=(390.0, 310.0), reliability=0.5)
    dim = replace(device("paper-lidar-32").spec, reach=33.0)
    pose = [1.0, 2.0, 5.0, 0, 0, 0]
    layout = place_sensors(*((spec, pose) for spec in (wide, dim, catalogued, LIDAR)))
    save_layout(layout, tmp_path / "l.yaml")
    again = load_layout(tmp_path / "l.yaml")
    assert yaml.safe_load((tmp_path / "l.yaml").read_text())["devices"].keys() == {
        "wide", "paper-lidar-32", "test-lidar",
    }  # fmt: skip
    for one, same in zip(layout.sensors, again.sensors, strict=True):
        assert same.name == one.name
        for key, value in vars(one.spec).items():
            if not key.startswith("_") and key != "grid":
                assert getattr(same.spec, key) == pytest.approx(value, abs=1e-9), key


def test_a_device_like_another(tmp_path):
    own = """
devices:
  far: {like: paper-camera, depth_m: 60, hfov_deg: 90}
  few: {like: paper-lidar-32, elevation_range_deg: [-30, 0], reliability: 0.5}
  table: {like: paper-lidar-64, elevations_deg: [-10, 0]}
  eight: {like: paper-lidar-64, elevation_range_deg: [-10, 0], channels: 8}
units:
  - base: [0, 0]
    sensors: [%s]
"""
    names = ("far", "few", "table", "eight", "paper-camera")
    sensors = ", ".join(f"{{device: {name}, height: 5, yaw_deg: 0}}" for name in names)
    far, few, table, eight, plain = (
        sensor.spec for sensor in load_layout(write(tmp_path, own % sensors)).sensors
    )
    assert plain == device("paper-camera").spec
    assert far == replace(plain, name="far", depth=60.0, focal=pytest.approx(400.0))
    assert (len(few.elevations), few.reach, few.reliability) == (32, 50.0, 0.5)
    np.testing.assert_allclose(np.degrees(few.elevations)[[0, -1]], [-30, 0], atol=1e-9)
    np.testing.assert_allclose(np.degrees(table.elevations), [-10, 0])
    np.testing.assert_allclose(np.degrees(eight.elevations), np.linspace(-10, 0, 8), atol=1e-9)


def test_what_could_not_be_read_back_is_not_written(tmp_path):
    other = replace(LIDAR, reach=12.0)
    two = place_sensors((LIDAR, [1.0, 2.0, 5.0, 0, 0, 0]), (other, [1.0, 2.0, 6.0, 0, 0, 0]))
    with pytest.raises(InspeError, match="two devices are named 'test-lidar'"):
        save_layout(two, tmp_path / "l.yaml")
    spec = device("paper-lidar-32").spec
    steep = place_sensors((spec, [1.0, 2.0, 5.0, 0, 2.0, 0]))
    with pytest.raises(InspeError, match="pitch_deg"):
        save_layout(steep, tmp_path / "l.yaml")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("units", "poses", "message"), [
    ([7], np.ones((1, 6)), "no unit 7"),
    ([0], np.ones((1, 5)), r"shape \(1, 5\), expected \(1, 6\)"),
    ([0], [[1.0], [2.0, 3.0]], "poses: give rows of six numbers"),
    ([0], np.full((1, 6), np.inf), r"poses\[0, 0\]: inf is not finite"),
    ([], np.zeros((0, 6)), "the layout is empty"),
])  # fmt: skip
def test_layouts_that_do_not_fit_together(units, poses, message):
    sensors = [Sensor(f"s{i}", LIDAR, u) for i, u in enumerate(units)]
    with pytest.raises(InspeError, match=message):
        make_layout(sensors, [Unit("u", (0.0, 0.0, 0.0))], poses)


def test_rays_are_the_specification_turned_and_moved():
    layout = place_sensors((LIDAR, [1.0, 2.0, 5.0, 0.1, -0.2, 0.3]))
    origin, directions, reach = layout.rays(0)
    assert origin.tolist() == [1, 2, 5]
    assert reach == 50
    assert directions.shape == (32 * 1800, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-12)
    # Channel 0, azimuth 0 is at −180°: backward and down 25°, then turned.
    body = [-np.cos(np.radians(25)), 0, -np.sin(np.radians(25))]
    turn = np.asarray(rotation(np.array([0.1, -0.2, 0.3]), np))
    np.testing.assert_allclose(directions[0], turn @ body, atol=1e-12)
