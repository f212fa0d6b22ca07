"""The report page: scores side by side, figures, the scene in three dimensions, the settings.

It is a single HTML file that needs no network. Numbers are shown rounded. The page contains the
exact ones too, in the same record as `inspe score --json` writes.
"""

import base64
import io
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure

from inspe_jax.core.errors import InspeError
from inspe_jax.core.sheet import house_style, jpeg_text, png_text
from inspe_jax.core.words import counted, isolated
from inspe_jax.placement.problem import Case
from inspe_jax.placement.result import STATUSES, Result
from inspe_jax.placement.studies.pareto import ParetoPoint
from inspe_jax.placement.studies.tolerance import Tolerance
from inspe_jax.report.cost import pareto_view
from inspe_jax.report.figures import SENSOR_COLORS, plan_view, scene_view
from inspe_jax.report.heights import height_view
from inspe_jax.report.layers import BLIND, SIGHT_COLORS, USER_COLOR, MapLayer, layers
from inspe_jax.report.mounting import model_words, mounting_words, origin_words
from inspe_jax.report.progress import before_after, history_view, same_sensors
from inspe_jax.report.schedule import (
    installation_schedule,
    materials,
    sensors_in_words,
    total_price,
)
from inspe_jax.report.tables import goal_words, scores_record, tolerance_record
from inspe_jax.report.targets import targets_view
from inspe_jax.scene.regions import WEIGHTS, Region
from inspe_jax.scene.scene import Scene
from inspe_jax.scoring.detection import DetectionCurves
from inspe_jax.scoring.evaluate import Scores, evaluate
from inspe_jax.scoring.metrics import Weights, listed_in
from inspe_jax.scoring.target_metrics import ROWS
from inspe_jax.scoring.targets import TargetView, target_view
from inspe_jax.scoring.viewshed import Viewshed, Visibility, viewshed
from inspe_jax.sensing.conditions import Conditions
from inspe_jax.sensing.layout import Layout
from inspe_jax.visibility.tiles import CORE

DPI = 170
"""Resolution of the figures in a page [dots per inch]."""
CAPTIONS: dict[str, str] = {
    "seen": "How often each spot is seen: the share of frames and levels, behind traffic.",
    "blind": "Blind spots: what no sensor has in view, and what traffic hides most of the time.",
    "redundancy": "Redundancy: how many sensors have a spot in view, a mean over its levels.",
    "entropy": "Entropy of the occupancy: where it is uncertain whether somebody is there.",
    "unresolved": "What of that uncertainty the sensors leave.",
}
SPOTS = 10
"""Most blind spots in a list."""
ON_TARGET = "What a pedestrian gets at each spot, behind traffic."
"""Caption of the maps of a page whose scores have metrics of what a detector gets."""


class Start(NamedTuple):
    """The layout that another one is compared with, and what it is, in words."""

    layout: Layout
    words: str


class PageViews(NamedTuple):
    """Views of a layout in its scene that a page has room for, each of a frame of traffic.

    ``photograph``: a picture, or None where it cannot be made. ``scene3d``: an HTML page.
    """

    photograph: Callable[[Scene, Layout, int], Figure | None]
    scene3d: Callable[[Scene, Layout, Conditions, int], str]


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class ReportEntry:
    """A layout with all that a page shows of it.

    ``result``: if a search found the layout, its result. ``start`` and ``before``: if given, the
    layout before, as the start of the search, and its scores. ``target``: if given, the P_sm that
    the layout should reach. ``tolerance``: if given, how carefully the layout must be installed.
    ``targets``: if given, what a pedestrian gets at each place. ``sought``: the score that the
    layout was searched for, if that is not P_sm.
    """

    layout: Layout
    scores: Scores
    shed: Viewshed
    tolerance: Tolerance | None = None
    result: Result | None = None
    start: Start | None = None
    before: Scores | None = None
    target: float | None = None
    targets: TargetView | None = None
    sought: float | None = None

    @property
    def moves(self) -> bool:
        """Whether there is a layout before, of the same sensors."""
        return self.start is not None and same_sensors(self.start.layout, self.layout)


def report_entry(
    case: Case,
    layout: Layout,
    weights: Weights,
    result: Result | None = None,
    metrics: Sequence[str] = (),
    detection: DetectionCurves | None = None,
    start: Start | None = None,
    target: float | None = None,
) -> ReportEntry:
    """Score a layout for a page, without its tolerance.

    ``metrics`` are computed besides the usual ones and those with weight, ``detection`` has the
    curves of detectability, the usual ones if None. ``result`` is that of
    the search that found the layout, if any. ``start`` is the layout to compare with, that of the
    search if None. ``target`` is the P_sm that the layout should reach. Raises InspeError as
    :func:`inspe_jax.evaluate` does.
    """
    scene, conditions = case.scene, case.conditions

    def scores(of: Layout) -> Scores:
        given: dict[str, Any] = dict(weights=weights, metrics=metrics, detection=detection)
        return evaluate(scene, of, conditions=conditions, **given)

    shed = viewshed(scene, layout, conditions=conditions)
    if start is None and result is not None:
        start = Start(result.start, "where the search began")
    before, found = None if start is None else scores(start.layout), scores(layout)
    targets = None
    if any(row.name in found.metrics for row in ROWS):
        targets = target_view(scene, layout, conditions=conditions, detection=detection)
    return ReportEntry(
        layout, found, shed, result=result, start=start, before=before, target=target,
        targets=targets,
    )  # fmt: skip


def report_page(
    scene: Scene,
    entries: Sequence[ReportEntry],
    *,
    front: Sequence[ParetoPoint] = (),
    frame: int = 0,
    prices: Mapping[str, float] | None = None,
    views: PageViews | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> str:
    """The page of one or several layouts on a scene, as HTML.

    ``front``: mixes of devices, whose score is drawn against their cost.
    ``frame``: number of the frame of traffic that is drawn.
    ``prices``: of devices [US dollars], in place of the catalogue's.
    ``views``: without them the page has no photograph and no scene in three dimensions.
    ``progress``: called with (steps done, steps).

    Raises InspeError if there is no layout, two have the same name, or there is no such frame.
    """
    check_names([entry.layout.name for entry in entries])
    steps = 2 + bool(front) + len(entries) * (1 + len(CAPTIONS))
    for entry in entries:
        steps += entry.moves + (entry.result is not None) + (entry.targets is not None)
    done = 0

    def drawn(figure: Figure) -> str:
        nonlocal done
        done += 1
        if progress:
            progress(done, steps)
        return png_text(figure, DPI)

    parts = []
    for entry in entries:
        of_columns = layers(scene, entry.shed)
        maps = _maps(scene, entry, of_columns, frame)
        parts.append(
            dict(
                name=entry.layout.name,
                goal=entry.layout.goal and entry.layout.goal.words,
                record=(record := scores_record(entry.scores, scene, entry.layout, entry.sought)),
                units=(
                    units := installation_schedule(entry.layout, scene.intersection, prices or {})
                ),
                mounting=mounting_words(scene, units),
                materials=(rows := materials(entry.layout, prices or {})),
                total=(total := total_price(rows)),
                models=model_words(entry.layout, rows),
                summary=_summary(scene, entry, record["blind_spots"], *total),
                blind=_shares(of_columns["blind"]),
                figures=[(words, drawn(figure)) for words, figure in maps],
                photograph=jpeg_text(photo, DPI)
                if (photo := _photograph(scene, entry, frame, views))
                else "",
                scene3d=views
                and _text(views.scene3d(scene, entry.layout, entry.scores.conditions, frame)),
                change=_change(scene, entry, frame, drawn),
                search=_search(entry, drawn),
                tolerance=None
                if entry.tolerance is None
                else tolerance_record(entry.tolerance, scene, entry.layout),
            )
        )
        done += 1
    metrics = listed_in(*(entry.scores for entry in entries))
    records: list[dict[str, Any]] = [part["record"] for part in parts]  # type: ignore[misc]
    return template("report", "page.html.j2").render(
        scene=scene,
        north="true north" if scene.intersection.georeference else "north, the y axis of the map",
        origin=origin_words(scene.intersection),
        in_words=_in_words,
        spots=SPOTS,
        around=entries[0].scores.conditions.words,
        keys={
            f"hidden by traffic in frame {frame}": SIGHT_COLORS[Visibility.HIDDEN],
            "never in view": SIGHT_COLORS[Visibility.OUT_OF_VIEW],
            "road user": USER_COLOR,
            "camera": SENSOR_COLORS["camera"],
            "LiDAR": SENSOR_COLORS["lidar"],
        },
        parts=parts,
        metrics=metrics,
        symbols={metric.name: metric.symbol for metric in metrics},
        best={m.name: max(record[m.name] for record in records) for m in metrics},
        weights=entries[0].scores.settings["weights"],
        core=CORE,
        regions={r.key: WEIGHTS[r] for r in Region if r.key in records[0]["region_coverage"]},
        scene_figure=drawn(scene_view(scene, frame=frame)),
        height_figure=drawn(height_view(scene, [(e.layout.name, e.scores) for e in entries])),
        front_figure=drawn(pareto_view(front)) if front else None,
        record=_text(json.dumps(records, indent=2)),
        made=date.today().isoformat(),
    )


def template(room: str, name: str) -> Template:
    """An HTML template ``name`` in a folder of the package. Inserted text is escaped, and isolated
    from its neighbours (:func:`~inspe_jax.core.words.isolated`)."""
    return Environment(
        loader=PackageLoader("inspe_jax", room),
        autoescape=True,
        finalize=lambda value: isolated(value) if type(value) is str else value,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    ).get_template(name)


def report_sheets(
    scene: Scene,
    entries: Sequence[ReportEntry],
    *,
    front: Sequence[ParetoPoint] = (),
    frame: int = 0,
    views: PageViews | None = None,
) -> bytes:
    """The figures of the page as a PDF, one on each sheet."""
    check_names([entry.layout.name for entry in entries])
    figures = [scene_view(scene, frame=frame)]
    figures.append(height_view(scene, [(e.layout.name, e.scores) for e in entries]))
    for entry in entries:
        of_columns = layers(scene, entry.shed)
        figures += [photo] if (photo := _photograph(scene, entry, frame, views)) else []
        figures += [figure for _, figure in _maps(scene, entry, of_columns, frame)]
        figures += [_moves(scene, entry, frame)] if entry.moves else []
        figures += [] if entry.result is None else [history_view([entry.result])]
    if front:
        figures.append(pareto_view(front))
    made = io.BytesIO()
    with house_style(), PdfPages(made, metadata={"CreationDate": None}) as pdf:
        for figure in figures:
            pdf.savefig(figure)
    return made.getvalue()


def check_names(names: Sequence[str]) -> None:
    """Raise InspeError if there is no layout, or two have the same name."""
    if not names:
        raise InspeError("no layout to report on")
    for name in names:
        if names.count(name) > 1:
            raise InspeError(
                f"two layouts are named '{name}': give each layout file another `name:`"
            )


def _maps(
    scene: Scene, entry: ReportEntry, of_columns: Mapping[str, MapLayer], frame: int
) -> Iterator[tuple[str, Figure]]:
    """The maps of a layout, each with its caption."""
    for name, words in CAPTIONS.items():
        yield words, _plan(scene, entry, of_columns[name], frame)
    if entry.targets is not None:
        reaching = entry.scores.conditions.layout(entry.layout)
        yield (
            ON_TARGET,
            targets_view(
                scene, reaching, entry.targets, frame=frame, conditions=entry.scores.conditions
            ),
        )


def _plan(scene: Scene, entry: ReportEntry, layer: MapLayer, frame: int) -> Figure:
    return plan_view(scene, entry.layout, entry.scores, layer, frame=frame)


def _moves(scene: Scene, entry: ReportEntry, frame: int) -> Figure:
    assert entry.start is not None
    assert entry.before is not None
    start, path = entry.start.layout, None if entry.result is None else entry.result.path
    return before_after(
        scene, start, entry.layout, entry.before, entry.scores, path=path, frame=frame
    )


def _summary(
    scene: Scene,
    entry: ReportEntry,
    spots: Sequence[Mapping[str, Any]],
    cost: float | None,
    unknown: Sequence[str],
) -> list[str]:
    """A layout in three sentences: what there is, what it sees, and what it does not.

    ``spots`` are its blind spots as records; ``cost`` and ``unknown`` its
    :func:`~inspe_jax.report.schedule.total_price`.
    """
    layout, scores = entry.layout, entry.scores
    price = f", for {cost:,.0f} US dollars" if cost is not None else ""
    if unknown and price:
        price += f" without {' and '.join(unknown)}, of unknown price"
    units, sensors = counted(len(layout.units), "unit"), sensors_in_words(layout)
    where = f"{scene.voxels.radius:g} m around the middle of {scene.name}{scores.conditions.words}"
    found = [] if entry.sought is None else [f"{goal_words(layout, scores, entry.sought)}."]
    found += [
        f"{units} with {sensors} watch {where}{price}.",
        f"They have {scores.coverage:.0%} of the region of interest in view, by weight, and see "
        f"{scores.occlusion:.0%} of it on average with traffic in the way.",
    ]
    worst = [
        f"the {spot['name']} ({spot['unseen']:.0%} of time and height unseen)" for spot in spots[:2]
    ]
    if worst:
        found.append(f"Most is missed on {' and '.join(worst)}.")
    if entry.before is not None:
        before, gain = entry.before.surrogate, scores.surrogate - entry.before.surrogate
        found.append(f"P_sm is {scores.surrogate:.4f}; before, it was {before:.4f} ({gain:+.4f}).")
    if entry.target is not None:
        short = entry.target - scores.surrogate
        end = f"missed by {short:.4f}" if short > 0 else "reached"
        found.append(f"The target for P_sm, {entry.target:g}, is {end}.")
    return found


def _change(
    scene: Scene, entry: ReportEntry, frame: int, drawn: Callable[[Figure], str]
) -> dict[str, Any] | None:
    """What the page shows of the layout before; None if there is none."""
    if entry.start is None or entry.before is None:
        return None
    before, after = entry.before, entry.scores
    return dict(
        words=entry.start.words,
        rows=[(m, before.value(m.name), after.value(m.name)) for m in listed_in(after)],
        moves=drawn(_moves(scene, entry, frame)) if entry.moves else "",
    )


def _search(entry: ReportEntry, drawn: Callable[[Figure], str]) -> dict[str, Any] | None:
    """What the page shows of the search that found a layout; None if there was no search."""
    result = entry.result
    if result is None:
        return None
    asked = result.settings
    where = [
        f"{row['name']}{Conditions.of(row['light'], row['weather']).words}"
        for row in asked["scenes"]
    ]
    return dict(
        where=" and ".join(where),
        weights=asked["objective"]["weights"],
        method=result.method,
        status=STATUSES[result.status],
        seconds=result.seconds,
        evaluations=result.evaluations,
        before=result.objective_before,
        after=result.objective,
        course=drawn(history_view([result])),
    )


def _shares(blind: MapLayer) -> list[tuple[str, str, float]]:
    """(kind, colour, share of the columns) of blind spots."""
    kinds = blind.values[~np.isnan(blind.values)].astype(int)
    share = np.bincount(kinds, minlength=len(BLIND)) / max(len(kinds), 1)
    rows = zip(BLIND, share.tolist(), strict=True)
    return [(name.replace("\n", " "), color, part) for (name, color), part in rows]


def _photograph(
    scene: Scene, entry: ReportEntry, frame: int, views: PageViews | None
) -> Figure | None:
    return views and views.photograph(scene, entry.scores.conditions.layout(entry.layout), frame)


def _in_words(value: Any) -> str:
    """A setting of a record, which may be a mapping or a list, as a person reads it."""
    if isinstance(value, Mapping):
        nested = any(isinstance(part, Mapping) for part in value.values())
        mark, form = ("; ", "{} ({})") if nested else (", ", "{} {}")
        return mark.join(
            form.format(str(key).replace("_", " "), _in_words(part)) for key, part in value.items()
        )
    if isinstance(value, list | tuple):
        return ", ".join(_in_words(part) for part in value)
    return str(value)


def _text(words: str) -> str:
    return base64.b64encode(words.encode()).decode()
