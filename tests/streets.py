"""Streets by hand for tests of traffic, and an oracle of boxes that overlap."""

from dataclasses import replace
from functools import cache

import numpy as np
import worlds
from shapely import STRtree, polygons
from shapely.geometry import MultiPolygon

from inspe_jax.scene.intersection import Intersection, Route
from inspe_jax.scene.traffic.frames import TrafficFrames

LANE = 3.5
FAR = 80.0


def line(*corners: tuple[float, ...], grade: float = 0.0) -> np.ndarray:
    """A polyline every metre, rising by ``grade`` along x."""
    points = np.array(corners, float)
    arc = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    even = np.arange(0, arc[-1] + 1e-9)
    x, y = (np.interp(even, arc, axis) for axis in points.T)
    return np.stack([x, y, grade * x], -1)


def quarter_bend(x: float, y: float, radius: float, left: bool) -> list[tuple[float, float]]:
    """Points of a quarter circle from (x, y) travelling +x."""
    angle = np.linspace(0, np.pi / 2, 30)
    side = 1 if left else -1
    across = side * radius * (1 - np.cos(angle))
    return list(zip(x + radius * np.sin(angle), y + across, strict=True))


def intersection(routes: list[Route], center: tuple[float, ...] = (0, 0, 0)) -> Intersection:
    """A place of routes alone."""
    bare = dict(regions={}, mounting=MultiPolygon(), ground_points=np.zeros((1, 3)))
    return replace(worlds.crossing(center=center), routes=tuple(routes), **bare)


def turned(route: Route, angle: float, shift: tuple[float, ...] = (0, 0, 0)) -> Route:
    """A route turned about the origin, then shifted; exact for quarter turns."""
    c, s = np.cos(angle), np.sin(angle)
    quarters = angle / (np.pi / 2)
    if quarters == int(quarters):
        c, s = round(c), round(s)
    x, y, z = route.waypoints.T
    return replace(route, waypoints=np.stack([c * x - s * y, s * x + c * y, z], -1) + shift)


@cache
def crossing(turns: bool = True, walks: bool = True) -> Intersection:
    """Two roads of two lanes each way, with turns, and pedestrians across and beside each arm."""
    inner, outer, kerb = -LANE / 2, -LANE * 1.5, -LANE * 2 - 2
    arm = [Route(line((-FAR, y), (FAR, y)), LANE, "vehicle", (0, 2)) for y in (inner, outer)]
    if turns:
        right = [(-FAR, outer), *quarter_bend(-13.0, outer, 13.0 + outer, False), (outer, -FAR)]
        left = [(-FAR, inner), *quarter_bend(-13.0, inner, 13.0 - inner, True), (-inner, FAR)]
        arm += [Route(line(*right), LANE, "vehicle", (0, 1))]
        arm += [Route(line(*left), LANE, "vehicle", (0, 3))]
    if walks:
        across, beside = [(-16.0, -11.0), (-16.0, 11.0)], [(-FAR, kerb), (kerb, kerb)]
        walk = [line(*across), line(*across[::-1]), line(*beside), line(*beside[::-1])]
        arm += [Route(w, 2.0, "pedestrian") for w in walk]
    return intersection([turned(route, k * np.pi / 2) for k in range(4) for route in arm])


def overlapping(traffic: TrafficFrames) -> list[tuple[int, int, int]]:
    """(frame, i, j) of boxes that meet, by shapely."""
    found = []
    for t in range(traffic.frame_count):
        there = traffic.valid[t]
        yaw, half = traffic.yaw[t, there, None], traffic.size[t, there, None, :2] / 2
        x, y = np.moveaxis(half * [[1, 1], [-1, 1], [-1, -1], [1, -1]], -1, 0)
        turned = [np.cos(yaw) * x - np.sin(yaw) * y, np.sin(yaw) * x + np.cos(yaw) * y]
        bodies = polygons(np.stack(turned, -1) + traffic.center[t, there, None, :2])
        pairs = STRtree(bodies).query(bodies, predicate="intersects").T
        found += [(t, int(i), int(j)) for i, j in pairs if i < j]
    return found
