"""Paths that road users follow: evenly spaced poses, speed limits, and conflicts between paths; and
footpaths beside the lanes and over the arms, for an intersection whose map has none."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy
from jaxtyping import Float, Int

from inspe_jax.scene.intersection import (
    Intersection,
    Route,
    crossing_lines,
    mouth_crosswalks,
    walking_routes,
)
from inspe_jax.scene.lines import cross, distance_from

SPACING = 0.5  # distance between poses of a path [m]
PATH_USERS: tuple[str, ...] = ("vehicle", "cyclist", "pedestrian")
"""Kinds of path. A cyclist's path is a vehicle's, moved to the right of its lane."""

WIDEST = np.array([2.6, 0.8, 0.6])  # width [m] that a path of each kind must keep free

# Odd figures on purpose: no lane width is a multiple of them, so rounding never decides.
SIDE_ROOM = 0.37  # kept between crossing streams [m]
FLOW = 1.61  # paths nearer than this and similar in direction are one stream [m]
ALIKE = np.cos(np.radians(20.3))
DIVERGING = 12  # paths that split less than this before do not conflict yet [m]
MERGE_GAP = (12.0, 8.0, 2.5)  # room to wait between two conflicts, by kind of path [m]
SETBACK = 1.0  # from a stop line to the first conflict [m]
LATERAL = 2.2  # comfortable lateral acceleration in a bend [m/s²]
AXLE = 0.3  # from a body's middle to either axle, as a share of its length
BRAKING = 2.0  # comfortable braking before a bend [m/s²]
SHORTEST = (8.0, 8.0, 2.0)  # shorter paths are left out, by kind of path [m]


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class Paths:
    """P paths inside the region of interest, their N poses end to end, and their K conflicts.

    ``start`` is the index of each path's first pose, ``count`` its number of poses, ``user``
    indexes :data:`PATH_USERS`, ``width`` is the lane's [m] and ``weight`` the share of new
    arrivals. Pose m of a path is :data:`SPACING`·m metres from its start: ``point`` [m] and
    ``limit`` on speed [m/s].

    A block is a stretch of a path that other streams cross or join; ``block`` (P, C) numbers each
    path's blocks in order, then −1; ``stop`` and ``leave`` are the arcs [m] where each begins (its
    stop line) and ends. ``clear[a, b]`` is the arc on b's path up to which block b is in conflict
    with block a: −inf where they never meet. Block −1 is the last entry: infinitely far, met by
    none.
    """

    start: Int[np.ndarray, " P"]
    count: Int[np.ndarray, " P"]
    user: Int[np.ndarray, " P"]
    width: Float[np.ndarray, " P"]
    weight: Float[np.ndarray, " P"]
    point: Float[np.ndarray, "N 3"]
    limit: Float[np.ndarray, " N"]
    block: Int[np.ndarray, "P C"]
    stop: Float[np.ndarray, " K"]
    leave: Float[np.ndarray, " K"]
    clear: Float[np.ndarray, "K K"]

    @cached_property
    def length(self) -> Float[np.ndarray, " P"]:
        """Length of each path [m]."""
        return (self.count - 1) * SPACING

    def at(
        self, path: Int[np.ndarray, "*S"], arc: Float[np.ndarray, "*S"]
    ) -> Float[np.ndarray, "*S 3"]:
        """Point [m] at an arc length [m] of a path, which goes straight on beyond its ends."""
        place = arc / SPACING
        below = np.minimum(np.maximum(np.floor(place).astype(int), 0), self.count[path] - 2)
        part = (place - below)[..., None]
        below = below + self.start[path]
        return self.point[below] * (1 - part) + self.point[below + 1] * part

    def chord(
        self,
        path: Int[np.ndarray, "*S"],
        arc: Float[np.ndarray, "*S"],
        length: Float[np.ndarray, "*S"],
    ) -> tuple[Float[np.ndarray, "*S 3"], Float[np.ndarray, "*S 2"]]:
        """Centre [m] and unit heading of a body of some length [m] whose axles are on the path: in
        a bend a long body cuts the corner."""
        rear = self.at(path, arc - AXLE * length)
        front = self.at(path, arc + AXLE * length)
        along = front[..., :2] - rear[..., :2]
        return (rear + front) / 2, along / np.sqrt(dot(along, along))[..., None]


def lay_paths(intersection: Intersection, radius: float) -> Paths:
    """The intersection's routes within ``radius`` [m] of its centre, as :class:`Paths`."""
    stretches: list[tuple[np.ndarray, int, float]] = []
    for route in intersection.routes:
        for kind in (2,) if route.user == "pedestrian" else (0, 1):
            points = _within(_line(route, kind), intersection.center, radius)
            if (len(points) - 1) * SPACING >= SHORTEST[kind]:
                stretches.append((points, kind, route.width))
    count = np.array([len(p) for p, _, _ in stretches], int)
    start = np.cumsum(count) - count
    user = np.array([u for _, u, _ in stretches], int)
    each = [_headings(p) for p, _, _ in stretches]
    point = np.concatenate([np.zeros((0, 3)), *(p for p, _, _ in stretches)])
    heading = np.concatenate([np.zeros((0, 2)), *each])
    return Paths(
        start=start,
        count=count,
        user=user,
        width=np.array([w for _, _, w in stretches], float),
        weight=_weights(point[start], user, heading[start], heading[start + count - 1]),
        point=point,
        limit=np.concatenate([np.zeros(0), *map(_limit, each)]),
        **_blocks(start, count, user, point[:, :2], heading),
    )


def _line(route: Route, kind: int) -> np.ndarray:
    """A route's poses for one kind of path; cyclists and pedestrians keep to the right."""
    points = resample(np.asarray(route.waypoints, float))
    offset = (0.0, max(route.width / 2 - 0.6, 0.0), min(route.width / 4, 0.5))[kind]
    if not offset or len(points) < 2:
        return points
    heading = _headings(points)
    moved = points.copy()
    moved[:, 0] += offset * heading[:, 1]
    moved[:, 1] -= offset * heading[:, 0]
    # In a bend tighter than the offset the line would run backwards: those points are left out.
    forward = dot(np.diff(moved[:, :2], axis=0), heading[1:]) > 0
    return resample(moved[np.concatenate([[True], forward])])


def resample(points: np.ndarray) -> np.ndarray:
    """The polyline at every :data:`SPACING` metres of its length in plan, from its start."""
    step = np.diff(points[:, :2], axis=0)
    arc = np.concatenate([[0.0], np.cumsum(np.sqrt(dot(step, step)))])
    even = np.arange(0.0, arc[-1] + 1e-9, SPACING)
    return np.stack([np.interp(even, arc, axis) for axis in points.T], -1)


def _within(points: np.ndarray, center: np.ndarray, radius: float) -> np.ndarray:
    away = points[:, :2] - np.asarray(center)[:2]
    inside = np.flatnonzero(dot(away, away) <= radius**2)
    return points[inside[0] : inside[-1] + 1] if len(inside) else points[:0]


def _headings(points: np.ndarray) -> np.ndarray:
    along = np.gradient(points[:, :2], axis=0)
    return along / np.sqrt(dot(along, along))[:, None]


def _limit(heading: np.ndarray) -> np.ndarray:
    """Speed [m/s] with comfortable lateral acceleration, and comfortable braking before bends."""
    turn = np.abs(cross(heading[:-1], heading[1:]))
    # The mean over 2 m, because waypoints turn in steps.
    turn = np.convolve(np.concatenate([turn[:1], turn]), np.full(4, 0.25), mode="same")
    squared = LATERAL * SPACING / np.maximum(turn, 1e-6)
    reach = 2 * BRAKING * SPACING * np.arange(len(heading))
    return np.sqrt(np.minimum.accumulate((squared + reach)[::-1])[::-1] - reach)


def _weights(
    first: np.ndarray, user: np.ndarray, enter: np.ndarray, leave: np.ndarray
) -> np.ndarray:
    """Shares of arrivals: equal for entry lanes; in one, straight on up to three times a turn."""
    straight = 1 + 2 * np.maximum(dot(enter, leave), 0.0)
    apart = first[:, None, :2] - first[None, :, :2]
    together = (dot(apart, apart) < 1.0) & (user[:, None] == user)
    return straight / np.where(together, straight, 0.0).sum(1)


def _blocks(
    start: np.ndarray, count: np.ndarray, user: np.ndarray, point: np.ndarray, heading: np.ndarray
) -> dict[str, np.ndarray]:
    path = np.repeat(np.arange(len(start)), count)
    arc = (np.arange(len(point)) - np.repeat(start, count)) * SPACING
    one, two = _conflicts(path, arc, user, point, heading)
    listed: list[list[int]] = [[] for _ in start]
    stop: list[float] = []
    leave: list[float] = []
    block_of = np.full(len(point), -1)
    busy = np.zeros(len(point), bool)
    busy[one] = True
    for p in range(len(start)):
        at = start[p] + np.flatnonzero(busy[start[p] : start[p] + count[p]])
        for run in np.split(at, np.flatnonzero(np.diff(arc[at]) > MERGE_GAP[user[p]]) + 1):
            if len(run):
                listed[p].append(len(stop))
                block_of[run] = len(stop)
                stop.append(arc[run[0]] - SETBACK)
                leave.append(arc[run[-1]] + SETBACK)
    clear = np.full((len(stop) + 1, len(stop) + 1), -np.inf)
    np.maximum.at(clear, (block_of[one], block_of[two]), arc[two] + SETBACK / 2)
    block = np.full((len(start), 1 + max((len(b) for b in listed), default=0)), -1)
    for row, numbers in zip(block, listed, strict=True):
        row[: len(numbers)] = numbers
    ends = dict(stop=np.array([*stop, np.inf]), leave=np.array([*leave, np.inf]))
    return ends | dict(block=block, clear=clear)


def _conflicts(
    path: np.ndarray, arc: np.ndarray, user: np.ndarray, point: np.ndarray, heading: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of poses, in both orders, that users of two different streams cannot both occupy."""
    sample = np.flatnonzero(np.round(arc / SPACING).astype(int) % 2 == 0)  # one a metre is enough
    if not len(sample):
        return np.zeros(0, int), np.zeros(0, int)
    reach = WIDEST.max() + SIDE_ROOM
    pairs = scipy.spatial.cKDTree(point[sample]).query_pairs(reach, output_type="ndarray")
    one, two = sample[pairs].reshape(-1, 2).T
    apart = path[one] != path[two]
    # Pedestrians walk round each other, so there is no right of way among them.
    apart &= (user[path[one]] != 2) | (user[path[two]] != 2)
    one, two = one[apart], two[apart]
    distance = np.sqrt(dot(point[one] - point[two], point[one] - point[two]))
    room = (WIDEST[user[path[one]]] + WIDEST[user[path[two]]]) / 2
    alike = dot(heading[one], heading[two])
    same_stream = (alike > ALIKE) & (distance < FLOW)
    near = np.where(np.abs(alike) > ALIKE, distance < room, distance < room + SIDE_ROOM)
    since = _since_stream(path, one[same_stream], two[same_stream])
    split = (since(one, path[two]) <= DIVERGING) & (since(two, path[one]) <= DIVERGING)
    met = near & ~same_stream & ~split
    return np.concatenate([one[met], two[met]]), np.concatenate([two[met], one[met]])


def _since_stream(
    path: np.ndarray, one: np.ndarray, two: np.ndarray
) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """A function: metres since a pose's path was last in one stream with another path."""
    first = np.searchsorted(path, path)  # first pose of each pose's path
    shared = np.full((path[-1] + 1, len(path)), -1)
    shared[path[two], one] = one
    shared[path[one], two] = two
    last = np.maximum.accumulate(shared, axis=1)

    def since(pose: np.ndarray, other: np.ndarray) -> np.ndarray:
        at = last[other, pose]
        return np.where(at >= first[pose], (pose - at) * SPACING, np.inf)

    return since


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Scalar products of plan vectors (…, 2)."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1]


BESIDE = 1.5  # distance of a footpath's middle from the lane's edge [m]: room for two that meet
SLACK = 0.3  # footpaths come nearer to another lane's edge than BESIDE by at most this [m]
WALKS_APART = 2.0  # two footpaths nearer than this are one [m]
SHORTEST_WALK = 10.0  # a footpath shorter than this beside a lane is left out [m]
CROSSING = np.cos(np.radians(45.0))  # lanes that meet at a larger angle cross; none on motorways


def with_walkways(intersection: Intersection, radius: float) -> Intersection:
    """The intersection with footpaths for traffic, if nobody walks within ``radius`` [m] and lanes
    cross, as on no motorway: to the right of the outermost lanes, and over each arm at its
    mouth."""
    away = [distance_from(route.waypoints, intersection.center) for route in intersection.routes]
    near = [r for r, far in zip(intersection.routes, away, strict=True) if (far <= radius).any()]
    lanes = [route for route in near if route.user == "vehicle"]
    if len(lanes) < len(near) or not _cross(lanes):
        return intersection
    crosswalks = [mouth_crosswalks((arm,)) for arm in intersection.arms]
    walks = walking_routes(intersection, [*_beside(lanes), *crossing_lines(crosswalks)])
    return replace(intersection, routes=(*intersection.routes, *walks))


def _cross(lanes: list[Route]) -> bool:
    """Whether two lanes meet, at one height, at more than 45°."""
    if not lanes:
        return False
    fine = [resample(lane.waypoints) for lane in lanes]
    point, heading = np.concatenate(fine), np.concatenate([_heading(line) for line in fine])
    one, two = scipy.spatial.cKDTree(point).query_pairs(1.0, output_type="ndarray").reshape(-1, 2).T
    return bool(((heading[one] * heading[two]).sum(1) < CROSSING).any())


def _beside(lanes: list[Route]) -> Iterator[np.ndarray]:
    """Lines (N, 2) to the right of lanes where no other lane is; the longest first."""
    fine = [(lane.width, resample(lane.waypoints)[:, :2]) for lane in lanes]
    trees = {
        width: scipy.spatial.cKDTree(np.concatenate([line for own, line in fine if own == width]))
        for width, _ in fine
    }
    runs: list[np.ndarray] = []
    for lane_width, line in fine:
        ahead = _heading(line)
        beside = line + (lane_width / 2 + BESIDE) * np.stack([ahead[:, 1], -ahead[:, 0]], -1)
        away = [tree.query(beside)[0] - width / 2 for width, tree in trees.items()]
        runs += _runs(beside, np.min(away, axis=0) >= BESIDE - SLACK)
    kept: list[np.ndarray] = []
    for run in sorted(runs, key=len, reverse=True):
        free = np.ones(len(run), bool)
        if kept:
            free = scipy.spatial.cKDTree(np.concatenate(kept)).query(run)[0] >= WALKS_APART
        kept += _runs(run, free)
    yield from kept


def _runs(line: np.ndarray, free: np.ndarray) -> list[np.ndarray]:
    parts = np.split(np.arange(len(line)), np.flatnonzero(np.diff(free.astype(int))) + 1)
    least = SHORTEST_WALK / SPACING
    return [line[part] for part in parts if len(part) > least and free[part[0]]]


def _heading(line: np.ndarray) -> np.ndarray:
    along = np.gradient(line[:, :2], axis=0)
    return along / np.maximum(np.hypot(*along.T), 1e-9)[:, None]
