"""Points of the world in a camera's picture."""

from typing import Protocol

import numpy as np
from jaxtyping import Float

from inspe_jax.core.geometry import rotation


class Pinhole(Protocol):
    """A camera's pose and calibration, such as an :class:`~inspe_jax.simulation.frame.Image`
    has."""

    @property
    def pose(self) -> Float[np.ndarray, "6"]:
        """Its pose in the world."""
        ...

    @property
    def intrinsic(self) -> Float[np.ndarray, "3 3"]:
        """Its calibration matrix, in pixels."""
        ...


def pixels(image: Pinhole, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Points of the world in a picture: column and row in pixels, and depth in metres.

    (0, 0) is the outer corner of the first pixel. A point behind the camera has a negative depth,
    and its column and row mean nothing.
    """
    pose = np.asarray(image.pose, float)
    body = (points - pose[:3]) @ rotation(pose[3:], np)
    seen = np.stack([-body[..., 1], -body[..., 2], body[..., 0]], -1) @ image.intrinsic.T
    placed: np.ndarray = np.concatenate([seen[..., :2] / seen[..., 2:], seen[..., 2:]], -1)
    return placed
