"""Boxes that a detector finds in a frame, and the ground truth in the same form."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int32

from inspe_jax.core.errors import InspeError
from inspe_jax.dataset.loading.batch import Targets
from inspe_jax.simulation.frame import KINDS


class Detections(NamedTuple):
    """The N boxes of one frame, without padding.

    ``boxes`` are as in :class:`~inspe_jax.dataset.loading.batch.Targets`: x, y, z of the middle,
    length, width, height [m], yaw [rad], and velocity in x and y [m/s], in the frame of the
    intersection. A detector that does not estimate velocity gives 0 for it. ``kind`` is the index
    in :data:`~inspe_jax.simulation.frame.KINDS`, and ``score`` is from 0 to 1: how sure the
    detector is.
    """

    boxes: Float32[np.ndarray, "N 9"]
    kind: Int32[np.ndarray, " N"]
    score: Float32[np.ndarray, " N"]


def check(detections: Detections, where: str) -> None:
    """Raise InspeError, which begins with ``where``, if a box is not finite, a size is not above 0,
    a score is not from 0 to 1, a kind is not known, or numbers of boxes differ."""
    boxes, kind, score = (np.asarray(part) for part in detections)
    if boxes.shape != (len(kind), 9) or kind.shape != score.shape or kind.ndim != 1:
        raise InspeError(
            f"{where}: boxes, kind and score have the shapes {boxes.shape}, {kind.shape} and "
            f"{score.shape}: (N, 9), (N,) and (N,) are needed"
        )
    fine = np.isfinite(boxes).all(1) & (boxes[:, 3:6] > 0).all(1)
    fine &= (score >= 0) & (score <= 1) & np.isin(kind, range(len(KINDS)))
    if not fine.all():
        n = int(np.argmin(fine))
        raise InspeError(
            f"{where}: box {n}: {boxes[n].tolist()} of kind {kind[n]} and score {score[n]:g}: "
            f"numbers must be finite, sizes above 0, scores from 0 to 1, and kinds from 0 to "
            f"{len(KINDS) - 1}"
        )


def truth_of(targets: Targets, b: int) -> Detections:
    """The road users of frame b of a batch as detections with score 1.

    All of them, also those that no sensor saw, so that placements are compared on the same truth.
    nuScenes leaves out those without a return.
    """
    kept = np.array(targets.mask[b], bool)
    boxes = np.asarray(targets.boxes[b], np.float32)[kept]
    kind = np.asarray(targets.kind[b], np.int32)[kept]
    return Detections(boxes, kind, np.ones(len(boxes), np.float32))


def within(detections: Detections, half: float) -> Detections:
    """The boxes whose middle is at most ``half`` [m] from the origin along x and along y.

    This is the region that :class:`~inspe_jax.dataset.loading.Loader` keeps boxes in. Detections
    are cut to it too: what is found outside would count as false.
    """
    kept = (np.abs(detections.boxes[:, :2]) <= half).all(1)
    return Detections(*(part[kept] for part in detections))
