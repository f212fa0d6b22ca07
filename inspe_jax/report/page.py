"""The report page: scores side by side, figures, the scene in three dimensions, the settings.

It is a single HTML file that needs no network. It shows rounded numbers, and contains the exact
ones in the same record as `inspe score --json` writes.
"""

import base64
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from itertools import count
from math import degrees
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from matplotlib.figure import Figure

from inspe_jax.core.errors import InspeError
from inspe_jax.core.sheet import image_text
from inspe_jax.core.words import counted, visible
from inspe_jax.placement.objective import Objective
from inspe_jax.placement.problem import Case
from inspe_jax.placement.result import STATUSES, Result
from inspe_jax.report import schedule
from inspe_jax.report.figures import SENSOR_COLORS, plan_view, scene_view
from inspe_jax.report.layers import BLIND, SIGHT_COLORS, USER_COLOR, MapLayer, layers
from inspe_jax.report.scene_tables import resolution_of
from inspe_jax.report.searches import before_after, history_view, same_sensors
from inspe_jax.report.tables import goal_words, scores_of, scores_record
from inspe_jax.report.targets import targets_view
from inspe_jax.scene.intersection import BUILT_IN
from inspe_jax.scene.maps.sumo.network import GEOGRAPHIC, SUMO
from inspe_jax.scene.regions import Region
from inspe_jax.scene.scene import Scene
from inspe_jax.scoring.evaluate import Scores
from inspe_jax.scoring.metrics import listed_in
from inspe_jax.scoring.target_metrics import ROWS
from inspe_jax.scoring.targets import TargetView, target_view
from inspe_jax.scoring.viewshed import Viewshed, Visibility, viewshed
from inspe_jax.sensing.conditions import Conditions
from inspe_jax.sensing.layout import Layout
from inspe_jax.visibility.tiles import CORE

DPI = 170  # resolution of the figures in a page [dots per inch]
CAPTIONS: dict[str, str] = {
    "seen": "How often each spot is seen: the share of frames and levels, behind traffic.",
    "blind": "Blind spots: what no sensor has in view, and what traffic hides most of the time.",
    "redundancy": "Redundancy: how many sensors have a spot in view, a mean over its levels.",
}
FACTS = dict[str, Any](
    built_in=BUILT_IN, sumo=SUMO, geographic=GEOGRAPHIC, existing_pole=schedule.EXISTING_POLE,
    resolution_of=resolution_of, degrees=degrees, conditions=Conditions.of,
)  # fmt: skip
"""What templates compare sources of places and poles of units with, and call."""
SPOTS = 10  # most blind spots in a list
ON_TARGET = "What a pedestrian gets at each spot, behind traffic."
"""Caption of the maps of a page whose scores have metrics of what a detector gets."""


class PageViews(NamedTuple):
    """Views of a layout in its scene that a page has room for, each of a frame of traffic.
    ``photograph``: a picture, or None where it cannot be made. ``scene3d``: an HTML page."""

    photograph: Callable[[Scene, Layout, int], Figure | None]
    scene3d: Callable[[Scene, Layout, Conditions, int], str]


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class ReportEntry:
    """A layout with all that a page shows of it: the ``result`` of the search that found it, the
    layout before (``start``) and its scores (``before``), the ``target`` for P_sm, what a
    pedestrian gets at each place (``targets``), and the score ``sought``, if that is not P_sm."""

    layout: Layout
    scores: Scores
    shed: Viewshed
    result: Result | None = None
    start: Layout | None = None
    before: Scores | None = None
    target: float | None = None
    targets: TargetView | None = None
    sought: float | None = None


def report_entry(
    case: Case,
    layout: Layout,
    objective: Objective,
    result: Result | None = None,
    start: Layout | None = None,
    target: float | None = None,
) -> ReportEntry:
    """Score a layout for a page, and ``start``, by default that of the search that has found it.
    Raises InspeError as :func:`scores_of`."""
    scene, around = case.scene, case.conditions
    start = result.start if start is None and result is not None else start
    found, targets = scores_of(case, layout, objective), None
    if any(row.name in found.metrics for row in ROWS):
        targets = target_view(scene, layout, conditions=around, detection=objective.detection)
    return ReportEntry(
        layout,
        found,
        viewshed(scene, layout, conditions=around),
        result=result,
        start=start,
        before=None if start is None else scores_of(case, start, objective),
        target=target,
        targets=targets,
    )


def report_page(
    scene: Scene,
    entries: Sequence[ReportEntry],
    *,
    frame: int = 0,
    prices: Mapping[str, float] | None = None,
    views: PageViews | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> str:
    """The page of one or several layouts on a scene, as HTML, with ``prices`` [US dollars] in place
    of the catalogue's. ``progress`` is called with (steps done, steps). Raises InspeError if there
    is no layout, two have the same name, or there is no such frame."""
    check_names([entry.layout.name for entry in entries])
    parts: list[dict[str, Any]] = []
    steps = count(1)

    def done(made: Any) -> Any:
        if progress:
            progress(next(steps), 3 * len(entries))
        return made

    for entry in entries:
        layout, scores = entry.layout, entry.scores
        of_columns = layers(scene, entry.shed)
        rows, words = schedule.materials(layout, prices or {}), schedule.sensors_in_words(layout)
        record = scores_record(scores, scene, layout, entry.sought)
        shown = scores.conditions.layout(layout)
        photograph = done(views and views.photograph(scene, shown, frame))
        part = dict(
            entry=entry,
            name=layout.name,
            record=record,
            units=schedule.installation_schedule(layout, scene.intersection, prices or {}),
            materials=rows,
            total=schedule.total_price(rows),
            specs={sensor.spec.name: sensor.spec for sensor in layout.sensors},
            counts=f"{counted(len(layout.units), 'unit')} with {words}",
            goal=None if entry.sought is None else goal_words(layout, scores, entry.sought),
            blind=_shares(of_columns["blind"]),
            images=done(_images(scene, entry, of_columns, frame)),
            photograph=photograph and image_text(photograph, DPI, "jpeg"),
            scene3d=done(views and _text(views.scene3d(scene, layout, scores.conditions, frame))),
        )
        parts.append(part)
    records = [part["record"] for part in parts]
    metrics = listed_in(*(entry.scores for entry in entries))
    return template("report", "page.html.j2").render(
        scene=scene,
        north="true north" if scene.intersection.georeference else "north, the y axis of the map",
        place=scene.intersection,
        **FACTS,
        in_words=_in_words,
        statuses=STATUSES,
        spots=SPOTS,
        around=entries[0].scores.conditions.words,
        keys={
            f"hidden by traffic in frame {frame}": SIGHT_COLORS[Visibility.HIDDEN],
            "never in view": SIGHT_COLORS[Visibility.OUT_OF_VIEW],
            "road user": USER_COLOR,
            **{s.title: SENSOR_COLORS[s.kind] for part in parts for s in part["specs"].values()},
        },
        parts=parts,
        maps=(*CAPTIONS.values(), ON_TARGET),
        metrics=metrics,
        symbols={metric.name: metric.symbol for metric in metrics},
        best={m.name: max(record[m.name] for record in records) for m in metrics},
        weights=entries[0].scores.settings["weights"],
        core=CORE,
        regions={
            r.key: scene.voxels.region_weight[r]
            for r in Region
            if r.key in records[0]["region_coverage"]
        },
        image=image_text(scene_view(scene, frame=frame), DPI),
        record=_text(json.dumps(records, indent=2)),
        made=date.today().isoformat(),
    )


def _images(
    scene: Scene, entry: ReportEntry, of_columns: Mapping[str, MapLayer], frame: int
) -> dict[str, str]:
    """The figures of a layout by what they show in words, its maps first."""
    layout, scores, result = entry.layout, entry.scores, entry.result
    found = {
        words: plan_view(scene, layout, scores, of_columns[name], frame=frame)
        for name, words in CAPTIONS.items()
    }
    if entry.targets is not None:
        around = scores.conditions
        shown = around.layout(layout)
        found[ON_TARGET] = targets_view(scene, shown, entry.targets, frame=frame, conditions=around)
    if entry.start is not None and same_sensors(entry.start, layout):
        assert entry.before is not None
        found["Before and after"] = before_after(
            scene, entry.start, layout, entry.before, scores,
            path=None if result is None else result.path, frame=frame,
        )  # fmt: skip
    if result is not None:
        found["Score against time"] = history_view([result])
    return {words: image_text(figure, DPI) for words, figure in found.items()}


def template(room: str, name: str) -> Template:
    """An HTML template ``name`` in a folder of the package. Inserted text is escaped, and so are
    its control characters (:func:`~inspe_jax.core.words.visible`)."""
    return Environment(
        loader=PackageLoader("inspe_jax", room),
        autoescape=True,
        finalize=lambda value: visible(value) if type(value) is str else value,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    ).get_template(name)


def check_names(names: Sequence[str]) -> None:
    """Raise InspeError if there is no layout, or two have the same name."""
    if not names:
        raise InspeError("no layout to report on")
    for name in names:
        if names.count(name) > 1:
            words = "give each layout file another `name:`"
            raise InspeError(f"two layouts are named '{name}': {words}")


def _shares(blind: MapLayer) -> list[tuple[str, str, float]]:
    """(kind, colour, share of the columns) of blind spots."""
    kinds = blind.values[~np.isnan(blind.values)].astype(int)
    share = np.bincount(kinds, minlength=len(BLIND)) / max(len(kinds), 1)
    rows = zip(BLIND, share.tolist(), strict=True)
    return [(name.replace("\n", " "), color, part) for (name, color), part in rows]


def _in_words(value: Any) -> str:
    """A setting of a record, which may be a mapping or a list, as a person reads it."""
    if isinstance(value, Mapping):
        nested = any(isinstance(part, Mapping) for part in value.values())
        mark, form = ("; ", "{} ({})") if nested else (", ", "{} {}")
        pairs = ((str(key).replace("_", " "), _in_words(part)) for key, part in value.items())
        return mark.join(form.format(*pair) for pair in pairs)
    if isinstance(value, list | tuple):
        return ", ".join(_in_words(part) for part in value)
    return str(value)


def _text(words: str) -> str:
    return base64.b64encode(words.encode()).decode()
