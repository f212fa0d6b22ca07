"""Where a place lies on the Earth: longitudes, latitudes and azimuths of its world metres."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from inspe_jax.core.errors import InspeError, error_at, needs

LOCAL = 0.5  # directions are those of a line of twice this length [m]
MADE_UP = 1.0  # nearer to 0° N 0° E is sea [degrees]: origin of projections without a true one
WGS84 = "EPSG:4326"  # longitude and latitude as GNSS receivers, GeoJSON and KML have them


@dataclass(frozen=True)
class Georeference:
    """The projection of a map's coordinates.

    ``crs`` is a code such as ``EPSG:25832`` or a PROJ string. ``shift`` (x, y) [m] is what world
    coordinates are larger by than those of the projection.
    """

    crs: str
    shift: tuple[float, float] = (0.0, 0.0)

    def check(self) -> None:
        """Raise InspeError where pyproj is missing, or PROJ does not know the projection."""
        self._to_world  # noqa: B018  # which makes it

    @cached_property
    def _to_world(self) -> Any:
        """PROJ's conversion of longitudes and latitudes to the projection's metres."""
        pyproj = _pyproj()
        wrong = f"'{self.crs}' is no projection that PROJ knows"
        with error_at(wrong, pyproj.exceptions.ProjError):
            system = pyproj.CRS.from_user_input(self.crs)
            if not system.is_projected:
                raise InspeError(f"'{self.crs}' has no metres: name a projection")
            return pyproj.Transformer.from_crs(WGS84, system.to_2d(), always_xy=True)

    def to_degrees(self, points: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2"]:
        """Longitudes and latitudes [degrees] of world coordinates [m]. Raises as :meth:`check`.

        >>> munich = inspe_jax.Georeference("EPSG:25832")
        >>> munich.to_degrees(np.array([[691600.0, 5334760.0]])).round(3).tolist()
        [[11.575, 48.137]]
        """
        at = np.asarray(points, float) - self.shift
        return np.column_stack(self._to_world.transform(*at.T, direction="INVERSE"))

    def from_degrees(self, degrees: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2"]:
        """World coordinates [m] of longitudes and latitudes [degrees], infinite where the
        projection has no place. Raises as :meth:`check`."""
        return np.column_stack(self._to_world.transform(*np.asarray(degrees, float).T)) + self.shift

    def words(self, point: Float[np.ndarray, "2"] | tuple[float, ...]) -> str:
        """Latitude and longitude of a point [m], as ``48.137000, 11.575000``."""
        lon, lat = self.to_degrees(np.asarray(point, float)[None, :2])[0]
        return f"{lat:.6f}, {lon:.6f}"

    def doubt(self, point: Float[np.ndarray, "2"] | tuple[float, ...]) -> str:
        """A warning where a point [m] is in the sea at 0° N 0° E; empty elsewhere."""
        if not np.abs(self.to_degrees(np.asarray(point, float)[None, :2])).max() < MADE_UP:
            return ""
        return (
            f"coordinates are in the sea, at {self.words(point)} (latitude, longitude): the map's "
            f"projection '{self.crs}' begins at 0° N 0° E, which is no true place; give the map "
            "its own before its coordinates are used on the Earth"
        )

    def azimuth(
        self, points: Float[np.ndarray, "N 2"], yaw: Float[np.ndarray, " N"]
    ) -> Float[np.ndarray, " N"]:
        """Directions [degrees clockwise from true north, 0 … 360] of yaws [rad] at points [m]."""
        along = LOCAL * np.column_stack([np.cos(yaw), np.sin(yaw)])
        start, end = (self.to_degrees(points + sign * along) for sign in (-1, 1))
        return np.asarray(_pyproj().Geod(ellps="WGS84").inv(*start.T, *end.T)[0]) % 360

    def yaw(
        self, points: Float[np.ndarray, "N 2"], azimuth: Float[np.ndarray, " N"]
    ) -> Float[np.ndarray, " N"]:
        """Yaws [rad] at points [m] of directions [degrees clockwise from true north]."""
        at, apart = self.to_degrees(points), np.full(len(points), LOCAL)
        forward = _pyproj().Geod(ellps="WGS84").fwd
        ends = [forward(*at.T, azimuth + turn, apart)[:2] for turn in (180.0, 0.0)]
        start, end = (self.from_degrees(np.column_stack(one)) for one in ends)
        return np.arctan2(*(end - start).T[::-1])


def about(lat: float | str, lon: float | str) -> Georeference:
    """The transverse Mercator of true scale about a place [degrees]: x is east, y true north."""
    return Georeference(f"+proj=tmerc +lat_0={lat} +lon_0={lon} +ellps=WGS84 +units=m")


def wgs84(
    system: str, points: Float[np.ndarray, "N 2"], *, back: bool = False
) -> Float[np.ndarray, "N 2"]:
    """Longitudes and latitudes [degrees] of points of a coordinate system, x or longitude first; or
    ``back``. Raises InspeError where PROJ does not know it."""
    if system.endswith(("CRS84", ":4326")):
        return np.asarray(points, float)
    pyproj = _pyproj()
    wrong = f"'{system}' is no coordinate system that PROJ knows"
    with error_at(wrong, pyproj.exceptions.ProjError):
        known = pyproj.CRS.from_user_input(system).to_2d()
        there = pyproj.Transformer.from_crs(known, WGS84, always_xy=True)
    way = "INVERSE" if back else "FORWARD"
    return np.column_stack(there.transform(*np.asarray(points, float).T, direction=way))


def of_open_drive(text: str, shift: tuple[float, float] = (0.0, 0.0)) -> Georeference | None:
    """The projection that an OpenDRIVE ``<geoReference>`` names, None for an empty one. Where it
    names none, as in CARLA's maps, it is the transverse Mercator of true scale about ``+lat_0``,
    ``+lon_0``."""
    words = dict(part.lstrip("+").partition("=")[::2] for part in text.split())
    words.pop("geoidgrids", None)  # for heights, and often a file that is not there
    if not words:
        return None
    if "proj" not in words and "lat_0" not in words:  # a code, or well-known text
        return Georeference(text.strip(), shift)
    words = {"proj": "tmerc"} | words
    crs = " ".join(f"+{key}={value}" if value else f"+{key}" for key, value in words.items())
    return Georeference(crs, shift)


def _pyproj() -> Any:
    with needs("coordinates need pyproj", "geo"):
        import pyproj
    return pyproj
