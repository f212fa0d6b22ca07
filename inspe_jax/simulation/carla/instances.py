"""Finds the road user that each pixel of CARLA's instance pictures shows.

An instance picture gives each pixel a number of the Unreal engine. CARLA does not say which number
an actor has, so numbers are matched by place. The pixels of a number show points in the world, and
the number belongs to the road user whose box holds most of them. If no box holds any, it belongs to
no road user. Limit: a number has 16 bits only, so two road users may share one. All its pixels then
go to the one whose box holds more of them.
"""

import numpy as np
from jaxtyping import Float, Int

from inspe_jax.core.geometry import rotation
from inspe_jax.simulation.frame import RoadUserBox

ROAD_USER_LABELS = (12, 13, 14, 15, 16, 18, 19)
"""CARLA's semantic labels (0.9.14 and later) of pedestrians, riders, cars, trucks, buses,
motorcycles and bicycles."""
MARGIN = 0.3
"""Mirrors and limbs may reach this far out of a box [m]."""
MOST_SAMPLES = 200
"""At most about this many pixels of a number are matched."""


def instances_of(
    tags: Int[np.ndarray, "H W"],
    numbers: Int[np.ndarray, "H W"],
    depth: Float[np.ndarray, "H W"],
    pose: Float[np.ndarray, "6"],
    intrinsic: Float[np.ndarray, "3 3"],
    boxes: tuple[RoadUserBox, ...],
) -> Int[np.ndarray, "H W"]:
    """Track + 1 of each pixel, 0 where there is no road user.

    ``tags`` and ``numbers`` are the labels and Unreal's numbers of the pixels; ``depth`` [m],
    ``pose`` and ``intrinsic`` are the camera's; ``boxes`` are those of the frame.
    """
    found = np.zeros(tags.shape, np.int32)
    rows, columns = np.nonzero(np.isin(tags, ROAD_USER_LABELS) & np.isfinite(depth))
    if not len(rows) or not boxes:
        return found
    _, entry, count = np.unique(numbers[rows, columns], return_inverse=True, return_counts=True)
    sampled = _sample(entry, count)
    away = depth[rows[sampled], columns[sampled]].astype(float)
    (fx, _, cx), (_, fy, cy), _ = intrinsic
    left, up = (cx - columns[sampled] - 0.5) / fx, (cy - rows[sampled] - 0.5) / fy
    body = np.stack([away, away * left, away * up], -1)
    nearest_box = _nearest_boxes(body @ rotation(pose[3:], np).T + pose[:3], boxes)  # −1: none
    votes = np.zeros((len(count), len(boxes) + 1), int)
    np.add.at(votes, (entry[sampled], nearest_box), 1)
    votes[:, -1] = 0  # points in no box do not vote
    owner = np.where(votes.any(1), votes.argmax(1), len(boxes))
    track = np.array([box.track + 1 for box in boxes] + [0])
    found[rows, columns] = track[owner[entry]]
    return found


def _sample(entry: Int[np.ndarray, " P"], count: Int[np.ndarray, " N"]) -> Int[np.ndarray, " Q"]:
    """Indices of some pixels of every number, evenly spaced. ``entry`` is the index of each pixel's
    number, ``count`` how many pixels each number has."""
    order = np.argsort(entry, kind="stable")
    first = np.cumsum(count) - count
    rank = np.arange(len(entry)) - first[entry[order]]
    return order[rank % -(-count // MOST_SAMPLES)[entry[order]] == 0]


def _nearest_boxes(
    points: Float[np.ndarray, "Q 3"], boxes: tuple[RoadUserBox, ...]
) -> Int[np.ndarray, " Q"]:
    """The index of the box that each point lies in or close to, −1 where there is none."""
    least, nearest_box = np.full(len(points), MARGIN), np.full(len(points), -1)
    for k, box in enumerate(boxes):
        cos, sin = np.cos(box.yaw), np.sin(box.yaw)
        x, y, z = (points - box.center).T
        local = np.abs([cos * x + sin * y, cos * y - sin * x, z])  # (3, Q)
        out = (local - box.size[:, None] / 2).max(0)
        nearer = out < least
        least[nearer], nearest_box[nearer] = out[nearer], k
    return nearest_box
