"""A map of roads: what each format reads of it, and the place that is made of that."""

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float
from shapely.geometry import MultiPolygon, Point
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from inspe_jax.core.errors import InspeError, nearest
from inspe_jax.scene.georeference import Georeference
from inspe_jax.scene.intersection import Intersection, Route
from inspe_jax.scene.maps.approaches import SIDEWALK, Approach, arms_of
from inspe_jax.scene.maps.bodies import NO_POLES
from inspe_jax.scene.maps.lane_strips import LaneStrip, same_level
from inspe_jax.scene.maps.parts import (
    CLUSTER,
    MARGIN,
    MOST_LISTED,
    JunctionInfo,
    clean,
    crossing_lines,
    crosswalks_of,
    distance_from,
    joined_lines,
    mounting_of,
    walking_routes,
)
from inspe_jax.scene.regions import Region
from inspe_jax.scene.voxels import check_range

RADIUS_READ = (0.0, 500.0)
"""Allowed radius of what is read of a map [m]."""

Id = int | str
"""A junction's id."""


class Node(NamedTuple):
    """A junction of a map: its middle [m], the larger side of its bounding box [m], and the number
    of its signals."""

    middle: Float[np.ndarray, "3"]
    size: float
    signals: int


class MapJunction(ABC):
    """One junction of a map, or several that count as one, and what its format reads around it."""

    approaches: list[Approach]
    poles: Float[np.ndarray, "P 3"]
    """Poles of the map near the junction, at any height [m]."""

    @abstractmethod
    def lanes(self) -> tuple[list[LaneStrip], list[bool]]:
        """The lanes near the junction on all levels, and which of them are certainly on its own."""

    @abstractmethod
    def areas(
        self, lane_strips: list[LaneStrip], notes: list[str]
    ) -> dict[Region, list[BaseGeometry]]:
        """The parts of each region but for crosswalks, which may overlap.

        ``notes`` get what was assumed.
        """

    @abstractmethod
    def drives(self, arm_of: dict[tuple[int, str], int]) -> Iterable[Route]:
        """Every path from an inbound lane to another arm, from radius to radius; no U-turns.

        ``arm_of`` has the arm of each (road, end).
        """

    @abstractmethod
    def with_bodies(
        self, place: Intersection, lane_strips: list[LaneStrip], notes: list[str]
    ) -> Intersection:
        """The place with the bodies of its map; ``notes`` get what was done."""


class RoadMap(ABC):
    """A map file as its format reads it, in world metres.

    ``name`` is that of its file without suffixes. ``crossings`` are the outlines of all crosswalks,
    each (K, 3). ``georeference`` is the projection of its coordinates, None where there is none
    that can be used.
    """

    format: ClassVar[str]
    """How the source of a place ends that was read from it."""

    path: Path
    name: str
    crossings: tuple[np.ndarray, ...]
    georeference: Georeference | None

    @abstractmethod
    def road_lines(self) -> list[Float[np.ndarray, "N 2"]]:
        """The lines of its roads [m], for drawing."""

    @abstractmethod
    def junctions(self) -> list[Id]:
        """The ids of its junctions."""

    @abstractmethod
    def node(self, junction: Id) -> Node:
        """One of its junctions."""

    @abstractmethod
    def around(
        self, members: set[Id], middle: Float[np.ndarray, "3"], radius: float
    ) -> MapJunction:
        """Some junctions as one, about their middle, to a radius [m]."""

    @property
    def source(self) -> str:
        """The name of its file."""
        return self.path.name

    def list_junctions(self) -> tuple[JunctionInfo, ...]:
        """Its junctions."""
        walks = np.array([loop.mean(0) for loop in self.crossings]).reshape(-1, 3)
        found = []
        for name in self.junctions():
            middle, size, signals = self.node(name)
            arms, _ = arms_of(self.around({name}, middle, 0.0).approaches)
            near = int((distance_from(walks, middle) < size / 2 + 8.0).sum())
            x, y, z = middle.tolist()
            found.append(JunctionInfo(name, (x, y, z), len(arms), size, near, signals))
        return tuple(found)

    def read(
        self,
        junction: Id | None = None,
        center: tuple[float, float] | None = None,
        radius: float = 50.0,
    ) -> Intersection:
        """One junction and its surroundings: :func:`~inspe_jax.scene.maps.registry.read_map`."""
        members, middle, where = self._chosen(junction, center)
        check_range("radius", radius, RADIUS_READ)
        here = self.around(members, middle, radius)
        lane_strips = same_level(*here.lanes())
        if not lane_strips:
            raise InspeError(
                f"{self.source}: no roads within {radius:g} m of ({middle[0]:.1f}, {middle[1]:.1f})"
            )
        arms, arm_of = arms_of(here.approaches)
        notes: list[str] = []
        areas = _side_by_side(here.areas(lane_strips, notes))
        reach = radius + MARGIN
        ground = np.concatenate([s.center for s in lane_strips])
        ground = ground[distance_from(ground, middle) <= reach + 5.0]
        disc = Point(middle[:2]).buffer(reach, quad_segs=32)
        walks = crosswalks_of(self.crossings, areas, arms, ground, disc, notes)
        areas[Region.CROSSWALK] = clean(unary_union(walks))
        regions = {region: areas[region].intersection(disc) for region in Region}
        medians = [s.polygon for s in lane_strips if s.kind == "median"]
        place = Intersection(
            name=f"{self.name} {where}",
            source=f"{self.source} {self.format}",
            center=middle,
            regions=regions,
            arms=arms,
            routes=(),
            mounting=mounting_of(regions, medians, arms, disc),
            poles=here.poles,
            ground_points=ground,
            map=self.path.resolve(),
            georeference=self.georeference,
        )
        pavements = [
            run.center[:, :2]
            for strip in lane_strips
            if strip.kind in SIDEWALK
            for run in strip.runs(distance_from(strip.center, middle) <= radius)
        ]
        people = walking_routes(place, [*crossing_lines(walks), *joined_lines(pavements)])
        place = replace(
            place,
            center=place.on_ground(middle[None])[0],
            poles=place.on_ground(here.poles),
            routes=(*here.drives(arm_of), *people),
        )
        place = here.with_bodies(place, lane_strips, notes)
        if not len(place.poles):
            notes.append(NO_POLES)
        return replace(place, notes=tuple(notes))

    def _chosen(
        self, junction: Id | None, center: tuple[float, float] | None
    ) -> tuple[set[Id], Float[np.ndarray, "3"], str]:
        """The junctions that a user names, their middle [m], and words for the place.

        Raises InspeError if both or neither are given, or if there is no such junction.
        """
        if (junction is None) == (center is None):
            raise InspeError("say which place to read: either a junction id or a center (x, y)")
        ids = self.junctions()
        if center is None:
            named = {str(j): j for j in ids}
            name = str(junction)
            if name not in named:
                known = ", ".join([*named][:MOST_LISTED]) + ", …" * (len(named) > MOST_LISTED)
                raise InspeError(
                    f"{self.source}: no junction '{name}'; there are: {known or 'none'}"
                    f"{nearest(name, [*named])}"
                )
            return {named[name]}, self.node(named[name]).middle, f"junction {name}"
        at, where = np.array([*center, 0.0], float), f"({center[0]:g}, {center[1]:g})"
        middles = np.array([self.node(j).middle for j in ids]).reshape(-1, 3)
        away = distance_from(middles, at)
        near = away <= CLUSTER
        if not near.any():
            hint = ""
            if ids:
                closest = int(np.argmin(away))
                hint = f"; the nearest is {ids[closest]} at {away[closest]:.0f} m"
            raise InspeError(f"{self.source}: no junction within {CLUSTER:g} m of {where}{hint}")
        at[2] = np.mean(middles[near, 2])
        return {j for j, one in zip(ids, near, strict=True) if one}, at, f"at {where}"


def _side_by_side(parts: dict[Region, list[BaseGeometry]]) -> dict[Region, BaseGeometry]:
    """Junction, driveway, shoulder and sidewalk of their parts, without overlaps, seams or gaps."""
    areas: dict[Region, BaseGeometry] = {}
    taken: BaseGeometry = MultiPolygon()
    for region in (Region.JUNCTION, Region.DRIVEWAY, Region.SHOULDER, Region.SIDEWALK):
        areas[region] = clean(unary_union(parts[region]).difference(taken))
        taken = unary_union([taken, areas[region]])
    return areas
