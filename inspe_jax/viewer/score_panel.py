"""The panel of a layout's scores, with the rules of mounting that it breaks, and its sensors."""

from collections.abc import Sequence

from inspe_jax.core.words import counted
from inspe_jax.report.figures import SENSOR_COLORS
from inspe_jax.report.layers import SIGHT_COLORS, USER_COLOR
from inspe_jax.report.page import template
from inspe_jax.report.schedule import materials, total_price
from inspe_jax.scoring.evaluate import Scores
from inspe_jax.scoring.metrics import METRICS, SURROGATE
from inspe_jax.scoring.viewshed import Visibility
from inspe_jax.sensing.kinds import SENSOR_KINDS
from inspe_jax.sensing.layout import Layout
from inspe_jax.viewer.scene3d import BROKEN_COLOR, MOUNTING_COLOR
from inspe_jax.viewer.workers import ScoredLayout

VISIBILITY_NAMES = {
    Visibility.HIDDEN: "hidden by traffic",
    Visibility.OUT_OF_VIEW: "never in view",
    Visibility.SEEN: "seen",
}
"""What voxels are called on the page."""
LEGEND = (
    *((words, SIGHT_COLORS[kind]) for kind, words in VISIBILITY_NAMES.items()),
    ("road user", USER_COLOR),
    *((SENSOR_KINDS[kind].spec_type.title, SENSOR_COLORS[kind]) for kind in sorted(SENSOR_KINDS)),
)

TARGET_COLOR = "#d55e00"  # of the mark of the target

_HEADLINE = template("viewer", "headline.html.j2")
_DETAILS = template("viewer", "score_panel.html.j2")
_NOTES = template("viewer", "notes.html.j2")
_TABLE = template("viewer", "sensor_table.html.j2")


def score_panel(
    layout: Layout,
    scored: ScoredLayout | None,
    *,
    frames: int,
    reference: Scores | None = None,
    faults: Sequence[str] = (),
    notes: Sequence[str] = (),
    waiting: str = "scoring …",
    target: float = 0.0,
) -> tuple[str, str, str]:
    """A layout's scores as HTML: P_sm and how far scoring is; all else; notes on the last change.

    ``scored`` are the newest scores, in grey if of another layout, ``frames`` all that there are,
    and ``reference`` the scores of the layout as it was opened. ``faults`` are the rules of
    mounting that it breaks, ``waiting`` what is being done while it has no scores, ``target`` the
    P_sm that it should reach, 0 for none.
    """
    scores = None if scored is None else scored.scores
    before = None if scores is None or reference is None else reference.surrogate
    new = scored if scored is not None and scored.layout is layout else None
    headline = _HEADLINE.render(
        scores=scores,
        around="" if scores is None else scores.conditions.words,
        change="" if scores is None else _change(scores.surrogate, before),
        before=before,
        target=target,
        target_color=TARGET_COLOR,
        meaning=f"P_sm: {SURROGATE.summary}",
        state=waiting if new is None else _state(new, frames),
        new=new is not None,
    )
    details = _DETAILS.render(
        scores=scores,
        wrong="" if new is None else new.wrong,
        faults=faults,
        broken=BROKEN_COLOR,
        reference=reference,
        metrics=METRICS.values(),
        digits=_digits,
        change=_change,
        keys=LEGEND,
        mounting=MOUNTING_COLOR,
    )
    return headline, details, _NOTES.render(notes=notes) if notes else ""


def sensor_table(layout: Layout, scored: ScoredLayout | None, selection: Sequence[int]) -> str:
    """The sensors of a layout as HTML: name, what it costs, and what P_sm loses without it, and
    what all of them cost. Those of the ``selection`` are ticked, the last of them is bold."""
    scores = None if scored is None else scored.scores
    lost = [row.surrogate for row in scores.contributions] if scores else [None] * len(layout)
    prices = {row.device: row.price for row in materials(layout, {})}
    names = [(sensor.name, prices[sensor.spec.name]) for sensor in layout.sensors]
    return _TABLE.render(
        rows=[(*of, loss) for of, loss in zip(names, lost, strict=True)],
        priced=any(price is not None for price in prices.values()),
        selection=selection,
        sensors=counted(len(layout), "sensor"),
        units=counted(len(layout.units), "unit"),
        cost=cost_of(layout),
    )


def _digits(value: float) -> str:
    """A score with three digits; with more where they would say 1 and it is less."""
    enough = (n for n in (3, 4) if value == 1.0 or round(value, n) < 1.0)
    return f"{value:.{next(enough, 5)}f}"


def _change(value: float, before: float | None, digits: int = 4) -> str:
    """A change with its sign; nothing where none is known or seen."""
    text = "" if before is None else f"{value - before:+.{digits}f}"
    return text if text.strip("+-0.") else ""


def _state(scored: ScoredLayout, frames: int) -> str:
    if scored.scores is None:
        return "no scores"
    some = f"{scored.frames} of {frames} frames" if scored.frames < frames else "all frames"
    return f"{some}, scored in {scored.seconds:.2f} s"


def cost_of(layout: Layout) -> str:
    """What a layout's sensors cost by the catalogue's prices, in words."""
    cost, unknown = total_price(materials(layout, {}))
    words = [] if cost is None else [f"{cost:,.0f} US dollars"]
    if unknown:
        words.append(f"no list price for {', '.join(sorted(unknown))}")
    return " and ".join(words)
