"""The loader: order, seeds, shapes, and frames that stay consistent when they are augmented."""

import pickle
from dataclasses import replace

import jax
import numpy as np
import pytest
from loading_sets import HEIGHT, MARK, MIDDLE, WIDTH, frame_of, write_scenario

from inspe_jax import dataset
from inspe_jax.core.errors import InspeError
from inspe_jax.core.geometry import rotation
from inspe_jax.dataset.loading import Augment, Loader, PillarGrid, Similarity, on_picture


def assert_equal(a, b) -> None:
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


def numbers(batches) -> list[int]:
    return [int(n) for batch in batches for n in batch.number[batch.valid]]


def test_the_order_repeats_with_its_seed_whatever_the_workers(cached):
    settings = dict(batch=2, augment=Augment())
    given = [list(Loader(cached, seed=3, workers=w, **settings).steps(0, 8)) for w in (0, 1, 3)]
    for others in given[1:]:
        for a, b in zip(given[0], others, strict=True):
            assert_equal(a, b)
    late = Loader(cached, seed=3, workers=2, **settings).steps(5, 8)
    for a, b in zip(given[0][5:], late, strict=True):
        assert_equal(a, b)
    assert_equal(Loader(cached, seed=3, **settings)[6], given[0][6])
    other = list(Loader(cached, seed=4, **settings).steps(0, 8))
    assert numbers(other) != numbers(given[0])
    assert not np.array_equal(other[0].transform, given[0][0].transform)


def test_an_epoch_has_each_frame_once(cached):
    loader = Loader(cached, batch=1, workers=0)
    epochs = [numbers(loader.steps(7 * e, 7 * e + 7)) for e in range(3)]
    assert all(sorted(epoch) == [0, 1, 2, 3, 4, 5, 6] for epoch in epochs)
    assert epochs[0] != epochs[1] != epochs[2]
    assert numbers(loader) == epochs[0]
    assert len(loader) == 7
    full = Loader(cached, batch=3, workers=0)
    assert len(full) == 2
    assert all(batch.valid.all() for batch in full)
    assert len(set(numbers(full))) == 6
    with pytest.raises(IndexError, match="below 0"):
        loader[-1]


def test_in_evaluation_the_last_batch_is_filled_up(cached):
    loader = Loader(cached, batch=4, shuffle=False)
    first, last = loader
    assert numbers([first, last]) == [0, 1, 2, 3, 4, 5, 6]
    assert last.valid.tolist() == [True] * 3 + [False]
    assert not last.targets.mask[3].any()
    assert not last.lidars.present[3].any()
    assert not last.cameras.present[3].any()
    for part in (last.lidars.points, last.lidars.mask, last.cameras.pixels, last.targets.boxes):
        assert not part[3].any()
    assert numbers([loader[2]]) == [0, 1, 2, 3]  # the next epoch
    np.testing.assert_array_equal(last.transform, np.eye(4)[None].repeat(4, 0))


def test_shapes_and_types_are_the_same_in_all_batches_of_all_splits(cached):
    shapes = {
        tuple((leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(batch))
        for split in ("train", "test")
        for batch in Loader(cached, split, batch=2, shuffle=False, workers=0)
    }
    assert len(shapes) == 1
    found = Loader(cached, batch=2, workers=0)[0]
    most = 60 + 30 + 10 + 7 * 2  # points on the ground of the second LiDAR, and in two boxes
    assert found.lidars.points.shape == (2, 2, most, 4)
    assert found.cameras.pixels.shape == (2, 2, HEIGHT, WIDTH, 3)
    assert found.targets.boxes.shape == (2, 4, 9)
    assert found.targets.returns.shape == (2, 4, 2)
    types = {leaf.dtype.name for leaf in jax.tree.leaves(found)}
    assert types == {"float32", "int32", "uint8", "bool"}


def test_points_poses_and_boxes_are_in_the_frame_of_the_intersection(cached):
    found = Loader(cached, "test", batch=1, shuffle=False, workers=0)[0]
    frame = frame_of(7)
    for s, station in enumerate(frame.stations):
        scan, pose = station.scans[0], found.lidars.pose[0, s]
        np.testing.assert_allclose(pose[:3, 3], scan.pose[:3] - MIDDLE, atol=1e-4)
        assert found.lidars.unit[0, s] == found.cameras.unit[0, s] == station.number
        cloud = found.lidars.points[0, s][found.lidars.mask[0, s]]
        assert len(cloud) == len(scan.points)
        assert (np.abs(cloud[:, 2]) < 5e-3).sum() >= 60 + 10 * s  # the ground is at 0
    centers = np.array([box.center for box in frame.boxes]) - MIDDLE
    np.testing.assert_allclose(found.targets.boxes[0, :, :3], centers, atol=1e-5)
    assert found.targets.kind[0].tolist() == [0, 1, 2, 3]


def test_scenarios_of_fewer_sensors_are_padded(tmp_path):
    frames = frame_of(0), frame_of(1, cameras=False), frame_of(2, lidars=False)
    for name, frame in zip("abc", frames, strict=True):
        write_scenario(tmp_path / "set" / "train" / name, [frame])
    found = dataset.cache(tmp_path / "set", tmp_path / "cache", pictures=(6, 8), workers=1)
    batch = Loader(found, batch=3, shuffle=False, workers=0)[0]
    assert batch.cameras.present.tolist() == [[True, True], [False, False], [True, True]]
    assert batch.lidars.present.tolist() == [[True, True], [True, True], [False, False]]
    assert not batch.cameras.pixels[1].any()
    assert not batch.lidars.points[2].any()
    assert not batch.targets.returns[2].any()
    lidar = Loader(found, batch=3, sensors=("lidar",), workers=0)[0]
    camera = Loader(found, batch=3, sensors=("camera",), workers=0)[0]
    assert lidar.cameras is camera.lidars is None
    assert camera.targets.returns.any()  # how visible a road user is matters for cameras as well
    blind = dataset.cache(tmp_path / "set", tmp_path / "blind", pictures=None, workers=1)
    assert Loader(blind, batch=1)[0].cameras is None
    with pytest.raises(InspeError, match="has no camera: it was made with pictures=None"):
        Loader(blind, sensors=("camera",))


def test_road_users_out_of_reach_are_left_out(cached):
    every = Loader(cached, "test", batch=3, shuffle=False, workers=0)[0].targets
    near = Loader(cached, "test", batch=3, shuffle=False, half=8.0, workers=0)[0].targets
    away = np.abs(every.boxes[..., :2]).max(-1)
    assert 0 < near.mask.sum() < every.mask.sum()
    for b in range(3):
        kept = every.track[b][away[b] <= 8.0]
        assert near.track[b][near.mask[b]].tolist() == kept.tolist()


def test_errors_of_workers_reach_the_caller_and_nothing_is_made_far_ahead(cached, monkeypatch):
    """Leaving a loop early ends its threads."""
    made = []
    given = Loader.__getitem__

    def counted(loader, step):
        made.append(step)
        if step == 9:
            raise InspeError("a broken frame")
        return given(loader, step)

    monkeypatch.setattr(Loader, "__getitem__", counted)
    loader = Loader(cached, batch=1, workers=2)
    steps = loader.steps()
    next(steps)
    steps.close()
    assert 1 <= len(made) <= 4
    with pytest.raises(InspeError, match="a broken frame"):
        list(loader.steps(7, 14))


def test_a_loader_can_be_sent_to_another_process_and_a_batch_is_a_pytree(cached):
    loader = Loader(cached, batch=2, points=PillarGrid(most_pillars=50), augment=Augment())
    text = pickle.dumps(loader)
    assert len(text) < 10_000
    batch = pickle.loads(text)[1]
    assert_equal(batch, loader[1])
    sent = jax.device_put(batch)
    assert_equal(sent, batch)
    assert type(sent) is type(batch)


@pytest.mark.parametrize(("bad", "message"), [
    (dict(split="trian"), "split 'trian': one of train, test; did you mean train"),
    (dict(batch=0), "batch 0: a whole number, at least 1"),
    (dict(batch=8), "split 'train' has 7 frames, less than a batch of 8: use a smaller"),
    (dict(seed=-1), "seed -1"),
    (dict(workers=1.5), "workers 1.5"),
    (dict(sensors=("radar",)), "sensors: 'radar': one of camera, lidar"),
    (dict(sensors="lidar"), "sensors 'lidar': a list"),
    (dict(sensors=()), "a list with at least one"),
])  # fmt: skip
def test_bad_arguments(cached, bad, message):
    with pytest.raises(InspeError, match=message):
        Loader(cached, **bad)


def test_targets_say_how_many_pixels_show_a_road_user(tmp_path):
    frame, stations = frame_of(0), []
    pixels = np.arange(4)[:, None] * 100 + [1, 2]
    for k, station in enumerate(frame.stations):
        seen = replace(station.images[0], pixels=pixels[:, k], share=np.ones(4))
        stations.append(replace(station, images=(seen,)))
    frames = replace(frame, stations=tuple(stations)), frame_of(1)
    write_scenario(tmp_path / "set" / "train" / "a", frames)
    half = (HEIGHT // 2, WIDTH // 2)
    found = dataset.cache(tmp_path / "set", tmp_path / "cache", pictures=half, workers=1)
    batch, expected = Loader(found, batch=2, shuffle=False)[0], pixels / 4
    np.testing.assert_array_equal(batch.targets.pixels[0, :4], expected)
    assert (batch.targets.pixels[1, :4] == -1).all()  # the set does not say


@pytest.fixture(scope="module")
def batch(cached):
    augment = Augment(flip=0.5, turn=np.pi, scale=(0.8, 1.25))
    found = Loader(cached, "train", batch=7, augment=augment, shuffle=False, workers=0)[0]
    assert found.valid.all()
    assert len(np.unique(np.sign(np.linalg.det(found.transform)))) == 2  # mirrored, and not
    return found


def inside(points, box, margin=0.0) -> np.ndarray:
    local = (points[:, :3] - box[:3]) @ rotation(np.array([0.0, 0.0, box[6]]), np)
    return (np.abs(local) <= box[3:6] / 2 + margin).all(1)


def test_points_in_boxes_stay_in_them(batch):
    """Each LiDAR has 7 points in each box, at least 2 cm below its surface."""
    counted = 0
    for b in range(7):
        for m in np.flatnonzero(batch.targets.mask[b]):
            for s in range(2):
                cloud = batch.lidars.points[b, s][batch.lidars.mask[b, s]]
                deep = inside(cloud, batch.targets.boxes[b, m].astype(float), -0.01)
                assert deep.sum() == 7 <= batch.targets.returns[b, m, s]
                counted += 7
    assert counted == 7 * 2 * (3 * 4 + 4 * 2)


def test_corners_stay_on_their_pixels(batch, cached):
    """The first corner of each frame's first box is marked in the pictures that show it."""
    seen = 0
    for b in range(7):
        pixels = batch.cameras.pixels[b]
        box = batch.targets.boxes[b, 0].astype(float)
        mirrored = np.linalg.det(batch.transform[b, :3, :3]) < 0
        half = box[3:6] / 2 * [1, -1 if mirrored else 1, -1]  # front left, at the bottom
        corner = box[:3] + rotation(np.array([0, 0, box[6]]), np) @ half
        for c in np.flatnonzero((pixels == MARK).all(-1).any((1, 2))):
            column, row, depth = on_picture(
                corner[None], batch.cameras.pose[b, c], batch.cameras.intrinsic[b, c]
            )[0]
            assert depth > 0
            rows, columns = np.nonzero((pixels[c] == MARK).all(-1))
            # The mark is 3 × 3 pixels around the one that holds the corner.
            assert abs(columns.mean() + 0.5 - column) <= 0.51
            assert abs(rows.mean() + 0.5 - row) <= 0.51
            seen += 1
    assert seen >= 5


def test_poses_stay_rotations_and_hold_the_same_points(batch, cached):
    """In its sensor's frame a cloud is scaled, and left and right change if it is mirrored."""
    for b in range(7):
        transform = batch.transform[b].astype(float)
        determinant = np.linalg.det(transform[:3, :3])
        scale = np.cbrt(abs(determinant))
        stored = cached.split("train")[batch.scenario[b]]
        t = stored.index["number"].tolist().index(batch.number[b])
        for s in range(2):
            pose = batch.lidars.pose[b, s].astype(float)
            np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-5)
            assert np.linalg.det(pose[:3, :3]) == pytest.approx(1, abs=1e-5)
            cloud = batch.lidars.points[b, s][batch.lidars.mask[b, s]][:, :3].astype(float)
            own = (cloud - pose[:3, 3]) @ pose[:3, :3]
            steps = stored.cloud(t, s)[:, :3] * stored.index["steps"][t, s, :3]
            before = steps @ stored.index["lidar_pose"][t, s, :3, :3]
            side = np.array([1, np.sign(determinant), 1])
            np.testing.assert_allclose(own, scale * before * side, atol=1e-3)


def test_frames_differ_in_how_they_are_changed(cached):
    loader = Loader(cached, "train", batch=2, augment=Augment(), sensors=("lidar",), workers=0)
    transforms = np.concatenate([loader[k].transform for k in range(70)])[:, :3, :3]
    determinants = np.linalg.det(transforms.astype(float))
    scales = np.cbrt(np.abs(determinants))
    turns = np.abs(np.arctan2(transforms[:, 1, 0], transforms[:, 0, 0]))
    assert 45 <= (determinants < 0).sum() <= 95  # of 140, 0.5 each: within four sigmas
    assert 0.95 <= scales.min() < 0.955
    assert 1.045 < scales.max() <= 1.05
    assert np.pi / 4 - 0.05 < turns.max() <= np.pi / 4 + 1e-6
    assert len(np.unique(transforms, axis=0)) == 140


def test_a_similarity_by_hand():
    """A quarter turn of the mirror image, at twice the size, of a box that heads north-east."""
    moved = Similarity(mirrored=True, turn=np.pi / 2, scale=2.0)
    box = np.array([[3.0, 1, 0.5, 4, 2, 1, np.pi / 4, 1, 1]])
    # (3, 1) mirrors to (3, −1) and turns to (1, 3); the heading mirrors to −45° and turns to 45°.
    np.testing.assert_allclose(
        moved.of_boxes(box)[0], [2, 6, 1, 8, 4, 2, np.pi / 4, 2, 2], atol=1e-12
    )
    np.testing.assert_allclose(moved.matrix @ [3, 1, 0.5, 1], [2, 6, 1, 1], atol=1e-12)
    box[0, 6] = 3.0  # yaws stay within ±π
    assert Similarity(turn=2.0).of_boxes(box)[0, 6] == pytest.approx(5 - 2 * np.pi)


@pytest.mark.parametrize(("bad", "message"), [
    (dict(flip=1.5), "flip .a chance.: 1.5 is out of range: from 0 to 1"),
    (dict(turn=4.0), r"turn \[rad\]: 4 is out of range"),
    (dict(scale=(1.1, 0.9)), "the smaller first"),
    (dict(scale=(0.0, 1.0)), "above 0"),
])  # fmt: skip
def test_bad_augmentations(cached, bad, message):
    with pytest.raises(InspeError, match=message):
        Loader(cached, augment=Augment(**bad))
