"""The plan of a city: a table of its junctions, and a map."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from rich.console import RenderableType
from rich.text import Text

from inspe_jax.core.sheet import HALO, KEYS, draw_scale, house_style, sheet
from inspe_jax.core.tables import table_of
from inspe_jax.core.words import counted
from inspe_jax.scene.georeference import Georeference
from inspe_jax.study.city import CityPlan

OTHER = "#606060"
_NOTHING: dict[str, Any] = dict(fc="white", ec=OTHER)
ROADS: dict[str, Any] = dict(color="#d0d0d0", lw=0.7, zorder=1)
SCORES = "viridis"
NAMED, LONGEST = 60, 8
"""Most junctions that are named on the map, and the longest id; else names are numbers of rows."""
_SMALL, _LARGE, _MANY = 4.0, 13.0, 60  # diameters of dots [points], of up to so many junctions


def plan_table(plan: CityPlan, georeference: Georeference | None = None) -> RenderableType:
    """What each junction gets: its place, in degrees or metres, its devices, the cost and score."""
    where = "x, y [m]" if georeference is None else "latitude, longitude"
    some = len(set(plan.weights)) > 1
    heads = ("importance",) if some else ()
    title = f"{_money(plan.budget)} US dollars for {counted(len(plan.fronts), 'junction')}"
    table = table_of(title, "#", "junction", where, *heads, "devices", "cost\n[US$]", "score")
    rows = zip(plan.fronts, plan.chosen, plan.weights, strict=True)
    for k, (front, option, weight) in enumerate(rows):
        at = np.array(front.junction.center[:2])
        place = "{:.1f}, {:.1f}".format(*at) if georeference is None else georeference.words(at)
        cells = [f"{weight:g}"] if some else []
        cells += [option.mix or "nothing", f"{option.cost:,.0f}", f"{option.score:.3f}"]
        look = "" if option.key else "dim"
        table.add_row(str(k + 1), Text(front.name), place, *map(Text, cells), style=look)
    return table


def plan_words(plan: CityPlan) -> list[str]:
    """The whole plan in two lines: what is spent and the score; and how near to the best it is."""
    share, gets = plan.share, sum(bool(option.key) for option in plan.chosen)
    some = len(set(plan.weights)) > 1
    spent = f"{_money(share.cost)} of {_money(plan.budget)} US dollars, at {gets} of "
    spent += counted(len(plan.fronts), "junction")
    mean = f"{'weighted ' * some}mean {share.total / sum(plan.weights):.4f}"
    what = f"{'weighted ' * some}sum of scores"
    what = f"least score, or then a greater {what}" if plan.worst else what
    if share.gap:
        proof = f"of the mixes searched, a better plan has at most {share.gap:.2%} more of the sum"
    else:
        proof = f"proved: of the mixes searched, no plan for this money has a greater {what}"
    return [f"{spent}; score in the {mean}, least score {share.worst:.4f}", proof]


def _money(amount: float) -> str:
    return f"{amount:,.2f}".removesuffix(".00")


def city_view(plan: CityPlan, name: str, roads: Sequence[Float[np.ndarray, "N 2"]] = ()) -> Figure:
    """A map of what each junction gets: a dot is larger the more is spent, and its colour is the
    score. ``name`` is that of the map, and ``roads`` are its lines [m]."""
    middles = np.array([front.junction.center[:2] for front in plan.fronts])
    cost = np.array([option.cost for option in plan.chosen])
    score = np.array([option.score for option in plan.chosen])
    gets = np.array([bool(option.key) for option in plan.chosen])
    low, high, (x, y) = middles.min(0), middles.max(0), middles.T
    reach = 0.56 * max(float((high - low).max()), 100.0)
    (left, below), (right, above) = (low + high) / 2 - reach, (low + high) / 2 + reach
    part = cost / (cost.max() or 1.0)  # of the areas of dots
    wide = np.sqrt(_SMALL**2 + part * (_LARGE**2 - _SMALL**2)) * min(1, np.sqrt(_MANY / len(cost)))
    order = np.argsort(-cost, kind="stable")
    some = order[gets[order]]  # small dots over large ones
    with house_style():
        title = f"{_money(plan.budget)} US dollars for the junctions of {name}"
        fig, ax, panel = sheet(title, "\n".join(plan_words(plan)), [], 0.0)
        # The scale says how far; plan.csv has coordinates.
        ax.set(xlim=(left, right), ylim=(below, above), aspect="equal", xticks=[], yticks=[])
        ax.add_collection(LineCollection(list(roads), **ROADS), autolim=False)
        ax.scatter(x[~gets], y[~gets], s=wide[~gets] ** 2, **_NOTHING, linewidths=0.8, zorder=4)
        _draw_names(ax, plan, middles, wide)
        draw_scale(ax, reach)
        if len(some):  # colours from a tenth below the least score to a tenth above the greatest
            tenths = 10 * score[some]
            least, most = np.floor(tenths.min()) / 10, np.ceil(tenths.max()) / 10
            dots = ax.scatter(
                x[some], y[some], s=wide[some] ** 2, c=score[some], cmap=SCORES,
                norm=Normalize(least, max(most, least + 0.1)), ec="white", linewidths=0.5,
                zorder=4,
            )  # fmt: skip
            _draw_keys(fig, panel, dots, {float(cost[k]): float(wide[k]) for k in order})
    return fig


def _draw_names(
    ax: Axes, plan: CityPlan, middles: np.ndarray, diameter: Float[np.ndarray, " N"]
) -> None:
    names = [front.name for front in plan.fronts]
    if len(names) > NAMED:
        return
    if max(map(len, names)) > LONGEST:
        names = [str(k + 1) for k in range(len(names))]
    for name, at, wide in zip(names, middles, diameter, strict=True):
        ax.annotate(
            name, at, (0, wide / 2 + 1), textcoords="offset points", ha="center", va="bottom",
            size=5.5, zorder=5, path_effects=HALO, parse_math=False, annotation_clip=True,
        )  # fmt: skip


def _draw_keys(fig: Figure, panel: Axes, dots: Any, diameters: Mapping[float, float]) -> None:
    """Beside the map: the scale of colours, and what the sizes of dots mean, by cost."""
    bar = panel.inset_axes((0.06, 0.92, 0.75, 0.02))
    fig.colorbar(dots, cax=bar, orientation="horizontal", ticks=MaxNLocator(4, steps=[1, 2, 5, 10]))
    bar.set_title("score of the junction", size=6.5, pad=2)
    costs = sorted(diameters)
    keys = []
    for cost in dict.fromkeys((costs[0], costs[len(costs) // 2], costs[-1])):
        face, edge, wide = (OTHER, "white", 0.5) if cost else ("white", OTHER, 0.8)
        look: dict[str, Any] = dict(mfc=face, mec=edge, mew=wide, ms=diameters[cost])
        keys.append(Line2D([], [], marker="o", ls="", label=_money(cost), **look))
    panel.legend(
        handles=keys, title="US dollars spent", loc="upper left", bbox_to_anchor=(0.0, 0.85),
        alignment="left", labelspacing=1.0, title_fontsize=6.5, **KEYS,
    )  # fmt: skip
