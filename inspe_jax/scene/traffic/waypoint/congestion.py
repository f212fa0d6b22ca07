"""The waypoint model for places whose roads fill before everybody is there."""

import numpy as np
from jaxtyping import Float, Int

from inspe_jax.scene.traffic.frames import CLASSES, Mix
from inspe_jax.scene.traffic.waypoint.model import ARRIVALS, BRAKING, REACTION, WaypointModel
from inspe_jax.scene.traffic.waypoint.paths import PATH_USERS, Paths

SHORTEST_HEADWAY = 2.0
"""Least time between two vehicles that leave by one lane [s]: of a queue that discharges at a
signal."""
LONGEST_HEADWAY = 20.0
"""The longest such time [s], with which traffic begins. With 40 s the roads hold no more, but four
of five vehicles stand."""
CHANGE = 0.1  # share by which that time grows in a second while vehicles are missing, or shrinks
NEAR_ENOUGH = 0.97  # share of vehicles and cyclists with which none count as missing
HOLD_BACK = 3.0
"""Time [s] without an arrival after which the class with the next largest part missing may come in
too: a truck waits for its gap so long."""
MEMORY = 10.0
"""Time [s] over which the number of missing road users is averaged: people on foot come in their
place, who stay longer than a gap in the traffic does."""

WALKER = CLASSES.index("pedestrian")


class CongestedModel(WaypointModel):
    """As :class:`WaypointModel`, but each class has its share of what the roads hold.

    In the other model the shortest find a gap first, so cars take the places of trucks, and lanes
    behind the junction are nearly empty. Here the class with the largest part missing comes in
    first. Vehicles leave at intervals, which grow while vehicles are missing, so that queues stand
    behind the junction. If some are missing at the longest, more people come on foot.
    """

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
        """Distance from each front to its path's end [m]."""
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
