"""A scenario in the cache: 16-bit clouds, pictures, an index of all else, and a record."""

import hashlib
import json
import os
import shutil
from collections import defaultdict
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int16, UInt8
from PIL import Image as Pillow

from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import check_model, json_value, open_arrays, read_json
from inspe_jax.core.geometry import pose_matrix, rotation
from inspe_jax.dataset.folders import Scenario
from inspe_jax.dataset.points_in_boxes import count_inside
from inspe_jax.jobs.settings import Strict
from inspe_jax.simulation.frame import KINDS, Image, Scan

RECORD, INDEX, POINTS, PICTURES = "scenario.json", "index.npz", "points.raw", "pictures.raw"
PART = ".part"

STEPS = 32_640
"""Steps from 0 to the farthest coordinate, or to intensity 1: 128 × 255, so that intensities of 8
bits are exact. Over 120 m a step is 3.7 mm; LiDARs scatter 20 mm."""

AT_ONCE = 8192
"""Points that are converted at once: their 128 kB stay in a core's cache from step to step."""


class ScenarioRecord(Strict):
    """What ``scenario.json`` says: digest of the source, middle of the intersection in its world
    [m], sizes of pictures and of files [bytes], and the largest counts of a frame."""

    source: str
    middle: list[float]
    pictures: list[int] | None
    frames: int
    lidars: int
    lidar_units: int
    cameras: int
    most_points: int
    most_boxes: int
    files: dict[str, int]


class StoredScenario:
    """A decoded scenario of T frames, S LiDARs and C cameras; pickled without its arrays."""

    def __init__(self, path: Path, split: str) -> None:
        """Raises InspeError if a file is missing, or has another size than when it was written."""
        self.path, self.split = path, split
        self.record = check_model(ScenarioRecord, read_json(path / RECORD), str(path / RECORD))
        for name, size in self.record.files.items():
            file = path / name
            if not file.is_file() or file.stat().st_size != size:
                raise InspeError(f"{file}: {self._damaged}")

    def __getstate__(self) -> dict[str, Any]:
        return {key: self.__dict__[key] for key in ("path", "split", "record")}

    @property
    def name(self) -> str:
        """The folder's name: that of the scenario."""
        return self.path.name

    @property
    def middle(self) -> Float[np.ndarray, "3"]:
        """The middle of the intersection on the ground, in the world [m]."""
        return np.array(self.record.middle)

    @cached_property
    def points(self) -> Int16[np.ndarray, "N 4"]:
        """All clouds, as :func:`to_steps` has them."""
        return self._mapped(POINTS, np.int16).reshape(-1, 4)

    @cached_property
    def pictures(self) -> UInt8[np.ndarray, "T C H W 3"]:
        """All pictures."""
        shape = self.record.frames, self.record.cameras, *(self.record.pictures or (0, 0)), 3
        return self._mapped(PICTURES, np.uint8).reshape(shape)

    @cached_property
    def index(self) -> Mapping[str, np.ndarray]:
        """All else, in memory.

        ``number`` (T,) of each frame; ``starts`` (T, S + 1) of clouds; ``steps`` (T, S, 4);
        ``lidar_pose`` (T, S, 4, 4) and ``camera_pose`` (T, C, 4, 4) in the world; ``lidar_unit``
        (S,), ``camera_unit`` (C,); ``intrinsic`` (T, C, 3, 3); ``box_starts`` (T + 1,), ``boxes``
        (N, 9), ``kind``, ``track`` (N,), ``returns`` (N, S), ``pixels`` (N, C).
        """
        with open_arrays(self.path / INDEX, self._damaged) as file:
            return dict(file)

    def cloud(self, t: int, s: int) -> Int16[np.ndarray, "N 4"]:
        """The stored points of a LiDAR in frame t."""
        first, end = self.index["starts"][t, s : s + 2]
        return self.points[first:end]

    def boxes(self, t: int) -> slice:
        """Where the boxes of frame t are in the index."""
        first, end = self.index["box_starts"][t : t + 2]
        return slice(int(first), int(end))

    def _mapped(self, name: str, kind: Any) -> np.ndarray:
        """The numbers of a file, as a plain array: each slice of a memmap runs code of Python."""
        if not self.record.files[name]:  # no empty file can be mapped
            return np.zeros(0, kind)
        return np.asarray(np.memmap(self.path / name, kind, "r"))

    @property
    def _damaged(self) -> str:
        return f"is missing or damaged: delete {self.path} and cache it again"


def digest_of_scenario(scenario: Scenario) -> str:
    """Identifies a scenario, and copies of it, by its protocol and names and sizes of files. One
    that was altered at the same size is not noticed."""
    found = hashlib.sha256()
    found.update(json.dumps(json_value(scenario.protocol), sort_keys=True, default=str).encode())
    for place, folders, names in os.walk(scenario.path):
        folders.sort()
        for name in sorted(names):
            path = Path(place, name)
            found.update(f"{path.relative_to(scenario.path).as_posix()} ".encode())
            found.update(f"{path.stat().st_size}\n".encode())
    return found.hexdigest()


def decode(scenario: Scenario, place: Path, source: str, pictures: tuple[int, int] | None) -> int:
    """Decode a scenario into ``place``, which appears when it is complete; gives its number of
    frames. Raises InspeError if a file is broken or not writable, or sensors differ by frame."""
    part = place.with_name(f".{place.name}{PART}")
    shutil.rmtree(part, ignore_errors=True)
    try:
        part.mkdir(parents=True)
        _write(scenario, part, source, pictures)
        os.replace(part, place)
    except OSError as e:
        words = f"{place}: {e.strerror or e}; give the same command again to resume"
        raise InspeError(words) from e
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return len(scenario.frames)


def _write(scenario: Scenario, part: Path, source: str, size: tuple[int, int] | None) -> None:
    each: dict[str, list[Any]] = defaultdict(list)  # by frame
    units: tuple[list[int], list[int]] | None = None
    end, shape = 0, size or (1, 1)
    with (part / POINTS).open("wb") as points, (part / PICTURES).open("wb") as pictures:
        for number in scenario.frames:
            frame = scenario.frame(number)
            lidars = [(unit.number, scan) for unit in frame.stations for scan in unit.scans]
            cameras = [(unit.number, x) for unit in frame.stations for x in unit.images if size]
            scans, images = [scan for _, scan in lidars], [image for _, image in cameras]
            now = [number for number, _ in lidars], [number for number, _ in cameras]
            units = units or now
            if now != units:
                raise InspeError(
                    f"{scenario.path}: frame {number} has LiDARs and cameras of stations {now}, "
                    f"frames before have {units}: leave it out, or complete its files"
                )
            clouds = [
                to_steps(scan.points, scan.pose, np.random.default_rng([number, s]))
                for s, scan in enumerate(scans)
            ]
            for cloud, _ in clouds:
                points.write(cloud.tobytes())
            for image in images:
                pictures.write(resized(image.rgb, shape).tobytes())
            returns = np.array([scan.returns for scan in scans if scan.returns is not None])
            if len(returns) != len(scans):  # one does not say
                returns = count_inside(scans, frame.boxes)
            starts = end + np.cumsum([0, *(len(cloud) for cloud, _ in clouds)])
            end = starts[-1]
            rows = [
                [*box.center, *box.size, box.yaw, *np.asarray(box.velocity)[:2]]
                for box in frame.boxes
            ]
            row = {
                "starts": starts,
                "steps": np.array([step for _, step in clouds]).reshape(-1, 4),
                "lidar_pose": _poses(scans),
                "camera_pose": _poses(images),
                **_calibration(images, shape, len(frame.boxes)),
                "boxes": np.array(rows, float).reshape(-1, 9),
                "kind": np.array([KINDS.index(box.kind) for box in frame.boxes], np.int32),
                "track": np.array([box.track for box in frame.boxes], np.int32),
                "returns": returns.reshape(len(scans), len(frame.boxes)).T.astype(np.int32),
            }
            for key, value in row.items():
                each[key].append(value)
    counts = [len(boxes) for boxes in each["boxes"]]
    of_boxes = ("boxes", "kind", "track", "returns", "pixels")
    index = {key: (np.concatenate if key in of_boxes else np.stack)(of) for key, of in each.items()}
    lidar_unit, camera_unit = units or ([], [])
    index |= {
        "number": np.array(scenario.frames, np.int32),
        "box_starts": np.cumsum([0, *counts]),
        "lidar_unit": np.array(lidar_unit, np.int32),
        "camera_unit": np.array(camera_unit, np.int32),
    }
    np.savez(part / INDEX, **index)  # type: ignore[arg-type]
    record = {
        "source": source,
        "middle": _middle(scenario, index),
        "pictures": size,
        "frames": len(scenario.frames),
        "lidars": len(lidar_unit),
        "lidar_units": len(set(lidar_unit)),
        "cameras": len(camera_unit),
        "most_points": int(np.diff(index["starts"]).max(initial=0)),
        "most_boxes": max(counts),
        "files": {path.name: path.stat().st_size for path in sorted(part.iterdir())},
    }
    (part / RECORD).write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")


def resized(rgb: Any, size: tuple[int, int]) -> np.ndarray:
    """A picture as (height, width, 3); each pixel is the mean of the area that it covers."""
    height, width = size
    rgb = np.asarray(rgb)
    if rgb.shape[:2] == size:
        return rgb
    return np.asarray(Pillow.fromarray(rgb).resize((width, height), Pillow.Resampling.BOX))


def _poses(of: Sequence[Scan | Image]) -> Float[np.ndarray, "S 4 4"]:
    return np.array([pose_matrix(each.pose) for each in of]).reshape(-1, 4, 4)


def _calibration(
    images: Sequence[Image], size: tuple[int, int], boxes: int
) -> dict[str, np.ndarray]:
    """Matrices of pictures of this size, and their pixels of each road user, −1 if unknown."""
    intrinsic = np.zeros((len(images), 3, 3))
    pixels = np.full((boxes, len(images)), -1, np.float32)
    for c, image in enumerate(images):
        height, width = np.asarray(image.rgb).shape[:2]
        factors = np.array([[size[1] / width], [size[0] / height], [1.0]])
        intrinsic[c] = np.asarray(image.intrinsic, float) * factors
        if image.pixels is not None:
            pixels[:, c] = np.asarray(image.pixels) * (size[0] * size[1] / (height * width))
    return {"intrinsic": intrinsic, "pixels": pixels}


def _middle(scenario: Scenario, index: dict[str, np.ndarray]) -> list[float]:
    """The middle of the intersection on the ground [m]: as the protocol says, else of the road
    users, on the median of the bottoms of their boxes, else of the sensors."""
    told = scenario.protocol.get("middle")
    if isinstance(told, list) and len(told) == 3:
        return [float(x) for x in told]
    boxes = index["boxes"]
    poses = np.concatenate([index["lidar_pose"], index["camera_pose"]], 1).reshape(-1, 4, 4)
    middle = np.zeros(3)
    if len(boxes):
        middle[:2] = (boxes[:, :2].min(0) + boxes[:, :2].max(0)) / 2
        middle[2] = np.median(boxes[:, 2] - boxes[:, 5] / 2)
    elif len(poses):
        middle[:2] = (poses[:, :2, 3].min(0) + poses[:, :2, 3].max(0)) / 2
    return middle.tolist()


def to_steps(
    points: Any, pose: Any, rng: np.random.Generator
) -> tuple[Int16[np.ndarray, "N 4"], Float[np.ndarray, "4"]]:
    """A cloud (N, 4) of a LiDAR with this ``pose`` as stored: steps of x, y, z and intensity, and
    the size of each. Positions are from the LiDAR, along the axes of the world, in random order."""
    values = np.array(points, np.float64).reshape(-1, 4)
    values[:, :3] = values[:, :3] @ rotation(np.asarray(pose, float)[3:], np).T
    reach = np.abs(values).max(0, initial=1.0)
    step = reach / STEPS
    order = rng.permutation(len(values))
    return np.rint(values[order] / step).astype(np.int16), step


def to_metres(
    steps: Int16[np.ndarray, "N 4"],
    step: Float[np.ndarray, "4"],
    linear: Float[np.ndarray, "3 3"],
    origin: Float[np.ndarray, "3"],
    out: Float[np.ndarray, "N 4"],
) -> None:
    """Write ``linear`` · position + ``origin``, and the intensity, of stored points to ``out``."""
    matrix = np.zeros((4, 4), np.float32)
    matrix[:3, :3] = (linear * step[:3]).T
    matrix[3, 3] = step[3]
    # In full, because NumPy broadcasts along rows of four a row at a time.
    shift = np.zeros((min(AT_ONCE, len(steps)), 4), np.float32)
    shift[:, :3] = origin
    for first in range(0, len(steps), AT_ONCE):
        part = slice(first, first + AT_ONCE)
        np.matmul(steps[part].astype(np.float32), matrix, out=out[part])
        out[part] += shift[: len(out[part])]


def woven(clouds: Sequence[Float[np.ndarray, "_ 4"]]) -> Float[np.ndarray, "N 4"]:
    """Clouds in random order as one in random order: each is spread over all of it evenly."""
    if len(clouds) == 1:
        return clouds[0]
    # 16 bits are sorted in one pass over their bytes.
    places = [(np.arange(len(cloud)) * 2**16 // len(cloud)).astype(np.uint16) for cloud in clouds]
    order = np.argsort(np.concatenate(places), kind="stable")
    return np.take(np.concatenate(clouds), order, axis=0)
