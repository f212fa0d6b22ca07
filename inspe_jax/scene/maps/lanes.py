"""Lanes of maps: the ends of roads at a junction, and strips of ground on one level."""

import functools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import scipy
import shapely
from jaxtyping import Float
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from inspe_jax.scene.intersection import CLEARANCE, Arm

# Kinds of lane, in OpenDRIVE's words.
TRAVEL = {"driving", "entry", "exit", "onRamp", "offRamp", "connectingRamp", "bus", "taxi", "HOV"}
TRAVEL |= {"mwyEntry", "mwyExit", "shared", "slipLane"}
CARRIAGEWAY = TRAVEL | {"bidirectional", "parking", "biking", "stop", "restricted", "roadWorks"}
SHOULDER = {"shoulder", "border", "curb"}
SIDEWALK = {"sidewalk", "walking"}


@dataclass(frozen=True, eq=False)
class Approach:
    """The end of a road at a junction: a cut with offsets to the left, looking away [m]."""

    road: int | str
    end: str  # 'start' or 'end' of the road
    origin: Float[np.ndarray, "2"]
    outward: float  # heading away from the junction at the cut
    bearing: float  # the same over the first 15 m, which a flare does not turn
    lanes: tuple[tuple[int, str, float, float, bool], ...]  # id, type, from, to, inbound

    @classmethod
    def across(
        cls, road: int | str, end: str, origin: np.ndarray, forward: np.ndarray, bearing: float,
        lanes: Iterable[tuple[int, str, np.ndarray, float, bool]],
    ) -> "Approach":  # fmt: skip
        """A cut across a road at ``origin``, looking along the unit vector ``forward``, from its
        ``lanes``: id, type, middle (2,) [m], width [m] and inbound."""
        left = np.array([-forward[1], forward[0]])
        cut = []
        for lane, kind, middle, width, inbound in lanes:
            offset = float((middle - origin) @ left)
            cut.append((lane, kind, offset - width / 2, offset + width / 2, inbound))
        return cls(road, end, origin, heading(forward), bearing, tuple(cut))

    def point(self, offset: float) -> np.ndarray:
        """The point of the cut at an offset to the left (2,)."""
        return self.origin + offset * np.array([-np.sin(self.outward), np.cos(self.outward)])

    @property
    def kerbs(self) -> tuple[float, float]:
        """Offsets of the carriageway's right and left edge."""
        lanes = [lane for lane in self.lanes if lane[1] in CARRIAGEWAY]
        return min(lane[2] for lane in lanes), max(lane[3] for lane in lanes)

    @property
    def edges(self) -> tuple[float, float]:
        """Offsets of the whole road's right and left edge."""
        return min(lane[2] for lane in self.lanes), max(lane[3] for lane in self.lanes)

    @property
    def one_way(self) -> int:
        """+1 if all lanes lead in, −1 if all lead out, 0 otherwise."""
        ways = {lane[4] for lane in self.lanes if lane[1] in TRAVEL}
        return {frozenset([True]): 1, frozenset([False]): -1}.get(frozenset(ways), 0)

    def lane_range(self, kinds: set[str], side: int) -> tuple[float, float] | None:
        """Inner and outer offset of some lanes beyond the left (+1) or right (−1) kerb, if any."""
        kerb = self.kerbs[1] if side > 0 else self.kerbs[0]
        beyond = [x for x in self.lanes if x[1] in kinds and side * ((x[2] + x[3]) / 2 - kerb) > 0]
        if not beyond:
            return None
        low, high = min(x[2] for x in beyond), max(x[3] for x in beyond)
        return (low, high) if side > 0 else (high, low)


def heading(vector: np.ndarray) -> float:
    """The heading of a vector (2,) [rad]."""
    return float(np.arctan2(vector[1], vector[0]))


def arms_of(approaches: list[Approach]) -> tuple[tuple[Arm, ...], dict[tuple[int | str, str], int]]:
    """The arms of a junction, counter-clockwise by bearing, and the arm of each (road, end). Each
    approach is an arm; two by which a divided road leads in and out are one."""
    groups = [[approach] for approach in approaches]
    for i, approach in enumerate(approaches):
        partners = [
            other
            for other in approaches[i + 1 :]
            if approach.one_way * other.one_way == -1
            and np.cos(approach.bearing - other.bearing) > np.cos(np.radians(40))
            and _gap(approach, other) <= 20.0
        ]
        free = [p for p in partners if [p] in groups and [approach] in groups]
        if free:
            partner = min(free, key=lambda other: _gap(approach, other))
            groups.remove([approach])
            groups[groups.index([partner])].append(approach)
    made = sorted(((_arm(g), g) for g in groups), key=lambda x: x[0].bearing)
    arm_of = {(approach.road, approach.end): i for i, (_, g) in enumerate(made) for approach in g}
    return tuple(arm for arm, _ in made), arm_of


def _gap(a: Approach, b: Approach) -> float:
    """Distance between the nearest kerbs of two approaches [m]."""
    return min(float(np.hypot(*(a.point(s) - b.point(t)))) for s in a.kerbs for t in b.kerbs)


def _arm(group: list[Approach]) -> Arm:
    along = np.sum([[np.cos(g.bearing), np.sin(g.bearing)] for g in group], axis=0)
    bearing = heading(along)
    axes = Arm((0.0, 0.0), bearing, 0.0).axes
    kerbs = np.array([axes @ g.point(k) for g in group for k in g.kerbs])  # (2 or 4, 2)
    low, high = kerbs[:, 1].min(), kerbs[:, 1].max()
    x, y = np.array([kerbs[:, 0].mean(), (low + high) / 2]) @ axes
    return Arm((float(x), float(y)), bearing, float(high - low))


GRADE = 0.3  # a lane that climbs more steeply is on another level; Town03 has streets of 0.2
LEVEL = 1e-3  # an edge whose height differs less from the middle's adds nothing [m]


@dataclass(frozen=True, eq=False)
class LaneStrip:
    """A stretch of one lane, of a ``kind`` above: its middle line and both edges, at stations about
    1 m apart [m]. ``junction`` is −1 outside junctions."""

    road: int | str
    junction: int | str
    kind: str
    center: Float[np.ndarray, "N 3"]
    left: Float[np.ndarray, "N 3"]
    right: Float[np.ndarray, "N 3"]

    @classmethod
    def along(
        cls, road: int | str, junction: int | str, kind: str, center: Float[np.ndarray, "N 3"],
        ahead: Float[np.ndarray, "N 2"], width: float,
    ) -> "LaneStrip":  # fmt: skip
        """A strip of a width [m] along a middle line with unit headings ``ahead``."""
        across = np.column_stack([-ahead[:, 1], ahead[:, 0], 0 * ahead[:, 0]]) * width / 2
        return cls(road, junction, kind, center, center + across, center - across)

    @property
    def ground(self) -> Float[np.ndarray, "G 3"]:
        """Points of its surface [m]: of the middle line, and of the edges where it tilts."""
        edges = np.stack([self.left, self.right])
        tilted = abs(edges - self.center)[..., 2] > LEVEL
        return np.concatenate([self.center, edges[tilted]])

    @functools.cached_property
    def polygon(self) -> BaseGeometry:
        """The lane's surface. Where a tight bend folds an edge over, it is joined from quads."""
        left, right = self.left[:, :2], self.right[:, :2]
        whole = Polygon(np.concatenate([left, right[::-1]]))
        if whole.is_valid:
            return whole
        quads = np.stack([left[:-1], left[1:], right[1:], right[:-1]], 1)
        return unary_union(shapely.convex_hull(shapely.polygons(quads)))

    def runs(self, keep: np.ndarray) -> "Iterator[LaneStrip]":
        """The unbroken runs of two or more stations where ``keep`` (N,) is true."""
        edges = np.flatnonzero(np.diff(np.concatenate([[0], keep, [0]])))
        for a, b in edges.reshape(-1, 2):
            if b - a > 1:
                center, left, right = (x[a:b] for x in (self.center, self.left, self.right))
                yield replace(self, center=center, left=left, right=right)


def same_level(lane_strips: list[LaneStrip], core: list[bool]) -> list[LaneStrip]:
    """The parts of lanes that lie on the same level as the core lanes, station by station.

    Stations within 5 m, where height counts three times, are connected. One connected to the core
    is left out if the steepest grade does not lead there. Where two levels overlap, the one farther
    from the core along the roads is left out. One that is not connected, as on a street behind a
    verge, stays if it is level with the nearest that stays.
    """
    if not any(core):
        return []
    points = np.concatenate([s.center for s in lane_strips])  # (N, 3)
    sizes = [len(s.center) for s in lane_strips]
    is_core = np.repeat(core, sizes)
    pairs = scipy.spatial.cKDTree(points * [1, 1, 3]).query_pairs(5.0, output_type="ndarray")
    graph = scipy.sparse.csr_array((np.ones(len(pairs)), pairs.T), shape=(len(points),) * 2)
    seeds = np.flatnonzero(is_core)
    how = dict(directed=False, unweighted=True, indices=seeds, min_only=True)
    hops = scipy.sparse.csgraph.dijkstra(graph, **how)

    def rise_from(some: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        away, index = scipy.spatial.cKDTree(points[some, :2]).query(points[:, :2])
        return np.abs(points[:, 2] - points[some][index, 2]), away

    rise, away = rise_from(is_core)
    joined = np.isfinite(hops)
    keep = joined & (rise <= 1.5 + GRADE * away)
    if np.ptp(points[:, 2]) > CLEARANCE:
        near = scipy.spatial.cKDTree(points[:, :2]).query_pairs(6.0, output_type="ndarray")
        near = near[np.abs(points[near[:, 0], 2] - points[near[:, 1], 2]) > CLEARANCE]
        near = near[joined[near].all(1)]
        farther = np.where(hops[near[:, 0]] > hops[near[:, 1]], near[:, 0], near[:, 1])
        keep[farther] = False
    rise, _ = rise_from(keep)
    keep |= ~joined & (rise <= 2.0)
    cut = np.split(keep, np.cumsum(sizes)[:-1])
    return [run for strip, mask in zip(lane_strips, cut, strict=True) for run in strip.runs(mask)]
