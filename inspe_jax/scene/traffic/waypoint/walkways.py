"""Footpaths beside the lanes and over the arms, for an intersection whose map has none."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from inspe_jax.scene.intersection import (
    Intersection,
    Route,
    crossing_lines,
    mouth_crosswalks,
    walking_routes,
)
from inspe_jax.scene.lines import distance_from
from inspe_jax.scene.traffic.waypoint.paths import SPACING, resample

BESIDE = 1.5  # distance of a footpath's middle from the lane's edge [m]: room for two that meet
SLACK = 0.3  # footpaths come nearer to another lane's edge than BESIDE by at most this [m]
APART = 2.0  # two footpaths nearer than this are one [m]
SHORTEST = 10.0  # a footpath shorter than this beside a lane is left out [m]
CROSSING = np.cos(np.radians(45.0))  # lanes that meet at a larger angle cross; none on motorways


def with_walkways(intersection: Intersection, radius: float) -> Intersection:
    """The intersection with footpaths for traffic, if nobody walks within ``radius`` [m].

    People walk beside the lanes, on the right of the outermost, and cross each arm at its mouth.
    The regions stay those of the map. An intersection where somebody walks, or no lanes cross, as
    on a motorway, stays as it is.
    """
    away = [distance_from(route.waypoints, intersection.center) for route in intersection.routes]
    near = [r for r, far in zip(intersection.routes, away, strict=True) if (far <= radius).any()]
    lanes = [route for route in near if route.user == "vehicle"]
    if len(lanes) < len(near) or not _cross(lanes):
        return intersection
    crosswalks = [mouth_crosswalks((arm,)) for arm in intersection.arms]
    lines = [*_beside(lanes), *crossing_lines(crosswalks)]
    walks = walking_routes(intersection, lines)
    return replace(intersection, routes=(*intersection.routes, *walks))


def _cross(lanes: list[Route]) -> bool:
    """Whether two lanes meet, at one height, at more than 45°."""
    if not lanes:
        return False
    fine = [resample(lane.waypoints) for lane in lanes]
    point, heading = np.concatenate(fine), np.concatenate([_heading(line) for line in fine])
    one, two = cKDTree(point).query_pairs(1.0, output_type="ndarray").reshape(-1, 2).T
    return bool(((heading[one] * heading[two]).sum(1) < CROSSING).any())


def _beside(lanes: list[Route]) -> Iterator[np.ndarray]:
    """Lines (N, 2) to the right of lanes where no other lane is; the longest first."""
    fine = [(lane.width, resample(lane.waypoints)[:, :2]) for lane in lanes]
    trees = {
        width: cKDTree(np.concatenate([line for own, line in fine if own == width]))
        for width, _ in fine
    }
    runs: list[np.ndarray] = []
    for lane_width, line in fine:
        ahead = _heading(line)
        beside = line + (lane_width / 2 + BESIDE) * np.stack([ahead[:, 1], -ahead[:, 0]], -1)
        away = [tree.query(beside)[0] - width / 2 for width, tree in trees.items()]
        runs += _runs(beside, np.min(away, axis=0) >= BESIDE - SLACK)
    kept: list[np.ndarray] = []
    for run in sorted(runs, key=len, reverse=True):
        free = np.ones(len(run), bool)
        if kept:
            free = cKDTree(np.concatenate(kept)).query(run)[0] >= APART
        kept += _runs(run, free)
    yield from kept


def _runs(line: np.ndarray, free: np.ndarray) -> list[np.ndarray]:
    """The stretches of a line (N, 2) that are free and at least :data:`SHORTEST` long."""
    parts = np.split(np.arange(len(line)), np.flatnonzero(np.diff(free.astype(int))) + 1)
    least = SHORTEST / SPACING
    return [line[part] for part in parts if len(part) > least and free[part[0]]]


def _heading(line: np.ndarray) -> np.ndarray:
    """Unit direction (N, 2) at each point of a line."""
    along = np.gradient(line[:, :2], axis=0)
    return along / np.maximum(np.hypot(*along.T), 1e-9)[:, None]
