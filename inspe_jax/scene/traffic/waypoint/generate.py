"""Traffic from the paper's waypoint model, also where roads fill before everybody is there."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from inspe_jax.core.errors import InspeError
from inspe_jax.scene.intersection import Intersection
from inspe_jax.scene.traffic import frames as traffic
from inspe_jax.scene.traffic.frames import CLASSES, MIXES, ROAD_USERS, Mix, Snapshot, TrafficFrames
from inspe_jax.scene.traffic.waypoint.model import ARRIVALS, BRAKING, REACTION, WaypointModel
from inspe_jax.scene.traffic.waypoint.paths import PATH_USERS, Paths, lay_paths, with_walkways

WARM_UP = 40.0  # time [s] that the model runs before the first frame
CONGESTED_WARM_UP = 60.0  # the same where the roads fill: queues form behind the junction
WATCHED = 20.0  # last part of the warm-up [s], over which road users are counted
MISSING, CLASS_MISSING = (0.05, 2.0), (0.3, 1.5)
"""Roads do not hold all if this share is missing, and this many; and the same of any class."""
STEP = 0.2  # longest step of the model [s]
SHORTEST_HEADWAY = 2.0  # least time between two vehicles that leave by one lane, as at signals [s]
LONGEST_HEADWAY = 20.0  # the most, at the beginning [s]; with 40 s four of five vehicles stand
CHANGE = 0.1  # share by which that time grows in a second while vehicles are missing, or shrinks
NEAR_ENOUGH = 0.97  # share of vehicles and cyclists with which none count as missing
HOLD_BACK = 3.0  # time without an arrival after which the class next in need may come in too [s]
MEMORY = 10.0  # time over which the missing are averaged [s]; people on foot come in their place
WALKER = CLASSES.index("pedestrian")


def waypoint_traffic(
    intersection: Intersection,
    *,
    radius: float,
    count: int,
    frames: int,
    mix: str = "mixed",
    step: float = 1.0,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> TrafficFrames:
    """Traffic on the waypoints of an intersection's routes (paper, section 4).

    There are about ``count`` objects at a time within ``radius`` [m] of the centre, in ``frames``
    frames ``step`` seconds apart. ``mix`` is a key of :data:`MIXES`. Unlike in the paper, road
    users never overlap: they keep their distance, slow down for bends and give way. Where roads do
    not hold all, traffic is that of :class:`CongestedModel`; where nobody walks on the map, people
    walk as in :func:`~inspe_jax.scene.traffic.waypoint.paths.with_walkways`. ``progress`` is called
    with (frames done, frames). The same seed gives the same traffic; turning the intersection turns
    it. Raises InspeError if a value is out of range, the mix is unknown, or no route lies within
    the radius.
    """
    traffic.check_traffic(radius=radius, count=count, frames=frames, mix=mix, step=step, seed=seed)
    walked = MIXES[mix].shares[WALKER] > 0
    place = with_walkways(intersection, radius) if walked else intersection
    paths = lay_paths(place, radius)
    has_path = [bool((paths.user == PATH_USERS.index(u.path)).any()) for u in ROAD_USERS]
    # Cyclists ride only where there are pedestrians too, so not on motorways.
    has_path[CLASSES.index("cyclist")] &= has_path[WALKER]
    numbers = traffic.quota(MIXES[mix], has_path, count)
    kind = np.repeat(np.arange(len(CLASSES), dtype=np.int8), numbers)
    if len(kind) < count:
        raise InspeError(
            f"{intersection.name}: no route within {radius:g} m of the centre for mix '{mix}'"
        )
    model = _warmed_up(paths, kind, mix, seed)
    seen = []
    for frame in range(frames):
        if frame:
            _advance(model, step)
        seen.append(_snapshot(model).within(intersection.center, radius))
        if progress is not None:
            progress(frame + 1, frames)
    return traffic.pack_frames(seen, step)


def _warmed_up(paths: Paths, kind: np.ndarray, mix: str, seed: int) -> WaypointModel:
    """A model after its warm-up: of free roads, or of congested ones if those do not hold all."""
    rng = np.random.default_rng(seed)
    model = WaypointModel(paths, rng.permutation(kind), MIXES[mix], rng)
    model.fill()
    _advance(model, WARM_UP - WATCHED)
    wanted = np.bincount(kind, minlength=len(CLASSES))
    missing = wanted - _advance(model, WATCHED)
    each = np.maximum(CLASS_MISSING[0] * wanted, CLASS_MISSING[1])
    if (missing < each).all() and missing.sum() < max(MISSING[0] * wanted.sum(), MISSING[1]):
        return model
    rng = np.random.default_rng(seed)
    full = CongestedModel(paths, rng.permutation(kind), MIXES[mix], rng)
    full.fill()
    _advance(full, CONGESTED_WARM_UP)
    return full


def _advance(model: WaypointModel, time: float) -> Float[np.ndarray, " K"]:
    """Run a model for some time [s]; the mean number of road users there by class."""
    steps = int(np.ceil(time / STEP - 1e-9))
    there = np.zeros(len(CLASSES))
    for _ in range(steps):
        model.step(time / steps)
        there += np.bincount(model.kind[model.active], minlength=len(CLASSES))
    return there / max(steps, 1)


def _snapshot(model: WaypointModel) -> Snapshot:
    on = np.flatnonzero(model.active)
    middle = model.point[on].copy()
    middle[:, 2] += model.size[on, 2] / 2
    heading, size = model.heading[on], model.size[on].copy()
    velocity = np.column_stack([heading * model.speed[on, None], np.zeros(len(on))])
    yaw = np.arctan2(heading[:, 1], heading[:, 0])
    return Snapshot(middle, yaw, size, model.kind[on], model.track[on], velocity)


class CongestedModel(WaypointModel):
    """As :class:`WaypointModel`, but the class with the largest part missing comes in first.
    Vehicles leave at intervals, which grow while vehicles are missing, so queues stand behind the
    junction; at the longest, more people come on foot."""

    def __init__(
        self, paths: Paths, kind: Int[np.ndarray, " M"], mix: Mix, rng: np.random.Generator
    ) -> None:
        spare = np.full(len(kind) if WALKER in kind else 0, WALKER, kind.dtype)
        super().__init__(paths, np.concatenate([kind, spare]), mix, rng)
        self.asked_for = len(kind)
        self.is_spare = np.arange(len(self.kind)) >= len(kind)
        self.quota = np.bincount(kind, minlength=len(CLASSES))
        self.walks = self.route == PATH_USERS.index("pedestrian")
        self.missing = 0.0
        self.came = np.zeros(2)  # when somebody last came in by road, on foot [s]
        self.headway = LONGEST_HEADWAY  # of vehicles that leave by one lane [s]
        self.exit = _exits(paths)
        self.opens = np.zeros(self.exit.max() + 1)  # when the next may leave by each lane [s]
        self.may_leave = np.zeros(len(self.kind), bool)

    def fill(self) -> None:
        """As :meth:`WaypointModel.fill`, the longest first, because they fit last."""
        for who in np.argsort(-self.mean_size[:, 0], kind="stable"):
            if not self.is_spare[who]:
                self._place_at_random(who)

    def step(self, dt: float) -> None:
        """As :meth:`WaypointModel.step`, with queues behind the junction."""
        by_road = ~self.walks
        short = self.active[by_road].sum() < NEAR_ENOUGH * by_road.sum()
        change = 1 + CHANGE * dt if short else 1 - CHANGE * dt
        self.headway = float(np.clip(self.headway * change, SHORTEST_HEADWAY, LONGEST_HEADWAY))
        missing = self.asked_for - (self.active & ~self.is_spare).sum()
        self.missing += (missing - self.missing) * min(dt / MEMORY, 1.0)
        self._let_out()
        super().step(dt)

    def _admit(self, who: int | np.intp) -> None:
        super()._admit(who)
        self.may_leave[who] = False

    def _let_in(self) -> None:
        """Let in one by road and one on foot at most, of the class with the most missing."""
        spare = (self.active & self.is_spare).sum() < self.missing - 1.0
        spare &= self.headway >= LONGEST_HEADWAY
        there = np.bincount(self.kind[self.active], minlength=len(self.quota))
        # Sainte-Laguë's rule: the part of its quota that each class has with half a user more.
        part = (there + 0.5) / np.maximum(self.quota, 1)
        for on_foot in (0, 1):
            waiting = ~self.active & (self.walks == on_foot) & (~self.is_spare | spare)
            if not waiting.any():
                continue
            classes = np.unique(self.kind[waiting])
            classes = classes[np.argsort(part[classes], kind="stable")]
            others = int((self.time - self.came[on_foot]) / HOLD_BACK)
            among = np.flatnonzero(waiting & np.isin(self.kind, classes[: 1 + others]))
            tried = np.sort(self.rng.choice(among, min(ARRIVALS, len(among)), replace=False))
            for who in tried[np.argsort(part[self.kind[tried]], kind="stable")]:
                if self._enters(who):
                    self.came[on_foot] = self.time
                    break

    def _let_out(self) -> None:
        """Let the first vehicle before each lane's end leave, a headway after the one before."""
        away = self._way_out()
        near = away < self.speed**2 / (2 * BRAKING) + (REACTION + 0.5) * self.speed + 2.0
        exits = self.exit[self.path]
        asks = self.active & (exits >= 0) & ~self.may_leave & near
        asks &= self.opens[exits] <= self.time
        asking = np.flatnonzero(asks)
        asking = asking[np.argsort(away[asking], kind="stable")]
        lane, first = np.unique(exits[asking], return_index=True)
        self.may_leave[asking[first]] = True
        self.opens[lane] = self.time + self.headway

    def _way_out(self) -> Float[np.ndarray, " M"]:
        return self.paths.length[self.path] - self.arc - self.size[:, 0] / 2

    def _line_distance(self, on: np.ndarray) -> np.ndarray:
        line = super()._line_distance(on)
        waits = (self.exit[self.path[on]] >= 0) & ~self.may_leave[on]
        return np.where(waits, np.minimum(line, self._way_out()[on]), line)


def _exits(paths: Paths) -> Int[np.ndarray, " P"]:
    """The number of the lane by which each vehicle's path leaves; −1 for the other paths."""
    last = paths.point[paths.start + paths.count - 1, :2]
    found = np.full(len(last), -1)
    for path in np.flatnonzero(paths.user == PATH_USERS.index("vehicle")):
        away = np.hypot(*(last[found >= 0] - last[path]).T)
        same = found[found >= 0][away < 1.0]
        found[path] = same[0] if len(same) else found.max() + 1
    return found
