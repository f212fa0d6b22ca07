"""What every experiment shares: its command line, the machine's name, and its output files."""

import argparse
import csv
import json
import os
import platform
import resource
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import jax
import numpy as np
from filelock import FileLock
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

import inspe_jax
from inspe_jax.core.files import write_text
from inspe_jax.scene.maps.registry import read_map

console = Console()
METRICS = {
    "coverage": "C",
    "occlusion": "O",
    "information_gain": "IG",
    "surrogate": "P_sm",
}
"""The columns of the paper's Table 2: names in records, and symbols."""
SCORES = {"surrogate": "P_sm", **METRICS, "detectability": "D"}
"""What is compared with mAP."""
MAPS = Path(__file__).resolve().parents[1].parent / "shared" / "maps"
"""Town maps beside the checkout, where there are any."""


CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
"""A browser to look at pages with, where there is one."""
CHROMIUM_OPTIONS = (
    "--no-sandbox",
    "--ignore-gpu-blocklist",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)
"""Also as root, and in three dimensions without a graphics card."""
UNDRAWN = """for (const name of ['drawArrays', 'drawElements', 'drawRangeElements',
        'drawArraysInstanced', 'drawElementsInstanced'])
    WebGL2RenderingContext.prototype[name] = () => {};"""
"""In a page: nothing is drawn in three dimensions, as though a graphics card did it at once. All
else is as it is, also what a click meets."""


@contextmanager
def progress(what: str) -> Iterator[Callable[..., None]]:
    """Show a bar on a terminal; yields a callback (done, total)."""
    bar = Progress(console=Console(stderr=True), transient=True, disable=not sys.stderr.isatty())
    with bar:
        task = bar.add_task(what, total=None)

        def report(done: int, total: int, what: str = what, facts: str = "") -> None:
            bar.update(task, completed=done, total=total, description=f"{what} {facts}")

        yield report


@contextmanager
def browser_on(url: str, *, drawn: bool = True) -> Iterator[Any]:
    """A tab of 1440 × 900 on a page of scores, in Chromium without a graphics card.

    Unless it is ``drawn``, the scene in three dimensions stays blank.
    """
    from playwright.sync_api import sync_playwright

    with sync_playwright() as play:
        chromium = play.chromium.launch(executable_path=CHROMIUM, args=list(CHROMIUM_OPTIONS))
        tab = chromium.new_page(viewport={"width": 1440, "height": 900})
        if not drawn:
            tab.add_init_script(UNDRAWN)
        tab.goto(url)
        tab.wait_for_selector('[data-state^="all frames"]', timeout=600_000)
        tab.wait_for_timeout(8000)  # until all is drawn
        yield tab
        chromium.close()


OPTIONS: dict[str, dict[str, Any]] = {
    "seed": dict(type=int, default=0),
    "keep": dict(type=Path, help="folder that what is made stays in"),
    "workers": dict(type=int, help="processes; one a core if not given"),
    "scheduler": dict(metavar="ADDRESS", help="a running Dask scheduler"),
    "paper": dict(type=Path, metavar="FILE", help="the paper's Table 2 as CSV"),
}
"""Options that several experiments have."""


def arguments(description: str | None, *shared: str, **own: dict[str, Any]) -> argparse.Namespace:
    """The options of an experiment: ``--quick``, ``--out``, some of :data:`OPTIONS`, its own."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="a small run that shows it works")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for CSV and PNG")
    for name, how in ({name: OPTIONS[name] for name in shared} | own).items():
        parser.add_argument(f"--{name.replace('_', '-')}", **how)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    return options


def output(given: argparse.Namespace, name: str) -> Path:
    """The path of an experiment's output, without a suffix; that of a quick run says so."""
    return given.out / (f"{name}_quick" if given.quick else name)


def need_maps(given: argparse.Namespace) -> None:
    """Stop where the town maps are not at hand, unless the run is quick."""
    if not given.quick and not MAPS.is_dir():
        raise SystemExit(f"the town maps are not at {MAPS}; --quick needs none")


def processes(given: argparse.Namespace) -> int | None:
    """The worker processes that were asked for; a quick run has one if none were.

    It works for less time than a second process takes to import and compile.
    """
    return given.workers or (1 if given.quick else None)


def in_fresh_process(work: Callable[..., Any], *given: Any) -> Any:
    """The result of ``work(*given)`` in a process that has compiled nothing, with its own peak of
    memory."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(work, *given).result()


@contextmanager
def kept_folder(keep: Path | None) -> Iterator[Path]:
    """A folder for what is made: ``keep``, which stays, or one that is gone afterwards."""
    if keep:
        keep.mkdir(parents=True, exist_ok=True)
        yield keep
        return
    with tempfile.TemporaryDirectory() as found:
        yield Path(found)


def on_maps(scenes: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Entries of a study with whole paths of their maps."""
    return [scene | dict(map=str(MAPS / scene["map"])) for scene in scenes]


def town_junction(town: str, junction: int, radius: float, quick: bool) -> inspe_jax.Intersection:
    """A junction of a town map; the built-in four-way in a quick run, or without that map."""
    path = MAPS / f"{town}.xodr"
    if quick or not path.is_file():
        return inspe_jax.built_in("four_way")
    return read_map(path, junction=junction, radius=radius)


def machine() -> dict[str, str]:
    """Processor, cores and versions: what a time means nothing without."""
    processor = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        names = [line for line in info.read_text().splitlines() if line.startswith("model name")]
        processor = names[0].split(":")[1].strip() if names else processor
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return dict(
        processor=processor,
        cores=str(cores),
        python=platform.python_version(),
        jax=jax.__version__,
        numpy=np.__version__,
        inspe_jax=inspe_jax.__version__,
        device=jax.devices()[0].device_kind,
    )


def peak_memory() -> float:
    """Peak resident memory of this process so far [GiB].

    On Linux not by ``getrusage``, whose peak begins at that of the process that started this one.
    """
    status = Path("/proc/self/status")
    if status.is_file():
        line = next(x for x in status.read_text().splitlines() if x.startswith("VmHWM"))
        return int(line.split()[1]) / 2**20
    unit = 1 if sys.platform == "darwin" else 1024  # bytes on macOS, KiB on Linux
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**30


def write_results(
    path: Path,
    rows: list[dict[str, Any]],
    settings: dict[str, Any],
    figure: Figure | None = None,
    dpi: int = 150,
) -> None:
    """Write rows as CSV and, beside them, settings and versions as JSON and the picture as PNG."""
    path = path.with_suffix(".csv")
    with path.open("w", newline="", encoding="utf-8") as f:
        writer = csv.DictWriter(f, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    write_settings(path.with_suffix(".json"), settings)
    if figure is not None:
        figure.savefig(path.with_suffix(".png"), dpi=dpi)
    console.print(f"wrote {path}, .json{'' if figure is None else ' and .png'}", highlight=False)


def show(heads: Sequence[str], rows: Iterable[Sequence[Any]], title: str | None = None) -> None:
    """Print rows as a table."""
    table = Table(*heads, title=title)
    for row in rows:
        table.add_row(*map(str, row))
    console.print(table)


def say(text: str) -> None:
    """Print text, such as Markdown, as it is."""
    console.print(text, highlight=False, soft_wrap=True, markup=False)


def markdown(heads: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A table in Markdown."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)


def with_interval(value: float, low: float, high: float) -> str:
    """A value and its interval in words: without one where that is NaN, a dash where both are."""
    if np.isnan(value):
        return "–"
    return f"{value:.2f}" + ("" if np.isnan(low) else f" [{low:.2f}, {high:.2f}]")


def append_rows(path: Path, rows: list[dict[str, Any]]) -> None:
    """Add rows to a CSV, with a head if it is new; of several processes, one after the other."""
    with FileLock(path.with_name(f".{path.name}.lock")):
        known = read_rows(path)
        names = list(known[0] if known else rows[0])  # a file of before may have fewer columns
        with path.open("a", newline="", encoding="utf-8") as f:
            writer = csv.DictWriter(f, names, extrasaction="ignore", lineterminator="\n")
            if not known:
                writer.writeheader()
            writer.writerows(rows)


def read_rows(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV; none where there is no file."""
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as f:
        return list(csv.DictReader(f))


def write_settings(path: Path, settings: dict[str, Any]) -> None:
    """Write settings, versions and the machine as JSON."""
    record = json.dumps(dict(settings=settings, machine=machine()), indent=2, default=str)
    write_text(path, record + "\n")
