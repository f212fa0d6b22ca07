"""Studies: every layout on every scene in every setting: `inspe sweep`.

Imports stay inside the commands, as of Dask.
"""

from pathlib import Path
from typing import Annotated

import typer

from inspe_jax.cli.common import app, busy, err, note, out, progress

SHOWN = 3
"""Failures whose error is printed."""

StudyArgument = Annotated[
    Path, typer.Argument(metavar="STUDY.yaml", help="Scenes, layouts and settings; see below.")
]


@app.command()
def sweep(
    source: StudyArgument,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="A running Dask scheduler, as tcp://host:8786; else this machine's cores work.",
        ),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(help="Processes on this machine; one a core if not given.")
    ] = None,
    retry: Annotated[
        bool, typer.Option("--retry", help="Try jobs again that failed in an earlier run.")
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Check the study and say how many jobs it has.")
    ] = False,
    folder: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for the results.")
    ] = Path("sweep"),
) -> None:
    """Score every layout on every scene in every setting, or search for better places from each.

    A study says what to combine; every setting is one value or a list of them:

        scenes:
          - built_in: four_way
          - {map: Town05.xodr, junction: 53, radius: 60}
          - file: saved.npz
        layouts: [Cam-d1, Cam-d1/L-d1, layout.yaml]
        settings:
          density: [low, medium, high]
          light: [midday, night]
          weather: [clear, "rain:10"]

    Into --out goes results.csv, a row a job with all its settings, appended as they come. A run
    that was stopped or killed goes on when the same command is given again; jobs that fail have
    their error in their row, and the exit status is then 1.

    Examples:

    - `inspe sweep study.yaml --dry-run`
    - `inspe sweep study.yaml --out results --workers 8`
    - `inspe sweep study.yaml --out results --scheduler tcp://cluster:8786`
    """
    from inspe_jax.core.files import check_folder
    from inspe_jax.report.tables import sweep_table
    from inspe_jax.study.plan import load_study
    from inspe_jax.study.sweep import sweep as run

    check_folder(folder)
    with busy(f"reading {source}"):
        study = load_study(source)
    if dry_run:
        scenes = {job.scene for job in study.jobs}
        layouts = {job.layout for job in study.jobs}
        out.print(
            f"{study.name}: {_counted(len(study.jobs), 'job')}, "
            f"{_counted(len(layouts), 'layout')} on {_counted(len(scenes), 'scene')}",
            highlight=False,
        )
        return
    try:
        with progress("jobs") as report:
            rows = run(
                study,
                folder,
                scheduler=scheduler,
                workers=workers,
                retry=retry,
                progress=report,
            )
    except KeyboardInterrupt:
        err.print("stopped; the same command goes on from here", soft_wrap=True)
        raise typer.Exit(130) from None
    out.print(sweep_table(rows))
    failures = [row for row in rows if row["status"] != "done"]
    note(f"{row['layout']} on {row['scene']}: {row['error']}" for row in failures[:SHOWN])
    if len(failures) > SHOWN:
        note([f"{len(failures)} jobs failed in all; results.csv says why"])
    out.print(f"wrote {folder / 'results.csv'}", highlight=False, soft_wrap=True)
    if failures:
        err.print("some jobs failed; --retry tries them again", soft_wrap=True)
        raise typer.Exit(1)


def _counted(count: int, what: str) -> str:
    return f"{count:,} {what}{'s' * (count != 1)}"
