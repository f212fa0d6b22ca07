"""The figure of detections beside ground truth: what is drawn where, and how it is marked."""

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from inspe_jax.core.errors import InspeError
from inspe_jax.core.geometry import pose_matrix
from inspe_jax.core.sheet import CLASS_COLORS
from inspe_jax.dataset.loading import Batch, Cameras, Lidars, Targets
from inspe_jax.perception.evaluation import Detections, truth_of
from inspe_jax.perception.figure import MISSED_COLOR, TRUTH_COLOR, draw

POINTS = np.array([[3.0, 4, 0, 1], [-5, 1, 0, 1], [900, 0, 0, 1]], np.float32)
"""Three points, of which the last is far outside the plan."""

USERS = np.array(
    [
        [10, 0, 1, 4, 2, 2, 0, 0, 0],
        [0, 20, 1, 4, 2, 2, np.pi / 2, 0, 0],
        [-8, -8, 0.9, 0.5, 0.5, 1.8, 0, 0, 0],
    ],
    np.float32,
)
"""A car ahead of the camera, a car beside it, and a pedestrian behind it."""


LEVEL = np.array([0.0, 0, 1, 0, 0, 0])


def batch(cameras: bool = True, points: bool = True) -> Batch:
    """Two frames, of which the second is padding. Unit 2 has a camera, a level one at the origin,
    1 m above the ground, which looks along x; unit 1 has a LiDAR there."""
    poses = np.broadcast_to(pose_matrix(LEVEL).astype(np.float32), (2, 2, 4, 4))
    present = np.array([[True, False]] * 2)
    padded, mask = np.zeros((2, 2, 5, 4), np.float32), np.zeros((2, 2, 5), bool)
    padded[0, 0, :3], mask[0, 0, :3] = POINTS, True
    lidars = Lidars(padded, mask, None, poses, present, np.array([[1, 0]] * 2, np.int32))
    intrinsic = np.array([[100, 0, 400], [0, 100, 300], [0, 0, 1]], np.float32)
    pixels = np.full((2, 2, 600, 800, 3), 90, np.uint8)
    unit = np.array([[2, 0]] * 2, np.int32)
    views = Cameras(pixels, np.broadcast_to(intrinsic, (2, 2, 3, 3)), poses, present, unit)
    targets = Targets(
        boxes=np.stack([USERS, USERS]),
        kind=np.array([[0, 0, 3]] * 2, np.int32),
        track=np.zeros((2, 3), np.int32),
        returns=np.zeros((2, 3, 2), np.int32),
        pixels=np.zeros((2, 3, 2), np.float32),
        mask=np.array([[True] * 3, [False] * 3]),
    )
    none, same = np.zeros(2, np.int32), np.broadcast_to(np.eye(4, dtype=np.float32), (2, 4, 4))
    of = lidars if points else None, views if cameras else None, targets
    return Batch(*of, none, none, same, valid=np.array([True, False]))


def detections() -> Detections:
    """The car ahead is found; the other one is taken for a truck; a cyclist is nowhere; and one
    with a low score."""
    boxes = np.concatenate([USERS[:2], USERS[:1], USERS[2:]])
    boxes[0, 0] += 0.5
    boxes[2, :2] = [15, -20]
    score = np.array([0.9, 0.6, 0.30, 0.05], np.float32)
    return Detections(boxes, np.array([0, 1, 2, 3], np.int32), score)


def plan_of(fig: Figure):
    return next(ax for ax in fig.axes if ax.get_xlabel() == "x [m]")


def polygons(ax) -> list[tuple[tuple[str, str], np.ndarray]]:
    """Fill and edge colour, and corners."""
    found = []
    for drawn in ax.collections:
        if type(drawn).__name__ == "PolyCollection":
            fills, edges = drawn.get_facecolor(), drawn.get_edgecolor()
            for k, path in enumerate(drawn.get_paths()):
                fill = to_hex(fills[k % len(fills)]) if len(fills) else "none"
                found.append(((fill, to_hex(edges[k % len(edges)])), path.vertices[:4]))
    return found


def panel_rows(fig: Figure) -> dict[str, list[str]]:
    panel = next(ax for ax in fig.axes if ax.get_legend())
    rows: dict[float, list[str]] = {}
    for text in sorted(panel.texts, key=lambda text: text.get_position()[0]):
        rows.setdefault(text.get_position()[1], []).append(text.get_text())
    return {row[0]: row[1:] for row in rows.values()}


@pytest.fixture(scope="module")
def fig():
    return draw(batch(), 0, detections(), "a detector", least_score=0.1)


def test_the_heading_and_the_panel_count(fig):
    words = "\n".join(text.get_text() for text in fig.texts)
    assert "a detector" in words
    assert "3 road users; 3 detections with a score of 0.1 or more, and 1 below, not drawn" in words
    assert "within 2 m: 1 found, 2 missed, 2 false detections" in words
    counts = {"car": "110", "truck": "001", "cyclist": "001", "pedestrian": "010"}
    expected = {kind: [*numbers] for kind, numbers in counts.items()}
    assert panel_rows(fig) == {"found": ["missed", "false"]} | expected


def test_boxes_are_in_plan_where_they_are(fig):
    """Truth is filled, in yellow where it is missed; detections have the colour of their class,
    and their score."""
    shown = polygons(plan_of(fig))
    truth = [(fill, corners) for (fill, edge), corners in shown if edge == TRUTH_COLOR]
    assert [fill == MISSED_COLOR for fill, _ in truth] == [False, True, True]
    np.testing.assert_allclose(truth[0][1].min(0), [8, -1])
    np.testing.assert_allclose(truth[1][1].max(0), [1, 22], atol=1e-5)
    found = [(edge, corners) for (_, edge), corners in shown if edge != TRUTH_COLOR]
    assert [color for color, _ in found] == list(CLASS_COLORS[:3])
    np.testing.assert_allclose(found[0][1].min(0), [8.5, -1])
    ax = plan_of(fig)
    by = {line.get_marker(): line.get_xydata() for line in ax.lines if len(line.get_xydata())}
    np.testing.assert_allclose(by["o"], USERS[1:, :2])  # missed
    np.testing.assert_allclose(by["x"], [[0, 20], [15, -20]])  # false
    words = {text.get_text(): text for text in ax.texts}
    assert list(words) == [".90", ".60", ".30", "1", "2"]  # scores, and the units
    np.testing.assert_allclose(words[".90"].xy, [12.5, 0])


def test_boxes_are_on_the_picture_where_the_calibration_puts_them(fig):
    """The near corners of the car ahead are 8 m away, 1 m beside and 1 m above and below the axis:
    12.5 pixels. Its detection is half a metre farther. What is behind the camera is not there."""
    (ax,) = (ax for ax in fig.axes if ax.images)
    assert ax.get_title(loc="left") == "unit 2, camera 0: 2 detections"
    truth, missed, found, false = (drawn.get_segments() for drawn in ax.collections)
    assert [len(lines) for lines in (truth, missed, found)] == [12, 0, 12]
    ends = np.concatenate(truth)
    assert ends.min(0).tolist() == [387.5, 287.5]
    assert ends.max(0).tolist() == [412.5, 312.5]
    np.testing.assert_allclose(np.concatenate(found).min(0), 400 - 100 / 8.5 - np.array([0, 100]))
    assert np.concatenate(false)[:, 0].min() > 412.5  # the cyclist, right of it
    assert to_hex(ax.collections[2].get_color()[0]) == CLASS_COLORS[0]
    assert (ax.get_xlim(), ax.get_ylim()) == ((0, 800), (600, 0))


@pytest.mark.parametrize(("cameras", "points"), [(False, True), (True, False)])
def test_sensors_may_be_missing_and_no_padding_is_drawn(cameras, points):
    fig = draw(batch(cameras, points), 0, detections(), "few sensors")
    assert [bool(ax.images) for ax in fig.axes].count(True) == cameras
    assert "3 road users; 4 detections\n" in fig.texts[1].get_text()
    keys = [text.get_text() for ax in fig.axes if ax.get_legend() for text in ax.get_legend().texts]
    assert ("LiDAR point" in keys) == points
    assert ("direction of a camera" in keys) == cameras
    if points:
        cloud = plan_of(fig).collections[0].get_offsets()
        assert sorted(np.asarray(cloud).tolist()) == [[-5, 1], [3, 4]]


def test_nothing_found_nothing_there_and_padding():
    none = Detections(*(part[:0] for part in detections()))
    assert panel_rows(draw(batch(), 0, none, "nothing found"))["car"] == ["0", "2", "0"]
    empty = batch()
    empty.targets.mask[0] = False, True, False
    truth = truth_of(empty.targets, 0)
    np.testing.assert_array_equal(truth.boxes, USERS[1:2])
    assert (truth.kind.tolist(), truth.score.tolist()) == ([0], [1])
    assert [part.dtype for part in truth] == [np.float32, np.int32, np.float32]
    empty.targets.mask[:] = False
    fig = draw(empty, 0, none, "nothing there")
    fig.draw_without_rendering()
    words = "0 road users; 0 detections\nwithin 2 m: 0 found, 0 missed, 0 false"
    assert words in fig.texts[1].get_text()
    with pytest.raises(InspeError, match="frame 1 of the batch is padding"):
        draw(batch(), 1, detections(), "padding")
