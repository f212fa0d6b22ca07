"""Road users that drive, queue, give way and walk along paths: one step after another."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from inspe_jax.scene.waypoint_paths import USERS, Paths

BRAKING = 3.0  # what drivers count on, of themselves and of whoever is ahead [m/s²]
REACTION = 0.7  # [s]
MARGIN = 0.05  # least distance ever kept between two bodies [m]
SIDE_MARGIN = 0.1  # room wanted beside one's own path [m]
ENTRY_ROOM = 3.0  # free road wanted before and behind an arrival [m]
LOOK = 1.0  # step of looking ahead [m]; shorter than the shortest reach of a body and its gap
HORIZON = 25.0  # how far ahead one looks [m]
PATIENCE = 8.0  # after waiting so long [s] one goes before those who came later
STUCK = 45.0  # a user that has not moved for so long [s] goes and comes again elsewhere
ARRIVALS = 4  # that are tried in one step


@dataclass(frozen=True)
class RoadUser:
    """One class: mean ``size`` (length, width, height) [m] and how it moves [m/s, m/s²].

    ``path`` is one of :data:`~inspe_jax.scene.waypoint_paths.USERS`; ``gap`` [m]
    is kept ahead at a standstill.
    """

    name: str
    path: str
    size: tuple[float, float, float]
    top_speed: float
    acceleration: float
    gap: float


class WaypointModel:
    """Up to ``len(kind)`` users on ``paths``; ``step`` moves them all, never into each other.

    Each user keeps one class for good: when it leaves, the same class comes in
    again as another user, of another size and on another path, as soon as there
    is room. Arrays below have one entry for each; where ``active`` is false the
    user waits outside. ``arc`` [m] places its centre on ``path``, ``track``
    numbers users in order of arrival.
    """

    def __init__(
        self,
        paths: Paths,
        users: tuple[RoadUser, ...],
        kind: Int[np.ndarray, " M"],
        spread: float,
        rng: np.random.Generator,
    ) -> None:
        many = len(kind)
        self.paths, self.rng, self.spread, self.kind = paths, rng, spread, kind
        self.mean_size = np.array([u.size for u in users])[kind]  # (M, 3)
        self.top_speed = np.array([u.top_speed for u in users])[kind]
        self.acceleration = np.array([u.acceleration for u in users])[kind]
        self.gap = np.array([u.gap for u in users])[kind]
        route = np.array([USERS.index(u.path) for u in users])[kind]
        self.choices = [np.flatnonzero(paths.user == r) for r in range(len(USERS))]
        self.route = route
        self.time = 0.0
        self.removed = 0
        self.arrived = 0
        self.active = np.zeros(many, bool)
        self.path = np.zeros(many, int)
        self.arc = np.zeros(many)
        self.speed = np.zeros(many)
        self.wish = np.zeros(many)  # speed on a free road [m/s]
        self.size = self.mean_size.copy()
        self.track = np.full(many, -1)
        self.still = np.zeros(many)  # time since it last moved [s]
        self.asked = np.full(many, np.inf)  # when it asked for its next block [s]
        self.granted = np.zeros((many, paths.block.shape[1]), bool)
        self.point = np.zeros((many, 3))
        self.heading = np.tile([1.0, 0.0], (many, 1))

    def fill(self) -> None:
        """Scatter users over the paths where there is room; the rest wait outside."""
        for who in range(len(self.kind)):
            for _ in range(20):
                self._draw(who)
                self.arc[who] = self.rng.random() * self.paths.length[self.path[who]]
                if self._has_room(who) and not self._in_block(who):
                    self._admit(who)
                    break

    def step(self, dt: float) -> None:
        """Let users in, decide who may go, and move everybody for ``dt`` seconds."""
        self.time += dt
        self._let_in()
        on = np.flatnonzero(self.active)
        if not len(on):
            return
        free, leader, leader_speed = self._look_ahead(on)
        self._give_way(on, free, leader)
        line = self._line_distance(on)  # to the stop line of the next block not granted
        speed = np.minimum.reduce(
            [
                self.speed[on] + self.acceleration[on] * dt,
                self.wish[on],
                self.paths.speed_limit(self.path[on], self.arc[on]),
                _safe_speed(free, leader_speed),
                _safe_speed(line, np.zeros(len(on))),
            ]
        )
        self._move(on, np.where(speed < 0.05, 0.0, speed), dt)

    # --- coming and going -------------------------------------------------------------------

    def _draw(self, who: int) -> None:
        """A new user in place of the last: size, speed and path, at the path's start."""
        among = self.choices[self.route[who]]
        weight = self.paths.weight[among]
        self.path[who] = self.rng.choice(among, p=weight / weight.sum())
        size = self.mean_size[who] * (1 + self.spread * _truncated_normal(self.rng, 3))
        # A body leaves some of its lane free, or neighbours could never pass.
        size[1] = min(size[1], max(self.paths.width[self.path[who]] - 0.3, 0.5))
        self.size[who] = size
        self.wish[who] = self.top_speed[who] * (0.9 + 0.05 * _truncated_normal(self.rng, 1)[0])
        self.arc[who], self.speed[who] = 0.0, 0.0

    def _has_room(self, who: int) -> bool:
        """Whether nobody is on the spot or within :data:`ENTRY_ROOM` of it along the path."""
        self._place(np.array([who]))
        others = np.flatnonzero(self.active)
        if not len(others):
            return True
        half = self.size[others, :2] / 2
        own = self.size[who, :2] / 2 + [min(ENTRY_ROOM, 3 * self.gap[who]), SIDE_MARGIN]
        return not _overlap(
            self.point[who, :2], self.heading[who], own,
            self.point[others, :2], self.heading[others], half,
        ).any()  # fmt: skip

    def _in_block(self, who: int) -> bool:
        blocks = self.paths.block[self.path[who]]
        front, rear = self._ends(np.array([who]))
        return bool(((self.paths.stop[blocks] < front) & (self.paths.leave[blocks] > rear)).any())

    def _admit(self, who: int) -> None:
        blocks = self.paths.block[self.path[who]]
        self.granted[who] = self.paths.stop[blocks] < self._ends(np.array([who]))[0]
        self.active[who], self.still[who], self.asked[who] = True, 0.0, np.inf
        self.track[who] = self.arrived
        self.arrived += 1

    def _let_in(self) -> None:
        """Try a few of those who wait outside, each at an entry of its own choice."""
        outside = np.flatnonzero(~self.active)
        if len(outside) > ARRIVALS:
            outside = np.sort(self.rng.choice(outside, ARRIVALS, replace=False))
        for who in outside:
            self._draw(who)
            if self._has_room(who) and (not self._in_block(who) or self._first_free(who)):
                self.speed[who] = self.wish[who]  # it looks ahead before it moves
                self._admit(who)

    def _first_free(self, who: int) -> bool:
        """Whether nobody is in the way of a user that would begin inside its first block."""
        on = np.flatnonzero(self.active)
        return not self._held_against(self.paths.block[self.path[[who]], 0], on).any()

    # --- right of way -----------------------------------------------------------------------

    def _next_block(self, on: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Column and number (−1: none left) of each user's first block not granted."""
        blocks = self.paths.block[self.path[on]]
        column = np.argmin(self.granted[on], axis=1)  # block -1 ends every row and is never granted
        return column, blocks[np.arange(len(on)), column]

    def _line_distance(self, on: np.ndarray) -> np.ndarray:
        """From each front to the stop line of the first block not granted [m]."""
        _, block = self._next_block(on)
        return self.paths.stop[block] - self._ends(on)[0]

    def _held_against(self, block: np.ndarray, on: np.ndarray) -> np.ndarray:
        """(A, M): whether a block is in conflict with a stretch that a user holds and is still on."""
        theirs = self.paths.block[self.path[on]]  # (M, C)
        until = self.paths.clear[block[:, None, None], theirs[None]]  # (A, M, C)
        return (self.granted[on] & (until > self._ends(on)[1][:, None])).any(-1)

    def _give_way(self, on: np.ndarray, free: np.ndarray, leader: np.ndarray) -> None:
        """Grant blocks: first come, first served, as far as nobody crossing is still in it.

        A block is asked for in time to brake before it, by whoever has nobody
        between itself and the line that still needs leave. Those who wait longer
        than :data:`PATIENCE` go before any who asked later; until then a stream
        that flows keeps flowing.
        """
        column, block = self._next_block(on)
        line = self._line_distance(on)
        line_of = np.full(len(self.kind), np.inf)
        line_of[on] = line
        near = line < self.speed[on] ** 2 / (2 * BRAKING) + 1.5 * self.speed[on] + 2.0
        first = (free >= line) | (leader < 0) | (line_of[leader] > line)
        asking = np.flatnonzero(near & first)
        self.asked[on[asking]] = np.minimum(self.asked[on[asking]], self.time)
        if not len(asking):
            return
        asking = asking[np.argsort(self.asked[on[asking]], kind="stable")]
        want, who = block[asking], on[asking]
        denied = self._held_against(want, on).any(1)
        met = self.paths.clear[want[:, None], want[None, :]] > -np.inf  # (A, A)
        patient = self.time - self.asked[who] > PATIENCE
        refused: list[int] = []
        for k in range(len(asking)):
            if denied[k] or any(met[k, q] for q in refused if patient[q]):
                refused.append(k)
                continue
            self.granted[who[k], column[asking[k]]] = True
            self.asked[who[k]] = np.inf
            denied |= met[:, k]

    # --- seeing and moving ------------------------------------------------------------------

    def _ends(self, on: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Arcs of front and rear [m]."""
        half = self.size[on, 0] / 2
        return self.arc[on] + half, self.arc[on] - half

    def _place(self, on: np.ndarray) -> None:
        self.point[on], self.heading[on] = self.paths.pose(self.path[on], self.arc[on])

    def _look_ahead(self, on: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Free way along each path [m], who ends it (−1: nobody) and its speed that way [m/s].

        The body, longer by its gap and a little wider, is slid along the path
        until it meets another; the last metre by bisection.
        """
        half = self.size[on, :2] / 2
        probe = half + np.stack([self.gap[on] / 2, np.full(len(on), SIDE_MARGIN)], -1)
        ahead = np.arange(0.0, HORIZON, LOOK)
        needed = self.speed[on] ** 2 / (2 * BRAKING) + 2 * self.speed[on] + 3.0

        def meets(i: np.ndarray, j: np.ndarray, distance: np.ndarray) -> np.ndarray:
            at, toward = self.paths.pose(self.path[on[i]], self.arc[on[i]] + distance)
            at = at[:, :2] + toward * (self.gap[on[i]] / 2)[:, None]
            point, heading = self.point[on[j], :2], self.heading[on[j]]
            return _overlap(at, toward, probe[i], point, heading, half[j])

        at, _ = self.paths.pose(self.path[on, None], self.arc[on, None] + ahead)  # (M, D, 3)
        apart = at[:, :, None, :2] - self.point[None, None, on, :2]  # (M, D, M, 2)
        # Circles about both bodies, the probe's centre moved by half its gap at most.
        reach = np.hypot(*probe.T)[:, None] + self.gap[on, None] / 2 + np.hypot(*half.T)
        close = apart[..., 0] ** 2 + apart[..., 1] ** 2 < (reach**2)[:, None, :]
        close &= (ahead < needed[:, None])[:, :, None]
        close[np.arange(len(on)), :, np.arange(len(on))] = False
        i, d, j = np.nonzero(close)
        hit = meets(i, j, ahead[d])
        i, d, j = i[hit], d[hit], j[hit]
        free, leader = np.full(len(on), HORIZON), np.full(len(on), -1)
        seen, where = np.unique(i, return_index=True)  # nonzero lists the nearest first
        free[seen], leader[seen] = ahead[d[where]], j[where]
        # Between the last step that was free and the first that was not.
        low, high = np.maximum(free[seen] - LOOK, 0.0), free[seen]
        for _ in range(3):
            middle = (low + high) / 2
            met = meets(seen, leader[seen], middle)
            low, high = np.where(met, low, middle), np.where(met, middle, high)
        free[seen] = low
        h = self.heading[on]
        along = h[:, 0] * h[leader, 0] + h[:, 1] * h[leader, 1]
        speed = np.where((leader >= 0) & (along > 0.7), self.speed[on][leader] * along, 0.0)
        return free, np.where(leader >= 0, on[leader], -1), speed

    def _move(self, on: np.ndarray, speed: np.ndarray, dt: float) -> None:
        """Move everybody whose way stays clear of everybody else's; the others stand.

        Users were clear of each other before, so holding back one of each pair
        that would meet, again and again, ends with nobody meeting anybody.
        """
        was_arc, was_point, was_heading = self.arc[on], self.point[on], self.heading[on]
        self.arc[on] = was_arc + speed * dt
        self._place(on)
        half = self.size[on, :2] / 2 + MARGIN / 2
        reach = np.hypot(*half.T)
        moves = speed > 0
        apart = self.point[on, None, :2] - self.point[None, on, :2]
        within = reach[:, None] + reach + 2 * dt * self.top_speed.max()  # wherever held back to
        i, j = np.nonzero(np.triu(apart[..., 0] ** 2 + apart[..., 1] ** 2 < within**2, 1))
        while True:
            point, heading = self.point[on, :2], self.heading[on]
            met = _overlap(point[i], heading[i], half[i], point[j], heading[j], half[j])
            if not met.any():
                break
            a, b = i[met], j[met]
            a_behind, b_behind = _is_ahead(point, heading, a, b), _is_ahead(point, heading, b, a)
            both = (a_behind == b_behind) | ~moves[a] | ~moves[b]
            held = np.concatenate([a[a_behind | both], b[b_behind | both]])
            speed[held], moves[held] = 0.0, False
            back = on[held]
            self.arc[back] = was_arc[held]
            self.point[back], self.heading[back] = was_point[held], was_heading[held]
        self.speed[on] = speed
        self.still[on] = np.where(speed > 0, 0.0, self.still[on] + dt)
        stuck = self.still[on] > STUCK
        self.removed += int(stuck.sum())
        self.active[on[(self.arc[on] >= self.paths.length[self.path[on]]) | stuck]] = False


def _safe_speed(free: np.ndarray, leader_speed: np.ndarray) -> np.ndarray:
    """Speed from which one stops within the free way [m] even if the leader brakes (Krauss 1998)."""
    lag = BRAKING * REACTION
    free = np.maximum(free, 0.0)
    reach = np.sqrt(lag**2 + leader_speed**2 + 2 * BRAKING * free) - lag
    return np.where(free > 0, reach, 0.0)


def _is_ahead(
    point: np.ndarray, heading: np.ndarray, a: np.ndarray, b: np.ndarray
) -> Bool[np.ndarray, " Q"]:
    """Whether b is ahead of a, as a sees it."""
    to = point[b] - point[a]
    return to[:, 0] * heading[a, 0] + to[:, 1] * heading[a, 1] > 0


def _overlap(
    point_a: np.ndarray, heading_a: np.ndarray, half_a: np.ndarray,
    point_b: np.ndarray, heading_b: np.ndarray, half_b: np.ndarray,
) -> Bool[np.ndarray, " Q"]:  # fmt: skip
    """Whether two rectangles meet: separating axes, closed form for two pairs of sides.

    Points [m], unit headings and half lengths and widths [m], each (Q, 2) or (2,).
    """
    to = point_b - point_a
    cos = np.abs(heading_a[..., 0] * heading_b[..., 0] + heading_a[..., 1] * heading_b[..., 1])
    sin = np.abs(heading_a[..., 0] * heading_b[..., 1] - heading_a[..., 1] * heading_b[..., 0])
    meet = np.ones(np.broadcast_shapes(to.shape, half_a.shape)[:-1], bool)
    for heading, half, other in ((heading_a, half_a, half_b), (heading_b, half_b, half_a)):
        along = np.abs(to[..., 0] * heading[..., 0] + to[..., 1] * heading[..., 1])
        across = np.abs(to[..., 0] * heading[..., 1] - to[..., 1] * heading[..., 0])
        meet &= along <= half[..., 0] + other[..., 0] * cos + other[..., 1] * sin
        meet &= across <= half[..., 1] + other[..., 0] * sin + other[..., 1] * cos
    return meet


def _truncated_normal(rng: np.random.Generator, count: int) -> Float[np.ndarray, " N"]:
    """Standard normal draws within ±2, the others drawn again."""
    draw = rng.standard_normal(count)
    while (outside := np.abs(draw) > 2).any():
        draw[outside] = rng.standard_normal(int(outside.sum()))
    return draw
