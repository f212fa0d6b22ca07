"""Evaluates the detections of many frames by nuScenes' measures."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from inspe_jax.core.errors import InspeError
from inspe_jax.core.words import counted
from inspe_jax.perception.detections import Detections, check
from inspe_jax.perception.evaluation.matching import Places, by_score, match
from inspe_jax.perception.evaluation.metrics import (
    DISTANCES,
    ERROR_DISTANCE,
    ERRORS,
    RECALLS,
    Evaluation,
    average_precision,
    curve,
    differences,
    mean_errors,
)
from inspe_jax.simulation.frame import KINDS


class Boxes(NamedTuple):
    """The boxes of all frames, one after the other, in double precision as in nuScenes' code."""

    frame: Int[np.ndarray, " N"]
    boxes: Float[np.ndarray, "N 9"]
    kind: Int[np.ndarray, " N"]
    score: Float[np.ndarray, " N"]


def evaluate(detections: Sequence[Detections], truth: Sequence[Detections]) -> Evaluation:
    """The measures of ``detections`` against ``truth``, which both have a record for each frame.

    The scores of ``truth`` mean nothing. All measures are those of ``nuscenes-devkit``, also the
    order of equal scores: of these, the later frame and in it the later box comes first. The caller
    leaves out boxes that are not to count.

    Raises InspeError if the numbers of frames differ, boxes or scores are not finite numbers, a
    size is not above 0, a score is not from 0 to 1, a kind is not known, or there is no road user
    in any frame.
    """
    if len(detections) != len(truth):
        raise InspeError(
            f"detections of {counted(len(detections), 'frame')}, but ground truth of "
            f"{len(truth):,}: give one of each for every frame, empty if there is none"
        )
    found, users = _joined(detections, "detections"), _joined(truth, "truth")
    if not len(users.kind):
        raise InspeError(
            f"truth: no {' or '.join(KINDS)} in {counted(len(truth), 'frame')}: there is nothing "
            "to find; use other frames"
        )
    shape = len(KINDS), len(DISTANCES)
    result = Evaluation(
        frames=len(truth),
        ap=np.full(shape, np.nan),
        errors=np.full((len(KINDS), len(ERRORS)), np.nan),
        users=np.bincount(users.kind, minlength=len(KINDS)),
        detections=np.bincount(found.kind, minlength=len(KINDS)),
        matched=np.zeros(shape, int),
        precision=np.zeros((*shape, RECALLS)),
        score=np.zeros((*shape, RECALLS)),
    )
    for k in np.flatnonzero(result.users).tolist():
        _fill(result, k, *(Boxes(*(part[of.kind == k] for part in of)) for of in (found, users)))
    return result


def _fill(result: Evaluation, k: int, found: Boxes, users: Boxes) -> None:
    """Write the measures of one class."""
    found = Boxes(*(part[by_score(found.score)] for part in found))
    places = [Places(of.frame, of.boxes[:, :2]) for of in (found, users)]
    taken, away = match(places[0], places[1], DISTANCES)
    for d, distance in enumerate(DISTANCES):
        true = taken[d] >= 0
        on = curve(true, found.score, len(users.kind))
        result.matched[k, d] = true.sum()
        result.precision[k, d], result.score[k, d] = on.precision, on.score
        result.ap[k, d] = average_precision(on.precision)
        if distance == ERROR_DISTANCE:
            each = differences(found.boxes[true], users.boxes[taken[d, true]], away[d, true])
            result.errors[k] = mean_errors(each, found.score[true], on)


def _joined(frames: Sequence[Detections], what: str) -> Boxes:
    """All frames as one. Raises InspeError if a value is not allowed."""
    for t, frame in enumerate(frames):
        check(frame, f"{what}: frame {t}")
    empty = Detections(np.zeros((0, 9)), np.zeros(0, int), np.zeros(0))
    counts = [len(frame.kind) for frame in frames]
    parts = (np.concatenate(part) for part in zip(empty, *frames, strict=True))
    return Boxes(np.repeat(np.arange(len(frames)), counts), *parts)
