"""Lanes as strips of ground, and which of them lie on the junction's own level."""

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

from inspe_jax.scene.maps.parts import CLEARANCE

GRADE = 0.3
"""A lane that has climbed more steeply than this is on another level; Town03 has streets of 0.2."""


@dataclass(frozen=True, eq=False)
class Strip:
    """A run of one lane: middle line and both edges at stations about 1 m apart."""

    road: int
    lane: int
    junction: int
    kind: str
    center: Float[np.ndarray, "N 3"]
    left: Float[np.ndarray, "N 2"]
    right: Float[np.ndarray, "N 2"]

    @functools.cached_property
    def polygon(self) -> BaseGeometry:
        """The lane's surface; quad by quad where a tight bend folds an edge over."""
        whole = Polygon(np.concatenate([self.left, self.right[::-1]]))
        if whole.is_valid:
            return whole
        quads = np.stack([self.left[:-1], self.left[1:], self.right[1:], self.right[:-1]], 1)
        return unary_union(shapely.convex_hull(shapely.polygons(quads)))

    def runs(self, keep: np.ndarray) -> "Iterator[Strip]":
        """The unbroken runs of stations to keep, of two or more."""
        edges = np.flatnonzero(np.diff(np.concatenate([[0], keep, [0]])))
        for a, b in edges.reshape(-1, 2):
            if b - a > 1:
                part = slice(a, b)
                yield replace(
                    self, center=self.center[part], left=self.left[part], right=self.right[part]
                )


def same_level(strips: list[Strip], core: list[bool]) -> list[Strip]:
    """Leave out what lies above or beneath, station by station.

    Two stations are joined within 5 m, height counted thrice, so a deck 2 m up is apart from the
    road beneath it. Of what is joined to the core, that goes which has climbed beyond the
    steepest grade, and where two levels overlap the one farther from the core along the roads.
    What is not joined, as a street behind a verge, stays if level with the nearest that is.
    """
    if not any(core):
        return []
    points = np.concatenate([s.center for s in strips])  # (N, 3)
    sizes = [len(s.center) for s in strips]
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
    return [run for strip, mask in zip(strips, cut, strict=True) for run in strip.runs(mask)]
