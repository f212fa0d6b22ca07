"""Converts poses and points between our world frame and CARLA's: left-handed, in degrees, so that y
and yaw change sign. Its body frame is x forward, y right, z up. Its files hold *cords*: x, y, z,
roll, yaw, pitch."""

from typing import Any

import numpy as np
from jaxtyping import Float

from inspe_jax.core.geometry import pose_matrix


def to_carla(pose: Any) -> Float[np.ndarray, "*n 6"]:
    """Cords [m, °] of poses (…, 6) [m, rad]."""
    x, y, z, roll, pitch, yaw = np.moveaxis(np.asarray(pose, float), -1, 0)
    return np.stack([x, -y, z, np.degrees(roll), -np.degrees(yaw), np.degrees(pitch)], -1)


def from_carla(cords: Any) -> Float[np.ndarray, "*n 6"]:
    """Poses [m, rad] of cords (…, 6) [m, °]: the inverse of :func:`to_carla`."""
    x, y, z, roll, yaw, pitch = np.moveaxis(np.asarray(cords, float), -1, 0)
    return np.stack([x, -y, z, np.radians(roll), np.radians(pitch), -np.radians(yaw)], -1)


THINNEST = 0.05  # smaller half sizes do not count [m]: some versions give two-wheelers no width


def whole_box(
    middle: Float[np.ndarray, "3"], half: Float[np.ndarray, "3"], usual: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """A box's middle and half sizes, where it has none those of the ``usual`` size [m]. A box
    without a height stands on the ground, at the actor's origin."""
    given = np.isfinite(half) & (half > THINNEST)
    half, middle = np.where(given, half, usual / 2), np.where(np.isfinite(middle), middle, 0.0)
    return np.where(given | [True, True, False], middle, half), half


def flip(points: Any) -> Any:
    """Points (…, 3 or more) from one body frame to the other: the second column changes sign."""
    flipped = np.array(points)
    flipped[..., 1] = -flipped[..., 1]
    return flipped


def matrix(cords: Any) -> Float[np.ndarray, "4 4"]:
    """From a body at ``cords`` (6,) to CARLA's world: ``carla.Transform.get_matrix()``."""
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    return mirror @ pose_matrix(from_carla(cords)) @ mirror


def between(source: Any, target: Any) -> Float[np.ndarray, "4 4"]:
    """From a body at ``source`` to one at ``target``, both cords: inv(target) · source."""
    return np.linalg.inv(matrix(target)) @ matrix(source)
