"""Augmented frames stay consistent: points in their boxes, corners on their pixels."""

import numpy as np
import pytest
from loading_sets import MARK

from inspe_jax.core.errors import InspeError
from inspe_jax.core.geometry import rotation
from inspe_jax.dataset.loading import Augment, Loader, Similarity, on_picture


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
    (dict(flip=1.5), "flip: 1.5 is out of range: from 0 to 1"),
    (dict(turn=4.0), r"turn \[rad\]: 4 is out of range"),
    (dict(scale=(1.1, 0.9)), "the smaller first"),
    (dict(scale=(0.0, 1.0)), "above 0"),
])  # fmt: skip
def test_bad_augmentations(cached, bad, message):
    with pytest.raises(InspeError, match=message):
        Loader(cached, augment=Augment(**bad))
