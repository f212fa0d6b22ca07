"""What stands and leads through a place, on maps: static bodies, lanes and walking routes."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.patches import Circle, Patch
from shapely.geometry import Point

from inspe_jax.scene.scene import Scene
from inspe_jax.scene.statics import KINDS, StaticBody

BODY_COLORS: dict[str, str] = dict.fromkeys(KINDS, "#9b938a") | {
    "hedge": "#3f7d4b",
    "tree": "#3f7d4b",
    "parked vehicle": "#c9c9c9",
}
"""Colours of bodies, by kind: greys of stone and of sheet metal, and the green of leaves."""
_EDGE = 0.4  # width of outlines [pt]
LANE: dict[str, Any] = dict(color="#303030", lw=0.4)
WALK: dict[str, Any] = dict(color="#00543d", lw=0.7)


def look_of(kind: str) -> dict[str, Any]:
    """How a kind looks on a map: filled; a tree, beneath which the ground is seen, as outline."""
    color = BODY_COLORS[kind]
    if kind == "tree":
        return dict(fc="none", ec=color, lw=2 * _EDGE)
    return dict(fc=color, ec="black", lw=_EDGE)


def draw_bodies(ax: Axes, scene: Scene) -> None:
    """Draw the outlines of a scene's bodies within the circle, filled where they stand on the
    ground: beneath others one sees it."""
    inside = _circle(ax, scene)
    for kind, bodies in _by_kind(scene):
        look = look_of(kind)
        color = look.pop("fc")
        fill = [color if one.base == 0 else "none" for one in bodies]
        drawn = PolyCollection([one.outline for one in bodies], fc=fill, **look, zorder=3.5)
        ax.add_collection(drawn, autolim=False)
        drawn.set_clip_path(inside)


def body_keys(scene: Scene) -> list[Any]:
    """Legend entries of the kinds that stand in the circle, kinds of one look in one entry."""
    words: dict[str, list[str]] = {}
    for kind, bodies in _by_kind(scene):
        outlines = np.array([one.polygon for one in bodies], object)
        if shapely.distance(outlines, Point(scene.voxels.center[:2])).min() <= scene.voxels.radius:
            words.setdefault(str(look_of(kind)), []).append(kind)
    return [Patch(**look_of(kinds[0]), label=", ".join(kinds)) for kinds in words.values()]


def _by_kind(scene: Scene) -> Iterator[tuple[str, list[StaticBody]]]:
    for kind in KINDS:
        if bodies := [one for one in scene.statics if one.kind == kind]:
            yield kind, bodies


def _circle(ax: Axes, scene: Scene) -> Circle:
    return Circle(tuple(scene.voxels.center[:2]), scene.voxels.radius, transform=ax.transData)


def draw_routes(ax: Axes, scene: Scene) -> None:
    """Draw centre lines of lanes with arrow heads, and walking routes, within the circle."""
    radius, inside = scene.voxels.radius, _circle(ax, scene)
    for user, look in (("vehicle", LANE), ("pedestrian", WALK)):
        lines = [r.waypoints[:, :2] for r in scene.intersection.routes if r.user == user]
        drawn = LineCollection(lines, **look, zorder=3)
        ax.add_collection(drawn, autolim=False)
        drawn.set_clip_path(inside)
    shape = radius * np.array([[0.012, 0.0], [-0.012, 0.008], [-0.012, -0.008]])
    heads = [at + shape @ np.array([d, [-d[1], d[0]]]) for at, d in arrow_heads(scene)]
    ax.add_collection(PolyCollection(heads, fc="#303030", ec="none", zorder=3), autolim=False)


def arrow_heads(scene: Scene) -> list[tuple[np.ndarray, np.ndarray]]:
    """(x, y) [m] and direction of the arrow heads on lanes. Several routes can run on one lane; one
    arrow head stands for all of them."""
    radius, middle = scene.voxels.radius, scene.voxels.center[:2]
    heads = list[tuple[np.ndarray, np.ndarray]]()
    for route in scene.intersection.routes:
        if route.user != "vehicle":
            continue
        steps = np.diff(route.waypoints[:, :2], axis=0)
        for s in np.arange(radius / 8, route.length, radius / 4):
            k = int(np.searchsorted(route.arc, s)) - 1
            at, ahead = route.waypoints[k, :2], steps[k] / np.hypot(*steps[k])
            apart = (at - np.array([head for head, _ in heads]).reshape(-1, 2)) / radius  # (H, 2)
            along, aside = np.abs(apart @ ahead), np.abs(apart @ [-ahead[1], ahead[0]])
            crowded = (along < 0.12) & (aside < 0.02) | (np.hypot(along, aside) < 0.035)
            if not crowded.any() and np.hypot(*(at - middle)) < 0.97 * radius:
                heads.append((at, ahead))
    return heads
