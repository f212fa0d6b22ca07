"""What a figure has drawn: its texts with their places, its pixels; and the text of a table."""

import io
from itertools import combinations

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Text
from rich.console import Console


def pixels(fig):
    """Colours (H, W, 3) from 0 to 1."""
    canvas = FigureCanvasAgg(fig)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3] / 255


def texts(fig):
    """(text, its box in pixels) of all that is drawn; ticks beyond the limits are not."""
    renderer = FigureCanvasAgg(fig).get_renderer()
    fig.draw(renderer)
    beyond = [
        tick.label1
        for ax in fig.axes
        for axis in (ax.xaxis, ax.yaxis)
        for tick in axis.get_major_ticks()
        if not min(axis.get_view_interval()) <= tick.get_loc() <= max(axis.get_view_interval())
    ]
    found = [
        (text.get_text(), text.get_window_extent(renderer))
        for text in fig.findobj(Text)
        if text.get_text().strip() and text.get_visible() and text not in beyond
    ]
    return [(text, box) for text, box in found if box.width > 0]


def misplaced(fig):
    """Texts that leave the sheet, and pairs that touch by more than half a pixel of 100 an inch."""
    found, (width, height) = texts(fig), fig.canvas.get_width_height()
    out = [t for t, b in found if b.x0 < 0 or b.x1 > width or b.y0 < 0 or b.y1 > height]
    return out + [
        (a, b)
        for (a, box), (b, other) in combinations(found, 2)
        if min(
            min(box.x1, other.x1) - max(box.x0, other.x0),
            min(box.y1, other.y1) - max(box.y0, other.y0),
        )
        > 0.5
    ]


def printed(table, width=160):
    """A table in so many columns."""
    out = io.StringIO()
    Console(file=out, width=width, color_system=None).print(table, crop=False)
    return out.getvalue()


def row(text, *begins):
    """The one line of a printed table that begins with these words, as its words."""
    lines = map(str.split, text.splitlines())
    found = [words for words in lines if words[: len(begins)] == [*begins]]
    assert len(found) == 1, f"{begins}: {found}"
    return found[0]
