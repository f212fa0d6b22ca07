"""Tables for a terminal."""

from collections.abc import Iterator
from copy import copy
from dataclasses import replace
from typing import Any

from rich import box
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.measure import Measurement
from rich.table import Column, Table
from rich.text import Text

from inspe_jax.core.words import visible

PROSE = {
    "", "unit", "maker", "source", "notes", "reason", "regions", "field of view", "devices",
    "streets",
}  # fmt: skip

NAMES = {
    "mix", "metric", "method", "symbol", "region", "scene", "device", "kind", "name", "sensor",
    "centre [m]", "pixels,\nchannels", "split", "class", "column", "setting", "value", "id",
    "layout", "installed",
}  # fmt: skip

_WORD = 24  # longer words of prose may break [characters]
_UNBOUNDED = 10_000


class WholeTable(Table):
    """A table that cuts no number and no name: prose breaks between words, further columns follow
    below, beside the names of the rows, and lines may be longer than the terminal."""

    def add_row(self, *cells: RenderableType | None, **how: Any) -> None:
        """Add a row; control characters of its texts show as escapes."""
        for cell in cells:
            if isinstance(cell, Text):
                cell.plain = visible(cell.plain)
        shown = [visible(x) if isinstance(x, str) else x for x in cells]
        super().add_row(*shown, **how)
        for column, cell in zip(self.columns, shown, strict=False):
            least = max(_width(column, text) for text in (column.header, cell or ""))
            column.min_width = max(column.min_width or 0, least)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """The title and the table, in parts where there is not the width for the least it needs."""
        if self.title is not None:
            yield Text.assemble((str(self.title), "bold"))
        for part in self._parts(console, options):
            wide = max(options.max_width, part._least(console, options))
            yield from super(WholeTable, part).__rich_console__(console, options.update(width=wide))

    def _least(self, console: Console, options: ConsoleOptions) -> int:
        return Measurement.get(console, options.update(width=_UNBOUNDED), self).minimum

    def _with(self, columns: list[Column]) -> "WholeTable":
        """A table of some of the columns, without its title."""
        part = copy(self)
        part.title, part.columns = None, [replace(c, _index=k) for k, c in enumerate(columns)]
        return part

    def _parts(self, console: Console, options: ConsoleOptions) -> Iterator["WholeTable"]:
        """Tables of as many columns as have room, each after those that name the rows."""
        names = 1 + any(str(column.header) in ("#", "track") for column in self.columns[:1])
        heads, left = self.columns[:names], self.columns[names:]
        while True:
            count = len(left)
            while count > 1 and (
                self._with(heads + left[:count])._least(console, options) > options.max_width
            ):
                count -= 1
            yield self._with(heads + left[:count])
            left = left[count:]
            if not left:
                return


def _width(column: Column, cell: RenderableType) -> int:
    """The width of a cell's longest line, or word of prose, in characters."""
    if column.no_wrap:
        return max(map(cell_len, str(cell).splitlines()), default=0)
    return max((min(cell_len(word), _WORD) for word in str(cell).split()), default=0)


def table_of(title: str, *columns: str) -> Table:
    """An empty table. Columns of prose may break between words; numbers and names never break."""
    table = WholeTable(title=Text(title))
    table.box, table.pad_edge, table.collapse_padding = box.SIMPLE_HEAD, False, True
    for name in columns:
        table.add_column(
            Text(name),
            justify="left" if name in PROSE | NAMES else "right",
            no_wrap=name not in PROSE,
            overflow="fold",
        )
    return table
