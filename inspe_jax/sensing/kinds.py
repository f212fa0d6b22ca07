"""Kinds of sensor: the keys with which a catalogue describes their devices.

A new kind is a row of :data:`SENSOR_KINDS`; scores, searches and layout files then work with it.
Light and weather take nothing from it until ``conditions.toml`` has figures for it, and a profile
does not change its reliability.
"""

from itertools import pairwise
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import BaseModel, Discriminator, Field, Tag

from inspe_jax.core.errors import InspeError, error_at
from inspe_jax.core.files import STRICT
from inspe_jax.sensing.lens import Lens, focal_of
from inspe_jax.sensing.radar import RadarSpec
from inspe_jax.sensing.sensors import CameraSpec, LidarSpec, Spec

Positive = Annotated[float, Field(gt=0)]
_Elevation = Annotated[float, Field(ge=-90, le=90)]
_View = Annotated[float, Field(gt=0, le=220)]
_Views = Annotated[
    Annotated[_View, Tag("")] | Annotated[list[_View], Field(min_length=2, max_length=2), Tag(" ")],
    Discriminator(lambda given: " " if isinstance(given, list) else ""),
]
"""A field of view, or the range of a varifocal lens. The tags are blank, and not in messages."""
_Limits = Annotated[list[_Elevation], Field(min_length=2, max_length=2)]


class DeviceKeys(BaseModel, **STRICT):
    """The keys of a catalogue that make a spec: those that every kind has."""

    kind: str
    reliability: Annotated[float, Field(ge=0, le=1)] = 1.0

    spec_type: ClassVar[type[Spec]]  # what they make
    replaces: ClassVar[dict[str, tuple[str, ...]]] = {}
    """What a key of a device that is like another takes the place of, besides its namesake."""

    def spec(self, name: str, where: str) -> Spec:
        """The spec [rad, m] of a device. Raises InspeError that names ``where`` and the key."""
        raise NotImplementedError

    @classmethod
    def table(cls, spec: Any) -> dict[str, Any]:
        """The keys of a spec of this kind, as Python's own numbers; :meth:`spec` reads them."""
        raise NotImplementedError


class LidarKeys(DeviceKeys):
    """A LiDAR: elevations as a table or as even steps, and a step of azimuth."""

    spec_type = LidarSpec
    replaces = {
        "elevations_deg": ("elevation_range_deg", "channels"),
        "elevation_range_deg": ("elevations_deg",),
    }

    range_m: Positive
    azimuth_step_deg: Annotated[float, Field(ge=0.001, le=360)]
    azimuth_fov_deg: Annotated[float, Field(gt=0, le=360)] = 360.0
    channels: Annotated[int, Field(ge=1, le=10_000)] | None = None
    elevations_deg: Annotated[list[_Elevation], Field(min_length=1)] | None = None
    elevation_range_deg: _Limits | None = None

    def spec(self, name: str, where: str) -> LidarSpec:
        """The spec [rad, m]; the azimuth count is the nearest to field of view over step."""
        elevations = self._elevations(where)
        if self.azimuth_step_deg > self.azimuth_fov_deg:
            raise InspeError(
                f"{where}: azimuth_step_deg: {self.azimuth_step_deg:g} is wider than "
                f"azimuth_fov_deg, {self.azimuth_fov_deg:g}"
            )
        return LidarSpec(
            name=name,
            elevations=tuple(np.radians(elevations).tolist()),
            azimuth_count=round(self.azimuth_fov_deg / self.azimuth_step_deg),
            azimuth_fov=float(np.radians(self.azimuth_fov_deg)),
            reach=self.range_m,
            reliability=self.reliability,
        )

    @classmethod
    def table(cls, spec: LidarSpec) -> dict[str, Any]:
        """The keys of a LiDAR's spec."""
        fov = float(np.degrees(spec.azimuth_fov))
        return dict(
            kind="lidar",
            channels=len(spec.elevations),
            elevations_deg=np.degrees(spec.elevations).round(9).tolist(),
            azimuth_fov_deg=fov,
            azimuth_step_deg=fov / spec.azimuth_count,
            range_m=float(spec.reach),
            reliability=float(spec.reliability),
        )

    def _elevations(self, where: str) -> list[float]:
        """Degrees, strictly ascending: the table, or even steps over the range."""
        key, table = "elevations_deg", self.elevations_deg
        if (table is None) == (self.elevation_range_deg is None):
            raise InspeError(f"{where}: give either elevations_deg or elevation_range_deg")
        if table is None:
            assert self.elevation_range_deg is not None
            if self.channels is None or self.channels < 2:
                raise InspeError(
                    f"{where}: channels: elevation_range_deg needs 2 or more, got {self.channels}"
                )
            key, (low, high) = "elevation_range_deg", self.elevation_range_deg
            table = np.linspace(low, high, self.channels).tolist()
        elif self.channels not in (None, len(table)):
            raise InspeError(
                f"{where}: channels: {self.channels}, but elevations_deg has {len(table)} entries"
            )
        for below, above in pairwise(table):
            if above <= below:
                raise InspeError(
                    f"{where}: {key}: must ascend strictly, but {above:g} follows {below:g}"
                )
        return table


class CameraKeys(DeviceKeys):
    """A camera: its picture, its focal length or field of view, or the range of a varifocal lens,
    how its lens bends lines, and its effective depth."""

    spec_type = CameraSpec
    replaces = {"hfov_deg": ("focal_px", "focal_y_px"), "focal_px": ("hfov_deg", "focal_y_px")}

    width: Annotated[int, Field(ge=1)]
    height: Annotated[int, Field(ge=1)]
    depth_m: Positive
    downsample: Annotated[float, Field(gt=0, le=1)]
    hfov_deg: _Views | None = None
    focal_px: Positive | None = None
    focal_y_px: Positive | None = None  # where pixels are not square
    principal_px: Annotated[list[float], Field(min_length=2, max_length=2)] | None = None
    lens: Literal["pinhole", "fisheye"] = "pinhole"
    distortion: Annotated[list[float], Field(max_length=8)] = []  # as OpenCV has it
    image_circle_deg: Annotated[float, Field(gt=0, le=220)] | None = None

    def spec(self, name: str, where: str) -> CameraSpec:
        """The spec [pixel, m]; the principal point is the middle of the image if not given."""
        fisheye, bent = self.lens == "fisheye", tuple(self.distortion)
        if (self.hfov_deg is None) == (self.focal_px is None):
            raise InspeError(f"{where}: give either hfov_deg or focal_px")
        if not fisheye and np.max(self.hfov_deg or 0.0) >= 180:
            raise InspeError(f"{where}: hfov_deg: only a 'lens: fisheye' sees 180° or more")
        if self.focal_y_px is not None and self.focal_px is None:
            raise InspeError(f"{where}: focal_y_px: goes with focal_px, not with hfov_deg")
        focal, lens = self.focal_px, None
        if isinstance(self.hfov_deg, list):
            narrow, wide = self.hfov_deg
            if not narrow < wide:
                raise InspeError(f"{where}: hfov_deg: must ascend, but {wide:g} follows {narrow:g}")
            lens = focal_of(self.width, wide), focal_of(self.width, narrow)
            focal = lens[0]  # set to the usual one below
        elif self.hfov_deg is not None:
            focal = focal_of(self.width, self.hfov_deg, Lens(1.0, 1.0, 0.0, 0.0, bent, fisheye))
        assert focal is not None
        cx, cy = self.principal_px or (self.width / 2, self.height / 2)
        same = self.model_dump(include={"width", "height", "downsample", "reliability"})
        same |= dict(depth=self.depth_m, focal_range=lens, focal_y=self.focal_y_px)
        same |= dict(distortion=bent or None, fisheye=fisheye or None)
        circle = self.image_circle_deg
        if circle is None and np.max(self.hfov_deg or 0.0) > 180:  # else a fisheye's is 180°
            circle = float(np.max(self.hfov_deg or 0.0))
        if circle is not None:
            same |= dict(image_circle=float(np.radians(circle)))
        with error_at(where):
            return CameraSpec(name, focal=focal, principal=(cx, cy), **same).with_lens(0.0)

    @classmethod
    def table(cls, spec: CameraSpec) -> dict[str, Any]:
        """The keys of a camera's spec; of a varifocal lens its range, not how it is set."""
        circle = round(float(np.degrees(spec.image_circle or 0.0)), 12)
        lens: dict[str, Any] = dict(focal_px=float(spec.focal))
        if spec.focal_range is not None:
            lens = dict(hfov_deg=[hfov_of(spec.width, x) for x in spec.focal_range[::-1]])
        return dict(
            kind="camera",
            width=int(spec.width),
            height=int(spec.height),
            **lens,
            **({"focal_y_px": float(spec.focal_y)} if spec.focal_y else {}),
            **({"lens": "fisheye"} if spec.fisheye else {}),
            **({"distortion": [float(k) for k in spec.distortion]} if spec.distortion else {}),
            **({"image_circle_deg": circle} if circle else {}),
            principal_px=[float(x) for x in spec.principal],
            downsample=float(spec.downsample),
            depth_m=float(spec.depth),
            reliability=float(spec.reliability),
        )


class RadarKeys(DeviceKeys):
    """A radar: its field of view, its range on a car, and what it tells apart."""

    spec_type = RadarSpec

    range_m: Positive
    azimuth_fov_deg: Annotated[float, Field(gt=0, le=360)]
    elevation_fov_deg: Annotated[float, Field(gt=0, lt=180)]
    range_resolution_m: Positive
    azimuth_resolution_deg: Positive
    speed_resolution_mps: Positive
    min_speed_mps: Annotated[float, Field(ge=0)] | None = None

    def spec(self, name: str, where: str) -> RadarSpec:
        """The spec [rad, m, m/s]; the least radial speed is the resolution of speed if not
        given."""
        least = self.min_speed_mps
        return RadarSpec(
            name=name,
            reach=self.range_m,
            azimuth_fov=float(np.radians(self.azimuth_fov_deg)),
            elevation_fov=float(np.radians(self.elevation_fov_deg)),
            range_resolution=self.range_resolution_m,
            azimuth_resolution=float(np.radians(self.azimuth_resolution_deg)),
            speed_resolution=self.speed_resolution_mps,
            min_speed=self.speed_resolution_mps if least is None else least,
            reliability=self.reliability,
        )

    @classmethod
    def table(cls, spec: RadarSpec) -> dict[str, Any]:
        """The keys of a radar's spec."""
        return dict(
            kind="radar",
            range_m=float(spec.reach),
            azimuth_fov_deg=float(np.degrees(spec.azimuth_fov)),
            elevation_fov_deg=float(np.degrees(spec.elevation_fov)),
            range_resolution_m=float(spec.range_resolution),
            azimuth_resolution_deg=float(np.degrees(spec.azimuth_resolution)),
            speed_resolution_mps=float(spec.speed_resolution),
            min_speed_mps=float(spec.min_speed),
            reliability=float(spec.reliability),
        )


def hfov_of(width: int, focal: float) -> float:
    """The inverse: how wide a picture is [degrees]."""
    return float(np.degrees(2 * np.arctan(width / 2 / focal)))


SENSOR_KINDS: dict[str, type[DeviceKeys]] = {
    keys.spec_type.kind: keys for keys in (LidarKeys, CameraKeys, RadarKeys)
}
"""Every kind of sensor by name."""
