"""nuScenes' measures: against its own code, by hand, against a plain loop, and what must hold."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import csv_text
from inspe_jax.perception.detections import Detections
from inspe_jax.perception.evaluation import DISTANCES, evaluate, matched, matching
from inspe_jax.perception.evaluation.matching import Places, match
from inspe_jax.simulation.frame import KINDS

REFERENCE = Path(__file__).parent / "data" / "nuscenes_reference.npz"
"""Made by ``make_nuscenes_reference.py``, which says how."""

CASES = (
    "usual",
    "crowded",
    "poor",
    "equal_scores",
    "on_a_grid",
    "half_a_turn",
    "no_trucks",
    "none_found",
    "empty_frames",
)
CLOSE = dict(rtol=1e-12, atol=1e-12)
"""For errors and what is made of them. The devkit turns yaws into quaternions and back, and takes
lengths of vectors by BLAS, which rounds otherwise on some processors: each is off by 1e-15."""


@pytest.fixture(scope="module")
def reference():
    """By case: what the devkit says, and the frames as it was given them."""
    with np.load(REFERENCE) as file:
        content = {key: file[key] for key in file.files}
    cases = {}
    for key, value in content.items():
        case, name = key.split("/")
        cases.setdefault(case, {})[name] = value
    return {name: SimpleNamespace(**case) for name, case in cases.items()}


def frames_of(case) -> tuple[list[Detections], list[Detections]]:
    """The detections and the truth of each frame of a case."""
    count = 1 + max(case.frame.max(), case.truth_frame.max())
    found, truth = [], []
    for t in range(count):
        own, users = case.frame == t, case.truth_frame == t
        found.append(Detections(case.boxes[own], case.kind[own], case.score[own]))
        ones = np.ones(users.sum(), np.float32)
        truth.append(Detections(case.truth_boxes[users], case.truth_kind[users], ones))
    return found, truth


def boxes_at(*places, kind=0, score=1.0, size=(4, 2, 1.5), yaw=0.0, velocity=(0, 0)) -> Detections:
    """Boxes of one frame at places (x, y)."""
    boxes = np.zeros((len(places), 9), np.float32)
    boxes[:, :2] = np.reshape(places, (-1, 2))
    boxes[:, 3:6], boxes[:, 6], boxes[:, 7:] = size, yaw, velocity
    kinds = np.full(len(places), kind, np.int32)
    return Detections(boxes, kinds, np.broadcast_to(np.float32(score), len(places)))


NOTHING = boxes_at()


@pytest.mark.parametrize("name", CASES)
def test_the_devkit_finds_the_same(reference, name):
    """AP, curves and their means to the last digit; errors up to :data:`CLOSE`. The devkit counts
    classes without truth with AP 0, where ours is NaN and counts nowhere."""
    said = reference[name]
    ours = evaluate(*frames_of(said))
    present = ours.present
    assert present.tolist() == [bool((said.truth_kind == k).any()) for k in range(4)]
    np.testing.assert_array_equal(np.nan_to_num(ours.ap), said.ap)
    np.testing.assert_array_equal(np.nan_to_num(ours.class_ap), said.class_ap)
    np.testing.assert_array_equal(ours.precision, said.precision)
    np.testing.assert_array_equal(ours.score, said.confidence)
    np.testing.assert_allclose(np.where(present[:, None], ours.errors, 1), said.errors, **CLOSE)
    assert ours.mean_ap == np.mean(said.class_ap[present])
    if present.all():
        assert ours.mean_ap == said.mean_ap
        np.testing.assert_allclose(ours.mean_errors, said.mean_errors, **CLOSE)
        # Without attributes, the devkit's fifth error is 1: it adds 0, but it divides by 10.
        np.testing.assert_allclose(9 * ours.nds_without_attributes, 10 * said.nds, **CLOSE)


def test_ap_by_hand():
    """Two road users in the first frame and two in the second. By falling score: true, false, true:
    precision 1, 1/2, 2/3 at recalls 1/4, 1/4, 1/2; 0 beyond 1/2, and linear between."""
    truth = [boxes_at((0, 0), (10, 0)), boxes_at((0, 0), (10, 0))]
    found = [
        Detections(
            boxes_at((0.1, 0), (20, 0)).boxes, np.zeros(2, np.int32), np.array([0.9, 0.8], "f4")
        ),
        boxes_at((10, 0.1), score=0.7),
    ]
    ours = evaluate(found, truth)
    recall = np.arange(11, 101) / 100
    precision = np.where(
        recall < 0.25, 1, np.where(recall <= 0.5, 1 / 2 + (recall - 0.25) / 0.25 / 6, 0)
    )
    by_hand = np.maximum(precision - 0.1, 0).mean() / 0.9
    np.testing.assert_allclose(ours.ap[0], by_hand, rtol=1e-12)
    assert ours.mean_ap == pytest.approx(by_hand)
    assert ours.matched[0].tolist() == [2, 2, 2, 2]
    assert ours.users.tolist() == [4, 0, 0, 0]
    assert ours.detections.tolist() == [3, 0, 0, 0]
    assert ours.frames == 2
    assert np.isnan(ours.ap[1:]).all()


def test_errors_by_hand():
    """One car found: 0.6 and 0.8 m off, twice as long, turned from −175° to 175°, and at 3, 4 m/s
    instead of standing."""
    truth = boxes_at((0, 0), size=(4, 2, 1), yaw=np.radians(-175))
    found = boxes_at((0.6, 0.8), size=(8, 2, 1), yaw=np.radians(175), velocity=(3, 4), score=0.5)
    ours = evaluate([found], [truth])
    np.testing.assert_allclose(ours.errors[0], [1, 0.5, np.radians(10), 5], atol=1e-6)
    assert ours.matched[0].tolist() == [0, 0, 1, 1]  # 1 m is not nearer than 1 m in float32
    expected = (5 * 0.5 + 0 + 0.5 + (1 - np.radians(10)) + 0) / 9
    assert ours.nds_without_attributes == pytest.approx(expected, rel=1e-6)


def test_errors_are_1_where_too_few_are_found():
    """1 of 12 is a recall below 0.1; 1 of 9 reaches 0.11, the first recall that counts."""
    truth = boxes_at(*[(10 * k, 0) for k in range(12)])
    one, nine = (Detections(*(part[:n] for part in truth)) for n in (1, 9))
    assert (evaluate([one], [truth]).errors[0] == 1).all()
    assert (evaluate([one], [nine]).errors[0] == 0).all()
    assert evaluate([NOTHING], [truth]).mean_ap == 0


def test_of_equal_scores_the_last_comes_first():
    """The false detection before or after the true one, in a frame and over frames. If it comes
    after, precision is 1, and 1/2 at the recall 1 alone."""
    true, false = (0, 0), (50, 0)
    truth = boxes_at(true)
    last, first = boxes_at(false, true), boxes_at(true, false)
    good = (89 * 0.9 + 0.4) / 90 / 0.9
    assert evaluate([last], [truth]).mean_ap == pytest.approx(good)
    assert evaluate([first], [truth]).mean_ap < 0.5
    frames = [boxes_at(false), boxes_at(true)], [NOTHING, truth]
    assert evaluate(*frames).mean_ap == pytest.approx(good)
    assert evaluate(*(of[::-1] for of in frames)).mean_ap < 0.5


def test_a_detection_does_not_take_what_is_far_or_of_another_class_or_frame():
    truth = boxes_at((0, 0))
    for found in (boxes_at((0, 4)), boxes_at((0, 0), kind=1)):
        assert evaluate([found], [truth]).matched.sum() == 0
    assert evaluate([NOTHING, truth], [truth, NOTHING]).matched.sum() == 0
    assert evaluate([boxes_at((0, 3.999))], [truth]).matched[0].tolist() == [0, 0, 0, 1]


def loop(found: Places, truth: Places, distance: float) -> list[int]:
    """What nuScenes' rule says, one detection after the other."""
    taken: list[int] = []
    for frame, xy in zip(*found, strict=True):
        nearest, least = -1, distance
        for n, (other, there) in enumerate(zip(*truth, strict=True)):
            away = np.sqrt(((xy - there) ** 2).sum())
            if frame == other and n not in taken and away < least:
                nearest, least = n, away
        taken.append(nearest)
    return taken


places = st.tuples(st.integers(0, 2), st.integers(0, 8), st.integers(0, 3))


@settings(max_examples=150, deadline=None)
@given(st.lists(places, max_size=14), st.lists(places, max_size=10), st.sampled_from([1, 7, 2**20]))
def test_rounds_take_what_a_loop_takes(found, truth, pairs):
    """On a grid of half metres, so that many distances are equal; in blocks of any size."""
    found, truth = (
        Places(
            np.array([f for f, _, _ in of], int), np.array([p for _, *p in of]).reshape(-1, 2) / 2
        )
        for of in (found, sorted(truth))
    )
    before, matching.PAIRS = matching.PAIRS, pairs
    try:
        taken, away = match(found, truth, DISTANCES)
    finally:
        matching.PAIRS = before
    for d, distance in enumerate(DISTANCES):
        assert taken[d].tolist() == loop(found, truth, distance)
    has = taken >= 0
    assert np.isinf(away[~has]).all()
    assert (away[has] < np.broadcast_to(np.array(DISTANCES)[:, None], has.shape)[has]).all()


@st.composite
def scenes(draw, distinct=False):
    """Frames of road users, and detections of which many are near them."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    frames = draw(st.integers(1, 5))
    found, truth = [], []
    for _ in range(frames):
        count, more = rng.integers(0, 12), rng.integers(0, 6)
        boxes = np.zeros((count + more, 9), np.float32)
        boxes[:, :2] = rng.uniform(-15, 15, (count + more, 2))
        boxes[:, 3:6] = rng.uniform(0.5, 9, (count + more, 3))
        boxes[:, 6:] = rng.uniform(-3, 3, (count + more, 3))
        kind = rng.integers(0, len(KINDS), count + more).astype(np.int32)
        truth.append(Detections(boxes[:count], kind[:count], np.ones(count, np.float32)))
        seen = boxes.copy()
        seen[:, :2] += rng.normal(0, rng.uniform(0, 2), (count + more, 2))
        order = rng.permutation(count + more)
        found.append(Detections(seen[order], kind[order], np.zeros(count + more, np.float32)))
    truth.append(boxes_at((0, 0)))  # there is always something to find
    found.append(NOTHING)
    total = sum(len(of.kind) for of in found)
    scores = rng.permutation(total) / total if distinct else rng.integers(0, 5, total) / 4
    ends = np.cumsum([len(of.kind) for of in found])[:-1]
    parts = np.split(scores.astype(np.float32), ends)
    return [of._replace(score=own) for of, own in zip(found, parts, strict=True)], truth


def assert_same(a, b) -> None:
    for name in ("ap", "errors", "matched", "precision", "score", "users", "detections"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


@settings(max_examples=40, deadline=None)
@given(scenes(distinct=True), st.randoms(use_true_random=False))
def test_the_order_of_frames_and_boxes_does_not_matter(scene, random):
    """With distinct scores, and distances of which no two are equal."""
    found, truth = scene
    order = list(range(len(found)))
    random.shuffle(order)

    def shuffled(frame):
        boxes = list(range(len(frame.kind)))
        random.shuffle(boxes)
        return Detections(*(part[boxes] for part in frame))

    moved = [[shuffled(of[t]) for t in order] for of in scene]
    assert_same(evaluate(found, truth), evaluate(*moved))


@settings(max_examples=40, deadline=None)
@given(scenes())
def test_perfect_detections_have_ap_1(scene):
    _, truth = scene
    ours = evaluate(truth, truth)
    np.testing.assert_allclose(ours.ap[ours.present], 1, rtol=1e-12)
    assert (ours.matched == ours.users[:, None]).all()
    np.testing.assert_allclose(ours.errors[ours.present], 0, atol=1e-12)
    assert ours.nds_without_attributes == pytest.approx(1, rel=1e-12)


@settings(max_examples=60, deadline=None)
@given(scenes(), st.integers(0, len(KINDS) - 1))
def test_a_false_detection_that_is_most_sure_never_helps(scene, kind):
    found, truth = scene
    wrong = boxes_at((1000, 0), kind=kind, score=1.0)
    before = evaluate(found, truth)
    more = [*found[:-1], Detections(*map(np.concatenate, zip(found[-1], wrong, strict=True)))]
    after = evaluate(more, truth)
    assert (after.ap[after.present] <= before.ap[before.present] + 1e-15).all()
    assert after.matched.tolist() == before.matched.tolist()
    others = np.arange(len(KINDS)) != kind
    np.testing.assert_array_equal(after.ap[others], before.ap[others])


@settings(max_examples=40, deadline=None)
@given(scenes())
def test_a_wider_distance_never_lowers_what_is_matched(scene):
    """More pairs are near enough; AP can still fall, since a detection may take another's."""
    ours = evaluate(*scene)
    assert (np.diff(ours.matched, axis=1) >= 0).all()
    assert (ours.matched <= np.minimum(ours.users, ours.detections)[:, None]).all()
    assert ((ours.ap[ours.present] >= 0) & (ours.ap[ours.present] <= 1 + 1e-12)).all()


def test_matches_of_one_frame():
    """The surer detection takes the nearest car; the other one takes the next, or none."""
    truth = boxes_at((0, 0), (1.5, 0), (9, 9), kind=[0, 0, 3])
    found = Detections(
        boxes_at((0.2, 0), (0.1, 0), (9, 9), (9, 9.5)).boxes,
        np.array([0, 0, 0, 3], np.int32),
        np.array([0.4, 0.8, 0.9, 0.1], np.float32),
    )
    assert matched(found, truth).tolist() == [1, 0, -1, 2]
    assert matched(found, truth, 1.0).tolist() == [-1, 0, -1, 2]
    assert matched(NOTHING, truth).tolist() == []
    assert matched(found, NOTHING).tolist() == [-1] * 4


def test_rows(reference):
    said = reference["no_trucks"]
    ours = evaluate(*frames_of(said))
    rows = ours.rows()
    assert [row["class"] for row in rows] == [*KINDS, "all"]
    assert rows[0]["ap_0.5m"] == said.ap[0, 0]
    assert rows[0]["orientation_error"] == pytest.approx(said.errors[0, 2])
    assert rows[1]["ap"] == rows[1]["velocity_error"] == ""
    assert rows[-1]["ap"] == ours.mean_ap
    assert rows[-1]["road_users"] == len(said.truth_kind)
    assert rows[-1]["matched_2m"] == ours.matched[:, 2].sum()
    assert rows[-1]["nds_without_attributes"] == ours.nds_without_attributes
    assert rows[0]["nds_without_attributes"] == ""
    assert csv_text(rows).count("\n") == 6


CAR = boxes_at((0, 0), (5, 5))


def spoilt(name: str, value, at=1) -> Detections:
    """Two cars, of which a value of the second is another."""
    part = np.array(getattr(CAR, name))
    part[at] = value
    return CAR._replace(**{name: part})


@pytest.mark.parametrize(
    ("found", "truth", "message"),
    [
        ([CAR], [CAR, CAR], "of 1 frame, but ground truth of 2: give one of each for every frame"),
        ([CAR, spoilt("boxes", np.nan)], [CAR, CAR], "detections: frame 1: box 1: box .*nan"),
        ([CAR], [spoilt("boxes", np.inf, (1, 0))], "truth: frame 0: box 1: box .*finite numbers"),
        ([spoilt("boxes", 0, (1, 4))], [CAR], r"size \[4.0, 0.0, 1.5\]: must be above 0"),
        ([spoilt("score", np.nan)], [CAR], "detections: frame 0: box 1: score nan: .* 0 to 1"),
        ([spoilt("score", 1.5)], [CAR], "score 1.5: must be from 0 to 1"),
        ([spoilt("kind", 4)], [CAR], "kind 4: 0 to 3: car, truck, cyclist, pedestrian"),
        ([spoilt("kind", -1)], [CAR], "kind -1: 0 to 3"),
        ([CAR._replace(boxes=CAR.boxes[:, :7])], [CAR], r"frame 0: boxes, .*\(2, 7\)"),
        ([CAR._replace(score=CAR.score[:1])], [CAR], r"shapes \(2, 9\), \(2,\) and \(1,\)"),
        ([CAR], [NOTHING], "truth: no car or truck or cyclist or pedestrian in 1 frame: there is"),
        ([], [], "in 0 frames: there is nothing to find"),
    ],
)
def test_bad_input(found, truth, message):
    with pytest.raises(InspeError, match=message):
        evaluate(found, truth)
