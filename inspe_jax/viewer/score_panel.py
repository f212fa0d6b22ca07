"""The panel of a layout's scores: bars, cost, and the rules of mounting that it breaks."""

from collections.abc import Sequence

from inspe_jax.core.errors import InspeError
from inspe_jax.placement.objective import Objective
from inspe_jax.report.figures import SENSOR_COLORS
from inspe_jax.report.layers import SIGHT_COLORS
from inspe_jax.report.page import template
from inspe_jax.report.scene3d import BROKEN_COLOR, MOUNTING_COLOR, USER_COLOR
from inspe_jax.report.targets import CHANCES
from inspe_jax.scoring.metrics import METRICS
from inspe_jax.scoring.viewshed import Visibility
from inspe_jax.sensing.layout import Layout
from inspe_jax.viewer.scorer import ScoredLayout

VISIBILITY_NAMES = {
    Visibility.HIDDEN: "hidden by traffic",
    Visibility.OUT_OF_VIEW: "never in view",
    Visibility.SEEN: "seen",
}
"""What voxels are called on the page."""
LEGEND = (
    *((words, SIGHT_COLORS[kind]) for kind, words in VISIBILITY_NAMES.items()),
    ("road user", USER_COLOR),
    ("camera", SENSOR_COLORS["camera"]),
    ("LiDAR", SENSOR_COLORS["lidar"]),
)

_TEMPLATE = template("viewer", "score_panel.html.j2")


def score_panel(
    layout: Layout,
    scored: ScoredLayout | None,
    *,
    frames: int,
    opened: float | None = None,
    faults: Sequence[str] = (),
    notes: Sequence[str] = (),
    waiting: str = "scoring …",
    faded: bool = False,
    road_user: str | None = None,
) -> str:
    """A layout's scores as HTML.

    ``scored``: the newest scores, or None. Those of another layout are shown in grey.
    ``frames``: number of frames of the whole traffic.
    ``opened``: P_sm of the layout that was opened.
    ``faults``: the rules of mounting that the layout breaks, in words.
    ``notes``: how mounting has changed the last change, in words.
    ``waiting``: what is being done while the layout has no scores.
    ``faded``: whether scores of another layout are faded.
    ``road_user``: by the chance to find whom the ground is coloured; None if it is not.
    """
    scores = None if scored is None else scored.scores
    new = scored if scored is not None and scored.layout is layout else None
    regions = {} if scores is None else scores.region_coverage
    return _TEMPLATE.render(
        scores=scores,
        around="" if scores is None else scores.conditions.words,
        change=None if scores is None or opened is None else scores.surrogate - opened,
        state=waiting if new is None else _state(new, frames),
        new=new is not None,
        faded=faded and new is None,
        wrong="" if new is None else new.wrong,
        faults=faults,
        notes=notes,
        broken=BROKEN_COLOR,
        metrics=[
            (f"{metric.words} {metric.symbol}", scores.metrics[metric.name])
            for metric in METRICS.values()
            if scores is not None and metric.name in scores.metrics
        ],
        regions=list(regions.items()),
        sensors=len(layout),
        units=len(layout.units),
        cost=cost_of(layout),
        keys=LEGEND if road_user is None else _found_keys(road_user),
        mounting=MOUNTING_COLOR,
    )


def _found_keys(road_user: str) -> tuple[tuple[str, str], ...]:
    """The legend where the ground has the colours of the chance to find a road user."""
    kinds = {*VISIBILITY_NAMES.values()}
    rest = tuple(row for row in LEGEND if row[0] not in kinds)
    return (*((f"{road_user} found {words}", color) for _, words, color in CHANCES), *rest)


def _state(scored: ScoredLayout, frames: int) -> str:
    if scored.scores is None:
        return "no scores"
    some = f"{scored.frames} of {frames} frames" if scored.frames < frames else "all frames"
    return f"{some}, scored in {scored.seconds:.2f} s"


def cost_of(layout: Layout) -> str:
    """What a layout's sensors cost by the catalogue's prices, in words."""
    wanted, known, unknown = Objective(), 0.0, set[str]()
    for sensor in layout.sensors:
        try:
            known += wanted.price_of(sensor.spec.name)
        except InspeError:
            unknown.add(sensor.spec.name)
    if not unknown:
        return f"{known:,.0f} US dollars"
    without = f"no list price for {', '.join(sorted(unknown))}"
    return f"{known:,.0f} US dollars and {without}" if known else without
