"""The wire-level CARLA server with the unmodified client, and the data of its sensors."""

import json
import subprocess
import sys

import numpy as np
import pytest
import shapely
from carla_rays import FAR, GROUND, SKY, colour_of, instance_of

carla = pytest.importorskip("carla", reason="needs the CARLA client: extra [opendrive]")
pytest.importorskip("msgpack", reason="what the CARLA client talks: extra [test]")

import carla_client as client  # noqa: E402
import carla_wire  # noqa: E402

FOCAL, WIDTH, HEIGHT = 40 / np.tan(np.radians(40)), 80, 60
"""Of the client's cameras."""
BUILDING = {"tag": 3, "pose": [60.0, -30.0, 5.0, 0.0, 45.0, 0.0], "extent": [8.0, 4.0, 5.0]}

NEAR = 2e-3
"""Metres. Points come as float32 in the sensor's frame, up to 60 m away."""


def run_client(task: str, port: int, *arguments: object) -> None:
    command = [sys.executable, client.__file__, task, str(port), *map(str, arguments)]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert ran.returncode == 0, ran.stdout + ran.stderr


def asked(task: str, folder, *arguments: object, of: int) -> dict:
    run_client(task, of, folder / "told.json", *arguments)
    return json.loads((folder / "told.json").read_text())


@pytest.fixture(scope="module")
def told(maps, tmp_path_factory) -> dict:
    """What the client wrote about twenty ticks."""
    file = tmp_path_factory.mktemp("drive") / "told.npz"
    with carla_wire.serving(maps / "Town07.xodr") as port:
        run_client("drive", port, file)
    with np.load(file) as saved:
        return dict(saved)


def to_world(pose) -> np.ndarray:
    """The client's own matrix, (4, 4)."""
    return np.array(client.transform(pose).get_matrix())


def depth_in(points: np.ndarray, told: dict, tick: int) -> np.ndarray:
    """Signed distance to road users and the ground (U + 1, P) [m]; negative inside."""
    rows = []
    for pose, centre, extent in zip(
        told["poses"][tick], told["centres"], told["extents"], strict=True
    ):
        turn = to_world(pose)
        local = (points - turn[:3, 3]) @ turn[:3, :3] - centre  # (P, 3)
        over = np.abs(local) - extent
        outside = np.linalg.norm(np.maximum(over, 0), axis=-1)
        rows.append(outside + np.minimum(over.max(-1), 0))
    return np.array([*rows, points[:, 2]])


def scan(told: dict, tick: int) -> tuple[np.ndarray, np.ndarray]:
    """A LiDAR's points in the world (P, 3), and as received (P, 4)."""
    ends = np.cumsum(told["counts"].sum(1))
    own = told["points"][ends[tick] - told["counts"][tick].sum() : ends[tick]].astype(float)
    turn = to_world(client.PILLAR)
    return own[:, :3] @ turn[:3, :3].T + turn[:3, 3], own


def outlines(told: dict, tick: int) -> list[shapely.Polygon]:
    """The outlines of the road users' boxes in an image, by their corners above ground."""
    drawn, turn = [], to_world(client.ROADSIDE)
    for where, centre, extent in zip(
        told["poses"][tick], told["centres"], told["extents"], strict=True
    ):
        box = carla.BoundingBox(carla.Location(*centre), carla.Vector3D(*extent))
        corners = [client.numbers(c) for c in box.get_world_vertices(client.transform(where))]
        above = np.maximum(corners, [-np.inf, -np.inf, 0])  # (8, 3)
        ahead, right, up = ((above - turn[:3, 3]) @ turn[:3, :3]).T
        assert (ahead > 0).all()
        pixels = np.stack([WIDTH / 2 + FOCAL * right / ahead, HEIGHT / 2 - FOCAL * up / ahead], -1)
        drawn.append(shapely.MultiPoint(pixels).convex_hull)
    return drawn


def inside(outline: shapely.Polygon, by: float) -> np.ndarray:
    """Pixels whose middles are inside by this many pixels, (H, W); if negative, also just
    outside."""
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    return shapely.contains_xy(outline.buffer(-by), x, y)


@pytest.mark.parametrize("sensor", client.SENSORS)
def test_every_tick_brings_one_measurement_of_every_sensor(told, sensor):
    assert told["frames"].tolist() == list(
        range(told["frames"][0], told["frames"][0] + client.TICKS)
    )
    assert told[f"{sensor}_frames"].tolist() == told["frames"].tolist()
    assert np.diff(told[f"{sensor}_times"]) == pytest.approx(client.STEP)
    assert told["left"].tolist() == [0] * len(client.SENSORS)


def test_road_users_are_where_they_were_put_and_the_walker_walks(told):
    put = np.array([client.driven(tick) for tick in range(client.TICKS)])
    np.testing.assert_allclose(told["poses"][:, :3], put, atol=1e-4)
    np.testing.assert_allclose(
        np.diff(told["poses"][:, 3, :3], axis=0),
        [np.multiply(client.WALK, client.STEP)] * 19,
        atol=1e-5,
    )
    np.testing.assert_allclose(told["velocities"][:, 3], [client.WALK] * client.TICKS, atol=1e-6)
    assert not told["velocities"][:, :3].any()
    assert not told["after"].size


def test_measurements_tell_where_their_sensor_was(told):
    for sensor, (_, pose) in client.SENSORS.items():
        for tick in range(client.TICKS):
            want = to_world(pose)
            if pose is client.BONNET:
                want = to_world(told["poses"][tick, 0]) @ want
            np.testing.assert_allclose(to_world(told[f"{sensor}_poses"][tick]), want, atol=1e-4)


def test_lidar_points_lie_on_the_ground_or_on_a_box(told):
    hit = np.zeros(len(told["ids"]), int)
    for tick in range(client.TICKS):
        points, own = scan(told, tick)
        gap = depth_in(points, told, tick)
        np.testing.assert_allclose(gap.min(0), 0, atol=NEAR)
        hit += (np.abs(gap[:-1]) < NEAR).sum(1)
        reach = np.linalg.norm(own[:, :3], axis=1)
        np.testing.assert_allclose(own[:, 3], np.exp(-0.004 * reach), rtol=1e-5)
        assert reach.max() <= 60 + NEAR
    assert (hit > 20).all()


def test_lidar_points_are_the_first_on_their_ray(told):
    """Nothing is in front of a point, and every ray that is steep enough has one.

    From 5 m up the ground is within 60 m from 4.8 degrees down, which is from the fourth of
    sixteen channels between 0 and -30 degrees.
    """
    origin, share = np.array(client.PILLAR[:3]), np.linspace(0.01, 0.99, 50)[:, None, None]
    for tick in range(0, client.TICKS, 5):
        points, _ = scan(told, tick)
        on_the_way = origin + share * (points - origin)  # (50, P, 3)
        assert depth_in(on_the_way.reshape(-1, 3), told, tick).min() > -NEAR
        assert told["counts"][tick][3:].tolist() == [180] * 13


def test_lidar_goes_round_once_a_tick(told):
    _, own = scan(told, 0)
    lowest = own[-180:]
    turned = np.unwrap(np.arctan2(lowest[:, 1], lowest[:, 0]))
    np.testing.assert_allclose(np.diff(turned), np.radians(2), atol=1e-4)


def test_pixels_have_the_colour_of_whose_box_is_there(told):
    """Pixels are compared only where no outline passes through their middles."""
    lit = np.zeros(len(told["ids"]), int)
    for tick in range(client.TICKS):
        image, drawn = told["rgb"][tick][..., 2::-1], outlines(told, tick)
        might = np.array([inside(outline, -0.02) for outline in drawn])
        for k, actor in enumerate(told["ids"].tolist()):
            coloured = (image == colour_of(actor)).all(-1)
            assert coloured[inside(drawn[k], 0.02) & (might.sum(0) == 1)].all()
            assert not coloured[~might[k]].any()
            lit[k] += coloured.sum()
        ground_or_sky = image[~might.any(0)]
        assert set(ground_or_sky[:, 2].tolist()) == {230, 64 + told["frames"][tick] % 128}
    assert (lit > 20).all()


def test_depth_is_that_of_the_surface_which_the_pixel_shows(told):
    turn = to_world(client.ROADSIDE)
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    rays = np.stack([np.ones_like(x), x / FOCAL, -y / FOCAL], -1)  # (H, W, 3)
    for tick in range(0, client.TICKS, 4):
        blue, green, red = np.moveaxis(told["depth"][tick][..., :3].astype(int), -1, 0)
        depth = (red + 256 * green + 256**2 * blue) / (256**3 - 1) * FAR
        near = depth < 100
        points = depth[near][:, None] * rays[near] @ turn[:3, :3].T + turn[:3, 3]
        gap = depth_in(points, told, tick)
        np.testing.assert_allclose(gap.min(0), 0, atol=NEAR)
        tags = np.array([*told["tags"], GROUND])[gap.argmin(0)]
        clear = np.sort(gap, 0)[1] > 10 * NEAR  # where only one surface is that close
        assert (told["semantic"][tick][near][clear, 2] == tags[clear]).all()
        assert set(told["semantic"][tick][~near][:, 2].tolist()) <= {SKY, GROUND}


def test_instances_and_colours_are_of_the_same_road_users(told):
    for image, instance in zip(told["rgb"], told["instance"], strict=True):
        tag, number = instance[..., 2], instance[..., 1] + 256 * instance[..., 0].astype(int)
        for actor, kind in zip(told["ids"].tolist(), told["tags"].tolist(), strict=True):
            coloured = (image[..., 2::-1] == colour_of(actor)).all(-1)
            np.testing.assert_array_equal(number == instance_of(actor), coloured)
            assert (tag[coloured] == kind).all()


def test_the_calls_of_a_recorder(maps, tmp_path):
    scenery = tmp_path / "scenery.json"
    scenery.write_text(json.dumps([BUILDING]))
    with carla_wire.serving(maps / "Town07.xodr", "--scenery", scenery) as port:
        told = asked("ask", tmp_path, of=port)
    assert told == {
        "versions": ["0.9.16", "0.9.16"],
        "settings": [True, client.STEP],
        "trucks": ["vehicle.carlamotors.carlacola", "vehicle.carlamotors.firetruck"],
        "two_wheels": [
            "vehicle.bh.crossbike",
            "vehicle.diamondback.century",
            "vehicle.vespa.zx125",
        ],
        "colour": "17,37,103",
        "map": "Carla/Maps/Town07",
        "spectator": "spectator",
        "lights": 0,
        "weather": True,
        "taken": True,
        "refusal": "Spawn failed because of collision at spawn position",
        "moved": [8, 0, 0],
        "batch": [False, False, True],
        "batch_ticks": 1,
        "spawned": ["vehicle.nissan.patrol", 45, 3, 0, 0, 60, 0],
        "parent": True,
        "attributes": "car",
        "destroyed": [False, False],
        "slow": [2, 5],
        "slow_left": 0,
        "ended": [True, True, False],
        "scenery": [["scenery_0", "Buildings", BUILDING["extent"]]],
        "boxes": [BUILDING["pose"][:3]],
        "below": ["Roads", 30, 30, 0],
        "too_far": True,
        "shared": 1,
        "flows": True,
    }


def test_a_map_is_loaded_and_what_was_there_is_gone(maps, tmp_path):
    with carla_wire.serving(maps / "Town07.xodr", maps / "Town10HD.xodr") as port:
        told = asked("travel", tmp_path, "Town10HD", of=port)
    assert told == {
        "maps": ["/Game/Carla/Maps/Town07", "/Game/Carla/Maps/Town10HD"],
        "before": "Carla/Maps/Town07",
        "after": "Carla/Maps/Town10HD",
        "actors": ["spectator"],
    }


def test_a_server_ends_when_told_to(maps):
    command = [sys.executable, carla_wire.__file__, str(maps / "Town07.xodr")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert int(process.stdout.readline()) > 0
        process.terminate()
        assert process.wait(timeout=10) == 0
        assert process.stderr.read() == b""


def test_a_server_ends_with_who_started_it(maps):
    """It inherits stderr from the process that started it: if stderr is closed, the server is
    gone."""
    starter = (
        "import subprocess, sys\n"
        "server = subprocess.Popen([sys.executable, *sys.argv[1:]], stdout=subprocess.PIPE)\n"
        "print(server.stdout.readline())\n"
        "sys.stdout.flush()\n"
        "import os; os._exit(0)\n"
    )
    command = [sys.executable, "-c", starter, carla_wire.__file__, str(maps / "Town07.xodr")]
    ran = subprocess.run(command, capture_output=True, timeout=20)
    assert ran.stdout
    assert ran.stderr == b""
