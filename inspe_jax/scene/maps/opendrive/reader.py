"""OpenDRIVE maps into intersections, through the CARLA client's ``carla.Map`` (needs no server)."""

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely.geometry import LineString, Point
from shapely.ops import unary_union

from inspe_jax.core.errors import InspeError
from inspe_jax.scene.intersection import Intersection, Route
from inspe_jax.scene.maps.approaches import SIDEWALK, TRAVEL, Leg, arms_of
from inspe_jax.scene.maps.lane_strips import Strip, same_level
from inspe_jax.scene.maps.opendrive.regions import areas_of, interior_of, legs_of
from inspe_jax.scene.maps.opendrive.road_network import (
    INSET,
    TownMap,
    heading_of,
    load_map,
    position,
    strips_near,
)
from inspe_jax.scene.maps.parts import (
    MARGIN,
    STEP,
    JunctionInfo,
    check_radius,
    chosen,
    clean,
    crossing_lines,
    crosswalks_of,
    distance_from,
    joined_lines,
    mounting_of,
    resample,
    walking_routes,
)
from inspe_jax.scene.regions import Region

APRON = 25.0
"""Lanes are followed this much beyond what is kept, so that nothing at the rim is left open [m]."""


def list_junctions(path: str | os.PathLike[str]) -> tuple[JunctionInfo, ...]:
    """The junctions of an OpenDRIVE file, by id. Raises InspeError as :func:`read_opendrive`."""
    world = load_map(path)
    found = []
    for junction in world.junctions:
        center, size = world.box(junction)
        arms, _ = arms_of(legs_of(world, {junction}))

        def near(points: np.ndarray, beyond: float, c: np.ndarray = center, s: float = size) -> int:
            return int((np.hypot(*(points[:, :2] - c[:2]).T) < s / 2 + beyond).sum())

        middles = np.array([loop.mean(0) for loop in world.crosswalks]).reshape(-1, 3)
        x, y, z = (float(v) for v in center)
        counts = near(middles, 8.0), near(world.signals, 15.0)
        found.append(JunctionInfo(junction, (x, y, z), len(arms), size, *counts))
    return tuple(found)


def read_opendrive(
    path: str | os.PathLike[str],
    *,
    junction: str | int | None = None,
    center: tuple[float, float] | None = None,
    radius: float = 50.0,
) -> Intersection:
    """One junction of an OpenDRIVE file and its surroundings, in world metres (ENU).

    Give ``junction``, an id of the file, or ``center`` (x, y) [m] for a place that is not one
    OpenDRIVE junction, as a roundabout: all junctions within 35 m of it then count as one. Lanes
    are read to ``radius`` + 10 m; routes run from ``radius`` to ``radius``. Roads on another
    level are left out. Raises InspeError where the CARLA client is missing, the file is missing
    or is not well-formed OpenDRIVE, the junction is unknown, or no road is near.
    """
    world = load_map(path)
    members, middle, place = chosen(
        world.source, world.junctions, lambda j: world.box(j)[0], junction, center
    )
    check_radius(radius)
    interior = interior_of(world, members)
    reach = radius + MARGIN
    strips = strips_near(world, middle, reach + APRON)
    core = [s.junction in members or s.road in interior for s in strips]
    strips = same_level(strips, core)
    if not strips:
        raise InspeError(
            f"{world.source}: no roads within {radius:g} m of ({middle[0]:.1f}, {middle[1]:.1f})"
        )
    legs = legs_of(world, members)
    arms, arm_of = arms_of(legs)
    notes: list[str] = []

    areas = areas_of(world, strips, members, interior, notes)
    ground = np.concatenate([s.center for s in strips])
    ground = ground[distance_from(ground, middle) <= reach + 5.0]
    disc = Point(middle[:2]).buffer(reach, quad_segs=32)
    walks = crosswalks_of(world.crosswalks, areas, arms, ground, disc, notes)
    areas[Region.CROSSWALK] = clean(unary_union(walks))
    regions = {region: areas[region].intersection(disc) for region in Region}

    medians = [s.polygon for s in strips if s.kind == "median"]
    mounting = mounting_of(regions, medians, arms, disc)

    signals = world.signals[distance_from(world.signals, middle) <= reach]
    if not len(signals):
        notes.append("no signal poles: the map has no traffic lights near")
    found = Intersection(
        name=f"{world.name} {place}",
        source=f"{world.source} (OpenDRIVE)",
        center=middle,
        regions=regions,
        arms=arms,
        routes=(),
        mounting=mounting,
        poles=signals,
        ground_points=ground,
        notes=tuple(notes),
        map=Path(path).resolve(),
    )

    people = [*crossing_lines(walks), *_pavements(strips, middle, radius)]
    routes = [
        *_vehicle_routes(world, legs, arm_of, members, interior, middle, radius),
        *walking_routes(found, people),
    ]
    # Signals hang on poles or are sunk in the map: their feet stand on the ground, as the centre.
    poles = found.on_ground(signals) if len(signals) else signals
    foot = found.on_ground(middle[None])[0]
    return replace(found, center=foot, poles=poles, routes=tuple(routes))


def _vehicle_routes(
    world: TownMap,
    legs: list[Leg],
    arm_of: dict[tuple[int, str], int],
    members: set[int],
    interior: set[int],
    middle: np.ndarray,
    radius: float,
) -> Iterator[Route]:
    """Every way from an inbound lane to another arm, from radius to radius; no U-turns."""
    inside = {r.id for r in world.roads.values() if r.junction in members} | interior

    # By position, not by road: a step may leap over a road that is a stub.
    cuts = [LineString([leg.point(k) for k in leg.kerbs]) for leg in legs]

    def leads_to(waypoint: Any) -> int:
        """The arm at whose cut a waypoint is; −1 if at none."""
        away = shapely.distance(cuts, Point(position(waypoint.transform.location)[:2]))
        best = legs[int(np.argmin(away))]
        return arm_of[best.road, best.end] if away.min() < 2 * STEP else -1

    for leg in legs:
        length = world.roads[leg.road].length
        for lane, kind, _, _, inbound in leg.lanes:
            if kind not in TRAVEL or not inbound:
                continue
            mouth = world.at(leg.road, lane, INSET if leg.end == "start" else length - INSET)
            upstream = _follow(mouth, "previous", middle, radius)[::-1]
            for path in _ways(mouth, inside):
                last = path[-1]
                entry_arm, exit_arm = arm_of[leg.road, leg.end], leads_to(last)
                if exit_arm in (entry_arm, -1):
                    continue
                line = [*upstream, *path, *_follow(last, "next", middle, radius)]
                points = resample(np.array([position(w.transform.location) for w in line]))
                yield Route(points, mouth.lane_width, "vehicle", (entry_arm, exit_arm))


def _ways(mouth: Any, inside: set[int]) -> Iterator[list[Any]]:
    """All lane paths from a mouth through the junction to the first station beyond it."""
    stack = [([mouth], frozenset[tuple[int, int]]())]
    while stack:
        path, seen = stack.pop()
        here = path[-1]
        for step in here.next(STEP):
            lane = (step.road_id, step.lane_id)
            if step.road_id not in inside:
                if here.road_id in inside:
                    yield [*path, step]
                elif len(path) < 5:  # still on the leg
                    stack.append(([*path, step], seen))
            elif lane == (here.road_id, here.lane_id):
                stack.append(([*path, step], seen))
            elif lane not in seen:  # round a roundabout once
                stack.append(([*path, step], seen | {lane}))


def _follow(start: Any, way: str, middle: np.ndarray, radius: float) -> list[Any]:
    """Waypoints from a lane onward ('next') or back ('previous') to the radius, forks straight on.

    Ends early where the lane does, or after four radii on a road that winds.
    """
    line: list[Any] = []
    here = start
    for _ in range(int(4 * radius / STEP)):
        options = getattr(here, way)(STEP)
        if (
            not options
            or distance_from(position(here.transform.location)[None], middle)[0] > radius
        ):
            break
        direction = heading_of(here)
        here = max(options, key=lambda w: float(heading_of(w) @ direction))
        line.append(here)
    return line


def _pavements(strips: list[Strip], middle: np.ndarray, radius: float) -> Iterator[np.ndarray]:
    """The middle lines of sidewalks (N, 2), joined where one goes on from another; 5 m or more."""
    walks = [s for s in strips if s.kind in SIDEWALK]
    near = [run for s in walks for run in s.runs(distance_from(s.center, middle) <= radius)]
    return joined_lines([s.center[:, :2] for s in near])
