"""Named devices: ``catalogue.toml``, and catalogues that users write in the same format.

Files give degrees, metres and US dollars under keys that say so; specs hold radians.
A device is its spec together with where its figures come from. The keys are described
at the head of ``catalogue.toml``.
"""

import os
import tomllib
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, Field

from inspe_jax.core.errors import InspeError, nearest
from inspe_jax.core.files import STRICT, check_input, check_model
from inspe_jax.sensing.sensors import CameraSpec, LidarSpec, Spec


@dataclass(frozen=True)
class Device:
    """One row of a catalogue: a spec, and what a buyer asks next.

    ``price_usd`` is a list price [US$] of the year in ``note``, None where none is
    public; ``source`` says where the figures come from, ``note`` what was assumed.
    """

    name: str
    kind: Literal["camera", "lidar"]
    title: str
    maker: str
    spec: Spec
    price_usd: float | None
    source: str
    note: str


def devices() -> dict[str, Device]:
    """The built-in catalogue by name, in the order of its file."""
    return dict(_built_in())


def device(name: str) -> Device:
    """A built-in device by name. Raises InspeError that names the nearest ones."""
    known = _built_in()
    if name not in known:
        hint = nearest(name, list(known))
        raise InspeError(f"no device '{name}': run 'inspe devices' for the list{hint}")
    return known[name]


def load_devices(path: str | os.PathLike[str]) -> dict[str, Device]:
    """Read a catalogue file (TOML, as ``catalogue.toml``): its devices by name.

    Raises InspeError that names the file, the device, the key and what is allowed.
    """
    path = Path(path)
    check_input(path)
    return _parse(path.read_bytes(), str(path))


@cache
def _built_in() -> dict[str, Device]:
    resource = files("inspe_jax.sensing").joinpath("catalogue.toml")
    return _parse(resource.read_bytes(), resource.name)


def _parse(content: bytes, where: str) -> dict[str, Device]:
    try:
        tables = tomllib.loads(content.decode("utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as e:
        raise InspeError(f"{where}: not TOML: {e}") from e
    if not tables:
        raise InspeError(f"{where}: the catalogue is empty: it needs one table for each device")
    return {name: _device(name, table, f"{where}: {name}") for name, table in tables.items()}


# ── The entries ─────────────────────────────────────────────────────────────

_Positive = Annotated[float, Field(gt=0)]
_Elevation = Annotated[float, Field(ge=-90, le=90)]
_Limits = Annotated[list[_Elevation], Field(min_length=2, max_length=2)]
_Text = Annotated[str, Field(min_length=1)]


class _Keys(BaseModel):
    model_config = STRICT

    kind: Literal["camera", "lidar"]
    reliability: Annotated[float, Field(ge=0, le=1)] = 1.0


class _About(BaseModel):
    title: _Text
    maker: _Text
    source: _Text
    note: str = ""
    price_usd: _Positive | None = None


class _LidarKeys(_Keys):
    range_m: _Positive
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


class _CameraKeys(_Keys):
    width: Annotated[int, Field(ge=1)]
    height: Annotated[int, Field(ge=1)]
    depth_m: _Positive
    downsample: Annotated[float, Field(gt=0, le=1)]
    hfov_deg: Annotated[float, Field(gt=0, lt=180)] | None = None
    focal_px: _Positive | None = None
    principal_px: Annotated[list[float], Field(min_length=2, max_length=2)] | None = None

    def spec(self, name: str, where: str) -> CameraSpec:
        """The spec [pixel, m]; the principal point is the middle of the image if not given."""
        if (self.hfov_deg is None) == (self.focal_px is None):
            raise InspeError(f"{where}: give either hfov_deg or focal_px")
        focal = self.focal_px
        if self.hfov_deg is not None:
            focal = float(self.width / 2 / np.tan(np.radians(self.hfov_deg) / 2))
        assert focal is not None
        cx, cy = self.principal_px or (self.width / 2, self.height / 2)
        return CameraSpec(
            name=name,
            width=self.width,
            height=self.height,
            focal=focal,
            principal=(cx, cy),
            downsample=self.downsample,
            depth=self.depth_m,
            reliability=self.reliability,
        )


class _LidarEntry(_LidarKeys, _About):
    pass


class _CameraEntry(_CameraKeys, _About):
    pass


_KEYS: dict[str, type[_LidarKeys] | type[_CameraKeys]] = dict(lidar=_LidarKeys, camera=_CameraKeys)
_ENTRIES: dict[str, type[_LidarEntry] | type[_CameraEntry]] = {
    "lidar": _LidarEntry,
    "camera": _CameraEntry,
}
_EITHER = (("hfov_deg", "focal_px"), ("elevations_deg", "elevation_range_deg"))
"""Keys of which a device has one."""


def spec_of(table: Any, name: str, where: str) -> Spec:
    """The spec of a device of one's own, in the keys of a catalogue that make a spec.

    ``like`` may name a device of the built-in catalogue whose keys it has where it gives none.
    Raises InspeError that names ``where``, the key and what is allowed.
    """
    table = _checked_kind(table, where, like=True)
    if "like" in table:
        try:
            base = table_of(device(table.pop("like")).spec)
        except InspeError as e:
            raise InspeError(f"{where}: like: {e}") from None
        for pair in _EITHER:
            if any(key in table for key in pair):
                base = {key: value for key, value in base.items() if key not in pair}
        if "elevation_range_deg" in table and "channels" not in table:
            table["channels"] = base["channels"]
        elif "elevations_deg" in table:
            base.pop("channels", None)
        table = base | table
    return check_model(_KEYS[table["kind"]], table, where).spec(name, where)


def table_of(spec: Spec) -> dict[str, Any]:
    """The keys of a catalogue that make a spec: those that :func:`spec_of` reads back.

    Python's own numbers, also where the spec was made with NumPy's.
    """
    if isinstance(spec, CameraSpec):
        return dict(
            kind="camera",
            width=spec.width,
            height=spec.height,
            focal_px=float(spec.focal),
            principal_px=[float(x) for x in spec.principal],
            downsample=float(spec.downsample),
            depth_m=float(spec.depth),
            reliability=float(spec.reliability),
        )
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


def _checked_kind(table: Any, where: str, like: bool = False) -> dict[str, Any]:
    """A device's table, of a kind that there is. Raises InspeError."""
    if not isinstance(table, dict):
        raise InspeError(f"{where}: must be a table of one device, got {table!r}")
    if like and "like" in table:
        return dict(table)
    if "kind" not in table:
        raise InspeError(f"{where}: kind: missing key")
    if table["kind"] not in ("lidar", "camera"):
        raise InspeError(f"{where}: kind: must be 'lidar' or 'camera', got {table['kind']!r}")
    return dict(table)


def _device(name: str, table: Any, where: str) -> Device:
    table = _checked_kind(table, where)
    entry = check_model(_ENTRIES[table["kind"]], table, where)
    return Device(
        name=name,
        kind=entry.kind,
        title=entry.title,
        maker=entry.maker,
        spec=entry.spec(name, where),
        price_usd=entry.price_usd,
        source=entry.source,
        note=entry.note,
    )
