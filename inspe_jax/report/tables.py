"""Scores, scenes, layouts and catalogues as tables for people, and scores as a record for JSON."""

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from rich import box
from rich.columns import Columns
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from inspe_jax.core.errors import InspeError
from inspe_jax.core.version import __version__
from inspe_jax.placement.result import Result
from inspe_jax.placement.studies.pareto import DeviceMix
from inspe_jax.placement.studies.tolerance import POSITION_STEP, Tolerance
from inspe_jax.scene.procedural.built_ins import BUILT_INS, built_in
from inspe_jax.scene.profiles import Profile
from inspe_jax.scene.regions import WEIGHTS, Region
from inspe_jax.scene.scene import Scene
from inspe_jax.scoring.evaluate import Scores
from inspe_jax.scoring.metrics import METRICS, listed
from inspe_jax.sensing.catalogue import Device
from inspe_jax.sensing.conditions import Conditions
from inspe_jax.sensing.layout import Layout
from inspe_jax.sensing.sensors import CameraSpec, Spec

if TYPE_CHECKING:
    from inspe_jax.scene.maps.opendrive.reader import JunctionInfo


_SAME = 1e-5  # objectives and scores sum in different orders, in single precision
_CHANGE = ("before", "after", "change")
_MOVES = ("moved\n[m]", "height\n[m]", "raised\n[m]", "yaw\n[°]", "pitch\n[°]")
_TURNS = ("yaw", "pitch")
_ENDS = ("seeds", "median", "worst", "best", "work", "time\n[s]")


def scores_table(scores: Scores, layout: Layout) -> RenderableType:
    """Scores for people: the four, coverage by region and level, and what each sensor adds.

    What a sensor adds is what the layout loses without it. Raises InspeError
    where the scores are not of this layout.
    """
    members = _members(scores, layout)
    weights = scores.settings.get("weights", {})

    title = f"Scores of {layout.name}{scores.conditions.words}"
    total = table_of(title, "metric", "symbol", "weight", "score")
    for metric in listed():
        look = "bold" if metric.name == "surrogate" else ""
        weight = f"{weights[metric.name]:g}" if metric.name in weights else ""
        number = f"{scores.value(metric.name):.3f}"
        total.add_row(metric.words, metric.symbol, weight, number, style=look)

    regions = table_of("Share covered by region", "region", "weight", "share")
    for key, share in scores.region_coverage.items():
        regions.add_row(key, f"{WEIGHTS[Region[key.upper()]]:g}", f"{share:.3f}")

    levels = table_of("Unweighted, by level", "level, from below", "share")
    for k, share in enumerate(scores.level_coverage):
        levels.add_row(str(k + 1), f"{share:.3f}")

    each = table_of("What each sensor adds", "#", "sensor", "device", *(m.symbol for m in listed()))
    for k, (part, _, device) in enumerate(members):
        drops = [f"{part.value(metric.name):+.4f}" for metric in listed()]
        each.add_row(str(k + 1), Text(part.sensor), Text(device), *drops)

    # Side by side as far as the terminal has room.
    beside = Columns([total, regions, levels], padding=(0, 4))
    return Group(beside, "", each)


def metrics_table() -> RenderableType:
    """The metrics and P_sm for people: name, symbol, usual weight and meaning."""
    table = table_of("Metrics, each from 0 to 1, higher is better", "name", "symbol", "weight", "")
    for metric in listed():
        weight = f"{metric.weight:g}" if metric.name in METRICS else ""
        table.add_row(metric.name, metric.symbol, weight, metric.summary)
    return table


def before_after_table(result: Result) -> RenderableType:
    """The four scores before and after a search, and its objective where that is something else."""
    title = f"{result.start.name}{result.scores.conditions.words}, before and after"
    table = table_of(title, "metric", "symbol", *_CHANGE)
    before, after = result.scores_before, result.scores
    rows = [
        (m.words, m.symbol, before.value(m.name), after.value(m.name))
        for m in listed()
        if m.name in {*before.metrics, "surrogate"} & {*after.metrics, "surrogate"}
    ]
    if abs(result.objective - result.scores.surrogate) > _SAME:
        rows.append(("objective", "", result.objective_before, result.objective))
    for name, symbol, old, new in rows:
        look = "bold" if name == rows[-1][0] else ""
        numbers = (f"{old:.3f}", f"{new:.3f}", f"{new - old:+z.3f}")
        table.add_row(name, symbol, *numbers, style=look)
    return table


def moves_table(before: Layout, after: Layout) -> RenderableType:
    """Each sensor of a layout before and after: how far it went [m], how it turned [degrees].

    Distance is in plan; turns are counter-clockwise and nose-up.
    """
    table = table_of("What moved", "#", "sensor", *_MOVES)
    poses, new = (np.asarray(of.poses, float) for of in (before, after))
    for k, sensor in enumerate(after.sensors):
        ground = (before.units[before.sensors[k].unit].base[2], after.units[sensor.unit].base[2])
        height = new[k, 2] - ground[1]
        yaw, pitch = np.degrees(new[k, [5, 4]] - poses[k, [5, 4]])
        values = (
            f"{np.hypot(*(new[k, :2] - poses[k, :2])):.1f}",
            f"{height:.1f}",
            f"{height - (poses[k, 2] - ground[0]):+z.1f}",
            f"{180 - (180 - yaw) % 360:+z.0f}",
            f"{pitch:+z.0f}",
        )
        table.add_row(str(k + 1), Text(sensor.name), *values)
    return table


def sweep_table(rows: Sequence[Mapping[str, str]]) -> RenderableType:
    """The rows of a study by layout: mean ± standard deviation over scenes and settings."""
    table = table_of(
        "Mean ± standard deviation", "layout", "jobs", "failed", *(m.symbol for m in listed())
    )
    by: dict[str, list[Mapping[str, str]]] = {}
    for row in rows:
        by.setdefault(row["layout"], []).append(row)
    for name, own in by.items():
        done = [row for row in own if row["status"] == "done"]
        scores = (np.array([float(row[key]) for row in done]) for key in (m.name for m in listed()))
        words = (f"{x.mean():.3f} ± {x.std():.2f}" if len(x) else "" for x in scores)
        table.add_row(Text(name), str(len(own)), str(len(own) - len(done)), *words)
    return table


def comparison_table(results: Sequence[Result]) -> RenderableType:
    """What several searches came to, a row a method, the best median first."""
    by: dict[str, list[Result]] = {}
    for result in results:
        by.setdefault(result.method, []).append(result)
    name = f"{results[0].start.name}: {results[0].objective_before:.4f} at the start"
    table = table_of(name, "method", *_ENDS)
    for method, of in sorted(by.items(), key=lambda row: -np.median([r.objective for r in row[1]])):
        scores = [result.objective for result in of]
        work = [np.median([getattr(r, key) for r in of]) for key in ("evaluations", "seconds")]
        numbers = [f"{value:.4f}" for value in (np.median(scores), min(scores), max(scores))]
        table.add_row(method, str(len(of)), *numbers, *(f"{value:.0f}" for value in work))
    return table


def pareto_table(found: Sequence[DeviceMix]) -> RenderableType:
    """What mixes of devices cost and score, cheapest first; those that no other beats in bold."""
    table = table_of(
        "Cost against score", "mix", "cost\n[US$]", *(m.symbol for m in listed()), "objective", ""
    )
    for mix in found:
        scores = [f"{mix.result.scores.value(m.name):.3f}" for m in listed()]
        numbers = (f"{mix.cost:,.0f}", *scores, f"{mix.result.objective:.4f}")
        words = ("front", "bold") if mix.front else ("", "")
        table.add_row(Text(mix.name), *numbers, words[0], style=words[1])
    return table


def tolerance_table(found: Tolerance, layout: Layout) -> RenderableType:
    """Slopes of each sensor, and the score before and after random installation errors."""
    step = f"per {100 * POSITION_STEP:g} cm"
    heads = [f"{name}\n{step}" for name in "xyz"] + [f"{name}\nper 1°" for name in _TURNS]
    around = Conditions.of(found.settings["light"], found.settings["weather"])
    slopes = table_of(f"What P_sm of {layout.name}{around.words} gains", "#", "sensor", *heads)
    for k, row in enumerate(found.slopes):
        values = (row.x, row.y, row.z, row.yaw, row.pitch)
        slopes.add_row(str(k + 1), Text(row.sensor), *(f"{value:+.5f}" for value in values))
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
    """A tolerance as a JSON-serialisable record."""
    return {
        "score": found.score,
        "mean": found.mean,
        "low": found.low,
        "left": found.left.tolist(),
        "slopes": [
            {
                "sensor": row.sensor,
                **{f"{axis}_per_10_cm": getattr(row, axis) for axis in "xyz"},
                **{f"{turn}_per_deg": getattr(row, turn) for turn in _TURNS},
            }
            for row in found.slopes
        ],
        "settings": _plain(found.settings),
        **_origin(scene, layout),
    }


def scores_record(scores: Scores, scene: Scene, layout: Layout) -> dict[str, Any]:
    """Scores as a JSON-serialisable record, every number exactly as scored.

    Beside the scores it says of what they are and how to make them again. Raises
    InspeError where the scores are not of this layout.
    """
    return {
        **{m.name: float(scores.value(m.name)) for m in listed()},
        "information_gain_literal": float(scores.information_gain_literal),
        "region_coverage": {key: float(share) for key, share in scores.region_coverage.items()},
        "level_coverage": [float(share) for share in scores.level_coverage],
        "contributions": [
            {
                "sensor": part.sensor,
                "unit": unit,
                "device": device,
                **{m.name: float(part.value(m.name)) for m in listed()},
            }
            for part, unit, device in _members(scores, layout)
        ],
        "settings": _plain(scores.settings),
        **_origin(scene, layout),
    }


def _origin(scene: Scene, layout: Layout) -> dict[str, Any]:
    """What a record is of, and which versions made it."""
    return {
        "scene": {
            "name": scene.name,
            "source": scene.intersection.source,
            "settings": dict(scene.settings),
        },
        "layout": layout.name,
        "versions": {
            "inspe_jax": __version__,
            "jax": jax.__version__,
            "numpy": np.__version__,
        },
    }


def scene_table(scene: Scene) -> RenderableType:
    """A scene for people: where it is from, its voxels, its traffic, its regions, its notes."""
    place, grid, traffic = scene.intersection, scene.voxels, scene.traffic
    facts = table_of(scene.name, "scene", "")
    rows = {
        "source": place.source,
        "centre": _position(place.center),
        "region of interest": f"radius {grid.radius:g} m",
        "voxels": f"{len(grid.columns):,} columns × {grid.level_count} levels = {grid.count:,}; "
        f"{grid.words}",
        "arms, poles, routes": f"{len(place.arms)}, {len(place.poles)}, {len(place.routes)}",
        "traffic": f"{traffic.frame_count} frames, {traffic.mean_count:.1f} road users on average",
        "settings": ", ".join(f"{key} {value}" for key, value in scene.settings),
        "notes": "\n".join(place.notes),
    }
    for name, value in rows.items():
        if value:
            facts.add_row(name, Text(value))
    share = table_of("Regions", "region", "weight", "columns", "share")
    for region in Region:
        count = int((grid.region == region).sum())
        if count:
            part = f"{count / len(grid.columns):.1%}"
            share.add_row(region.key, f"{WEIGHTS[region]:g}", f"{count:,}", part)
    return Group(facts, "", share)


def layout_table(layout: Layout) -> RenderableType:
    """A layout for people: each sensor with its device and pose [m, degrees].

    Height is above the unit's base; roll has a column only where some sensor rolls.
    """
    poses = np.asarray(layout.poses, float)
    height = poses[:, 2] - [layout.units[sensor.unit].base[2] for sensor in layout.sensors]
    roll, pitch, yaw = np.degrees(poses[:, 3:]).T
    numbers = {
        "x\n[m]": poses[:, 0],
        "y\n[m]": poses[:, 1],
        "height\n[m]": height,
        "yaw\n[°]": 180 - (180 - yaw) % 360,
        "pitch\n[°]": pitch,
        **({"roll\n[°]": roll} if np.any(np.abs(roll) >= 0.05) else {}),
    }
    table = table_of(f"Layout {layout.name}", "#", "sensor", "device", *numbers)
    for k, (sensor, row) in enumerate(
        zip(layout.sensors, zip(*numbers.values(), strict=True), strict=True)
    ):
        names = [Text(name) for name in (sensor.name, sensor.spec.name)]
        table.add_row(str(k + 1), *names, *(f"{value:z.1f}" for value in row))
    return table


def devices_table(devices: Mapping[str, Device] | Iterable[Device]) -> RenderableType:
    """The catalogue for people: what each device resolves, how far, at what price, says who."""
    headers = (
        "device",
        "kind",
        "pixels,\nchannels",
        "field\nof view",
        "reach\n[m]",
        "rays",
        "price\n[US$]",
    )
    table = table_of("Devices", *headers)
    sources = [Text("Where their figures are from", style="bold")]
    for device in devices.values() if isinstance(devices, Mapping) else devices:
        resolution, view = _resolution(device.spec)
        grid = device.spec.grid
        price = "–" if device.price_usd is None else f"{device.price_usd:,.0f}"
        rays = f"{len(grid.rows) * grid.column_count:,}"
        numbers = (resolution, view, f"{grid.reach:g}", rays, price)
        table.add_row(device.name, device.kind, *numbers)
        words = f"{device.name}: {device.source.rstrip('.')}. {device.note}".strip()
        sources.append(Text(words, style="dim"))
    return Group(table, "", *sources)


def profile_table(profile: Profile) -> RenderableType:
    """A profile for people: every value, and why."""
    table = table_of(f"{profile.name}: {profile.title}", "setting", "value", "reason")
    for key, reason in profile.reasons.items():
        table.add_row(key, f"{getattr(profile, key)}", reason)
    return table


def junctions_table(infos: "Iterable[JunctionInfo]", map_name: str) -> RenderableType:
    """The junctions of a map for people: id, centre (x, y, z) [m], arms, size, what is there."""
    table = table_of(
        f"Junctions of {map_name}", "id", "centre [m]", "arms", "size [m]", "crosswalks", "signals"
    )
    for info in infos:
        counts = (str(info.crosswalks), str(info.signals))
        table.add_row(
            str(info.id), _position(info.center), str(info.arms), f"{info.size:.1f}", *counts
        )
    return table


def built_ins_table() -> RenderableType:
    """The built-in intersections for people."""
    table = table_of(
        "Built-in intersections", "name", "arms", "poles", "routes", "regions", "notes"
    )
    for name in BUILT_INS:
        place = built_in(name)
        regions = ", ".join(
            region.key
            for region in Region
            if region in place.regions and not place.regions[region].is_empty
        )
        counts = (str(len(each)) for each in (place.arms, place.poles, place.routes))
        table.add_row(name, *counts, regions, Text("\n".join(place.notes)))
    return table


_PROSE = {"", "sensor", "unit", "maker", "source", "notes", "regions", "field of view"}
_NAMES = {
    "mix",
    "P_sm",
    "metric",
    "method",
    "symbol",
    "region",
    "scene",
    "device",
    "kind",
    "name",
    "centre [m]",
}
_NAMES |= {"pixels,\nchannels", "split", "class", "column"}


def table_of(title: str, *columns: str) -> Table:
    """A table that may break prose between words, but numbers and names at no price."""
    table = Table(title=Text(title), title_justify="left", title_style="bold", box=box.SIMPLE_HEAD)
    table.pad_edge, table.collapse_padding = False, True
    for name in columns:
        breaks = name in _PROSE
        table.add_column(
            Text(name),
            justify="left" if name in _PROSE | _NAMES else "right",
            no_wrap=not breaks,
            min_width=5 if breaks else None,
            overflow="fold",
        )
    return table


def _members(scores: Scores, layout: Layout) -> list[tuple[Any, str, str]]:
    """(contribution, unit, device) of each sensor. Raises InspeError where they do not match."""
    scored = [part.sensor for part in scores.contributions]
    placed = [sensor.name for sensor in layout.sensors]
    if scored != placed:
        raise InspeError(
            f"{layout.name}: the scores are of another layout: of sensors {', '.join(scored)}; "
            f"expected {', '.join(placed)}"
        )
    return [
        (part, layout.units[sensor.unit].name, sensor.spec.name)
        for part, sensor in zip(scores.contributions, layout.sensors, strict=True)
    ]


def _resolution(spec: Spec) -> tuple[str, str]:
    """Pixels or channels, and the field of view from edge to edge [°]."""
    if isinstance(spec, CameraSpec):
        angles = [
            np.degrees(np.arctan2(middle, spec.focal) + np.arctan2(side - middle, spec.focal))
            for side, middle in zip((spec.width, spec.height), spec.principal, strict=True)
        ]
        return f"{spec.width} × {spec.height}", f"{angles[0]:.0f}° × {angles[1]:.0f}°"
    low, high = np.degrees([spec.elevations[0], spec.elevations[-1]])
    around = f"{np.degrees(spec.azimuth_fov):.0f}°"
    return (
        f"{len(spec.elevations)}",
        f"{around} × {high - low:.0f}°",
    )


def _position(center: Iterable[float]) -> str:
    return ", ".join(f"{value:z.1f}" for value in center)


def _plain(value: Any) -> Any:
    """Settings as JSON has them: lists for tuples and arrays, Python's own numbers."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value
