"""The ground truth of a batch as detections."""

import numpy as np

from inspe_jax.dataset.loading import Targets
from inspe_jax.perception.detections import truth_of, within


def targets() -> Targets:
    """Two frames: three road users and a place for padding; and none."""
    boxes = np.zeros((2, 4, 9), np.float32)
    boxes[0, :3, 0], boxes[0, :3, 1] = [5, -20, 30], [0, 20.5, 1]
    boxes[0, :3, 3:6] = [4, 2, 1.5]
    return Targets(
        boxes=boxes,
        kind=np.array([[1, 0, 3, 0], [0] * 4], np.int32),
        track=np.array([[7, 8, 9, 0], [0] * 4], np.int32),
        returns=np.zeros((2, 4, 0), np.int32),
        pixels=np.zeros((2, 4, 0), np.float32),
        mask=np.array([[True, True, True, False], [False] * 4]),
    )


def test_the_truth_is_what_is_no_padding():
    found = truth_of(targets(), 0)
    assert found.kind.tolist() == [1, 0, 3]
    np.testing.assert_array_equal(found.boxes, targets().boxes[0, :3])
    assert found.score.tolist() == [1, 1, 1]
    assert [part.dtype for part in found] == [np.float32, np.int32, np.float32]
    none = truth_of(targets(), 1)
    assert [part.shape for part in none] == [(0, 9), (0,), (0,)]


def test_a_region_keeps_its_edge():
    for half, kept in ((30, [1, 0, 3]), (20.5, [1, 0]), (20.4, [1])):
        assert within(truth_of(targets(), 0), half).kind.tolist() == kept
