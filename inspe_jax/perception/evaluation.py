"""Detections, and nuScenes' mean average precision (mAP) of them against ground truth: equations
and constants of its detection challenge (Caesar et al., CVPR 2020, section 3.1), and where the
paper leaves something open, of its ``nuscenes-devkit`` 1.2 with ``detection_cvpr_2019.json``."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32
from rich.table import Table

from inspe_jax.core.errors import InspeError
from inspe_jax.core.tables import table_of
from inspe_jax.core.words import counted
from inspe_jax.dataset.loading.batch import Targets
from inspe_jax.simulation.frame import KINDS

DISTANCES = (0.5, 1.0, 2.0, 4.0)
"""Detections are true if they are nearer in plan than one of these [m]; AP is the mean over all."""
USUAL_DISTANCE = 2.0  # the one of these that figures show [m]
RECALLS = 101  # precision is interpolated at this many recalls from 0 to 1
LEAST_RECALL = LEAST_PRECISION = 0.1
"""Recalls up to this, and precision below it, do not count: noise has a part in them."""


class Detections(NamedTuple):
    """The N boxes of one frame, without padding: ``boxes`` as in
    :class:`~inspe_jax.dataset.loading.batch.Targets`, with velocity 0 if it is not estimated;
    ``kind`` is the index in KINDS, ``score`` 0 to 1."""

    boxes: Float32[np.ndarray, "N 9"]
    kind: Int32[np.ndarray, " N"]
    score: Float32[np.ndarray, " N"]


Frames = Sequence[Detections]


def check(detections: Detections, where: str) -> None:
    """Raise InspeError, which begins with ``where``, if a value or a shape is not valid."""
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


def truth_of(targets: Targets, b: int, sensors: Sequence[str] = ()) -> Detections:
    """Frame b's road users as detections with score 1: all, or those that ``sensors`` see."""
    kept = np.array(targets.mask[b], bool)
    if sensors:
        kept &= targets.seen_by(sensors)[b]
    boxes = np.asarray(targets.boxes[b], np.float32)[kept]
    kind = np.asarray(targets.kind[b], np.int32)[kept]
    return Detections(boxes, kind, np.ones(len(boxes), np.float32))


def within(detections: Detections, half: float) -> Detections:
    """The boxes whose middle is at most ``half`` [m] from the origin along x and along y."""
    kept = (np.abs(detections.boxes[:, :2]) <= half).all(1)
    return Detections(*(part[kept] for part in detections))


class NoTruth(InspeError):
    """Frames without a road user: there is nothing to find, and no mAP."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """AP of K classes at D :data:`DISTANCES`; NaN, and in no mean, of classes without road users.
    ``seen`` takes those alone as truth that the detector's sensors see."""

    frames: int
    ap: Float[np.ndarray, "K D"]
    users: Int[np.ndarray, " K"]
    seen: "Evaluation | None" = None

    @property
    def present(self) -> Bool[np.ndarray, " K"]:
        """Which classes the truth has road users of."""
        return self.users > 0

    @property
    def class_ap(self) -> Float[np.ndarray, " K"]:
        """AP of each class: the mean over distances."""
        return np.mean(self.ap, 1)

    @property
    def mean_ap(self) -> float:
        """MAP: the mean of ``class_ap`` over the classes that are present."""
        return float(np.mean(self.class_ap[self.present]))

    def rows(self) -> list[dict[str, Any]]:
        """A row for each class and one for all, for CSV; AP of a class without truth is empty."""
        counts = [*self.users, self.users.sum()]
        means = [*np.column_stack([self.ap, self.class_ap])]
        means.append(np.array([*np.mean(self.ap[self.present], 0), self.mean_ap]))
        names = [*(f"ap_{distance:g}m" for distance in DISTANCES), "ap"]
        seen = self.seen.rows() if self.seen else []
        more = [dict(seen=own["road_users"], ap_seen=own["ap"]) for own in seen] or [{}] * len(
            counts
        )
        return [
            {"class": kind, "road_users": int(count)}
            | {name: "" if np.isnan(x) else float(x) for name, x in zip(names, ap, strict=True)}
            | rest
            for kind, count, ap, rest in zip([*KINDS, "all"], counts, means, more, strict=True)
        ]


def evaluate(detections: Frames, truth: Frames, seen: Frames | None = None) -> Evaluation:
    """The measures of ``detections`` against ``truth``, a record a frame each; with ``seen``, also
    against this part of the truth alone: a find of the rest is then false. Of equal scores, the
    later frame and in it the later box comes first, as in nuScenes' code. Raises InspeError for
    invalid input, and :class:`NoTruth`."""
    if len(detections) != len(truth):
        raise InspeError(
            f"detections of {counted(len(detections), 'frame')}, but ground truth of "
            f"{len(truth):,}: give one of each for every frame, empty if there is none"
        )
    for frames, what in ((detections, "detections"), (truth, "truth")):
        for t, frame in enumerate(frames):
            check(frame, f"{what}: frame {t}")
    kinds = np.concatenate([np.zeros(0, int), *(frame.kind for frame in truth)])
    users = np.bincount(kinds, minlength=len(KINDS))
    if not users.any():
        raise NoTruth(
            f"truth: no {' or '.join(KINDS)} in {counted(len(truth), 'frame')}: there is nothing "
            "to find; use other frames"
        )
    kind, score = (
        np.concatenate([getattr(frame, name) for frame in detections]) for name in ("kind", "score")
    )
    pairs = list(zip(detections, truth, strict=True))
    taken = [[matched(*pair, distance) for pair in pairs] for distance in DISTANCES]
    true = np.array([np.concatenate(frames) >= 0 for frames in taken])
    ap = np.full((len(KINDS), len(DISTANCES)), np.nan)
    for k in np.flatnonzero(users):
        own = np.flatnonzero(kind == k)
        own = own[_by_score(score[own])]
        ap[k] = [average_precision(row[own], users[k]) for row in true]
    found = Evaluation(len(truth), ap, users)
    if seen is None or not any(len(frame.kind) for frame in seen):
        return found
    return replace(found, seen=evaluate(detections, seen))


def average_precision(true: Bool[np.ndarray, " N"], users: int) -> float:
    """AP of N detections by falling score: the mean of max(0, precision − 0.1) / 0.9 over the
    recalls above 0.1, with precision interpolated between those reached, and 0 beyond them."""
    if not true.any():
        return 0.0
    hits = np.cumsum(true).astype(float)
    recall = np.linspace(0, 1, RECALLS)
    precision = np.interp(recall, hits / users, hits / np.arange(1, len(true) + 1), right=0)
    above = np.maximum(precision[round(100 * LEAST_RECALL) + 1 :] - LEAST_PRECISION, 0)
    return float(np.mean(above)) / (1 - LEAST_PRECISION)


def matched(
    detections: Detections, truth: Detections, distance: float = USUAL_DISTANCE
) -> Int[np.ndarray, " N"]:
    """The road user in ``truth`` that each detection takes, or −1. By falling score, each takes the
    nearest of its class that is free and nearer in plan than ``distance`` [m]."""
    found = np.full(len(detections.kind), -1)
    for kind in np.unique(detections.kind):
        own, users = (np.flatnonzero(of.kind == kind) for of in (detections, truth))
        own = own[_by_score(detections.score[own])]
        off = detections.boxes[own, None, :2].astype(float) - truth.boxes[None, users, :2]
        away = np.sqrt(off[..., 0] ** 2 + off[..., 1] ** 2)
        rows, columns = np.nonzero(away < distance)
        order = np.lexsort((away[rows, columns], rows))  # stable: of equal ones, the first user
        taken: set[int] = set()
        for n, user in zip(own[rows[order]].tolist(), users[columns[order]].tolist(), strict=True):
            if found[n] < 0 and user not in taken:
                found[n] = user
                taken.add(user)
    return found


def _by_score(score: Float[np.ndarray, " N"]) -> Int[np.ndarray, " N"]:
    """Indices by falling score. Of equal scores, the last comes first, as in nuScenes' code."""
    return np.argsort(score, kind="stable")[::-1]


def evaluation_table(found: Evaluation, note: str = "") -> Table:
    """AP by class and distance; ``note`` ends the title."""
    title = f"mAP {found.mean_ap:.1%} of {found.frames:,} frames{note}"
    more = ("seen", "AP of seen") if found.seen else ()
    table = table_of(title, "class", "users", *(f"{each:g} m" for each in DISTANCES), "AP", *more)
    for row in found.rows():
        kind, *values = row.values()
        cells = ("–" if x == "" else f"{x:,}" if isinstance(x, int) else f"{x:.1%}" for x in values)
        table.add_row(kind, *cells)
    return table


def detections_table(found: Detections, least_score: float, note: str = "") -> Table:
    """The detections of a frame with at least a score, highest first; ``note`` ends the title."""
    heads = "class", "score", "x, y [m]", "length × width × height [m]"
    table = table_of(f"Detections{note}", *heads)
    for n in (-found.score).argsort(kind="stable"):
        if found.score[n] >= least_score:
            x, y, _, *size = found.boxes[n][:6]
            sides = " × ".join(f"{side:.1f}" for side in size)
            table.add_row(KINDS[found.kind[n]], f"{found.score[n]:.2f}", f"{x:.1f}, {y:.1f}", sides)
    return table
