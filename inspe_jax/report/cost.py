"""The figure of a Pareto front: score of mixes of devices against their cost."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import StrMethodFormatter

from inspe_jax.core.errors import InspeError
from inspe_jax.core.sheet import TITLE, WIDTH, fit, house_style
from inspe_jax.placement.studies.pareto import DeviceMix, ParetoPoint

FRONT, BEATEN = "#0072b2", "#808080"
NAMED = 12
"""Most mixes on the front that are named; those that add most to the score are chosen."""


def pareto_view(mixes: Sequence[DeviceMix | ParetoPoint]) -> Figure:
    """Score against cost of every mix of devices. The front is a staircase with named mixes.

    Raises InspeError if there is no mix.
    """
    if not mixes:
        raise InspeError("no mix to draw")
    found = [mix.point if isinstance(mix, DeviceMix) else mix for mix in mixes]
    front = sorted((mix for mix in found if mix.front), key=lambda mix: mix.cost)
    beaten = [mix for mix in found if not mix.front]
    names = _named(front)
    height = 3.75 + 0.155 * len(names)
    with house_style():
        fig = Figure(figsize=(WIDTH, height), facecolor="white")
        ax = fig.add_axes((0.085, 1 - 3.22 / height, 0.885, 2.7 / height))
        cost = np.array([mix.cost for mix in front])
        score = np.array([mix.objective for mix in front])
        end = max(mix.cost for mix in found)
        end += 0.04 * max(end - cost[0], 0.05 * end, 1.0)
        ax.step([*cost, end], [*score, score[-1]], where="post", color=FRONT, lw=1.2, zorder=2)
        ax.plot(cost, score, "o", ms=4.5, color=FRONT, zorder=3, label="no other mix is better")
        if beaten:
            ax.plot(
                [mix.cost for mix in beaten], [mix.objective for mix in beaten], "o",
                ms=4, mfc="white", mec=BEATEN, zorder=2, label="another is better or cheaper",
            )  # fmt: skip
        for k, mix in enumerate(names):
            ax.annotate(
                str(k + 1), (mix.cost, mix.objective), (0, 5), size=6.5, ha="center",
                textcoords="offset points", color=FRONT, weight="bold",
            )  # fmt: skip
        ax.set(xlabel="cost of the sensors [US dollars]", ylabel="objective, exact")
        ax.margins(y=0.12)
        ax.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
        ax.grid(color="#e0e0e0", lw=0.4)
        ax.set_axisbelow(True)
        ax.legend(loc="lower right", frameon=False)
        title = fit(f"Cost against score at {found[0].scene}", TITLE, 10)
        fig.text(0.085, 1 - 0.10 / height, **title, weight="bold", va="top",
                 parse_math=False)  # fmt: skip
        facts = f"{len(found)} mixes of devices, each searched by {found[0].method}"
        fig.text(0.085, 1 - 0.29 / height, facts, va="top", parse_math=False)
        for k, mix in enumerate(names):
            words = f"{mix.name}: {mix.cost:,.0f} US dollars, {mix.objective:.4f}"
            y = 1 - (3.8 + 0.155 * k) / height
            fig.text(0.085, y, str(k + 1), color=FRONT, weight="bold", va="bottom")
            fig.text(0.11, y, **fit(words, 110, 7), va="bottom", parse_math=False)
    return fig


def _named(front: Sequence[ParetoPoint]) -> list[ParetoPoint]:
    """The mixes of a front to name, in its order: the first, and those that add most to the
    score."""
    score = np.array([mix.objective for mix in front])
    adds = np.diff(score, prepend=-np.inf)
    chosen = np.sort(np.argsort(-adds, kind="stable")[:NAMED])
    return [front[k] for k in chosen]
