"""Puts frames of a cache together as a batch."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from inspe_jax.dataset.loading.augment import Augment
from inspe_jax.dataset.loading.batch import Batch, Cameras, Lidars, Pillars, Targets
from inspe_jax.dataset.loading.caching import Cache
from inspe_jax.dataset.loading.geometry import Similarity
from inspe_jax.dataset.loading.pillars import PillarGrid, grouping
from inspe_jax.dataset.loading.points import pad_points, sample, to_metres, woven
from inspe_jax.dataset.loading.stored import StoredScenario


@dataclass(frozen=True)
class Assembly:
    """How frames become batches: the arguments of the :class:`~.loader.Loader`, checked.

    Where there is no place for all points, those that are kept are drawn at random in ``training``;
    otherwise they are always the same.
    """

    cache: Cache
    scenarios: tuple[StoredScenario, ...]
    sensors: tuple[str, ...]
    grid: PillarGrid | None
    most_points: int
    most_boxes: int
    half: float | None
    augment: Augment | None
    training: bool

    @cached_property
    def lidars(self) -> int:
        """Number of LiDARs of a frame: the largest in the cache."""
        return max(each.record.lidars for each in self.cache.scenarios)

    @cached_property
    def cameras(self) -> int:
        """Number of cameras of a frame: the largest in the cache."""
        return max(each.record.cameras for each in self.cache.scenarios)

    @cached_property
    def groups(self) -> int:
        """Number of groups of LiDARs that share pillars: the largest in the cache."""
        units = max(each.record.lidar_units for each in self.cache.scenarios)
        per = "sensor" if self.grid is None else self.grid.per
        return {"sensor": self.lidars, "unit": units, "all": 1}[per]

    def batch(
        self,
        frames: Int[np.ndarray, "F 2"],
        draws: Sequence[np.random.Generator],
        size: int,
    ) -> Batch:
        """The batch of some frames, each a scenario's index and the place in it.

        ``draws`` has a source of random numbers for each. The batch is filled up to ``size``.
        """
        pixels = self.cache.pictures
        found = Batch(
            lidars=self._no_lidars(size) if "lidar" in self.sensors and self.lidars else None,
            cameras=_no_cameras(size, self.cameras, *pixels)
            if "camera" in self.sensors and self.cameras and pixels
            else None,
            targets=_no_targets(size, self.most_boxes, self.lidars, self.cameras),
            scenario=np.zeros(size, np.int32),
            number=np.zeros(size, np.int32),
            transform=_identities(size),
            valid=np.arange(size) < len(frames),
        )
        for b, (chosen, draw) in enumerate(zip(frames, draws, strict=True)):
            self._fill(found, b, int(chosen[0]), int(chosen[1]), draw)
        for b in range(len(frames), size):  # what is not written is what memory held before
            if found.lidars is not None and found.lidars.points is not None:
                found.lidars.points[b] = 0
            if found.cameras is not None:
                found.cameras.pixels[b] = 0
        return found

    def _fill(self, found: Batch, b: int, s: int, t: int, draw: np.random.Generator) -> None:
        stored = self.scenarios[s]
        index, record = stored.index, stored.record
        moved = Similarity() if self.augment is None else self.augment.similarity(draw)
        present = np.ones(record.lidars, bool)
        if self.augment is not None and found.lidars is not None:
            present = self.augment.kept(record.lidars, draw)
        found.scenario[b], found.number[b] = s, index["number"][t]
        found.transform[b] = moved.matrix
        if found.lidars is not None:
            self._fill_lidars(found.lidars, b, stored, t, moved, present, draw)
        kept = np.ones(record.cameras, bool)
        if found.cameras is not None:
            if self.augment is not None:
                kept = self.augment.kept(record.cameras, draw)
            _fill_cameras(found.cameras, b, stored, t, moved, kept)
        self._fill_targets(found.targets, b, stored, t, moved, present, kept)

    def _no_lidars(self, size: int) -> Lidars:
        lidars, points, pillars = self.lidars, None, None
        if self.grid is None:
            points = np.empty((size, lidars, self.most_points, 4), np.float32)
        else:
            pillars = self.grid.empty(size, self.groups)
        return Lidars(
            points=points,
            mask=None if points is None else np.zeros(points.shape[:3], bool),
            pillars=pillars,
            pose=_identities(size, lidars),
            present=np.zeros((size, lidars), bool),
            unit=np.zeros((size, lidars), np.int32),
        )

    def _fill_lidars(
        self,
        found: Lidars,
        b: int,
        stored: StoredScenario,
        t: int,
        moved: Similarity,
        present: Bool[np.ndarray, " S"],
        draw: np.random.Generator,
    ) -> None:
        index, count = stored.index, stored.record.lidars
        local = np.array(index["lidar_pose"][t])  # (S, 4, 4)
        local[:, :3, 3] -= stored.middle
        poses = moved.of_poses(local)
        found.unit[b, :count] = index["lidar_unit"]
        found.present[b, :count] = present
        found.pose[b, :count][present] = poses[present]
        order = self._drawn(draw)
        clouds = {}
        for s in range(self.lidars):
            steps = stored.cloud(t, s) if s < count and present[s] else None
            if found.points is not None and found.mask is not None:
                steps = None if steps is None else sample(steps, self.most_points, order)
                length = 0 if steps is None else len(steps)
                pad_points(found.points[b, s], found.mask[b, s], length)
                out = found.points[b, s, :length]
            elif steps is not None:
                out = clouds[s] = np.empty((len(steps), 4), np.float32)
            if steps is not None:
                to_metres(steps, index["steps"][t, s], moved.linear, poses[s, :3, 3], out)
        if found.pillars is not None and self.grid is not None:
            for g, members in enumerate(grouping(index["lidar_unit"], present, self.grid.per)):
                if members:
                    own = Pillars(*(part[b, g] for part in found.pillars))
                    self.grid.fill(woven([clouds[s] for s in members]), own, order)

    def _drawn(self, draw: np.random.Generator) -> np.random.Generator | None:
        return draw if self.training else None

    def _fill_targets(
        self,
        found: Targets,
        b: int,
        stored: StoredScenario,
        t: int,
        moved: Similarity,
        present: Bool[np.ndarray, " S"],
        kept: Bool[np.ndarray, " C"],
    ) -> None:
        index, own = stored.index, stored.boxes(t)
        boxes = np.array(index["boxes"][own])
        boxes[:, :3] -= stored.middle
        boxes = moved.of_boxes(boxes)
        away = np.abs(boxes[:, :2]).max(1, initial=0)
        chosen = np.arange(len(boxes))
        if self.half is not None:
            chosen = np.flatnonzero(away <= self.half)
        if len(chosen) > self.most_boxes:
            chosen = np.sort(chosen[np.argsort(away[chosen], kind="stable")[: self.most_boxes]])
        count = len(chosen)
        found.boxes[b, :count] = boxes[chosen]
        for name in ("kind", "track"):
            getattr(found, name)[b, :count] = index[name][own][chosen]
        found.returns[b, :count, : len(present)] = index["returns"][own][chosen] * present
        pixels = np.where(kept, index["pixels"][own][chosen], 0)
        found.pixels[b, :count, : len(kept)] = pixels
        found.mask[b, :count] = True


def _fill_cameras(
    found: Cameras,
    b: int,
    stored: StoredScenario,
    t: int,
    moved: Similarity,
    kept: Bool[np.ndarray, " C"],
) -> None:
    index, count = stored.index, stored.record.cameras
    local = np.array(index["camera_pose"][t])
    local[:, :3, 3] -= stored.middle
    found.unit[b, :count] = index["camera_unit"]
    found.present[b, :count] = kept
    found.pose[b, :count][kept] = moved.of_poses(local)[kept]
    width = found.pixels.shape[3]
    found.intrinsic[b, :count][kept] = moved.of_intrinsics(index["intrinsic"][t], width)[kept]
    for c in range(found.pixels.shape[1]):
        if c < count and kept[c]:
            moved.copy_picture(stored.pictures[t, c], found.pixels[b, c])
        else:
            found.pixels[b, c] = 0


def _no_cameras(size: int, cameras: int, height: int, width: int) -> Cameras:
    return Cameras(
        pixels=np.empty((size, cameras, height, width, 3), np.uint8),
        intrinsic=_identities(size, cameras, side=3),
        pose=_identities(size, cameras),
        present=np.zeros((size, cameras), bool),
        unit=np.zeros((size, cameras), np.int32),
    )


def _no_targets(size: int, boxes: int, lidars: int, cameras: int) -> Targets:
    return Targets(
        boxes=np.zeros((size, boxes, 9), np.float32),
        kind=np.zeros((size, boxes), np.int32),
        track=np.zeros((size, boxes), np.int32),
        returns=np.zeros((size, boxes, lidars), np.int32),
        pixels=np.zeros((size, boxes, cameras), np.float32),
        mask=np.zeros((size, boxes), bool),
    )


def _identities(*leading: int, side: int = 4) -> Float[np.ndarray, "... 4 4"]:
    return np.array(np.broadcast_to(np.eye(side, dtype=np.float32), (*leading, side, side)))
