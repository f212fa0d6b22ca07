"""Batches of a cache, in repeatable order, read ahead by threads; ``grain`` reads them, too."""

from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import count
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float, Int

from inspe_jax.core.errors import InspeError, check_known, nearest
from inspe_jax.dataset.loading.batch import Batch, Cameras, Lidars, Pillars, Targets
from inspe_jax.dataset.loading.caching import Cache
from inspe_jax.dataset.loading.geometry import Augment, Similarity
from inspe_jax.dataset.loading.pillars import PillarGrid
from inspe_jax.dataset.loading.stored import StoredScenario, to_metres, woven

Sensor = Literal["camera", "lidar"]
SENSORS: tuple[Sensor, ...] = get_args(Sensor)

_Frame = tuple[StoredScenario, int]  # a scenario, and the place of a frame in it

AHEAD = 2  # batches that each worker may be ahead: one that is being made, and one that is ready


class Loader:
    """The batches of a split, in shapes of the whole cache.

    ``loader[k]`` is the batch of step k ≥ 0, also beyond the first epoch of ``len(loader)``
    batches; it depends on ``k`` and the arguments but ``workers`` alone, so a training goes on with
    ``loader.steps(k)``.

    With ``shuffle``, each epoch has another order, and leaves out what does not fill a batch.
    Without, for evaluation, frames come as stored, and the last batch is filled up with frames that
    are not ``valid``. ``sensors`` are "camera", "lidar" or both; what the cache does not have is
    None. Clouds are in random order, given as they are or as ``points`` of a pillar grid; which
    pillars are kept of too many is drawn with ``shuffle`` or ``augment``. Road users farther than
    ``half`` [m] from the middle along x or y are left out: the half of a pillar grid if not given,
    otherwise none is.
    """

    def __init__(
        self,
        cache: Cache,
        split: str = "train",
        *,
        batch: int = 4,
        seed: int = 0,
        shuffle: bool = True,
        sensors: Sequence[Sensor] = SENSORS,
        points: PillarGrid | None = None,
        augment: Augment | None = None,
        half: float | None = None,
        workers: int = 2,
    ) -> None:
        """Raises InspeError that says which argument is not allowed, and what is."""
        self.cache, self.split, self.seed, self.batch = cache, split, seed, batch
        self.shuffle, self.workers = shuffle, workers
        self.scenarios: tuple[StoredScenario, ...] = cache.split(split)
        for name, value, least in (("batch", batch, 1), ("seed", seed, 0), ("workers", workers, 0)):
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise InspeError(f"{name} {value!r}: a whole number, at least {least}")
        _check_sensors(sensors, cache)
        for each in (points, augment):
            if each is not None:
                each.check()
        self.sensors, self.grid, self.augment = tuple(sensors), points, augment
        self.half = points.half if half is None and points is not None else half
        counts = [scenario.record.frames for scenario in self.scenarios]
        places = [(s, t) for s, count in enumerate(counts) for t in range(count)]
        self.frames: Int[np.ndarray, "F 2"] = np.array(places)
        """Every frame: the index of its scenario, and its place in it."""
        if len(self) == 0:
            raise InspeError(
                f"{cache.path}: split '{split}' has {len(places)} frames, less than a batch of "
                f"{batch}: use a smaller batch, or shuffle=False"
            )

    def __len__(self) -> int:
        frames = len(self.frames)
        return frames // self.batch if self.shuffle else -(-frames // self.batch)

    def __getitem__(self, step: int) -> Batch:
        """The batch of a step. Raises IndexError for a negative one."""
        if step < 0:
            raise IndexError(f"step {step} is below 0")
        epoch, number = divmod(int(step), len(self))
        first = number * self.batch
        chosen = self.order(epoch)[first : first + self.batch]
        found = self._empty()
        for b, (s, t) in enumerate(self.frames[chosen].tolist()):
            draw = np.random.default_rng([self.seed, epoch, first + b, 1])
            moved = Similarity() if self.augment is None else self.augment.similarity(draw)
            of = self.scenarios[s], t
            found.scenario[b], found.number[b] = s, of[0].index["number"][t]
            found.transform[b], found.valid[b] = moved.matrix, True
            if found.lidars is not None:
                self._fill_lidars(found.lidars, b, of, moved, draw)
            if found.cameras is not None:
                _fill_cameras(found.cameras, b, of, moved)
            self._fill_targets(found.targets, b, of, moved)
        if found.cameras is not None:
            found.cameras.pixels[~found.cameras.present] = 0
        return found

    def __iter__(self) -> Iterator[Batch]:
        return self.steps(0, len(self))

    def steps(self, start: int = 0, stop: int | None = None) -> Iterator[Batch]:
        """The batches from step ``start`` to below ``stop``, or without an end, made ahead."""
        each = count(start) if stop is None else iter(range(start, stop))
        if not self.workers:
            yield from map(self.__getitem__, each)
            return
        waiting: deque[Future[Batch]] = deque()
        pool = ThreadPoolExecutor(self.workers, "loader")
        try:
            for step in each:
                waiting.append(pool.submit(self.__getitem__, step))
                if len(waiting) == AHEAD * self.workers:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)

    def find(self, scenario: str | None = None, frame: int | None = None) -> tuple[str, int, int]:
        """A frame by its scenario and number, or the first: both, and the step whose batch has it.
        For loaders without ``shuffle``, of batches of one. Raises InspeError that says which there
        are."""
        names = [each.name for each in self.scenarios]
        name = names[0] if scenario is None else scenario
        if name not in names:
            more = " …" * (len(names) > 3)
            raise InspeError(
                f"no scenario '{name}' in split '{self.split}': it has {', '.join(names[:3])}{more}"
                f"{nearest(name, names)}"
            )
        s = names.index(name)
        numbers = self.scenarios[s].index["number"].tolist()
        number = numbers[0] if frame is None else frame
        if number not in numbers:
            raise InspeError(
                f"{name}: no frame {number}: it has {len(numbers)}, from {numbers[0]} to "
                f"{numbers[-1]}"
            )
        before = sum(each.record.frames for each in self.scenarios[:s])
        return name, number, before + numbers.index(number)

    def order(self, epoch: int) -> Int[np.ndarray, " F"]:
        """The rows of :attr:`frames` in the order of an epoch."""
        if not self.shuffle:
            return np.arange(len(self.frames))
        return np.random.default_rng([self.seed, epoch, 0, 0]).permutation(len(self.frames))

    def _empty(self) -> Batch:
        """A batch that is all padding; shapes are those of the whole cache."""
        size, records = self.batch, [each.record for each in self.cache.scenarios]
        lidars = max(each.lidars for each in records)
        cameras = max(each.cameras for each in records)
        pixels, found_lidars, found_cameras = self.cache.pictures, None, None
        if "lidar" in self.sensors and lidars:
            points, mask, pillars = None, None, None
            if self.grid is None:
                shape = size, lidars, max(1, *(each.most_points for each in records))
                points, mask = np.zeros((*shape, 4), np.float32), np.zeros(shape, bool)
            else:
                pillars = self.grid.empty(size, max(each.lidar_units for each in records))
            found_lidars = Lidars(points, mask, pillars, *_no_sensors(size, lidars))
        if "camera" in self.sensors and cameras and pixels:
            colours = np.empty((size, cameras, *pixels, 3), np.uint8)
            intrinsic = _identities(size, cameras, side=3)
            found_cameras = Cameras(colours, intrinsic, *_no_sensors(size, cameras))
        places = size, max(1, *(each.most_boxes for each in records))
        targets = Targets(
            boxes=np.zeros((*places, 9), np.float32),
            kind=np.zeros(places, np.int32),
            track=np.zeros(places, np.int32),
            returns=np.zeros((*places, lidars), np.int32),
            pixels=np.zeros((*places, cameras), np.float32),
            mask=np.zeros(places, bool),
        )
        number, valid = np.zeros(size, np.int32), np.zeros(size, bool)
        given = found_lidars, found_cameras, targets
        return Batch(*given, number.copy(), number, _identities(size), valid)

    def _fill_lidars(
        self, found: Lidars, b: int, of: _Frame, moved: Similarity, draw: np.random.Generator
    ) -> None:
        (stored, t), clouds = of, list[np.ndarray]()
        index, poses = stored.index, _fill_poses(found, b, of, moved)
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
            order = draw if self.shuffle or self.augment is not None else None
            for g, unit in enumerate(np.unique(index["lidar_unit"])):
                own = [clouds[s] for s in np.flatnonzero(index["lidar_unit"] == unit)]
                group = Pillars(*(part[b, g] for part in found.pillars))
                self.grid.fill(woven(own), group, order)

    def _fill_targets(self, found: Targets, b: int, of: _Frame, moved: Similarity) -> None:
        stored, t = of
        rows = stored.boxes(t)
        boxes = np.array(stored.index["boxes"][rows])
        boxes[:, :3] -= stored.middle
        boxes = moved.of_boxes(boxes)
        near = np.ones(len(boxes), bool)
        if self.half is not None:
            near = np.abs(boxes[:, :2]).max(1, initial=0) <= self.half
        count = int(near.sum())
        found.mask[b, :count], found.boxes[b, :count] = True, boxes[near]
        for name in ("kind", "track", "returns", "pixels"):
            own = stored.index[name][rows][near]  # of as many sensors as the scenario has
            getattr(found, name)[(b, slice(count), *map(slice, own.shape[1:]))] = own


def _fill_cameras(found: Cameras, b: int, of: _Frame, moved: Similarity) -> None:
    stored, t = of
    count = len(_fill_poses(found, b, of, moved))
    width = found.pixels.shape[3]
    found.intrinsic[b, :count] = moved.of_intrinsics(stored.index["intrinsic"][t], width)
    for c in range(count):
        moved.copy_picture(stored.pictures[t, c], found.pixels[b, c])


def _fill_poses(
    found: Lidars | Cameras, b: int, of: _Frame, moved: Similarity
) -> Float[np.ndarray, "S 4 4"]:
    """Write the units and the poses of a frame's sensors; gives the poses."""
    stored, t = of
    kind = "lidar" if isinstance(found, Lidars) else "camera"
    poses = np.array(stored.index[f"{kind}_pose"][t])
    poses[:, :3, 3] -= stored.middle
    poses, count = moved.of_poses(poses), len(poses)
    found.unit[b, :count] = stored.index[f"{kind}_unit"]
    found.present[b, :count] = True
    found.pose[b, :count] = poses
    return poses


def _no_sensors(*shape: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return _identities(*shape), np.zeros(shape, bool), np.zeros(shape, np.int32)


def _identities(*leading: int, side: int = 4) -> Float[np.ndarray, "... n n"]:
    return np.array(np.broadcast_to(np.eye(side, dtype=np.float32), (*leading, side, side)))


def _check_sensors(sensors: Sequence[str], cache: Cache) -> None:
    """Raise InspeError if sensors are unknown, or the cache has none of those that are wanted."""
    if isinstance(sensors, str) or not sensors:
        raise InspeError(f"sensors {sensors!r}: a list with at least one of {', '.join(SENSORS)}")
    for name in sensors:
        check_known(name, SENSORS, "sensors:")
    if not any(getattr(each.record, f"{name}s") for each in cache.scenarios for name in sensors):
        how = ": it was made with pictures=None" * ("camera" in sensors and not cache.pictures)
        raise InspeError(f"{cache.path}: has no {' or '.join(sensors)}{how}")
