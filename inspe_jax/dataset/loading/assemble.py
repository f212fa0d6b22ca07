"""Puts frames of a cache together as a batch."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from inspe_jax.dataset.loading.batch import Batch, Cameras, Lidars, Pillars, Targets
from inspe_jax.dataset.loading.caching import Cache
from inspe_jax.dataset.loading.geometry import Augment, Similarity
from inspe_jax.dataset.loading.pillars import PillarGrid
from inspe_jax.dataset.loading.points import to_metres, woven
from inspe_jax.dataset.loading.stored import StoredScenario


@dataclass(frozen=True)
class Assembly:
    """How frames become batches: the arguments of the :class:`~.loader.Loader`, checked.

    Where there is no place for all pillars, those that are kept are drawn at random in
    ``training``; otherwise they are always the same.
    """

    cache: Cache
    scenarios: tuple[StoredScenario, ...]
    sensors: tuple[str, ...]
    grid: PillarGrid | None
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
            stored = self.scenarios[s]
            moved = Similarity() if self.augment is None else self.augment.similarity(draw)
            found.scenario[b], found.number[b] = s, stored.index["number"][t]
            found.transform[b], found.valid[b] = moved.matrix, True
            if found.lidars is not None:
                self._fill_lidars(found.lidars, b, stored, t, moved, draw)
            if found.cameras is not None:
                _fill_cameras(found.cameras, b, stored, t, moved)
            self._fill_targets(found.targets, b, stored, t, moved)
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
            grid, shape = self.grid, (size, lidars, max(1, *(r.most_points for r in records)))
            units = max(each.lidar_units for each in records)
            found_lidars = Lidars(
                points=np.zeros((*shape, 4), np.float32) if grid is None else None,
                mask=np.zeros(shape, bool) if grid is None else None,
                pillars=None if grid is None else grid.empty(size, units),
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
        places = size, max(1, *(each.most_boxes for each in records))
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

    def _fill_lidars(
        self,
        found: Lidars,
        b: int,
        stored: StoredScenario,
        t: int,
        moved: Similarity,
        draw: np.random.Generator,
    ) -> None:
        index, clouds = stored.index, list[np.ndarray]()
        poses = _fill_poses(found, b, stored, t, moved)
        for s, pose in enumerate(poses):
            steps = stored.cloud(t, s)
            if found.points is not None and found.mask is not None:
                found.mask[b, s, : len(steps)] = True
                out = found.points[b, s, : len(steps)]
            else:
                out = np.empty((len(steps), 4), np.float32)
                clouds.append(out)
            to_metres(steps, index["steps"][t, s], moved.linear, pose[:3, 3], out)
        if found.pillars is not None and self.grid is not None:
            order = draw if self.training else None
            for g, unit in enumerate(np.unique(index["lidar_unit"])):
                own = [clouds[s] for s in np.flatnonzero(index["lidar_unit"] == unit)]
                group = Pillars(*(part[b, g] for part in found.pillars))
                self.grid.fill(woven(own), group, order)

    def _fill_targets(
        self, found: Targets, b: int, stored: StoredScenario, t: int, moved: Similarity
    ) -> None:
        own = {
            name: stored.index[name][stored.boxes(t)]
            for name in ("boxes", "kind", "track", "returns", "pixels")
        }
        boxes = np.array(own["boxes"])
        boxes[:, :3] -= stored.middle
        own["boxes"] = moved.of_boxes(boxes)
        near = np.ones(len(boxes), bool)
        if self.half is not None:
            near = np.abs(own["boxes"][:, :2]).max(1, initial=0) <= self.half
        count = int(near.sum())
        found.mask[b, :count] = True
        for name in ("boxes", "kind", "track"):
            getattr(found, name)[b, :count] = own[name][near]
        for name in ("returns", "pixels"):  # of as many sensors as the scenario has
            sensors = own[name].shape[1]
            getattr(found, name)[b, :count, :sensors] = own[name][near]


def _fill_cameras(
    found: Cameras, b: int, stored: StoredScenario, t: int, moved: Similarity
) -> None:
    count = len(_fill_poses(found, b, stored, t, moved))
    width = found.pixels.shape[3]
    found.intrinsic[b, :count] = moved.of_intrinsics(stored.index["intrinsic"][t], width)
    for c in range(count):
        moved.copy_picture(stored.pictures[t, c], found.pixels[b, c])


def _fill_poses(
    found: Lidars | Cameras, b: int, stored: StoredScenario, t: int, moved: Similarity
) -> Float[np.ndarray, "S 4 4"]:
    """Write the units and the poses of a frame's sensors; gives the poses."""
    kind = "lidar" if isinstance(found, Lidars) else "camera"
    poses = np.array(stored.index[f"{kind}_pose"][t])
    poses[:, :3, 3] -= stored.middle
    poses, count = moved.of_poses(poses), len(poses)
    found.unit[b, :count] = stored.index[f"{kind}_unit"]
    found.present[b, :count] = True
    found.pose[b, :count] = poses
    return poses


def _identities(*leading: int, side: int = 4) -> Float[np.ndarray, "... 4 4"]:
    return np.array(np.broadcast_to(np.eye(side, dtype=np.float32), (*leading, side, side)))
