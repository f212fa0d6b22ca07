"""The lanes of a SUMO network in world coordinates: their course, their use, the lanes after."""

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
from shapely.geometry import Polygon

from inspe_jax.scene.lines import distinct, resampled
from inspe_jax.scene.maps.lane_strips import LaneStrip
from inspe_jax.scene.maps.parts import valid
from inspe_jax.scene.maps.sumo.network import RoadNet

MOTORS = {"passenger", "private", "taxi", "bus", "truck", "delivery", "hov", "evehicle"}
"""SUMO's vehicle classes that drive on a carriageway."""


def kind_of(lane: Any) -> str:
    """What a lane is for, as a word of :mod:`inspe_jax.scene.maps.approaches`.

    '' for rails and waterways.
    """
    who = set(lane.getPermissions())
    if who & MOTORS:
        return "driving"
    if "pedestrian" in who:
        return "sidewalk"
    if "bicycle" in who:
        return "biking"
    return "" if who else "shoulder"


@dataclass(frozen=True, eq=False)
class Streets:
    """A network in world coordinates: every lane as a strip, the lanes after it, and crossings.

    Lanes have the network's names. In a lane's strip ``road`` is the number of its edge, and
    ``junction`` is 1 inside any junction, else −1. ``follows`` has the lanes after each lane, with
    those inside junctions; ``leads`` has the lanes before it.
    """

    road: RoadNet
    numbers: dict[str, int]
    lane_strips: dict[str, LaneStrip]
    follows: dict[str, list[str]]
    leads: dict[str, list[str]]
    crossings: tuple[np.ndarray, ...]  # outlines, each (K, 3)
    walks: tuple[tuple[str, Polygon], ...]  # node, walking area

    def node(self, name: int | str) -> np.ndarray:
        """The position of a node (3,) [m]."""
        return self.road.to_world([self.road.net.getNode(name).getCoord3D()])[0]


@functools.lru_cache(maxsize=8)
def streets_of(road: RoadNet) -> Streets:
    """Every lane of a network."""
    lane_strips, crossings, walks = {}, [], []
    follows: dict[str, list[str]] = {}
    leads: dict[str, list[str]] = {}
    edges = road.net.getEdges(withInternal=True)
    for number, edge in enumerate(edges):
        for lane in edge.getLanes():
            line = distinct(road.to_world(lane.getShape3D()))
            if len(line) < 2:
                continue
            if edge.getFunction() == "walkingarea":
                if len(line) > 2:
                    walks.append((edge.getFromNode().getID(), valid(Polygon(line[:, :2]))))
                continue
            strip = _lane_strip(number, lane, line, edge.getFunction() != "")
            if edge.getFunction() == "crossing":
                outline = np.concatenate([strip.left, strip.right[::-1]])
                heights = np.concatenate([strip.center, strip.center[::-1]])[:, 2]
                crossings.append(np.column_stack([outline, heights]))
            elif strip.kind:
                lane_strips[lane.getID()] = strip
                follows[lane.getID()] = [
                    link.getViaLaneID() or link.getToLane().getID() for link in lane.getOutgoing()
                ]
    for lane in follows:
        follows[lane] = [other for other in follows[lane] if other in lane_strips]
        for other in follows[lane]:
            leads.setdefault(other, []).append(lane)
    numbers = {edge.getID(): number for number, edge in enumerate(edges)}
    return Streets(road, numbers, lane_strips, follows, leads, tuple(crossings), tuple(walks))


def _lane_strip(number: int, lane: Any, line: np.ndarray, inside: bool) -> LaneStrip:
    """A lane with evenly spaced stations."""
    center = resampled(line)
    ahead = np.gradient(center[:, :2], axis=0)
    ahead /= np.hypot(*ahead.T)[:, None]
    junction, width = 1 if inside else -1, lane.getWidth()
    return LaneStrip.along(number, lane.getIndex(), junction, kind_of(lane), center, ahead, width)
