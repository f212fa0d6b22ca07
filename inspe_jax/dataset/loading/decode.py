"""Decodes a scenario of a data set into the cache."""

import hashlib
import json
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from jaxtyping import Float, Int
from PIL import Image as Pillow

from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import json_value
from inspe_jax.dataset.folders import Scenario
from inspe_jax.dataset.loading.geometry import pose_matrix
from inspe_jax.dataset.loading.points import to_steps
from inspe_jax.dataset.loading.stored import INDEX, PICTURES, POINTS, RECORD, STATIC
from inspe_jax.dataset.points_in_boxes import returns_of
from inspe_jax.simulation.frame import KINDS, Frame, Image, RoadUserBox, Scan

PART = ".part"

Sensors = tuple[list[tuple[int, Scan]], list[tuple[int, Image]]]


def digest_of_scenario(scenario: Scenario) -> str:
    """Identifies what a scenario holds, by its protocol and the names and sizes of its files.

    It is the same for a copy. Files are not read, so it does not notice one that was altered but
    kept its size.
    """
    found = hashlib.sha256()
    found.update(json.dumps(json_value(scenario.protocol), sort_keys=True, default=str).encode())
    for place, folders, names in os.walk(scenario.path):
        folders.sort()
        for name in sorted(names):
            path = Path(place, name)
            found.update(f"{path.relative_to(scenario.path).as_posix()} ".encode())
            found.update(f"{path.stat().st_size}\n".encode())
    return found.hexdigest()


def decode(
    scenario: Scenario, place: Path, source: str, pictures: tuple[int, int] | None
) -> tuple[str, int]:
    """Decode a scenario into the folder ``place``, which appears when it is complete.

    ``source`` is its digest; ``pictures`` are resized to (height, width), or left out if None.
    Gives its name, and the number of its frames. Raises InspeError if a file is broken, frames do
    not have the same sensors, or the disk is full.
    """
    part = place.with_name(f".{place.name}{PART}")
    shutil.rmtree(part, ignore_errors=True)
    try:
        part.mkdir(parents=True)
        _write(scenario, part, source, pictures)
        os.replace(part, place)
    except OSError as e:
        raise InspeError(
            f"{place}: {e.strerror or e}; give the same command again to resume"
        ) from e
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return place.name, len(scenario.frames)


def _write(scenario: Scenario, part: Path, source: str, pictures: tuple[int, int] | None) -> None:
    lidars, cameras = _sensors(scenario.frame(scenario.frames[0]))
    index = _Index(scenario, len(lidars), len(cameras) if pictures else None)
    stored = []
    if lidars:
        stored.append(_Rows(part / POINTS, (4,), np.int16))
    if cameras and pictures:
        stored.append(_Rows(part / PICTURES, (len(cameras), *pictures, 3), np.uint8))
    try:
        for number in scenario.frames:
            frame = scenario.frame(number)
            scans, images = index.sensors(frame)
            rows = iter(stored)
            if scans:
                next(rows).append(index.add_clouds(number, scans))
            if images:
                pixels = [resized(image.rgb, pictures or (1, 1)) for image in images]
                next(rows).append(np.stack(pixels)[None])
                index.add_cameras(images, pictures or (1, 1))
            index.add_boxes(number, frame.boxes, scans)
            index.add_pixels(len(frame.boxes), images, pictures or (1, 1))
    finally:
        for each in stored:
            each.close()
    np.savez(part / INDEX, **index.arrays())  # type: ignore[arg-type]
    files = {path.name: path.stat().st_size for path in sorted(part.iterdir())}
    record = {"source": source, "middle": middle_of(scenario, index), **index.counts}
    text = json.dumps({**record, "files": files}, indent=2)
    (part / RECORD).write_text(text + "\n", encoding="utf-8")


def resized(rgb: Any, size: tuple[int, int]) -> np.ndarray:
    """A picture as (height, width, 3); each pixel is the mean of the area that it covers."""
    height, width = size
    rgb = np.asarray(rgb)
    if rgb.shape[:2] == size:
        return rgb
    return np.asarray(Pillow.fromarray(rgb).resize((width, height), Pillow.Resampling.BOX))


def middle_of(scenario: Scenario, index: "_Index") -> list[float]:
    """The middle of the intersection on the ground [m].

    It is what the protocol says. Of a set whose protocols do not say it, it is the middle of where
    road users are in all frames, which is the same for every placement of sensors in the same
    traffic, or of the sensors where there are no road users. The ground is then the median of the
    bottoms of all boxes.
    """
    told = scenario.protocol.get("middle")
    if isinstance(told, list) and len(told) == 3:
        return [float(x) for x in told]
    boxes = index.all_boxes()
    poses = np.concatenate([*index.lidar_poses, *index.camera_poses, np.zeros((0, 4, 4))])
    middle = np.zeros(3)
    if len(boxes):
        middle[:2] = (boxes[:, :2].min(0) + boxes[:, :2].max(0)) / 2
        middle[2] = np.median(boxes[:, 2] - boxes[:, 5] / 2)
    elif len(poses):
        middle[:2] = (poses[:, :2, 3].min(0) + poses[:, :2, 3].max(0)) / 2
    return middle.tolist()


def _sensors(frame: Frame) -> Sensors:
    """The scans and the images of a frame, each with the number of its station."""
    stations = frame.stations
    scans = [(station.number, scan) for station in stations for scan in station.scans]
    images = [(station.number, image) for station in stations for image in station.images]
    return scans, images


class _Rows:
    """A file in NumPy's format to which rows are appended; its header is completed at the end."""

    def __init__(self, path: Path, shape: tuple[int, ...], kind: type) -> None:
        self.shape, self.kind, self.count = shape, np.dtype(kind), 0
        self._file: IO[bytes] = path.open("wb")
        self._head()
        self._body = self._file.tell()

    def _head(self) -> None:
        head = {
            "descr": np.lib.format.dtype_to_descr(self.kind),
            "fortran_order": False,
            "shape": (self.count, *self.shape),
        }
        np.lib.format.write_array_header_1_0(self._file, head)

    def append(self, rows: np.ndarray) -> None:
        """Write rows of this file's shape and type."""
        self._file.write(np.ascontiguousarray(rows).data)
        self.count += len(rows)

    def close(self) -> None:
        """Write the number of rows into the header, where NumPy leaves room for it."""
        self._file.seek(0)
        self._head()
        assert self._file.tell() == self._body
        self._file.close()


class _Index:
    """All that is kept of a scenario but points and pictures, frame by frame."""

    def __init__(self, scenario: Scenario, lidars: int, cameras: int | None) -> None:
        """``cameras`` is None if pictures are left out."""
        self.scenario, self.lidars, self.cameras = scenario, lidars, cameras or 0
        self.pictures = cameras is not None
        self.units: tuple[list[int], list[int]] | None = None
        self.starts: list[list[int]] = []
        self.steps: list[np.ndarray] = []
        self.lidar_poses: list[np.ndarray] = []
        self.camera_poses: list[np.ndarray] = []
        self.intrinsics: list[np.ndarray] = []
        self.box_starts = [0]
        self.boxes: list[np.ndarray] = []
        self.kinds: list[int] = []
        self.tracks: list[int] = []
        self.returns: list[np.ndarray] = []
        self.pixels: list[np.ndarray] = []
        self._end = self.most_points = 0

    def sensors(self, frame: Frame) -> tuple[list[Scan], list[Image]]:
        """The scans and images of a frame, which must be those of the sensors of the others."""
        scans, images = _sensors(frame)
        images = images if self.pictures else []
        units = [number for number, _ in scans], [number for number, _ in images]
        if self.units is None:
            self.units = units
        if units != self.units:
            raise InspeError(
                f"{self.scenario.path}: frame {frame.number} has LiDARs and cameras of stations "
                f"{units}, frames before have {self.units}: leave it out, or complete its files"
            )
        return [scan for _, scan in scans], [image for _, image in images]

    def add_clouds(self, number: int, scans: Sequence[Scan]) -> np.ndarray:
        """Note where the clouds of a frame are; gives their points as stored."""
        starts, clouds, steps = [self._end], [], []
        for s, scan in enumerate(scans):
            cloud, step = to_steps(scan.points, scan.pose, np.random.default_rng([number, s]))
            clouds.append(cloud)
            steps.append(step)
            starts.append(starts[-1] + len(cloud))
            self.most_points = max(self.most_points, len(cloud))
        self._end = starts[-1]
        self.starts.append(starts)
        self.steps.append(np.stack(steps))
        self.lidar_poses.append(np.stack([pose_matrix(scan.pose) for scan in scans]))
        return np.concatenate(clouds)

    def add_cameras(self, images: Sequence[Image], size: tuple[int, int]) -> None:
        """Note poses and calibration; (0, 0) is a corner, so the latter scales with the size."""
        self.camera_poses.append(np.stack([pose_matrix(image.pose) for image in images]))
        scaled = []
        for image in images:
            height, width = np.asarray(image.rgb).shape[:2]
            factors = np.array([[size[1] / width], [size[0] / height], [1.0]])
            scaled.append(np.asarray(image.intrinsic, float) * factors)
        self.intrinsics.append(np.stack(scaled))

    def add_boxes(self, number: int, boxes: Sequence[RoadUserBox], scans: Sequence[Scan]) -> None:
        """Note the road users of a frame. What else is to be known of a box is added here."""
        for box in boxes:
            if box.kind not in KINDS:
                raise InspeError(f"{self.scenario.path}: frame {number}: kind '{box.kind}'")
            given = (box.center, box.size, [box.yaw], np.asarray(box.velocity)[:2])
            self.boxes.append(np.concatenate(given).astype(float))
            self.kinds.append(KINDS.index(box.kind))
            self.tracks.append(box.track)
        self.returns.append(returns_of(scans, boxes).T)  # (B, S)
        self.box_starts.append(len(self.boxes))

    def add_pixels(self, boxes: int, images: Sequence[Image], size: tuple[int, int]) -> None:
        """Note how many pixels of a picture of this size show each road user of a frame."""
        found = np.full((boxes, self.cameras), -1.0)
        for c, image in enumerate(images):
            if image.pixels is not None:
                height, width = np.asarray(image.rgb).shape[:2]
                found[:, c] = np.asarray(image.pixels) * (size[0] * size[1] / (height * width))
        self.pixels.append(found)

    def all_boxes(self) -> Float[np.ndarray, "N 9"]:
        """The boxes of all frames."""
        return np.array(self.boxes).reshape(-1, 9)

    def arrays(self) -> dict[str, np.ndarray]:
        """What ``index.npz`` holds; see :data:`~inspe_jax.dataset.loading.stored.STATIC`."""
        units = self.units or ([], [])
        frames, lidars, cameras = len(self.scenario.frames), self.lidars, self.cameras
        found = {
            "number": np.array(self.scenario.frames, np.int32),
            "starts": _stacked(self.starts, (frames, lidars + 1), np.int64),
            "steps": _stacked(self.steps, (frames, lidars, 4), np.float64),
            "lidar_pose": _stacked(self.lidar_poses, (frames, lidars, 4, 4), np.float64),
            "lidar_unit": np.array(units[0], np.int32),
            "camera_pose": _stacked(self.camera_poses, (frames, cameras, 4, 4), np.float64),
            "intrinsic": _stacked(self.intrinsics, (frames, cameras, 3, 3), np.float64),
            "camera_unit": np.array(units[1], np.int32),
            "box_starts": np.array(self.box_starts, np.int64),
            "boxes": self.all_boxes(),
            "kind": np.array(self.kinds, np.int32),
            "track": np.array(self.tracks, np.int32),
            "returns": np.concatenate(self.returns).astype(np.int32),
            "pixels": np.concatenate(self.pixels).astype(np.float32),
        }
        for key in STATIC:
            if (found[key] == found[key][:1]).all():
                found[key] = found[key][:1]
        return found

    @property
    def counts(self) -> dict[str, int]:
        """The counts of the record."""
        return {
            "frames": len(self.scenario.frames),
            "lidars": self.lidars,
            "lidar_units": len(set(self.units[0] if self.units else ())),
            "cameras": self.cameras,
            "most_points": self.most_points,
            "most_boxes": int(np.diff(self.box_starts).max(initial=0)),
        }


def _stacked(parts: Sequence[Any], shape: tuple[int, ...], kind: type) -> Int[np.ndarray, "..."]:
    """Parts as one array; zeros of this shape if there are none, because no frame has any."""
    return np.array(parts, kind) if parts else np.zeros(shape, kind)
