"""What you buy (CameraSpec, LidarSpec), apart from where you put it (a pose).

Every sensor is a grid of rays, rows × columns, in the body frame: a camera's downsampled pixels in
the plane of tangents, a LiDAR's channels × azimuths on the sphere.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, Self

import jax
import numpy as np
from jaxtyping import Float, Int

from inspe_jax.core.arrays import on_host, wide_bucket
from inspe_jax.core.digest import OPTIONAL
from inspe_jax.core.errors import InspeError
from inspe_jax.core.rigid import pose_of
from inspe_jax.sensing.rays import Edges, Kind, PinholeRays, Rays, RayTable, SphericalRays

ROWS, STEPS = 128, 1024
"""Smallest lengths of a grid's tables of rows. Longer tables have 4, 16, … times that."""
SWAPPED = 0.2  # a principal point farther off the middle, in picture sizes, is looked at twice
COUNTS = 1024  # length of the table that counts rows


class Pose(NamedTuple):
    """Where a sensor is and how it is turned, in world metres and radians: a row of
    ``Layout.poses``. Yaw is counter-clockwise from +x, pitch positive nose-up."""

    x: float
    y: float
    z: float
    roll: float = 0.0
    pitch: float = 0.0
    yaw: float = 0.0

    @classmethod
    def from_matrix(cls, matrix: Any, *, convention: str, direction: str) -> "Pose":
        """The pose that a calibration has as a matrix.

        Args:
            matrix: (4, 4), or (3, 4) without its last row [m].
            convention: The sensor's axes: "body" (x forward, y left, z up), "optical" (OpenCV: x
                right, y down, z forward) or "carla" (x forward, y right, z up, left-handed world).
            direction: What the matrix takes points from and to: "sensor_to_world", or
                "world_to_sensor", as OpenCV's extrinsics.

        Returns:
            The pose in world metres and radians.

        Raises:
            InspeError: The matrix is no rotation with a translation, is mirrored or transposed.

        >>> m = [[1, 0, 0, 2], [0, 0, 1, 3], [0, -1, 0, 6], [0, 0, 0, 1]]  # level, to the north
        >>> pose = inspe_jax.Pose.from_matrix(m, convention="optical", direction="sensor_to_world")
        >>> pose.x, pose.y, pose.z, round(float(np.degrees(pose.yaw)))
        (2.0, 3.0, 6.0, 90)
        """
        return cls(*pose_of(matrix, convention, direction).tolist())


@dataclass(frozen=True)
class RayGrid:
    """Rows at given coordinates and evenly spaced columns, with a ray at each crossing.

    ``rows`` ascend. Column j lies at ``first_column + j · column_step``. If ``wraps``, the first
    column follows the last. ``reach`` is in metres. Coordinates are those of the class ``of`` rays:
    angles [rad] on the sphere, or tangents on a plane. ``cell`` is a radar's resolution in range
    [m], azimuth [rad] and radial speed [m/s], and the least radial speed that it finds; else 0.
    """

    rows: tuple[float, ...]
    first_column: float
    column_step: float
    column_count: int
    wraps: bool
    reach: float
    of: type[Rays]
    cell: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

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
        """The kind that code is compiled for; grids of one kind differ only in numbers."""
        return Kind(self.of, self.wraps)

    @property
    def rays(self) -> Rays:
        """The grid in the form that scores use, in JAX's precision at the moment."""
        return self.kind.rays(jax.tree.map(on_host, self.table))

    @cached_property
    def table(self) -> RayTable:
        """The grid's numbers, in tables of a few fixed lengths."""
        rows, (first, last) = np.asarray(self.rows, float), self.column_limits
        nearest, steps = self._nearest
        ends = self.outer_rows
        at = np.linspace(ends[0], ends[1], COUNTS)
        # Halfway between rows a spacing ends: there the count is whole.
        counts = np.interp(
            at, [ends[0], *rows, ends[1]], [0.0, *(np.arange(len(rows)) + 0.5), len(rows)]
        )
        half = self.column_step / 2
        return RayTable(
            repeat_last(rows, wide_bucket(len(rows), ROWS)),
            repeat_last(nearest, wide_bucket(len(nearest), STEPS)),
            np.array(steps),
            np.array(len(rows), np.int32),
            np.array(self.column_step),
            np.array(1.0 / self.column_step),
            np.array(self.column_count, np.int32),
            np.array(self.reach),
            self._edges(rows[[0, -1]], np.array([first, last])),
            self._edges(ends, np.array([first - half, last + half])),
            counts,
            np.array((COUNTS - 1) / (ends[1] - ends[0])),
            np.array(not self.of.slants and last - first > np.pi),
            np.array(self.cell),
        )

    @property
    def outer_rows(self) -> Float[np.ndarray, "2"]:
        """Coordinates half a spacing beyond the first and the last row. A single row has no
        spacing; that of the columns is taken for it."""
        rows = np.asarray(self.rows, float)
        if len(rows) == 1:
            return rows[[0, 0]] + np.array([-0.5, 0.5]) * self.column_step
        return np.array([rows[0] - (rows[1] - rows[0]) / 2, rows[-1] + (rows[-1] - rows[-2]) / 2])

    def _edges(self, row: Float[np.ndarray, "2"], column: Float[np.ndarray, "2"]) -> Edges:
        return Edges(row, column, self._turn(row), self._turn(column))

    def _turn(self, coordinate: Float[np.ndarray, " n"]) -> Float[np.ndarray, "2 n"]:
        """Cosines and sines of the angles at coordinates."""
        angle = np.arctan(coordinate) if self.of.slants else coordinate
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
        # Loops copy the table, so it is kept small.
        return nearest.astype(np.uint8 if len(rows) <= 2**8 else np.uint16), steps / span


def repeat_last(x: Any, length: int) -> np.ndarray:
    """A table with its last entry repeated up to a length."""
    return np.concatenate([x, np.repeat(x[-1:], length - len(x))])


class Spec:
    """The base of every kind of sensor: a frozen dataclass with what its grid of rays needs, and a
    row in :data:`~inspe_jax.sensing.kinds.SENSOR_KINDS`. ``reliability`` is the chance that what is
    in view is perceived. Defaults are those of a sensor that looks level or all round."""

    name: str
    reliability: float

    kind: ClassVar[str]  # its name in files and reports
    title: ClassVar[str]  # its name for people
    reach_field: ClassVar[str] = "reach"  # the field that holds how far it perceives [m]
    aimed: ClassVar[bool] = False
    """Whether it is usually aimed down at a place, as a camera, or mounted level, as a LiDAR."""
    pitch_limits_deg: ClassVar[tuple[float, float]] = (-30.0, 30.0)
    """Pitches that a mount allows where a user sets no others [degrees, positive nose-up]."""
    candidate_pitches_deg: ClassVar[tuple[float, ...]] = (0.0,)  # what searches try first

    @property
    def grid(self) -> RayGrid:
        """Its rays in the body frame."""
        raise NotImplementedError

    @property
    def azimuth_limits(self) -> tuple[float, float]:
        """Right and left edge of its view [rad], counter-clockwise from straight ahead."""
        return self.grid.column_limits

    @property
    def resolution(self) -> str:
        """What a table of devices says about its rays: as of a LiDAR, the number of rows."""
        return f"{len(self.grid.rows)}"

    @property
    def focal_pixels(self) -> float | None:
        """Focal length of its pictures [px]; None for a sensor without pictures."""
        return None

    @property
    def pixels_per_ray(self) -> float:
        """How many pixels of its pictures a ray stands for; 1 for a sensor without pictures."""
        focal = self.focal_pixels
        return 1.0 if focal is None else float(focal * self.grid.column_step) ** 2

    @property
    def field_of_view(self) -> tuple[float, float]:
        """Angle from edge to edge, horizontal and vertical [rad]."""
        right, left = self.azimuth_limits
        return left - right, self.grid.rows[-1] - self.grid.rows[0]

    @property
    def lens_limits(self) -> tuple[float, float]:
        """Logarithms of the least and the greatest focal length, in times the usual one: the middle
        of both. They are 0 without a varifocal lens."""
        return 0.0, 0.0

    @property
    def lens(self) -> float:
        """The logarithm of its focal length, in times the usual one."""
        return 0.0

    def with_lens(self, lens: float) -> Self:
        """The same sensor with a varifocal lens set within its limits; without one, as it is."""
        return self

    def with_performance(self, reliability: float, reach: float | None = None) -> Self:
        """The same sensor with another reliability, and with another reach [m] if one is given."""
        changed: dict[str, float] = {"reliability": reliability}
        if reach is not None:
            changed[self.reach_field] = reach
        return replace(self, **changed)  # type: ignore[type-var]  # every kind is a dataclass


@dataclass(frozen=True)
class CameraSpec(Spec):
    """A pinhole camera: one ray per downsampled pixel, to its effective depth.

    ``width``, ``height``, the ``focal`` length and the ``principal`` point are in pixels, and so is
    the ``focal_range`` of a varifocal lens, and ``focal_y``, down a column, where pixels are not
    square. ``downsample`` is λ: the rays are ⌊λ·height⌋ × ⌊λ·width⌋ and pass through the centres of
    the enlarged pixels. ``depth`` [m] is measured along the ray.
    """

    name: str
    width: int
    height: int
    focal: float
    principal: tuple[float, float]
    downsample: float
    depth: float
    reliability: float = 1.0
    focal_range: tuple[float, float] | None = field(default=None, metadata=OPTIONAL)
    focal_y: float | None = field(default=None, metadata=OPTIONAL)

    kind = "camera"
    title = "camera"
    reach_field = "depth"
    aimed = True
    pitch_limits_deg = (-80.0, 10.0)
    candidate_pitches_deg = (-25.0, -10.0)

    def __post_init__(self) -> None:
        """A range is rounded, so that it is the same when it is read from a file. Raises InspeError
        where it does not ascend, or the focal length is outside of it."""
        if self.focal_range is not None:
            low, high = (round(float(focal), 6) for focal in self.focal_range)
            object.__setattr__(self, "focal_range", (low, high))
            if not (0 < low < high and low - 1e-5 <= self.focal <= high + 1e-5):
                raise InspeError(
                    f"device '{self.name}': focal_range must ascend about the focal length, but is "
                    f"{low:g} to {high:g} about {self.focal:g} px"
                )

    @classmethod
    def from_intrinsics(
        cls,
        name: str,
        width: int,
        height: int,
        *,
        depth: float,
        fx: float | None = None,
        fy: float | None = None,
        hfov_deg: float | None = None,
        vfov_deg: float | None = None,
        cx: float | None = None,
        cy: float | None = None,
        downsample: float = 0.1,
        reliability: float = 1.0,
    ) -> "CameraSpec":
        """A camera from its calibration: focal lengths, or fields of view.

        Args:
            name: Name of the device.
            width, height: Size of the picture [px].
            depth: How far it perceives along a ray [m], which no calibration says.
            fx, fy: Focal lengths [px]; one of them is both.
            hfov_deg, vfov_deg: Fields of view [degrees] in place of fx and fy; one of them is
                enough where pixels are square.
            cx, cy: Principal point [px] from the outer corner of the first pixel; the middle of the
                picture if not given.
            downsample: Rays per pixel, along a row.
            reliability: The chance that what is in view is perceived.

        Raises:
            InspeError: Neither or both of focal length and field of view are given, or the
                principal point is outside of the picture, as where width and height are swapped.

        >>> spec = inspe_jax.CameraSpec.from_intrinsics("roof", 1920, 1080, hfov_deg=90, depth=60)
        >>> round(spec.focal)
        960
        """
        where = f"device '{name}'"
        if ((fx or fy) is None) == ((hfov_deg or vfov_deg) is None):
            raise InspeError(f"{where}: give either fx and fy, or a field of view")
        cx, cy = width / 2 if cx is None else cx, height / 2 if cy is None else cy
        given = [fx, fy]
        for k, (side, view) in enumerate(((width, hfov_deg), (height, vfov_deg))):
            if view is not None:
                half = np.radians(view) / 2 if 0 < view < 180 else np.nan
                given[k] = float(side / 2 / np.tan(half))
        x, y = (float(given[k] or given[1 - k] or 0.0) for k in (0, 1))
        numbers = np.array([width, height, x, y, depth, downsample, cx, cy], float)
        if not (np.isfinite(numbers).all() and (numbers[:6] > 0).all()):
            raise InspeError(f"{where}: its numbers must be positive, a field of view below 180°")
        off, swapped = (abs(cx / w - 0.5) + abs(cy / h - 0.5) for w, h in
                        ((width, height), (height, width)))  # fmt: skip
        words = f"{where}: principal point ({cx:g}, {cy:g}) in a picture of {width} × {height}"
        if off > SWAPPED and swapped < off / 2:
            raise InspeError(f"{words}: width and height seem to be swapped")
        if not (0 <= cx <= width and 0 <= cy <= height):
            raise InspeError(f"{words} is outside of it: give the size that the lens was found for")
        other = dict(reliability=reliability, focal_y=None if y == x else y)
        return cls(name, width, height, x, (cx, cy), downsample, depth, **other)  # type: ignore[arg-type]

    @cached_property
    def grid(self) -> RayGrid:
        """Rays r_ij = O + μ·((w_j − c_x)/f, (h_i − c_y)/f, 1), turned to the body frame."""
        columns = max(1, int(self.width * self.downsample + 1e-9))
        rows = max(1, int(self.height * self.downsample + 1e-9))
        pitch = self.width / columns / self.focal
        pixel = (np.arange(rows) + 0.5) * self.height / rows
        tangents = tuple((self.principal[1] - pixel[::-1]) / self.focals[1])  # rows run downward
        leftmost = (self.principal[0] - self.width) / self.focal + pitch / 2
        return RayGrid(tangents, leftmost, pitch, columns, False, self.depth, PinholeRays)

    @property
    def lens_limits(self) -> tuple[float, float]:
        """Even about 0, by what makes the focal length usual."""
        low, high = self.focal_range or (1.0, 1.0)
        half = float(np.log(high / low) / 2)
        return -half, half

    @property
    def _usual(self) -> float:
        """The usual focal length [px]: the middle of the range, by its logarithm."""
        if self.focal_range is None:
            return self.focal
        return float(np.sqrt(self.focal_range[0] * self.focal_range[1]))

    @property
    def lens(self) -> float:
        """0 at the usual focal length."""
        return float(np.log(self.focal / self._usual))

    def with_lens(self, lens: float) -> Self:
        """The same camera with another focal length."""
        if self.focal_range is None:
            return self
        focal = float(self._usual * np.exp(lens))
        return replace(self, focal=min(max(focal, self.focal_range[0]), self.focal_range[1]))

    @property
    def focals(self) -> tuple[float, float]:
        """Focal lengths along a row and down a column [px]."""
        return self.focal, self.focal_y or self.focal

    @property
    def azimuth_limits(self) -> tuple[float, float]:
        """Right and left edge of the picture [rad]."""
        middle, focal = self.principal[0], self.focal
        return float(np.arctan2(middle - self.width, focal)), float(np.arctan2(middle, focal))

    @property
    def resolution(self) -> str:
        """Pixels of the picture."""
        return f"{self.width} × {self.height}"

    @property
    def focal_pixels(self) -> float:
        """Of the full picture, which has more pixels than rays."""
        return self.focal

    @property
    def field_of_view(self) -> tuple[float, float]:
        """Angle from edge to edge of the picture, horizontal and vertical [rad]."""
        wide, tall = (
            float(np.arctan2(middle, focal) + np.arctan2(side - middle, focal))
            for side, middle, focal in zip(
                (self.width, self.height), self.principal, self.focals, strict=True
            )
        )
        return wide, tall


@dataclass(frozen=True)
class LidarSpec(Spec):
    """A LiDAR: channels at given elevations, each fired at evenly spaced azimuths.

    ``elevations`` ascend [rad]; ``azimuth_count`` is J; ``azimuth_fov`` is θ₀
    [rad], 2π for a spinning LiDAR; ``reach`` is t_max [m]. Azimuths are
    θ_j = −θ₀/2 + j·θ₀/J (paper, section 3).
    """

    name: str
    elevations: tuple[float, ...]
    azimuth_count: int
    azimuth_fov: float
    reach: float
    reliability: float = 1.0

    kind = "lidar"
    title = "LiDAR"

    @cached_property
    def grid(self) -> RayGrid:
        """Rays (cos ψ_i cos θ_j, cos ψ_i sin θ_j, sin ψ_i)."""
        return RayGrid(
            self.elevations,
            -self.azimuth_fov / 2,
            self.azimuth_fov / self.azimuth_count,
            self.azimuth_count,
            bool(np.isclose(self.azimuth_fov, 2 * np.pi)),
            self.reach,
            SphericalRays,
        )

    @property
    def azimuth_limits(self) -> tuple[float, float]:
        """Right and left end of the sweep [rad]."""
        return -self.azimuth_fov / 2, self.azimuth_fov / 2
