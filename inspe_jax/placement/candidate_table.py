"""Candidate poses for every sensor, and what a sensor sees of one sample from each."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from inspe_jax.placement.candidates import FRAMES, lattice, of_unit, poses, set_heights
from inspe_jax.placement.problem import Problem
from inspe_jax.placement.sampled_objective import (
    Rows,
    SampledObjective,
    SampledRows,
    joined,
    rows_at,
)
from inspe_jax.sensing.layout import UNIT_HEIGHT

HEIGHTS, YAWS = 3, 8
"""Usual number of heights, and that of yaws, of candidates at each foot."""
CHUNK = 128
"""Number of candidates in one step."""
AS_IT_IS = -1
"""In place of a candidate: as the sensor stands. All sensors of a unit do, or none."""
Picks = dict[int, int]
"""The candidate of each placed sensor, or :data:`AS_IT_IS`."""


@dataclass(eq=False)
class CandidateKind:
    """Sensors with the same K candidate poses, each on a ``foot`` (index), and what they see."""

    sensors: tuple[int, ...]
    foot: Int[np.ndarray, " K"]
    height: Float[np.ndarray, " K"]
    yaw: Float[np.ndarray, " K"]
    pitch: Float[np.ndarray, " K"]
    lens: Float[np.ndarray, " K"]
    rows: list[Rows] = field(default_factory=list)

    @property
    def parts(self) -> int:
        """Number of chunks of candidates."""
        return -(-len(self.foot) // CHUNK)

    @property
    def looked(self) -> int:
        """Number of candidates that were looked at."""
        return min(len(self.rows) * CHUNK, len(self.foot))

    def row(self, k: int) -> Rows:
        """What is seen from candidate ``k``."""
        return rows_at(self.rows[k // CHUNK], k % CHUNK)


@dataclass(eq=False)
class Table:
    """The candidates of every kind of sensor, on one sample. ``own`` are the rows of sensors that
    may stay as they are, ``paid`` what the objective pays for each unit's present pole."""

    problem: Problem
    sampled: SampledObjective
    feet: Float[np.ndarray, "F 2"]
    stand: Bool[np.ndarray, "U F"]
    kinds: list[CandidateKind]
    own: dict[int, Rows] = field(default_factory=dict)
    paid: Float[np.ndarray, " U"] = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def of(
        cls,
        problem: Problem,
        rng: np.random.Generator,
        columns: int,
        heights: int,
        first: bool = True,
    ) -> "Table":
        """Feet × heights × yaws × pitches on a new sample; if not ``first``, shifted at random."""
        space, layout = problem.space, problem.layout
        sampled = SampledObjective(problem, problem.sample(rng, columns, FRAMES))
        feet = lattice(space)
        stand = space.can_stand(feet)
        shift = np.array([0.5, 0.0, 0.5]) if first else rng.uniform(size=3)
        bounds, pitches = space.limits
        groups: dict[object, list[int]] = {}
        for s, sensor in enumerate(layout.sensors):
            usual = sensor.spec.with_lens(0.0)
            grids = tuple(case.conditions.spec(usual).grid for case in problem.cases)
            sector = space.constraints.yaw.get(sensor.name)
            key = (grids, usual.lens_limits, sector, *bounds[s].round(3), *pitches[s].round(3))
            groups.setdefault(key, []).append(s)
        kinds = []
        for sensors in groups.values():
            s = sensors[0]
            at = np.flatnonzero(stand[[layout.sensors[t].unit for t in sensors]].any(0))
            steps = _steps(problem, s, bounds[s], heights, pitches[s], shift)
            product = np.meshgrid(at, *steps, indexing="ij")
            # In random order, so that the first chunk is a sample of all.
            order = rng.permutation(product[0].size)
            foot, height, yaw, pitch = (part.ravel()[order] for part in product)
            low, high = layout.sensors[s].spec.lens_limits
            lens = rng.uniform(low, high, len(foot)) if low < high else np.zeros(len(foot))
            kinds.append(CandidateKind(tuple(sensors), foot, height, yaw, pitch, lens))
        return cls(problem, sampled, feet, stand, kinds)

    @cached_property
    def price(self) -> Float[np.ndarray, "U F"]:
        """What the objective pays for each unit's pole at each foot."""
        feet = np.repeat(self.feet[:, None], len(self.stand), 1)
        return self.problem.objective.pole_price * self.problem.space.new_poles(feet).T

    @property
    def parts(self) -> list[CandidateKind]:
        """The kind of each chunk of candidates. The first chunks of all kinds come first."""
        first = [kind for kind in self.kinds if kind.parts]
        return first + [kind for kind in self.kinds for _ in range(kind.parts - 1)]

    def look(self, part: int) -> int:
        """Find what is seen from the candidates of one chunk; returns their number."""
        kind = self.parts[part]
        at = np.arange(len(kind.rows) * CHUNK, (len(kind.rows) + 1) * CHUNK)
        at = np.minimum(at, len(kind.foot) - 1)  # of one shape: the last fills up
        s = kind.sensors[0]
        space, u = self.problem.space, self.problem.layout.sensors[s].unit
        index = space.index
        x = np.zeros((CHUNK, space.size))
        x[:, index.base[u]] = self.feet[kind.foot[at]]
        x[:, index.height[u]] = kind.height[at]
        x[:, index.yaw[s]] = kind.yaw[at]
        x[:, index.pitch[s]] = kind.pitch[at]
        x[:, index.lens[s]] = kind.lens[at]
        kind.rows.append(self.sampled.views({s: poses(space, x)[:, s]})[s])
        return len(np.unique(at))

    def kind_of(self, s: int) -> CandidateKind:
        """The candidates of sensor ``s``."""
        return next(kind for kind in self.kinds if s in kind.sensors)

    def rows(self, picks: Picks) -> dict[int, Rows]:
        """What each placed sensor sees."""
        return {
            s: self.own[s] if k == AS_IT_IS else self.kind_of(s).row(k) for s, k in picks.items()
        }

    def scores(self, rows: SampledRows, at: Sequence[tuple[int, int]]) -> Float[np.ndarray, " n"]:
        """The scores beside ``rows`` with sensor s at candidate k for each (s, k), less poles."""
        new = joined([rows_at(self.kind_of(s).row(k), None) for s, k in at])
        paid = [self.share(s)[self.kind_of(s).foot[k]] for s, k in at]
        return self.sampled.scores(rows, np.array(at)[:, :1], [new]) - np.array(paid)

    def scores_of_all(
        self, rows: SampledRows, sensors: Sequence[int]
    ) -> dict[int, Float[np.ndarray, " K"]]:
        """The same of some sensors of a unit, each at all of its candidates."""
        found = dict[int, Float[np.ndarray, " K"]]()
        for s in self.one_of_each(sensors):
            kind, at = self.kind_of(s), np.full((CHUNK, 1), s)
            scores = np.concatenate([self.sampled.scores(rows, at, [part]) for part in kind.rows])
            scores = scores[: kind.looked] - self.share(s)[kind.foot[: kind.looked]]
            found |= {t: scores for group in self.alike if s in group for t in group}
        return {s: found[s] for s in sensors}

    @cached_property
    def alike(self) -> list[list[int]]:
        """Sensors of one kind that are as reliable as each other and pay as much for poles."""
        groups: dict[object, list[int]] = {}
        for number, kind in enumerate(self.kinds):
            for s in kind.sensors:
                reliability = (of.reliability[s] for of in self.problem.sensor_sets)
                key = (number, *reliability, self.share(s).tobytes())
                groups.setdefault(key, []).append(s)
        return list(groups.values())

    def one_of_each(self, sensors: Sequence[int]) -> list[int]:
        """The first of some sensors of a unit in each group of those that are :attr:`alike`."""
        firsts = ([s for s in group if s in sensors][:1] for group in self.alike)
        return [s for first in firsts for s in first]

    def share(self, s: int) -> Float[np.ndarray, " F"]:
        """What sensor ``s`` pays for its unit's pole at each foot, as much as the unit's others."""
        u = self.problem.layout.sensors[s].unit
        return self.price[u] / len(self.problem.layout.members()[u])

    def value(self, picks: Picks, u: int) -> float:
        """The score of sensors at the picks, without what unit ``u`` pays for its pole."""
        s = self.problem.layout.members()[u][0]
        k = picks[s]
        paid = self.paid[u] if k == AS_IT_IS else self.price[u, self.kind_of(s).foot[k]]
        return self.sampled.value(self.rows(picks)) - paid

    def fits(self, picks: Picks, s: int, k: Int[np.ndarray, " n"] | int) -> np.ndarray:
        """Whether sensor ``s`` may be at candidates ``k``, beside the sensors already placed."""
        kind, (foot, low, high) = self.kind_of(s), self.mast(picks, s)
        height = kind.height[k]
        here = self.stand[self.problem.layout.sensors[s].unit][kind.foot[k]]
        near = (height >= high - UNIT_HEIGHT) & (height <= low + UNIT_HEIGHT)
        return here & near & ((foot < 0) | (kind.foot[k] == foot))

    def mast(self, picks: Picks, s: int) -> tuple[int, float, float]:
        """Foot of the sensor's unit, or −1, and the lowest and highest of its other sensors [m]."""
        sensors = self.problem.layout.sensors
        others = [t for t in picks if t != s and sensors[t].unit == sensors[s].unit]
        kinds = [(self.kind_of(t), picks[t]) for t in others]
        heights = [float(kind.height[k]) for kind, k in kinds]
        foot = int(kinds[0][0].foot[kinds[0][1]]) if kinds else -1
        return foot, min(heights, default=np.inf), max(heights, default=-np.inf)

    def layout(self, x: Float[np.ndarray, " N"], picks: Picks) -> Float[np.ndarray, " N"]:
        """Coordinates (N,) with sensors at the picks; the others stay as in ``x``."""
        space, index, stay = self.problem.space, self.problem.space.index, list[int]()
        given, x = np.asarray(x), np.array(x)[None]
        for u, members in enumerate(self.problem.layout.members()):
            placed = [s for s in members if picks.get(s, AS_IT_IS) != AS_IT_IS]
            if len(placed) < len(members):
                stay.append(u)
                continue
            kinds = [(self.kind_of(s), picks[s]) for s in members]
            x[:, index.base[u]] = self.feet[kinds[0][0].foot[kinds[0][1]]]
            x[:, index.arm[u]] = 0.0
            x[:, index.offset[list(members)]] = 0.0
            x[:, index.yaw[list(members)]] = [kind.yaw[k] for kind, k in kinds]
            x[:, index.pitch[list(members)]] = [kind.pitch[k] for kind, k in kinds]
            x[:, index.lens[list(members)]] = [kind.lens[k] for kind, k in kinds]
            x = set_heights(space, x, u, members, np.array([[kind.height[k] for kind, k in kinds]]))
        for u in stay:  # to the bit: projections round
            own = of_unit(space, u)
            x[0, own] = given[own]
        return x[0]


def _steps(
    problem: Problem,
    s: int,
    bounds: Float[np.ndarray, "2"],
    heights: int,
    pitches: Float[np.ndarray, "2"],
    shift: Float[np.ndarray, "3"],
) -> tuple[Float[np.ndarray, " h"], Float[np.ndarray, " y"], Float[np.ndarray, " p"]]:
    """Heights, yaws and pitches of a sensor's candidates, between its lowest and highest."""
    sensor = problem.layout.sensors[s]
    low, high = bounds
    sector = problem.space.constraints.yaw.get(sensor.name)
    # All directions of a LiDAR that looks all round are one.
    yaws = 1 if sensor.spec.grid.wraps and sector is None else YAWS
    height = low + (high - low) * (np.arange(heights) + shift[0]) / heights
    begin, end = sector or (0.0, 2 * np.pi)
    yaw = begin + (end - begin) * (np.arange(yaws) + shift[1]) / yaws
    down = np.radians(np.array(sensor.spec.candidate_pitches_deg) + 10 * (shift[2] - 0.5))
    return height, yaw, np.unique(np.clip(down, *pitches))
