"""Frames written and read, and what HEAL's, CoAlign's and OpenCOOD's readers need of them."""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from frames import FRAMES, UNIT, WORLD, assert_same, car, frame, image, scan, station
from hypothesis import given, settings
from opv2v_validator import box_in_lidar, check_scenario, check_set, corners_in_lidar, load
from PIL import Image

from inspe_jax.core.carla_frame import to_carla
from inspe_jax.core.errors import InspeError
from inspe_jax.dataset import FileOptions, Frame, Scenario, Station, write_frame, write_protocol
from inspe_jax.dataset.formats.opv2v import writer
from inspe_jax.dataset.formats.other_readers import lidar_range
from inspe_jax.dataset.formats.pictures import read_picture, write_picture
from inspe_jax.scene.voxels import VoxelGrid


def written(folder: Path, given: Frame | None = None) -> Path:
    given = given or frame()
    write_protocol(folder, {"world": WORLD}, given.stations)
    write_frame(folder, given)
    return folder


def content(path: Path) -> dict:
    return yaml.safe_load(path.read_text())


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@settings(max_examples=25, deadline=None)
@given(FRAMES)
def test_written_frames_read_back(given):
    with tempfile.TemporaryDirectory() as folder:
        scenario = written(Path(folder) / "a", given)
        read = Scenario(scenario).frame(given.number)
        assert_same(read, given)
        names = {s.number: s.name for s in given.stations}
        assert {s.number: s.name for s in read.stations} == names
        # A frame that was read is written again, in place, to the same bytes.
        before = files(scenario)
        write_frame(scenario, read)
        assert files(scenario) == before


def test_readers_accept_a_set(tmp_path):
    """Three LiDARs, one of them the second of its station, and a station without one."""
    stations = station(1), station(2, cameras=1, lidars=2), station(3, cameras=4, lidars=0)
    for split, number in (("train", 0), ("train", 2), ("validate", 4), ("test", 6)):
        written(tmp_path / split / "2024_01_01", frame(number, stations=stations))
    reports = check_set(tmp_path, lidar_range=(-200, -200, -8, 200, 200, 0))
    assert reports.keys() == {f"{split}/2024_01_01" for split in ("train", "validate", "test")}
    train = reports["train/2024_01_01"]
    assert train.ego == "-2"
    assert (train.agents, train.frames) == (3, 2)
    assert (train.points, train.points_in_range) == (200, 200)
    assert (train.boxes, train.boxes_in_range) == (8, 8)


def test_yaml_of_a_known_frame(tmp_path):
    """A car at (10, 20) facing north and a station 6 m up, worked out by hand."""
    seen = image(pose=[12, 8, 5, 0, np.radians(-30), np.radians(-150)], layers=False)
    on_top = scan(pose=UNIT + [0, 0, 0.5, 0, 0, 0])
    here = replace(station(1, 0, 1), images=(seen,), scans=(on_top,))
    scenario = written(tmp_path / "a", frame(boxes=[car()], stations=[here]))
    entry = dict(
        angle=[0, -90, 0], center=[0, 0, 0.75], extent=[2.1, 0.9, 0.75], location=[10, -20, 0],
        name="vehicle.audi.tt", obj_type="Car", speed=36, velocity=[0, -10, 0],
    )  # fmt: skip
    read = content(scenario / "-1" / "000068.yaml")
    extrinsic = np.array(read["camera0"].pop("extrinsic"))
    camera = {"cords": [12, -8, 5, 0, 150, -30], "intrinsic": [[5, 0, 4], [0, 5, 3], [0, 0, 1]]}
    unit, lidar = [12, -8, 6, 0, 150, 0], [12, -8, 6.5, 0, 150, 0]
    assert read == dict(
        RSU=True, ego_speed=0, true_ego_pos=unit, predicted_ego_pos=unit, lidar_pose=lidar,
        lidar_pose0=lidar, camera0=camera, vehicles={3: entry}, cars={3: entry}, cyclists={},
        pedestrians={}, trucks={},
    )  # fmt: skip
    # The LiDAR is 1.5 m above the camera, which looks 30° down: partly behind, partly above.
    above = [-1.5 * np.sin(np.radians(30)), 0, 1.5 * np.cos(np.radians(30))]
    np.testing.assert_allclose(extrinsic[:3, 3], above, atol=1e-9)


def test_names_that_yaml_could_read_otherwise(tmp_path):
    """As a number, a date or null; boxes in any order."""
    names = ["null", "1e-7", "2024-01-01", "", " a: b", "ä\n", "\U0001f697", "x" * 300]
    boxes = [car(i, name=name, yaw=1e-9 * i) for i, name in enumerate(names)]
    found = files(written(tmp_path / "a", frame(boxes=boxes)))
    read = yaml.safe_load(found["-1/000068.yaml"])["vehicles"]
    assert [read[i]["name"] for i in range(len(names))] == names
    assert all(type(number) is float for entry in read.values() for number in entry["angle"])
    assert files(written(tmp_path / "b", frame(boxes=boxes[::-1]))) == found


def test_a_frame_that_fails_halfway_does_not_count(tmp_path, monkeypatch):
    """The disk becomes full at the fourth picture: the earlier frame of this number is gone."""
    scenario = written(tmp_path / "a")
    count = [0]

    def full(path, *_, **__):
        count[0] += 1
        if count[0] == 4:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(writer, "write_picture", full)
    with pytest.raises(OSError, match="No space"):
        write_frame(scenario, frame())
    assert not list(scenario.glob("-*/*.yaml"))
    assert not list(scenario.rglob("*.part"))


def test_a_frame_written_again_leaves_nothing_behind(tmp_path, monkeypatch):
    """Without its YAML file it does not count; while its first file is there, it is begun."""
    scenario = written(tmp_path / "a", frame(stations=[station(1, cameras=3)]))
    (scenario / "-1" / ".000068.pcd.killed.part").touch()
    bare = frame(stations=[station(1, cameras=1, layers=False)])
    gone, unlink = [], Path.unlink

    def watch(path, **how):
        gone.append(path.name)
        unlink(path, **how)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", watch)
        write_frame(scenario, bare)
    assert (gone[0], gone[-1]) == ("000068.yaml", "000068.pcd")
    assert len(gone) == len(set(gone)) == 1 + 3 * 4 + 1 + 1
    check_scenario(scenario)
    assert_same(Scenario(scenario).frame(68), bare)


def test_the_infra_set_variant_has_a_second_name_for_the_points(tmp_path):
    """A file of its own: a set with hard links would grow when it is copied."""
    plain = files(written(tmp_path / "a"))
    write_protocol(tmp_path / "b", {"world": WORLD}, frame().stations)
    paths = write_frame(tmp_path / "b", frame(), options=FileOptions(infra_set_names=True))
    more = files(tmp_path / "b")
    assert {name: more[name] for name in plain} == plain
    assert more.keys() - plain.keys() == {f"-{n}/000068_lidar0.pcd" for n in (1, 2)}
    assert all(path.stat().st_nlink == 1 for path in paths)
    named = {str(path.relative_to(tmp_path / "b")) for path in paths}
    assert named == more.keys() - {"data_protocol.yaml"}
    check_scenario(tmp_path / "b")
    assert_same(Scenario(tmp_path / "b").frame(68), frame())


def test_jpeg_pictures(tmp_path):
    given, smooth = frame(), np.linspace(0, 255, 48 * 64 * 3).reshape(48, 64, 3).astype(np.uint8)
    here = given.stations[0]
    bare = replace(here.images[0], rgb=smooth, depth=None, instance=None, semantic=None)
    here = replace(here, images=(bare,))
    options = FileOptions(pictures="jpeg")
    paths = write_frame(tmp_path, replace(given, stations=(here,)), options=options)
    assert sorted(path.suffix for path in paths) == [".jpg", ".pcd", ".yaml"]
    read = Scenario(tmp_path).frame(68).stations[0].images[0].rgb
    assert np.abs(read.astype(int) - smooth).max() < 12
    with pytest.raises(InspeError, match="pictures: 'jpg': one of png, jpeg; did you mean jpeg"):
        write_frame(tmp_path, given, options=FileOptions(pictures="jpg"))


def test_agents_with_as_many_cameras_each(tmp_path):
    """Stations with 1, 0 and 5 cameras, four of each wanted: the third becomes two agents."""
    stations = station(1, cameras=1), station(2, cameras=0), station(3, cameras=5, lidars=0)
    write_protocol(tmp_path, {"world": WORLD})
    write_frame(tmp_path, frame(stations=stations), options=FileOptions(cameras_per_agent=4))
    for agent in (-1, -2, -3, -4):
        holds = content(tmp_path / str(agent) / "000068.yaml")
        assert [f"camera{i}" in holds for i in range(5)] == [True] * 4 + [False]
    check_scenario(tmp_path, lidar_range=(-200, -200, -8, 200, 200, 0))
    read = Scenario(tmp_path).frame(68)
    assert [len(s.images) for s in read.stations] == [1, 0, 4, 1]  # those that fill up are left out
    assert [len(s.scans) for s in read.stations] == [1, 1, 0, 0]
    last = read.stations[3].images[0]
    np.testing.assert_array_equal(last.rgb, stations[2].images[4].rgb)
    black = content(tmp_path / "-1" / "000068.yaml")["camera3"]
    assert black["cords"][5] == 90.0  # CARLA's pitch: straight up


@pytest.mark.parametrize("observed", [[1, 2], {3: True}, {3: {"lidar_points": 5}}])
def test_what_others_call_observed_is_left_out(tmp_path, observed):
    """And a velocity that is no vector, or not as long as the speed."""
    scenario = written(tmp_path / "a", frame(boxes=[car(3)]))
    for path in scenario.glob("*/000068.yaml"):
        holds = content(path) | {"observed": observed}
        for velocity in (5.0, [1.0, 2.0], [1.0, 2.0, 3.0], None):
            for section in ("vehicles", "cars"):
                holds[section][3]["velocity"] = velocity
            path.write_text(yaml.safe_dump(holds))
            read = Scenario(scenario).frame(68)
            np.testing.assert_allclose(read.boxes[0].velocity, [0, 10, 0], atol=1e-6)
            assert read.stations[0].scans[0].returns is None


def test_what_was_observed_of_each_road_user(tmp_path):
    given = frame()
    order = len(given.boxes)
    seen, stations = dict(pixels=np.arange(order) * 3, share=np.linspace(0, 1, order)), []
    for s in given.stations:
        scans = tuple(replace(x, returns=np.arange(order) + 10 * s.number) for x in s.scans)
        stations.append(replace(s, scans=scans, images=tuple(replace(x, **seen) for x in s.images)))
    write_protocol(tmp_path, {"world": WORLD})
    write_frame(tmp_path, replace(given, boxes=given.boxes[::-1], stations=tuple(stations)))
    check_scenario(tmp_path)
    read = Scenario(tmp_path).frame(68)
    back = [[box.track for box in given.boxes[::-1]].index(box.track) for box in read.boxes]
    for a, b in zip(read.stations, stations, strict=True):
        for x, y in zip(a.scans, b.scans, strict=True):
            np.testing.assert_array_equal(x.returns, y.returns[back])
        for x, y in zip(a.images, b.images, strict=True):
            np.testing.assert_array_equal(x.pixels, y.pixels[back])
            np.testing.assert_allclose(x.share, y.share[back], atol=5e-4)
    holds = content(tmp_path / "-1" / "000068.yaml")
    track = read.boxes[0].track
    each = holds["observed"][track]["lidar_points"]
    assert holds["observed"][track]["points"] == sum(map(sum, each.values()))
    wrong = replace(stations[0], scans=(replace(stations[0].scans[0], returns=np.zeros(3, int)),))
    with pytest.raises(InspeError, match=r"scans\[0\].returns: 3 values, for 4 road users"):
        write_frame(tmp_path, replace(given, stations=(wrong,)))


def test_depth_is_capped_and_reads_as_infinite(tmp_path):
    path = tmp_path / "depth.png"
    write_picture(path, "depth", np.array([[0.0, 1.234, 655.34], [655.35, 1e6, np.inf]]))
    expected = [[0, 1.23, 655.34], [np.inf] * 3]
    np.testing.assert_allclose(read_picture(path, "depth"), np.array(expected, np.float32))


def seen(**changes) -> dict:
    return {"stations": (replace(station(), images=(replace(image(), **changes),)),)}


def heard(points) -> dict:
    return {"stations": (replace(station(), scans=(replace(scan(), points=points),)),)}


@pytest.mark.parametrize(("changes", "message"), [
    ({"number": 10**6}, "number: 1e.06 is out of range: from 0 to 999999"),
    ({"boxes": (car(), car())}, "track 3 is given twice"),
    ({"boxes": (car(65535),)}, r"boxes\[0\].track: 65535 is out of range: from 0 to 65534"),
    ({"boxes": (car(kind="bus"),)}, r"boxes\[0\].kind 'bus': one of car, truck"),
    ({"boxes": (car(size=np.array([1, 1, 0])),)},
     r"boxes\[0\].size\[2\]: 0 is out of range: at least 0.001"),
    ({"stations": (station(0),)}, r"stations\[0\].number: 0 is out of range: at least 1"),
    ({"stations": (station(1), station(1))}, "station 1 is given twice"),
    (seen(rgb=np.zeros((6, 8), np.uint8)), r"images\[0\].rgb: shape \(6, 8\), expected \("),
    (seen(depth=np.zeros((6, 9))), r"depth: shape \(6, 9\), expected \(6, 8\), as rgb"),
    (seen(instance=np.full((6, 8), 2**16)),
     r"instance\[0, 0\]: 65536 is out of range: from 0 to 65535"),
    (heard(np.array([[0, 0, 0, 1.01]])),
     r"points: intensity\[0\]: 1.01 is out of range: from 0 to 1"),
])  # fmt: skip
def test_frames_that_cannot_be_written_leave_no_file(tmp_path, changes, message):
    with pytest.raises(InspeError, match=message):
        write_frame(tmp_path / "a", replace(frame(), **changes))
    assert not (tmp_path / "a").exists()


def test_protocols_must_have_the_keys_of_world_and_be_plain_yaml(tmp_path):
    for key in WORLD:
        world = {k: v for k, v in WORLD.items() if k != key}
        with pytest.raises(InspeError, match=rf"data_protocol.yaml: world.{key}: missing key"):
            write_protocol(tmp_path, {"world": world})
    with pytest.raises(InspeError, match=r"data_protocol.yaml: .*cannot represent"):
        write_protocol(tmp_path, {"world": WORLD, "noise": np.float32(0.02)})
    (tmp_path / "file").touch()
    with pytest.raises(InspeError, match="file/-1: the folder cannot be created"):
        write_frame(tmp_path / "file", frame())


TILTED = np.array([14.0, -11.0, 6.2, np.radians(4), np.radians(-12), np.radians(-150)])
AGENTS = (
    Station(1, "LiDAR", TILTED, (), (scan(pose=TILTED),)),
    Station(2, "camera alone", np.array([-12.0, 9.0, -0.3, 0, 0, 2.0]), (), ()),
)
"""A LiDAR that leans, 6 m up, and a unit on the ground."""


def region(radius: float = 50.0, slope: float = 0.03) -> VoxelGrid:
    """Columns 1 m apart over a disc whose ground rises along x."""
    line = np.arange(-radius, radius) + 0.5
    columns = np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)
    columns = columns[np.hypot(*columns.T) <= radius]
    kinds = np.zeros(len(columns), int)
    ground = slope * columns[:, 0]
    return VoxelGrid(columns, ground, kinds, np.zeros(3), 1.0, radius, 4, 1.0)


def kept(box, agent: Station, limits) -> bool:
    """Whether readers keep a box: all its corners are in range, in the frame of ``lidar_pose``."""
    cords = to_carla([*box.center, 0.0, 0.0, box.yaw])
    thing = dict(location=cords[:3], center=[0, 0, 0], angle=cords[3:], extent=box.size / 2)
    pose = agent.scans[0].pose if agent.scans else agent.pose
    at = corners_in_lidar(thing, to_carla(pose))
    return bool(((at >= limits[:3]) & (at <= limits[3:])).all())


def test_the_range_holds_the_longest_road_users_as_a_whole():
    """Road trains on every 40th column, in all directions, half of each beyond the region's rim."""
    voxels, rng = region(), np.random.default_rng(0)
    limits = lidar_range(AGENTS, voxels)
    size = np.array([18.75, 2.55, 4.0])
    for (x, y), ground in zip(voxels.columns[::40], voxels.ground[::40], strict=True):
        middle = np.array([x, y, ground + size[2] / 2])
        train = car(size=size, center=middle, yaw=rng.uniform(0, 2 * np.pi))
        assert all(kept(train, agent, limits) for agent in AGENTS)
    assert not kept(car(center=np.array([90.0, 0, 0.75])), AGENTS[0], limits)


def test_the_range_is_one_grid_for_all_agents():
    """As wide as the agents need together, the same on four sides, in steps of 16 pillars."""
    voxels = region(slope=0.0)
    each, both = [lidar_range([agent], voxels) for agent in AGENTS], lidar_range(AGENTS, voxels)
    assert both == [*np.min(each, 0)[:3], *np.max(each, 0)[3:]]
    assert both[3] == both[4] == -both[0] == -both[1]
    assert both[3] / 6.4 == pytest.approx(round(both[3] / 6.4))
    assert each[1][2:6:3] == [-1.0, 6.0]  # ground 0.3 m above the unit, half a metre spare; 5 m
    upright = Station(3, "upright", np.array([0, 0, 6.2, 0, 0, 0.0]), (), ())
    assert lidar_range([upright], voxels) == [-64.0, -64.0, -7.0, 64.0, 64.0, -1.0]


def readers_pixel(thing: dict, lidar_pose) -> tuple[int, int]:
    x, y, _ = box_in_lidar(thing, lidar_pose)[1]
    return 127 - int(x / 0.39), 127 + int(y / 0.39)


def test_visibility_maps(tmp_path):
    """A box is kept where one camera of the agent shows it, and only there. The first agent's
    cameras show every third box, the other's did not count pixels."""
    places = [(x, y) for x in range(-30, 60, 11) for y in range(-30, 50, 9)]
    boxes = [
        car(k, center=np.array([*place, 0.75]), yaw=0.3 * k, size=np.array([3.6, 1.65, 1.5]))
        for k, place in enumerate(places)
    ]
    shown = np.arange(len(boxes)) % 3 == 0
    first = station(1, cameras=0, layers=False)
    counted = [np.where(shown & (np.arange(len(boxes)) % 2 == i), 5, 0) for i in (0, 1)]
    looks = tuple(image(layers=False, pixels=pixels, share=pixels / 5) for pixels in counted)
    other = Station(2, "not counted", first.pose, (image(layers=False),), ())
    stations = [Station(1, "counted", first.pose, looks, first.scans), other]
    given = frame(boxes=boxes, stations=stations)
    write_protocol(tmp_path, {"world": WORLD})
    paths = write_frame(tmp_path, given, options=FileOptions(visibility_maps=True))
    maps = [path for path in paths if path.name == "000068_bev_visibility.png"]
    assert len(maps) == 2
    check_scenario(tmp_path, lidar_range=(-200, -200, -8, 200, 200, 0))
    for path, seen in zip(maps, (shown, np.ones(len(boxes), bool)), strict=True):
        content = load(path.with_name("000068.yaml"))
        with Image.open(path) as picture:
            found = np.array(picture)
        things = [content["vehicles"][k] for k in range(len(boxes))]
        at = np.array([readers_pixel(thing, content["lidar_pose"]) for thing in things])
        inside = ((at >= 0) & (at < 256)).all(1)
        assert inside.sum() > 60
        white = found[tuple(at[inside].T)] > 0
        np.testing.assert_array_equal(white, seen[inside])
        assert 15 < found.astype(bool).sum() / white.sum() < 60  # 3.6 × 1.65 m are 39 pixels
