"""Batches of a cache for training: in a repeatable order, augmented, read ahead by threads.

Threads, not worker processes: what takes time is NumPy copying and multiplying large arrays, during
which Python's lock is free, and no batch has to be copied from another process. A :class:`Loader`
is a source of random access, which ``grain`` can read as well; ``experiments/loading.py`` compares
both.
"""

from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Literal, get_args

import numpy as np
from jaxtyping import Int

from inspe_jax.core.errors import InspeError, check_known, nearest
from inspe_jax.dataset.loading.assemble import Assembly
from inspe_jax.dataset.loading.augment import Augment
from inspe_jax.dataset.loading.batch import Batch
from inspe_jax.dataset.loading.caching import Cache
from inspe_jax.dataset.loading.pillars import PillarGrid
from inspe_jax.dataset.loading.stored import StoredScenario

Sensor = Literal["camera", "lidar"]
SENSORS: tuple[Sensor, ...] = get_args(Sensor)

AHEAD = 2
"""Batches that each worker may be ahead of what was asked for: one that is being made, and one that
is ready when a step of training is quicker than usual."""


class Loader:
    """The batches of a split.

    ``loader[k]`` is the batch of step k ≥ 0, also beyond the first epoch: a training that was
    killed goes on with ``loader.steps(k)``. It depends on ``k``, the seed and the other arguments
    alone, not on ``workers`` or on what was read before. ``len(loader)`` is the number of batches
    of an epoch, and iterating gives the first epoch.

    With ``shuffle``, each epoch has another order, and leaves out what does not fill a batch.
    Without, frames come as stored, and the last batch is filled up with frames that are not
    ``valid``: for evaluation.

    ``sensors`` are "camera", "lidar" or both; what the cache does not have is None in the batches.
    Clouds are given as points, of which each has at most ``points``, the largest of the cache if
    None, or as pillars of a grid. Of a larger cloud a random stretch is taken, another one in each
    epoch; since clouds are stored in random order, it is a fair sample.

    Road users are left out whose middle is farther than ``half`` [m] from the middle of the
    intersection, along x or y: the half of a pillar grid if not given, otherwise none is.
    ``most_boxes`` is the number M of boxes; if not given, the largest of a frame in the cache.
    Where there are more, those farthest from the middle are left out.

    Shapes come from the whole cache, so that they are the same for all of its splits.
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
        points: int | PillarGrid | None = None,
        augment: Augment | None = None,
        half: float | None = None,
        most_boxes: int | None = None,
        workers: int = 2,
    ) -> None:
        """Raises InspeError that says which argument is not allowed, and what is."""
        self.cache, self.split, self.seed, self.batch = cache, split, seed, batch
        self.shuffle, self.workers = shuffle, workers
        self._orders: dict[int, Int[np.ndarray, " F"]] = {}
        self.scenarios: tuple[StoredScenario, ...] = cache.split(split)
        for name, value, least in (("batch", batch, 1), ("seed", seed, 0), ("workers", workers, 0)):
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise InspeError(f"{name} {value!r}: a whole number, at least {least}")
        grid = points if isinstance(points, PillarGrid) else None
        most = None if isinstance(points, PillarGrid) else points
        for name, limit in (("most_boxes", most_boxes), ("points", most)):
            if limit is not None and limit < 1:
                raise InspeError(f"{name} {limit}: must be 1 or more")
        _check_sensors(sensors, cache)
        if grid is not None:
            grid.check()
        if augment is not None:
            augment.check()
        self.half = grid.half if half is None and grid is not None else half
        counts = [scenario.record.frames for scenario in self.scenarios]
        places = [(s, t) for s, count in enumerate(counts) for t in range(count)]
        self.frames: Int[np.ndarray, "F 2"] = np.array(places)
        """Every frame: the index of its scenario, and its place in it."""
        if len(self) == 0:
            raise InspeError(
                f"{cache.path}: split '{split}' has {len(places)} frames, less than a batch of "
                f"{batch}: use a smaller batch, or shuffle=False"
            )
        self.assembly = Assembly(
            cache=cache,
            scenarios=self.scenarios,
            sensors=tuple(sensors),
            grid=grid,
            most_points=most or max(1, *(each.record.most_points for each in cache.scenarios)),
            most_boxes=most_boxes or max(1, *(each.record.most_boxes for each in cache.scenarios)),
            half=self.half,
            augment=augment,
            training=shuffle or augment is not None,
        )

    def __len__(self) -> int:
        """Number of batches of an epoch."""
        frames = len(self.frames)
        return frames // self.batch if self.shuffle else -(-frames // self.batch)

    def __getitem__(self, step: int) -> Batch:
        """The batch of a step. Raises IndexError for a negative one."""
        if step < 0:
            raise IndexError(f"step {step} is below 0")
        epoch, number = divmod(int(step), len(self))
        chosen = self.order(epoch)[number * self.batch : (number + 1) * self.batch]
        draws = [
            np.random.default_rng([self.seed, epoch, number * self.batch + b, 1])
            for b in range(len(chosen))
        ]
        return self.assembly.batch(self.frames[chosen], draws, self.batch)

    def __iter__(self) -> Iterator[Batch]:
        """The batches of the first epoch."""
        return self.steps(0, len(self))

    def steps(self, start: int = 0, stop: int | None = None) -> Iterator[Batch]:
        """The batches of the steps from ``start`` to below ``stop``, or without an end.

        ``workers`` threads make them ahead of time; with 0 they are made when they are asked for.
        """
        if not self.workers:
            step = start
            while stop is None or step < stop:
                yield self[step]
                step += 1
            return
        waiting: deque[Future[Batch]] = deque()
        pool = ThreadPoolExecutor(self.workers, "loader")
        try:
            step = start
            while True:
                while len(waiting) < AHEAD * self.workers and (stop is None or step < stop):
                    waiting.append(pool.submit(self.__getitem__, step))
                    step += 1
                if not waiting:
                    return
                yield waiting.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)

    def find(self, scenario: str | None = None, frame: int | None = None) -> tuple[str, int, int]:
        """A frame by its scenario and number: both, and the step whose batch has it.

        The first scenario, or its first frame, if not given. For loaders without ``shuffle`` and
        with batches of one. Raises InspeError that says which there are.
        """
        names = [each.name for each in self.scenarios]
        if scenario is not None and scenario not in names:
            hint = nearest(scenario, names)
            raise InspeError(
                f"no scenario '{scenario}' in split '{self.split}': it has {', '.join(names[:3])}"
                f"{' …' if len(names) > 3 else ''}{hint}"
            )
        s = 0 if scenario is None else names.index(scenario)
        numbers = self.scenarios[s].index["number"].tolist()
        if frame is not None and frame not in numbers:
            raise InspeError(
                f"{names[s]}: no frame {frame}: it has {len(numbers)}, from {numbers[0]} to "
                f"{numbers[-1]}"
            )
        t = 0 if frame is None else numbers.index(frame)
        at = np.flatnonzero((self.frames == [s, t]).all(1))
        return names[s], numbers[t], int(at[0])

    def order(self, epoch: int) -> Int[np.ndarray, " F"]:
        """The rows of :attr:`frames` in the order of an epoch."""
        if not self.shuffle:
            return np.arange(len(self.frames))
        known = self._orders
        drawn = known.get(epoch)
        if drawn is None:
            rng = np.random.default_rng([self.seed, epoch, 0, 0])
            drawn = rng.permutation(len(self.frames))
        # Threads share what was drawn last; where two draw at once, they draw the same.
        self._orders = {key: known[key] for key in known if abs(key - epoch) == 1} | {epoch: drawn}
        return drawn


def _check_sensors(sensors: Sequence[str], cache: Cache) -> None:
    """Raise InspeError if sensors are unknown, or the cache has none of those that are wanted."""
    if isinstance(sensors, str) or not sensors:
        raise InspeError(f"sensors {sensors!r}: a list with at least one of {', '.join(SENSORS)}")
    for name in sensors:
        check_known(name, SENSORS, "sensors:")
    there = {
        "camera": max(each.record.cameras for each in cache.scenarios),
        "lidar": max(each.record.lidars for each in cache.scenarios),
    }
    if not any(there[name] for name in sensors):
        without = " or ".join(sensors)
        how = (
            "" if cache.pictures or "camera" not in sensors else ": it was made with pictures=None"
        )
        raise InspeError(f"{cache.path}: has no {without}{how}")
