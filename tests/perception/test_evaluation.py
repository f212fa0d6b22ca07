"""nuScenes' measures: against its own code, by hand, against a plain loop, and what must hold."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import csv_text
from inspe_jax.perception.evaluation import DISTANCES, Detections, evaluate, matched, within
from inspe_jax.simulation.frame import KINDS

REFERENCE = Path(__file__).parent / "data" / "nuscenes_reference.npz"
"""Made by ``make_nuscenes_reference.py``, which says how."""

with np.load(REFERENCE) as file:
    CASES = list(dict.fromkeys(key.partition("/")[0] for key in file.files))


@pytest.fixture(scope="module")
def reference():
    with np.load(REFERENCE) as file:
        content = {key: file[key] for key in file.files}
    cases = {}
    for key, value in content.items():
        case, name = key.split("/")
        cases.setdefault(case, {})[name] = value
    return {name: SimpleNamespace(**case) for name, case in cases.items()}


def frames_of(case) -> tuple[list[Detections], list[Detections]]:
    count = 1 + max(case.frame.max(), case.truth_frame.max())
    found, truth = [], []
    for t in range(count):
        own, users = case.frame == t, case.truth_frame == t
        found.append(Detections(case.boxes[own], case.kind[own], case.score[own]))
        ones = np.ones(users.sum(), np.float32)
        truth.append(Detections(case.truth_boxes[users], case.truth_kind[users], ones))
    return found, truth


def boxes_at(*places, kind=0, score=1.0) -> Detections:
    """Standing cars, or boxes of their size, of one frame at places (x, y)."""
    boxes = np.zeros((len(places), 9), np.float32)
    boxes[:, :2] = np.reshape(places, (-1, 2))
    boxes[:, 3:6] = 4, 2, 1.5
    kinds = np.full(len(places), kind, np.int32)
    return Detections(boxes, kinds, np.broadcast_to(np.float32(score), len(places)))


NOTHING = boxes_at()


@pytest.mark.parametrize("name", CASES)
def test_the_devkit_finds_the_same(reference, name):
    """AP and its means to the last digit. The devkit counts classes without truth with AP 0, where
    ours is NaN and counts nowhere."""
    said = reference[name]
    ours = evaluate(*frames_of(said))
    present = ours.present
    assert present.tolist() == [bool((said.truth_kind == k).any()) for k in range(4)]
    np.testing.assert_array_equal(np.nan_to_num(ours.ap), said.ap)
    np.testing.assert_array_equal(np.nan_to_num(ours.class_ap), said.class_ap)
    assert ours.mean_ap == np.mean(said.class_ap[present])
    if present.all():
        assert ours.mean_ap == said.mean_ap


def test_ap_by_hand():
    """Two road users in the first frame and two in the second. By falling score: true, false, true:
    precision 1, 1/2, 2/3 at recalls 1/4, 1/4, 1/2; 0 beyond 1/2, and linear between."""
    truth = [boxes_at((0, 0), (10, 0)), boxes_at((0, 0), (10, 0))]
    first = boxes_at((0.1, 0), (20, 0))._replace(score=np.array([0.9, 0.8], "f4"))
    found = [first, boxes_at((10, 0.1), score=0.7)]
    ours = evaluate(found, truth)
    recall = np.arange(11, 101) / 100
    between = np.where(recall <= 0.5, 1 / 2 + (recall - 0.25) / 0.25 / 6, 0)
    precision = np.where(recall < 0.25, 1, between)
    by_hand = np.maximum(precision - 0.1, 0).mean() / 0.9
    np.testing.assert_allclose(ours.ap[0], by_hand, rtol=1e-12)
    assert ours.mean_ap == pytest.approx(by_hand)
    assert ours.users.tolist() == [4, 0, 0, 0]
    assert ours.frames == 2
    assert np.isnan(ours.ap[1:]).all()


def test_of_road_users_that_are_seen_alone():
    truth, seen = [boxes_at((0, 0), (10, 0))], [boxes_at((0, 0))]
    for found in (seen, [truth[0]._replace(score=np.array([0.5, 0.9], "f4"))]):
        ours, own = evaluate(found, truth, seen), evaluate(found, seen)
        assert (ours.mean_ap, ours.seen.mean_ap) == (evaluate(found, truth).mean_ap, own.mean_ap)
        assert [(row["seen"], row["ap_seen"]) for row in ours.rows()[::4]] == [(1, own.mean_ap)] * 2


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


def loop(found: Detections, truth: Detections, distance: float) -> list[int]:
    """What nuScenes' rule says, one detection after the other."""
    taken = [-1] * len(found.kind)
    for k in sorted(range(len(taken)), key=lambda k: (found.score[k], k), reverse=True):
        nearest, least = -1, distance
        for n in range(len(truth.kind)):
            away = np.sqrt(((found.boxes[k, :2] - truth.boxes[n, :2]) ** 2).sum())
            if found.kind[k] == truth.kind[n] and n not in taken and away < least:
                nearest, least = n, away
        taken[k] = nearest
    return taken


places = st.tuples(st.integers(0, 8), st.integers(0, 3), st.integers(0, 1), st.integers(0, 3))


@settings(max_examples=150, deadline=None)
@given(st.lists(places, max_size=14), st.lists(places, max_size=10))
def test_detections_take_what_a_loop_takes(found, truth):
    """On a grid of half metres, so that many distances and scores are equal."""
    rows = (np.reshape(of, (-1, 4)) for of in (found, truth))
    found, truth = (
        boxes_at(*of[:, :2] / 2)._replace(
            kind=of[:, 2].astype(np.int32), score=of[:, 3].astype(np.float32) / np.float32(3)
        )
        for of in rows
    )
    for distance in DISTANCES:
        assert matched(found, truth, distance).tolist() == loop(found, truth, distance)


def test_a_region_keeps_its_edge():
    users = boxes_at((5, 0), (-20, 20.5), (30, 1))
    for half, kept in ((30, 3), (20.5, 2), (20.4, 1)):
        np.testing.assert_array_equal(within(users, half).boxes, users.boxes[:kept])


def test_rows(reference):
    said = reference["no_trucks"]
    ours = evaluate(*frames_of(said))
    rows = ours.rows()
    assert [row["class"] for row in rows] == [*KINDS, "all"]
    assert rows[0]["ap_0.5m"] == said.ap[0, 0]
    assert rows[1]["ap"] == ""
    assert rows[-1]["ap"] == ours.mean_ap
    assert rows[-1]["road_users"] == len(said.truth_kind)
    assert csv_text(rows).count("\n") == 6


CAR = boxes_at((0, 0), (5, 5))


def spoilt(name: str, value, at=1) -> Detections:
    part = np.array(getattr(CAR, name))
    part[at] = value
    return CAR._replace(**{name: part})


@pytest.mark.parametrize(("found", "truth", "message"), [
    ([CAR], [CAR, CAR], "of 1 frame, but ground truth of 2: give one of each for every frame"),
    ([CAR, spoilt("boxes", np.nan)], [CAR, CAR], "detections: frame 1: box 1: .*nan.* finite"),
    ([spoilt("boxes", 0, (1, 4))], [CAR], r"4.0, 0.0, 1.5, .* sizes above 0"),
    ([spoilt("score", np.nan)], [CAR], "detections: frame 0: box 1: .* score nan: .* 0 to 1"),
    ([spoilt("kind", -1)], [CAR], "of kind -1 .* kinds from 0 to 3"),
    ([CAR._replace(score=CAR.score[:1])], [CAR], r"shapes \(2, 9\), \(2,\) and \(1,\)"),
    ([CAR], [NOTHING], "truth: no car or truck or cyclist or pedestrian in 1 frame: there is"),
    ([], [], "in 0 frames: there is nothing to find"),
])  # fmt: skip
def test_bad_input(found, truth, message):
    with pytest.raises(InspeError, match=message):
        evaluate(found, truth)
