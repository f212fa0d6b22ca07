"""What all commands share: the app, its consoles, arguments, progress bars, and errors."""

import ast
import json
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from functools import cache
from importlib import import_module
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer
from rich.console import Console
from rich.text import Text
from typer.core import TyperCommand, TyperGroup

from inspe_jax.cli.claims import claims
from inspe_jax.cli.stopping import CTRL_C, attended, step, stopped
from inspe_jax.core.compiling import compiled, leave
from inspe_jax.core.errors import InspeError, missing_extra
from inspe_jax.core.files import read_json, write_text
from inspe_jax.core.version import __version__
from inspe_jax.core.words import visible

if TYPE_CHECKING:
    from inspe_jax.scene.scene import Scene
    from inspe_jax.sensing.layout import Layout

GROUPS = {
    "Start here": (
        "scene.examples", "scene.scene", "scene.layout", "score.score", "score.targets",
        "show.view", "score.metrics", "score.devices", "score.profiles",
    ),
    "Search": ("search.optimise", "search.compare", "search.pareto"),
    "Hand over": ("show.report", "show.export", "score.tolerance"),
    "Studies": ("study.sweep", "study.plan"),
    "Data sets and detectors": (
        "dataset.generate", "dataset.dataset", "perception.train", "perception.evaluate",
        "perception.detect",
    ),
}  # fmt: skip
"""The commands in the order of ``inspe --help``, each a function of a module in this folder."""
MODULES = {name.split(".")[1]: name.split(".")[0] for names in GROUPS.values() for name in names}
PANELS = {name.split(".")[1]: group for group, names in GROUPS.items() for name in names}
"""The module and the group of each command."""


@cache
def _docstrings(module: str) -> dict[str, str | None]:
    """Those of a module's functions, read from its text: importing it takes longer."""
    tree = ast.parse(files(__package__).joinpath(f"{module}.py").read_text("utf-8"))
    return {it.name: ast.get_docstring(it) for it in tree.body if isinstance(it, ast.FunctionDef)}


class _Group(TyperGroup):
    """The commands. One's module is imported when it is called; the others have help alone."""

    def __init__(self, **how: Any) -> None:
        super().__init__(**how)
        for name, panel in PANELS.items():
            words = _docstrings(MODULES[name])[name]
            command = TyperCommand(name, help=words, rich_help_panel=panel)
            self.commands[name] = self.commands.pop(name, command)  # in this order

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if module := MODULES.get(args[0]):
            import_module(f"{__package__}.{module}")
            self.commands = typer.main.get_group(app).commands
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            err.print(Text(stopped()))
            leave_at_once(CTRL_C)  # XLA may still compute, and crashes if Python ends before it


app = typer.Typer(
    cls=_Group,
    help="Score and optimise roadside cameras, LiDARs and radars at road intersections.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
)


class WholeConsole(Console):
    """A console that cuts and breaks no line of text."""

    def print(self, *objects: Any, **how: Any) -> None:
        """Print as rich does, with whole lines."""
        texts = [visible(x) if isinstance(x, str) else x for x in objects]
        for text in texts:
            if isinstance(text, Text):
                text.plain = visible(text.plain)
        lines = all(isinstance(x, str | Text) for x in objects)
        super().print(*texts, **{"crop": False, "soft_wrap": lines} | how)


out = WholeConsole(highlight=False, markup=False)
err = WholeConsole(stderr=True, highlight=False)

EXTRAS = {
    "dataset": "dataset", "detect": "perception", "evaluate": "perception", "generate": "dataset",
    "report": "report", "train": "perception", "view": "view",
}  # fmt: skip
"""The extra that brings the libraries of a whole command."""
DEFAULT_SCENE = "four_way"
DEFAULT_LAYOUT = "Cam-d1"


def main() -> None:
    """Run the command line. An InspeError is printed on one line; the exit status is then 2."""
    try:
        with attended(note, leave_at_once):
            _run()
    except SystemExit as e:
        if compiled().now:  # Python would wait for the threads that do
            leave_at_once(e.code if isinstance(e.code, int) else int(e.code is not None))
        raise


def leave_at_once(status: int) -> NoReturn:
    """End the process, whatever its other threads compile or score."""
    claims.record()
    err.show_cursor()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError):  # the reader of the pipe has gone
            stream.flush()
    leave(status)


def _run() -> None:
    try:
        app()
    except InspeError as e:
        words = str(e)
    except OSError as e:
        where = f"{e.filename}: " if e.filename else ""
        words = where + (e.strerror or str(e) or type(e).__name__)  # a TimeoutError says nothing
    except ModuleNotFoundError as e:
        extra = EXTRAS.get(claims.command)
        if extra is None or (e.name or "").startswith("inspe_jax"):
            raise
        words = str(missing_extra(f"`inspe {claims.command}` needs {e.name}", extra))
    except (AssertionError, RuntimeError):
        platforms = os.environ.get("JAX_PLATFORMS")
        if not platforms or _has_devices():
            raise
        words = f"JAX_PLATFORMS={platforms}: JAX finds no such device here; install its driver "
        words += "and JAX's plugin for it, or set JAX_PLATFORMS=cpu"
    else:
        return
    err.print(Text.assemble(("Error: ", "bold red"), words))
    sys.exit(2)


def _has_devices() -> bool:
    import jax

    try:
        return bool(jax.devices())
    except (AssertionError, RuntimeError):
        return False


def _version(wanted: bool) -> None:
    if wanted:
        out.print(f"inspe_jax {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    context: typer.Context,
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
    claims.begin(context.invoked_subcommand or "")
    context.call_on_close(claims.end)
    import jax

    from inspe_jax.core.kept import keep_programs

    if cache:
        keep_programs()
    else:
        jax.config.update("jax_enable_compilation_cache", False)


def scene_and_layout(
    source: str, sensors: str, profile: str | None, *, unit_rule: bool = True
) -> "tuple[Scene, Layout]":
    """A scene, and a layout on it from a file or from the name of a strategy."""
    from inspe_jax.scene.scene import load_scene

    check_layout(sensors, unit_rule=unit_rule)
    with busy(f"reading {source}"):
        world = load_scene(source, profile)
        return world, layout_on(world, sensors, unit_rule=unit_rule)


def check_layout(sensors: str, *, unit_rule: bool = True) -> None:
    """Raise InspeError if a layout cannot be read: before its scene, which may take minutes."""
    from inspe_jax.scene.geojson import SUFFIX
    from inspe_jax.sensing.layout import load_layout
    from inspe_jax.sensing.named import rule_of

    if Path(sensors).suffix.lower() == SUFFIX:
        read_json(Path(sensors))
    elif rule_of(sensors) is None:
        load_layout(sensors, unit_rule=unit_rule)


def layout_on(world: "Scene", sensors: str, *, unit_rule: bool = True) -> "Layout":
    """A layout on a scene, from a file or from the name of a strategy. With ``unit_rule``, the
    sensors of each unit in the file must be close to each other."""
    from inspe_jax.sensing.named import layout_of

    layout = layout_of(sensors, world, unit_rule=unit_rule)
    if layout.profile not in (None, here := world.profile.name):
        made = f"{layout.name} was made under the profile {layout.profile}"
        note(f"{made}, but the scene under {here}")
    return layout


@contextmanager
def busy(what: str) -> Iterator[None]:
    """Show a spinner, if stderr is a terminal."""
    with step(what), err.status(f"{what} …") if err.is_terminal else nullcontext():
        yield


@contextmanager
def progress(what: str) -> Iterator[Any]:
    """Show a progress bar on a terminal; yields a callback (done, total), or None elsewhere. The
    callback may be told ``what`` is counted now, and ``facts`` to show beside it."""
    with step(what, writes=True), _bar(what) as report:
        yield report


@contextmanager
def _bar(what: str, *, counted: bool = True, facts: str = "") -> Iterator[Any]:
    """The bar of :func:`progress`; it shows how many are ``counted`` of how many."""
    if not err.is_terminal:
        yield None
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
    from rich.progress import TimeRemainingColumn as TimeLeft

    shown = (MofNCompleteColumn(), TimeLeft()) if counted else (TimeLeft(),)
    words, beside = TextColumn("{task.description}"), TextColumn("{task.fields[facts]}")
    columns = words, BarColumn(), *shown, beside
    # The time left is estimated from all steps so far, since some take minutes.
    with Progress(*columns, console=err, transient=True, speed_estimate_period=1e9) as bar:
        task = bar.add_task(what, total=None, facts=facts)

        def report(done: float, total: float, what: str = what, facts: str = "") -> None:
            # Steps of an earlier run, or of something else, say nothing of speed.
            anew = counted and what != bar.tasks[0].description
            if bar.tasks[0].total is None or anew:
                bar.reset(task, total=total)
            bar.update(task, completed=done, description=what, facts=facts)

        yield report


@contextmanager
def resumable() -> Iterator[None]:
    """Ctrl-C in the block ends the command, which goes on from what it has written."""
    try:
        yield
    except KeyboardInterrupt:
        err.print("stopped; give the same command again to resume")
        raise typer.Exit(CTRL_C) from None


@contextmanager
def search_bar(what: str) -> Iterator[Callable[[float, float, str], None]]:
    """Show a bar with the best score and the time left, on a terminal; yields a callback (fraction
    done, best score, what is being done)."""
    bar = _bar(what, counted=False, facts="compiling …")
    with step(what, search=True) as search, bar as report:

        def callback(done: float, best: float, now: str) -> None:
            search.writes = True
            if report:
                report(done, 1.0, f"{what}: {now}" if now else what, f"best {best:.4f}")

        yield callback


def show(table: Any, record: dict[str, Any], path: str | None) -> None:
    """Print a table, and write its record as JSON to ``path``; for "-" print the record alone."""
    text = json.dumps(record, indent=2)
    if path == "-":
        typer.echo(text)
        return
    out.print(table)
    if path:
        write_text(path, text + "\n")
        out.print(f"wrote {path}")


def said(words: str, record: str | None = None) -> None:
    """Print a line; on stderr where ``record`` is "-", since stdout is then the record's."""
    (err if record == "-" else out).print(words)


def draw(figure: Callable[[], Any], path: Path | None, record: str | None = None) -> None:
    """Draw a figure into a file, if one is asked for."""
    if path:
        from inspe_jax.core.sheet import save_figure

        with busy("drawing"):
            save_figure(figure(), path)
        said(f"drew {path}", record)


def note(*notes: str) -> None:
    """Print notes on stderr, one per line."""
    for words in notes:
        err.print(Text.assemble(("Note: ", "yellow"), words))


def note_some(notes: Sequence[str], most: int, others: str) -> None:
    """Print the first notes; ``others`` says where to find those that are left."""
    note(*notes[:most])
    if len(notes) > most:
        note(f"and {len(notes) - most:,} more: {others}")
