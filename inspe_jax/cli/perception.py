"""Detectors trained on data sets: `inspe train`, `inspe evaluate` and `inspe detect`."""

from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from inspe_jax.cli import common
from inspe_jax.cli.claims import claims
from inspe_jax.cli.options import Positive, Whole, command
from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import check_folder, check_model, json_value, prepare_folder
from inspe_jax.jobs.engine import check_workers

if TYPE_CHECKING:
    from inspe_jax.dataset import Cache, Loader
    from inspe_jax.perception.training import TrainingRun, TrainingSettings

BOX = ("x", "y", "z", "length", "width", "height", "yaw", "velocity_x", "velocity_y")
"""Names of a box's numbers in records [m, rad, m/s], about the middle of the intersection."""


@command()
def train(
    recorded: Path,
    *,
    folder: Path,
    model: list[str] | None = None,
    steps: Positive = 1500,
    batch: Positive = 2,
    rate: float = 0.002,
    seed: Annotated[list[int] | None, typer.Option(min=0)] = None,
    every: Positive = 250,
    validate: Whole = 60,
    augment: bool = True,
    targets: str = "seen",
    workers: int | None = None,
    scheduler: str | None = None,
) -> None:
    """Train a detector, or several, on the split train of a cache.

    The detectors of InSPE's Table 1 are lss-eff and lss-resnet (cameras), v2vnet, v2x-vit and
    coalign (LiDARs), attfuse, disconet and hm-vit (both). They are small: what two cores train in
    an hour. early-fusion is disconet's teacher, which is trained first.

    RUN gets losses.csv, validation.csv and the last two states. To go on after a stop, give the
    same command again; on a CPU, losses are the same as without the stop.

    With several models or seeds, each is trained by a process of its own, and has a folder of its
    own in RUN, such as RUN/coalign_0.

    Examples:

    - `inspe train infra_cache --model lss-eff --steps 3000 --out lss-eff`
    - `inspe train infra_cache --model v2x-vit --model coalign --seed 0 --seed 1 --out runs`

    Args:
        folder (--out RUN): Folder of the training.
        model: Detector; see above. Repeat it for more. coalign if not given.
        steps: Steps of training.
        batch: Frames of a step.
        rate: Highest learning rate.
        seed: Seed of the weights, the order of frames and the augmentation. Repeat it for more.
        every: Steps after which the state is kept, and mAP measured.
        validate: Frames of the split validate that mAP is measured on.
        augment: Mirror, turn and scale frames at random.
        targets (seen|all): Road users to be found: those that the detector's sensors see, or all.
    """
    from inspe_jax.dataset import open_cache
    from inspe_jax.perception import training

    check_folder(folder)
    given: dict[str, Any] = dict(steps=steps, batch=batch, rate=rate, every=every)
    given |= dict(validate_frames=validate, augment=augment, targets=targets)
    wanted = []
    for name, number in dict.fromkeys(product(model or ["coalign"], seed or [0])):
        own = dict(model=name, seed=number, **given)
        wanted.append(check_model(training.TrainingSettings, own, "training"))
    check_workers(scheduler, workers)
    many = len(wanted) > 1 or workers is not None or scheduler is not None
    data = open_cache(recorded)
    with common.resumable():
        if many:
            _train_many(data, folder, wanted, workers, scheduler)
        else:
            _train_one(data, folder, wanted[0])


def _train_one(data: "Cache", folder: Path, settings: "TrainingSettings") -> None:
    """A training in this process, with a bar."""
    with common.progress("compiling") as tell:

        def report(now: Any) -> None:
            facts = f"loss {now.loss:.2f}"
            if now.mean_ap is not None:
                facts += f", mAP {now.mean_ap:.1%}"
            if tell:
                tell(now.step, now.steps, now.model, facts)
            elif now.step % settings.every == 0:
                common.err.print(f"{now.model}: step {now.step:,} of {now.steps:,}, {facts}")

        from inspe_jax.perception import training

        run = training.train(data, folder, settings, progress=report)
    common.out.print(f"{settings.model}: {_summary(run)}\nwrote {folder}")


def _train_many(
    data: "Cache",
    folder: Path,
    wanted: "list[TrainingSettings]",
    workers: int | None,
    scheduler: str | None,
) -> None:
    """Trainings in processes of their own, with a bar of the steps of all."""
    from inspe_jax.perception import training
    from inspe_jax.perception.inputs import BevGrid

    folders = [folder.resolve()]
    if len(wanted) > 1:
        folders = [folders[0] / f"{own.model}_{own.seed}" for own in wanted]
        prepare_folder(folder)
    path, grid = data.path.resolve(), BevGrid()
    pairs = zip(folders, wanted, strict=True)
    jobs = [training.Training(path, into, own, grid) for into, own in pairs]
    failed, how = 0, dict[str, Any](workers=workers, scheduler=scheduler)
    with common.progress("steps") as tell:
        for job, found in training.train_all(jobs, progress=tell, **how):
            if isinstance(found, Exception):
                failed += 1
                common.err.print(f"{job.folder.name}: {found}")
            else:
                common.out.print(f"{job.folder.name}: {_summary(found)}")
    if failed:
        raise InspeError(f"{failed} of {len(jobs)} trainings failed, see above")
    common.out.print(f"wrote {folder}")


def _summary(run: "TrainingRun") -> str:
    """What a training came to."""
    rows = run.rows("validation.csv")
    found = f", mAP {rows[-1]['mean_ap']:.1%} on the split validate" if rows else ""
    return f"{run.steps:,} steps{found}"


@command()
def evaluate(
    run: Path,
    recorded: Path,
    *,
    split: str = "test",
    record: str | None = None,
    force: bool = False,
) -> None:
    """Measure what a trained detector finds: nuScenes' mAP, by class.

    Detections are true if they are nearer than 0.5, 1, 2 and 4 m to a road user of their class; AP
    is the mean over these. All road users of the frames count, also those that no sensor sees, so
    that placements of sensors are measured against the same traffic. The last columns are of those
    that the detector's sensors see, a return or a pixel of them: nuScenes counts those with points.

    Examples:

    - `inspe evaluate v2x-vit infra_cache --split validate --json found.json`
    """
    from inspe_jax.perception.evaluation import evaluation_table

    claims.file(record, force=force)
    training, step, loader, predictor = _ready(run, recorded, split)
    with common.progress("frames") as tell:
        found = predictor.evaluate(loader, progress=tell)
    content = {"run": str(training.path), "split": split, "step": step, "classes": found.rows()}
    common.show(evaluation_table(found, _unfinished(training, step)), json_value(content), record)


@command()
def detect(
    run: Path,
    recorded: Path,
    *,
    frame: int | None = None,
    scenario: str | None = None,
    split: str = "test",
    least: Annotated[float, typer.Option(min=0, max=1)] = 0.3,
    plot: Path | None = None,
    record: str | None = None,
    force: bool = False,
) -> None:
    """List what a trained detector finds in a frame, and draw it beside the ground truth.

    Examples:

    - `inspe detect v2x-vit infra_cache --plot detections.png`
    - `inspe detect v2x-vit infra_cache --scenario four_way --frame 68 --score 0.1`

    Args:
        frame: Number of the frame; the first if not given.
        scenario (NAME): Its scenario; the first if not given.
        least (--score): Least score that is shown.
    """
    from inspe_jax.dataset import Loader
    from inspe_jax.perception import figure
    from inspe_jax.perception.evaluation import detections_table
    from inspe_jax.simulation.frame import KINDS

    claims.outputs(plot, record, force=force)
    training, step, loader, predictor = _ready(run, recorded, split)
    name, number, index = loader.find(scenario, frame)
    batch = loader[index]
    with common.busy("detecting"):
        (found,) = predictor(batch)
    boxes = [
        {"class": KINDS[kind], "score": score, **dict(zip(BOX, box, strict=True))}
        for box, kind, score in zip(*found, strict=True)
        if score >= least
    ]
    where = {"run": str(training.path), "step": step, "scenario": name, "frame": number}
    until = _unfinished(training, step)
    written = json_value({**where, "detections": boxes})
    common.show(detections_table(found, least, until), written, record)

    def drawn() -> Any:
        title = f"{training.content.settings.model}: {name}, frame {number}{until}"
        whole = Loader(loader.cache, split, batch=1, shuffle=False, half=loader.half)[index]
        return figure.draw(whole, 0, found, title, least_score=least)

    common.draw(drawn, plot, record)


def _unfinished(run: "TrainingRun", step: int) -> str:
    """What titles add for a detector of a training that was not done."""
    steps = run.content.settings.steps
    return "" if step >= steps else f", after {step:,} of {steps:,} steps"


def _ready(folder: Path, cache: Path, split: str) -> "tuple[TrainingRun, int, Loader, Any]":
    """A run, the step of its last state, the frames of a cache in order, and what detects there."""
    from inspe_jax.dataset import open_cache
    from inspe_jax.perception import training
    from inspe_jax.perception.detector import loader_of
    from inspe_jax.perception.training.run import check_pictures, check_sensors

    run = training.open_run(folder)
    content = run.content
    step, detector = run.last()
    name, data = content.settings.model, open_cache(cache)
    check_sensors(name, data)
    check_pictures(run, data)
    loader = loader_of(name, data, split, content.grid, batch=1, shuffle=False)
    return run, step, loader, training.Predictor(detector, content.agents, content.grid)
