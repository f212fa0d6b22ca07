"""Puts frames of a cache together as a batch."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from inspe_jax.dataset.loading.augment import Augment
from inspe_jax.dataset.loading.batch import Batch, Cameras, Lidars, Pillars, Targets
from inspe_jax.dataset.loading.caching import Cache
from inspe_jax.dataset.loading.geometry import Similarity
from inspe_jax.dataset.loading.pillars import PillarGrid, grouping
from inspe_jax.dataset.loading.points import sample, to_metres, woven
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

    def batch(
        self, frames: Int[np.ndarray, "F 2"], draws: Sequence[np.random.Generator], size: int
    ) -> Batch:
        """The batch of some frames, each a scenario's index and the place in it.

        ``draws`` has a source of random numbers for each. The batch is filled up to ``size``.
        """
        found = self._empty(size)
        for b, ((s, t), draw) in enumerate(zip(frames.tolist(), draws, strict=True)):
            self._fill(found, b, s, t, draw)
        if found.cameras is not None:
            found.cameras.pixels[~found.cameras.present] = 0
        return found

    def _empty(self, size: int) -> Batch:
        """A batch that is all padding; shapes are those of the whole cache."""
        records = [each.record for each in self.cache.scenarios]
        lidars = max(each.lidars for each in records)
        cameras = max(each.cameras for each in records)
        pixels, found_lidars, found_cameras = self.cache.pictures, None, None
        if "lidar" in self.sensors and lidars:
            shape = size, lidars, self.most_points
            pillars = None
            if self.grid is not None:
                units = max(each.lidar_units for each in records)
                groups = {"sensor": lidars, "unit": units, "all": 1}[self.grid.per]
                pillars = self.grid.empty(size, groups)
            found_lidars = Lidars(
                points=np.zeros((*shape, 4), np.float32) if pillars is None else None,
                mask=np.zeros(shape, bool) if pillars is None else None,
                pillars=pillars,
                pose=_identities(size, lidars),
                present=np.zeros((size, lidars), bool),
                unit=np.zeros((size, lidars), np.int32),
            )
        if "camera" in self.sensors and cameras and pixels:
            found_cameras = Cameras(
                pixels=np.empty((size, cameras, *pixels, 3), np.uint8),
                intrinsic=_identities(size, cameras, side=3),
                pose=_identities(size, cameras),
                present=np.zeros((size, cameras), bool),
                unit=np.zeros((size, cameras), np.int32),
            )
        places = size, self.most_boxes
        return Batch(
            lidars=found_lidars,
            cameras=found_cameras,
            targets=Targets(
                boxes=np.zeros((*places, 9), np.float32),
                kind=np.zeros(places, np.int32),
                track=np.zeros(places, np.int32),
                returns=np.zeros((*places, lidars), np.int32),
                pixels=np.zeros((*places, cameras), np.float32),
                mask=np.zeros(places, bool),
            ),
            scenario=np.zeros(size, np.int32),
            number=np.zeros(size, np.int32),
            transform=_identities(size),
            valid=np.zeros(size, bool),
        )

    def _fill(self, found: Batch, b: int, s: int, t: int, draw: np.random.Generator) -> None:
        stored = self.scenarios[s]
        moved = Similarity() if self.augment is None else self.augment.similarity(draw)
        found.scenario[b], found.number[b] = s, stored.index["number"][t]
        found.transform[b], found.valid[b] = moved.matrix, True
        heard, seen = np.ones(stored.record.lidars, bool), np.ones(stored.record.cameras, bool)
        if found.lidars is not None:
            if self.augment is not None:
                heard = self.augment.kept(len(heard), draw)
            self._fill_lidars(found.lidars, b, stored, t, moved, heard, draw)
        if found.cameras is not None:
            if self.augment is not None:
                seen = self.augment.kept(len(seen), draw)
            _fill_cameras(found.cameras, b, stored, t, moved, seen)
        self._fill_targets(found.targets, b, stored, t, moved, heard, seen)

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
        poses = _fill_poses(found, b, stored, t, moved, present)
        order = draw if self.training else None
        clouds = {}
        for s in np.flatnonzero(present).tolist():
            steps = stored.cloud(t, s)
            if found.points is not None and found.mask is not None:
                steps = sample(steps, self.most_points, order)
                found.mask[b, s, : len(steps)] = True
                out = found.points[b, s, : len(steps)]
            else:
                out = clouds[s] = np.empty((len(steps), 4), np.float32)
            to_metres(steps, stored.index["steps"][t, s], moved.linear, poses[s, :3, 3], out)
        if found.pillars is not None and self.grid is not None:
            groups = grouping(stored.index["lidar_unit"], present, self.grid.per)
            for g, members in enumerate(groups):
                if members:
                    own = Pillars(*(part[b, g] for part in found.pillars))
                    self.grid.fill(woven([clouds[s] for s in members]), own, order)

    def _fill_targets(
        self,
        found: Targets,
        b: int,
        stored: StoredScenario,
        t: int,
        moved: Similarity,
        heard: Bool[np.ndarray, " S"],
        seen: Bool[np.ndarray, " C"],
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
        found.kind[b, :count] = index["kind"][own][chosen]
        found.track[b, :count] = index["track"][own][chosen]
        found.returns[b, :count, : len(heard)] = index["returns"][own][chosen] * heard
        found.pixels[b, :count, : len(seen)] = np.where(seen, index["pixels"][own][chosen], 0)
        found.mask[b, :count] = True


def _fill_cameras(
    found: Cameras,
    b: int,
    stored: StoredScenario,
    t: int,
    moved: Similarity,
    present: Bool[np.ndarray, " C"],
) -> None:
    _fill_poses(found, b, stored, t, moved, present)
    there, width = np.flatnonzero(present), found.pixels.shape[3]
    found.intrinsic[b, there] = moved.of_intrinsics(stored.index["intrinsic"][t], width)[there]
    for c in there.tolist():
        moved.copy_picture(stored.pictures[t, c], found.pixels[b, c])


def _fill_poses(
    found: Lidars | Cameras,
    b: int,
    stored: StoredScenario,
    t: int,
    moved: Similarity,
    present: Bool[np.ndarray, " S"],
) -> Float[np.ndarray, "S 4 4"]:
    """Write the units of a frame's sensors, which are present, and the poses of these; gives the
    poses of all."""
    kind, count = "lidar" if isinstance(found, Lidars) else "camera", len(present)
    poses = np.array(stored.index[f"{kind}_pose"][t])
    poses[:, :3, 3] -= stored.middle
    found.unit[b, :count] = stored.index[f"{kind}_unit"]
    found.present[b, :count] = present
    poses = moved.of_poses(poses)
    found.pose[b, :count][present] = poses[present]
    return poses


def _identities(*leading: int, side: int = 4) -> Float[np.ndarray, "... 4 4"]:
    return np.array(np.broadcast_to(np.eye(side, dtype=np.float32), (*leading, side, side)))
