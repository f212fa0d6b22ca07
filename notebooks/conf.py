"""The site: guides as they are kept, and a reference from docstrings. CONTRIBUTING.md says how."""

import inspect
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

from rich.console import Group
from rich.table import Table
from rich.text import Text

import inspe_jax
from inspe_jax import __version__ as release
from inspe_jax.report.scene_tables import devices_table, profile_table
from inspe_jax.report.tables import metrics_table, table_of
from inspe_jax.sensing.conditions import figures

project, author, copyright = "inspe_jax", "The inspe_jax developers", "MIT licence"
html_title, html_theme = f"inspe_jax {release}", "furo"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]

nb_execution_mode = "off"
suppress_warnings = ["misc.highlighting_failure"]  # of a cell with IPython's own ! before a command

autodoc_default_options = {"members": True}
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88
napoleon_use_rtype = False

PACKAGES = (
    "inspe_jax", "inspe_jax.report", "inspe_jax.dataset", "inspe_jax.dataset.loading",
    "inspe_jax.perception.training",
)  # fmt: skip


FILES = ("inspe_jax.sensing.layout", "inspe_jax.sensing.calibrations")
"""Modules whose docstrings say what is in files that people write."""

SEEN: set[int] = set()
"""What a page has already: a package's own package may list it too."""


def page_of(name: str) -> str:
    """The reference of a package: what it lists, by the names that users write."""
    package = import_module(name)
    lines = [name, "=" * len(name), "", f".. automodule:: {name}", "   :no-members:", ""]
    for member in package.__all__:
        thing = getattr(package, member)
        if isinstance(thing, dict):
            lines += [f"``{member}``, rows by name: {', '.join(thing)}.", ""]
        elif id(thing) not in SEEN:
            kind = "class" if inspect.isclass(thing) else "function"
            lines += [f".. auto{kind}:: {name}.{member}", ""]
        SEEN.add(id(thing))
    return "\n".join(lines)


def methods_table() -> Table:
    """The search methods."""
    table = table_of("Search methods: guide 02 says how to choose", "name", "does")
    for name, summary in inspe_jax.methods().items():
        table.add_row(name, summary)
    return table


def conditions_table() -> Table:
    """Light and weather, with what they take from each kind of sensor."""
    table = table_of("Light and weather", "name", "sensor", "figures", "source")
    for light, own in figures()["light"].items():
        shares = ", ".join(
            f"{k} {x:.2f}".replace("_", " ") for k, x in own.items() if k[-1] in "hy"
        )
        table.add_row(light, "", shares, own["source"])
    for weather, own in figures()["weather"].items():
        for kind in (key for key, value in own.items() if isinstance(value, dict)):
            row = own[kind]
            words = "extinction {factor:g} · R^{exponent:g} per metre, reliability {reliability:g}"
            name = f"{weather}, usually {own['usual']:g} {own['unit']}"
            table.add_row(name, kind, words.format(**row), row["source"])
    return table


def markdown(thing: object) -> Iterator[str]:
    """Tables of the terminal, as Markdown."""
    if isinstance(thing, Group):
        for part in thing.renderables:
            yield from markdown(part)
    elif isinstance(thing, Text):
        yield f"{thing.plain}\n"
    elif isinstance(thing, Table):
        heads = [str(column.header).replace("\n", " ") for column in thing.columns]
        cells = zip(*(column.cells for column in thing.columns), strict=True)
        rows = [heads, ["---"] * len(heads), *cells]
        lines = ("| " + " | ".join(" ".join(str(x).split()) for x in row) + " |" for row in rows)
        yield f"## {thing.title}\n"
        yield "\n".join(lines) + "\n"


def tables() -> Iterator[str]:
    """A page of what is data: devices, metrics, methods, conditions, profiles."""
    yield "# Tables\n"
    own = [devices_table(inspe_jax.devices()), metrics_table(), methods_table(), conditions_table()]
    for thing in (*own, *map(profile_table, inspe_jax.profiles().values())):
        yield from markdown(thing)


for name in PACKAGES:
    path = Path(__file__).parent / "reference" / f"{name}.rst"
    path.parent.mkdir(exist_ok=True)
    path.write_text(page_of(name))
files = "\n\n".join(f".. automodule:: {name}\n   :no-members:" for name in FILES)
(path.parent / "files.rst").write_text(f"Files\n=====\n\n{files}\n")
(path.parent / "tables.md").write_text("\n".join(tables()))
