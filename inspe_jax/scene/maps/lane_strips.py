"""Lanes as strips of ground, and which of them lie on the same level as the junction."""

import functools
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import shapely
from jaxtyping import Float
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from inspe_jax.scene.intersection import CLEARANCE

GRADE = 0.3
"""A lane that climbs more steeply than this is on another level. Town03 has streets of 0.2."""


@dataclass(frozen=True, eq=False)
class LaneStrip:
    """A stretch of one lane: its middle line and both edges, at stations about 1 m apart [m].

    ``junction`` is −1 outside junctions; ``kind`` is a word of
    :mod:`inspe_jax.scene.maps.approaches`.
    """

    road: int
    lane: int
    junction: int
    kind: str
    center: Float[np.ndarray, "N 3"]
    left: Float[np.ndarray, "N 2"]
    right: Float[np.ndarray, "N 2"]

    @classmethod
    def along(
        cls, road: int, lane: int, junction: int, kind: str, center: Float[np.ndarray, "N 3"],
        ahead: Float[np.ndarray, "N 2"], width: Float[np.ndarray, " N"] | float,
    ) -> "LaneStrip":  # fmt: skip
        """A strip of a width [m] along a middle line with unit headings ``ahead``."""
        half = np.broadcast_to(width, len(center))[:, None] / 2
        across = np.column_stack([-ahead[:, 1], ahead[:, 0]]) * half
        left, right = center[:, :2] + across, center[:, :2] - across
        return cls(road, lane, junction, kind, center, left, right)

    @functools.cached_property
    def polygon(self) -> BaseGeometry:
        """The lane's surface. Where a tight bend folds an edge over, it is joined from quads."""
        whole = Polygon(np.concatenate([self.left, self.right[::-1]]))
        if whole.is_valid:
            return whole
        quads = np.stack([self.left[:-1], self.left[1:], self.right[1:], self.right[:-1]], 1)
        return unary_union(shapely.convex_hull(shapely.polygons(quads)))

    def runs(self, keep: np.ndarray) -> "Iterator[LaneStrip]":
        """The unbroken runs of two or more stations where ``keep`` (N,) is true."""
        edges = np.flatnonzero(np.diff(np.concatenate([[0], keep, [0]])))
        for a, b in edges.reshape(-1, 2):
            if b - a > 1:
                part = slice(a, b)
                yield replace(
                    self, center=self.center[part], left=self.left[part], right=self.right[part]
                )


def same_level(lane_strips: list[LaneStrip], core: list[bool]) -> list[LaneStrip]:
    """The parts of lanes that lie on the same level as the core lanes, station by station.

    Two stations are connected if they are within 5 m. Height counts three times, so a deck 2 m up
    is not connected to the road beneath it. A station that is connected to the core is left out
    if it is higher or lower than the steepest grade allows. Where two levels overlap, the one
    farther from the core along the roads is left out. A station that is not connected, as on a
    street behind a verge, stays if it is level with the nearest one that stays.
    """
    if not any(core):
        return []
    points = np.concatenate([s.center for s in lane_strips])  # (N, 3)
    sizes = [len(s.center) for s in lane_strips]
    is_core = np.repeat(core, sizes)
    pairs = cKDTree(points * [1, 1, 3]).query_pairs(5.0, output_type="ndarray")
    graph = csr_array((np.ones(len(pairs)), pairs.T), shape=(len(points),) * 2)
    seeds = np.flatnonzero(is_core)
    hops = dijkstra(graph, directed=False, unweighted=True, indices=seeds, min_only=True)

    def rise_from(some: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        away, index = cKDTree(points[some, :2]).query(points[:, :2])
        return np.abs(points[:, 2] - points[some][index, 2]), away

    rise, away = rise_from(is_core)
    joined = np.isfinite(hops)
    keep = joined & (rise <= 1.5 + GRADE * away)
    if np.ptp(points[:, 2]) > CLEARANCE:
        near = cKDTree(points[:, :2]).query_pairs(6.0, output_type="ndarray")
        near = near[np.abs(points[near[:, 0], 2] - points[near[:, 1], 2]) > CLEARANCE]
        near = near[joined[near].all(1)]
        farther = np.where(hops[near[:, 0]] > hops[near[:, 1]], near[:, 0], near[:, 1])
        keep[farther] = False
    rise, _ = rise_from(keep)
    keep |= ~joined & (rise <= 2.0)
    cut = np.split(keep, np.cumsum(sizes)[:-1])
    return [run for strip, mask in zip(lane_strips, cut, strict=True) for run in strip.runs(mask)]
