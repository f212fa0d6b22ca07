"""Which detection is of which road user, by nuScenes' rule.

Detections of one class choose by falling score: each takes the nearest road user of its class in
its frame that is not taken yet, if it is nearer in plan than a distance. nuScenes writes this as a
loop over all detections. Here it is a list of the pairs that are near enough, in the order in which
the loop would look at them: by detection, and then by distance. The loop takes a pair exactly if
neither its detection nor its road user was in an earlier pair that it took. Pairs that come first
both for their detection and for their road user do not depend on each other, so all of them are
taken at once, and the rest is gone through in further rounds.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from inspe_jax.perception.detections import Detections
from inspe_jax.perception.evaluation.metrics import ERROR_DISTANCE

PAIRS = 2**20
"""Pairs whose distances are computed at once: some tens of megabytes."""


class Places(NamedTuple):
    """Where boxes of one class are: the index of the frame, and x and y of the middle [m]."""

    frame: Int[np.ndarray, " N"]
    xy: Float[np.ndarray, "N 2"]


def by_score(score: Float[np.ndarray, " N"]) -> Int[np.ndarray, " N"]:
    """Indices by falling score. Of equal scores, the last comes first, as in nuScenes' code."""
    return np.argsort(score, kind="stable")[::-1]


def match(
    found: Places, truth: Places, distances: Sequence[float]
) -> tuple[Int[np.ndarray, "D N"], Float[np.ndarray, "D N"]]:
    """The road user that each of N detections takes at each of D ``distances`` [m], and how far
    away it is [m]; −1 and infinite if it takes none.

    Detections are in the order in which they choose, and road users are sorted by frame. Of road
    users at the same distance, the first is taken.
    """
    detection, user, away = _near(found, truth, max(distances))
    taken = np.full((len(distances), len(found.frame)), -1)
    far = np.full(taken.shape, np.inf)
    for d, distance in enumerate(distances):
        own = np.flatnonzero(away < distance)
        sizes = len(found.frame), len(truth.frame)
        chosen = own[_first_come(detection[own], user[own], *sizes)]
        taken[d, detection[chosen]] = user[chosen]
        far[d, detection[chosen]] = away[chosen]
    return taken, far


def matched(
    detections: Detections, truth: Detections, distance: float = ERROR_DISTANCE
) -> Int[np.ndarray, " N"]:
    """The index of the road user in ``truth`` that each detection of one frame takes, at a
    ``distance`` [m]; −1 if none."""
    found = np.full(len(detections.kind), -1)
    for kind in np.unique(detections.kind):
        rows = np.flatnonzero(detections.kind == kind)
        rows = rows[by_score(detections.score[rows])]
        users = np.flatnonzero(truth.kind == kind)
        places = [
            Places(np.zeros(len(own), int), np.asarray(boxes[own, :2], float))
            for own, boxes in ((rows, detections.boxes), (users, truth.boxes))
        ]
        taken = match(places[0], places[1], (distance,))[0][0]
        found[rows[taken >= 0]] = users[taken[taken >= 0]]
    return found


def _near(
    found: Places, truth: Places, most: float
) -> tuple[Int[np.ndarray, " P"], Int[np.ndarray, " P"], Float[np.ndarray, " P"]]:
    """Pairs of one frame nearer than ``most`` [m]: detection, road user, and distance; by detection
    and then by distance."""
    first = np.searchsorted(truth.frame, found.frame, "left")
    count = np.searchsorted(truth.frame, found.frame, "right") - first
    block = (np.cumsum(count) - count) // PAIRS  # by the pairs of earlier detections
    parts = []
    for own in np.split(np.arange(len(count)), np.flatnonzero(np.diff(block)) + 1):
        detection = np.repeat(own, count[own])
        begin = np.cumsum(count[own]) - count[own]
        user = np.arange(len(detection)) + np.repeat(first[own] - begin, count[own])
        x, y = (found.xy[detection] - truth.xy[user]).T
        away = np.sqrt(x * x + y * y)
        near = away < most
        detection, user, away = detection[near], user[near], away[near]
        order = np.lexsort((away, detection))  # stable: of equal distances, the first road user
        parts.append((detection[order], user[order], away[order]))
    detection, user, away = (np.concatenate(part) for part in zip(*parts, strict=True))
    return detection, user, away


def _first_come(
    detection: Int[np.ndarray, " P"], user: Int[np.ndarray, " P"], detections: int, users: int
) -> Int[np.ndarray, " M"]:
    """Indices of the pairs that are taken, of pairs in the order in which they are looked at.

    ``detections`` and ``users`` are how many there are. Each round takes a pair in every frame that
    has any left, so there are at most as many as a frame has boxes, and usually a few.
    """
    chosen = [np.zeros(0, int)]
    left = np.arange(len(detection))
    while len(left):
        of, to = detection[left], user[left]
        rank = np.arange(len(left))
        first = np.full(users, len(left))
        np.minimum.at(first, to, rank)
        take = first[to] == rank
        take[1:] &= of[1:] != of[:-1]
        chosen.append(left[take])
        busy, taken = np.zeros(detections, bool), np.zeros(users, bool)
        busy[of[take]] = taken[to[take]] = True
        left = left[~(busy[of] | taken[to])]
    return np.concatenate(chosen)
