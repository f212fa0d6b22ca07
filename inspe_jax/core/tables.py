"""Tables for a terminal."""

from typing import Any

from rich import box
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
    """A table that cuts no number and no name, whatever its width: columns of prose break between
    words, and where that is not enough, every row becomes a block of lines, one a column."""

    def add_row(self, *cells: RenderableType | None, **how: Any) -> None:
        """Add a row; control characters of its texts show as escapes."""
        for cell in cells:
            if isinstance(cell, Text):
                cell.plain = visible(cell.plain)
        super().add_row(*(visible(x) if isinstance(x, str) else x for x in cells), **how)

    def __rich_measure__(self, console: Console, options: ConsoleOptions) -> Measurement:
        """From the narrowest width in which it is a table, to that of whole lines."""
        self._measure_columns(console, options)
        return super().__rich_measure__(console, options)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """The table, or its rows as blocks of lines."""
        wide = options.update(width=_UNBOUNDED)
        more = self._measure_columns(console, wide)
        spare = options.max_width - super().__rich_measure__(console, wide).minimum
        if spare < 0:
            yield from self._rows_as_blocks(console, options)
            return
        for left, k in zip(
            range(len(more), 0, -1), sorted(more, key=more.__getitem__), strict=True
        ):
            given = min(more[k], spare // left)
            spare -= given
            self.columns[k].width = (self.columns[k].min_width or 0) + given
        yield from super().__rich_console__(console, options)

    def _measure_columns(self, console: Console, options: ConsoleOptions) -> dict[int, int]:
        """Set each column's least width; returns how much wider whole lines are, of prose."""
        wide, more = options.update(width=_UNBOUNDED), {}
        for k, column in enumerate(self.columns):
            cells = [Measurement.get(console, wide, x) for x in (column.header, *column.cells)]
            most = max(cell.maximum for cell in cells)
            least = most if column.no_wrap else min(max(cell.minimum for cell in cells), _WORD)
            column.width, column.min_width = None, least
            if not column.no_wrap:
                more[k] = most - least
        return more

    def _rows_as_blocks(self, console: Console, options: ConsoleOptions) -> RenderResult:
        heads = (str(x.header).replace("-\n", "") for x in self.columns)
        names = [Text(" ".join(head.split())) for head in heads]
        grid = Table.grid(Column(no_wrap=True), Column(overflow="fold"), padding=(0, 2))
        for cells, row in zip(
            zip(*(x.cells for x in self.columns), strict=True), self.rows, strict=True
        ):
            for name, cell in zip(names, cells, strict=True):
                if str(cell):
                    grid.add_row(name, cell, style=row.style)
            grid.add_row()
        longest = max((x.min_width or 0 for x in self.columns if x.no_wrap), default=0)
        needed = max(map(len, names)) + 2 + longest
        yield Text(f"{self.title}\n", style="bold")
        yield from console.render(grid, options.update(width=max(options.max_width, needed)))


def table_of(title: str, *columns: str) -> Table:
    """An empty table. Columns of prose may break between words; numbers and names never break."""
    table = WholeTable(
        title=Text(title), title_justify="left", title_style="bold", box=box.SIMPLE_HEAD
    )
    table.pad_edge, table.collapse_padding = False, True
    for name in columns:
        table.add_column(
            Text(name),
            justify="left" if name in PROSE | NAMES else "right",
            no_wrap=name not in PROSE,
            overflow="fold",
        )
    return table
