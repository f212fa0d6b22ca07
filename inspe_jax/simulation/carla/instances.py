"""Whose pixels are whose: CARLA's instance pictures have Unreal's numbers, and no actor knows its.

So the numbers are matched by place: the points that a number's pixels show lie in the box of the
road user it stands for. Limits: a number is 16 bits of Unreal's, which two road users may share;
all its pixels then go to the one with more of them. What nobody's box holds is nobody's.
"""

import numpy as np
from jaxtyping import Float, Int

from inspe_jax.core.geometry import rotation
from inspe_jax.simulation.frame import RoadUserBox

ROAD_USERS = (12, 13, 14, 15, 16, 18, 19)
"""CARLA's labels (0.9.14 and later) of pedestrians, riders, cars, trucks, buses, motorcycles and
bicycles."""
BEYOND = 0.3
"""Mirrors and limbs reach so far out of a box [m]."""
ASKED = 200
"""So many pixels are asked of a number that has more."""


def instances_of(
    tags: Int[np.ndarray, "H W"],
    numbers: Int[np.ndarray, "H W"],
    depth: Float[np.ndarray, "H W"],
    pose: Float[np.ndarray, "6"],
    intrinsic: Float[np.ndarray, "3 3"],
    boxes: tuple[RoadUserBox, ...],
) -> Int[np.ndarray, "H W"]:
    """Track + 1 of each pixel of a camera at ``pose``, 0 where there is no thing."""
    found = np.zeros(tags.shape, np.int32)
    rows, columns = np.nonzero(np.isin(tags, ROAD_USERS) & np.isfinite(depth))
    if not len(rows) or not boxes:
        return found
    _, which, many = np.unique(numbers[rows, columns], return_inverse=True, return_counts=True)
    asked = _some(which, many)
    away = depth[rows[asked], columns[asked]].astype(float)
    (fx, _, cx), (_, fy, cy), _ = intrinsic
    left, up = (cx - columns[asked] - 0.5) / fx, (cy - rows[asked] - 0.5) / fy
    body = np.stack([away, away * left, away * up], -1)
    holder = _holders(body @ rotation(pose[3:], np).T + pose[:3], boxes)  # −1: nobody
    votes = np.zeros((len(many), len(boxes) + 1), int)
    np.add.at(votes, (which[asked], holder), 1)
    votes[:, -1] = 0  # what nobody holds
    owner = np.where(votes.any(1), votes.argmax(1), len(boxes))
    track = np.array([box.track + 1 for box in boxes] + [0])
    found[rows, columns] = track[owner[which]]
    return found


def _some(which: Int[np.ndarray, " P"], many: Int[np.ndarray, " N"]) -> Int[np.ndarray, " Q"]:
    """Pixels of every number, evenly out of all it has."""
    order = np.argsort(which, kind="stable")
    first = np.cumsum(many) - many
    rank = np.arange(len(which)) - first[which[order]]
    return order[rank % -(-many // ASKED)[which[order]] == 0]


def _holders(
    points: Float[np.ndarray, "Q 3"], boxes: tuple[RoadUserBox, ...]
) -> Int[np.ndarray, " Q"]:
    """The thing in or nearest to whose box points lie, −1 where none is near."""
    least, holder = np.full(len(points), BEYOND), np.full(len(points), -1)
    for k, box in enumerate(boxes):
        cos, sin = np.cos(box.yaw), np.sin(box.yaw)
        x, y, z = (points - box.center).T
        local = np.abs([cos * x + sin * y, cos * y - sin * x, z])  # (3, Q)
        out = (local - box.size[:, None] / 2).max(0)
        nearer = out < least
        least[nearer], holder[nearer] = out[nearer], k
    return holder
