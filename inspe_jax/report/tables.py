"""Tables of scores, scenes, layouts and catalogues for people; records of scores for JSON."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import jax
import numpy as np
from rich.columns import Columns
from rich.console import Group, RenderableType
from rich.text import Text

from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import json_value
from inspe_jax.core.tables import table_of
from inspe_jax.core.version import __version__
from inspe_jax.placement.objective import Objective
from inspe_jax.placement.problem import Case
from inspe_jax.placement.result import Result
from inspe_jax.placement.studies.pareto import Cheapest, DeviceMix
from inspe_jax.placement.studies.tolerance import POSITION_STEP, Tolerance
from inspe_jax.scene.regions import PAPER_WEIGHTS, Region
from inspe_jax.scene.scene import Scene
from inspe_jax.scoring.blind_spots import blind_spots
from inspe_jax.scoring.evaluate import Scores, evaluate
from inspe_jax.scoring.metrics import METRICS, listed, listed_in
from inspe_jax.sensing.conditions import Conditions
from inspe_jax.sensing.layout import Layout, device_words, lens_keys
from inspe_jax.sensing.sensors import Spec
from inspe_jax.visibility.tiles import CORE

RADARS = (
    "C, O and IG count where radars look; what they find is in detectability (--metrics "
    "detectability)"
)
"""Below the scores of a layout with radars."""
SPOTS = 5  # most blind spots in a table
_SAME = 1e-5  # objectives and scores are summed in different orders, in single precision


def scores_of(case: Case, layout: Layout, objective: Objective) -> Scores:
    """Exact scores, with the weights, the further metrics and the curves of an objective. Raises
    InspeError as :func:`inspe_jax.evaluate`."""
    return evaluate(
        case,
        layout,
        weights=objective.weights,
        metrics=objective.metrics,
        detection=objective.detection,
    )


def goal_words(layout: Layout, scores: Scores, sought: float | None) -> str:
    """The headline of a layout: its P_sm, after the score that it was searched for, if any."""
    words = f"P_sm {scores.surrogate:.4f}{_only(scores)}"
    if sought is not None and layout.goal is not None:
        words = f"searched for {layout.goal.words}: {sought:.4f}; {words}"
    return f"{layout.name}: {words}"


def _only(scores: Scores) -> str:
    """Which regions and road users alone count in a score, in brackets."""
    words = []
    if regions := scores.settings.get("regions"):
        some = [m.symbol for m in listed_in(scores) if m.by_region]
        words.append(f"{' and '.join(some)} of {', '.join(regions)} only")
    if users := scores.settings.get("road_users"):
        words.append(f"road users: {', '.join(users)} only")
    return f" ({'; '.join(words)})" if words else ""


def scores_table(scores: Scores, layout: Layout, sought: float | None = None) -> RenderableType:
    """Scores: every metric and P_sm, coverage by region, and what each sensor adds.

    Args:
        scores, layout: The scores and what they are of. What a sensor adds is what the layout loses
            without it.
        sought: The score that the layout was searched for, if that is not P_sm.

    Raises:
        InspeError: The scores are of another layout.
    """
    members = _members(scores, layout)
    weights, rows = scores.settings.get("weights", {}), listed_in(scores)

    title = f"Scores of {layout.name}{scores.conditions.words}{_only(scores)}"
    places = [f"{place}\n{'≤' if place == 'core' else '>'} {CORE:g} m" for place in scores.parts]
    total = table_of(title, "metric", "symbol", "weight", "score", *places)
    for metric in rows:
        look = "bold" if metric.name == "surrogate" else ""
        weight = f"{weights[metric.name]:g}" if metric.name in weights else ""
        values = [scores.value(metric.name), *(of[metric.name] for of in scores.parts.values())]
        numbers = [f"{value:z.3f}" for value in values]
        total.add_row(metric.words, metric.symbol, weight, *numbers, style=look)

    regions = table_of("Share covered by region", "region", "weight", "share")
    usual = dict(zip((region.key for region in Region), PAPER_WEIGHTS, strict=True))
    each_weight = scores.settings.get("region_weight", usual)
    for key, share in scores.region_coverage.items():
        regions.add_row(key, f"{each_weight.get(key, 0.0):g}", f"{share:.3f}")

    each = table_of("What each sensor adds", "#", "sensor", "device", *(m.symbol for m in rows))
    for k, (part, _, spec) in enumerate(members):
        digits = 4 if len(rows) <= 5 else 3  # as many as a narrow terminal shows
        drops = [f"{part.value(metric.name):+z.{digits}f}" for metric in rows]
        each.add_row(str(k + 1), Text(part.sensor), Text(device_words(spec)), *drops)

    # Side by side as far as the terminal has room.
    tables = Group(Columns([total, regions], padding=(0, 4)), "", each)
    if any(spec.grid.of.signal.echo for _, _, spec in members):
        tables = Group(tables, Text(RADARS))
    if sought is None:
        return tables
    return Group(Text(goal_words(layout, scores, sought)), "", tables)


def metrics_table() -> RenderableType:
    """The registered metrics and P_sm: name, symbol, usual weight and meaning.

    >>> report.metrics_table().row_count == len(inspe_jax.METRICS) + 1
    True
    """
    table = table_of("Metrics, each from 0 to 1, higher is better", "name", "symbol", "weight", "")
    for metric in listed(METRICS):
        weight = f"{metric.weight:g}" if metric.name in METRICS else ""
        table.add_row(metric.name, metric.symbol, weight, metric.summary)
    return table


def before_after_table(result: Result) -> RenderableType:
    """The scores before and after a search, and its objective if that differs from P_sm. Metrics
    that one of the two records does not have are left out."""
    title = f"{result.start.name}{result.scores.conditions.words}, before and after"
    title += _only(result.scores)
    table = table_of(title, "metric", "symbol", "before", "after", "change")
    before, after = result.scores_before, result.scores
    rows = [
        (m.words, m.symbol, before.value(m.name), after.value(m.name))
        for m in listed_in(before, after)
    ]
    objective = result.objective_before, result.objective
    usual = [of.surrogate for of in (before, after)]
    if not np.allclose(objective, usual, rtol=0, atol=_SAME, equal_nan=True):
        rows.append(("objective", "", *objective))
    for name, symbol, old, new in rows:
        look = "bold" if name == rows[-1][0] else ""
        table.add_row(name, symbol, f"{old:.3f}", f"{new:.3f}", f"{new - old:+z.3f}", style=look)
    return table


def moves_table(before: Layout, after: Layout) -> RenderableType:
    """How far each sensor was moved [m] and turned [degrees] from one layout to another. Distance
    is in plan. Turns are positive counter-clockwise and nose-up. View is that of a varifocal lens
    now.

    >>> report.moves_table(layout, layout.with_poses(layout.poses + [1.0, 0, 0, 0, 0, 0])).row_count
    8
    """
    heads = ["moved\n[m]", "height\n[m]", "raised\n[m]", "yaw\n[°]", "pitch\n[°]"]
    lenses = [lens_keys(sensor.spec) for sensor in after.sensors]
    heads += ["view\n[°]"] * any(lenses)
    table = table_of("What moved", "#", "sensor", *heads)
    old, new = (np.asarray(of.poses, float) for of in (before, after))
    low, high = (
        poses[:, 2] - [of.units[sensor.unit].base[2] for sensor in of.sensors]
        for of, poses in ((before, old), (after, new))
    )
    went, raised = np.hypot(*(new - old)[:, :2].T), high - low
    pitch, yaw = np.degrees(new - old)[:, 4:].T
    for k, sensor in enumerate(after.sensors):
        numbers = (f"{went[k]:.1f}", f"{high[k]:.1f}", f"{raised[k]:+z.1f}")
        turns = (f"{180 - (180 - yaw[k]) % 360:+z.0f}", f"{pitch[k]:+z.0f}")
        view = (f"{lens:.0f}" for lens in lenses[k].values())
        table.add_row(str(k + 1), Text(sensor.name), *numbers, *turns, *view)
    return table


def sweep_table(rows: Sequence[Mapping[str, str]]) -> RenderableType:
    """The results of a study by layout: mean ± standard deviation over scenes and settings."""
    metrics = listed({key for row in rows for key in row})
    symbols = (metric.symbol for metric in metrics)
    table = table_of("Mean ± standard deviation", "layout", "jobs", "failed", *symbols)
    for name in dict.fromkeys(row["layout"] for row in rows):
        own = [row for row in rows if row["layout"] == name]
        done = [row for row in own if row["status"] == "done"]
        scores = (np.array([float(row[key]) for row in done]) for key in (m.name for m in metrics))
        words = (f"{x.mean():.3f} ± {x.std():.2f}" if len(x) else "" for x in scores)
        table.add_row(Text(name), str(len(own)), str(len(own) - len(done)), *words)
    return table


def by_method(results: Sequence[Result]) -> dict[str, list[Result]]:
    """The results of searches by their method, in the order in which methods come."""
    names = dict.fromkeys(result.method for result in results)
    return {name: [result for result in results if result.method == name] for name in names}


def comparison_table(results: Sequence[Result]) -> RenderableType:
    """The results of several searches: one row for each method, the best median first."""
    by = by_method(results)
    name = f"{results[0].start.name}: {results[0].objective_before:.4f} at the start"
    table = table_of(name, "method", "seeds", "median", "worst", "best", "work", "time\n[s]")
    for method, of in sorted(by.items(), key=lambda row: -np.median([r.objective for r in row[1]])):
        scores = [result.objective for result in of]
        work = [np.median([getattr(r, key) for r in of]) for key in ("evaluations", "seconds")]
        numbers = [f"{value:.4f}" for value in (np.median(scores), min(scores), max(scores))]
        table.add_row(method, str(len(of)), *numbers, *(f"{value:.0f}" for value in work))
    return table


def pareto_table(found: Sequence[DeviceMix]) -> RenderableType:
    """Cost and scores of mixes of devices, cheapest first; those on the Pareto front in bold."""
    metrics = listed_in(*(mix.result.scores for mix in found))
    symbols = (metric.symbol for metric in metrics)
    table = table_of("Cost against score", "mix", "cost\n[US$]", *symbols, "objective", "")
    for mix in found:
        scores = [f"{mix.result.scores.value(m.name):z.3f}" for m in metrics]
        numbers = (f"{mix.cost:,.0f}", *scores, f"{mix.result.objective:.4f}")
        words = ("front", "bold") if mix.front else ("", "")
        table.add_row(Text(mix.name), *numbers, words[0], style=words[1])
    return table


def cheapest_table(found: Cheapest) -> RenderableType:
    """The mixes that were searched for a target, cheapest first; that which reaches it in bold."""
    title = f"The cheapest mix with {found.target:g} or more"
    table = table_of(title, "mix", "cost\n[US$]", "best found", "searched\n[s]", "")
    for mix in found.searched:
        reached = mix is found.found
        numbers = (f"{mix.cost:,.0f}", f"{mix.result.objective:.4f}", f"{mix.result.seconds:.0f}")
        words = "reaches it" if reached else ""
        table.add_row(Text(mix.name), *numbers, words, style="bold" if reached else "")
    return table


def tolerance_table(found: Tolerance, layout: Layout) -> RenderableType:
    """The slopes of each sensor, and P_sm before and after random installation errors."""
    step = f"per {100 * POSITION_STEP:g} cm"
    heads = [f"{name}\n{step}" for name in "xyz"] + ["yaw\nper 1°", "pitch\nper 1°"]
    around = Conditions.of(found.settings["light"], found.settings["weather"])
    slopes = table_of(f"What P_sm of {layout.name}{around.words} gains", "#", "sensor", *heads)
    for k, row in enumerate(found.slopes):
        values = (row.x, row.y, row.z, row.yaw, row.pitch)
        slopes.add_row(str(k + 1), Text(row.sensor), *(f"{value:+z.5f}" for value in values))
    settings = found.settings
    errors = f"{settings['position']:g} m and {settings['angle_deg']:g}°"
    left = table_of(f"After errors of {errors} (standard deviation)", "installed", "P_sm", "change")
    for name, value in {
        "as planned": found.score,
        f"mean of {settings['samples']} installations": found.mean,
        "95 of 100 reach": found.low,
    }.items():
        left.add_row(name, f"{value:.4f}", f"{value - found.score:+z.4f}")
    return Group(slopes, "", left)


def tolerance_record(found: Tolerance, scene: Scene, layout: Layout) -> dict[str, Any]:
    """A tolerance as a record for JSON."""
    return {
        "score": found.score,
        "mean": found.mean,
        "low": found.low,
        "left": found.left.tolist(),
        "slopes": [
            {
                "sensor": row.sensor,
                **{f"{axis}_per_10_cm": getattr(row, axis) for axis in "xyz"},
                **{f"{turn}_per_deg": getattr(row, turn) for turn in ("yaw", "pitch")},
            }
            for row in found.slopes
        ],
        "settings": json_value(found.settings),
        **_origin(scene, layout),
    }


def scores_record(
    scores: Scores, scene: Scene, layout: Layout, sought: float | None = None
) -> dict[str, Any]:
    """Scores as a record for JSON, with every number exactly as scored; ``sought`` as in
    :func:`scores_table`.

    It also has the scene, the layout, the settings and the versions, so that the scores can be
    repeated. Raises InspeError if the scores are of another layout.
    """
    goal = {} if sought is None or layout.goal is None else layout.goal.record | {"score": sought}
    return {
        **{m.name: float(scores.value(m.name)) for m in listed_in(scores)},
        "region_coverage": {key: float(share) for key, share in scores.region_coverage.items()},
        "parts": json_value(scores.parts),
        "contributions": [
            {
                "sensor": part.sensor,
                "unit": unit,
                "device": spec.name,
                **lens_keys(spec),
                **{m.name: float(part.value(m.name)) for m in listed_in(scores)},
            }
            for part, unit, spec in _members(scores, layout)
        ],
        "blind_spots": [json_value(asdict(spot)) for spot in blind_spots(scene, scores.seen_share)],
        "settings": json_value(scores.settings),
        **({"searched_for": goal} if goal else {}),
        **_origin(scene, layout),
    }


def blind_spots_table(scene: Scene, scores: Scores) -> RenderableType:
    """Where most is unseen: the first of :func:`~inspe_jax.scoring.blind_spots.blind_spots`."""
    table = table_of("Blind spots", "region", "unseen", "area\n[m²]", "of all unseen", "x, y [m]")
    for spot in blind_spots(scene, scores.seen_share)[:SPOTS]:
        x, y = spot.at
        numbers = (f"{spot.unseen:.0%}", f"{spot.area:.0f}", f"{spot.loss:.0%}")
        table.add_row(spot.name, *numbers, f"{x:.0f}, {y:.0f}")
    return table


def _origin(scene: Scene, layout: Layout) -> dict[str, Any]:
    source, settings = scene.intersection.source, dict(scene.settings)
    versions = {"inspe_jax": __version__, "jax": jax.__version__, "numpy": np.__version__}
    about = {"name": scene.name, "source": source, "settings": settings}
    return {"scene": about, "layout": layout.name, "versions": versions}


def _members(scores: Scores, layout: Layout) -> list[tuple[Any, str, Spec]]:
    """(contribution, unit, spec) of each sensor. Raises InspeError if names do not match."""
    scored = [part.sensor for part in scores.contributions]
    placed = [sensor.name for sensor in layout.sensors]
    if scored != placed:
        raise InspeError(
            f"{layout.name}: the scores are of another layout: of sensors {', '.join(scored)}; "
            f"expected {', '.join(placed)}"
        )
    return [
        (part, layout.units[sensor.unit].name, sensor.spec)
        for part, sensor in zip(scores.contributions, layout.sensors, strict=True)
    ]
