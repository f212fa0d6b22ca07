"""What every command shares: the app, its consoles, arguments, progress, and how errors end."""

import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.text import Text

from inspe_jax.core.errors import InspeError, nearest

if TYPE_CHECKING:
    from inspe_jax.scene.scene import Scene
    from inspe_jax.sensing.layout import Layout

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
    str, typer.Argument(metavar="[SCENE]", help="A built-in intersection or a saved .npz scene.")
]
LayoutArgument = Annotated[
    str, typer.Argument(metavar="[LAYOUT]", help="A layout .yaml, or a strategy by name.")
]
LightOption = Annotated[str, typer.Option(help="Light: midday, dusk or night.")]
WeatherOption = Annotated[
    str, typer.Option(help="Weather: clear; rain:10, in mm/h; or fog:200, in m of optical range.")
]
ProfileOption = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help="Profile that a built-in is built under: paper, if not given, or ideal (see "
        "`inspe profiles`).",
    ),
]
PlotOption = Annotated[
    Path | None, typer.Option("--plot", metavar="FILE", help="Draw it: .png, .svg or .pdf.")
]


def main() -> None:
    """Run the command line; an error that the user can mend is one line and status 2."""
    try:
        _run()
    except SystemExit as e:
        # Only if a search has compiled: importing it would take longer than most commands.
        ahead = sys.modules.get("inspe_jax.placement.compile_ahead")
        if ahead is not None and ahead.compiles():
            from inspe_jax.core.compiling import leave

            for stream in (sys.stdout, sys.stderr):
                with suppress(OSError):  # nobody reads it any more
                    stream.flush()
            leave(e.code if isinstance(e.code, int) else int(e.code is not None))
        raise


def _run() -> None:
    try:
        app()
    except InspeError as e:
        err.print(f"[bold red]Error:[/] {plain(str(e))}", soft_wrap=True)
        sys.exit(2)
    except OSError as e:
        where = f"{e.filename}: " if e.filename else ""
        err.print(f"[bold red]Error:[/] {plain(where + (e.strerror or str(e)))}", soft_wrap=True)
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
            help="Keep what is compiled for the next run, in the user's cache folder.",
        ),
    ] = True,
) -> None:
    import jax

    if cache:
        keep_compiled()
    else:
        jax.config.update("jax_enable_compilation_cache", False)


COMPILED = 512 * 2**20
"""Most that what is kept compiled may take up on disk [bytes]; what is used least goes first."""


def keep_compiled() -> None:
    """Let JAX keep what it compiles from one run to the next.

    As the user set it up for JAX, if so. Where there is nowhere to write to, every run compiles
    anew.
    """
    import jax
    from platformdirs import user_cache_path

    if jax.config.jax_compilation_cache_dir is not None:  # type: ignore[attr-defined]
        return
    try:
        folder = user_cache_path("inspe_jax", appauthor=False)
        if not folder.is_absolute():  # no home
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
    """The name of a built-in; raises InspeError with all that a scene can come from."""
    from inspe_jax.scene.procedural.built_ins import BUILT_INS

    if source not in BUILT_INS:
        raise InspeError(
            f"no scene '{source}': a built-in ({', '.join(BUILT_INS)}), a map (.xodr, .net.xml, "
            f".osm) or a saved .npz{nearest(source, tuple(BUILT_INS))}"
        )
    return source


def scene_and_layout(source: str, sensors: str, profile: str | None) -> "tuple[Scene, Layout]":
    """A scene, and the layout that a file or a strategy's name gives on it."""
    from inspe_jax.scene.scene import load_scene

    world = load_scene(source, profile)
    return world, layout_on(world, sensors)


def layout_on(world: "Scene", sensors: str, *, unit_rule: bool = True) -> "Layout":
    """The layout that a file or a strategy's name gives on a scene.

    Without ``unit_rule`` also one whose units' sensors are too far apart.
    """
    from inspe_jax.placement.strategies import STRATEGIES, strategy
    from inspe_jax.sensing.layout import load_layout

    if Path(sensors).suffix in (".yaml", ".yml") or Path(sensors).is_file():
        layout = load_layout(sensors, world, unit_rule=unit_rule)
        note_other_profile(world, layout)
        return layout
    if sensors.lower() not in (name.lower() for name in STRATEGIES):
        raise InspeError(
            f"no layout '{sensors}': a .yaml file or a strategy: {', '.join(STRATEGIES)}"
            + nearest(sensors, tuple(STRATEGIES))
        )
    return strategy(world, sensors)


def note_other_profile(world: "Scene", layout: "Layout") -> None:
    """Say so where a layout was made under another profile than its scene."""
    here = world.profile.name
    if layout.profile not in (None, here):
        note([f"{layout.name} was made under the profile {layout.profile}, the scene under {here}"])


@contextmanager
def busy(what: str) -> Iterator[None]:
    """A spinner on a terminal, nothing elsewhere."""
    if not err.is_terminal:
        yield
        return
    with err.status(f"{what} …"):
        yield


@contextmanager
def progress(what: str) -> Iterator[Any]:
    """A progress bar with time left on a terminal; gives a callback (done, total) or None."""
    if not err.is_terminal:
        yield None
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
    from rich.progress import TimeRemainingColumn as TimeLeft

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeLeft())
    # The time left is from all steps so far: some take minutes each.
    with Progress(*columns, console=err, transient=True, speed_estimate_period=1e9) as bar:
        task = bar.add_task(what, total=None)

        def tell(done: int, total: int) -> None:
            if bar.tasks[0].total is None:  # what was done before it began says nothing of speed
                bar.reset(task, total=total, completed=done)
            bar.update(task, completed=done)

        yield tell


@contextmanager
def search_bar(what: str) -> Iterator[Callable[[float, float, str], None] | None]:
    """A bar with the best score and the time left, on a terminal.

    Gives a callback of the share done, the best score and a word on what is under way; or None.
    """
    if not err.is_terminal:
        yield None
        return
    from rich.progress import BarColumn, Progress, TextColumn

    first: list[tuple[float, float]] = []  # when it was first heard of, and how far it was then
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[facts]}"))
    with Progress(*columns, console=err, transient=True) as bar:
        task = bar.add_task(what, total=1.0, facts="compiling …")

        def tell(done: float, best: float, now: str) -> None:
            if not first:
                first.append((time.monotonic(), done))
            began, before = first[0]
            spent = time.monotonic() - began
            gone = done - before  # since then: a search that is taken up again begins half way
            left = f", {spent * (1 - done) / gone:.0f} s left" if gone > 0.02 else ""
            name = f"{what}: {now}" if now else what
            bar.update(task, completed=done, description=name, facts=f"best {best:.4f}{left}")

        yield tell


def check_record(path: str | None) -> None:
    """Raise InspeError where the file of ``--json`` cannot be written; - is stdout."""
    from inspe_jax.core.files import check_output

    if path != "-":
        check_output(path)


def show(table: Any, record: dict[str, Any], path: str | None) -> None:
    """A table, and its record as JSON in the file of ``--json``; for - the record alone."""
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
    """What a person should know, a line each."""
    for words in notes:
        err.print(Text.assemble(("Note: ", "yellow"), words), soft_wrap=True)


def plain(message: str) -> str:
    """Text with rich's markup brackets escaped."""
    from rich.markup import escape

    return escape(message)
