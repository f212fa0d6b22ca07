"""Lanes and walking routes on a map: their lines, and arrow heads for their direction."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.patches import Circle

from inspe_jax.scene.scene import Scene

LANE: dict[str, Any] = dict(color="#303030", lw=0.4)
WALK: dict[str, Any] = dict(color="#00543d", lw=0.7)


def draw_routes(ax: Axes, scene: Scene) -> None:
    """Draw centre lines of lanes with arrow heads, and walking routes, within the circle."""
    radius = scene.voxels.radius
    inside = Circle(tuple(scene.voxels.center[:2]), radius, transform=ax.transData)
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
