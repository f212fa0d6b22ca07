"""Road users that drive, walk, queue and give way along paths, step by step."""

import numpy as np
from jaxtyping import Bool, Float, Int

from inspe_jax.scene.lines import cross
from inspe_jax.scene.traffic.frames import ROAD_USERS, Mix
from inspe_jax.scene.traffic.waypoint.paths import PATH_USERS, SPACING, Paths, dot

BRAKING = 3.0  # that drivers expect of themselves and of the road user ahead [m/s²]
REACTION = 0.7  # [s]
MARGIN = 0.05  # least distance ever kept between two bodies [m]
SIDE_MARGIN = 0.04  # width added to each side when looking ahead [m]; less than MARGIN, so that
# nobody looks blocked where they stand
ENTRY_ROOM = 1.5  # free road wanted in front of and behind an arrival, at most [m]
LOOK = 1.0  # step of looking ahead, at most [m]
HORIZON = 27  # number of steps of looking ahead
PATIENCE = 8.0  # time after which the longest waiting goes first, and least time between two [s]
STUCK = 120.0  # a user that has not moved for this long [s] leaves and enters again elsewhere
WEDGED = 20.0  # the same for one that stands in a block this long [s]
TRY = 2.0  # of two that block each other, each tries to go for this long in turn [s]
ARRIVALS = 4  # most that are tried in one step


class WaypointModel:
    """Up to ``len(kind)`` users on ``paths``; ``step`` moves them all, never into each other.

    Each entry of the arrays is one user. When it leaves, another of its class enters as soon as
    there is room, with another size and path; until then it is not ``active``. ``arc`` [m] places
    its centre on ``path``; ``track`` numbers users by arrival.
    """

    def __init__(
        self, paths: Paths, kind: Int[np.ndarray, " M"], mix: Mix, rng: np.random.Generator
    ) -> None:
        many = len(kind)
        self.paths, self.rng, self.mix, self.kind = paths, rng, mix, kind
        self.mean_size = np.array([u.size for u in ROAD_USERS])[kind]  # (M, 3)
        self.top_speed = np.array([u.top_speed for u in ROAD_USERS])[kind]
        self.acceleration = np.array([u.acceleration for u in ROAD_USERS])[kind]
        self.gap = np.array([u.gap for u in ROAD_USERS])[kind]
        self.route = np.array([PATH_USERS.index(u.path) for u in ROAD_USERS])[kind]
        self.choices = [np.flatnonzero(paths.user == r) for r in range(len(PATH_USERS))]
        self.time = 0.0
        self.turn = 0.0  # when the longest waiting last had its turn [s]
        self.removed = 0  # for having been stuck
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
        """Place users at random on the paths where there is room; the others wait outside."""
        for who in range(len(self.kind)):
            self._place_at_random(who)

    def step(self, dt: float) -> None:
        """Let users in, grant right of way, and move all users for ``dt`` seconds."""
        self.time += dt
        self._let_in()
        on = np.flatnonzero(self.active)
        if not len(on):
            return
        free, leader, follows = self._look_ahead(on)
        self._give_way(on, free, leader, follows)
        line = self._line_distance(on)  # to the stop line of the next block not granted
        path, paths = self.path[on], self.paths
        pose = np.minimum((self.arc[on] / SPACING).astype(int), paths.count[path] - 1)
        most = [
            self.speed[on] + self.acceleration[on] * dt,
            self.wish[on],
            paths.limit[paths.start[path] + pose],  # that the bends ahead allow
            _safe_speed(free, self.speed[on][leader] * follows),
            _safe_speed(line, np.zeros(len(on))),
        ]
        speed = np.minimum.reduce(most)
        self._move(on, np.where(speed < 0.05, 0.0, speed), dt)

    def _place_at_random(self, who: int | np.intp) -> None:
        """Place a user where there is room and no block, if such a place is found."""
        for _ in range(20):
            self._draw(who)
            self.arc[who] = self.rng.random() * self.paths.length[self.path[who]]
            if self._has_room(who) and not self._in_block(np.array([who])).any():
                self._admit(who)
                break

    def _draw(self, who: int | np.intp) -> None:
        """Draw a new user in this entry: size, speed and path. It is at the path's start."""
        among = self.choices[self.route[who]]
        weight = self.paths.weight[among]
        self.path[who] = self.rng.choice(among, p=weight / weight.sum())
        mean = self.mix.mean_size(int(self.kind[who]), self.rng)
        size = mean * (1 + self.mix.spread * _truncated_normal(self.rng, 3))
        # A body leaves part of its lane free; otherwise neighbours could never pass.
        size[1] = min(size[1], max(self.paths.width[self.path[who]] - 0.3, 0.5))
        self.size[who] = size
        self.wish[who] = self.top_speed[who] * (0.9 + 0.05 * _truncated_normal(self.rng, 1)[0])
        self.arc[who], self.speed[who] = 0.0, 0.0

    def _has_room(self, who: int | np.intp) -> bool:
        self._place(np.array([who]))
        others = np.flatnonzero(self.active)
        if not len(others):
            return True
        own = self.size[who, :2] / 2 + [min(ENTRY_ROOM, 3 * self.gap[who]), 2 * MARGIN]
        theirs = self.point[others, :2], self.heading[others], self.size[others, :2] / 2
        return not _overlap(self.point[who, :2], self.heading[who], own, *theirs).any()

    def _in_block(self, on: np.ndarray) -> Bool[np.ndarray, " M"]:
        blocks = self.paths.block[self.path[on]]
        front, rear = (end[:, None] for end in self._ends(on))
        return ((self.paths.stop[blocks] < front) & (self.paths.leave[blocks] > rear)).any(1)

    def _admit(self, who: int | np.intp) -> None:
        blocks = self.paths.block[self.path[who]]
        self.granted[who] = self.paths.stop[blocks] < self._ends(np.array([who]))[0]
        self.active[who], self.still[who], self.asked[who] = True, 0.0, np.inf
        self.track[who] = self.arrived
        self.arrived += 1

    def _let_in(self) -> None:
        """Let in a few of the users that wait outside, each at an entry drawn at random."""
        outside = np.flatnonzero(~self.active)
        if len(outside) > ARRIVALS:
            outside = np.sort(self.rng.choice(outside, ARRIVALS, replace=False))
        for who in outside:
            self._enters(who)

    def _enters(self, who: int | np.intp) -> bool:
        """Let a user in at an entry drawn at random, if there is room; whether it came in."""
        self._draw(who)
        free = self._has_room(who) and (
            not self._in_block(np.array([who])).any() or self._first_free(who)
        )
        if free:
            self.speed[who] = self.wish[who]  # it looks ahead before it moves
            self._admit(who)
        return bool(free)

    def _first_free(self, who: int | np.intp) -> bool:
        """Whether a user may enter inside its first block, and can leave it again."""
        on = np.flatnonzero(self.active)
        first = self.paths.block[self.path[who], :1]
        away = self.point[on, :2] - self.point[who, :2]
        room = self.paths.leave[first] + self.size[who, 0] + 2.0
        near = dot(away, away) < room**2
        standing = near & (self.speed[on] < 1.0)
        return not (standing.any() or self._held_against(first, on).any())

    def _next_block(self, on: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Column and number of each user's first block that is not granted; −1 if none is left."""
        blocks = self.paths.block[self.path[on]]
        column = np.argmin(self.granted[on], axis=1)  # block -1 ends every row and is never granted
        return column, blocks[np.arange(len(on)), column]

    def _line_distance(self, on: np.ndarray) -> np.ndarray:
        """Distance from each front to the stop line of the first block that is not granted [m]."""
        _, block = self._next_block(on)
        return self.paths.stop[block] - self._ends(on)[0]

    def _held_against(self, block: np.ndarray, on: np.ndarray) -> np.ndarray:
        """(A, M): whether each block conflicts with one that each user holds and has not left."""
        theirs = self.paths.block[self.path[on]]  # (M, C)
        until = self.paths.clear[block[:, None, None], theirs[None]]  # (A, M, C)
        return (self.granted[on] & (until > self._ends(on)[1][:, None])).any(-1)

    def _pressed(self, on: np.ndarray, leader: np.ndarray) -> np.ndarray:
        """Whether each user has stood long while one of the six behind it holds a block."""
        leave = self.paths.leave[self.paths.block[self.path[on]]]
        pressing = (self.granted[on] & (leave > self._ends(on)[1][:, None])).any(1)
        pressed = np.zeros(len(on), bool)
        for _ in range(6):
            pressed[leader[(pressing | pressed) & (leader >= 0)]] = True
        return pressed & (self.still[on] > PATIENCE)

    def _give_way(
        self, on: np.ndarray, free: np.ndarray, leader: np.ndarray, follows: np.ndarray
    ) -> None:
        """Grant blocks: first to users that are further on, then first come, first served."""
        column, block = self._next_block(on)
        line = self._line_distance(on)
        line_of = np.append(line, np.inf)  # index −1, nobody ahead, reads the last entry
        # Users ask in time to brake, if nobody before the stop line still waits for a grant.
        near = line < self.speed[on] ** 2 / (2 * BRAKING) + 1.5 * self.speed[on] + 2.0
        clear = (free >= line) | (line_of[leader] > line)
        asking = np.flatnonzero(near & clear & (block >= 0))
        self.asked[on[asking]] = np.minimum(self.asked[on[asking]], self.time)
        needed = self.paths.leave[block] - self._ends(on)[1] + 0.5
        reach = free + _reach(free, line, leader, follows)
        asking = asking[reach[asking] >= needed[asking]]  # there is room to leave it again
        if not len(asking):
            return
        # Nobody in conflict with who waited too long goes before it: so streams take turns.
        asked = self.asked[on[asking]]
        longest = int(np.argmin(asked))
        due = np.zeros(len(asking), bool)
        due[longest] = self.time - max(asked[longest], self.turn) > PATIENCE
        order = np.lexsort((asked, -column[asking], ~due))
        asking, due = asking[order], due[order]
        want, who, inside = block[asking], on[asking], column[asking] > 0
        met = self.paths.clear[want[:, None], want] > -np.inf  # (A, A)
        yields = ~self._pressed(on, leader)[asking]
        denied = np.asarray(self._held_against(want, on).any(1))
        for k in range(len(asking)):
            if not denied[k]:
                self.granted[who[k], column[asking[k]]] = True
                self.asked[who[k]] = np.inf
                self.turn = self.time if due[k] else self.turn
                denied |= met[:, k]
            elif due[k] or inside[k]:  # users already inside go before users that come in
                denied |= met[:, k] & yields

    def _ends(self, on: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        half = self.size[on, 0] / 2
        return self.arc[on] + half, self.arc[on] - half

    def _place(self, on: np.ndarray) -> None:
        at = self.path[on], self.arc[on], self.size[on, 0]
        self.point[on], self.heading[on] = self.paths.chord(*at)

    def _look_ahead(self, on: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Free distance along each path [m] less the user's gap, the user that ends it, as an index
        into ``on`` or −1, and the cosine between the headings of a user and one that it follows,
        else 0."""
        # The body, slightly widened, is moved along its path until it meets another.
        half = self.size[on, :2] / 2
        probe = half + [0.0, SIDE_MARGIN]
        look = np.minimum(LOOK, self.size[on, 0])  # so that no body fits between two looks
        ahead = look[:, None] * np.arange(HORIZON)  # (M, D)
        needed = self.speed[on] ** 2 / (2 * BRAKING) + 2 * self.speed[on] + 5.0

        def meets(i: np.ndarray, j: np.ndarray, distance: np.ndarray) -> np.ndarray:
            arc = self.arc[on[i]] + distance
            at, toward = self.paths.chord(self.path[on[i]], arc, self.size[on[i], 0])
            point, heading = self.point[on[j], :2], self.heading[on[j]]
            return _overlap(at[:, :2], toward, probe[i], point, heading, half[j])

        i, d = np.nonzero(ahead < needed[:, None])  # the (L,) looks
        at = self.paths.at(self.path[on[i]], self.arc[on[i]] + ahead[i, d])  # (L, 3)
        away = at[:, None, :2] - self.point[on, :2]  # (L, M, 2)
        # Circles round both bodies; the 1 m is because in a bend the centre is off its path.
        reach = np.hypot(*probe.T)[:, None] + np.hypot(*half.T) + 1.0
        close = dot(away, away) < (reach**2)[i]
        close[np.arange(len(i)), i] = False
        k, j = np.nonzero(close)
        i, d = i[k], d[k]
        hit = meets(i, j, ahead[i, d])
        i, d, j = i[hit], d[hit], j[hit]
        free, leader = np.full(len(on), float(HORIZON)), np.full(len(on), -1)
        seen, where = np.unique(i, return_index=True)  # the nearest, which nonzero lists first
        leader[seen] = j[where]
        # Between the last free look and the first that is not free.
        high = ahead[seen, d[where]]
        low = np.maximum(high - look[seen], 0.0)
        for _ in range(3):
            middle = (low + high) / 2
            met = meets(seen, leader[seen], middle)
            low, high = np.where(met, low, middle), np.where(met, middle, high)
        free[seen] = np.maximum(low - self.gap[on[seen]], 0.0)
        along = dot(self.heading[on], self.heading[on[leader]])
        return free, leader, np.where((leader >= 0) & (along > 0.7), along, 0.0)

    def _move(self, on: np.ndarray, speed: np.ndarray, dt: float) -> None:
        """Move all users that stay clear of each other; the others stand."""
        was_arc, was_point, was_heading = self.arc[on], self.point[on], self.heading[on]
        self.arc[on] = was_arc + speed * dt
        self._place(on)
        half = self.size[on, :2] / 2 + MARGIN / 2
        reach = np.hypot(*half.T)
        moves = speed > 0
        apart = self.point[on, None, :2] - self.point[None, on, :2]
        within = reach[:, None] + reach + 2 * dt * self.top_speed.max()  # also if held back
        i, j = np.nonzero(np.triu(dot(apart, apart) < within**2, 1))
        while True:  # nobody overlapped before, so holding back one of each pair ends
            point, heading = self.point[on, :2], self.heading[on]
            met = _overlap(point[i], heading[i], half[i], point[j], heading[j], half[j])
            if not met.any():
                break
            a, b = i[met], j[met]
            to = point[b] - point[a]
            a_behind, b_behind = dot(to, heading[a]) > 0, dot(-to, heading[b]) > 0
            # Where that does not decide who is first, the two try in turn. If both were held back,
            # they would stand for ever.
            a_later = self.track[on[a]] > self.track[on[b]]
            a_last = a_later == (self.time % (2 * TRY) < TRY)
            a_waits = np.where(a_behind == b_behind, a_last, a_behind)
            both = ~moves[a] | ~moves[b]
            held = np.concatenate([a[a_waits | both], b[~a_waits | both]])
            speed[held], moves[held] = 0.0, False
            back = on[held]
            self.arc[back] = was_arc[held]
            self.point[back], self.heading[back] = was_point[held], was_heading[held]
        self.speed[on] = speed
        self.still[on] = np.where(speed > 0, 0.0, self.still[on] + dt)
        stuck = (self.still[on] > STUCK) | ((self.still[on] > WEDGED) & self._in_block(on))
        self.removed += int(stuck.sum())
        self.active[on[(self.arc[on] >= self.paths.length[self.path[on]]) | stuck]] = False


def _safe_speed(free: np.ndarray, leader_speed: np.ndarray) -> np.ndarray:
    """Speed [m/s] at which one can stop in the free distance [m] if its leader brakes (Krauss)."""
    lag = BRAKING * REACTION
    free = np.maximum(free, 0.0)
    reach = np.sqrt(lag**2 + leader_speed**2 + 2 * BRAKING * free) - lag
    return np.where(free > 0, reach, 0.0)


def _reach(
    free: np.ndarray, line: np.ndarray, leader: np.ndarray, follows: np.ndarray
) -> np.ndarray:
    """Distance that each user's leader can surely move on [m], by a chain of six; ∞ without one."""
    ahead = np.where(follows > 0, 0.0, np.inf)
    for _ in range(6):
        ahead = np.where(follows > 0, np.minimum(line, free + ahead)[leader], np.inf)
    return ahead


def _overlap(
    point_a: np.ndarray, heading_a: np.ndarray, half_a: np.ndarray,
    point_b: np.ndarray, heading_b: np.ndarray, half_b: np.ndarray,
) -> Bool[np.ndarray, " Q"]:  # fmt: skip
    """Whether two rectangles overlap, by separating axes."""
    to = point_b - point_a
    cos, sin = np.abs(dot(heading_a, heading_b)), np.abs(cross(heading_a, heading_b))
    meet = np.ones(np.broadcast_shapes(to.shape, half_a.shape)[:-1], bool)
    for heading, half, other in ((heading_a, half_a, half_b), (heading_b, half_b, half_a)):
        along, across = np.abs(dot(to, heading)), np.abs(cross(to, heading))
        meet &= along <= half[..., 0] + other[..., 0] * cos + other[..., 1] * sin
        meet &= across <= half[..., 1] + other[..., 0] * sin + other[..., 1] * cos
    return meet


def _truncated_normal(rng: np.random.Generator, count: int) -> Float[np.ndarray, " N"]:
    """Standard normal draws; those outside ±2 are drawn again."""
    draw = rng.standard_normal(count)
    while (outside := np.abs(draw) > 2).any():
        draw[outside] = rng.standard_normal(int(outside.sum()))
    return draw
