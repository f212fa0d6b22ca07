"""Opening data sets: the package's own, those of other people, and folders that are none."""

import copy
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from frames import WORLD, assert_same, frame, station
from PIL import Image as Pillow

import inspe_jax.dataset as dataset
from inspe_jax.core.errors import InspeError
from inspe_jax.dataset import Scenario, write_frame, write_protocol

OTHERS = """\
camera0:
  cords: [100.0, 50.0, 2.0, 0.0, 90.0, 0.0]
  extrinsic: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
  intrinsic: [[335.64, 0, 400], [0, 335.64, 300], [0, 0, 1]]
camera1: {cords: [100, 50, 2, 0, -90, 0], intrinsic: [[300, 0, 400], [0, 300, 300], [0, 0, 1]]}
ego_speed: 20.0
lidar_pose: [100.0, 50.0, 1.9, 0.0, 90.0, 0.0]
plan_trajectory: [[1.0, 2.0], [3.0]]
predicted_ego_pos: [100.1, 50.1, 0.1, 0.0, 90.0, 0.0]
true_ego_pos: [100.0, 50.0, 0.0, 0.0, 90.0, 0.0]
vehicles:
  215:
    angle: [0.5, -90.0, 1.0]
    center: [0.0, 0.25, 0.7]
    extent: [2.0, 0.9, 0.7]
    location: [110.0, 50.0, 0]
    speed: 36
"""
"""A frame as OPV2V has it: a car that drives north, which is −y in the left-handed world."""

POINTS = """\
VERSION 0.7
FIELDS x y z rgb
SIZE 4 4 4 4
TYPE F F F F
POINTS 2
DATA ascii
1 2 -1.5 2.34180515e-38
-4 5 -1 0
"""


@pytest.fixture
def others(tmp_path) -> Path:
    """A scenario of two vehicles and a unit, with file names of five digits and no protocol."""
    scenario = tmp_path / "test_culvercity" / "2021_08_18"
    for agent in ("641", "-1", "9"):
        (scenario / agent).mkdir(parents=True)
        (scenario / agent / "00068.yaml").write_text(OTHERS)
        (scenario / agent / "00068.pcd").write_text(POINTS)
    Pillow.new("RGBA", (8, 6), (1, 2, 3, 4)).save(scenario / "641" / "00068_camera0.png")
    second = OTHERS.replace("215:", "900:").replace("speed: 36", "speed: 3")
    (scenario / "9" / "00068.yaml").write_text(second.replace("[100.0, 50.0", "[120.0, 50.0"))
    return scenario


def test_a_data_set_of_other_people(others):
    opened = dataset.open(others)
    (scenario,) = opened.splits["test_culvercity"]
    assert scenario.agents == (-1, 9, 641)
    assert scenario.frames == (68,)
    assert scenario.protocol == {}
    read = scenario.frame(68)
    assert read.time == 68 * 0.05
    first, second = read.boxes
    assert (first.track, first.kind, first.name) == (215, "car", "")
    np.testing.assert_allclose(first.center, [110, -50.25, 0.7])
    np.testing.assert_allclose(first.size, [4, 1.8, 1.4])
    assert first.yaw == pytest.approx(np.pi / 2)
    np.testing.assert_allclose(first.velocity, [0, 10, 0], atol=1e-12)
    assert second.track == 900
    unit, near, far = read.stations
    assert [s.number for s in read.stations] == [1, -9, -641]
    assert far.name == "641"
    np.testing.assert_allclose(near.pose, [120, -50, 0, 0, 0, -np.pi / 2])
    np.testing.assert_allclose(near.scans[0].pose, [120, -50, 1.9, 0, 0, -np.pi / 2])
    np.testing.assert_allclose(unit.scans[0].points, [[1, -2, -1.5, 1], [-4, -5, -1, 0]], rtol=1e-6)
    assert not unit.images
    (picture,) = far.images
    assert picture.rgb.shape == (6, 8, 3)
    assert picture.rgb[0, 0].tolist() == [1, 2, 3]
    assert picture.depth is picture.instance is picture.semantic is None


def test_infra_set_variant(others):
    """Four sections instead of ``vehicles``, and ``lidar_pose0`` with its own file name."""
    agent = others / "-1"
    holds = yaml.safe_load(OTHERS)
    car = holds.pop("vehicles")[215]
    holds["lidar_pose0"] = holds.pop("lidar_pose")
    holds |= {"cars": {}, "trucks": {4: {**car, "name": "vehicle.tesla.cybertruck"}}}
    holds |= {"cyclists": {5: {**car, "obj_type": "Bicycle"}}, "pedestrians": {6: car}}
    del holds["true_ego_pos"]
    (agent / "00068.yaml").write_text(yaml.safe_dump(holds))
    (agent / "00068.pcd").rename(agent / "00068_lidar0.pcd")
    read = Scenario(others).frame(68)
    assert [t.kind for t in read.boxes] == ["truck", "cyclist", "pedestrian", "car", "car"]
    assert read.boxes[0].name == "vehicle.tesla.cybertruck"
    assert len(read.stations[0].scans[0].points) == 2
    np.testing.assert_allclose(read.stations[0].pose[:3], [100, -50, 1.9])


def ours(root: Path) -> Path:
    """Two scenarios in train and one in test, with two frames each."""
    for place in ("train/a", "train/b", "test/c"):
        for number in (0, 2):
            write_frame(root / place, frame(number))
        write_protocol(root / place, {"world": WORLD}, frame().stations)
    (root / "notes").mkdir()
    return root


def test_a_set_a_split_or_a_scenario_can_be_opened(tmp_path):
    root = ours(tmp_path / "set")
    opened = dataset.open(root)
    assert [*opened.splits] == ["train", "test"]
    assert [s.name for s in opened.splits["train"]] == ["a", "b"]
    assert [s.name for s in opened.scenarios] == ["a", "b", "c"]
    for folder, expected in (("train", {"train": ["a", "b"]}), ("test/c", {"test": ["c"]})):
        splits = dataset.open(str(root / folder)).splits
        assert {name: [s.name for s in own] for name, own in splits.items()} == expected


def test_frames_of_a_scenario(tmp_path):
    folder = ours(tmp_path) / "train" / "a"
    (scenario,) = dataset.open(folder).scenarios
    assert scenario.protocol["world"]["town"] == "four_way"
    assert scenario.agents == (-1, -2)
    assert scenario.frames == (0, 2)
    assert_same(scenario.frame(2), frame(2))
    assert [s.name for s in scenario.frame(2).stations] == ["mast 1", "mast 2"]
    with pytest.raises(InspeError, match=r"000004.yaml: no such frame; there are 2, 0 to 2"):
        scenario.frame(4)
    (folder / "-2" / "000002.yaml").unlink()  # the frame is not complete then
    write_protocol(folder, {"world": {**WORLD, "fixed_delta_seconds": 0.1}})
    (scenario,) = dataset.open(folder).scenarios
    assert scenario.frames == (0,)
    write_frame(folder, frame(30))
    assert Scenario(folder).frame(30).time == pytest.approx(3)
    (folder / "data_protocol.yaml").write_text("world: {")
    with pytest.raises(InspeError, match=r"data_protocol.yaml: not YAML"):
        _ = dataset.open(folder).scenarios[0].protocol


def test_pictures_and_points_are_read_when_used(tmp_path):
    """Only once: what was read stays when the files are deleted. Records can be copied before."""
    write_frame(tmp_path, frame())
    read = Scenario(tmp_path).frame(68)
    first, second = read.stations
    given = frame().stations[0].images[0]
    image = first.images[0]
    assert "rgb" not in repr(image)
    for made in (copy.copy(image), pickle.loads(pickle.dumps(image)), replace(image, depth=None)):
        np.testing.assert_array_equal(made.rgb, given.rgb)
    assert replace(image, depth=None).depth is None
    with pytest.raises(AttributeError, match="Image has no 'colour'"):
        _ = image.colour
    kept = image.rgb, image.depth, first.scans[0].points
    for path in [*tmp_path.rglob("*.png"), *tmp_path.rglob("*.pcd")]:
        path.unlink()
    again = image.rgb, image.depth, first.scans[0].points
    assert all(a is b for a, b in zip(kept, again, strict=True))
    with pytest.raises(InspeError, match=r"-2/000068_camera0.png: no such file"):
        _ = second.images[0].rgb
    with pytest.raises(InspeError, match=r"-2/000068.pcd: no such file"):
        _ = second.scans[0].points


def short(cut: int):
    return lambda path: path.write_bytes(path.read_bytes()[:cut])


def in_colour(path: Path) -> None:
    Pillow.new("RGB", (8, 6)).save(path)


@pytest.mark.parametrize(("name", "field", "damage", "message"), [
    ("_camera0.png", "rgb", short(0), "not a readable picture"),
    ("_instance0.png", "instance", short(60), "not a readable picture"),
    ("_depth0.png", "depth", in_colour, "its pixels are RGB: must be 16-bit"),
    ("_semantic0.png", "semantic", in_colour, "its pixels are RGB: must be 8-bit"),
    (".pcd", "points", short(-1), "cut short"),
    (".pcd", "", short(0), "not a PCD file"),
])  # fmt: skip
def test_broken_pictures_and_points(tmp_path, name, field, damage, message):
    write_frame(tmp_path, frame(stations=[station()]))
    path = tmp_path / "-1" / f"000068{name}"
    damage(path)

    def use():
        (read,) = Scenario(tmp_path).frame(68).stations
        return getattr(read.scans[0] if field == "points" else read.images[0], field)

    with pytest.raises(InspeError, match=f"{path}: {message}"):
        use()


@pytest.mark.parametrize(("old", "new", "message"), [
    (OTHERS, "", "must hold keys with values, got None"),
    ("  215:", "  215: [", "not YAML: .*line 1[0-9]"),
    ("lidar_pose: [100.0,", "lidar_pose: [", "lidar_pose: must be 6 numbers, got"),
    ("lidar_pose: [100.0,", "lidar_pose: [.nan,", "lidar_pose: must be 6 numbers, got"),
    ("true_ego_pos: [100.0", "true_ego_pos: ['100'", "true_ego_pos: must be 6 numbers"),
    ("    location", "    place", "vehicles.215: location: missing key"),
    ("    speed: 36", "    speed: fast", "vehicles.215: speed: must be 1 numbers, got 'fast'"),
    ("    speed: 36", "    obj_type: Tram", "vehicles.215: obj_type 'Tram': one of car, van"),
    ("  215:", "  abc:", "vehicles.abc: the id must be a whole number"),
    ("  cords", "  coords", "camera0: cords: missing key"),
    ("[0, 335.64, 300]", "[0, 335.64]", "camera0: intrinsic: must be 3 x 3 numbers"),
    ("camera0:\n", "camera2:\ncamera0:\n", "camera2: must hold keys with values, got None"),
])  # fmt: skip
def test_broken_frames(others, old, new, message):
    path = others / "-1" / "00068.yaml"
    assert old in OTHERS
    path.write_text(OTHERS.replace(old, new))
    with pytest.raises(InspeError, match=f"{path}: {message}"):
        Scenario(others).frame(68)


def test_frames_with_anchors_are_read_whole(others):
    """An anchor before the road users may be used among them."""
    text = OTHERS.replace("ego_speed: 20.0", "ego_speed: &fast 20.0")
    (others / "-1" / "00068.yaml").write_text(text.replace("speed: 36", "speed: *fast"))
    speed = np.linalg.norm(Scenario(others).frame(68).boxes[0].velocity)
    assert speed == pytest.approx(20 / 3.6)


def test_folders_that_are_not_data_sets(tmp_path):
    with pytest.raises(InspeError, match="missing: no such folder"):
        dataset.open(tmp_path / "missing")
    with pytest.raises(InspeError, match="not a scenario: it has no folder of an agent"):
        Scenario(tmp_path).frame(0)
    (tmp_path / "train" / "a" / "-1").mkdir(parents=True)
    words = f"{tmp_path}: not a data set: expected one of SPLIT/SCENARIO"
    with pytest.raises(InspeError, match=words):
        dataset.open(tmp_path)
