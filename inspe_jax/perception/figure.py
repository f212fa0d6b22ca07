"""A figure of detections beside ground truth: in plan over the points, and on the pictures."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from inspe_jax.core.errors import InspeError
from inspe_jax.core.sheet import CLASS_COLORS, KEYS, heading, house_style
from inspe_jax.core.words import counted
from inspe_jax.dataset import frame_figure
from inspe_jax.dataset.loading.batch import Batch, Cameras
from inspe_jax.perception.evaluation import USUAL_DISTANCE, Detections, check, matched, truth_of
from inspe_jax.simulation.frame import KINDS, Image, RoadUserBox
from inspe_jax.simulation.projection import corners, edge_lines

TRUTH_COLOR, MISSED_COLOR = "#808080", "#f0e442"
"""A grey, and Okabe and Ito's yellow, which no class has."""

_FILL, _POINT = "#dcdcdc", "#cfcfcf"
_COLUMNS = (62, 91, 117)  # right edges in the panel [pt]
_DASHES: Any = (0, (2.5, 1.2))
_DISC: dict[str, Any] = dict(ls="", marker="o", ms=10, mfc=MISSED_COLOR, mew=0, alpha=0.6)
_CROSS: dict[str, Any] = dict(marker="x", ms=4.5, mec="black", mew=0.9)
_SCORE_HALO = [patheffects.withStroke(linewidth=1.2, foreground="white")]


class _Compared(NamedTuple):
    """Truth and detections, and which of them have no counterpart."""

    truth: Detections
    found: Detections
    missed: Bool[np.ndarray, " M"]
    false: Bool[np.ndarray, " N"]


class _Group(NamedTuple):
    """Boxes that are drawn alike; ``line`` is their colour on pictures, if not as in plan."""

    boxes: list[RoadUserBox]
    colors: list[str]
    in_plan: dict[str, Any]
    on_pictures: dict[str, Any]
    line: str | None = None


def draw(
    batch: Batch, b: int, detections: Detections, title: str, *, least_score: float = 0.0
) -> Figure:
    """A figure of frame b of a batch: points and boxes in plan, and every picture with the boxes.

    Truth is grey, white on pictures; detections have their class's colour. Road users that no
    detection takes at 2 m are missed, in yellow; detections that take none are false, and dashed.
    Scores below ``least_score`` are left out. Raises InspeError if b is padding, or a detection is
    not valid.
    """
    if not batch.valid[b]:
        raise InspeError(f"frame {b} of the batch is padding: use one that is valid")
    check(detections, "detections")
    found = Detections(*(np.asarray(p)[detections.score >= least_score] for p in detections))
    truth = truth_of(batch.targets, b)
    taken = matched(found, truth)
    missed = ~np.isin(np.arange(len(truth.kind)), taken)
    compared = _Compared(truth, found, missed, taken < 0)
    groups = _groups(compared)
    cameras = batch.cameras
    there = [] if cameras is None else np.flatnonzero(cameras.present[b]).tolist()
    shapes = [] if cameras is None else [cameras.pixels.shape[2:4]] * len(there)
    with house_style():
        fig, ax, panel, places = frame_figure.sheet_of_pictures(shapes)
        facts = _facts(compared, len(detections.kind), least_score)
        heading(fig, title, facts, linespacing=1.35)
        _draw_plan(ax, batch, b, compared, groups)
        points = batch.lidars is not None and batch.lidars.points is not None
        _draw_panel(panel, compared, bool(there), points)
        if cameras is not None:
            for place, c in zip(places, there, strict=True):
                _draw_image(place, cameras, b, c, groups)
    return fig


def _groups(compared: _Compared) -> list[_Group]:
    """Road users that are found and missed, then detections that are right and false."""
    users, boxes, groups = _boxes(compared.truth), _boxes(compared.found), []
    for missed, fill, line in ((False, _FILL, "white"), (True, MISSED_COLOR, MISSED_COLOR)):
        own = [users[n] for n in np.flatnonzero(compared.missed == missed)]
        look = dict(fill=fill, lw=0.5, zorder=3)
        groups.append(_Group(own, [TRUTH_COLOR] * len(own), look, dict(lw=0.8), line))
    for false, style in ((False, "-"), (True, _DASHES)):
        own = [boxes[n] for n in np.flatnonzero(compared.false == false)]
        colors = [CLASS_COLORS[KINDS.index(box.kind)] for box in own]
        look = dict(lw=0.7, ls=style, path_effects=frame_figure.RIM)
        groups.append(_Group(own, colors, dict(ls=style, zorder=4), look))
    return groups


def _boxes(of: Detections) -> list[RoadUserBox]:
    return [
        RoadUserBox(k, KINDS[kind], "", x[:3], float(x[6]), x[3:6], np.array([*x[7:], 0.0]))
        for k, (x, kind) in enumerate(zip(of.boxes.astype(float), of.kind, strict=True))
    ]


def _facts(compared: _Compared, given: int, least_score: float) -> str:
    users, boxes = len(compared.missed), len(compared.false)
    words = f"{counted(users, 'road user')}; {counted(boxes, 'detection')}"
    if least_score > 0:
        words += f" with a score of {least_score:g} or more, and {given - boxes:,} below, not drawn"
    missed, false = int(compared.missed.sum()), int(compared.false.sum())
    return (
        f"{words}\nwithin {USUAL_DISTANCE:g} m: {users - missed:,} found, {missed:,} missed, "
        f"{counted(false, 'false detection')}"
    )


def _draw_plan(ax: Axes, batch: Batch, b: int, compared: _Compared, groups: list[_Group]) -> None:
    sensors = [each for each in (batch.lidars, batch.cameras) if each is not None]
    places = [each.pose[b, each.present[b], :2, 3] for each in sensors]
    spots = np.concatenate([compared.truth.boxes[:, :2], compared.found.boxes[:, :2], *places])
    (x0, y0), (x1, y1) = frame_figure.square(spots)
    ax.set(xlim=(x0, x1), ylim=(y0, y1), xlabel="x [m]", ylabel="y [m]")
    lidars = batch.lidars
    if lidars is not None and lidars.points is not None and lidars.mask is not None:
        x, y = lidars.points[b, lidars.mask[b], :2].T
        near = (x > x0) & (x < x1) & (y > y0) & (y < y1)
        ax.scatter(x[near], y[near], c=_POINT, s=0.3, lw=0, rasterized=True, zorder=1)
    ax.plot(*compared.truth.boxes[compared.missed, :2].T, **_DISC, zorder=2)
    for group in groups:
        frame_figure.draw_footprints(ax, group.boxes, group.colors, **group.in_plan)
    ax.plot(*compared.found.boxes[compared.false, :2].T, ls="", **_CROSS, zorder=5)
    for box, score in zip(_boxes(compared.found), compared.found.score, strict=True):
        ax.annotate(
            f"{score:.2f}".removeprefix("0"), (corners([box])[..., 0].max(), box.center[1]),
            xytext=(1, 0), textcoords="offset points", size=4.5, va="center", zorder=5,
            color=CLASS_COLORS[KINDS.index(box.kind)], path_effects=_SCORE_HALO,
            annotation_clip=True,
        )  # fmt: skip
    if batch.cameras is not None:
        for pose in batch.cameras.pose[b, batch.cameras.present[b]]:
            frame_figure.draw_direction(ax, pose[:2, 3], float(np.arctan2(pose[1, 0], pose[0, 0])))
    units = np.concatenate([each.unit[b, each.present[b]] for each in sensors])
    for unit in np.unique(units):
        frame_figure.badge(ax, np.concatenate(places)[units == unit].mean(0), str(unit))


def _draw_panel(panel: Axes, compared: _Compared, cameras: bool, points: bool) -> None:
    look: dict[str, Any] = dict(size=6.5, va="center", parse_math=False)
    for x, word in zip(_COLUMNS, ("found", "missed", "false"), strict=True):
        panel.text(x, -frame_figure.ROW / 2, word, ha="right", **look)
    for k, kind in enumerate(KINDS):
        y = -frame_figure.ROW * (k + 1.5)
        panel.text(0, y, kind, color=CLASS_COLORS[k], weight="bold", **look)
        missed = compared.missed[compared.truth.kind == k]
        counts = (~missed).sum(), missed.sum(), compared.false[compared.found.kind == k].sum()
        for x, count in zip(_COLUMNS, counts, strict=True):
            panel.text(x, y, f"{count:,}", ha="right", **look)
    wrong: dict[str, Any] = dict(color="black", lw=0.8, ls=_DASHES, **_CROSS)
    truth = "ground truth (white below)" if cameras else "ground truth"
    keys: list[Any] = [
        Patch(fc=_FILL, ec=TRUTH_COLOR, lw=0.5, label=truth),
        Patch(fc="none", ec=CLASS_COLORS[0], lw=0.8, label="detection, and its score"),
        Line2D([], [], **_DISC, label=f"missed: none within {USUAL_DISTANCE:g} m"),
        Line2D([], [], **wrong, label="false detection"),
    ]
    if points:
        keys.append(Line2D([], [], ls="", marker=".", ms=3, c=_POINT, label="LiDAR point"))
    if cameras:
        keys.append(frame_figure.camera_key())
    panel.legend(handles=keys, loc="lower left", **KEYS)


def _draw_image(ax: Axes, cameras: Cameras, b: int, c: int, groups: list[_Group]) -> None:
    pixels = cameras.pixels[b, c]
    height, width = pixels.shape[:2]
    pose = cameras.pose[b, c].astype(float)
    image = Image(np.zeros(6), cameras.intrinsic[b, c].astype(float), pixels)  # of its own frame
    shown = 0
    for group in groups:
        there = (corners(group.boxes) - pose[:3, 3]) @ pose[:3, :3]
        lines, owner = edge_lines(image, there, width, height)
        colors = group.line or [group.colors[k] for k in owner]
        drawn = LineCollection(list(lines), colors=colors, **group.on_pictures)
        ax.add_collection(drawn, autolim=False)
        shown += 0 if group.line else len(np.unique(owner))
    number = int((cameras.unit[b, :c] == cameras.unit[b, c]).sum())
    words = f"unit {cameras.unit[b, c]}, camera {number}"
    frame_figure.draw_picture(ax, pixels, f"{words}: {counted(shown, 'detection')}")
