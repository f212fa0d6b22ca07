"""Kinds of sensor: the keys with which a catalogue describes their devices.

A new kind is a row of :data:`SENSOR_KINDS`; scores, searches and layout files then work with it.
Light and weather take nothing from it until ``conditions.toml`` has figures for it, and a profile
does not change its reliability.
"""

from dataclasses import replace
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import BaseModel, Discriminator, Field, Tag

from inspe_jax.core.errors import InspeError, error_at
from inspe_jax.core.files import STRICT
from inspe_jax.sensing.lens import focal_of
from inspe_jax.sensing.radar import RadarSpec
from inspe_jax.sensing.sensors import CameraSpec, LidarSpec, Spec
from inspe_jax.sensing.thermal import ThermalSpec

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
    fields: ClassVar[dict[str, str]] = {}
    """Keys that are a field of the spec as they are, but for those in degrees, which it has in
    radians."""
    replaces: ClassVar[dict[str, tuple[str, ...]]] = {}
    """What a key of a device that is like another takes the place of, besides its namesake."""

    def spec(self, name: str, where: str) -> Spec:
        """The spec [rad, m] of a device. Raises InspeError that names ``where`` and the key."""
        return self.spec_type(name=name, **self._given())  # type: ignore[call-arg]

    def _given(self) -> dict[str, Any]:
        """The fields of the spec that keys name."""
        given = ((key, getattr(self, key), to) for key, to in self._all_fields().items())
        return {
            to: float(np.radians(x)) if key.endswith("_deg") and x is not None else x
            for key, x, to in given
        }

    @classmethod
    def _all_fields(cls) -> dict[str, str]:
        return cls.fields | {"reliability": "reliability"}

    @classmethod
    def table(cls, spec: Any) -> dict[str, Any]:
        """The keys of a spec of this kind, as Python's own numbers; :meth:`spec` reads them."""
        given = ((key, getattr(spec, to)) for key, to in cls._all_fields().items())
        found = {
            key: np.degrees(x).item() if key.endswith("_deg") else np.asarray(x).item()
            for key, x in given
            if x is not None
        }
        return {"kind": spec.kind, **found}


class LidarKeys(DeviceKeys):
    """A LiDAR: elevations as a table or as even steps, and a step of azimuth."""

    spec_type = LidarSpec
    fields = {"range_m": "reach", "azimuth_fov_deg": "azimuth_fov"}
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
            **self._given(),
        )

    @classmethod
    def table(cls, spec: LidarSpec) -> dict[str, Any]:
        """The keys of a LiDAR's spec."""
        fov = float(np.degrees(spec.azimuth_fov))
        return super().table(spec) | dict(
            channels=len(spec.elevations),
            elevations_deg=np.degrees(spec.elevations).round(9).tolist(),
            azimuth_step_deg=fov / spec.azimuth_count,
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

    spec_type: ClassVar[type[CameraSpec]] = CameraSpec
    fields = {
        "width": "width", "height": "height", "downsample": "downsample", "depth_m": "depth",
        "focal_px": "focal", "focal_y_px": "focal_y",
    }  # fmt: skip
    replaces = {"hfov_deg": ("focal_px", "focal_y_px"), "focal_px": ("hfov_deg", "focal_y_px")}

    width: Annotated[int, Field(ge=1)]
    height: Annotated[int, Field(ge=1)]
    depth_m: Positive | None = None  # by pixels per metre if not given
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
        fisheye, view = self.lens == "fisheye", self.hfov_deg
        lens, focal = None, self.focal_px
        if (view is None) == (focal is None):
            raise InspeError(f"{where}: give either hfov_deg or focal_px")
        if not fisheye and np.max(view or 0.0) >= 180:
            raise InspeError(f"{where}: hfov_deg: only a 'lens: fisheye' sees 180° or more")
        if self.focal_y_px is not None and self.focal_px is None:
            raise InspeError(f"{where}: focal_y_px: goes with focal_px, not with hfov_deg")
        if isinstance(view, list):
            if fisheye:
                raise InspeError(f"{where}: hfov_deg: a varifocal lens is a pinhole")
            narrow, wide = view
            if not narrow < wide:
                raise InspeError(f"{where}: hfov_deg: must ascend, but {wide:g} follows {narrow:g}")
            lens, view = (focal_of(self.width, wide), focal_of(self.width, narrow)), None
            focal = lens[0]
        with error_at(where):
            found = self.spec_type.from_intrinsics(
                name, self.width, self.height, depth=self.depth_m, downsample=self.downsample,
                fx=focal, fy=self.focal_y_px, hfov_deg=view, reliability=self.reliability,
                distortion=self.distortion, fisheye=fisheye, image_circle_deg=self.image_circle_deg,
            )  # fmt: skip
            if self.principal_px is not None:  # a part of a picture may have it outside
                cx, cy = self.principal_px
                found = replace(found, principal=(cx, cy))
            if lens is None:
                return found
            found = replace(found, focal_range=lens).with_lens(0.0)
        return replace(found, depth=self.depth_m or found.usual_depth(found.focal))

    @classmethod
    def table(cls, spec: CameraSpec) -> dict[str, Any]:
        """The keys of a camera's spec; of a varifocal lens its range, not how it is set."""
        found = super().table(spec) | dict(principal_px=[float(x) for x in spec.principal])
        if spec.depth == spec.usual_depth(spec.with_lens(0.0).focal):
            del found["depth_m"]  # so that it follows where a device is like this one
        if spec.focal_range is not None:
            del found["focal_px"]
            found["hfov_deg"] = [hfov_of(spec.width, x) for x in spec.focal_range[::-1]]
        if spec.fisheye:
            found["lens"] = "fisheye"
        if spec.distortion:
            found["distortion"] = [float(k) for k in spec.distortion]
        if spec.image_circle:
            found["image_circle_deg"] = round(float(np.degrees(spec.image_circle)), 12)
        return found


class ThermalKeys(CameraKeys):
    """A thermal camera: the keys of a camera."""

    spec_type = ThermalSpec


class RadarKeys(DeviceKeys):
    """A radar: its field of view, its range on a car, and what it tells apart."""

    spec_type = RadarSpec
    fields = {
        "range_m": "reach", "azimuth_fov_deg": "azimuth_fov", "elevation_fov_deg": "elevation_fov",
        "range_resolution_m": "range_resolution", "azimuth_resolution_deg": "azimuth_resolution",
        "speed_resolution_mps": "speed_resolution", "min_speed_mps": "min_speed",
    }  # fmt: skip

    range_m: Positive
    azimuth_fov_deg: Annotated[float, Field(gt=0, le=360)]
    elevation_fov_deg: Annotated[float, Field(gt=0, lt=180)]
    range_resolution_m: Positive
    azimuth_resolution_deg: Positive
    speed_resolution_mps: Positive
    min_speed_mps: Annotated[float, Field(ge=0)] | None = None

    def _given(self) -> dict[str, Any]:
        """The least radial speed is the resolution of speed if not given."""
        found = super()._given()
        least = found["min_speed"]
        least = found["speed_resolution"] if least is None else least
        return found | dict(min_speed=least)


def hfov_of(width: int, focal: float) -> float:
    """The inverse: how wide a picture is [degrees]."""
    return float(np.degrees(2 * np.arctan(width / 2 / focal)))


SENSOR_KINDS: dict[str, type[DeviceKeys]] = {
    keys.spec_type.kind: keys for keys in (LidarKeys, CameraKeys, RadarKeys, ThermalKeys)
}
"""Every kind of sensor by name."""
