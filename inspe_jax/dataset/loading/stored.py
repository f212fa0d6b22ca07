"""A scenario in the cache: arrays in NumPy's own format, mapped into memory when they are used.

Its folder holds ``points.npy`` (all clouds one after the other), ``pictures.npy`` (T, C, H, W, 3),
``index.npz`` (poses, calibration, boxes, and where each cloud begins) and ``scenario.json``.
"""

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Int16, UInt8
from pydantic import BaseModel

from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import STRICT, check_model, open_arrays, read_json

RECORD, INDEX, POINTS, PICTURES = "scenario.json", "index.npz", "points.npy", "pictures.npy"

INDEX_KEYS = (
    *("number", "starts", "steps", "lidar_pose", "lidar_unit"),
    *("camera_pose", "intrinsic", "camera_unit"),
    *("box_starts", "boxes", "kind", "track", "returns", "pixels"),
)

STATIC = ("lidar_pose", "camera_pose", "intrinsic")
"""Arrays that are stored once if they are the same in all frames, as for sensors that stand."""


class ScenarioRecord(BaseModel):
    """What ``scenario.json`` says.

    ``source`` is the digest of the scenario that was decoded, ``middle`` that of the intersection
    on the ground [m] in its world, and ``files`` the size of each file [bytes]. The counts are the
    largest of a frame: LiDARs, units that have any, cameras, points of a cloud, boxes.
    """

    model_config = STRICT

    source: str
    middle: list[float]
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
                raise InspeError(f"{file}: is missing or damaged: {self._advice}")

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

    @cached_property
    def points(self) -> Int16[np.ndarray, "N 4"]:
        """All clouds, as :func:`~inspe_jax.dataset.loading.points.to_steps` has them."""
        return self._mapped(POINTS)

    @cached_property
    def pictures(self) -> UInt8[np.ndarray, "T C H W 3"]:
        """All pictures."""
        return self._mapped(PICTURES)

    @cached_property
    def index(self) -> Mapping[str, np.ndarray]:
        """All else, in memory.

        ``number`` (T,) of each frame; ``starts`` (T, S + 1), where each cloud begins and the last
        ends; ``steps`` (T, S, 4); ``lidar_pose`` (T, S, 4, 4) and ``camera_pose`` (T, C, 4, 4) in
        the world; ``lidar_unit`` (S,), ``camera_unit`` (C,); ``intrinsic`` (T, C, 3, 3);
        ``box_starts`` (T + 1,), ``boxes`` (N, 9), ``kind`` (N,), ``track`` (N,), ``returns``
        (N, S), ``pixels`` (N, C).
        """
        path = self.path / INDEX
        with open_arrays(path, f"is missing or damaged: {self._advice}") as file:
            found = {key: file[key] for key in INDEX_KEYS}
        for key in STATIC:
            found[key] = np.broadcast_to(found[key], (self.record.frames, *found[key].shape[1:]))
        return found

    def cloud(self, t: int, s: int) -> Int16[np.ndarray, "N 4"]:
        """The stored points of a LiDAR in frame t."""
        first, end = self.index["starts"][t, s : s + 2]
        return self.points[first:end]

    def boxes(self, t: int) -> slice:
        """Where the boxes of frame t are in the index."""
        first, end = self.index["box_starts"][t : t + 2]
        return slice(int(first), int(end))

    @property
    def middle(self) -> Float[np.ndarray, "3"]:
        """The middle of the intersection on the ground, in the world [m]."""
        return np.array(self.record.middle)

    def frames_with(self, kind: int, half: float | None) -> Int[np.ndarray, " F"]:
        """The frames that have a road user of a kind, within ``half`` to each side [m] if given."""
        own = self.index["kind"] == kind
        if half is not None:
            own &= (np.abs(self.index["boxes"][:, :2] - self.middle[:2]) <= half).all(1)
        frame = np.searchsorted(self.index["box_starts"], np.flatnonzero(own), side="right") - 1
        return np.unique(frame)

    def _mapped(self, name: str) -> np.ndarray:
        try:
            # Without memmap's own class, whose every slice runs code of Python.
            mapped: np.ndarray = np.load(self.path / name, mmap_mode="r").view(np.ndarray)
            return mapped
        except (OSError, ValueError) as e:
            raise InspeError(f"{self.path / name}: is missing or damaged: {self._advice}") from e

    @property
    def _advice(self) -> str:
        return f"delete {self.path} and cache it again"
