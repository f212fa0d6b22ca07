"""Plan views of a scene and of a scored layout, in colours that readers with any colour vision can
tell apart: those of Okabe and Ito's palette and of cividis."""

import textwrap
from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import shapely
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, PathPatch
from matplotlib.path import Path as Outline
from matplotlib.ticker import MaxNLocator
from scipy.ndimage import uniform_filter
from shapely.geometry.base import BaseGeometry

from inspe_jax.core import sheet
from inspe_jax.core.errors import InspeError
from inspe_jax.report.bodies import LANE, WALK, body_keys, draw_bodies, draw_routes
from inspe_jax.report.layers import MapLayer, cell_rows, seen_layer
from inspe_jax.report.outlines import clear_outlines
from inspe_jax.scene.regions import PRECEDENCE, Region
from inspe_jax.scene.scene import Scene
from inspe_jax.scene.traffic.frames import CLASSES
from inspe_jax.scene.voxels import VoxelGrid
from inspe_jax.scoring.evaluate import Scores
from inspe_jax.scoring.metrics import Metric, listed_in
from inspe_jax.sensing.layout import Layout, device_words
from inspe_jax.sensing.sensors import CameraSpec, Spec
from inspe_jax.visibility.queries import check_frame

REGION_COLORS: dict[Region, str] = dict(
    zip(Region, ("#dcdcdc", "#f5eb86", "#e9a83a", "#74c4ab", "#b4dcf4"), strict=True)
)
"""Tints of Okabe and Ito's black, yellow, orange, bluish green and sky blue, by region."""
SENSOR_COLORS: defaultdict[str, str] = defaultdict(
    lambda: "#2f5d50", {"camera": "#c04a00", "lidar": "#8a2f74", "thermal": "#7a5c00"}
)
"""Vermilion, reddish purple, dark yellow and, for other kinds, dark green: dark enough for white
digits."""

_LINE: dict[str, Any] = dict(ec="#707070", lw=0.3)
OUTLINE: dict[str, Any] = dict(fc="none", ec="#999999", lw=0.45)
_HATCH: dict[str, Any] = dict(fc="none", ec="#606060", lw=0.0, hatch="//////")
_POLE: dict[str, Any] = dict(ls="", marker="o", ms=4.5, mfc="white", mec="black", mew=1.0)
USER: dict[str, Any] = dict(fc="white", ec="black", lw=0.4)
_MARKERS = defaultdict(lambda: "D", {"camera": "o", "lidar": "s", "thermal": "h"})
LEGEND_WIDTH = 27  # most letters of a line of the legend, as wide as the panel
_LABEL = 8.5  # height of a line of a layer's label [pt]
_ROW = 9.5  # height of a row of the panel [pt]
_BADGE = 8.5  # diameter of a sensor's number on the map [pt]


def scene_view(scene: Scene, *, frame: int = 0) -> Figure:
    """Plan view of a scene: its regions, lanes, mounting areas, poles, and one frame's road users.
    World metres, north up. Raises InspeError if there is no such ``frame``.

    >>> report.scene_view(scene, frame=2).savefig("scene.png")
    """
    place, grid = scene.intersection, scene.voxels
    notes = [f"• {note}" for note in (f"source: {place.source}", *place.notes)]
    facts = (
        f"radius {grid.radius:g} m, {grid.words}: {len(grid.columns):,} columns × "
        f"{grid.level_count} levels = {grid.count:,} voxels\n"
        f"{len(place.arms)} arms, {len(scene.poles)} poles; {_users(scene, frame)}; "
        f"{sheet.setting_words({'profile': scene.profile.name})}"
    )
    with sheet.house_style():
        fig, ax, panel = sheet.sheet(scene.name, facts, notes, 0.0)
        sheet.frame_map(ax, scene.voxels.center, scene.voxels.radius, grid.radius)
        draw_regions(ax, scene, lambda region: dict(_LINE, fc=REGION_COLORS[region]))
        ax.add_patch(_patch(place.mounting.intersection(_disc(scene)), **_HATCH, zorder=2))
        draw_routes(ax, scene)
        draw_bodies(ax, scene)
        draw_users(ax, scene, frame, [dict(fc=c, ec="black", lw=0.3) for c in sheet.CLASS_COLORS])
        ax.plot(*scene.poles.T[:2], **_POLE, zorder=6)
        panel.legend(handles=_scene_keys(scene), loc="upper left", **sheet.KEYS)
    return fig


def plan_view(
    scene: Scene, layout: Layout, scores: Scores, layer: MapLayer | None = None, *, frame: int = 0
) -> Figure:
    """Plan view of a scored layout: how often each column is seen, and what each sensor looks at.

    For a camera the horizontal field of view is drawn up to its depth, for a LiDAR its reach.

    Args:
        scene, layout, scores: A layout and its scores on the scene.
        layer: What the raster shows; ``scores.seen_share``, the share of frames and levels in which
            a column is seen, if None.
        frame: Number of the frame of traffic that is drawn.

    Raises:
        InspeError: There is no such frame, or scores are of another scene.

    >>> figure = report.plan_view(scene, layout, inspe_jax.evaluate(scene, layout))
    >>> figure.savefig("plan.png")
    """
    layer = layer or seen_layer(scores.seen_share, scene)
    layout = scores.conditions.layout(layout)
    values = [(m, f"{in_math(m)} {scores.value(m.name):.3f}") for m in listed_in(scores)]
    line = ",  ".join(f"{metric.words} {value}" for metric, value in values)
    if len(line) > sheet.LINE:  # then by their symbols alone
        line = ",  ".join(value for _, value in values)
    facts = (
        f"{line}\n"
        f"radius {scene.voxels.radius:g} m, {scene.voxels.words}; {_users(scene, frame)}; "
        f"{sheet.setting_words(scores.settings)}"
    )
    keys = plan_keys(scene, layout)
    rows = 8 + len(layout) + len({s.unit for s in layout.sensors}) + 1.4 * len(keys)
    with sheet.house_style():
        title = f"{layout.name} at {scene.name}"
        fig, ax, panel = sheet.sheet(title, facts, [], rows * _ROW / 72, math=True)
        image = draw_plan(ax, scene, layout, layer, reach_of(scene, layout), frame)
        top = _list_kinds(panel, layer) if layer.kinds else _color_bar(fig, panel, image, layer)
        _list_sensors(panel, layout, top)
        panel.legend(handles=keys, loc="lower left", **sheet.KEYS)
    return fig


def in_math(metric: Metric) -> str:
    """A metric's symbol for matplotlib: its index is set below the line, as in P_sm."""
    letter, _, index = metric.symbol.partition("_")
    return f"${letter}_{{{index}}}$" if index else letter


def column_raster(
    voxels: VoxelGrid, values: Float[np.ndarray, " L"]
) -> tuple[Float[np.ndarray, "N N"], tuple[float, float, float, float]]:
    """A value for each column as an image, NaN where there is no column, from the south-west corner
    northward and eastward; and (x0, x1, y0, y1) [m]. Raises InspeError if L is not the number of
    columns."""
    values = np.asarray(values, float)
    if values.shape != (len(voxels.columns),):
        raise InspeError(
            f"scores of another scene: their columns' values have shape {values.shape}, expected "
            f"({len(voxels.columns)},), one value a column"
        )
    half = int(np.ceil(voxels.radius / voxels.spacing))
    index = np.round((voxels.columns - voxels.center[:2]) / voxels.spacing - 0.5).astype(int) + half
    raster = np.full((2 * half, 2 * half), np.nan)
    raster[index[:, 1], index[:, 0]] = values
    (x, y), reach = voxels.center[:2].tolist(), half * voxels.spacing
    return raster, (x - reach, x + reach, y - reach, y + reach)


def layer_raster(
    voxels: VoxelGrid, layer: MapLayer
) -> tuple[Float[np.ndarray, "N N"], tuple[float, float, float, float]]:
    """:func:`column_raster` of a layer as maps show it: where it asks, of squares of
    :func:`~inspe_jax.report.layers.cell_rows` rows about each column."""
    raster, extent = column_raster(voxels, layer.values)
    rows = cell_rows(voxels.spacing)
    if not layer.averaged or rows < 2:
        return raster, extent
    there = ~np.isnan(raster)

    def mean(values: Bool[np.ndarray, "N N"] | Float[np.ndarray, "N N"]) -> np.ndarray:
        return uniform_filter(np.where(there, values, 0.0), rows, mode="constant")

    if layer.kinds:
        each = [mean(raster == kind) for kind in range(len(layer.kinds))]
        found = np.argmax(np.round(each, 6), 0)  # of equals the first, whatever the rounding
    else:
        found = mean(raster) / np.where(there, mean(there), 1.0)
    return np.where(there, found, np.nan), extent


def spread_badges(
    anchors: Float[np.ndarray, "S 2"], toward: Float[np.ndarray, "S 2"], gap: float
) -> Float[np.ndarray, "S 2"]:
    """Places [m] for labels, each ``gap`` from its anchor in the direction ``toward`` if possible;
    no two are nearer to each other than ``gap``, and none to an anchor than 0.75·``gap``."""
    turn = np.arange(len(anchors)) * 2.4  # the golden angle separates labels with the same wish
    place = anchors + gap * toward + 1e-3 * gap * np.column_stack([np.cos(turn), np.sin(turn)])
    for _ in range(1000):
        push, count = np.zeros_like(place), np.zeros(len(place))
        for others, least, part in ((place, gap, 0.5), (anchors, 0.75 * gap, 1.0)):
            away = place[:, None] - others  # (S, S, 2)
            distance = np.maximum(np.hypot(away[..., 0], away[..., 1]), 1e-9 * gap)
            if others is place:
                np.fill_diagonal(distance, np.inf)
            lack = np.maximum(least - distance, 0.0)
            push += part * (away * (lack / distance)[..., None]).sum(1)
            count += (lack > 0).sum(1)
        if not count.any():
            break
        # The mean of the pushes: their sum would throw a label out of a crowd.
        place = place + 1.02 * push / np.maximum(count, 1)[:, None]
    return place


def _scene_keys(scene: Scene) -> list[Any]:
    place = scene.intersection
    here, users = set(scene.voxels.region.tolist()), {route.user for route in place.routes}
    kinds = set(scene.traffic.kind[scene.traffic.valid].tolist())
    classes = zip(CLASSES, sheet.CLASS_COLORS, strict=True)
    offered: list[tuple[bool, Any]] = [
        *((r in here, Patch(**_LINE, fc=c, label=r.key)) for r, c in REGION_COLORS.items()),
        (not place.mounting.is_empty, Patch(**{**_HATCH, "fc": "white"}, label="mounting area")),
        (len(scene.poles) > 0, Line2D([], [], **_POLE, label="standing pole")),
        ("vehicle" in users, Line2D([], [], **LANE, marker=">", ms=2.5, label="lane")),
        ("pedestrian" in users, Line2D([], [], **WALK, label="walking route")),
        *(
            (k in kinds, Patch(fc=c, ec="black", lw=0.3, label=name))
            for k, (name, c) in enumerate(classes)
        ),
        *((True, key) for key in body_keys(scene)),
        (True, Line2D([], [], **sheet.CIRCLE, label="region of interest")),
    ]
    return [key for there, key in offered if there]


def plan_keys(scene: Scene, layout: Layout) -> list[Any]:
    """Legend entries of a plan view, with the reach of each kind of sensor."""
    keys: list[Any] = []
    for kind in sorted({sensor.spec.kind for sensor in layout.sensors}):
        specs = [sensor.spec for sensor in layout.sensors if sensor.spec.kind == kind]
        far = ", ".join(f"{reach:g}" for reach in sorted({s.grid.reach for s in specs}))
        words = f"{specs[0].title}, {'view to' if specs[0].aimed else 'reach'} {far} m"
        words = textwrap.fill(words, LEGEND_WIDTH)
        keys.append(Line2D([], [], **wedge_look(specs[0], halo=False), label=words))
    if scene.traffic.valid.any():
        keys.append(Patch(**USER, label="road user"))
    keys += body_keys(scene)
    keys.append(Line2D([], [], color=OUTLINE["ec"], lw=0.8, label="region outlined"))
    return [*keys, Line2D([], [], **sheet.CIRCLE, label="region of interest")]


def _users(scene: Scene, frame: int) -> str:
    traffic = scene.traffic
    check_frame(scene, frame)
    count, mean = int(traffic.valid[frame].sum()), traffic.mean_count
    return f"frame {frame} of {traffic.frame_count}: {count} road users (mean {mean:.1f})"


def _disc(scene: Scene) -> BaseGeometry:
    return shapely.Point(scene.voxels.center[:2]).buffer(scene.voxels.radius, quad_segs=64)


def _patch(shape: BaseGeometry, **look: Any) -> PathPatch:
    """The polygons of a shape with their holes; points and lines that a clip left are dropped."""
    rings = shapely.get_rings(shapely.get_parts(shapely.orient_polygons(shape)))
    outlines = [Outline(shapely.get_coordinates(ring), closed=True) for ring in rings]
    return PathPatch(Outline.make_compound_path(*outlines), **look)


def reach_of(scene: Scene, *layouts: Layout) -> float:
    """How far from the centre a map of layouts must reach to show all sensors [m]."""
    at = np.concatenate([np.asarray(one.poses, float)[:, :2] for one in layouts])
    return max(scene.voxels.radius, np.hypot(*(at - scene.voxels.center[:2]).T).max())


def draw_plan(
    ax: Axes,
    scene: Scene,
    layout: Layout,
    layer: MapLayer,
    reach: float,
    frame: int | None = 0,
    *,
    side: float = sheet.MAP,
    own: Sequence[int] | None = None,
) -> AxesImage:
    """Draw a map of ``reach`` [m] and ``side`` [inch]: a layer, and over it a frame's road users if
    one is given, what each sensor looks at, and its number; or only the sensors at the places
    ``own``. Raises InspeError if the layer is of another scene."""
    raster, extent = layer_raster(scene.voxels, layer)
    sheet.frame_map(ax, scene.voxels.center, scene.voxels.radius, reach)
    own = range(len(layout)) if own is None else own
    specs, poses = [layout.sensors[s].spec for s in own], np.asarray(layout.poses, float)[[*own]]
    look: dict[str, Any] = dict(cmap=layer.colors, vmin=0.0, vmax=layer.most)
    if layer.kinds:
        colors = ListedColormap([color for _, color in layer.kinds])
        look = dict(cmap=colors, vmin=-0.5, vmax=len(layer.kinds) - 0.5)
    look |= dict(interpolation="nearest", zorder=0.5)
    image = ax.imshow(raster, extent=extent, origin="lower", **look)
    draw_regions(ax, scene, lambda _: OUTLINE)
    draw_bodies(ax, scene)
    if frame is not None:
        draw_users(ax, scene, frame, [USER] * len(CLASSES))
    for spec, pose in zip(specs, poses, strict=True):
        for ring in clear_outlines(scene, spec, pose):
            ax.plot(*ring.T, **wedge_look(spec), zorder=5)
    _draw_badges(ax, specs, poses, side, [s + 1 for s in own])
    return image


def draw_regions(ax: Axes, scene: Scene, look: Callable[[Region], dict[str, Any]]) -> None:
    """Draw regions within the circle; where they overlap, a column's own is on top."""
    disc = _disc(scene)
    for region in reversed(PRECEDENCE):
        shape = scene.intersection.regions.get(region)
        if shape is not None:
            ax.add_patch(_patch(shape.intersection(disc), **look(region), zorder=1))


def draw_users(ax: Axes, scene: Scene, frame: int, looks: list[dict[str, Any]]) -> None:
    """Draw one frame's road users as oriented rectangles, with a look for each class."""
    traffic = scene.traffic
    for kind, look in enumerate(looks):
        who = traffic.valid[frame] & (traffic.kind[frame] == kind)
        yaw, half = traffic.yaw[frame, who], traffic.size[frame, who, None, :2] / 2
        x, y = np.moveaxis(half * [[1, 1], [-1, 1], [-1, -1], [1, -1]], -1, 0)  # (B, 4) each
        cos, sin = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
        corners = np.stack([x * cos - y * sin, x * sin + y * cos], -1)  # (B, 4, 2)
        boxes = traffic.center[frame, who, None, :2] + corners
        ax.add_collection(PolyCollection(list(boxes), **look, zorder=4), autolim=False)


def wedge_look(spec: Spec, halo: bool = True) -> dict[str, Any]:
    """Line style of the outline of what a sensor looks at."""
    line = "-" if isinstance(spec, CameraSpec) else (0, (4, 2))
    look: dict[str, Any] = dict(color=SENSOR_COLORS[spec.kind], lw=0.8, ls=line)
    return dict(look, path_effects=sheet.HALO) if halo else look


def _badge(ax: Axes, at: Sequence[float] | np.ndarray, number: int, kind: str) -> None:
    look: dict[str, Any] = dict(mfc=SENSOR_COLORS[kind], mec="white", mew=0.5)
    ax.plot(*at, _MARKERS[kind], ms=_BADGE if kind == "camera" else _BADGE - 1, zorder=7, **look)
    ax.annotate(
        str(number), tuple(at), size=5.5, weight="bold", color="white", ha="center",
        va="center_baseline", zorder=8,
    )  # fmt: skip


def _draw_badges(
    ax: Axes, specs: Sequence[Spec], poses: np.ndarray, side: float, numbers: Sequence[int]
) -> None:
    """Draw a dot at each sensor and its number beside it; a camera's number is in front of it."""
    (left, right), (low, high) = ax.get_xlim(), ax.get_ylim()
    out = poses[:, :2] - [(left + right) / 2, (low + high) / 2]
    out /= np.maximum(np.hypot(*out.T), 1e-9)[:, None]
    ahead = np.column_stack([np.cos(poses[:, 5]), np.sin(poses[:, 5])])
    camera = np.array([[isinstance(spec, CameraSpec)] for spec in specs])
    gap = (_BADGE + 1.5) * (right - left) / (side * 72)
    places = spread_badges(poses[:, :2], np.where(camera, ahead, out), gap)
    for spec, number, foot, place in zip(specs, numbers, poses, places, strict=True):
        kind, color = spec.kind, SENSOR_COLORS[spec.kind]
        ax.plot([foot[0], place[0]], [foot[1], place[1]], color=color, lw=0.7, zorder=6)
        ax.plot(*foot[:2], _MARKERS[kind], ms=3.5, mfc=color, mec="white", mew=0.4, zorder=6)
        _badge(ax, place, number, kind)


def _color_bar(fig: Figure, panel: Axes, image: Any, layer: MapLayer) -> float:
    """Draw a layer's colours below its label; returns their height [pt]."""
    depth = -panel.get_ylim()[0]
    low = 13.0 + _LABEL * (1 + layer.label.count("\n"))
    axes = panel.inset_axes((0.02, 1 - low / depth, 0.94, 7 / depth))
    quarters: Any = [0.0, 0.25, 0.5, 0.75, 1.0]
    ticks = quarters if layer.most == 1.0 else MaxNLocator(5, steps=[1, 2, 5, 10])
    fig.colorbar(image, cax=axes, orientation="horizontal", ticks=ticks, format="{x:g}")
    middle = panel.get_xlim()[1] / 2
    panel.text(middle, -1, layer.label, ha="center", va="top", linespacing=1.2)
    return low + 22.0


def kind_keys(layer: MapLayer) -> list[Any]:
    """Legend entries of a layer's kinds of columns."""
    return [Patch(fc=color, ec=OUTLINE["ec"], lw=0.4, label=name) for name, color in layer.kinds]


def _list_kinds(panel: Axes, layer: MapLayer) -> float:
    """Draw the legend of the kinds of columns; returns its height [pt]."""
    keys = panel.legend(
        handles=kind_keys(layer), loc="upper left", title=layer.label, title_fontsize=7,
        alignment="left", **sheet.KEYS,
    )  # fmt: skip
    panel.add_artist(keys)
    lines = sum(name.count("\n") for name, _ in layer.kinds)
    return 11.0 * (1 + len(layer.kinds)) + 9.0 * lines + 12.0


def _list_sensors(panel: Axes, layout: Layout, top: float) -> None:
    """List units with their sensors, from ``top`` [pt] below the panel's upper edge."""
    poses = np.asarray(layout.poses, float)
    look: dict[str, Any] = dict(size=6.5, va="center", parse_math=False)
    y = -top
    panel.text(0, y, "device, height above the ground", **look, color="#404040")
    for unit, members in zip(layout.units, layout.members(), strict=True):
        if members:
            y -= _ROW
            panel.text(0, y, **look | sheet.fit(unit.name, 28, 6.5), weight="bold")
        for k in members:
            y -= _ROW
            spec, height = layout.sensors[k].spec, poses[k, 2] - unit.base[2]
            _badge(panel, (6, y), k + 1, spec.kind)
            panel.text(13, y, **look | sheet.fit(f"{device_words(spec)}, {height:.1f} m", 30, 6.5))
