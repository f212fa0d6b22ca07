"""Travel paths through a region of interest on a SUMO network, for vehicles and people on foot."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from inspe_jax.scene.lines import arc_of, distance_from
from inspe_jax.scene.maps.sumo.reader import SumoMap
from inspe_jax.scene.traffic.frames import CLASSES

LEAD_IN = 60.0  # vehicles enter this much beyond the radius [m], or where their road begins
TOUCH = 15.0  # a road that comes so near to the region leads into it: junctions are as wide [m]
FOOT_LEAD_IN = 15.0  # people on foot enter this much beyond the radius [m]
V_CLASS = {"car": "passenger", "truck": "truck", "cyclist": "bicycle", "pedestrian": "pedestrian"}
"""SUMO's vehicle class of each road-user class."""


@dataclass(frozen=True)
class TravelPath:
    """A path through the region by its ``edges``, from ``begin`` on the first to ``end`` on the
    last [m]; ``weight`` is its share of the arrivals."""

    edges: tuple[str, ...]
    begin: float
    end: float
    weight: float


def paths_through(
    streets: SumoMap, center: np.ndarray, radius: float
) -> dict[str, list[TravelPath]]:
    """The travel paths of each road-user class through the region of interest."""
    drives = [kind for kind in CLASSES if kind != "pedestrian"]
    found = {kind: _drives(streets, V_CLASS[kind], center, radius) for kind in drives}
    return found | {"pedestrian": _walks(streets, center, radius)}


@dataclass(frozen=True)
class _Edge:
    name: str
    line: Float[np.ndarray, "N 2"]  # its middle [m]
    arc: Float[np.ndarray, " N"]  # length to each point [m]
    away: Float[np.ndarray, " N"]  # distance of each point from the centre [m]
    lanes: int  # that the class may use
    edge: Any


def _edges(streets: SumoMap, v_class: str, center: np.ndarray, reach: float) -> list[_Edge]:
    """The edges within reach that a class may use, in the network's order."""
    found = []
    for edge in streets.net.getEdges(withInternal=False):
        lanes = [lane for lane in edge.getLanes() if lane.allows(v_class)]
        if v_class == "pedestrian":  # beside the road, not on it
            lanes = [lane for lane in lanes if not lane.allows("passenger")]
        names = [lane.getID() for lane in lanes if lane.getID() in streets.lane_strips]
        if not names:
            continue
        line = streets.lane_strips[names[0]].center[:, :2]
        away, arc = distance_from(line, center), arc_of(line)
        if away.min() <= reach:
            arc = arc * edge.getLength() / arc[-1]
            found.append(_Edge(edge.getID(), line, arc, away, len(lanes), edge))
    return found


def _drives(streets: SumoMap, v_class: str, center: np.ndarray, radius: float) -> list[TravelPath]:
    """The shortest path from every road that leads into the region to every road that leads out."""
    edges = _edges(streets, v_class, center, radius + LEAD_IN)
    index = {e.name: k for k, e in enumerate(edges)}
    links = [
        (k, index[after.getID()])
        for k, e in enumerate(edges)
        for after in e.edge.getAllowedOutgoing(v_class)
        if after.getID() in index
    ]
    near = {k: e.away for k, e in enumerate(edges) if e.away.min() <= radius + TOUCH}
    entries = [k for k, away in near.items() if away[0] > max(radius, away[-1])]
    exits = [k for k, away in near.items() if away[-1] > max(radius, away[0])]
    inner = [(a, b) for a, b in links if a in near and b in near and b not in entries]
    inner = [(a, b) for a, b in inner if a not in exits]  # once out, nobody comes in again
    one, two = np.array(inner, int).reshape(-1, 2).T
    length = np.array([e.edge.getLength() for e in edges]) + 1e-3
    graph = csr_array((length[two], (one, two)), shape=(len(edges),) * 2)
    found = []
    for entry in entries:
        away, before = dijkstra(graph, indices=entry, return_predecessors=True)
        paths = [_path(before, k) for k in exits if k != entry and np.isfinite(away[k])]
        paths = [p for p in paths if min(edges[k].away.min() for k in p) <= radius]
        # Back to the road it came from only if there is no other; straight on is likelier.
        onward = [p for p in paths if not _returns(edges[entry], edges[p[-1]])] or paths
        first = _upstream(edges, links, entry)  # queues have room
        begin = _arc_at(edges[first[0]], radius + LEAD_IN, first=True)
        straight = [1 + 2 * max(_alike(edges[entry], edges[p[-1]]), 0.0) for p in onward]
        for path, weight in zip(onward, straight, strict=True):
            names = [edges[k].name for k in (*first, *path[1:])]
            end = _arc_at(edges[path[-1]], radius + LEAD_IN, first=False)
            share = edges[entry].lanes * weight / sum(straight)
            found.append(TravelPath(tuple(names), begin, end, share))
    return found


def _upstream(edges: list[_Edge], links: list[tuple[int, int]], entry: int) -> list[int]:
    """The edges that lead straight to an entry, for :data:`LEAD_IN` metres, and the entry."""
    found, far = [entry], float(edges[entry].away[0])
    while far < edges[entry].away.min() + LEAD_IN:
        here = edges[found[0]]
        before = [a for a, b in links if b == found[0] and a not in found]
        before = [a for a in before if not _returns(edges[a], here) and edges[a].away[0] > far]
        if not before:
            break
        found.insert(0, max(before, key=lambda a: _alike(edges[a], here)))
        far = float(edges[found[0]].away[0])
    return found


def _arc_at(edge: _Edge, reach: float, *, first: bool) -> float:
    """The first or last arc length of an edge within reach [m]; that of its end if none is."""
    inside = edge.arc[edge.away <= reach] if (edge.away <= reach).any() else edge.arc[::-1]
    return float(inside[0 if first else -1])


def _returns(one: _Edge, two: _Edge) -> bool:
    """Whether edge ``two`` leads back along edge ``one``."""
    beside = np.hypot(*(one.line[0] - two.line[-1])) < 20.0 and _alike(one, two) < -0.9
    there = one.edge.getToNode() is two.edge.getFromNode() or bool(beside)
    return there and one.edge.getFromNode() is two.edge.getToNode()


def _alike(one: _Edge, two: _Edge) -> float:
    a, b = one.line[1] - one.line[0], two.line[-1] - two.line[-2]
    return float(a @ b / np.hypot(*a) / np.hypot(*b))


def _path(before: np.ndarray, sink: int) -> list[int]:
    path = [sink]
    while before[path[-1]] >= 0:
        path.append(int(before[path[-1]]))
    return path[::-1]


def _walks(streets: SumoMap, center: np.ndarray, radius: float) -> list[TravelPath]:
    """Paths on foot from the rim of the region to the rim elsewhere; SUMO routes them."""
    edges = _edges(streets, "pedestrian", center, radius + FOOT_LEAD_IN)
    ends = []  # (edge, arc, point) where a sidewalk leaves the region
    for e in edges:
        rim = np.flatnonzero((e.away[:-1] <= radius) != (e.away[1:] <= radius))
        ends += [(e.name, float(e.arc[k]), e.line[k]) for k in rim]
    if len(ends) < 2:
        ends = [(e.name, float(e.arc[len(e.arc) // 2]), e.line[len(e.line) // 2]) for e in edges]
    return [
        TravelPath((a, b), begin, end, 1.0)
        for a, begin, here in ends
        for b, end, there in ends
        if a != b and np.hypot(*(here - there)) > 0.5 * radius
    ]
