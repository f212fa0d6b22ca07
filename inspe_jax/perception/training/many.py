"""Many trainings at once, on Dask workers: of this machine, or of a running cluster."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from inspe_jax.core.errors import InspeError
from inspe_jax.core.parallel import cores
from inspe_jax.dataset.loading import open_cache
from inspe_jax.jobs.engine import Messages, check_workers, load_cluster, run_jobs
from inspe_jax.perception.detector import model_of
from inspe_jax.perception.inputs import BevGrid
from inspe_jax.perception.training.run import Run
from inspe_jax.perception.training.settings import Settings
from inspe_jax.perception.training.train import Report, train

Progress = Callable[[Report], None]
"""What is called after each step of a training."""


@dataclass(frozen=True)
class Training:
    """A detector to be trained on the cache in the folder ``data``; its run is in ``folder``."""

    data: Path
    folder: Path
    settings: Settings
    grid: BevGrid

    def train(self, progress: Progress | None = None) -> Run:
        """Do it, in this process."""
        data = open_cache(self.data)
        return train(data, self.folder, self.settings, grid=self.grid, progress=progress)

    @property
    def key(self) -> str:
        """The folder: no two trainings have the same."""
        return str(self.folder)

    @property
    def scene(self) -> str:
        """The cache, of which a worker does all trainings before it goes to another."""
        return str(self.data)

    @property
    def steps(self) -> int:
        """Steps of the training, and of its teacher's where the model is taught."""
        return self.settings.steps * (2 if model_of(self.settings.model).taught else 1)

    @property
    def source(self) -> tuple[str, str]:
        """The model and the cache, which decide what is compiled."""
        return self.settings.model, str(self.data)


def train_all(
    trainings: Sequence[Training],
    *,
    work: Callable[[Training, Progress], Any] = Training.train,
    scheduler: str | None = None,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Iterator[tuple[Training, Any]]:
    """Train every detector; yields each training as it is done, with its run or its exception.

    Each goes on from its last state. ``progress`` is called with (steps done, steps) of all
    trainings together. With ``work``, a worker does ``work(training, progress)``, which may measure
    what was trained, and what that gives takes the place of the run.

    ``scheduler``: address of a running Dask scheduler, whose workers reach caches and runs at the
    same paths. ``workers``: without a scheduler, number of processes on this machine, which share
    its cores; by default one per core, but no more than trainings. Raises InspeError if two
    trainings have the same folder, if both of these are given, if Dask is missing, or if no
    scheduler answers.
    """
    folders = [training.folder for training in trainings]
    if twice := [folder for folder in folders if folders.count(folder) > 1]:
        raise InspeError(f"{twice[0]}: is the folder of two trainings: give each its own")
    check_workers(scheduler, workers)
    if not trainings:
        return
    done = dict.fromkeys((training.key for training in trainings), 0)
    steps = sum(training.steps for training in trainings)

    def heard(message: tuple[str, int]) -> None:
        key, number = message
        done[key] = max(done[key], number)
        if progress:
            progress(sum(done.values()), steps)

    count = workers or min(cores(), len(trainings))
    with load_cluster().client(scheduler, count) as client:
        messages = Messages(client, heard)
        jobs = sorted(trainings, key=lambda training: training.scene)
        for training, found in run_jobs(
            client, jobs, _shared, _work, messages.topic, work, ahead=1
        ):
            heard((training.key, training.steps))
            yield training, found


def _shared(training: Training) -> None:
    """What the trainings of a cache share: nothing that a worker holds in memory."""


def _work(
    shared: None, training: Training, topic: str, work: Callable[[Training, Progress], Any]
) -> Any:
    """What a worker does."""
    settings = training.settings

    def report(now: Report) -> None:
        before = training.steps - settings.steps if now.model == settings.model else 0
        Messages.send(topic, (training.key, before + now.step))

    return work(training, report)
