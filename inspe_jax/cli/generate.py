"""Data sets: every layout on every scene in every setting, recorded: `inspe generate`.

Imports stay inside the command, as of Dask.
"""

from collections import Counter
from pathlib import Path
from typing import Annotated

import typer

from inspe_jax.cli.common import app, busy, err, note, out, progress
from inspe_jax.simulation.backends import BACKENDS, DEFAULT_BACKEND

SHOWN = 3
"""Scenarios that could not be made whose error is printed."""


@app.command()
def generate(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="STUDY.yaml", help="What to record, see below; or a data_protocol.yaml."
        ),
    ],
    folder: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the data set.")],
    backend: Annotated[
        str | None,
        typer.Option(
            help=f"What records: {' or '.join(BACKENDS)}. If not given, {DEFAULT_BACKEND}, or as "
            "the data_protocol.yaml says."
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            help="Number of processes. If not given, one per core, or as the backend allows."
        ),
    ] = None,
    address: Annotated[
        str | None,
        typer.Option(
            "--server",
            metavar="HOST:PORT",
            help="Where CARLA listens, with --backend carla; 127.0.0.1:2000 if not given.",
        ),
    ] = None,
    files: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder of the map that a data_protocol.yaml names."),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Check the study and say what it would make.")
    ] = False,
) -> None:
    """Make a data set in the format of OPV2V: what sensors record at every layout, scene, setting.

    A study says what to combine; every setting is one value or a list of them:

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

    Into --out go train, validate and test with a folder for each scenario, which appears when it
    is whole. A run that was stopped or killed goes on when the same command is given again, to
    the same bytes. A scenario's data_protocol.yaml in place of the study makes it once more; what
    could not be recorded as asked is noted in it, and at the end. Where scenarios cannot be made,
    the others are, and the exit status is 1.

    Examples:

    - `inspe generate study.yaml --out set --dry-run`
    - `inspe generate study.yaml --out set --workers 8`
    - `inspe generate towns.yaml --out towns --backend carla --server 192.168.0.7:2000`
    - `inspe generate set/train/SCENARIO/data_protocol.yaml --out again`
    """
    from inspe_jax.core.files import check_folder
    from inspe_jax.dataset import generate as run
    from inspe_jax.dataset import load_generation
    from inspe_jax.simulation.backends import check_backend, server_of
    from inspe_jax.simulation.recorder import Server

    check_folder(folder)
    if backend is not None:
        check_backend(backend)
    server = None if address is None else Server.of(address)
    with busy(f"reading {source}"):
        generation = load_generation(source, files)
    server_of(backend or generation.backend, server)
    note(generation.notes)
    if dry_run:
        each = ", ".join(f"{len(plans)} {split}" for split, plans in generation.splits.items())
        out.print(
            f"{generation.name}: {_counted(len(generation.scenarios), 'scenario')} ({each}), "
            f"{_counted(generation.frames, 'frame')}",
            highlight=False,
            soft_wrap=True,
        )
        return
    try:
        with progress("frames") as report:
            result = run(
                generation, folder, backend, workers=workers, server=server, progress=report
            )
    except KeyboardInterrupt:
        err.print("stopped; the same command goes on from here", soft_wrap=True)
        raise typer.Exit(130) from None
    speed = f", {result.seconds / result.recorded:.2g} s a frame" if result.recorded else ""
    out.print(
        f"{_counted(result.scenarios, 'scenario')}, {_counted(result.frames, 'frame')}, "
        f"{result.size / 1e6:.1f} MB{speed}",
        highlight=False,
        soft_wrap=True,
    )
    out.print(f"wrote {result.folder}", highlight=False, soft_wrap=True)
    counts = Counter(words for notes in result.notes.values() for words in notes)
    note(f"{words} ({_counted(count, 'scenario')})" for words, count in counts.items())
    failures = list(result.failures.items())
    note(f"{name}: {error}" for name, error in failures[:SHOWN])
    if failures:
        err.print(
            f"{_counted(len(failures), 'scenario')} could not be made; "
            "the same command tries again",
            soft_wrap=True,
        )
        raise typer.Exit(1)


def _counted(count: int, what: str) -> str:
    return f"{count:,} {what}{'s' * (count != 1)}"
