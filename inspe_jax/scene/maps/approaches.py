"""Approaches: the ends of roads at a junction, and how they pair into arms."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from inspe_jax.scene.intersection import Arm

# Kinds of lane, in OpenDRIVE's words.
TRAVEL = {"driving", "entry", "exit", "onRamp", "offRamp", "connectingRamp", "bus", "taxi", "HOV"}
TRAVEL |= {"mwyEntry", "mwyExit"}
CARRIAGEWAY = TRAVEL | {"bidirectional", "parking", "biking", "stop", "restricted", "roadWorks"}
SHOULDER = {"shoulder", "border", "curb"}
SIDEWALK = {"sidewalk", "walking"}


@dataclass(frozen=True, eq=False)
class Approach:
    """The end of a road at a junction, as a cut across the road.

    Offsets along the cut run to the left, looking away from the junction [m].
    """

    road: int
    end: str  # 'start' or 'end' of the road
    origin: Float[np.ndarray, "2"]
    outward: float  # heading away from the junction at the cut
    bearing: float  # the same over the first 15 m, which a flare does not turn
    lanes: tuple[tuple[int, str, float, float, bool], ...]  # id, type, from, to, inbound

    @classmethod
    def across(
        cls, road: int, end: str, origin: np.ndarray, forward: np.ndarray, bearing: float,
        lanes: Iterable[tuple[int, str, np.ndarray, float, bool]],
    ) -> "Approach":  # fmt: skip
        """A cut across a road at ``origin``, looking along the unit vector ``forward``, from its
        ``lanes``: id, type, middle (2,) [m], width [m] and inbound."""
        left = np.array([-forward[1], forward[0]])
        cut = []
        for lane, kind, middle, width, inbound in lanes:
            offset = float((middle - origin) @ left)
            cut.append((lane, kind, offset - width / 2, offset + width / 2, inbound))
        return cls(road, end, origin, heading(forward), bearing, tuple(cut))

    def point(self, offset: float) -> np.ndarray:
        """The point of the cut at an offset to the left (2,)."""
        return self.origin + offset * np.array([-np.sin(self.outward), np.cos(self.outward)])

    @property
    def kerbs(self) -> tuple[float, float]:
        """Offsets of the carriageway's right and left edge."""
        lanes = [lane for lane in self.lanes if lane[1] in CARRIAGEWAY]
        return min(lane[2] for lane in lanes), max(lane[3] for lane in lanes)

    @property
    def edges(self) -> tuple[float, float]:
        """Offsets of the whole road's right and left edge."""
        return min(lane[2] for lane in self.lanes), max(lane[3] for lane in self.lanes)

    @property
    def one_way(self) -> int:
        """+1 if all lanes lead in, −1 if all lead out, 0 otherwise."""
        ways = {lane[4] for lane in self.lanes if lane[1] in TRAVEL}
        return {frozenset([True]): 1, frozenset([False]): -1}.get(frozenset(ways), 0)

    def lane_range(self, kinds: set[str], side: int) -> tuple[float, float] | None:
        """Inner and outer offset of the lanes of some kinds beyond the left (+1) or right (−1)
        kerb; None if there are none."""
        kerb = self.kerbs[1] if side > 0 else self.kerbs[0]
        beyond = [x for x in self.lanes if x[1] in kinds and side * ((x[2] + x[3]) / 2 - kerb) > 0]
        if not beyond:
            return None
        low, high = min(x[2] for x in beyond), max(x[3] for x in beyond)
        return (low, high) if side > 0 else (high, low)


def heading(vector: np.ndarray) -> float:
    """The heading of a vector (2,) [rad]."""
    return float(np.arctan2(vector[1], vector[0]))


def arms_of(approaches: list[Approach]) -> tuple[tuple[Arm, ...], dict[tuple[int, str], int]]:
    """The arms of a junction, counter-clockwise by bearing, and the arm of each (road, end).

    Each approach is an arm; but where a divided road leads in on one approach and out on another,
    the two are one arm.
    """
    groups = [[approach] for approach in approaches]
    for i, approach in enumerate(approaches):
        partners = [
            other
            for other in approaches[i + 1 :]
            if approach.one_way * other.one_way == -1
            and np.cos(approach.bearing - other.bearing) > np.cos(np.radians(40))
            and _gap(approach, other) <= 20.0
        ]
        free = [p for p in partners if [p] in groups and [approach] in groups]
        if free:
            partner = min(free, key=lambda other: _gap(approach, other))
            groups.remove([approach])
            groups[groups.index([partner])].append(approach)
    made = sorted(((_arm(g), g) for g in groups), key=lambda x: x[0].bearing)
    return (
        tuple(arm for arm, _ in made),
        {(approach.road, approach.end): i for i, (_, g) in enumerate(made) for approach in g},
    )


def _gap(a: Approach, b: Approach) -> float:
    """Distance between the nearest kerbs of two approaches [m]."""
    return min(float(np.hypot(*(a.point(s) - b.point(t)))) for s in a.kerbs for t in b.kerbs)


def _arm(group: list[Approach]) -> Arm:
    along = np.sum([[np.cos(g.bearing), np.sin(g.bearing)] for g in group], axis=0)
    bearing = heading(along)
    axes = np.array([[np.cos(bearing), np.sin(bearing)], [-np.sin(bearing), np.cos(bearing)]])
    kerbs = np.array([axes @ g.point(k) for g in group for k in g.kerbs])  # (2 or 4, 2)
    low, high = kerbs[:, 1].min(), kerbs[:, 1].max()
    x, y = np.array([kerbs[:, 0].mean(), (low + high) / 2]) @ axes
    return Arm((float(x), float(y)), bearing, float(high - low))
