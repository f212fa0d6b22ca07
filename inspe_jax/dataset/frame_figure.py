"""A figure of a frame: the point cloud in plan and the images, with the boxes on both."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from inspe_jax.core import sheet
from inspe_jax.core.sheet import ASIDE, CLASS_COLORS, LEFT, MAP, WIDTH
from inspe_jax.core.words import counted
from inspe_jax.dataset.folders import Scenario
from inspe_jax.dataset.points_in_boxes import world_points
from inspe_jax.simulation.frame import KINDS, Frame, Image, Picture, RoadUserBox, Station
from inspe_jax.simulation.projection import corners, edge_lines

MARGIN = 6.0  # margin of the plan around road users and stations [m]
BADGE_COLOR = "#00543d"  # of stations: a green that no class has
_HEIGHTS = LinearSegmentedColormap.from_list(
    "heights", ["#d4d4d4", "#9db8c8", "#4c7f94", "#0d3b4a"]
)
_HEAD, _FOOT, _GAP, _WORDS = 0.62, 0.42, 0.10, 0.17  # [inch]
_DOTS: Any = (0, (1, 1.2))
RIM: list[Any] = [patheffects.withStroke(linewidth=1.3, foreground="white", alpha=0.6)]
ROW = 9.5  # height of a row of the panel [pt]


def frame_view(scenario: Scenario, number: int) -> Figure:
    """A figure of a frame: points in plan, coloured by height, images, and boxes on both: those
    without a visible pixel are dotted. Raises InspeError if there is no such frame, or a file is
    broken."""
    frame = scenario.frame(number)
    images = [
        (f"station {name_of(station)}, camera {i}", image)
        for station in frame.stations
        for i, image in enumerate(station.images)
    ]
    with sheet.house_style():
        fig, ax, panel, pictures = sheet_of_pictures([image.rgb.shape[:2] for _, image in images])
        _heading(fig, scenario, frame, [image for _, image in images])
        cloud = _draw_plan(ax, frame)
        _draw_panel(fig, panel, frame, cloud, bool(images))
        for place, (words, image) in zip(pictures, images, strict=True):
            _draw_image(place, image, frame.boxes, words)
    return fig


def sheet_of_pictures(shapes: Sequence[tuple[int, ...]]) -> tuple[Figure, Axes, Axes, list[Axes]]:
    """An empty sheet: figure, plan, panel, and a place for each picture of ``shapes`` [pixels]."""
    columns = 2 if len(shapes) <= 4 else 3 if len(shapes) <= 12 else 4
    width = (WIDTH - 2 * _GAP - _GAP * (columns - 1)) / columns
    step = width * max((tall / wide for tall, wide in shapes), default=0.0) + _WORDS + _GAP
    rows = -(-len(shapes) // columns)
    height = _HEAD + MAP + _FOOT + (rows * step + _GAP if shapes else 0.0)
    fig = Figure(figsize=(WIDTH, height), facecolor="white")
    ax = fig.add_axes((LEFT / WIDTH, 1 - (_HEAD + MAP) / height, MAP / WIDTH, MAP / height))
    beside = (sheet.PANEL / WIDTH, 1 - (_HEAD + MAP) / height, ASIDE / WIDTH, MAP / height)
    panel = fig.add_axes(beside)
    panel.set(xlim=(0, ASIDE * 72), ylim=(-MAP * 72, 0))  # in points
    panel.axis("off")
    pictures = []
    for k, (tall, wide) in enumerate(shapes):
        left = _GAP + (k % columns) * (width + _GAP)
        top = _HEAD + MAP + _FOOT + _WORDS + (k // columns) * step
        own = width * tall / wide
        place = (left / WIDTH, 1 - (top + own) / height, width / WIDTH, own / height)
        pictures.append(fig.add_axes(place))
    return fig, ax, panel, pictures


def name_of(station: Station) -> str:
    """The label of a station: its number, or ``v641`` for the vehicle 641."""
    return str(station.number) if station.number > 0 else f"v{-station.number}"


def _heading(fig: Figure, scenario: Scenario, frame: Frame, images: Sequence[Image]) -> None:
    scans = [scan for station in frame.stations for scan in station.scans]
    points = sum(len(scan.points) for scan in scans)
    facts = (
        f"{frame.time:.2f} s; {counted(len(frame.boxes), 'object')}; "
        f"{counted(len(frame.stations), 'station')}\n"
        f"{counted(len(images), 'image')}; {counted(len(scans), 'point cloud')}"
        f"{f' of {points:,} points together' if scans else ''}"
    )
    sheet.heading(fig, f"{scenario.name}, frame {frame.number}", facts, linespacing=1.35)


def _draw_plan(ax: Axes, frame: Frame) -> Any:
    """Draw points, boxes and stations in plan, north up; gives the drawn points, or None."""
    scans = [scan for station in frame.stations for scan in station.scans]
    cloud = np.concatenate([np.zeros((3, 0)), *map(world_points, scans)], 1)
    places = [box.center[:2] for box in frame.boxes]
    places += [station.pose[:2] for station in frame.stations]
    if len(places) < 2:
        places += list(cloud[:2].T) or [np.zeros(2)]
    (x0, y0), (x1, y1) = square(np.reshape(places, (-1, 2)))
    ax.set(xlim=(x0, x1), ylim=(y0, y1), xlabel="x, east [m]", ylabel="y, north [m]")
    cloud = cloud[:, (cloud[0] > x0) & (cloud[0] < x1) & (cloud[1] > y0) & (cloud[1] < y1)]
    drawn = None
    if cloud.size:
        cloud = cloud[:, np.argsort(cloud[2], kind="stable")]  # the highest on top
        low, high = np.percentile(cloud[2], (1, 99))
        drawn = ax.scatter(
            cloud[0], cloud[1], c=cloud[2], s=0.35, lw=0, cmap=_HEIGHTS, vmin=low,
            vmax=max(high, low + 1.0), rasterized=True, zorder=1,
        )  # fmt: skip
    draw_footprints(ax, frame.boxes, [_color(box) for box in frame.boxes])
    for station in frame.stations:
        for image in station.images:
            draw_direction(ax, image.pose[:2], image.pose[5])
        badge(ax, station.pose[:2], name_of(station))
    return drawn


def draw_footprints(
    ax: Axes, boxes: Sequence[RoadUserBox], colors: Sequence[str], fill: str = "none", **look: Any
) -> None:
    """Draw boxes in plan, and a line from the middle of each to its front."""
    look = dict(lw=0.8, zorder=3) | look
    footprint = corners(boxes)[:, :4, :2]
    outlines = PolyCollection(list(footprint), fc=fill, ec=colors, **look)
    front, middle = footprint[:, [0, 3]].mean(1), footprint.mean(1)
    look["lw"] *= 0.75
    ahead = LineCollection(list(np.stack([middle, front], 1)), colors=colors, **look)
    for drawn in (outlines, ahead):
        ax.add_collection(drawn, autolim=False)


def draw_direction(ax: Axes, at: Float[np.ndarray, "2"], yaw: float) -> None:
    """Draw a line from a camera to where it looks, a twentieth of the plan long."""
    reach = 0.05 * np.diff(ax.get_xlim())
    ends = np.stack([at, at + reach * np.array([np.cos(yaw), np.sin(yaw)])])
    ax.plot(*ends.T, color=BADGE_COLOR, lw=0.9, zorder=5, path_effects=sheet.HALO)


def square(spots: Float[np.ndarray, "N 2"]) -> tuple[Any, Any]:
    """The lower left and the upper right corner of a plan around spots (x, y) [m]."""
    spots = spots if len(spots) else np.zeros((1, 2))
    low, high = spots.min(0), spots.max(0)
    middle, reach = (low + high) / 2, float((high - low).max()) / 2 + MARGIN
    return middle - reach, middle + reach


def camera_key() -> Line2D:
    """What a legend says of :func:`draw_direction`."""
    return Line2D([], [], color=BADGE_COLOR, lw=0.9, label="direction of a camera")


def _color(box: RoadUserBox) -> str:
    return CLASS_COLORS[KINDS.index(box.kind)]


def badge(ax: Axes, at: Any, name: str) -> None:
    """Mark a station with its name."""
    ax.annotate(
        name, tuple(at), size=6, weight="bold", color="white", ha="center", va="center",
        zorder=6, bbox=dict(boxstyle="round,pad=0.25,rounding_size=0.6", fc=BADGE_COLOR,
        ec="white", lw=0.5), annotation_clip=True,
    )  # fmt: skip


def _draw_panel(fig: Figure, panel: Axes, frame: Frame, cloud: Any, images: bool) -> None:
    y = 0.0
    if cloud is not None:
        axes = panel.inset_axes((0.02, 1 - 21 / (MAP * 72), 0.94, 7 / (MAP * 72)))
        bar = fig.colorbar(cloud, cax=axes, orientation="horizontal", extend="both")
        bar.ax.locator_params(nbins=5)
        middle = panel.get_xlim()[1] / 2
        panel.text(middle, -1, "height of a point, z [m]", ha="center", va="top")
        y = -42.0
    look: dict[str, Any] = dict(size=6.5, va="center", parse_math=False)
    most = int((MAP * 72 + y) / ROW) - 10 - len(KINDS)
    for station in frame.stations[:most]:
        y -= ROW
        badge(panel, (6, y), name_of(station))
        x = 13 + 3.2 * (len(name_of(station)) - 1)
        panel.text(x, y, **look | sheet.fit(station.name, 26, 6.5))
    more = len(frame.stations[most:])
    panel.text(0, y - ROW, f"and {counted(more, 'more station')}" if more else "", **look)
    panel.legend(handles=_keys(frame, images), loc="lower left", **sheet.KEYS)


def _keys(frame: Frame, images: bool) -> list[Any]:
    counts = {kind: sum(box.kind == kind for box in frame.boxes) for kind in KINDS}
    keys: list[Any] = [
        Patch(fc="none", ec=color, lw=0.9, label=f"{kind} ({counts[kind]})")
        for kind, color in zip(KINDS, CLASS_COLORS, strict=True)
        if counts[kind]
    ]
    if images:
        keys.append(camera_key())
    layers = [image.instance for station in frame.stations for image in station.images]
    if any(layer is not None for layer in layers):
        look: dict[str, Any] = dict(color="#606060", lw=0.9, ls=_DOTS)
        keys.append(Line2D([], [], **look, label="no pixel of it is visible"))
    return keys


def _draw_image(ax: Axes, image: Image, boxes: Sequence[RoadUserBox], words: str) -> None:
    height, width = image.rgb.shape[:2]
    lines, owner = edge_lines(image, corners(boxes), width, height)
    seen = set(range(len(boxes)))
    if image.instance is not None:
        found = set(np.unique(image.instance).tolist())
        seen = {k for k, box in enumerate(boxes) if box.track + 1 in found}
    for shown, look in ((False, dict(lw=0.5, ls=_DOTS)), (True, dict(lw=0.7))):
        own = np.array([(k in seen) == shown for k in owner], bool)
        colors = [_color(boxes[k]) for k in owner[own]]
        drawn = LineCollection(list(lines[own]), colors=colors, **look)
        if shown:
            drawn.set_path_effects(RIM)
        ax.add_collection(drawn, autolim=False)
    met = len(set(owner.tolist()) & seen)
    draw_picture(ax, image.rgb, f"{words}: {met} box{'es' * (met != 1)}")


def draw_picture(ax: Axes, rgb: Picture, words: str) -> None:
    """Draw a picture under what is drawn in its pixels, with words above it."""
    height, width = rgb.shape[:2]
    ax.imshow(rgb, extent=(0, width, height, 0))
    ax.set(xlim=(0, width), ylim=(height, 0), xticks=[], yticks=[])
    ax.set_title(words, loc="left", size=6.5, pad=2.5, parse_math=False)
