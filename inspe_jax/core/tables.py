"""Tables for a terminal."""

from typing import Any

from rich import box
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.measure import Measurement
from rich.table import Column, Table
from rich.text import Text

from inspe_jax.core.words import visible

PROSE = {
    "", "sensor", "unit", "maker", "source", "notes", "reason", "regions", "field of view",
    "devices",
}  # fmt: skip

NAMES = {
    "mix", "P_sm", "metric", "method", "symbol", "region", "scene", "device", "kind", "name",
    "centre [m]", "pixels,\nchannels", "split", "class", "column", "setting", "value", "id",
}  # fmt: skip

_WORD = 24  # longer words of prose may break [characters]
_UNBOUNDED = 10_000


class WholeTable(Table):
    """A table that cuts no number and no name: columns of prose break between words, and where that
    is not enough, lines are longer than the terminal."""

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
        """The table in the width that there is, or in the least that it needs."""
        least = Measurement.get(console, options.update(width=_UNBOUNDED), self).minimum
        wide = options.update(width=max(options.max_width, least))
        yield from super().__rich_console__(console, wide)


def _width(column: Column, cell: RenderableType) -> int:
    """The width of a cell's longest line, or word of prose, in characters."""
    if column.no_wrap:
        return max(map(cell_len, str(cell).splitlines()), default=0)
    return max((min(cell_len(word), _WORD) for word in str(cell).split()), default=0)


def table_of(title: str, *columns: str) -> Table:
    """An empty table. Columns of prose may break between words; numbers and names never break."""
    table = WholeTable(title=Text(title), title_justify="left", title_style="bold")
    table.box, table.pad_edge, table.collapse_padding = box.SIMPLE_HEAD, False, True
    for name in columns:
        table.add_column(
            Text(name),
            justify="left" if name in PROSE | NAMES else "right",
            no_wrap=name not in PROSE,
            overflow="fold",
        )
    return table
