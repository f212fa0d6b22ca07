"""What a road user gets at each place: tables, records and maps of returns, px/m and chances."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from rich.console import Group, RenderableType

from inspe_jax.core.sheet import KEYS, SIDE, house_style, setting_words, sheet_of_two
from inspe_jax.core.tables import table_of
from inspe_jax.report.figures import draw_plan, kind_keys, reach_of
from inspe_jax.report.layers import MapLayer, free_of_bodies
from inspe_jax.scene.regions import Region
from inspe_jax.scene.scene import Scene
from inspe_jax.scoring.detection import BANDS, EDITION, FEW
from inspe_jax.scoring.targets import TargetView
from inspe_jax.sensing.conditions import FAIR, Conditions
from inspe_jax.sensing.layout import Layout
from inspe_jax.visibility.queries import check_frame

Bands = dict[str, float]
"""Kinds of columns: the least number of each, by its words."""
RETURNS = {"< 1": 0.0, f"1 – {FEW:g}": 1.0, f"{FEW:g} – 16": FEW, "16 – 64": 16.0, "≥ 64": 64.0}
"""Kinds of columns by LiDAR returns on a target."""
CHANCES = {"< 50 %": 0.0, "50 – 80 %": 0.5, "80 – 90 %": 0.8, "90 – 95 %": 0.9, "≥ 95 %": 0.95}
"""Kinds of columns by the chance that a detector finds a target."""
PIXELS = {
    edition: {f"< {min(bands.values()):g}": 0.0}
    | {f"{name}, ≥ {least:g}": least for name, least in bands.items()}
    for edition, bands in BANDS.items()
}
"""Kinds of columns by pixels per metre: the bands of each edition of IEC 62676-4."""
FIVE_COLORS = "#202020", "#d55e00", "#f0e442", "#9ecae1", "#2171b5"
PIXEL_COLORS = "#202020", "#7a3b00", *FIVE_COLORS[1:], "#6a51a3", "#3f007d"

_HEAD, _BELOW = 0.80, 1.10  # above and below the maps [inch]


def banded(values: Float[np.ndarray, " L"], bands: Bands, colors: Sequence[str]) -> MapLayer:
    """A layer whose columns have the kind of the highest band that they reach."""
    number = np.searchsorted([*bands.values()], values, side="right") - 1.0
    number[np.isnan(values)] = np.nan
    return MapLayer("", number, kinds=tuple(zip(bands, colors, strict=False)))


def _counting(layout: Layout) -> tuple[list[bool], list[bool]]:
    """Which sensors count returns: LiDARs; and which pixels: cameras."""
    specs = [sensor.spec for sensor in layout.sensors]
    ranging = [spec.grid.of.signal.noise is not None for spec in specs]
    return ranging, [spec.focal_pixels is not None for spec in specs]


def _shares(
    scene: Scene, values: Float[np.ndarray, " L"]
) -> list[tuple[str, Float[np.ndarray, " l"]]]:
    """The values of each region that the scene has, and of all of them, outside static bodies."""
    free = free_of_bodies(scene).any(1)
    label, values = scene.voxels.region[free], values[free]
    there = [region for region in Region if (label == region).any()]
    return [*((region.key, values[label == region]) for region in there), ("all", values)]


def targets_record(
    scene: Scene, layout: Layout, view: TargetView, edition: str = EDITION
) -> dict[str, Any]:
    """By region, as a record for JSON: how many LiDAR returns and how many pixels per metre a road
    user gets, as medians and shares of places, and the mean chance that it is found. Pixels are by
    the bands of an ``edition`` of IEC 62676-4."""

    def of(values: np.ndarray, least: dict[str, float]) -> dict[str, Any]:
        return {
            region: dict(
                median=float(np.median(part)),
                shares={name: float((part >= number).mean()) for name, number in least.items()},
            )
            for region, part in _shares(scene, values)
        }

    record: dict[str, Any] = dict(scene=scene.name, layout=layout.name, road_user=view.road_user)
    ranging, seeing = _counting(layout)
    if any(ranging):
        returns = {f"at least {least:g}": least for least in [*RETURNS.values()][1:]}
        record["lidar_returns"] = of(view.points_on_target, returns)
    if any(seeing):
        record["pixels_per_metre"] = of(view.pixel_density, BANDS[edition])
    found = _shares(scene, view.detectability)
    record["detectability"] = {region: float(values.mean()) for region, values in found}
    return record


def targets_table(record: Mapping[str, Any]) -> RenderableType:
    """The numbers of :func:`targets_record` as tables."""
    user, tables = record["road_user"], list[RenderableType]()
    least = {name: number for bands in BANDS.values() for name, number in bands.items()}
    for key, title in (
        ("lidar_returns", f"LiDAR returns on a {user}, mean over frames: share of places"),
        ("pixels_per_metre", "Pixels per metre of the best camera, no traffic: share of places"),
    ):
        if key in record:
            names = record[key]["all"]["shares"]
            heads = [f"{name}\n≥ {least[name]:g}" if name in least else name for name in names]
            table = table_of(title, "region", "median", *heads)
            for region, of in record[key].items():
                shares = (f"{share:.0%}" for share in of["shares"].values())
                table.add_row(region, f"{of['median']:.1f}", *shares)
            tables += [table, ""]
    chances = table_of(f"Chance that a detector finds a {user}", "region", "mean")
    for region, chance in record["detectability"].items():
        chances.add_row(region, f"{chance:.3f}")
    return Group(*tables, chances)


Panel = tuple[str, MapLayer, list[int]]
"""A map: its words, its layer, and the places in the layout of the sensors that it is of."""


def _panels(scene: Scene, layout: Layout, view: TargetView, edition: str) -> list[Panel]:
    """The maps of what a layout has, two at most: what its sensors have on a road user, and the
    chance that it is found where one kind of sensor leaves room for it."""
    free, user, panels = free_of_bodies(scene).any(1), view.road_user, list[Panel]()
    ranging, seeing = _counting(layout)
    mean = "mean over frames of traffic"
    for words, values, bands, of in (
        (f"LiDAR returns on a {user},\n{mean}", view.points_on_target, RETURNS, ranging),
        (f"pixels per metre across a {user},\nbest camera, without traffic", view.pixel_density,
         PIXELS[edition], seeing),
        (f"chance that a detector finds a {user},\n{mean}", view.detectability, CHANCES,
         [True] * len(layout)),
    ):  # fmt: skip
        if any(of):
            colors = PIXEL_COLORS if of is seeing else FIVE_COLORS
            layer = banded(np.where(free, values, np.nan), bands, colors)
            panels.append((words, layer, np.flatnonzero(of).tolist()))
    return panels[:2]


def targets_view(
    scene: Scene,
    layout: Layout,
    view: TargetView,
    *,
    frame: int = 0,
    conditions: Conditions = FAIR,
    edition: str = EDITION,
) -> Figure:
    """Maps of what a road user gets at each place: LiDAR returns, pixels per metre, and for layouts
    of one kind of sensor the chance that it is found.

    Args:
        scene: The scene.
        layout, view: A layout and its :func:`inspe_jax.target_view`, both in ``conditions``.
        frame: Number of the frame of traffic that is drawn.
        conditions: Light and weather, which are named on the sheet.
        edition: Of IEC 62676-4, whose bands pixels per metre are by.

    Raises:
        InspeError: There is no such frame.
    """
    title = f"What a {view.road_user} gets: {layout.name} at {scene.name}"
    return _sheet(scene, title, [("", layout, view)], frame, conditions, edition)


def targets_change(
    scene: Scene,
    before: tuple[Layout, TargetView],
    after: tuple[Layout, TargetView],
    *,
    frame: int = 0,
    conditions: Conditions = FAIR,
) -> Figure:
    """The maps of :func:`targets_view` of two layouts of the same sensors, one above the other.

    Args:
        scene, frame, conditions: As in :func:`targets_view`.
        before, after: A layout and its :func:`inspe_jax.target_view` each.

    Raises:
        InspeError: There is no such frame.
    """
    title = f"What a {before[1].road_user} gets: before and after, at {scene.name}"
    return _sheet(scene, title, [("before: ", *before), ("after: ", *after)], frame, conditions)


def _sheet(
    scene: Scene,
    title: str,
    rows: Sequence[tuple[str, Layout, TargetView]],
    frame: int,
    conditions: Conditions,
    edition: str = EDITION,
) -> Figure:
    """The maps of layouts, one below the other, each with what its titles begin with."""
    check_frame(scene, frame)
    reach = reach_of(scene, *(layout for _, layout, _ in rows))
    settings = setting_words(conditions.record | dict(profile=scene.profile.name))
    where = f"at each place of the region, radius {scene.voxels.radius:g} m"
    maps = [_panels(scene, layout, view, edition) for _, layout, view in rows]
    beside = max(map(len, maps))  # one for radars alone
    with house_style():
        facts = f"{where}; frame {frame}; {settings}"
        fig, axes = sheet_of_two(title, facts, beside, _HEAD, _BELOW, rows=len(rows))
        for row, (when, layout, _) in enumerate(rows):
            last = row + 1 == len(rows)
            for k, (words, layer, own) in enumerate(maps[row]):
                ax = axes[beside * row + k]
                words = when + words.splitlines()[0].rstrip(",") if when else words
                draw_plan(ax, scene, layout, layer, reach, frame, side=SIDE, own=own)
                ax.set_title(words, size=7.5, loc="left", pad=4)
                ax.set(**({"ylabel": ""} if k else {}), **({} if last else {"xlabel": ""}))
                if last:
                    corner = ax.get_position().x0, (_BELOW - 0.45) / fig.get_figheight()
                    fig.legend(
                        handles=kind_keys(layer), loc="upper left", ncols=2, columnspacing=1.6,
                        bbox_to_anchor=corner, **KEYS,
                    )  # fmt: skip
    return fig
