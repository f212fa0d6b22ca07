"""Claim: a batch is loaded in less than a tenth of a training step, with each of the detectors.

The frames are like those of ``table1.py``: LiDARs and cameras of Cam-d1/L-d1, at the built-in
four-way intersection, pictures of 400 × 300, and two frames a step. Measured for each detector, in
a process of its own, one after the other: its number of parameters, how long a batch takes to load
in one thread, what a step takes, and the peak of the process's memory, in which its compiling is
included.

Recorded frames stay in the folder of --keep.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from common import (
    arguments,
    console,
    in_fresh_process,
    kept_folder,
    output,
    peak_memory,
    progress,
    write_results,
)
from table1 import PICTURES, QUICK_HALF, recorded

from inspe_jax.dataset import open_cache
from inspe_jax.dataset.plan import make_generation
from inspe_jax.perception.detector import MODELS, TEACHER, Detector, loader_of, model_of
from inspe_jax.perception.inputs import BevGrid, inputs_of
from inspe_jax.perception.training.run import AUGMENT, TrainingSettings, agents_of, optimiser
from inspe_jax.perception.training.train import training_step

QUICK_MODELS = ("coalign",)
SHARE = 0.1
"""The largest share of a step that loading may take."""


def frames(given: argparse.Namespace, into: Path) -> Path:
    """The folder of the cache of eight frames."""
    settings: dict[str, Any] = dict(
        mix="fleet", density="medium", light="midday", seconds=8, seed=given.seed
    )
    if given.quick:
        settings |= dict(radius=15.0, voxel=1.0, density=8, seconds=4)
    content = dict(
        name="frames", scenes=[dict(built_in="four_way")], layouts=["Cam-d1/L-d1"], rate_hz=1,
        settings=settings, splits=dict(train=1), pictures="jpeg", image_size=list(PICTURES),
    )  # fmt: skip
    return recorded(given, make_generation(content, into), into / "frames").path


def measured(name: str, path: Path, times: int, half: float) -> dict[str, Any]:
    """The row of a detector."""
    data, grid, settings = open_cache(path), BevGrid(half=half), TrainingSettings(model=name)
    agents, model = agents_of(data), model_of(name)
    how = dict(batch=settings.batch, augment=AUGMENT, workers=0)
    loader = loader_of(name, data, "train", grid, **how)
    batches, loading = loader.steps(), []
    for _ in range(times + 1):
        began = time.perf_counter()
        batch = next(batches)
        inputs = inputs_of(batch, agents)
        loading.append(time.perf_counter() - began)

    inputs, targets = jax.device_put((inputs, batch.targets))
    detector, teacher = (
        eqx.filter_jit(Detector)(model_of(of), agents, grid, jax.random.key(0))
        for of in (name, TEACHER)
    )
    weights = eqx.filter(detector, eqx.is_inexact_array)
    count = sum(leaf.size for leaf in jax.tree.leaves(weights))
    chain = optimiser(settings.steps, settings.rate)
    counted = batch.targets.seen_by(model.sensors)
    constant = teacher if model.taught else None, inputs, targets, counted, grid, chain
    moments = chain.init(weights)

    began = time.perf_counter()
    step: Any = training_step  # jitted by Equinox, whose types do not say so
    compiled = step.lower(constant, detector, moments).compile()
    compiling = time.perf_counter() - began
    steps = []
    for _ in range(times + 1):  # the first touches its memory
        began = time.perf_counter()
        detector, moments, losses = compiled(constant, detector, moments)
        jax.block_until_ready(losses)
        steps.append(time.perf_counter() - began)
    return dict(
        model=name, after=model.source, parameters=count,
        loading_ms=round(1e3 * float(np.median(loading[1:])), 1),
        step_ms=round(1e3 * float(np.median(steps[1:]))),
        compiling_s=round(compiling, 1), memory_gib=round(peak_memory(), 2),
    )  # fmt: skip


def main() -> None:
    """Record, measure, tell."""
    steps = dict(type=int, default=9, help="that are measured")
    given = arguments(__doc__, "seed", "keep", steps=steps)
    given.workers = 1
    models = QUICK_MODELS if given.quick else [name for name in MODELS if name != TEACHER]
    times, half = (2, QUICK_HALF) if given.quick else (given.steps, BevGrid().half)
    rows = []
    with kept_folder(given.keep) as into, progress("detectors") as bar:
        path = frames(given, into)
        for done, name in enumerate(models, 1):
            rows.append(in_fresh_process(measured, name, path, times, half))
            bar(done, len(models), name)
    write_results(output(given, "training_step"), rows, dict(vars(given)))
    share = max(row["loading_ms"] / row["step_ms"] for row in rows)
    console.print(f"loading takes at most {share:.1%} of a step, {SHARE:.0%} was claimed")


if __name__ == "__main__":
    main()
