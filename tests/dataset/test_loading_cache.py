"""The decoded cache: what it holds, that it resumes, and what it refuses."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from filelock import FileLock
from loading_sets import HEIGHT, MIDDLE, WIDTH, frame_of, write_scenario

from inspe_jax import dataset
from inspe_jax.core.errors import InspeError
from inspe_jax.core.geometry import pose_matrix, rotation
from inspe_jax.dataset.loading import caching, open_cache
from inspe_jax.dataset.loading.stored import AT_ONCE, STEPS, to_metres, to_steps
from inspe_jax.dataset.points_in_boxes import count_inside

SIZE = (HEIGHT, WIDTH)


@pytest.fixture
def made(loading_set, cached):
    return loading_set, cached.path


def test_a_cache_has_the_splits_and_frames_of_its_set(made, cached):
    data, folder = made
    assert (cached.path, cached.pictures) == (folder.resolve(), SIZE)
    names = {name: [each.name for each in found] for name, found in cached.splits.items()}
    assert names == {"train": ["a", "b"], "test": ["c"]}
    for split, scenarios in data.splits.items():
        for scenario, stored in zip(scenarios, cached.split(split), strict=True):
            assert stored.index["number"].tolist() == list(scenario.frames)
            assert stored.record.frames == len(scenario.frames)
            np.testing.assert_allclose(stored.middle, MIDDLE, atol=1e-6)


def test_clouds_differ_by_half_a_step_at_most(made, cached):
    """They are in random order, so both are sorted by intensity and place."""
    data, _ = made
    scenario, stored = data.splits["train"][1], cached.split("train")[1]
    for t, number in enumerate(scenario.frames):
        for s, station in enumerate(scenario.frame(number).stations):
            scan, step = station.scans[0], stored.index["steps"][t, s]
            turned = scan.points[:, :3].astype(float) @ rotation(scan.pose[3:], np).T
            given = np.column_stack([turned, scan.points[:, 3]])
            read = np.zeros((len(given), 4), np.float32)
            to_metres(stored.cloud(t, s), step, np.eye(3), np.zeros(3), read)
            distance = np.abs(given[:, None] - read[None]).max(-1)
            match = distance.argmin(1)
            assert sorted(match) == list(range(len(given)))
            assert (np.abs(given - read[match]) <= step / 2 + 1e-5).all()
            np.testing.assert_allclose(read[match, 3], given[:, 3], atol=1e-7)
            assert (step[:3] <= np.maximum(np.abs(given[:, :3]).max(0), 1) / STEPS + 1e-12).all()


def test_points_are_converted_in_parts_as_at_once():
    rng = np.random.default_rng(1)
    steps = rng.integers(-STEPS, STEPS, (2 * AT_ONCE + 5, 4)).astype(np.int16)
    step, linear, origin = rng.uniform(1e-3, 4e-3, 4), rng.normal(size=(3, 3)), np.arange(3.0)
    out = np.zeros((len(steps), 4), np.float32)
    to_metres(steps, step, linear, origin, out)
    np.testing.assert_allclose(out[:, :3], (steps[:, :3] * step[:3]) @ linear.T + origin, atol=1e-3)
    np.testing.assert_allclose(out[:, 3], steps[:, 3] * step[3], atol=1e-4)
    steps, step = to_steps([[1, 2, 3, 200.0]], np.zeros(6), rng)  # an intensity above 1
    np.testing.assert_allclose(steps[0] * step, [1, 2, 3, 200], atol=200 / STEPS)


def test_pictures_are_exact_or_of_half_the_size_means_of_four_pixels(made, cached, tmp_path):
    """To one level of 255: Pillow rounds once along rows and once along columns."""
    frame, stored = made[0].splits["test"][0].frame(8), cached.split("test")[0]
    for c, station in enumerate(frame.stations):
        (image,) = station.images
        np.testing.assert_array_equal(stored.pictures[1, c], image.rgb)
        np.testing.assert_allclose(stored.index["intrinsic"][1, c], image.intrinsic, atol=1e-9)
    half = dataset.cache(made[0].path / "test", tmp_path / "half", pictures=(24, 32), workers=1)
    stored = half.split("test")[0]
    image = made[0].splits["test"][0].frame(7).stations[0].images[0]
    means = image.rgb.reshape(24, 2, 32, 2, 3).mean((1, 3))
    assert np.abs(stored.pictures[0, 0] - means).max() <= 1.0
    expected = np.diag([0.5, 0.5, 1]) @ image.intrinsic
    np.testing.assert_allclose(stored.index["intrinsic"][0, 0], expected, atol=1e-9)


def test_boxes_and_their_returns(made, cached):
    frame, stored = made[0].splits["train"][0].frame(1), cached.split("train")[0]
    own = stored.boxes(1)
    scans = [station.scans[0] for station in frame.stations]
    expected = [[*b.center, *b.size, b.yaw, *b.velocity[:2]] for b in frame.boxes]
    np.testing.assert_allclose(stored.index["boxes"][own], expected, atol=1e-12)
    np.testing.assert_array_equal(stored.index["returns"][own], count_inside(scans, frame.boxes).T)
    assert (stored.index["returns"][own] >= 7).all()
    assert stored.index["track"][own].tolist() == [box.track for box in frame.boxes]


def test_poses_that_change_and_a_middle_that_no_protocol_says(tmp_path):
    first, second = frame_of(0), frame_of(1)
    (one, other), scan = second.stations, second.stations[0].scans[0]
    moved = replace(one, scans=(replace(scan, pose=scan.pose + 0.1),))
    frames = first, replace(second, stations=(moved, other))
    write_scenario(tmp_path / "set" / "train" / "a", frames, middle=None)
    found = dataset.cache(tmp_path / "set", tmp_path / "cache", pictures=SIZE, workers=1)
    (stored,) = found.scenarios
    places = np.array([box.center for frame in frames for box in frame.boxes])
    between = (places.min(0) + places.max(0)) / 2
    np.testing.assert_allclose(stored.middle, [*between[:2], MIDDLE[2]], atol=1e-5)
    for t, frame in enumerate(frames):
        for s, unit in enumerate(frame.stations):
            for key, pose in (("lidar_pose", unit.scans[0]), ("camera_pose", unit.images[0])):
                expected = pose_matrix(pose.pose)
                np.testing.assert_allclose(stored.index[key][t, s], expected, atol=1e-6)


def test_a_run_that_was_killed_is_resumed(made, tmp_path, monkeypatch):
    """Killed in the second scenario: the first is there, and half of the second is no scenario."""
    decode, seen = caching.decode, []

    def killed(scenario, place, *rest):
        seen.append(place.name)
        if len(seen) == 2:
            part = place.with_name(f".{place.name}.part")
            part.mkdir()
            (part / "points.raw").write_bytes(b"half")
            raise KeyboardInterrupt
        return decode(scenario, place, *rest)

    monkeypatch.setattr(caching, "decode", killed)
    with pytest.raises(KeyboardInterrupt):
        dataset.cache(made[0], tmp_path / "cache", pictures=None, workers=1)
    assert len(open_cache(tmp_path / "cache").scenarios) == 1
    found = dataset.cache(made[0], tmp_path / "cache", pictures=None, workers=1)
    assert len(found.scenarios) == 3
    assert len(seen) == 4  # one, the killed one twice, and the third
    dataset.cache(made[0], tmp_path / "cache", pictures=None, workers=1)
    assert len(seen) == 4
    assert not list((tmp_path / "cache").rglob("*.part"))
    whole = dataset.cache(made[0], tmp_path / "whole", pictures=None, workers=1)
    for a, b in zip(found.scenarios, whole.scenarios, strict=True):
        for name in a.record.files:
            assert (a.path / name).stat().st_size == (b.path / name).stat().st_size
        np.testing.assert_array_equal(a.points, b.points)


@pytest.mark.process
def test_worker_processes_decode_the_same(made, cached, tmp_path):
    found = dataset.cache(made[0], tmp_path / "cache", pictures=SIZE, workers=2)
    for a, b in zip(found.scenarios, cached.scenarios, strict=True):
        np.testing.assert_array_equal(a.points, b.points)
        np.testing.assert_array_equal(a.pictures, b.pictures)
        assert a.record == b.record


def test_a_copy_of_the_set_fits_and_another_set_does_not(made, cached, tmp_path):
    shutil.copytree(made[0].path, tmp_path / "copy")
    dataset.cache(tmp_path / "copy", cached.path, pictures=SIZE, workers=1)
    write_scenario(tmp_path / "copy" / "test" / "c", [frame_of(7, points=61)])
    before = sorted(cached.path.rglob("*"))
    with pytest.raises(InspeError, match=r"test.c: was not decoded from .* delete this scenario"):
        dataset.cache(tmp_path / "copy", cached.path, pictures=SIZE, workers=1)
    assert sorted(cached.path.rglob("*")) == before


def test_a_folder_with_anything_else_is_left_alone(made, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InspeError, match=r"notes\.txt, and is no cache: name an empty"):
        dataset.cache(made[0], tmp_path, workers=1)
    assert [path.name for path in tmp_path.iterdir() if path.name[0] != "."] == ["notes.txt"]
    with pytest.raises(InspeError, match="no cache: name an empty"):
        dataset.cache(made[0], made[0].path, workers=1)
    with pytest.raises(InspeError, match=r"not a cache: make one with"):
        open_cache(tmp_path)


def test_another_size_of_pictures_needs_another_folder(made, cached):
    for pictures in ((24, 32), None):
        with pytest.raises(InspeError, match=r"has pictures of \[48, 64\].* another folder"):
            dataset.cache(*made, pictures=pictures, workers=1)
    other = pytest.raises(InspeError, match="in use by another run")
    with FileLock(cached.path / caching.LOCK), other:
        dataset.cache(*made, pictures=SIZE, workers=1)


def test_damage_is_noticed(cached, tmp_path):
    shutil.copytree(cached.path, tmp_path / "cache")
    for name in ("points.raw", "index.npz"):
        file = tmp_path / "cache" / "test" / "c" / name
        content = file.read_bytes()
        file.write_bytes(content[:-1])
        with pytest.raises(InspeError, match=rf"{name}: is missing or damaged: delete .*c and"):
            open_cache(tmp_path / "cache")
        file.write_bytes(content)
    file.write_bytes(b"\0" * 200 + content[200:])
    stored = open_cache(tmp_path / "cache").split("test")[0]
    with pytest.raises(InspeError, match=r"index\.npz: is missing or damaged"):
        _ = stored.index
    record = tmp_path / "cache" / "cache.json"
    for text, message in (
        (json.dumps({"format": "inspe_jax cache 0", "pictures": None}), "by another version: name"),
        ("{", r"cache\.json: not JSON"),
    ):
        record.write_text(text)
        with pytest.raises(InspeError, match=message):
            open_cache(tmp_path / "cache")


@pytest.mark.parametrize("frame", [0, 1])
def test_frames_of_different_sensors_are_refused(tmp_path, frame):
    write_scenario(tmp_path / "set" / "train" / "a", [frame_of(0), frame_of(1)])
    for path in (tmp_path / "set").rglob(f"00000{frame}_camera0.png"):
        path.unlink()
    with pytest.raises(InspeError, match="frame 1 has LiDARs and cameras of stations"):
        dataset.cache(tmp_path / "set", tmp_path / "cache", pictures=SIZE, workers=1)
    found = dataset.cache(tmp_path / "set", tmp_path / "without", pictures=None, workers=1)
    assert found.scenarios[0].record.lidars == 2


def test_clouds_without_any_point(tmp_path):
    empty = np.zeros((0, 4), np.float32)
    units = frame_of(0).stations
    stations = [replace(of, images=(), scans=(dataset.Scan(of.pose, empty),)) for of in units]
    frame = dataset.Frame(0, 0.0, (), tuple(stations))
    write_scenario(tmp_path / "set" / "train" / "a", [frame], middle=None)
    found = dataset.cache(tmp_path / "set", tmp_path / "cache", workers=1)
    middle = (stations[0].pose + stations[1].pose)[:2] / 2  # there is no road user either
    np.testing.assert_allclose(found.scenarios[0].middle, [*middle, 0], atol=1e-6)
    batch = dataset.Loader(found, batch=1, augment=dataset.Augment(), workers=0)[0]
    assert batch.lidars.present.all()
    assert not batch.lidars.mask.any()
    assert not batch.targets.mask.any()


def test_bad_arguments(made, tmp_path):
    for bad in (dict(pictures=(0, 4)), dict(pictures=(3.5, 4)), dict(workers=0)):
        with pytest.raises(InspeError, match=r"or more"):
            dataset.cache(made[0], tmp_path / "cache", **bad)
    write_scenario(tmp_path / "none" / "train" / "a", [frame_of(0)])
    for path in (tmp_path / "none").rglob("000000.yaml"):
        path.unlink()
    with pytest.raises(InspeError, match="no scenario has a frame"):
        dataset.cache(tmp_path / "none", tmp_path / "cache", workers=1)
