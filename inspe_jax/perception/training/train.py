"""The loop: batches, steps, and what is kept of them; and many trainings at once."""

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from inspe_jax.core.digest import digest
from inspe_jax.core.errors import InspeError
from inspe_jax.core.parallel import cores
from inspe_jax.dataset.loading import Cache, Loader, Targets, open_cache
from inspe_jax.jobs.engine import Messages, check_workers, load_cluster, run_jobs
from inspe_jax.perception.detector import TEACHER, Detector, Predictor, loader_of, model_of
from inspe_jax.perception.evaluation import NoTruth
from inspe_jax.perception.head import aims, focal_loss, loss, per_road_user, perspective_aims
from inspe_jax.perception.inputs import BevGrid, Inputs, inputs_of
from inspe_jax.perception.training import run as runs
from inspe_jax.perception.training.run import VALIDATION, TrainingRun, TrainingSettings
from inspe_jax.simulation.frame import KINDS


class Report(NamedTuple):
    """How far a training is: the loss is that of late; there is no mAP at first."""

    model: str
    step: int
    steps: int
    loss: float
    mean_ap: float | None


Progress = Callable[[Report], None]  # what is called after each step of a training
Scalar = Float[Array, ""]


class _Losses(NamedTuple):
    heat: Scalar
    values: Scalar
    taught: Scalar
    on_pictures: Scalar


def content_of(cache: Cache, settings: TrainingSettings, grid: BevGrid) -> runs.Content:
    """What a run of these settings on a cache depends on."""
    sources = sorted((each.split, each.name, each.record.source) for each in cache.scenarios)
    frames = {name: sum(one.record.frames for one in own) for name, own in cache.splits.items()}
    return runs.Content(
        settings=settings,
        frames=frames,
        scenarios=digest(sources),
        pictures=None if cache.pictures is None else list(cache.pictures),
        **runs.agents_of(cache)._asdict(),
        **asdict(grid),
    )


def train(
    cache: Cache,
    folder: str | os.PathLike[str],
    settings: TrainingSettings,
    *,
    grid: BevGrid | None = None,
    progress: Progress | None = None,
) -> TrainingRun:
    """Train a detector on the split ``train`` of a cache.

    After a kill, call this again: it goes on from the last state. On a CPU, its losses are then the
    same to the last digit as without the kill. A model that is taught has its teacher
    trained first, in ``folder/teacher``.

    Args:
        cache: The decoded data set.
        folder: Where the run is.
        settings: The model, its steps and their size.
        grid: In plan, from above; the usual one if None.
        progress: Called with a :class:`Report`.

    Raises:
        InspeError: The cache has no data of the model's sensors or no split ``train``; the folder
            has another run, or another process trains it; the last state is damaged; or a loss is
            not a number, in which case the states before it stay.
    """
    grid = grid or BevGrid()
    grid.check()
    model = model_of(settings.model)
    runs.check_sensors(settings.model, cache)
    how: dict[str, Any] = dict(batch=settings.batch, seed=settings.seed, workers=1)
    how["augment"] = runs.AUGMENT if settings.augment else None
    loader = loader_of(settings.model, cache, "train", grid, **how)
    with runs.begun(folder, content_of(cache, settings, grid)) as run:
        teacher = None
        if model.taught:
            own = settings.model_copy(update={"model": TEACHER})
            into = run.path / runs.TEACHER_RUN
            _, teacher = train(cache, into, own, grid=grid, progress=progress).last()
        _train(loader, run, teacher, progress)
    return run


def _train(
    loader: Loader, run: TrainingRun, teacher: Detector | None, progress: Progress | None
) -> None:
    settings, grid, agents = run.content.settings, run.content.grid, run.content.agents
    first, (detector, moments) = run.restore()
    run.forget(first)
    predictor = Predictor(detector, agents, grid)
    if first and not any(row["step"] == first for row in run.rows(VALIDATION)):
        _validate(loader.cache, run, predictor, first)  # a kill came between state and mAP
    if first >= settings.steps:
        return
    chain = runs.optimiser(settings.steps, settings.rate)
    measured = run.rows(VALIDATION)
    late, mean_ap = None, measured[-1]["mean_ap"] if measured else None
    for number, batch in enumerate(loader.steps(first, settings.steps), first + 1):
        seen = batch.targets.seen_by(model_of(settings.model).sensors)
        counted = seen if settings.targets == "seen" else None
        constant = teacher, inputs_of(batch, agents), batch.targets, counted, grid, chain
        detector, moments, losses = training_step(constant, detector, moments)
        row = {name: float(value) for name, value in losses._asdict().items()}
        total = sum(row.values())
        due = number % settings.every == 0 or number == settings.steps
        # A loss is of the weights before its step.
        weights = jax.tree.leaves(eqx.filter(detector, eqx.is_inexact_array)) if due else []
        if not all(np.isfinite(np.asarray(each)).all() for each in (total, *weights)):
            raise InspeError(
                f"{run.path}: step {number} gave no numbers: train into another folder, at a lower "
                f"rate than {settings.rate:g}; the state after step {run.steps} stays"
            )
        run.write(runs.LOSSES, {"step": number, **row})
        late = total if late is None else 0.95 * late + 0.05 * total
        if due:
            run.keep(number, (detector, moments))
            predictor.detector = detector
            mean_ap = _validate(loader.cache, run, predictor, number)
        if progress:
            progress(Report(settings.model, number, settings.steps, late, mean_ap))


def objective(
    detector: Detector,
    teacher: Detector | None,
    inputs: Inputs,
    targets: Targets,
    counted: Bool[Array, "B M"] | None,
    grid: BevGrid,
) -> tuple[Scalar, _Losses]:
    """What is made small, and its parts. Road users that are not ``counted`` have no part in it."""
    predicted = detector(inputs)
    bev = aims(targets, grid, counted)
    heat, values = loss(predicted.found, bev)
    taught = on_pictures = jnp.zeros(())
    if teacher is not None:
        divergence = distillation(predicted.fused, teacher(inputs).fused)
        taught = per_road_user(TAUGHT * len(bev.mask) * divergence, bev.mask)
    if predicted.on_pictures is not None:
        aim, shown = perspective_aims(inputs, targets, predicted.on_pictures.shape[1:3])
        on_pictures = focal_loss(predicted.on_pictures, aim, shown)
    losses = _Losses(heat, values, taught, on_pictures)
    return sum(losses, jnp.zeros(())), losses


TAUGHT = 1e5  # weight beside the sum of a frame's other losses, as in DiscoNet's code


def distillation(taught: Float[Array, "B h w c"], teacher: Float[Array, "B h w c"]) -> Scalar:
    """The loss of a student (DiscoNet, Li et al. 2021): the Kullback–Leibler divergence of
    distributions over channels, as in DiscoNet's code the mean over cells and channels."""
    target = jax.nn.log_softmax(lax.stop_gradient(teacher), -1)
    own = jax.nn.log_softmax(taught, -1)
    return (jnp.exp(target) * (target - own)).mean()


@eqx.filter_jit(donate="all-except-first")
def training_step(
    constant: tuple[Detector | None, Inputs, Targets, Any, BevGrid, runs.Optimiser],
    detector: Detector,
    moments: Any,
) -> tuple[Detector, Any, _Losses]:
    """The detector and the moments after a step, and the losses before it."""
    *of, chain = constant
    gradient, losses = eqx.filter_grad(objective, has_aux=True)(detector, *of)
    weights = eqx.filter(detector, eqx.is_inexact_array)
    # optax mixes whole numbers and fractions
    with jax.numpy_dtype_promotion("standard"):
        updates, moments = chain.update(gradient, moments, weights)
    return eqx.apply_updates(detector, updates), moments, losses


def _validate(cache: Cache, run: TrainingRun, predictor: Predictor, step: int) -> float | None:
    settings = run.content.settings
    if not settings.validate_frames or "validate" not in cache.splits:
        return None
    grid = run.content.grid
    loader = loader_of(settings.model, cache, "validate", grid, batch=1, shuffle=False)
    try:
        found = predictor.evaluate(loader, settings.validate_frames)
    except NoTruth:
        return None
    classes = dict(zip(KINDS, found.class_ap.tolist(), strict=True))
    run.write(VALIDATION, {"step": step, "mean_ap": found.mean_ap, **classes})
    return found.mean_ap


@dataclass(frozen=True)
class Training:
    """A detector to be trained on the cache in the folder ``data``; its run is in ``folder``."""

    data: Path
    folder: Path
    settings: TrainingSettings
    grid: BevGrid

    def train(self, progress: Progress | None = None) -> TrainingRun:
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

    Each goes on from its last state.

    Args:
        trainings: What is trained where.
        work: What a worker does with (training, progress) in place of training; it may measure what
            was trained, and what it gives takes the place of the run.
        scheduler: Address of a running Dask scheduler, whose workers reach caches and runs at the
            same paths.
        workers: Without a scheduler, number of processes on this machine, which share its cores; by
            default one per core, but no more than trainings.
        progress: Called with (steps done, steps) of all trainings together.

    Raises:
        InspeError: Two trainings have the same folder, both of scheduler and workers are given,
            Dask is missing, or no scheduler answers.
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
        given = jobs, _shared, _work, messages.topic, work
        for training, found in run_jobs(client, *given, ahead=1):
            heard((training.key, training.steps))
            yield training, found


def _shared(training: Training) -> None:
    """What the trainings of a cache share: nothing that a worker holds in memory."""


def _work(
    shared: None, training: Training, topic: str, work: Callable[[Training, Progress], Any]
) -> Any:
    settings = training.settings

    def report(now: Report) -> None:
        before = training.steps - settings.steps if now.model == settings.model else 0
        Messages.send(topic, (training.key, before + now.step))

    return work(training, report)
