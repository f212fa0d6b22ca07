"""Studies, which combine layouts, scenes and settings: `inspe sweep`.

Imports are inside the command: Dask loads slowly.
"""

from pathlib import Path

import typer

from inspe_jax.cli.common import busy, err, note_some, out, run_study
from inspe_jax.cli.options import command
from inspe_jax.core.files import check_folder
from inspe_jax.core.words import counted
from inspe_jax.study.plan import load_study

SHOWN = 3
"""Number of failures whose error is printed."""


@command()
def sweep(
    source: Path,
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    retry: bool = False,
    dry_run: bool = False,
    folder: Path = Path("sweep"),
) -> None:
    """Score every layout on every scene in every setting, or run a search from each.

    A study says what to combine. Every setting is one value or a list of values:

        scenes:
          - built_in: four_way
          - {map: Town05.xodr, junction: 53, radius: 60}
          - file: saved.npz
        layouts: [Cam-d1, Cam-d1/L-d1, layout.yaml, {mix: {hesai-xt32: 2, paper-camera: 4}}]
        settings:
          density: [low, medium, high]
          light: [midday, night]
          weather: [clear, "rain:10"]
          weights: [{coverage: 0.3, occlusion: 0.7}, {information_gain: 1}]
        metrics: [detectability]
        detection: mine.toml

    A mix has as many sensors of each device, at corners and roadsides, where a search begins.
    Curves of detectability are those of `inspe score --detection`; a job's key depends on them.
    The folder of --out gets results.csv, with one row for each job and all its settings. To resume
    a run that was stopped or killed, give the same command again. If a job fails, its row has the
    error, and the exit status is 1.

    Examples:

    - `inspe sweep study.yaml --dry-run`
    - `inspe sweep study.yaml --out results --workers 8`
    - `inspe sweep study.yaml --out results --scheduler tcp://cluster:8786`

    Args:
        source (STUDY.yaml): Scenes, layouts and settings; see above.
        retry: Run jobs again that failed in an earlier run.
        dry_run: Only check the study, and print how many jobs it has.
    """
    from inspe_jax.report.tables import sweep_table

    check_folder(folder)
    with busy(f"reading {source}"):
        study = load_study(source)
    if dry_run:
        scenes = {job.scene for job in study.jobs}
        layouts = {job.layout for job in study.jobs}
        out.print(
            f"{study.name}: {counted(len(study.jobs), 'job')}, "
            f"{counted(len(layouts), 'layout')} on {counted(len(scenes), 'scene')}"
        )
        return
    rows = run_study(study, folder, "jobs", scheduler=scheduler, workers=workers, retry=retry)
    out.print(sweep_table(rows))
    failures = [row for row in rows if row["status"] != "done"]
    errors = [f"{row['layout']} on {row['scene']}: {row['error']}" for row in failures]
    note_some(errors, SHOWN, "results.csv has their errors")
    out.print(f"wrote {folder / 'results.csv'}")
    if failures:
        err.print("some jobs failed; --retry runs them again")
        raise typer.Exit(1)
