"""What all commands share: the app, its consoles, arguments, progress bars, and errors."""

import json
import re
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer
from rich.console import Console
from rich.text import Text

from inspe_jax.core.errors import InspeError, nearest

if TYPE_CHECKING:
    from inspe_jax.scene.scene import Scene
    from inspe_jax.sensing.layout import Layout
    from inspe_jax.study.plan import Study
    from inspe_jax.study.work import Row

app = typer.Typer(
    help="Score and optimise roadside cameras and LiDARs at road intersections.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
)
out = Console()
err = Console(stderr=True, highlight=False)

DEFAULT_SCENE = "four_way"
DEFAULT_LAYOUT = "Cam-d1"

SceneArgument = Annotated[
    str, typer.Argument(metavar="SCENE", help="A built-in intersection, or a scene saved as .npz.")
]
LayoutArgument = Annotated[
    str,
    typer.Argument(
        metavar="LAYOUT",
        help="A layout file (.yaml, or .geojson of `inspe export`), or the name of a strategy.",
    ),
]
LightOption = Annotated[str, typer.Option(help="Light: midday, dusk or night.")]
WeatherOption = Annotated[
    str, typer.Option(help="Weather: clear, rain:10 (10 mm/h), or fog:200 (optical range 200 m).")
]
ProfileOption = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help="Profile for a built-in scene: paper (used if not given) or ideal; see "
        "`inspe profiles`.",
    ),
]
PlotOption = Annotated[
    Path | None, typer.Option("--plot", metavar="FILE", help="Draw a figure: .png, .svg or .pdf.")
]
RecordOption = Annotated[
    str | None,
    typer.Option("--json", metavar="FILE|-", help="Write the result as JSON; - prints it instead."),
]
PICTURES = "400x300"
"""Width and height that pictures are decoded to if no option says [pixels]."""


def picture_size(text: str) -> tuple[int, int] | None:
    """Height and width of an option such as 400x300; None for none."""
    found = re.fullmatch(r"(\d+)x(\d+)", text)
    if not found and text != "none":
        raise InspeError(f"--pictures {text}: width and height such as 400x300, or none")
    return (int(found[2]), int(found[1])) if found else None


def main() -> None:
    """Run the command line. An InspeError is printed on one line; the exit status is then 2."""
    try:
        _run()
    except SystemExit as e:
        # Only if a search has compiled: importing this takes longer than most commands.
        ahead = sys.modules.get("inspe_jax.placement.compile_ahead")
        if ahead is not None and ahead.compiles():
            leave_at_once(e.code if isinstance(e.code, int) else int(e.code is not None))
        raise


def leave_at_once(status: int) -> NoReturn:
    """End the process, whatever its other threads compile or score."""
    from inspe_jax.core.compiling import leave

    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError):  # the reader of the pipe has gone
            stream.flush()
    leave(status)


def _run() -> None:
    try:
        app()
    except InspeError as e:
        err.print(f"[bold red]Error:[/] {plain(str(e))}", soft_wrap=True)
        sys.exit(2)
    except OSError as e:
        where = f"{e.filename}: " if e.filename else ""
        words = e.strerror or str(e) or type(e).__name__  # a TimeoutError often says nothing
        err.print(f"[bold red]Error:[/] {plain(where + words)}", soft_wrap=True)
        sys.exit(2)


def _version(wanted: bool) -> None:
    if wanted:
        from inspe_jax.core.version import __version__

        out.print(f"inspe_jax {__version__}", highlight=False)
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
    cache: Annotated[
        bool,
        typer.Option(
            envvar="INSPE_CACHE",
            help="Keep compiled programs for the next run, in the user's cache folder.",
        ),
    ] = True,
) -> None:
    import jax

    if cache:
        keep_compiled()
    else:
        jax.config.update("jax_enable_compilation_cache", False)


COMPILED = 512 * 2**20
"""Largest size of the cache of compiled programs [bytes]; the least used go first."""


def keep_compiled() -> None:
    """Let JAX keep compiled programs from one run to the next.

    A cache folder that the user has set for JAX stays. If no folder can be written, every run
    compiles again.
    """
    import jax
    from platformdirs import user_cache_path

    if jax.config.jax_compilation_cache_dir is not None:  # type: ignore[attr-defined]
        return
    try:
        folder = user_cache_path("inspe_jax", appauthor=False)
        if not folder.is_absolute():  # there is no home folder
            return
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except (OSError, RuntimeError):
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_compilation_cache_max_size", COMPILED)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def known(source: str) -> str:
    """Check the name of a built-in. Raises InspeError that lists what a scene can be."""
    from inspe_jax.scene.procedural.built_ins import BUILT_INS
    from inspe_jax.scene.scene import what_is

    if source not in BUILT_INS:
        if other := what_is(source):
            raise InspeError(f"{source}: {other}")
        raise InspeError(
            f"no scene '{source}': give a built-in ({', '.join(BUILT_INS)}), a map (.xodr, "
            f".net.xml, .osm) or a saved .npz{nearest(source, tuple(BUILT_INS))}"
        )
    return source


def scene_and_layout(source: str, sensors: str, profile: str | None) -> "tuple[Scene, Layout]":
    """A scene, and a layout on it from a file or from the name of a strategy."""
    from inspe_jax.scene.scene import load_scene

    world = load_scene(source, profile)
    return world, layout_on(world, sensors)


def layout_on(world: "Scene", sensors: str, *, unit_rule: bool = True) -> "Layout":
    """A layout on a scene, from a file or from the name of a strategy.

    With ``unit_rule``, the sensors of each unit in the file must be close to each other; see
    :func:`~inspe_jax.sensing.layout.make_layout`.
    """
    from inspe_jax.placement.strategies import STRATEGIES, strategy
    from inspe_jax.scene.geojson import SUFFIX
    from inspe_jax.scene.scene import what_is
    from inspe_jax.sensing.layout import load_layout
    from inspe_jax.sensing.layout_geojson import load_layout_geojson

    suffix = Path(sensors).suffix.lower()
    of_layouts = suffix in (".yaml", ".yml", SUFFIX)
    if not of_layouts and (other := what_is(sensors)):
        raise InspeError(f"{sensors}: no layout: {other}")
    if of_layouts or Path(sensors).is_file():
        layout = (
            load_layout_geojson(sensors, world.intersection, unit_rule=unit_rule)
            if suffix == SUFFIX
            else load_layout(sensors, world, unit_rule=unit_rule)
        )
        note_other_profile(world, layout)
        return layout
    if sensors.lower() not in (name.lower() for name in STRATEGIES):
        raise InspeError(
            f"no layout '{sensors}': give a .yaml or .geojson file, or a strategy: "
            + ", ".join(STRATEGIES)
            + nearest(sensors, tuple(STRATEGIES))
        )
    return strategy(world, sensors)


def note_other_profile(world: "Scene", layout: "Layout") -> None:
    """Print a note if a layout was made under another profile than its scene."""
    here = world.profile.name
    if layout.profile not in (None, here):
        note(
            [
                f"{layout.name} was made under the profile {layout.profile}, but the scene "
                f"under {here}"
            ]
        )


@contextmanager
def busy(what: str) -> Iterator[None]:
    """Show a spinner, if stderr is a terminal."""
    if not err.is_terminal:
        yield
        return
    with err.status(f"{what} …"):
        yield


@contextmanager
def progress(what: str) -> Iterator[Any]:
    """Show a progress bar on a terminal; yields a callback (done, total), or None elsewhere.

    The callback may be told ``what`` is counted now, and begins anew where that has changed; and
    ``facts`` to show beside it.
    """
    if not err.is_terminal:
        yield None
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
    from rich.progress import TimeRemainingColumn as TimeLeft

    facts = TextColumn("{task.fields[facts]}")
    words = TextColumn("{task.description}")
    columns = (words, BarColumn(), MofNCompleteColumn(), TimeLeft(), facts)
    # The time left is estimated from all steps so far, since some take minutes.
    with Progress(*columns, console=err, transient=True, speed_estimate_period=1e9) as bar:
        task = bar.add_task(what, total=None, facts="")

        def report(done: int, total: int, what: str = what, facts: str = "") -> None:
            # Steps of an earlier run say nothing of speed.
            if bar.tasks[0].total is None or what != bar.tasks[0].description:
                bar.reset(task, total=total, completed=done, description=what)
            bar.update(task, completed=done, facts=facts)

        yield report


def run_study(
    study: "Study",
    folder: Path,
    what: str,
    scheduler: str | None,
    workers: int | None,
    retry: bool,
) -> "list[Row]":
    """The rows of a study, run with a bar that counts ``what``. Ctrl-C ends the command."""
    from inspe_jax.study.sweep import sweep as run

    try:
        with progress(what) as report:
            return run(
                study,
                folder,
                scheduler=scheduler,
                workers=workers,
                retry=retry,
                progress=report,
            )
    except KeyboardInterrupt:
        err.print("stopped; give the same command again to resume", soft_wrap=True)
        raise typer.Exit(130) from None


@contextmanager
def search_bar(what: str) -> Iterator[Callable[[float, float, str], None] | None]:
    """Show a bar with the best score and the time left, on a terminal.

    Yields a callback (fraction done, best score, what is being done), or None elsewhere.
    """
    if not err.is_terminal:
        yield None
        return
    from rich.progress import BarColumn, Progress, TextColumn

    first: list[tuple[float, float]] = []  # time of the first call, and the fraction then
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[facts]}"))
    with Progress(*columns, console=err, transient=True) as bar:
        task = bar.add_task(what, total=1.0, facts="compiling …")

        def report(done: float, best: float, now: str) -> None:
            if not first:
                first.append((time.monotonic(), done))
            began, before = first[0]
            spent = time.monotonic() - began
            gone = done - before  # a search that is resumed does not begin at 0
            left = f", {spent * (1 - done) / gone:.0f} s left" if gone > 0.02 else ""
            name = f"{what}: {now}" if now else what
            bar.update(task, completed=done, description=name, facts=f"best {best:.4f}{left}")

        yield report


def check_record(path: str | None) -> None:
    """Raise InspeError if the file of ``--json`` cannot be written; "-" is stdout."""
    from inspe_jax.core.files import check_output

    if path != "-":
        check_output(path)


def show(table: Any, record: dict[str, Any], path: str | None) -> None:
    """Print a table, and write its record as JSON to ``path``; for "-" print the record alone."""
    from inspe_jax.core.files import write_text

    text = json.dumps(record, indent=2)
    if path == "-":
        typer.echo(text)
        return
    out.print(table)
    if path:
        write_text(path, text + "\n")
        out.print(f"wrote {path}", highlight=False)


def note(notes: Iterable[str]) -> None:
    """Print notes on stderr, one per line."""
    for words in notes:
        err.print(Text.assemble(("Note: ", "yellow"), words), soft_wrap=True)


def plain(message: str) -> str:
    """A message in which brackets are not read as rich's markup."""
    from rich.markup import escape

    return escape(message)
