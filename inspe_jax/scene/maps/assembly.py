"""A place from the lanes, areas, crosswalks and routes that a reader found in its map."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from shapely.geometry import MultiPolygon, Point
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from inspe_jax.scene.georeference import Georeference
from inspe_jax.scene.intersection import Arm, Intersection, Route
from inspe_jax.scene.maps.approaches import SIDEWALK
from inspe_jax.scene.maps.lane_strips import LaneStrip
from inspe_jax.scene.maps.parts import (
    MARGIN,
    clean,
    crossing_lines,
    crosswalks_of,
    distance_from,
    joined_lines,
    mounting_of,
    walking_routes,
)
from inspe_jax.scene.regions import Region


def side_by_side(parts: dict[Region, list[BaseGeometry]]) -> dict[Region, BaseGeometry]:
    """Junction, driveway, shoulder and sidewalk of their parts, without overlaps, seams or gaps."""
    areas: dict[Region, BaseGeometry] = {}
    taken: BaseGeometry = MultiPolygon()
    for region in (Region.JUNCTION, Region.DRIVEWAY, Region.SHOULDER, Region.SIDEWALK):
        areas[region] = clean(unary_union(parts[region]).difference(taken))
        taken = unary_union([taken, areas[region]])
    return areas


def assembled(
    *,
    name: str,
    source: str,
    path: Path,
    georeference: Georeference | None,
    middle: Float[np.ndarray, "3"],
    radius: float,
    lane_strips: list[LaneStrip],
    areas: dict[Region, BaseGeometry],
    arms: tuple[Arm, ...],
    drives: Iterable[Route],
    loops: Iterable[np.ndarray],
    poles: Float[np.ndarray, "P 3"],
    notes: list[str],
) -> Intersection:
    """A place on the ground of its lanes, with crosswalks, footpaths and mounting areas.

    Args:
        name: Name of the place.
        source: Where it was read from, in words.
        path: File of the map.
        georeference: Projection of its coordinates.
        middle: Middle of the junction [m].
        radius: Footpaths end there; regions end :data:`MARGIN` farther out [m].
        lane_strips: The lanes on its level.
        areas: Its regions but for crosswalks (:func:`side_by_side`).
        arms: Its arms.
        drives: Routes of vehicles.
        loops: Outlines of the map's crosswalks, each (K, 3) [m].
        poles: Poles of the map at any height [m].
        notes: Gets what was assumed.
    """
    reach = radius + MARGIN
    ground = np.concatenate([s.center for s in lane_strips])
    ground = ground[distance_from(ground, middle) <= reach + 5.0]
    disc = Point(middle[:2]).buffer(reach, quad_segs=32)
    walks = crosswalks_of(loops, areas, arms, ground, disc, notes)
    areas = {**areas, Region.CROSSWALK: clean(unary_union(walks))}
    regions = {region: areas[region].intersection(disc) for region in Region}
    medians = [s.polygon for s in lane_strips if s.kind == "median"]
    place = Intersection(
        name=name,
        source=source,
        center=middle,
        regions=regions,
        arms=arms,
        routes=(),
        mounting=mounting_of(regions, medians, arms, disc),
        poles=poles,
        ground_points=ground,
        map=path.resolve(),
        georeference=georeference,
    )
    pavements = [
        run.center[:, :2]
        for strip in lane_strips
        if strip.kind in SIDEWALK
        for run in strip.runs(distance_from(strip.center, middle) <= radius)
    ]
    people = [*crossing_lines(walks), *joined_lines(pavements)]
    return replace(
        place,
        center=place.on_ground(middle[None])[0],
        poles=place.on_ground(poles),
        routes=(*drives, *walking_routes(place, people)),
    )
