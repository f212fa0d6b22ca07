"""A scenario in the cache: arrays that are mapped into memory when they are used.

Its folder holds ``points.raw`` (all clouds one after the other, 16-bit), ``pictures.raw`` (bytes of
T × C pictures), ``index.npz`` (poses, calibration, boxes, and where each cloud begins) and
``scenario.json``.
"""

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int16, UInt8
from pydantic import BaseModel

from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import STRICT, check_model, open_arrays, read_json

RECORD, INDEX, POINTS, PICTURES = "scenario.json", "index.npz", "points.raw", "pictures.raw"


class ScenarioRecord(BaseModel):
    """What ``scenario.json`` says.

    ``source`` is the digest of the scenario that was decoded, ``middle`` that of the intersection
    on the ground [m] in its world, ``pictures`` their height and width, and ``files`` the size of
    each file [bytes]. The counts are the largest of a frame: LiDARs, units that have any, cameras,
    points of a cloud, boxes.
    """

    model_config = STRICT

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
    """A decoded scenario of T frames with S LiDARs and C cameras each.

    It holds its place alone until its arrays are used, also when it is sent to another process.
    """

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
    def size(self) -> int:
        """Bytes of all arrays."""
        return sum(self.record.files.values())

    @property
    def middle(self) -> Float[np.ndarray, "3"]:
        """The middle of the intersection on the ground, in the world [m]."""
        return np.array(self.record.middle)

    @cached_property
    def points(self) -> Int16[np.ndarray, "N 4"]:
        """All clouds, as :func:`~inspe_jax.dataset.loading.points.to_steps` has them."""
        return self._mapped(POINTS, np.int16).reshape(-1, 4)

    @cached_property
    def pictures(self) -> UInt8[np.ndarray, "T C H W 3"]:
        """All pictures."""
        shape = self.record.frames, self.record.cameras, *(self.record.pictures or (0, 0)), 3
        return self._mapped(PICTURES, np.uint8).reshape(shape)

    @cached_property
    def index(self) -> Mapping[str, np.ndarray]:
        """All else, in memory.

        ``number`` (T,) of each frame; ``starts`` (T, S + 1), where each cloud begins and the last
        ends; ``steps`` (T, S, 4); ``lidar_pose`` (T, S, 4, 4) and ``camera_pose`` (T, C, 4, 4) in
        the world; ``lidar_unit`` (S,), ``camera_unit`` (C,); ``intrinsic`` (T, C, 3, 3);
        ``box_starts`` (T + 1,), ``boxes`` (N, 9), ``kind`` (N,), ``track`` (N,), ``returns``
        (N, S), ``pixels`` (N, C).
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
