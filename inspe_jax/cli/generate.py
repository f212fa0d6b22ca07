"""Data sets, recorded for every layout, scene and setting: `inspe generate`.

Imports are inside the command: Dask loads slowly.
"""

from collections import Counter
from pathlib import Path
from typing import Annotated

import typer

from inspe_jax.cli.common import app, busy, err, note, out, progress

SHOWN = 3
"""Number of failed scenarios whose error is printed."""


@app.command()
def generate(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="STUDY.yaml", help="What to record, see above; or a data_protocol.yaml."
        ),
    ],
    folder: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the data set.")],
    backend: Annotated[
        str | None,
        typer.Option(
            help="Simulator that records: embedded or carla. If not given, embedded, or the one "
            "that a data_protocol.yaml names."
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(help="Processes; one per core if not given. With carla always one."),
    ] = None,
    address: Annotated[
        str | None,
        typer.Option(
            "--server",
            metavar="HOST:PORT",
            help="Address of the CARLA server, for --backend carla; 127.0.0.1:2000 if not given.",
        ),
    ] = None,
    files: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder with the map that a data_protocol.yaml names."),
    ] = None,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="Only check the study, and print what it would record."),
    ] = False,
) -> None:
    """Record a data set in OPV2V's format, for every layout on every scene in every setting.

    A study says what to combine. Every setting is one value or a list of values:

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

    The folder of --out gets train, validate and test, with one folder for each scenario, which
    appears when it is complete. To resume a run that was stopped or killed, give the same command
    again; the files are the same to the byte. To record one scenario again, give its
    data_protocol.yaml in place of the study. What could not be recorded as asked is noted in that
    file, and printed at the end. If a scenario fails, the others are still recorded, and the exit
    status is 1.

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
            made = run(generation, folder, backend, workers=workers, server=server, progress=report)
    except KeyboardInterrupt:
        err.print("stopped; give the same command again to resume", soft_wrap=True)
        raise typer.Exit(130) from None
    speed = f", {made.seconds / made.recorded:.2g} s a frame" if made.recorded else ""
    out.print(
        f"{_counted(made.scenarios, 'scenario')}, {_counted(made.frames, 'frame')}, "
        f"{made.size / 1e6:.1f} MB{speed}",
        highlight=False,
        soft_wrap=True,
    )
    out.print(f"wrote {made.folder}", highlight=False, soft_wrap=True)
    counts = Counter(words for notes in made.notes.values() for words in notes)
    note(f"{words} ({_counted(count, 'scenario')})" for words, count in counts.items())
    failures = list(made.failures.items())
    note(f"{name}: {error}" for name, error in failures[:SHOWN])
    if failures:
        err.print(
            f"{_counted(len(failures), 'scenario')} failed; the same command tries them again",
            soft_wrap=True,
        )
        raise typer.Exit(1)


def _counted(count: int, what: str) -> str:
    return f"{count:,} {what}{'s' * (count != 1)}"
