"""The command `inspe generate`: records every layout on every scene in every setting."""

from collections import Counter
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from inspe_jax.cli.common import busy, err, note, note_some, out, progress, resumable
from inspe_jax.cli.options import command
from inspe_jax.core.files import check_folder
from inspe_jax.core.parallel import cores
from inspe_jax.core.words import counted
from inspe_jax.simulation.backends import check_backend, server_of

if TYPE_CHECKING:
    from inspe_jax.dataset import Generation

SHOWN = 3
"""Number of failed scenarios whose error is printed."""
MOST_NOTES = 12
"""Number of different notes that are printed."""


@command()
def generate(
    source: Path,
    *,
    folder: Path,
    backend: str | None = None,
    workers: int | None = None,
    address: str | None = None,
    files: Path | None = None,
    deep: bool = True,
    dry_run: bool = False,
) -> None:
    """Generate a data set in OPV2V's format: what the sensors of layouts record in scenes.

    A study file says which scenes, layouts and settings to combine. A setting is one value or a
    list:

        scenes:
          - built_in: four_way
          - {map: Town05.xodr, junction: 53, radius: 60}
        layouts: [Cam-d1, Cam-d1/L-d1, layout.yaml]
        settings:
          density: [low, medium, high]
          light: [midday, night]
          seed: [0, 1, 2]
          seconds: 20
        rate_hz: 10
        layers: [depth, instance]
        splits: {train: 7, validate: 1, test: 2}

    Every combination is a scenario. It gets a folder in train, validate or test in --out, which
    appears when the scenario is complete. If a run was stopped or killed, the same command goes on,
    and gives the same bytes; files that were damaged since are recorded again. If a scenario cannot
    be generated, the others are, and the exit status is 1. What the backend cannot record as the
    layout has it is printed at the end, and noted in the scenario's data_protocol.yaml. This file
    in place of the study generates the scenario again.

    Examples:

    - `inspe generate study.yaml --out set --dry-run`
    - `inspe generate study.yaml --out set --workers 8`
    - `inspe generate towns.yaml --out towns --backend carla --server 192.168.0.7:2000`
    - `inspe generate set/train/SCENARIO/data_protocol.yaml --out again`

    Args:
        source (STUDY.yaml): What to record (see above), or a data_protocol.yaml.
        folder (--out DIR): Folder for the data set.
        backend: What records: embedded or carla. If not given, embedded, or as the
            data_protocol.yaml says.
        workers: Number of processes. If not given, one per core, or as the backend allows.
        address (--server HOST:PORT): Address of the CARLA server, with --backend carla;
            127.0.0.1:2000 if not given.
        files (DIR): Folder of the map or saved scene that a data_protocol.yaml names.
        deep (--deep/--sizes): Compare what is there by the digests of files, or by their sizes
            alone, which is faster.
        dry_run: Say what the set would hold, its size and the time it takes: builds every
            scene, and tries every layout on two frames.
    """
    from inspe_jax.dataset import generate as run
    from inspe_jax.dataset import load_generation
    from inspe_jax.simulation.recorder import Server

    check_folder(folder)
    if backend is not None:
        check_backend(backend)
    server = None if address is None else Server.of(address)
    with busy(f"reading {source}"):
        generation = load_generation(source, files)
    server_of(backend or generation.backend, server)
    note(*generation.notes)
    if dry_run:
        _tell_what_it_would_hold(generation, backend or generation.backend, workers)
        return
    with resumable(), progress("frames") as report:
        result = run(
            generation,
            folder,
            backend,
            workers=workers,
            server=server,
            deep=deep,
            progress=report,
            checking=report and partial(report, what="scenarios compared"),
        )
    speed = f", {result.seconds / result.recorded:.2g} s a frame" if result.recorded else ""
    out.print(
        f"{counted(result.scenarios, 'scenario')}, {counted(result.frames, 'frame')}, "
        f"{result.size / 1e6:.1f} MB{speed}"
    )
    out.print(f"wrote {result.folder}")
    damaged = [fault for faults in result.repaired.values() for fault in faults]
    note_some([f"{fault}: recorded again" for fault in damaged], SHOWN, "recorded again, too")
    _note_often(Counter(words for notes in result.notes.values() for words in notes))
    note(*[f"{name}: {error}" for name, error in result.failures.items()][:SHOWN])
    if result.failures:
        failed = counted(len(result.failures), "scenario")
        err.print(f"{failed} could not be generated; the same command tries again")
        raise typer.Exit(1)


def _note_often(counts: Counter[str]) -> None:
    """Print notes on scenarios, each with their number; of many only the first."""
    notes = [f"{words} ({counted(count, 'scenario')})" for words, count in counts.items()]
    note_some(notes, MOST_NOTES, "see notes in each data_protocol.yaml")


def _tell_what_it_would_hold(generation: "Generation", backend: str, workers: int | None) -> None:
    """Print a table of the splits, and the size and the time that the set would take."""
    from inspe_jax.dataset.estimate import estimate
    from inspe_jax.dataset.tables import content_table

    workers = workers or cores()
    with progress("scenarios") as report:
        found = estimate(generation, backend, workers, report)
    each = ", ".join(f"{len(plans)} {split}" for split, plans in generation.splits.items())
    out.print(
        f"{generation.name}: {counted(len(generation.scenarios), 'scenario')} ({each}), "
        f"{counted(generation.frames, 'frame')}"
    )
    out.print(content_table(generation, found))
    _note_often(found.shortfalls)
    if found.size is None or found.seconds is None:
        note(f"backend {backend}: size and time are not known without its server")
        return
    hours = found.seconds / 3600
    took = f"{hours:.1f} h" if hours >= 1 else f"{max(60 * hours, 0.1):.1f} min"
    out.print(
        f"about {found.size / 1e9:.3g} GB, and {took} with {counted(workers, 'worker')} like this"
    )
