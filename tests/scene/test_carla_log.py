"""Recorder logs: against one written here byte by byte, and CARLA's own."""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from worlds import MAPS, crossing

from inspe_jax.core.errors import InspeError
from inspe_jax.scene.scene import build_scene
from inspe_jax.scene.traffic.carla_log import load_log, log_traffic
from inspe_jax.scene.traffic.frames import ROAD_USERS

LOGS = MAPS.parent / "carla_logs"
CAR, TRUCK, CYCLIST, PEDESTRIAN = range(4)


def text(words: str) -> bytes:
    return struct.pack("<H", len(words)) + words.encode()


def packet(kind: int, content: bytes) -> bytes:
    return struct.pack("<BI", kind, len(content)) + content


def rows(form: str, *each: tuple) -> bytes:
    return struct.pack("<H", len(each)) + b"".join(struct.pack("<" + form, *row) for row in each)


ACTORS = {
    # id: blueprint, attributes, half sizes [m], start (x, y, yaw°) left-handed, velocity
    1: ("vehicle.lincoln.mkz", {"number_of_wheels": "4"}, (2.4, 1.0, 0.8), (0, 10, 0), (8, 0)),
    2: ("vehicle.bmw.grandtourer", {"number_of_wheels": "2"}, (1, 0.4, 0.9), (5, -8, 90), (0, 4)),
    3: ("vehicle.carlamotors.carlacola", {"number_of_wheels": "4"}, (3.2, 1.2, 1.3),
        (-5, 3, 180), (-2, 0)),
    4: ("walker.pedestrian.0001", {}, (0.2, 0.2, 0.9), (3, 3, -90), (0, -1)),
    5: ("static.prop.mesh", {}, (9, 9, 9), (0, 0, 0), (0, 0)),
    6: ("vehicle.tesla.cybertruck", {"number_of_wheels": "4", "base_type": "truck"},
        (2.9, 1.1, 1.0), (20, 0, 0), (0, 0)),
}  # fmt: skip


def log(frames: int = 5, town: str = "Town01", after: float = 0.5) -> bytes:
    """Everybody drives on at a constant velocity; boxes hang 0.1 m before their actors."""
    data = struct.pack("<H", 1) + text("CARLA_RECORDER") + struct.pack("<q", 0) + text(town)
    for k in range(frames):
        time = 3.0 + k * after
        data += packet(0, struct.pack("<Qdd", k, after, time))
        if k == 0:
            born = struct.pack("<H", len(ACTORS))
            for actor, (name, facts, *_) in ACTORS.items():
                born += struct.pack("<IB6fI", actor, 1, *[0.0] * 6, actor) + text(name)
                born += struct.pack("<H", len(facts))
                for key, value in facts.items():
                    born += struct.pack("<B", 3) + text(key) + text(value)
            data += packet(2, born)
        where, speed, boxes = [], [], []
        for actor, (_, _, half, (x, y, yaw), (vx, vy)) in ACTORS.items():
            t = k * after
            where.append((actor, 100 * (x + vx * t), 100 * (y + vy * t), 0.0, 0.0, 0.0, yaw))
            speed.append((actor, vx, vy, 0, 0, 0, 0))
            boxes.append((actor, 10.0, 0.0, 100 * half[2], *(100 * h for h in half)))
        data += packet(6, rows("I6f", *where)) + packet(12, rows("I6f", *speed))
        data += packet(13, rows("I6f", *boxes)) + packet(99, b"something newer")
        data += packet(1, b"")
    return data


@pytest.fixture
def place():
    return replace(crossing(center=(0, 0, 0)), map=Path("Town01.xodr"))


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "run.log"
    path.write_bytes(log())
    return path


def test_who_is_where_worked_out_on_paper(place, path):
    """CARLA's y and yaw change sign; boxes lie 0.1 m ahead of their actors."""
    traffic = log_traffic(place, path, radius=60, frames=3, step=0.75)
    assert traffic.time.tolist() == [0.0, 0.75, 1.5]
    assert traffic.valid.all()
    first, second = traffic.at(0), traffic.at(1)
    assert first.track.tolist() == [1, 2, 3, 4, 6]
    assert first.kind.tolist() == [CAR, CYCLIST, TRUCK, PEDESTRIAN, TRUCK]
    for center, expected in zip(
        second.center[:4],
        ([6.1, -10, 0.8], [5, 8 - 3 - 0.1, 0.9], [-6.6, -3, 1.3], [3, -3 + 0.75 + 0.1, 0.9]),
        strict=True,
    ):
        assert center == pytest.approx(expected, abs=1e-5)
    assert np.degrees(first.yaw[:4]) % 360 == pytest.approx([0, 270, 180, 90])
    assert first.velocity[[1, 3]].tolist() == [[0, -4, 0], [0, 1, 0]]  # 2 goes south
    assert first.size[0] == pytest.approx([4.8, 2.0, 1.6])


def test_a_box_without_a_size_has_the_usual_one(place, tmp_path, monkeypatch):
    name, facts, (long, _, high), *rest = ACTORS[2]
    monkeypatch.setitem(ACTORS, 2, (name, facts, (long, 0.0, np.inf), *rest))
    path = tmp_path / "run.log"
    path.write_bytes(log())
    scene = build_scene(place, radius=20, voxel=1.0, frames=1, traffic=path)
    size = scene.traffic.at(0).size[1]
    assert size == pytest.approx([2 * long, *ROAD_USERS[CYCLIST].size[1:]])
    assert size[2] < 2 * high + 1
    assert scene.intersection.notes[-1:] == (
        "the log has boxes without a size: 1 road user of the usual size of the kind",
    )


def test_who_is_set_down_elsewhere_does_not_fly_there(place, tmp_path, monkeypatch):
    monkeypatch.setitem(ACTORS, 1, (*ACTORS[1][:-1], (100, 0)))  # 50 m from frame to frame
    path = tmp_path / "a.log"
    path.write_bytes(log())
    traffic = log_traffic(place, path, radius=80, frames=2, step=0.2)
    assert traffic.center[1, 0, 0] == pytest.approx(0.1)  # where it was, not 20 m on


def test_who_is_above_the_road_is_left_out(path):
    high = replace(crossing(center=(0, 0, 30.0)), map=Path("Town01.xodr"))
    with pytest.raises(InspeError, match="nobody comes within"):
        log_traffic(high, path, radius=60, frames=3)


def test_bad_input(place, path, tmp_path):
    beside = {key: shapely.affinity.translate(of, 30, 30) for key, of in place.regions.items()}
    with pytest.raises(InspeError, match=r"map 'Town01', and not of test crossing: 33% of"):
        log_traffic(replace(place, regions=beside, map=None), path, radius=60, frames=3)
    log_traffic(replace(place, regions=beside), path, radius=60, frames=3, notes=(said := []))
    assert said == ["33% of the log's cars and trucks are on the roads here"]
    for name in ("renamed.xodr", "Town05.net.xml"):  # what its map's file is called says nothing
        named = log_traffic(replace(place, map=Path(name)), path, radius=60, frames=3)
        assert named.frame_count == 3
    with pytest.raises(InspeError, match="in 2 s nobody comes within 5 m of"):
        log_traffic(replace(place, center=np.array([90.0, 90, 0])), path, radius=5, frames=3)
    whole = log()
    broken = {
        b"": "not a log of CARLA's recorder",
        b"2026-01-01 12:00 INFO started\n": "not a log of CARLA's recorder",
        whole[:-8]: "cut short or broken",
        whole[:200]: "cut short or broken",
        whole[:40]: "cut short|no frames",
    }
    for k, (data, message) in enumerate(broken.items()):
        (tmp_path / f"{k}.log").write_bytes(data)
        with pytest.raises(InspeError, match=message):
            load_log(tmp_path / f"{k}.log")


@pytest.mark.skipif(not LOGS.is_dir(), reason="CARLA's recorder logs are not at hand")
def test_a_real_run_is_read():
    """Two cars of the scenario runner, one after the other along Town01's street at y = 133 m
    (left-handed): each moves as its velocity says."""
    path = LOGS / "DistanceBetweenVehicles.log"
    place = replace(crossing(center=(200.0, -133.4, 0)), map=Path("Town01.xodr"))
    traffic = log_traffic(place, path, radius=60, frames=240, step=0.1)
    assert set(traffic.track[traffic.valid].tolist()) == {174, 175}
    assert (np.abs(traffic.center[traffic.valid][:, 1] + 133.4) < 1.0).all()
    assert traffic.size[traffic.valid][:, 0] == pytest.approx(4.75, abs=0.2)
    for track in (174, 175):
        frame, entry = np.nonzero(traffic.track == track)
        at, speed = (x[frame, entry, :2] for x in (traffic.center, traffic.velocity))
        moved = np.diff(at, axis=0) / 0.1
        assert len(moved) > 80
        assert np.abs(moved - (speed[1:] + speed[:-1]) / 2).max() < 0.4
