"""nuScenes' measures of matched detections of one class, and the record of all of them.

Equations and constants are those of nuScenes' detection challenge (Caesar et al., "nuScenes: A
Multimodal Dataset for Autonomous Driving", CVPR 2020, section 3.1), and, where the paper leaves
something open, those of its ``nuscenes-devkit`` 1.2 with ``detection_cvpr_2019.json``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from inspe_jax.simulation.frame import KINDS

DISTANCES = (0.5, 1.0, 2.0, 4.0)
"""Detections are true if they are nearer in plan than one of these [m]; AP is the mean over all."""

ERROR_DISTANCE = 2.0
"""The distance of these at which errors are measured [m]."""

ERRORS = ("translation", "scale", "orientation", "velocity")
"""Mean errors of true detections: distance in plan [m]; 1 − intersection over union of the boxes,
moved and turned onto each other; smallest difference of yaw [rad]; and of velocity [m/s]. The fifth
of nuScenes, of attributes such as "parked", is left out: road users here have no attributes."""

RECALLS = 101
"""Precision is interpolated at this many recalls from 0 to 1."""

LEAST_RECALL = LEAST_PRECISION = 0.1
"""Recalls up to this, and precision below it, do not count: noise has a part in them."""

AP_WEIGHT = 5
"""Weight of mAP in NDS; each error has 1."""

_COUNTED = slice(round(100 * LEAST_RECALL) + 1, None)


class Curve(NamedTuple):
    """Precision over recall, from 0 to 1, and the least score that reaches each recall; precision
    and score are 0 where it is not reached."""

    recall: Float[np.ndarray, "101"]
    precision: Float[np.ndarray, "101"]
    score: Float[np.ndarray, "101"]


def curve(true: Bool[np.ndarray, " N"], score: Float[np.ndarray, " N"], users: int) -> Curve:
    """The curve of N detections by falling score, of which some are ``true``, of ``users`` road
    users. It is 0 if none is true."""
    recall = np.linspace(0, 1, RECALLS)
    if not true.any():
        return Curve(recall, np.zeros(RECALLS), np.zeros(RECALLS))
    hits = np.cumsum(true).astype(float)
    reached = hits / users
    precision = np.interp(recall, reached, hits / np.arange(1, len(true) + 1), right=0)
    return Curve(recall, precision, np.interp(recall, reached, score, right=0))


def average_precision(precision: Float[np.ndarray, "101"]) -> float:
    """Mean of max(0, precision − 0.1) / 0.9 over the recalls above 0.1."""
    above = np.maximum(precision[_COUNTED] - LEAST_PRECISION, 0)
    return float(np.mean(above)) / (1 - LEAST_PRECISION)


def differences(
    found: Float[np.ndarray, "N 9"], truth: Float[np.ndarray, "N 9"], away: Float[np.ndarray, " N"]
) -> Float[np.ndarray, "E N"]:
    """What differs between N detections and their road users, as :data:`ERRORS`; ``away`` is the
    first of these."""
    size, own = found[:, 3:6], truth[:, 3:6]
    both = np.prod(np.minimum(size, own), 1)
    scale = 1 - both / (np.prod(own, 1) + np.prod(size, 1) - both)
    turn = np.abs((truth[:, 6] - found[:, 6] + np.pi) % (2 * np.pi) - np.pi)
    x, y = (found[:, 7:9] - truth[:, 7:9]).T
    return np.stack([away, scale, turn, np.sqrt(x * x + y * y)])


def mean_errors(
    each: Float[np.ndarray, "E M"], score: Float[np.ndarray, " M"], on: Curve
) -> Float[np.ndarray, " E"]:
    """Mean errors over the recalls above 0.1 that are reached, of M true detections by falling
    score.

    The error at a recall is the mean over all true detections of at least its score. An error is 1
    if no recall above 0.1 is reached, in whatever unit: nuScenes' worst value. As in the devkit, a
    recall that takes detections with score 0 is not reached.
    """
    reached = np.flatnonzero(on.score)
    last = reached[-1] if len(reached) else 0
    if last < _COUNTED.start:
        return np.ones(len(each))
    running = np.cumsum(each, 1) / np.arange(1, each.shape[1] + 1)
    found = [np.interp(on.score[::-1], score[::-1], row[::-1])[::-1] for row in running]
    return np.array([np.mean(row[_COUNTED.start : last + 1]) for row in found])


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The measures of the K classes of
    :data:`~inspe_jax.simulation.frame.KINDS` at the D :data:`DISTANCES`, and the E :data:`ERRORS`.

    ``ap`` and ``errors`` are NaN for classes that the truth has no road user of. ``users``,
    ``detections`` and ``matched`` are counts: road users, detections, and those of them that are
    true at each distance. ``precision`` and ``score`` are those of each :class:`Curve`.

    Classes without truth are left out of all means, so that these do not depend on which classes
    happen to be in the frames. The devkit counts them, with AP 0 and errors 1; nuScenes' own splits
    have all classes. Detections of such a class count nowhere, neither here nor in the devkit.
    """

    frames: int
    ap: Float[np.ndarray, "K D"]
    errors: Float[np.ndarray, "K E"]
    users: Int[np.ndarray, " K"]
    detections: Int[np.ndarray, " K"]
    matched: Int[np.ndarray, "K D"]
    precision: Float[np.ndarray, "K D 101"] = field(repr=False)
    score: Float[np.ndarray, "K D 101"] = field(repr=False)

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

    @property
    def mean_errors(self) -> Float[np.ndarray, " E"]:
        """The mean of each error over the classes that are present."""
        return np.mean(self.errors[self.present], 0)

    @property
    def nds_without_attributes(self) -> float:
        """(5 mAP + Σ max(0, 1 − error)) / 9, over the four mean errors.

        nuScenes' detection score (NDS) has a fifth error, of attributes, and divides by 10: this is
        not comparable with nuScenes' leader board.
        """
        scores = np.maximum(0, 1 - self.mean_errors)
        return float(AP_WEIGHT * self.mean_ap + np.sum(scores)) / (AP_WEIGHT + len(ERRORS))

    def rows(self) -> list[Mapping[str, Any]]:
        """A row for each class and one for all, for CSV. Empty: measures of a class without truth,
        and the score that only the last row has."""
        counts = self.users, self.detections, self.matched
        measures = self.ap, self.class_ap, self.errors
        rows = [
            _row(kind, [part[k] for part in counts], [part[k] for part in measures])
            for k, kind in enumerate(KINDS)
        ]
        means = [np.mean(self.ap[self.present], 0), self.mean_ap, self.mean_errors]
        totals = [np.sum(part, 0) for part in counts]
        return [*rows, _row("all", totals, means, self.nds_without_attributes)]


def _row(
    kind: str, counts: Sequence[Any], measures: Sequence[Any], nds: float = np.nan
) -> dict[str, Any]:
    """A row of the counts and measures of a class, in the order of the record."""
    (users, detections, matched), (ap, mean, errors) = counts, measures
    numbers = {
        **{f"ap_{distance:g}m": value for distance, value in zip(DISTANCES, ap, strict=True)},
        "ap": mean,
        **{f"{name}_error": value for name, value in zip(ERRORS, errors, strict=True)},
        "nds_without_attributes": nds,
    }
    return {
        "class": kind,
        "road_users": int(users),
        "detections": int(detections),
        **{f"matched_{d:g}m": int(n) for d, n in zip(DISTANCES, matched, strict=True)},
        **{key: "" if np.isnan(value) else float(value) for key, value in numbers.items()},
    }
