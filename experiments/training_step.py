"""Claim: a batch is loaded in less than a tenth of a training step, with each of the detectors.

The frames are like those of ``table1.py``: LiDARs and cameras of Cam-d1/L-d1, at the built-in
four-way intersection, pictures of 400 × 300, and two frames a step. Measured for each detector, in
a process of its own, one after the other: its number of parameters, how long a batch takes to load
in one thread, what a step takes and its parts, and the peak of the process's memory, in which its
compiling is included.

The parts are differences between gradients: of the encoders' maps, of the fused map, and of the
whole loss. The optimiser is what it takes by itself. So a part is known no better than a step
varies: a small one may come out below 0, and they add up to a step only roughly. Where a teacher is
needed, its maps are part of the loss. Each is the median over steps, and all are measured in turn.

Recorded frames stay in the folder of --keep.
"""

import argparse
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from common import command_line, kept_folder, peak_memory, write_results
from rich.console import Console
from table1 import NAMES, PICTURES, recorded

from inspe_jax.cli.common import progress
from inspe_jax.dataset import open_cache
from inspe_jax.dataset.plan import make_generation
from inspe_jax.perception.detector import MODELS, TEACHER, Detector, model_of, parameters
from inspe_jax.perception.inputs import BevGrid, Inputs, inputs_of
from inspe_jax.perception.training.optimiser import optimiser, updates_of
from inspe_jax.perception.training.predict import loader_of
from inspe_jax.perception.training.settings import AUGMENT, Settings, agents_of
from inspe_jax.perception.training.train import objective, training_step

QUICK_MODELS = ("coalign",)
SHARE = 0.1
"""The largest share of a step that loading may take."""
PARTS = ("encoders", "pyramids and fusion", "head and losses", "optimiser")

console = Console()


def options() -> argparse.Namespace:
    """The command line."""
    parser = command_line(__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="folder that the frames stay in: 1 GB")
    parser.add_argument("--steps", type=int, default=9, help="that are measured of each part")
    given = parser.parse_args()
    given.workers = 1
    given.out.mkdir(parents=True, exist_ok=True)
    return given


def frames(given: argparse.Namespace, into: Path) -> Path:
    """The folder of the cache of eight frames."""
    settings: dict[str, Any] = dict(
        mix="fleet", density="medium", light="midday", seconds=8, seed=given.seed
    )
    if given.quick:
        settings |= dict(radius=25.0, voxel=1.0, seconds=4)
    content = dict(
        name="frames", scenes=[dict(built_in="four_way")], layouts=["Cam-d1/L-d1"], rate_hz=1,
        settings=settings, splits=dict(train=1), pictures="jpeg", image_size=list(PICTURES),
    )  # fmt: skip
    return recorded(given, make_generation(content, into), into / "frames").path


def medians(works: list[Callable[[], Any]], times: int) -> list[float]:
    """The median time of each work that gives arrays [s], after each was done once.

    They take turns, so that what slows the machine for a while slows all of them.
    """
    seconds = np.zeros((times + 1, len(works)))
    for turn in seconds:
        for k, work in enumerate(works):
            began = time.perf_counter()
            jax.block_until_ready(work())
            turn[k] = time.perf_counter() - began
    return [float(median) for median in np.median(seconds[1:], axis=0)]


def encoders_only(detector: Detector, inputs: Inputs) -> jax.Array:
    """A number that depends on all that the encoders give."""
    maps, _, on_pictures = detector.encoded(inputs)
    every = [*maps, *([] if on_pictures is None else [on_pictures])]
    return sum((jnp.square(x).sum() for x in every), jnp.zeros(()))


def to_fused(detector: Detector, inputs: Inputs) -> jax.Array:
    """A number that depends on the fused map, and on heat on the pictures."""
    maps, present, on_pictures = detector.encoded(inputs)
    found = jnp.square(detector.fused(maps, present)).sum()
    return found if on_pictures is None else found + jnp.square(on_pictures).sum()


def measured(name: str, path: Path, times: int, half: float) -> dict[str, Any]:
    """The row of a detector."""
    data, grid, settings = open_cache(path), BevGrid(half=half), Settings(model=name)
    agents, model = agents_of(data), model_of(name)
    how = dict(batch=settings.batch, augment=AUGMENT, workers=0)
    loader = loader_of(name, data, "train", grid, **how)
    batches = loader.steps()
    (loading,) = medians([lambda: inputs_of(next(batches), agents)], times)

    batch = next(batches)
    inputs, targets = jax.device_put((inputs_of(batch, agents), batch.targets))
    detector, teacher = (
        eqx.filter_jit(Detector)(model_of(of), agents, grid, jax.random.key(0))
        for of in (name, TEACHER)
    )
    chain = optimiser(settings.steps, settings.rate)
    constant = teacher if model.taught else None, inputs, targets, grid, chain
    state = [detector, chain.init(eqx.filter(detector, eqx.is_inexact_array))]

    def step() -> Any:
        *state[:], losses = training_step(constant, *state)
        return losses

    def gradient(of: Callable[..., Any], *more: Any) -> Callable[[], Any]:
        found = eqx.filter_jit(eqx.filter_grad(of, has_aux=of is objective))
        return lambda: found(state[0], *more)

    updated = eqx.filter_jit(updates_of)

    def update() -> Any:
        weights = eqx.filter(state[0], eqx.is_inexact_array)
        return updated(chain, weights, state[1], weights)  # of gradients, only their shapes count

    began = time.perf_counter()
    jax.block_until_ready(step())
    compiling = time.perf_counter() - began
    memory = peak_memory()
    works = [
        gradient(encoders_only, inputs),
        gradient(to_fused, inputs),
        gradient(objective, *constant[:-1]),
        update,
        step,
    ]
    *ends, updating, whole = medians(works, times)
    parts = zip(PARTS, [*np.diff([0, *ends]), updating], strict=True)
    return dict(
        model=name, after=model.source, parameters=parameters(detector),
        loading_ms=round(1e3 * loading, 1), step_ms=round(1e3 * whole),
        **{f"{part}_ms": round(1e3 * seconds) for part, seconds in parts},
        compiling_s=round(compiling, 1), memory_gib=round(memory, 2),
    )  # fmt: skip


def table(rows: list[dict[str, Any]]) -> str:
    """The rows in Markdown."""
    heads = ("detector", "after", "parameters", "a batch", "a step", *PARTS, "memory")
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for row in rows:
        cells = [NAMES[row["model"]], row["after"], f"{row['parameters']:,}"]
        cells += [f"{row['loading_ms']} ms", f"{row['step_ms'] / 1e3:.2f} s"]
        cells += [f"{row[f'{part}_ms'] / 1e3:.2f}" for part in PARTS]
        lines.append("| " + " | ".join([*cells, f"{row['memory_gib']} GiB"]) + " |")
    return "\n".join(lines)


def main() -> None:
    """Record, measure, tell."""
    given = options()
    models = QUICK_MODELS if given.quick else [name for name in MODELS if name != TEACHER]
    times, half = (2, 25.6) if given.quick else (given.steps, BevGrid().half)
    rows = []
    with kept_folder(given.keep) as into, progress("detectors") as bar:
        path = frames(given, into)
        for done, name in enumerate(models, 1):
            # A process each, so that each has a peak of its own.
            with ProcessPoolExecutor(1, get_context("spawn")) as pool:
                rows.append(pool.submit(measured, name, path, times, half).result())
            if bar:
                bar(done, len(models), name)
    out = given.out / "training_step.csv"
    write_results(out, rows, dict(vars(given)))
    console.print(table(rows), highlight=False, soft_wrap=True, markup=False)
    share = max(row["loading_ms"] / row["step_ms"] for row in rows)
    console.print(f"loading takes at most {share:.1%} of a step, {SHARE:.0%} was claimed")
    console.print(f"wrote {out} and .json", highlight=False)


if __name__ == "__main__":
    main()
