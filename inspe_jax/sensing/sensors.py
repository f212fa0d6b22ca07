"""What you buy (CameraSpec, LidarSpec), apart from where you put it (a pose).

Both kinds of sensor are a grid of rays, rows × columns: a camera's downsampled
pixels in the plane of tangents, a LiDAR's channels × azimuths on the sphere.
All in the body frame: x forward, y left, z up.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from inspe_jax.core.arrays import wide_bucket
from inspe_jax.sensing.rays import Kind, PinholeRays, Rays, RayTable, SphericalRays

ROWS, STEPS = 128, 1024
"""Least lengths of a grid's tables of rows; if they are longer, four times that."""


class Pose(NamedTuple):
    """Where a sensor is and how it is turned, in world metres and radians.

    Yaw is counter-clockwise from +x, pitch positive nose-up, roll about the
    forward axis: a row of ``Layout.poses``.
    """

    x: float
    y: float
    z: float
    roll: float = 0.0
    pitch: float = 0.0
    yaw: float = 0.0


@dataclass(frozen=True)
class RayGrid:
    """Rows at given coordinates and evenly spaced columns, each crossing one ray.

    ``rows`` ascend; column j lies at ``first_column + j · column_step``; with
    ``wraps`` the last column is followed by the first. ``reach`` in metres.
    """

    rows: tuple[float, ...]
    first_column: float
    column_step: float
    column_count: int
    wraps: bool
    reach: float

    @property
    def column_limits(self) -> tuple[float, float]:
        """Coordinates of the first and the last column."""
        last = self.first_column + (self.column_count - 1) * self.column_step
        return self.first_column, last

    def directions(self) -> Float[np.ndarray, "R 3"]:
        """Unit directions of all rays in the body frame, row by row."""
        columns = self.first_column + np.arange(self.column_count) * self.column_step
        row, column = np.meshgrid(np.asarray(self.rows), columns, indexing="ij")
        return np.stack(self.rays.direction(row.ravel(), column.ravel(), np), axis=-1)

    @property
    def kind(self) -> Kind:
        """What is compiled for: grids of one kind differ in numbers alone."""
        return Kind(self._rays, self.wraps)

    @property
    def rays(self) -> Rays:
        """The grid as scores work with it."""
        return self.kind.rays(self.table)

    _rays: ClassVar[type[Rays]]

    @cached_property
    def table(self) -> RayTable:
        """The grid's numbers, in tables of a few lengths."""
        rows, (first, last) = np.asarray(self.rows, float), self.column_limits
        nearest, steps = self._nearest
        ends, sides = np.array([rows[0], rows[-1]]), np.array([first, last])
        return RayTable(
            _filled(rows, ROWS),
            _filled(nearest, STEPS),
            np.array(steps),
            np.array(len(rows), np.int32),
            np.array(self.column_step),
            np.array(1.0 / self.column_step),
            np.array(self.column_count, np.int32),
            np.array(self.reach),
            ends,
            sides,
            self._turn(ends),
            self._turn(sides),
            np.array(last - first > np.pi),
        )

    def _turn(self, coordinate: Float[np.ndarray, " n"]) -> Float[np.ndarray, "2 n"]:
        """Cosines and sines of the angles at coordinates."""
        angle = np.arctan(coordinate) if self._rays.slants else coordinate
        return np.array([np.cos(angle), np.sin(angle)])

    @property
    def _nearest(self) -> tuple[Int[np.ndarray, " K"], float]:
        """(row nearest to each of many even steps between the end rows, steps per unit)."""
        rows = np.asarray(self.rows)
        if len(rows) == 1:
            return np.zeros(1, np.uint8), 0.0
        span = rows[-1] - rows[0]
        steps = int(min(4 * STEPS - 1, np.ceil(8 * span / np.diff(rows).min())))
        at = rows[0] + np.arange(steps + 1) * span / steps
        nearest = np.abs(at[:, None] - rows).argmin(1)
        # Loops copy the table, so it is to be small.
        return nearest.astype(np.uint8 if len(rows) <= 2**8 else np.uint16), steps / span


def _filled(x: np.ndarray, least: int) -> np.ndarray:
    """A table in one of a few lengths: ``least``, or four times as long, or four times that."""
    return repeat_last(x, wide_bucket(len(x), least))


def repeat_last(x: Any, length: int) -> np.ndarray:
    """A table with its last entry repeated up to a length."""
    return np.concatenate([x, np.repeat(x[-1:], length - len(x))])


@dataclass(frozen=True)
class SphericalGrid(RayGrid):
    """A LiDAR's grid."""

    _rays = SphericalRays


@dataclass(frozen=True)
class PinholeGrid(RayGrid):
    """A camera's grid."""

    _rays = PinholeRays


@dataclass(frozen=True)
class CameraSpec:
    """A pinhole camera: one ray per downsampled pixel, to its effective depth.

    ``width``, ``height`` [pixel]; ``focal`` length and ``principal`` point
    [pixel]; ``downsample`` is λ, so the rays are ⌊λ·height⌋ × ⌊λ·width⌋ and pass
    through the centres of the enlarged pixels; ``depth`` [m], measured along the
    ray; ``reliability`` is the chance that what is in view is perceived.
    """

    name: str
    width: int
    height: int
    focal: float
    principal: tuple[float, float]
    downsample: float
    depth: float
    reliability: float = 1.0

    kind = "camera"

    @cached_property
    def grid(self) -> RayGrid:
        """Rays r_ij = O + μ·((w_j − c_x)/f, (h_i − c_y)/f, 1), turned to the body frame."""
        columns = max(1, int(self.width * self.downsample + 1e-9))
        rows = max(1, int(self.height * self.downsample + 1e-9))
        pitch = self.width / columns / self.focal
        pixel = (np.arange(rows) + 0.5) * self.height / rows
        tangents = (self.principal[1] - pixel[::-1]) / self.focal  # pixel rows run downward
        leftmost = (self.principal[0] - self.width) / self.focal + pitch / 2
        return PinholeGrid(tuple(tangents), leftmost, pitch, columns, False, self.depth)


@dataclass(frozen=True)
class LidarSpec:
    """A LiDAR: channels at the elevations of a table, each fired at even azimuths.

    ``elevations`` ascend [rad]; ``azimuth_count`` is J; ``azimuth_fov`` is θ₀
    [rad], 2π for one that spins; ``reach`` is t_max [m]. Azimuths are
    θ_j = −θ₀/2 + j·θ₀/J (paper, section 3). ``reliability`` as for a camera.
    """

    name: str
    elevations: tuple[float, ...]
    azimuth_count: int
    azimuth_fov: float
    reach: float
    reliability: float = 1.0

    kind = "lidar"

    @cached_property
    def grid(self) -> RayGrid:
        """Rays (cos ψ_i cos θ_j, cos ψ_i sin θ_j, sin ψ_i)."""
        return SphericalGrid(
            self.elevations,
            -self.azimuth_fov / 2,
            self.azimuth_fov / self.azimuth_count,
            self.azimuth_count,
            bool(np.isclose(self.azimuth_fov, 2 * np.pi)),
            self.reach,
        )


Spec = CameraSpec | LidarSpec
