"""What the loader gives: named tuples of NumPy arrays, which JAX takes as pytrees.

Shapes are the same in every batch; padding is 0, and its mask is false. B frames, S LiDARs, C
cameras, N points of a cloud, M road users, H × W pixels, G units with LiDARs, P pillars, K points
of a pillar. Positions are in metres from the middle of the intersection on the ground, along the
axes of the world, unless the frame was augmented.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Int32, UInt8


class Pillars(NamedTuple):
    """Points by pillar: x, y, z and intensity 0…1, of which ``counts`` are there and come first;
    ``cells`` are a pillar's place in the grid, along x and along y."""

    points: Float32[np.ndarray, "B G P K 4"]
    counts: Int32[np.ndarray, "B G P"]
    cells: Int32[np.ndarray, "B G P 2"]


class Lidars(NamedTuple):
    """LiDARs and their points: x, y, z and intensity 0…1, either padded or as pillars. ``pose``
    leads from the body (x forward, y left, z up) to the intersection: the identity where none is
    ``present``. ``unit`` is the number of the infrastructure unit, from 1; 0 is padding."""

    points: Float32[np.ndarray, "B S N 4"] | None
    mask: Bool[np.ndarray, "B S N"] | None
    pillars: Pillars | None
    pose: Float32[np.ndarray, "B S 4 4"]
    present: Bool[np.ndarray, "B S"]
    unit: Int32[np.ndarray, "B S"]


class Cameras(NamedTuple):
    """Pictures and their calibration, in pixels of these pictures; the others are as in
    :class:`Lidars`. See :func:`~inspe_jax.dataset.loading.geometry.on_picture`."""

    pixels: UInt8[np.ndarray, "B C H W 3"]
    intrinsic: Float32[np.ndarray, "B C 3 3"]
    pose: Float32[np.ndarray, "B C 4 4"]
    present: Bool[np.ndarray, "B C"]
    unit: Int32[np.ndarray, "B C"]


class Targets(NamedTuple):
    """The road users: ``boxes`` are x, y, z of the middle, length, width, height [m], yaw [rad],
    and velocity in x and y [m/s]; ``kind`` is the index in
    :data:`~inspe_jax.simulation.frame.KINDS`. ``returns`` are those of each LiDAR (if the set does
    not say: points in the box), and ``pixels`` those of each picture, scaled to this size, −1 if
    the set does not say."""

    boxes: Float32[np.ndarray, "B M 9"]
    kind: Int32[np.ndarray, "B M"]
    track: Int32[np.ndarray, "B M"]
    returns: Int32[np.ndarray, "B M S"]
    pixels: Float32[np.ndarray, "B M C"]
    mask: Bool[np.ndarray, "B M"]

    def seen_by(self, sensors: Iterable[str]) -> Bool[np.ndarray, "B M"]:
        """Whether one of ``sensors``, "camera" or "lidar", sees a road user, or may."""
        each = {"camera": self.pixels != 0, "lidar": self.returns > 0}
        return np.any([each[sensor].any(-1) for sensor in sensors], 0)


class Batch(NamedTuple):
    """Some frames. ``scenario`` is the index in the loader's scenarios, ``number`` that of the
    frame in it; ``transform`` leads from the intersection as recorded to that of the batch;
    ``valid`` is false for what fills up the last batch of an epoch."""

    lidars: Lidars | None
    cameras: Cameras | None
    targets: Targets
    scenario: Int32[np.ndarray, " B"]
    number: Int32[np.ndarray, " B"]
    transform: Float32[np.ndarray, "B 4 4"]
    valid: Bool[np.ndarray, " B"]
