"""Data sets: `inspe generate`, and `inspe dataset stats`, `check`, `cache` and `show`."""

from collections import Counter
from functools import partial
from pathlib import Path

import typer
from rich.text import Text

from inspe_jax.cli import common
from inspe_jax.cli.claims import claims
from inspe_jax.cli.options import command, parts_of
from inspe_jax.core.errors import check_known
from inspe_jax.core.files import check_folder, csv_text, write_text
from inspe_jax.core.words import counted
from inspe_jax.simulation.backends import BACKENDS, server_of

dataset_app = typer.Typer(no_args_is_help=True, rich_markup_mode="markdown")
common.app.add_typer(dataset_app, name="dataset", rich_help_panel=common.PANELS["dataset"])


@dataset_app.callback()
def dataset() -> None:
    """Look at data sets: statistics, single frames, and whether files are damaged."""


FAILURES, FAULTS, NOTES = 3, 20, 12
"""Number of failed scenarios, of damaged files and of different notes that are printed."""


@command()
def generate(
    source: Path,
    *,
    folder: Path,
    backend: str | None = None,
    workers: int | None = None,
    address: str | None = None,
    files: Path | None = None,
    dry_run: bool = False,
) -> None:
    """Generate a data set in OPV2V's format: what the sensors of layouts record in scenes.

    A study file says which scenes, layouts and settings to combine, as for `inspe sweep`, and how
    they are recorded:

        scenes: [{built_in: four_way}, {map: Town05.xodr, junction: 53, radius: 60}]
        layouts: [Cam-d1, Cam-d1/L-d1, layout.yaml]
        settings: {density: [low, high], light: [midday, night], seed: [0, 1, 2], seconds: 20}
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
        dry_run: Only check the study, and print what its splits would hold.
    """
    from inspe_jax.dataset import generate as run
    from inspe_jax.dataset import load_generation
    from inspe_jax.dataset.tables import content_table
    from inspe_jax.simulation.recorder import Server

    check_folder(folder)
    if backend is not None:
        check_known(backend, BACKENDS, "backend")
    server = None if address is None else Server.of(address)
    with common.busy(f"reading {source}"):
        generation = load_generation(source, files)
    server_of(backend or generation.backend, server)
    common.note(*generation.notes)
    if dry_run:
        each = ", ".join(f"{len(plans)} {split}" for split, plans in generation.splits.items())
        common.out.print(
            f"{generation.name}: {counted(len(generation.scenarios), 'scenario')} ({each}), "
            f"{counted(generation.frames, 'frame')}"
        )
        common.out.print(content_table(generation))
        return
    with common.resumable(), common.progress("frames") as report:
        result = run(
            generation,
            folder,
            backend,
            workers=workers,
            server=server,
            progress=report,
            checking=report and partial(report, what="scenarios compared"),
        )
    speed = f", {result.seconds / result.recorded:.2g} s a frame" if result.recorded else ""
    common.out.print(
        f"{counted(result.scenarios, 'scenario')}, {counted(result.frames, 'frame')}, "
        f"{result.size / 1e6:.1f} MB{speed}"
    )
    common.out.print(f"wrote {result.folder}")
    again = [f"{one}: recorded again" for faults in result.repaired.values() for one in faults]
    common.note_some(again, FAILURES, "recorded again, too")
    often = Counter(words for notes in result.notes.values() for words in notes)
    notes = [f"{words} ({counted(count, 'scenario')})" for words, count in often.items()]
    common.note_some(notes, NOTES, "see notes in each data_protocol.yaml")
    common.note(*[f"{name}: {error}" for name, error in result.failures.items()][:FAILURES])
    if result.failures:
        failed = counted(len(result.failures), "scenario")
        common.err.print(f"{failed} could not be generated; the same command tries again")
        raise typer.Exit(1)


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

    - `inspe dataset stats infra --plot infra.png --json infra.json --csv row.csv`
    - `inspe dataset stats infra/test --json -`

    Args:
        row (--csv FILE.csv): Write the data set's row of a table that compares data sets.
    """
    from inspe_jax.dataset.figure import statistics_view
    from inspe_jax.dataset.folders import open_dataset
    from inspe_jax.dataset.manifest import compare
    from inspe_jax.dataset.statistics import statistics, table_row
    from inspe_jax.dataset.tables import statistics_record, statistics_table

    claims.outputs(plot, record, force=force)
    claims.file(row, (".csv",), force=force)
    recorded = open_dataset(data)
    damaged = [fault for scenario in recorded.scenarios for fault in compare(scenario.path)[1]]
    with common.progress("frames") as tell:
        found = statistics(recorded, tell)
    common.show(statistics_table(found), statistics_record(found), record)
    if row:
        write_text(row, csv_text([table_row(found)]))
        common.said(f"wrote {row}", record)
    common.draw(lambda: statistics_view(found), plot, record)
    if damaged:
        files = counted(len(damaged), "file")
        words = f"{files} not as the manifests say: see inspe dataset check {data}"
        common.note(f"{damaged[0]}", words)
        raise typer.Exit(1)


@command(dataset_app, name="check")
def check_files(
    data: Path, *, deep: bool = False, record: str | None = None, force: bool = False
) -> None:
    """Check whether files of a data set are missing, cut short or changed.

    `inspe generate` writes a manifest.json with each scenario, which has the size and the SHA-256
    of every file. Sizes are compared at once; --deep reads the whole set, as fast as the disk
    allows. The exit status is 1 if a file is not as the manifest says, or a scenario has none. The
    `inspe generate` that made the set records damaged scenarios again.

    Examples:

    - `inspe dataset check infra/test --deep --json faults.json`

    Args:
        deep: Read every file, and compare its SHA-256 as well.
    """
    from inspe_jax.dataset.manifest import check

    claims.file(record, force=force)
    with common.progress("scenarios") as tell:
        found = check(data, deep, tell)
    words = (
        f"{counted(found.scenarios, 'scenario')}, {counted(found.files, 'file')}, "
        f"{found.size / 1e6:,.1f} MB compared by {'digest' if deep else 'size'}: "
        f"{counted(len(found.faults), 'fault') if found.faults else 'no fault'}"
    )
    common.show(Text(words, no_wrap=True, overflow="ignore"), found.record, record)
    common.note_some([str(fault) for fault in found.faults], FAULTS, "--json FILE lists all")
    if found.unknown:
        common.note(
            f"{found.unknown[0]}: no manifest.json, so nothing is known of its files "
            f"({counted(len(found.unknown), 'scenario')} like this)"
        )
    if found.faults or found.unknown:
        raise typer.Exit(1)


@command(dataset_app, name="cache")
def decode(data: Path, *, into: Path, size: str = "400x300", workers: int | None = None) -> None:
    """Decode a data set into arrays that training reads at once, many times as fast as the files.

    `inspe_jax.dataset.Loader` gives batches of the cache. After a stop, the same command goes on.

    Examples:

    - `inspe dataset cache infra --out infra_cache --pictures 352x128`
    - `inspe dataset cache infra --out infra_cache --pictures none`

    Args:
        into (--out DIR): Folder for the cache.
        size (--pictures WxH): Width and height of pictures, or none.
    """
    from inspe_jax.dataset import cache

    pictures = None
    if size != "none":
        form = "width and height such as 400x300, or none"
        pictures = parts_of("pictures", size, "x", int, (2,), form)[::-1]
    with common.progress("frames") as tell:
        made = cache(data, into, pictures=pictures, workers=workers, progress=tell)
    frames = sum(scenario.record.frames for scenario in made.scenarios)
    scenarios = counted(len(made.scenarios), "scenario")
    common.out.print(f"{scenarios}, {counted(frames, 'frame')}\nwrote {into}")


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
    from inspe_jax.dataset.folders import open_dataset
    from inspe_jax.dataset.frame_figure import frame_view
    from inspe_jax.dataset.tables import frame_table

    claims.outputs(plot, force=force)
    chosen = open_dataset(data).scenario(scenario)
    with common.busy(f"reading frame {frame}"):
        table = frame_table(chosen, frame)
    common.out.print(table)
    common.draw(lambda: frame_view(chosen, frame), plot)
