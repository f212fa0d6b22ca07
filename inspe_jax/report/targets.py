"""What a road user gets at each place: tables, records and maps of LiDAR returns and px/m."""

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from rich.console import Group, RenderableType

from inspe_jax.report.figures import KEYS, column_raster, draw_badges, draw_layer, kind_keys
from inspe_jax.report.layers import MapLayer
from inspe_jax.report.routes import center_distance
from inspe_jax.report.sheet import SIDE, frame_map, house_style, sheet_of_two
from inspe_jax.report.tables import table_of
from inspe_jax.scene.regions import Region
from inspe_jax.scene.scene import Scene
from inspe_jax.scoring.targets import BANDS, FEW, TargetView
from inspe_jax.sensing.layout import Layout
from inspe_jax.visibility.queries import check_frame

RETURNS: tuple[tuple[float, str, str], ...] = (
    (0.0, "< 1", "#202020"),
    (1.0, f"1 – {FEW:g}", "#d55e00"),
    (FEW, f"{FEW:g} – 16", "#f0e442"),
    (16.0, "16 – 64", "#9ecae1"),
    (64.0, "≥ 64", "#2171b5"),
)
"""Kinds of columns by LiDAR returns on a target: least number, words and colour."""
PIXELS: tuple[tuple[float, str, str], ...] = (
    (0.0, f"< {BANDS['monitor']:g}", "#202020"),
    *(
        (least, f"{name}, ≥ {least:g}", color)
        for (name, least), color in zip(
            BANDS.items(), ("#7a3b00", "#d55e00", "#f0e442", "#9ecae1", "#2171b5"), strict=True
        )
    ),
)
"""Kinds of columns by pixels per metre: the bands of EN 62676-4."""

_HEAD, _BELOW = 0.80, 1.35  # above and below the maps [inch]


def banded(
    name: str, values: Float[np.ndarray, " L"], bands: tuple[tuple[float, str, str], ...]
) -> MapLayer:
    """A layer whose columns have the kind of the highest band that they reach."""
    number = np.searchsorted([least for least, _, _ in bands], values, side="right") - 1.0
    return MapLayer(name, name, number, kinds=tuple((words, color) for _, words, color in bands))


def _shares(
    scene: Scene, values: Float[np.ndarray, " L"]
) -> list[tuple[str, Float[np.ndarray, " l"]]]:
    """The values of each region that the scene has, and of all of them."""
    label = scene.voxels.region
    there = [region for region in Region if (label == region).any()]
    return [*((region.key, values[label == region]) for region in there), ("all", values)]


def _measured(layout: Layout) -> dict[str, bool]:
    """Which of the two a layout's sensors have: returns, and pixels."""
    pictures = [sensor.spec.focal_pixels is not None for sensor in layout.sensors]
    return dict(returns=not all(pictures), pixels=any(pictures))


def targets_table(scene: Scene, layout: Layout, view: TargetView) -> RenderableType:
    """By region: how many LiDAR returns and how many pixels per metre a road user gets."""
    parts: list[RenderableType] = []
    has = _measured(layout)
    if has["returns"]:
        table = table_of(
            f"LiDAR returns on a {view.road_user}, mean over frames: share of places", "region",
            "median", "10 %", *(words for _, words, _ in RETURNS),
        )  # fmt: skip
        for region, values in _shares(scene, view.points_on_target):
            kinds = banded("", values, RETURNS).values
            each = [f"{(kinds == k).mean():.0%}" for k in range(len(RETURNS))]
            low, middle = np.percentile(values, [10, 50])
            table.add_row(region, f"{middle:.1f}", f"{low:.1f}", *each)
        parts += [table, ""]
    if has["pixels"]:
        names = (f"{name}\n≥ {least:g}" for name, least in BANDS.items())
        table = table_of("Pixels per metre of the best camera, no traffic: share of places",
                         "region", "median", *names)  # fmt: skip
        for region, values in _shares(scene, view.pixel_density):
            each = [f"{(values >= least).mean():.0%}" for least in BANDS.values()]
            table.add_row(region, f"{np.median(values):.1f}", *each)
        parts += [table, ""]
    return Group(*parts)


def targets_record(scene: Scene, layout: Layout, view: TargetView) -> dict[str, Any]:
    """The same as a record for JSON: medians and shares by region."""

    def of(values: np.ndarray, least: dict[str, float]) -> dict[str, Any]:
        return {
            region: dict(
                median=float(np.median(part)),
                shares={name: float((part >= number).mean()) for name, number in least.items()},
            )
            for region, part in _shares(scene, values)
        }

    has = _measured(layout)
    record: dict[str, Any] = dict(scene=scene.name, layout=layout.name, road_user=view.road_user)
    if has["returns"]:
        returns = {f"at least {least:g}": least for least, _, _ in RETURNS[1:]}
        record["lidar_returns"] = of(view.points_on_target, returns)
    if has["pixels"]:
        record["pixels_per_metre"] = of(view.pixel_density, BANDS)
    return record


def targets_view(scene: Scene, layout: Layout, view: TargetView, *, frame: int = 0) -> Figure:
    """Maps of how many LiDAR returns and pixels per metre a road user gets at each place.

    There is one map for each that the layout has. Raises InspeError if there is no such ``frame``.
    """
    check_frame(scene, frame)
    has = _measured(layout)
    maps: list[tuple[str, MapLayer, bool]] = []
    if has["returns"]:
        words = f"LiDAR returns on a {view.road_user},\nmean over frames of traffic"
        maps.append((words, banded("returns", view.points_on_target, RETURNS), False))
    if has["pixels"]:
        words = f"pixels per metre across a {view.road_user},\nbest camera, without traffic"
        maps.append((words, banded("pixels", view.pixel_density, PIXELS), True))
    poses = np.asarray(layout.poses, float)
    reach = max(scene.voxels.radius, center_distance(scene, poses).max())
    with house_style():
        title = f"What a {view.road_user} gets: {layout.name} at {scene.name}"
        facts = f"at each place of the region, radius {scene.voxels.radius:g} m; frame {frame}"
        fig, axes = sheet_of_two(title, facts, len(maps), _HEAD, _BELOW)
        height = fig.get_figheight()
        for k, (ax, (words, layer, pictures)) in enumerate(zip(axes, maps, strict=True)):
            frame_map(ax, scene, reach)
            raster, extent = column_raster(scene.voxels, layer.values)
            # Only the sensors that the map is of, with their numbers in the layout.
            own = [
                s
                for s, each in enumerate(layout.sensors)
                if (each.spec.focal_pixels is not None) == pictures
            ]
            few = replace(layout, poses=poses[own], sensors=tuple(layout.sensors[s] for s in own))
            draw_layer(ax, scene, few, poses[own], layer, raster, extent, frame)
            draw_badges(ax, few, poses[own], SIDE, [s + 1 for s in own])
            ax.set_title(words, size=7.5, loc="left", pad=4)
            if k:
                ax.set(ylabel="")
            fig.legend(
                handles=kind_keys(layer), loc="upper left", ncols=2, columnspacing=1.6,
                bbox_to_anchor=(ax.get_position().x0, (_BELOW - 0.45) / height), **KEYS,
            )  # fmt: skip
    return fig
