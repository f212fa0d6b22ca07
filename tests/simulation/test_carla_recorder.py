"""A data set recorded with the wire-level CARLA server, checked by its files alone."""

import json
import re
import shutil
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import shapely
import yaml
from opv2v_validator import check_set

pytest.importorskip("msgpack", reason="what the CARLA client talks: extra [test]")

import carla_recording as client
import carla_wire
from carla_world import BLUEPRINTS
from frames import car
from processes import inspe_process
from worlds import place_sensors, world

from inspe_jax import dataset
from inspe_jax.core.errors import InspeError
from inspe_jax.core.geometry import pixels, rotation
from inspe_jax.scene.traffic.frames import CLASSES
from inspe_jax.sensing.catalogue import device
from inspe_jax.sensing.conditions import Conditions
from inspe_jax.simulation.backends import recorder_of
from inspe_jax.simulation.carla.recorder import CarlaRecorder
from inspe_jax.simulation.carla.sensors import CarlaCamera, instances_of
from inspe_jax.simulation.carla.server import weather_of
from inspe_jax.simulation.carla.traffic import body_of
from inspe_jax.simulation.projection import corners
from inspe_jax.simulation.recorder import Recording, Server

PARKED = {"tag": 14, "pose": [-47.76, 20.43, 0.8, 0.0, 30.0, 0.0], "extent": [2.2, 0.9, 0.8]}
"""A car that is part of the map, in the middle of the junction."""
NEAR = 2e-3
"""Metres. Points come as float32 in the sensor's frame, poses as float32 in the world."""
TAGS = {"car": {14}, "truck": {15, 16}, "cyclist": {18, 19}, "pedestrian": {12}}


def run_client(task: str, port: int, file, *arguments: object) -> dict:
    words = [sys.executable, client.__file__, task, str(port), str(file), *map(str, arguments)]
    ran = subprocess.run(words, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return json.loads(file.read_text())


@pytest.fixture(scope="module")
def recorded(maps, tmp_path_factory):
    """A folder with a data set, and the state of the server, which starts with another map, during
    and after."""
    folder = tmp_path_factory.mktemp("carla")
    towns = maps / "Town07.xodr", maps / f"{client.TOWN}.xodr"
    with carla_wire.serving(*towns, scenery=[PARKED]) as port:
        return folder, *run_client("record", port, folder / "told.json").values()


@pytest.fixture(scope="module")
def frames(recorded):
    folder, _, _ = recorded
    (scenario,) = dataset.open(folder / "train").scenarios
    return [scenario.frame(t) for t in scenario.frames]


def gaps(points: np.ndarray, boxes) -> np.ndarray:
    """Signed distance of points (P, 3) to boxes and the ground, (T + 1, P) [m]."""
    rows = []
    for box in boxes:
        turn = rotation(np.array([0.0, 0.0, box.yaw]), np)
        over = np.abs((points - box.center) @ turn) - box.size / 2
        rows.append(np.linalg.norm(np.maximum(over, 0), axis=1) + np.minimum(over.max(1), 0))
    return np.array([*rows, points[:, 2]])


def carried(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ rotation(pose[3:], np).T + pose[:3]


def test_readers_accept_the_set(recorded):
    folder, _, _ = recorded
    report = check_set(folder, attenuation=0.004)[f"train/{client.TOWN}"]
    assert (report.agents, report.frames) == (1, client.FRAMES)
    assert report.boxes_hit > 5 * client.FRAMES
    assert report.points > 5000 * client.FRAMES


def test_the_server_is_synchronous_meanwhile_and_restored_afterwards(recorded):
    _, meanwhile, after = recorded
    assert meanwhile["settings"] == [True, 1 / client.RATE]
    assert meanwhile["weather"] == pytest.approx([63.2, 7.0], abs=0.1)
    assert meanwhile["below"] != "Car"
    sensors = [name for name in meanwhile["actors"] if name.startswith("sensor.")]
    kinds = ("depth", "rgb", "semantic_segmentation")
    cameras = [f"sensor.camera.{kind}" for kind in kinds for _ in range(2)]
    assert sensors == [*cameras, "sensor.lidar.ray_cast"]
    found = dict(settings=[False, None], weather=[0.0, 45.0], actors=["spectator"], below="Car")
    assert after == {"map": client.TOWN, **found}


def test_road_users_stand_where_the_traffic_has_them_with_boxes_of_the_server(frames):
    traffic, names = client.scene().traffic, {}
    for t, frame in enumerate(frames):
        entry = {int(traffic.track[t, b]): b for b in np.flatnonzero(traffic.valid[t])}
        assert {box.track for box in frame.boxes} == entry.keys()
        for box in frame.boxes:
            b = entry[box.track]
            center, size = traffic.center[t, b], traffic.size[t, b]
            np.testing.assert_allclose(box.center[:2], center[:2], atol=NEAR)
            foot = box.center[2] - box.size[2] / 2
            assert foot == pytest.approx(center[2] - size[2] / 2, abs=NEAR)
            assert np.cos(box.yaw - traffic.yaw[t, b]) == pytest.approx(1)
            assert box.kind == CLASSES[traffic.kind[t, b]]
            kind = BLUEPRINTS[box.name]
            assert kind.tag in TAGS[box.kind]
            np.testing.assert_allclose(box.size, 2 * np.array(kind.extent), atol=1e-5)
            assert np.abs(np.log(box.size / size)).max() < 0.9
            assert names.setdefault(box.track, box.name) == box.name
    assert set(traffic.kind[traffic.valid].tolist()) == {0, 1, 2, 3}
    assert len(set(names.values())) > 5


def test_lidar_points_lie_on_road_users_and_the_ground(frames):
    """And none on the parked car, which is hidden."""
    hit = 0
    for frame in frames:
        (scan,) = frame.stations[0].scans
        points = carried(scan.pose, scan.points[:, :3].astype(float))
        gap = gaps(points, frame.boxes)
        np.testing.assert_allclose(gap.min(0), 0, atol=NEAR)
        hit += (np.abs(gap[:-1]) < NEAR).any(0).sum()
    assert hit > 200 * len(frames)


def test_depth_is_of_surfaces(frames):
    """To half a centimetre of depth, which is the same from the ground, and more from sides."""
    for frame in frames[::4]:
        for image in frame.stations[0].images:
            height, width = image.depth.shape
            u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
            (f, _, cx), (_, g, cy), _ = image.intrinsic
            rays = np.stack([np.ones_like(u), (cx - u) / f, (cy - v) / g], -1)
            near = image.depth < 100
            assert near.mean() > 0.5
            points = carried(image.pose, image.depth[near][:, None].astype(float) * rays[near])
            gap = gaps(points, frame.boxes)
            np.testing.assert_allclose(gap.min(0), 0, atol=0.005 * np.linalg.norm(rays[0, 0]))


def test_boxes_by_the_written_calibration_cover_their_instances(frames):
    """Pixels of an instance have one colour, and lie in the outline of its box; all pixels with the
    colour of an actor belong to an instance."""
    seen = 0
    for frame in frames:
        kinds = {box.track: box.kind for box in frame.boxes}
        for image in frame.stations[0].images:
            np.testing.assert_array_equal(image.rgb[..., 2] < 40, image.instance > 0)
            colours = []
            for box in frame.boxes:
                own = image.instance == box.track + 1
                if not own.any():
                    continue
                colours.append(np.unique(image.rgb[own], axis=0))
                assert set(image.semantic[own].tolist()) <= TAGS[kinds[box.track]]
                column, row, depth = pixels(image, corners([box])[0]).T
                if depth.min() > 0.1:
                    hull = shapely.MultiPoint(np.column_stack([column, row])).convex_hull
                    v, u = np.nonzero(own)
                    assert shapely.contains_xy(hull.buffer(0.1), u + 0.5, v + 0.5).all()
                    seen += len(v)
            assert all(len(colour) == 1 for colour in colours)
            assert len(np.unique(np.concatenate(colours), axis=0)) == len(colours)
            assert set(image.instance.flat) <= {0, *(track + 1 for track in kinds)}
            assert set(image.semantic[image.instance == 0].tolist()) <= {1, 11}
    assert seen > 100 * len(frames)


def test_every_measurement_is_of_its_own_tick(frames):
    """The blue of the ground encodes the tick."""
    pairs = [frame.stations[0].images for frame in frames]
    blue = [[np.unique(x.rgb[x.semantic == 1][:, 2]).item() for x in images] for images in pairs]
    ticks = np.array(blue)  # (T, 2)
    np.testing.assert_array_equal(np.diff(ticks, axis=0) % 128, 1)
    np.testing.assert_array_equal(ticks[:, 0], ticks[:, 1])


def test_servers_that_cannot_be_used(maps, tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        nobody = free.getsockname()[1]
    town = maps / f"{client.TOWN}.xodr"
    servers = {
        "elsewhere": carla_wire.serving(maps / "Town07.xodr"),
        "older": carla_wire.serving(town, version="0.9.15"),
        "mute": carla_wire.serving(town, mute="sensor.lidar.ray_cast"),
        "failing": carla_wire.serving(town, mute="sensor.camera.depth", after=29),
        "taken": carla_wire.serving(town),
        "stopped": carla_wire.serving(town),
    }
    with ExitStack() as stack:
        with ThreadPoolExecutor() as pool:
            ports = dict(zip(servers, pool.map(stack.enter_context, servers.values()), strict=True))
        given = [f"{name}:{port}" for name, port in {"nobody": nobody, **ports}.items()]
        told = run_client("errors", 0, tmp_path / "told.json", *given)
    assert f"no CARLA server at 127.0.0.1:{nobody}" in told["nobody"]
    assert "has no map 'Town10HD'; it has Town07" in told["elsewhere"]
    assert "is 0.9.15 and the client here 0.9.16: pip install carla==0.9.15" in told["older"]
    assert "sensor.lidar.ray_cast of 'top', unit 'mast', did not measure anything" in told["mute"]
    assert "sensor.camera.depth of 'east', unit 'mast', did not measure frame" in told["failing"]
    assert "1 vehicles or walkers are there already (vehicle.tesla.model3)" in told["taken"]
    for name in ("mute", "failing", "stopped"):
        left = told[f"{name}, left"]
        assert (left["settings"], left["actors"]) == ([False, None], ["spectator"])
        assert left["weather"] == [0.0, 45.0]
    left = told["taken, left"]
    assert left["settings"] == [True, None]
    assert left["actors"] == ["spectator", "vehicle.tesla.model3"]


STUDY = {
    "scenes": [{"map": f"{client.TOWN}.xodr", "junction": client.JUNCTION, "radius": 20}],
    "layouts": ["one.yaml"],
    "settings": {"voxel": 2, "density": 5, "seconds": 0.2},
    "image_size": [40, 30],
}
ONE = """
name: one mast
units:
  - base: [-38, -11]
    sensors:
      - {device: velodyne-vlp-32c, height: 6, yaw_deg: 0}
      - {device: paper-camera, height: 6, yaw_deg: -135, pitch_deg: -20}
"""


def test_notes_are_in_the_data_set_and_the_address_of_the_server_is_not(maps, tmp_path):
    (tmp_path / "one.yaml").write_text(ONE)
    shutil.copy(maps / f"{client.TOWN}.xodr", tmp_path)
    (tmp_path / "towns.yaml").write_text(yaml.safe_dump(STUDY))
    folder = tmp_path / "set"
    with carla_wire.serving(tmp_path / f"{client.TOWN}.xodr") as port:
        where = ("--out", folder, "--backend", "carla", "--server", f"localhost:{port}")
        process = inspe_process("generate", "towns.yaml", *where, cwd=tmp_path)
        words, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    assert "1 scenario, 2 frames" in words
    ((name, report),) = check_set(folder).items()
    assert (report.agents, report.frames) == (1, 2)
    for file in (folder / "generation.yaml", folder / name / "data_protocol.yaml"):
        assert not re.search(rf"(?<![\w.]){port}(?![\w.])|localhost", file.read_text())
    (scenario,) = dataset.open(folder).scenarios
    kept, turns = scenario.protocol["notes"]
    assert turns.endswith("of a LiDAR's turn at once: lidar_turn_s is 0")
    assert kept.startswith("velodyne-vlp-32c: CARLA's channels are evenly spaced")
    assert f"Note: {kept} (1 scenario)" in words + err
    again = dataset.load_generation(scenario.path / "data_protocol.yaml", tmp_path)
    assert (again.backend, again.notes) == ("carla", ())


def test_scenes_that_no_server_has_and_a_missing_client(monkeypatch):
    monkeypatch.setitem(sys.modules, "carla", None)
    scene, layout = world(count=0), place_sensors((client.CAMERA, [0, 0, 6, 0, 0, 0]))
    for source, words in (
        ("tests", r"test crossing: its source is tests.*\.xodr"),
        ("Town03.xodr (OpenDRIVE)", r"pip install .*\[carla\]'"),
    ):
        there = replace(scene, intersection=replace(scene.intersection, source=source))
        with pytest.raises(InspeError, match=words), recorder_of("carla", there, layout):
            pass


def test_uneven_channels_and_shifted_axes_are_noted():
    shifted = replace(client.CAMERA, name="shifted", principal=(300.0, 240.0))
    uneven, even = (device(f"velodyne-{name}").spec for name in ("vlp-32c", "vlp-16"))
    layout = place_sensors(*((spec, [0, 0, 6, 0, 0, 0]) for spec in (uneven, even, shifted)))
    notes = CarlaRecorder(world(), layout, recording=Recording(turn=0.0)).notes
    assert len(notes) == 2
    assert notes[0].startswith("velodyne-vlp-32c: CARLA's channels are evenly spaced: 32 from -25°")
    assert notes[1].startswith("shifted: CARLA's principal point")


def test_boxes_without_a_size_have_the_usual_one():
    """CARLA is left-handed: its right has a negative y here."""
    at, half = (SimpleNamespace(x=x, y=y, z=np.inf) for x, y in ((0.1, 0.2), (0.8, 0.0)))
    box = SimpleNamespace(location=at, extent=half)
    body = body_of("bicycle", box, np.array([1.8, 0.6, 1.7]))
    np.testing.assert_allclose(body.middle, [0.1, -0.2, 0.85])
    np.testing.assert_allclose(body.size, [1.6, 0.6, 1.7])


def weather_in(light: str, weather: str) -> dict[str, float]:
    return weather_of(SimpleNamespace(WeatherParameters=dict), Conditions.of(light, weather))


def test_weather_and_light_are_in_the_order_of_their_strength():
    """Within CARLA's limits, 0 to 100 % and -90 to 90 degrees."""
    for key, falling, sign in (("precipitation", "rain", 1), ("fog_density", "fog", -1)):
        strength = [weather_in("midday", f"{falling}:{n}")[key] for n in (10, 20, 50, 200)]
        assert (np.diff(strength) * sign > 0).all()
        assert 0 < min(strength) < max(strength) < 100
    assert not weather_in("midday", "clear").keys() & {"precipitation", "fog_density"}
    suns = [weather_in(light, "clear")["sun_altitude_angle"] for light in ("midday", "dusk")]
    assert 90 > suns[0] > 30 > suns[1] > 0 > weather_in("night", "clear")["sun_altitude_angle"]
    assert 0 <= weather_in("dusk", "clear")["sun_azimuth_angle"] < 360


def test_pixels_of_road_users_are_matched_by_place():
    """A rider and a bicycle in one box, ahead and turned; a statue with the label of a road user
    stands behind, and the road in the box is no road user."""
    box = car(4, kind="cyclist", center=np.array([10.0, 0.0, 0.0]), size=np.array([2.0, 0.6, 2.0]))
    tags = np.array([[13, 19, 12], [1, 19, 11]], np.uint8)
    depth = np.array([[9.8, 9.7, 30.0], [10.0, 9.7, np.inf]])
    small = replace(client.CAMERA, width=3, height=2, focal=30.0)
    intrinsic = CarlaCamera(small, Recording()).intrinsic
    found = instances_of(tags, depth, np.zeros(6), intrinsic, (box,))
    np.testing.assert_array_equal(found, [[5, 5, 0], [0, 5, 0]])


def test_servers_by_text():
    assert Server.of("sim") == Server("sim", 2000)
    assert Server.of("sim:3000") == Server("sim", 3000)
    assert Server.of("3000") == Server("127.0.0.1", 3000)
    for text in ("", ":", "sim:", ":2000", "sim:two", "sim:70000", "0"):
        with pytest.raises(InspeError, match=r"server|port"):
            Server.of(text)
