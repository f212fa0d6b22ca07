"""The plan of a city: a table of its junctions, and a figure of its map and its budget."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, StrMethodFormatter
from rich.console import RenderableType
from rich.text import Text

from inspe_jax.core.sheet import HALO, SIDE, SIDE_GAP, SIDE_LEFT, WIDTH, house_style, sheet_of_two
from inspe_jax.core.tables import table_of
from inspe_jax.core.words import counted
from inspe_jax.scene.georeference import Georeference
from inspe_jax.study.city import NOTHING, CityPlan

CHOSEN, EVEN, OTHER = "#0072b2", "#d55e00", "#606060"
ROADS: dict[str, Any] = dict(color="#d0d0d0", lw=0.7, zorder=1)
SCORES = "viridis"
NAMED, LONGEST = 60, 8
"""Most junctions that are named on the map, and the longest id; else names are numbers of rows."""
_SMALL, _LARGE, _MANY = 4.0, 13.0, 60  # diameters of dots [points], of up to so many junctions
_HEAD, _BELOW = 0.86, 0.98  # above and below the panels [inch]


def plan_table(plan: CityPlan, georeference: Georeference | None = None) -> RenderableType:
    """What each junction gets: its place, its mix of devices, the cost and the score.

    Places are latitudes and longitudes where the map's projection is given, else metres.
    """
    where = "x, y [m]" if georeference is None else "latitude, longitude"
    some = _some_count_more(plan)
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
    """The whole plan in a few lines: what is spent, the score, how near to the best, and against an
    even share."""
    share, gets = plan.share, sum(bool(option.key) for option in plan.chosen)
    spent = f"{_money(share.cost)} of {_money(plan.budget)} US dollars, at {gets} of "
    spent += counted(len(plan.fronts), "junction")
    scores = f"score in the {_mean_words(plan)} {share.total / sum(plan.weights):.4f}, "
    scores += f"least score {share.worst:.4f}"
    what = f"{'weighted ' * _some_count_more(plan)}sum of scores"
    what = f"least score, or then a greater {what}" if plan.worst else what
    if share.gap:
        proof = f"of the mixes searched, a better plan has at most {share.gap:.2%} more of the sum"
    else:
        proof = f"proved: of the mixes searched, no plan for this money has a greater {what}"
    kind = "least score" if plan.worst else _mean_words(plan)
    even = "the same part of the budget for every junction would give a "
    even += f"{kind} of {plan.value(plan.even):.4f}"
    if plan.worst and gets < len(plan.fronts):
        first = (next((one for one in front.options if one.key), NOTHING) for front in plan.fronts)
        even += f"; devices for all cost {_money(sum(option.cost for option in first))} or more"
    return [f"{spent}; {scores}", proof, even]


def _money(amount: float) -> str:
    return f"{amount:,.2f}".removesuffix(".00")


def _some_count_more(plan: CityPlan) -> bool:
    return len(set(plan.weights)) > 1


def _mean_words(plan: CityPlan) -> str:
    return f"{'weighted ' * _some_count_more(plan)}mean"


def city_view(plan: CityPlan, name: str, roads: Sequence[Float[np.ndarray, "N 2"]] = ()) -> Figure:
    """A map of what each junction gets, and the score against the budget.

    ``name`` is that of the map, and ``roads`` are its lines [m]. A dot is larger the more is spent,
    and its colour is the score. The curve has the best plans of other budgets.
    """
    title = f"{_money(plan.budget)} US dollars for the junctions of {name}"
    with house_style():
        fig, (left, right) = sheet_of_two(title, "\n".join(plan_words(plan)), 2, _HEAD, _BELOW)
        _draw_map(fig, left, plan, roads)
        _draw_curve(right, plan)
    return fig


# ── The map ─────────────────────────────────────────────────────────────────


def _draw_map(
    fig: Figure, ax: Axes, plan: CityPlan, roads: Sequence[Float[np.ndarray, "N 2"]]
) -> None:
    middles = np.array([front.junction.center[:2] for front in plan.fronts])
    cost = np.array([option.cost for option in plan.chosen])
    score = np.array([option.score for option in plan.chosen])
    gets = np.array([bool(option.key) for option in plan.chosen])
    low, high = middles.min(0), middles.max(0)
    reach = 0.56 * max(float((high - low).max()), 100.0)
    (left, below), (right, above) = (low + high) / 2 - reach, (low + high) / 2 + reach
    # The scale says how far; plan.csv has coordinates.
    ax.set(xlim=(left, right), ylim=(below, above), aspect="equal", xticks=[], yticks=[])
    ax.add_collection(LineCollection(list(roads), **ROADS), autolim=False)
    x, y = middles.T
    wide = _diameter(cost, cost.max()) * min(1.0, np.sqrt(_MANY / len(cost)))
    none, order = np.flatnonzero(~gets), np.argsort(-cost, kind="stable")
    some = order[gets[order]]  # small dots over large ones
    ax.scatter(x[none], y[none], s=wide[none] ** 2, fc="white", ec=OTHER, linewidths=0.8, zorder=4)
    _draw_names(ax, plan, middles, wide)
    _draw_scale(ax, reach)
    if not gets.any():
        return
    dots = ax.scatter(
        x[some], y[some], s=wide[some] ** 2, c=score[some], cmap=SCORES, norm=_norm(score[some]),
        ec="white", linewidths=0.5, zorder=4,
    )  # fmt: skip
    _draw_keys(fig, ax, dots, {float(cost[k]): float(wide[k]) for k in order})


def _norm(scores: Float[np.ndarray, " N"]) -> Normalize:
    """Colours from a tenth below the least score to a tenth above the greatest."""
    low, high = np.floor(10 * scores.min()) / 10, np.ceil(10 * scores.max()) / 10
    return Normalize(low, max(high, low + 0.1))


def _diameter(cost: Float[np.ndarray, " N"], most: float) -> Float[np.ndarray, " N"]:
    """Diameters of dots [points]; their areas grow by the cost."""
    part = cost / most if most > 0 else np.zeros_like(cost)
    return np.sqrt(_SMALL**2 + part * (_LARGE**2 - _SMALL**2))


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


def _draw_scale(ax: Axes, reach: float) -> None:
    """A scale bar and a north arrow."""
    choices = [k * 10**n for n in range(6) for k in (1, 2, 5)]
    bar = max((m for m in choices if m <= 0.5 * reach), default=1)
    words = f"{bar} m" if bar < 1000 else f"{bar / 1000:g} km"
    at: dict[str, Any] = dict(transform=ax.transAxes, zorder=9, path_effects=HALO)
    start = 0.98 - bar / (2 * reach)
    ax.plot([start, 0.98], [0.02, 0.02], "k-", lw=2.2, solid_capstyle="butt", **at)
    ax.text((start + 0.98) / 2, 0.03, words, ha="center", va="bottom", **at)
    ax.plot([0.965, 0.965], [0.90, 0.965], "k-", lw=1.0, **at)
    ax.plot(0.965, 0.965, "k^", ms=4, **at)
    ax.text(0.965, 0.89, "N", ha="center", va="top", weight="bold", **at)


def _draw_keys(fig: Figure, ax: Axes, dots: Any, diameters: Mapping[float, float]) -> None:
    """Below the map: the scale of colours, and what the sizes of dots mean, by cost."""
    height = fig.get_figheight()
    bar = fig.add_axes(
        (SIDE_LEFT / WIDTH, (_BELOW - 0.40) / height, 0.44 * SIDE / WIDTH, 0.08 / height)
    )
    fig.colorbar(dots, cax=bar, orientation="horizontal", ticks=MaxNLocator(4, steps=[1, 2, 5, 10]))
    bar.set_title("score of the junction", size=6.5, pad=2)
    costs = sorted(diameters)
    keys = []
    for cost in dict.fromkeys((costs[0], costs[len(costs) // 2], costs[-1])):
        look: dict[str, Any] = dict(mfc=OTHER, mec="white", mew=0.5)
        if not cost:
            look = dict(mfc="white", mec=OTHER, mew=0.8)
        look |= dict(marker="o", ls="", ms=diameters[cost], label=_money(cost))
        keys.append(Line2D([], [], **look))
    ax.legend(
        handles=keys, title="US dollars spent", loc="upper left", ncols=len(keys), frameon=False,
        bbox_to_anchor=(0.50, -0.05), borderaxespad=0, handletextpad=0.5, columnspacing=1.0,
        title_fontsize=6.5, fontsize=6.5,
    )  # fmt: skip


# ── The budget ──────────────────────────────────────────────────────────────


def _draw_curve(ax: Axes, plan: CityPlan) -> None:
    box = ax.get_position()
    gap = SIDE_GAP / WIDTH  # room for the numbers of the axis
    ax.set_position((box.x0 + gap, box.y0, box.width - gap, box.height))
    budgets = [budget for budget, _ in plan.curve]
    values = [plan.value(share) for _, share in plan.curve]
    best = [front.options[-1].score for front in plan.fronts]
    most = min(best) if plan.worst else float(np.average(best, weights=plan.weights))
    ax.axhline(most, color=OTHER, lw=0.8, ls=(0, (4, 2)), label="the best found at every junction")
    # Between two budgets the best plan is at least that of the smaller one.
    ax.plot(budgets, values, color=CHOSEN, lw=1.0, drawstyle="steps-post")
    ax.plot(budgets, values, "o", color=CHOSEN, ms=2.2, label="best plans of other budgets")
    ax.plot(
        plan.budget, plan.value(plan.even), "D", ms=5, mfc="none", mec=EVEN, mew=1.2, zorder=5,
        label="the same for every junction",
    )  # fmt: skip
    ax.plot(
        plan.budget, plan.value(plan.share), "o", ms=7, color=CHOSEN, mec="white",
        label="this plan", zorder=4,
    )  # fmt: skip
    words = "least score" if plan.worst else f"{_mean_words(plan)} of the scores"
    ax.set(xlabel="budget [US dollars]", ylabel=words, xlim=(0, budgets[-1] * 1.03))
    ax.set_ylim(-0.03 * max(most, 1e-6), 1.08 * max(most, 1e-6))
    ax.xaxis.set_major_locator(MaxNLocator(5))
    ax.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    ax.grid(color="#e0e0e0", lw=0.4)
    ax.set_axisbelow(True)
    ax.legend(
        loc="upper right", frameon=False, ncols=2, bbox_to_anchor=(1.02, -0.13), borderaxespad=0,
        columnspacing=1.0, handletextpad=0.4, handlelength=1.6, fontsize=6.5,
    )  # fmt: skip
