"""What the loader gives: named tuples of NumPy arrays, which JAX takes as pytrees.

Their shapes are the same in every batch. What is padding is 0, and its mask is false. Letters in
shapes: B frames, S LiDARs, C cameras, N points of a cloud, M road users, H × W pixels, G units with
LiDARs, P pillars, K points of a pillar. Positions are in metres from the middle of the intersection
on the ground; the axes are those of the world, unless the frame was augmented.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Int32, UInt8


class Pillars(NamedTuple):
    """The points of units' LiDARs by the pillars of a grid.

    ``points`` are x, y, z and intensity 0…1; ``counts`` of them are in each pillar, 0 in padding,
    and come first. ``cells`` are the pillar's place in the grid, along x and along y.
    """

    points: Float32[np.ndarray, "B G P K 4"]
    counts: Int32[np.ndarray, "B G P"]
    cells: Int32[np.ndarray, "B G P 2"]


class Lidars(NamedTuple):
    """LiDARs and their points: x, y, z and intensity 0…1, either padded or as pillars.

    ``pose`` leads from the sensor's body (x forward, y left, z up) to the intersection; it is the
    identity where a LiDAR is not ``present``. ``unit`` is the number of its infrastructure unit, 1,
    2 …; 0 is padding.
    """

    points: Float32[np.ndarray, "B S N 4"] | None
    mask: Bool[np.ndarray, "B S N"] | None
    pillars: Pillars | None
    pose: Float32[np.ndarray, "B S 4 4"]
    present: Bool[np.ndarray, "B S"]
    unit: Int32[np.ndarray, "B S"]


class Cameras(NamedTuple):
    """Pictures and their calibration, in pixels of these pictures.

    ``pose`` leads from the camera's body (x forward, y left, z up) to the intersection;
    :func:`~inspe_jax.dataset.loading.geometry.on_picture` uses it. ``present`` and ``unit`` are as
    in :class:`Lidars`.
    """

    pixels: UInt8[np.ndarray, "B C H W 3"]
    intrinsic: Float32[np.ndarray, "B C 3 3"]
    pose: Float32[np.ndarray, "B C 4 4"]
    present: Bool[np.ndarray, "B C"]
    unit: Int32[np.ndarray, "B C"]


class Targets(NamedTuple):
    """The road users.

    ``boxes`` are x, y, z of the middle, length, width, height [m], yaw [rad], and velocity in x and
    y [m/s]. ``kind`` is the index in :data:`~inspe_jax.simulation.frame.KINDS`, ``track`` the
    number of the road user in its scenario, and ``returns`` how many returns each LiDAR has of it
    (if the set does not say: how many points in its box), also of those that pillars have no place
    for. ``pixels`` is how many pixels of each picture show it, counted where the picture was
    recorded and scaled to this size, and −1 if the set does not say.
    """

    boxes: Float32[np.ndarray, "B M 9"]
    kind: Int32[np.ndarray, "B M"]
    track: Int32[np.ndarray, "B M"]
    returns: Int32[np.ndarray, "B M S"]
    pixels: Float32[np.ndarray, "B M C"]
    mask: Bool[np.ndarray, "B M"]

    def seen_by(self, sensors: Iterable[str]) -> Bool[np.ndarray, "B M"]:
        """Whether a sensor of these kinds, "camera" or "lidar", sees a road user: a picture shows a
        part of a pixel of it, or a LiDAR has a return; also where the set does not say."""
        each = {"camera": self.pixels != 0, "lidar": self.returns > 0}
        return np.any([each[sensor].any(-1) for sensor in sensors], 0)


class Batch(NamedTuple):
    """Some frames. ``valid`` is false for what fills up the last batch of an epoch.

    ``scenario`` is the index in the loader's scenarios, ``number`` that of the frame in it.
    ``transform`` leads from the intersection as recorded to that of the batch: the identity without
    augmentation.
    """

    lidars: Lidars | None
    cameras: Cameras | None
    targets: Targets
    scenario: Int32[np.ndarray, " B"]
    number: Int32[np.ndarray, " B"]
    transform: Float32[np.ndarray, "B 4 4"]
    valid: Bool[np.ndarray, " B"]
