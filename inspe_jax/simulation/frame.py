"""A frame of a data set: the road users as boxes, and stations with images and LiDAR scans, in the
world frame (ENU), in metres and radians. A pose is (x, y, z, roll, pitch, yaw)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from jaxtyping import Float, Int, UInt8

from inspe_jax.core.errors import InspeError, check_known
from inspe_jax.scene.traffic.frames import CLASSES

Pose6 = Float[np.ndarray, "6"]
Picture = UInt8[np.ndarray, "H W 3"]

KINDS = CLASSES
"""Kinds of :class:`RoadUserBox`."""

MOST_TRACK = 2**16 - 2
"""The largest track: ``track + 1`` must fit into a 16-bit picture."""

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
    """The box of a road user, which stands upright.

    ``track`` identifies the road user in all frames of a scenario. ``center`` is the middle of the
    box [m]; ``size`` is length, width and height [m]; ``velocity`` is in m/s. ``kind`` is one of
    :data:`KINDS`, ``name`` a blueprint's such as ``vehicle.audi.tt``. The lights of one that is
    ``parked`` are off.
    """

    track: int
    kind: str
    name: str
    center: Float[np.ndarray, "3"]
    yaw: float
    size: Float[np.ndarray, "3"]
    velocity: Float[np.ndarray, "3"]
    parked: bool = False


Boxes = tuple[RoadUserBox, ...]


@dataclass(frozen=True, eq=False)
class Image(Deferred):
    """A camera's picture, and what each pixel of it shows.

    ``intrinsic`` is the calibration in pixels. ``depth`` is measured along the camera's axis [m],
    and infinite where nothing was hit; ``instance`` is track + 1, and 0 where there is no road
    user; ``semantic`` is a label. Each of these three may be None.

    ``pixels`` is the number of pixels that show each of the frame's B road users, ``share`` their
    share (0…1) of those that would show it if nothing stood before it; None: not counted.
    """

    pose: Pose6
    intrinsic: Float[np.ndarray, "3 3"]
    rgb: Picture = field(repr=False)
    # None by a factory is no attribute of the class, which a deferred field would find.
    depth: Float[np.ndarray, "H W"] | None = field(default_factory=lambda: None, repr=False)
    instance: Int[np.ndarray, "H W"] | None = field(default_factory=lambda: None, repr=False)
    semantic: UInt8[np.ndarray, "H W"] | None = field(default_factory=lambda: None, repr=False)
    pixels: Int[np.ndarray, " B"] | None = field(default=None, repr=False)
    share: Float[np.ndarray, " B"] | None = field(default=None, repr=False)


@dataclass(frozen=True, eq=False)
class Scan(Deferred):
    """The points of a LiDAR: x, y, z in its body frame (x forward, y left, z up) [m], intensity
    0…1. ``returns`` is how many are of each of the frame's B road users; None: not counted."""

    pose: Pose6
    points: Float[np.ndarray, "N 4"] = field(repr=False)
    returns: Int[np.ndarray, " B"] | None = field(default=None, repr=False)


@dataclass(frozen=True, eq=False)
class Station:
    """An infrastructure unit and what its sensors recorded. ``number`` n ≥ 1 is the agent −n; an
    agent of other people's data sets that is the vehicle n has the number −n."""

    number: int
    name: str
    pose: Pose6
    images: tuple[Image, ...]
    scans: tuple[Scan, ...]


@dataclass(frozen=True, eq=False)
class Frame:
    """One moment of a scenario: the box of every road user, and what every station recorded.
    ``number`` counts the frames of the scenario; ``time`` is in seconds."""

    number: int
    time: float
    boxes: Boxes
    stations: tuple[Station, ...]


def check_frame(frame: Frame) -> None:
    """Raise InspeError where a value of a frame is not valid. This reads all deferred fields."""
    where = f"frame {frame.number}"
    _whole_number(frame.number, 0, MOST_FRAME, "frame")
    tracks = [box.track for box in frame.boxes]
    numbers = [station.number for station in frame.stations]
    for what, own, least, most in (("track", tracks, 0, MOST_TRACK), ("station", numbers, 1, None)):
        for number in own:
            _whole_number(number, least, most, f"{where}: {what}")
            if own.count(number) > 1:
                raise InspeError(f"{where}: {what} {number} is given twice")
    for box in frame.boxes:
        here = f"{where}: track {box.track}"
        check_known(box.kind, KINDS, f"{here}: kind")
        for key, shape in (("center", (3,)), ("size", (3,)), ("velocity", (3,)), ("yaw", ())):
            _numbers(getattr(box, key), shape, f"{here}: {key}")
        if not np.all(np.asarray(box.size) > 0):
            raise InspeError(f"{here}: size {np.asarray(box.size).tolist()} is not above 0")
    for station in frame.stations:
        here = f"{where}: station {station.number}"
        _numbers(station.pose, (6,), f"{here}: pose")
        for i, image in enumerate(station.images):
            _check_image(image, len(tracks), f"{here}: image {i}")
        for i, scan in enumerate(station.scans):
            _check_scan(scan, len(tracks), f"{here}: scan {i}")


_LAYERS: tuple[tuple[str, str, str, float, float], ...] = (
    ("depth", "f", "floats", 0.0, np.inf),
    ("instance", "iu", "integers", 0, MOST_TRACK + 1),
    ("semantic", "u", "unsigned integers", 0, 255),
)
"""Each layer's kinds of numbers, in NumPy's letters and in words, and the least and the most."""


def _check_image(image: Image, road_users: int, where: str) -> None:
    _numbers(image.pose, (6,), f"{where}: pose")
    _numbers(image.intrinsic, (3, 3), f"{where}: intrinsic")
    rgb = np.asarray(image.rgb)
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8 or not rgb.size:
        given = f"{rgb.dtype} {rgb.shape}"
        raise InspeError(f"{where}: rgb must be uint8 (height, width, 3), got {given}")
    for key, letters, words, least, most in _LAYERS:
        if getattr(image, key) is None:
            continue
        layer = np.asarray(getattr(image, key))
        if layer.shape != rgb.shape[:2] or layer.dtype.kind not in letters:
            allowed = f"{rgb.shape[:2]} as rgb, of {words}"
            raise InspeError(f"{where}: {key} must be {allowed}, got {layer.dtype} {layer.shape}")
        _within(layer, least, most, f"{where}: {key}")
    for key in ("pixels", "share"):
        if getattr(image, key) is not None:
            _numbers(getattr(image, key), (road_users,), f"{where}: {key}")


def _check_scan(scan: Scan, road_users: int, where: str) -> None:
    _numbers(scan.pose, (6,), f"{where}: pose")
    points = np.asarray(scan.points)
    _numbers(points, (len(points) if points.ndim else 0, 4), f"{where}: points")
    _within(points[:, 3], 0, 1, f"{where}: points: intensity")
    if scan.returns is not None:
        _numbers(scan.returns, (road_users,), f"{where}: returns")


def _numbers(value: Any, shape: tuple[int, ...], where: str) -> None:
    array = np.asarray(value)
    if array.shape != shape or array.dtype.kind not in "fiu" or not np.isfinite(array).all():
        given = array.tolist() if array.size <= 9 else f"{array.dtype} {array.shape}"
        raise InspeError(f"{where} must be finite numbers of shape {shape}, got {given}")


def _within(array: np.ndarray, least: float, most: float, where: str) -> None:
    if array.size and not (array.min() >= least and array.max() <= most):  # also false for NaN
        given = f"{array.min()} to {array.max()}"
        raise InspeError(f"{where} runs from {given}: allowed {least} to {most}")


def _whole_number(value: Any, least: int, most: int | None, where: str) -> None:
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not whole or value < least or (most is not None and value > most):
        allowed = f"at least {least}" if most is None else f"{least} to {most}"
        raise InspeError(f"{where} {value!r} is out of range: a whole number, {allowed}")
