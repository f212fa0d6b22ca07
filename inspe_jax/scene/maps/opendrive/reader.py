"""Reads OpenDRIVE maps with the CARLA client's ``carla.Map``, which needs no server."""

import os
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float
from shapely.geometry import LineString, Point
from shapely.geometry.base import BaseGeometry

from inspe_jax.scene.intersection import Intersection, Route
from inspe_jax.scene.lines import resampled
from inspe_jax.scene.maps.approaches import TRAVEL
from inspe_jax.scene.maps.bodies import with_bodies
from inspe_jax.scene.maps.lane_strips import LaneStrip
from inspe_jax.scene.maps.opendrive.objects import PARKING
from inspe_jax.scene.maps.opendrive.regions import approaches_of, areas_of, interior_of
from inspe_jax.scene.maps.opendrive.road_network import (
    INSET,
    heading_of,
    lane_strips_near,
    load_map,
    position,
)
from inspe_jax.scene.maps.parking import with_parked
from inspe_jax.scene.maps.parts import MARGIN, STEP, distance_from
from inspe_jax.scene.maps.road_map import Id, MapJunction, Node, RoadMap
from inspe_jax.scene.regions import Region

COARSE = 5.0
"""Spacing of the points of a map's road lines [m]."""
APRON = 25.0
"""Lanes are read this much farther than they are kept, so that no lane ends inside the rim [m]."""


class OpenDriveMap(RoadMap):
    """An OpenDRIVE file.

    Raises InspeError as :func:`~inspe_jax.scene.maps.opendrive.road_network.load_map`.
    """

    format = "(OpenDRIVE)"

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path, self.town = Path(path), load_map(path)
        self.name, self.crossings = self.path.stem, self.town.crosswalks
        self.georeference = self.town.georeference

    def road_lines(self) -> list[Float[np.ndarray, "N 2"]]:
        found = []  # the middle of a driving lane of each
        for road in self.town.roads.values():
            for start, end, lanes in road.sections:
                lane = next((name for name, kind in lanes.items() if kind == "driving"), 0)
                marks = self.town.along(road.id, lane, start, end, COARSE) if lane else []
                if len(marks) > 1:
                    found.append(np.array([position(m.transform.location)[:2] for m in marks]))
        return found

    def junctions(self) -> list[Id]:
        return sorted({road.junction for road in self.town.roads.values()} - {-1})

    def node(self, junction: Id) -> Node:
        middle, size = self.town.box(junction)
        signals = distance_from(self.town.signals, middle) < size / 2 + 15.0
        return Node(middle, size, int(signals.sum()))

    def around(
        self, members: set[Id], middle: Float[np.ndarray, "3"], radius: float
    ) -> "OpenDriveJunction":
        return OpenDriveJunction(self, members, middle, radius)


class OpenDriveJunction(MapJunction):
    """One or several junctions of an OpenDRIVE file."""

    def __init__(
        self, of: OpenDriveMap, members: set[Any], middle: Float[np.ndarray, "3"], radius: float
    ) -> None:
        self.town, self.members, self.middle, self.radius = of.town, members, middle, radius
        # Signals are at the height of their lights, or below ground.
        signals = self.town.signals
        self.poles = signals[distance_from(signals, middle) <= radius + MARGIN]
        self.approaches = approaches_of(self.town, members)

    @cached_property
    def interior(self) -> set[int]:
        """Roads inside the junction, from one member to another."""
        return interior_of(self.town, self.members)

    def lanes(self) -> tuple[list[LaneStrip], list[bool]]:
        found = lane_strips_near(self.town, self.middle, self.radius + MARGIN + APRON)
        return found, [s.junction in self.members or s.road in self.interior for s in found]

    def areas(
        self, lane_strips: list[LaneStrip], notes: list[str]
    ) -> dict[Region, list[BaseGeometry]]:
        return areas_of(self.town, lane_strips, self.members, self.interior, notes)

    def with_bodies(
        self, place: Intersection, lane_strips: list[LaneStrip], notes: list[str]
    ) -> Intersection:
        reach, shapes = self.radius + MARGIN, self.town.shapes
        notes += self.town.notes
        place = with_bodies(place, [s for s in shapes if s.kind != PARKING], reach, notes)
        lanes = [strip for strip in lane_strips if strip.kind == "parking"]
        spaces = [shape.area for shape in shapes if shape.kind == PARKING]
        return with_parked(place, lanes, spaces, reach, notes)

    def drives(self, arm_of: dict[tuple[int, str], int]) -> Iterator[Route]:
        town, approaches = self.town, self.approaches
        inside = {r.id for r in town.roads.values() if r.junction in self.members} | self.interior
        # By position, not by road, because a step may skip a road that is a stub.
        cuts = [LineString([approach.point(k) for k in approach.kerbs]) for approach in approaches]

        def leads_to(waypoint: Any) -> int:
            """The arm at whose mouth a waypoint is; −1 if it is at none."""
            away = shapely.distance(cuts, Point(position(waypoint.transform.location)[:2]))
            best = approaches[int(np.argmin(away))]
            return arm_of[best.road, best.end] if away.min() < 2 * STEP else -1

        for approach in approaches:
            at = INSET if approach.end == "start" else town.roads[approach.road].length - INSET
            for lane, kind, _, _, inbound in approach.lanes:
                if kind not in TRAVEL or not inbound:
                    continue
                mouth = town.at(approach.road, lane, at)
                upstream = self._follow(mouth, "previous")[::-1]
                for path in _lane_paths(mouth, inside):
                    entry_arm, exit_arm = arm_of[approach.road, approach.end], leads_to(path[-1])
                    if exit_arm in (entry_arm, -1):
                        continue
                    line = [*upstream, *path, *self._follow(path[-1], "next")]
                    points = resampled(np.array([position(w.transform.location) for w in line]))
                    yield Route(points, mouth.lane_width, "vehicle", (entry_arm, exit_arm))

    def _follow(self, start: Any, direction: str) -> list[Any]:
        """Waypoints from a lane on ('next') or back ('previous') to the radius, straight on."""
        line: list[Any] = []
        here = start
        for _ in range(int(4 * self.radius / STEP)):  # four radii on a winding road
            options = getattr(here, direction)(STEP)
            at = position(here.transform.location)[None]
            if not options or distance_from(at, self.middle)[0] > self.radius:
                break
            heading = heading_of(here)
            here = max(options, key=lambda w: float(heading_of(w) @ heading))
            line.append(here)
        return line


def _lane_paths(mouth: Any, inside: set[int]) -> Iterator[list[Any]]:
    """All paths of waypoints from a mouth through the junction to the first one beyond it."""
    stack = [([mouth], frozenset[tuple[int, int]]())]
    while stack:
        path, seen = stack.pop()
        here = path[-1]
        for step in here.next(STEP):
            lane = (step.road_id, step.lane_id)
            if step.road_id not in inside:
                if here.road_id in inside:
                    yield [*path, step]
                elif len(path) < 5:  # still on the approach
                    stack.append(([*path, step], seen))
            elif lane == (here.road_id, here.lane_id):
                stack.append(([*path, step], seen))
            elif lane not in seen:  # at most once round a roundabout
                stack.append(([*path, step], seen | {lane}))
