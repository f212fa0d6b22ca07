"""The commands `inspe dataset stats`, `check`, `cache` and `show`."""

import time
from pathlib import Path

import typer
from rich.text import Text

from inspe_jax.cli.claims import claims
from inspe_jax.cli.common import (
    PICTURES,
    app,
    busy,
    draw,
    note,
    note_some,
    out,
    picture_size,
    progress,
    said,
    show,
)
from inspe_jax.cli.options import command
from inspe_jax.core.files import csv_text, write_text
from inspe_jax.core.words import counted

dataset_app = typer.Typer(
    help="Look at data sets: statistics, single frames, and whether files are damaged.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
)
app.add_typer(dataset_app, name="dataset")

SHOWN = 20
"""Number of faults that are printed."""


@command(dataset_app, name="stats")
def stats(
    data: Path,
    *,
    plot: Path | None = None,
    record: str | None = None,
    row: Path | None = None,
    force: bool = False,
) -> None:
    """Count the content of a data set: frames, boxes, sizes, and points in boxes by range.

    Reads OPV2V's format and its Infra-Set variant. Pictures are counted, but not read.

    Examples:

    - `inspe dataset stats infra`
    - `inspe dataset stats infra --plot infra.png --json infra.json --csv row.csv`
    - `inspe dataset stats infra/test --json -`

    Args:
        row (--csv FILE.csv): Write the data set's row of a table that compares data sets.
    """
    from inspe_jax.core.sheet import FORMATS
    from inspe_jax.dataset.figure import statistics_view
    from inspe_jax.dataset.folders import open_dataset
    from inspe_jax.dataset.manifest import differing
    from inspe_jax.dataset.statistics import statistics, table_row
    from inspe_jax.dataset.tables import statistics_record, statistics_table

    claims.file(plot, FORMATS, force=force)
    claims.file(row, (".csv",), force=force)
    claims.file(record, force=force)
    recorded = open_dataset(data)
    damaged = [fault for scenario in recorded.scenarios for fault in differing(scenario)]
    with progress("frames") as tell:
        found = statistics(recorded, tell)
    show(statistics_table(found), statistics_record(found), record)
    if row:
        values = {key: "" if value is None else value for key, value in table_row(found).items()}
        write_text(row, csv_text([values]))
        said(f"wrote {row}", record)
    draw(lambda: statistics_view(found), plot, record)
    if damaged:
        files = counted(len(damaged), "file")
        note(
            f"{damaged[0]}",
            f"{files} not as the manifests say: see inspe dataset check {data}",
        )
        raise typer.Exit(1)


@command(dataset_app, name="check")
def check_files(
    data: Path,
    *,
    deep: bool = False,
    record: str | None = None,
    force: bool = False,
) -> None:
    """Check whether files of a data set are missing, cut short or changed.

    `inspe generate` writes a manifest.json with each scenario, which has the size and the SHA-256
    of every file. Sizes are compared at once; --deep reads the whole set, as fast as the disk
    allows. The exit status is 1 if a file is not as the manifest says, or a scenario has none. The
    `inspe generate` that made the set records damaged scenarios again.

    Examples:

    - `inspe dataset check infra`
    - `inspe dataset check infra/test --deep --json faults.json`

    Args:
        deep: Read every file, and compare its SHA-256 as well.
    """
    from inspe_jax.dataset.manifest import check

    claims.file(record, force=force)
    began = time.monotonic()
    with progress("scenarios") as tell:
        found = check(data, deep, tell)
    seconds = time.monotonic() - began
    speed = f", {found.size / 1e6 / seconds:,.0f} MB/s" if deep and seconds else ""
    words = (
        f"{counted(found.scenarios, 'scenario')}, {counted(found.files, 'file')}, "
        f"{found.size / 1e6:,.1f} MB compared by {'digest' if deep else 'size'}{speed}: "
        f"{counted(len(found.faults), 'fault') if found.faults else 'no fault'}"
    )
    show(Text(words, no_wrap=True, overflow="ignore"), found.record, record)
    note_some([str(fault) for fault in found.faults], SHOWN, "--json FILE lists all")
    if found.unknown:
        note(
            f"{found.unknown[0]}: no manifest.json, so nothing is known of its files "
            f"({counted(len(found.unknown), 'scenario')} like this)"
        )
    if found.faults or found.unknown:
        raise typer.Exit(1)


@command(dataset_app, name="cache")
def decode(
    data: Path,
    *,
    into: Path,
    size: str = PICTURES,
    workers: int | None = None,
) -> None:
    """Decode a data set into arrays that training reads at once, many times as fast as the files.

    `inspe_jax.dataset.Loader` gives batches of the cache. After a stop, the same command goes on.

    Examples:

    - `inspe dataset cache infra --out infra_cache`
    - `inspe dataset cache infra --out infra_cache --pictures 352x128`
    - `inspe dataset cache infra --out infra_cache --pictures none`

    Args:
        into (--out DIR): Folder for the cache.
        size (--pictures WxH): Width and height of pictures, or none.
        workers: Number of processes; one per core if not given.
    """
    from inspe_jax.dataset import cache

    with progress("frames") as tell:
        made = cache(data, into, pictures=picture_size(size), workers=workers, progress=tell)
    frames = sum(scenario.record.frames for scenario in made.scenarios)
    out.print(
        f"{counted(len(made.scenarios), 'scenario')}, {counted(frames, 'frame')}\nwrote {into}"
    )


@command(dataset_app, name="show")
def show_frame(
    data: Path,
    frame: int,
    *,
    scenario: str | None = None,
    plot: Path | None = None,
    force: bool = False,
) -> None:
    """List the road users of a frame, and draw their boxes on its images and its point cloud.

    The boxes are projected onto the images with the calibration in the files.

    Examples:

    - `inspe dataset show infra/test/four_way 68`
    - `inspe dataset show infra 68 --scenario test/four_way --plot frame.png`

    Args:
        frame (FRAME): The number of the frame.
        scenario (NAME): The scenario, if there are several.
    """
    from inspe_jax.core.sheet import FORMATS
    from inspe_jax.dataset.folders import open_dataset
    from inspe_jax.dataset.frame_figure import frame_view
    from inspe_jax.dataset.tables import frame_table

    claims.file(plot, FORMATS, force=force)
    chosen = open_dataset(data).scenario(scenario)
    with busy(f"reading frame {frame}"):
        table = frame_table(chosen, frame)
    out.print(table)
    draw(lambda: frame_view(chosen, frame), plot)
