"""What you buy (CameraSpec, LidarSpec), apart from where you put it (a pose).

Every sensor is a grid of rays, rows × columns, in the body frame: a camera's downsampled pixels in
the plane of tangents, a LiDAR's channels × azimuths on the sphere.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from jaxtyping import Float

from inspe_jax.core.digest import OPTIONAL
from inspe_jax.core.errors import InspeError, error_at
from inspe_jax.core.rigid import pose_of
from inspe_jax.sensing.lens import Lens, distortion_of, focal_of
from inspe_jax.sensing.lens_rays import DistortedRays, FisheyeRays
from inspe_jax.sensing.ray_grid import RayGrid
from inspe_jax.sensing.rays import PinholeRays, Rays, SphericalRays

WIDEST = np.radians(220.0)  # across an image circle
SWAPPED = 0.2  # a principal point farther off the middle, in picture sizes, is looked at twice


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
    """A camera: one ray per downsampled pixel, to its effective depth.

    ``width``, ``height``, the ``focal`` length and the ``principal`` point are in pixels, and so is
    the ``focal_range`` of a varifocal lens, and ``focal_y``, down a column, where pixels are not
    square. ``downsample`` is λ: the rays are ⌊λ·height⌋ × ⌊λ·width⌋ and pass through the centres of
    the enlarged pixels. ``depth`` [m] is measured along the ray.

    Without ``distortion``, as OpenCV has it, it is a pinhole; or a ``fisheye``, equidistant but for
    its own distortion. ``image_circle`` is the angle across what a lens shows [rad], beyond which
    pictures are black; by a fisheye 180° if it is None.
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
    distortion: tuple[float, ...] | None = field(default=None, metadata=OPTIONAL)
    fisheye: bool | None = field(default=None, metadata=OPTIONAL)
    image_circle: float | None = field(default=None, metadata=OPTIONAL)

    kind = "camera"
    title = "camera"
    reach_field = "depth"
    aimed = True
    pitch_limits_deg = (-80.0, 10.0)
    candidate_pitches_deg = (-25.0, -10.0)
    pixels_per_metre: ClassVar[float] = 25.0
    """At its depth where none is given: enough to detect by EN 62676-4:2015."""

    @classmethod
    def usual_depth(cls, focal: float) -> float:
        """How far a focal length [px] gives ``pixels_per_metre`` [m], to 0.1 m."""
        return max(round(focal / cls.pixels_per_metre, 1), 0.1)

    def __post_init__(self) -> None:
        """A range is rounded, so that it is the same when it is read from a file. Raises InspeError
        where it does not ascend, or the focal length is outside of it; where a lens is not known,
        folds the picture, or has no such image circle."""
        if self.focal_y == self.focal:
            object.__setattr__(self, "focal_y", None)
        if self.focal_range is not None:
            low, high = (round(float(focal), 6) for focal in self.focal_range)
            object.__setattr__(self, "focal_range", (low, high))
            if not (0 < low < high and low - 1e-5 <= self.focal <= high + 1e-5):
                raise InspeError(
                    f"device '{self.name}': focal_range must ascend about the focal length, but is "
                    f"{low:g} to {high:g} about {self.focal:g} px"
                )
        if self.image_circle is not None and not 0 < self.image_circle <= WIDEST + 1e-9:
            raise InspeError(
                f"device '{self.name}': image_circle_deg: must be above 0 and at most "
                f"{np.degrees(WIDEST):g}, got {np.degrees(self.image_circle):g}"
            )
        if self.bends:
            with error_at(f"device '{self.name}'"):
                if self.focal_range is not None:
                    raise InspeError(
                        "a varifocal lens is a pinhole: distortion is that of one focal length, so "
                        "give focal_px with it"
                    )
                self._lens_table  # noqa: B018

    @classmethod
    def from_intrinsics(
        cls,
        name: str,
        width: int,
        height: int,
        *,
        depth: float | None = None,
        fx: float | None = None,
        fy: float | None = None,
        hfov_deg: float | None = None,
        vfov_deg: float | None = None,
        cx: float | None = None,
        cy: float | None = None,
        downsample: float = 0.1,
        reliability: float = 1.0,
        distortion: Any = (),
        fisheye: bool = False,
        image_circle_deg: float | None = None,
    ) -> Self:
        """A camera from its calibration: focal lengths, or fields of view.

        Args:
            name: Name of the device.
            width, height: Size of the picture [px].
            depth: How far it perceives along a ray [m], which no calibration says; if not given,
                where there are ``pixels_per_metre``: 25, of a thermal camera 8.
            fx, fy: Focal lengths [px]; one of them is both.
            hfov_deg, vfov_deg: Fields of view [degrees] in place of fx and fy; one of them is
                enough where pixels are square. Of what a lens with distortion, or a fisheye, shows.
            cx, cy: Principal point [px] from the outer corner of the first pixel; the middle of the
                picture if not given.
            downsample: Rays per pixel, along a row.
            reliability: The chance that what is in view is perceived.
            distortion: OpenCV's k1, k2, p1, p2, k3, k4, k5, k6; of a fisheye k1 … k4.
            fisheye: Whether the lens is equidistant.
            image_circle_deg: Angle across what the lens shows at all [degrees]; of a fisheye 180,
                or the field of view if that is wider, if not given.

        Raises:
            InspeError: Neither or both of focal length and field of view are given, the principal
                point is outside of the picture, as where width and height are swapped, or the lens
                is not known or folds the picture.

        >>> spec = inspe_jax.CameraSpec.from_intrinsics("roof", 1920, 1080, hfov_deg=90)
        >>> round(spec.focal), round(spec.depth, 1)
        (960, 38.4)
        """
        where = f"device '{name}'"
        if ((fx or fy) is None) == ((hfov_deg or vfov_deg) is None):
            raise InspeError(f"{where}: give either fx and fy, or a field of view")
        cx, cy = width / 2 if cx is None else cx, height / 2 if cy is None else cy
        circle = image_circle_deg
        with error_at(f"{where}: distortion"):
            bent = distortion_of(distortion)
        given, unit = [fx, fy], Lens(1.0, 1.0, 0.0, 0.0, bent, fisheye)
        widest = np.degrees(WIDEST) if fisheye else np.nextafter(180.0, 0.0)
        for k, (side, view) in enumerate(((width, hfov_deg), (height, vfov_deg))):
            if view is not None:
                with error_at(where):
                    given[k] = focal_of(side, view, unit, k) if 0 < view <= widest else np.nan
                if view > 180 and image_circle_deg is None:
                    circle = max(circle or 0.0, view)
        x, y = (float(given[k] or given[1 - k] or 0.0) for k in (0, 1))
        depth = cls.usual_depth(x) if depth is None and np.isfinite(x) else depth
        numbers = np.array([width, height, x, y, depth, downsample, cx, cy], float)
        if not (np.isfinite(numbers).all() and (numbers[:6] > 0).all()):
            raise InspeError(
                f"{where}: its numbers must be positive, a field of view below 180°, or of a "
                f"fisheye at most {np.degrees(WIDEST):g}°"
            )
        off, swapped = (abs(cx / w - 0.5) + abs(cy / h - 0.5) for w, h in
                        ((width, height), (height, width)))  # fmt: skip
        words = f"{where}: principal point ({cx:g}, {cy:g}) in a picture of {width} × {height}"
        if off > SWAPPED and swapped < off / 2:
            raise InspeError(f"{words}: width and height seem to be swapped")
        if not (0 <= cx <= width and 0 <= cy <= height):
            raise InspeError(f"{words} is outside of it: give the size that the lens was found for")
        other: dict[str, Any] = dict(reliability=reliability, focal_y=y)
        other |= dict(distortion=bent or None, fisheye=fisheye or None)
        other |= dict(image_circle=None if circle is None else float(np.radians(circle)))
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
        of: type[Rays] = FisheyeRays if self.fisheye else DistortedRays
        lens = self._lens_table if self.bends else ()
        of = of if self.bends else PinholeRays
        return RayGrid(tangents, leftmost, pitch, columns, False, self.depth, of, lens)

    @property
    def optics(self) -> Lens:
        """Its lens."""
        (fx, fy), (cx, cy) = self.focals, self.principal
        return Lens(fx, fy, cx, cy, self.distortion or (), bool(self.fisheye), self.image_circle)

    @property
    def bends(self) -> bool:
        """Whether its lens is another than a pinhole that shows all of the picture."""
        return bool(self.fisheye or self.image_circle or any(self.distortion or ()))

    @cached_property
    def _lens_table(self) -> tuple[float, ...]:
        return self.optics.table(self.width, self.height)

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
        """Right and left edge of what it shows, along the row of the principal point [rad]."""
        x, y, _ = self.optics.rays(self._across(0)).T
        return float(np.arctan2(y[1], x[1])), float(np.arctan2(y[0], x[0]))

    def _across(self, axis: int) -> Float[np.ndarray, "2 2"]:
        """The ends of the row (0) or the column (1) through the principal point [px]."""
        ends = np.array([self.principal, self.principal])
        ends[:, axis] = 0, (self.width, self.height)[axis]
        return ends

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
        """Angle from edge to edge of what it shows, horizontal and vertical [rad]."""
        ends = [self.optics.rays(self._across(axis)).T for axis in (0, 1)]
        wide, tall = (np.arctan2(ends[k][k + 1], ends[k][0]) for k in (0, 1))
        return float(wide[0] - wide[1]), float(tall[0] - tall[1])


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
