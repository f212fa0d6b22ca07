"""Reads OpenDRIVE maps with the CARLA client's ``carla.Map``, which needs no server."""

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float
from shapely.geometry import LineString, Point

from inspe_jax.core.errors import InspeError
from inspe_jax.scene.georeference import Georeference
from inspe_jax.scene.intersection import Intersection, Route
from inspe_jax.scene.lines import resampled
from inspe_jax.scene.maps.approaches import TRAVEL, Approach, arms_of
from inspe_jax.scene.maps.assembly import assembled
from inspe_jax.scene.maps.bodies import NO_POLES, with_bodies
from inspe_jax.scene.maps.lane_strips import same_level
from inspe_jax.scene.maps.opendrive.objects import PARKING
from inspe_jax.scene.maps.opendrive.regions import approaches_of, areas_of, interior_of
from inspe_jax.scene.maps.opendrive.road_network import (
    INSET,
    TownMap,
    heading_of,
    lane_strips_near,
    load_map,
    position,
)
from inspe_jax.scene.maps.parking import with_parked
from inspe_jax.scene.maps.parts import (
    MARGIN,
    RADIUS_READ,
    STEP,
    JunctionInfo,
    distance_from,
    junctions_at,
)
from inspe_jax.scene.voxels import check_range

COARSE = 5.0
"""Spacing of the points of a map's road lines [m]."""
APRON = 25.0
"""Lanes are read this much farther than they are kept, so that no lane ends inside the rim [m]."""


def list_junctions(path: str | os.PathLike[str]) -> tuple[JunctionInfo, ...]:
    """The junctions of an OpenDRIVE file, by id. Raises InspeError as :func:`read_opendrive`."""
    town = load_map(path)
    found = []
    for junction in town.junctions:
        center, size = town.box(junction)
        arms, _ = arms_of(approaches_of(town, {junction}))

        def near(points: np.ndarray, beyond: float, c: np.ndarray = center, s: float = size) -> int:
            return int((np.hypot(*(points[:, :2] - c[:2]).T) < s / 2 + beyond).sum())

        middles = np.array([loop.mean(0) for loop in town.crosswalks]).reshape(-1, 3)
        x, y, z = (float(v) for v in center)
        counts = near(middles, 8.0), near(town.signals, 15.0)
        found.append(JunctionInfo(junction, (x, y, z), len(arms), size, *counts))
    return tuple(found)


def road_lines(path: str | os.PathLike[str]) -> list[Float[np.ndarray, "N 2"]]:
    """The middle of a driving lane of each road [m]. Raises as :func:`read_opendrive`."""
    town, found = load_map(path), []
    for road in town.roads.values():
        for start, end, lanes in road.sections:
            lane = next((name for name, kind in lanes.items() if kind == "driving"), 0)
            marks = town.along(road.id, lane, start, end, COARSE) if lane else []
            if len(marks) > 1:
                found.append(np.array([position(m.transform.location)[:2] for m in marks]))
    return found


def georeference_of(path: str | os.PathLike[str]) -> Georeference | None:
    """The projection of an OpenDRIVE file's coordinates; None if it names none that can be used.

    Raises InspeError as :func:`read_opendrive`.
    """
    return load_map(path).georeference


def read_opendrive(
    path: str | os.PathLike[str],
    *,
    junction: str | int | None = None,
    center: tuple[float, float] | None = None,
    radius: float = 50.0,
) -> Intersection:
    """One junction of an OpenDRIVE file: :func:`~inspe_jax.scene.maps.registry.read_map`."""
    town = load_map(path)
    members, middle, place = junctions_at(
        town.source, town.junctions, lambda j: town.box(j)[0], junction, center
    )
    check_range("radius", radius, RADIUS_READ)
    interior = interior_of(town, members)
    reach = radius + MARGIN
    lane_strips = lane_strips_near(town, middle, reach + APRON)
    core = [s.junction in members or s.road in interior for s in lane_strips]
    lane_strips = same_level(lane_strips, core)
    if not lane_strips:
        raise InspeError(
            f"{town.source}: no roads within {radius:g} m of ({middle[0]:.1f}, {middle[1]:.1f})"
        )
    approaches = approaches_of(town, members)
    arms, arm_of = arms_of(approaches)
    notes: list[str] = []
    found = assembled(
        name=f"{town.name} {place}",
        source=f"{town.source} (OpenDRIVE)",
        path=Path(path),
        georeference=town.georeference,
        middle=middle,
        radius=radius,
        lane_strips=lane_strips,
        areas=areas_of(town, lane_strips, members, interior, notes),
        arms=arms,
        drives=_vehicle_routes(town, approaches, arm_of, members, interior, middle, radius),
        loops=town.crosswalks,
        # Signals are at the height of their lights, or below ground.
        poles=town.signals[distance_from(town.signals, middle) <= reach],
        notes=notes,
    )
    notes += town.notes
    bodies = [shape for shape in town.shapes if shape.kind != PARKING]
    spaces = [shape.area for shape in town.shapes if shape.kind == PARKING]
    found = with_bodies(found, bodies, reach, notes)
    parking = [strip for strip in lane_strips if strip.kind == "parking"]
    found = with_parked(found, parking, spaces, reach, notes)
    if not len(found.poles):
        notes.append(NO_POLES)
    return replace(found, notes=tuple(notes))


def _vehicle_routes(
    town: TownMap,
    approaches: list[Approach],
    arm_of: dict[tuple[int, str], int],
    members: set[int],
    interior: set[int],
    middle: np.ndarray,
    radius: float,
) -> Iterator[Route]:
    """Every path from an inbound lane to another arm, from radius to radius; no U-turns."""
    inside = {r.id for r in town.roads.values() if r.junction in members} | interior
    # By position, not by road, because a step may skip a road that is a stub.
    cuts = [LineString([approach.point(k) for k in approach.kerbs]) for approach in approaches]

    def leads_to(waypoint: Any) -> int:
        """The arm at whose mouth a waypoint is; −1 if it is at none."""
        away = shapely.distance(cuts, Point(position(waypoint.transform.location)[:2]))
        best = approaches[int(np.argmin(away))]
        return arm_of[best.road, best.end] if away.min() < 2 * STEP else -1

    for approach in approaches:
        length = town.roads[approach.road].length
        for lane, kind, _, _, inbound in approach.lanes:
            if kind not in TRAVEL or not inbound:
                continue
            mouth = town.at(
                approach.road, lane, INSET if approach.end == "start" else length - INSET
            )
            upstream = _follow(mouth, "previous", middle, radius)[::-1]
            for path in _lane_paths(mouth, inside):
                last = path[-1]
                entry_arm, exit_arm = arm_of[approach.road, approach.end], leads_to(last)
                if exit_arm in (entry_arm, -1):
                    continue
                line = [*upstream, *path, *_follow(last, "next", middle, radius)]
                points = resampled(np.array([position(w.transform.location) for w in line]))
                yield Route(points, mouth.lane_width, "vehicle", (entry_arm, exit_arm))


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


def _follow(start: Any, direction: str, middle: np.ndarray, radius: float) -> list[Any]:
    """Waypoints from a lane on ('next') or back ('previous') to the radius, straight on."""
    line: list[Any] = []
    here = start
    for _ in range(int(4 * radius / STEP)):  # four radii on a winding road
        options = getattr(here, direction)(STEP)
        if (
            not options
            or distance_from(position(here.transform.location)[None], middle)[0] > radius
        ):
            break
        heading = heading_of(here)
        here = max(options, key=lambda w: float(heading_of(w) @ heading))
        line.append(here)
    return line
