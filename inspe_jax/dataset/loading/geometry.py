"""Points on pictures, and similarities of the intersection, also at random."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from inspe_jax.core.errors import InspeError
from inspe_jax.core.geometry import rotation
from inspe_jax.core.records import check_values
from inspe_jax.simulation.frame import Picture


def on_picture(points: Any, pose: Any, intrinsic: Any, xp: Any = np) -> Any:
    """Points (…, 3) on a picture, whose (4, 4) ``pose`` leads from the body (x forward, y left, z
    up) to their frame: column and row [px] from the outer corner of the first pixel, and depth [m],
    negative behind the camera. ``xp`` is numpy or jax.numpy."""
    body = (points - xp.broadcast_to(pose[:3, 3], points.shape)) @ pose[:3, :3]
    seen = xp.stack([-body[..., 1], -body[..., 2], body[..., 0]], -1) @ intrinsic.T
    return xp.concatenate([seen[..., :2] / seen[..., 2:], seen[..., 2:]], -1)


@dataclass(frozen=True)
class Similarity:
    """Mirrors the plane y = 0 if ``mirrored``, turns about the z axis by ``turn`` [rad], and
    scales, about the middle of the intersection: points, poses, boxes, pictures."""

    mirrored: bool = False
    turn: float = 0.0
    scale: float = 1.0

    @property
    def linear(self) -> Float[np.ndarray, "3 3"]:
        """The matrix that moves points."""
        turned: np.ndarray = rotation(np.array([0.0, 0.0, self.turn]), np)
        return self.scale * (turned * [1.0, -1.0, 1.0] if self.mirrored else turned)

    @property
    def matrix(self) -> Float[np.ndarray, "4 4"]:
        """The same as a homogeneous matrix."""
        found = np.eye(4)
        found[:3, :3] = self.linear
        return found

    def of_poses(self, poses: Float[np.ndarray, "*n 4 4"]) -> Float[np.ndarray, "*n 4 4"]:
        """Poses of sensors in the moved world; a mirrored body frame has its y reversed."""
        moved = np.array(poses)
        moved[..., :3, 3] = poses[..., :3, 3] @ self.linear.T
        moved[..., :3, :3] = (self.linear / self.scale) @ poses[..., :3, :3]
        if self.mirrored:
            moved[..., :3, 1] *= -1
        return moved

    def of_intrinsics(
        self, intrinsics: Float[np.ndarray, "*n 3 3"], width: float
    ) -> Float[np.ndarray, "*n 3 3"]:
        """Calibrations of pictures, mirrored if the world is: column u becomes ``width`` − u."""
        moved = np.array(intrinsics)
        if self.mirrored:
            moved[..., 0, 1] *= -1
            moved[..., 0, 2] = width - moved[..., 0, 2]
        return moved

    def copy_picture(self, picture: Picture, out: Picture) -> None:
        """Write a picture to ``out``, mirrored if the world is."""
        if not self.mirrored:
            out[:] = picture
            return
        for colour in range(3):  # nine times as fast as all at once
            out[..., colour] = picture[:, ::-1, colour]

    def of_boxes(self, boxes: Float[np.ndarray, "N 9"]) -> Float[np.ndarray, "N 9"]:
        """Boxes as of targets, with yaw within ±π and velocities that scale as lengths do."""
        moved = np.array(boxes)
        moved[:, :3] = boxes[:, :3] @ self.linear.T
        moved[:, 3:6] *= self.scale
        yaw = (-boxes[:, 6] if self.mirrored else boxes[:, 6]) + self.turn
        moved[:, 6] = np.pi - (np.pi - yaw) % (2 * np.pi)
        moved[:, 7:9] = boxes[:, 7:9] @ self.linear[:2, :2].T
        return moved


@dataclass(frozen=True)
class Augment:
    """How frames are changed at random: ``flip`` is the chance to be mirrored, which puts traffic
    on the other side of the road; turns are within ± ``turn`` [rad], scales within ``scale``.
    Defaults are of SECOND (Yan, Mao and Li 2018) and PointPillars (Lang et al. 2019).

    >>> change = dataset.Augment(flip=0.0, turn=0.1).similarity(np.random.default_rng(0))
    >>> change.mirrored, abs(change.turn) < 0.1
    (False, True)
    """

    flip: float = 0.5
    turn: float = np.pi / 4
    scale: tuple[float, float] = (0.95, 1.05)

    def check(self) -> None:
        """Raise InspeError where a value is out of range."""
        check_values(self.flip, "augment: flip (a chance)", 0, 1)
        check_values(self.turn, "augment: turn [rad]", 0, np.pi)
        low, high = self.scale
        if not 0 < low <= high < np.inf:
            raise InspeError(f"augment: scale {self.scale}: two numbers above 0, the smaller first")

    def similarity(self, rng: np.random.Generator) -> Similarity:
        """A mirror, turn and scale at random."""
        return Similarity(
            mirrored=bool(rng.random() < self.flip),
            turn=float(rng.uniform(-self.turn, self.turn)),
            scale=float(rng.uniform(*self.scale)),
        )
