"""Batches of a cache for training: in a repeatable order, augmented, read ahead by threads.

Threads, not worker processes: what takes time is NumPy copying and multiplying large arrays, during
which Python's lock is free, and no batch has to be copied from another process. A :class:`Loader`
is a source of random access, which ``grain`` can read as well; ``experiments/loading.py`` compares
both.
"""

from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import count
from typing import Literal, get_args

import numpy as np
from jaxtyping import Int

from inspe_jax.core.errors import InspeError, check_known, nearest
from inspe_jax.dataset.loading.assemble import Assembly
from inspe_jax.dataset.loading.batch import Batch
from inspe_jax.dataset.loading.caching import Cache
from inspe_jax.dataset.loading.geometry import Augment
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
    Clouds are given as they are, or their ``points`` as pillars of a grid. They are in random
    order, so the first points of a cloud are a fair sample of it.

    Road users are left out whose middle is farther than ``half`` [m] from the middle of the
    intersection, along x or y: the half of a pillar grid if not given, otherwise none is.

    Shapes come from the whole cache, so that they are the same for all of its splits: each cloud
    has room for the largest one, and each frame for the most road users.
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
        self.assembly = Assembly(
            cache=cache,
            scenarios=self.scenarios,
            sensors=tuple(sensors),
            grid=points,
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
        """A frame by its scenario and number: both, and the step whose batch has it.

        The first scenario, or its first frame, if not given. For loaders without ``shuffle`` and
        with batches of one. Raises InspeError that says which there are.
        """
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
        how = ": it was made with pictures=None" * ("camera" in sensors and not cache.pictures)
        raise InspeError(f"{cache.path}: has no {' or '.join(sensors)}{how}")
