"""A frame of a data set: the road users as boxes, and stations with images and scans, in the world
frame (ENU), in metres and radians. A pose is (x, y, z, roll, pitch, yaw)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from jaxtyping import Float, Int, UInt8

from inspe_jax.core.errors import InspeError, check_known
from inspe_jax.core.records import check_record, check_values
from inspe_jax.scene.traffic.frames import CLASSES

Pose6 = Float[np.ndarray, "6"]
Picture = UInt8[np.ndarray, "H W 3"]

KINDS = CLASSES  # kinds of :class:`RoadUserBox`

MOST_TRACK = 2**16 - 2  # the largest track: ``track + 1`` must fit into a 16-bit picture

LEAST_SIZE = 1e-3  # the smallest length, width or height of a box [m]

MOST_FRAME = 999_999
"""The largest number of a frame: file names have six digits, and are sorted as text."""


class Deferred:
    """A record that reads some of its fields from files, each when it is first used."""

    @classmethod
    def deferred(cls, later: Mapping[str, Callable[[], Any]], **now: Any) -> Self:
        """A record with the fields ``now``; ``later[name]()`` reads each of the others."""
        record = object.__new__(cls)
        record.__dict__.update(now, _later=dict(later))
        return record

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            later = self.__dict__.get("_later", {})
            if name not in later:
                raise AttributeError(f"{type(self).__name__} has no '{name}'")
            value = self.__dict__[name] = later[name]()
            return value


@dataclass(frozen=True, eq=False)
class RoadUserBox:
    """The upright box of a road user: ``track`` identifies it in all frames, ``center`` is its
    middle, ``size`` length, width and height [m], ``velocity`` in m/s; ``kind`` is one of
    :data:`KINDS`, ``name`` a blueprint's such as ``vehicle.audi.tt``. Lights of ``parked`` ones are
    off."""

    track: int
    kind: str
    name: str
    center: Float[np.ndarray, "3"]
    yaw: float
    size: Float[np.ndarray, "3"]
    velocity: Float[np.ndarray, "3"]
    parked: bool = False

    def _check(self, prefix: str) -> None:
        check_known(self.kind, KINDS, f"{prefix}kind")
        check_values(self.track, f"{prefix}track", 0, MOST_TRACK)
        check_values(self.size, f"{prefix}size", LEAST_SIZE)


Boxes = tuple[RoadUserBox, ...]


@dataclass(frozen=True, eq=False)
class Image(Deferred):
    """A camera's picture, with its calibration in pixels, and layers, each of which may be None:
    ``depth`` along the axis [m], infinite where nothing was hit; ``instance``, track + 1 or 0;
    ``semantic`` labels. Of each of B road users, ``pixels`` show it, which is a ``share`` (0…1) of
    those that would if nothing stood before it; None: not counted."""

    pose: Pose6
    intrinsic: Float[np.ndarray, "3 3"]
    rgb: Picture = field(repr=False)
    # None by a factory is no attribute of the class, which a deferred field would find.
    depth: np.ndarray | None = field(default_factory=lambda: None, repr=False)
    instance: Int[np.ndarray, "H W"] | None = field(default_factory=lambda: None, repr=False)
    semantic: UInt8[np.ndarray, "H W"] | None = field(default_factory=lambda: None, repr=False)
    pixels: Int[np.ndarray, " B"] | None = field(default=None, repr=False)
    share: Float[np.ndarray, " B"] | None = field(default=None, repr=False)

    def _check(self, prefix: str) -> None:
        if self.depth is not None and self.depth.shape != self.rgb.shape[:2]:
            expected = f"{self.rgb.shape[:2]}, as rgb"
            raise InspeError(f"{prefix}depth: shape {self.depth.shape}, expected {expected}")
        if self.depth is not None and not (self.depth >= 0).all():  # also false for NaN
            raise InspeError(f"{prefix}depth: below 0 or no number")
        if self.instance is not None:
            check_values(self.instance, f"{prefix}instance", 0, MOST_TRACK + 1)


@dataclass(frozen=True, eq=False)
class Scan(Deferred):
    """Points of a LiDAR or a radar: x, y, z in its body frame (x forward, y left, z up) [m],
    intensity 0…1. ``returns`` of each of B road users, None: not counted; ``speeds`` are a radar's
    radial speeds [m/s], positive away from it."""

    pose: Pose6
    points: Float[np.ndarray, "N 4"] = field(repr=False)
    returns: Int[np.ndarray, " B"] | None = field(default=None, repr=False)
    speeds: Float[np.ndarray, " N"] | None = field(default=None, repr=False)

    def _check(self, prefix: str) -> None:
        check_values(self.points[:, 3], f"{prefix}points: intensity", 0, 1)


@dataclass(frozen=True, eq=False)
class Station:
    """An infrastructure unit, whose agent is −``number``, and what its sensors recorded."""

    number: int
    name: str
    pose: Pose6
    images: tuple[Image, ...]
    scans: tuple[Scan, ...]


@dataclass(frozen=True, eq=False)
class Frame:
    """One moment [s] of a scenario: the box of every road user, and what every station recorded."""

    number: int
    time: float
    boxes: Boxes
    stations: tuple[Station, ...]

    def _check(self, prefix: str) -> None:
        check_values(self.number, f"{prefix}number", 0, MOST_FRAME)
        numbers = [station.number for station in self.stations]
        for what, own in (("track", [box.track for box in self.boxes]), ("station", numbers)):
            for number in own:
                if own.count(number) > 1:
                    raise InspeError(f"{prefix}{what} {number} is given twice")
        for s, station in enumerate(self.stations):
            check_values(station.number, f"{prefix}stations[{s}].number", 1)
            for name in ("images", "scans"):
                for k, record in enumerate(getattr(station, name)):
                    _check_counts(record, len(self.boxes), f"{prefix}stations[{s}].{name}[{k}]")


def check_frame(frame: Frame) -> None:
    """Raise InspeError where a value of a frame is not valid. This reads all deferred fields."""
    check_record(frame, f"frame {frame.number}")


def _check_counts(record: Image | Scan, road_users: int, where: str) -> None:
    for name in ("returns", "pixels", "share"):
        counts = getattr(record, name, None)
        if counts is not None and len(counts) != road_users:
            raise InspeError(f"{where}.{name}: {len(counts)} values, for {road_users} road users")
