"""The objective on a sample, from what each sensor alone has in view, sees and finds.

What a sensor has from a pose is a row, :class:`Rows`. C and O are weighted unions of its bits. IG
is the weighted chance that some sensor resolves a voxel, and D that some sensor finds a road user,
1 − ∏(1 − p). So all four are monotone and submodular: the gain of a sensor only falls as others
are added. What one more sensor adds to D is Σ w·∏(1 − p)·p', with the product over the others: no
factor exceeds 1.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import islice

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from inspe_jax.core.parallel import Job, run
from inspe_jax.placement.candidate_views import FOUND, Rows, view_jobs
from inspe_jax.placement.problem import Problem, Sample
from inspe_jax.scoring import metrics
from inspe_jax.scoring.detection import detection_curves
from inspe_jax.sensing.sensors import RayGrid

PAPER = ("coverage", "occlusion", "information_gain")
KNOWN = (*PAPER, FOUND)
"""The metrics that are sums over a row. Others count nothing here."""
LEAST = 1e-6
"""A gain that is smaller is rounding."""
_PART = 256  # rows that are converted from bits to numbers at once


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class MarginalWeights:
    """What each bit of the row of one more sensor adds, and each chance."""

    bits: Float[np.ndarray, "F V"]
    chance: Float[np.ndarray, "Q L"]

    def dot(self, rows: Rows) -> Float[np.ndarray, " K"]:
        """The marginal gains (K,) of rows: the sums over their set bits and of their chances."""
        value, bits = self.bits.astype(np.float32).ravel(), rows.bits.reshape(len(rows), -1)
        parts = [bits[k : k + _PART].astype(np.float32) @ value for k in range(0, len(bits), _PART)]
        finds = rows.chance.reshape(len(rows), -1) @ self.chance.ravel()
        return np.concatenate([np.zeros(0), *parts]) + finds


SampledRows = Mapping[int, Rows]
"""The row of each of some sensors."""


class SampleScore:
    """The score of sets of sensors on one sample of a problem.

    With ``failures`` in the objective it is the mean over the units of the score without that unit,
    which is submodular too. Two objectives are not submodular, and others stand in for them: the
    mean for the worst of several scenes, and the occlusion reference "roi" for "covered", whose
    union is weighted by itself.
    """

    def __init__(self, problem: Problem, sample: Sample) -> None:
        objective = problem.objective
        c, o, ig, d = (objective.weights_by_name[name] for name in KNOWN)
        weight, free, entropy, places = _shares(problem, sample)
        self.problem, self.sample = problem, sample
        self._weights = np.concatenate([c * weight[None], o * free])
        self._entropy = ig * entropy
        classes = len((problem.asked.detection or detection_curves()).counted)
        self._places = np.tile(d * places / classes, (classes if d else 0, 1))
        self._sighted = objective.visibility != "in_view"
        # Under "targets" and "line_of_sight", the rows count what is inside a vehicle as seen if no
        # other vehicle hides it. That is right for O; for IG such voxels are not in line of sight.
        inside = objective.occlusion_reference == "targets"
        inside &= objective.visibility == "line_of_sight"
        self._in_sight = ~(free > 0) if inside else np.ones(free.shape, bool)
        everyone = frozenset(range(len(problem.layout)))
        # The sensors that work, in each of the failures whose mean the score is.
        self._there = [everyone - {*lost} for lost in problem.sensor_sets[0].failures or [()]]
        counts = [part.centered.heights.size for part in sample.arrays]
        reliability = [sensors.reliability for sensors in problem.sensor_sets]
        self._reliability = np.repeat(reliability, counts, 0).T

    def views(self, poses: Mapping[int, Float[np.ndarray, "K 6"]]) -> dict[int, Rows]:
        """The rows of some sensors of the layout, each at K poses about the scene's centre."""
        problem = self.problem
        jobs, wanted = list[Job](), list[tuple[list[int], int]]()
        for case, tiled, sensor_set in zip(
            problem.cases, self.sample.scenes, problem.sensor_sets, strict=True
        ):
            alike: dict[tuple[RayGrid, float], list[int]] = {}
            for grid, index in sensor_set.groups:
                for s in index:
                    if s in poses:
                        alike.setdefault((grid, sensor_set.pixels[s]), []).append(s)
            for (grid, pixels), sensors in alike.items():
                at = np.concatenate([poses[s] for s in sensors])
                half = case.scene.voxels.size / 2
                new = view_jobs(grid, half, at, tiled, problem.asked, pixels)
                wanted.append((sensors, len(new)))
                jobs += new
        done, found = iter(run(jobs)), dict[int, list[Rows]]()
        for sensors, count in wanted:
            rows, first = Rows.joined(list(islice(done, count))), 0
            for s in sensors:
                found.setdefault(s, []).append(rows[first : first + len(poses[s])])
                first += len(poses[s])
        return {s: Rows.joined(parts, -1) for s, parts in found.items()}

    def _left(
        self, rows: SampledRows, there: frozenset[int]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The weight of bits not yet set, the entropy left, and the weight of road users not found,
        by the sensors of ``rows`` that are in ``there``."""
        union = np.zeros(self._weights.shape, bool)
        entropy, missed = self._entropy, self._places
        for s in (s for s in rows if s in there):
            union |= rows[s].bits
            entropy = entropy * (1 - self._resolved(s, rows[s].bits))
            missed = missed * (1 - rows[s].chance)
        return np.where(union, 0.0, self._weights), entropy, missed

    def _resolved(self, s: int, bits: Bool[np.ndarray, "*k F V"]) -> Float[np.ndarray, "*k V"]:
        """The chance that sensor ``s`` alone resolves each voxel."""
        if self._sighted:
            return (bits[..., 1:, :] & self._in_sight).mean(-2) * self._reliability[s]
        return bits[..., 0, :] * self._reliability[s]

    def value(self, rows: SampledRows) -> float:
        """The score of a set of sensors, given the row of each."""
        total = sum(x.sum() for x in (self._weights, self._entropy, self._places))
        left = [sum(part.sum() for part in self._left(rows, there)) for there in self._there]
        return float(total - np.mean(left))

    def marginal(self, rows: SampledRows, s: int) -> MarginalWeights:
        """What each part of the row of one more sensor ``s`` adds beside the others."""
        bits, finds = np.zeros(self._weights.shape), np.zeros(self._places.shape)
        for there in self._there:
            if s not in there:
                continue
            weights, entropy, missed = self._left(rows, there)
            bits += weights
            finds += missed
            resolved = entropy * self._reliability[s]
            if self._sighted:
                bits[1:] += resolved / len(self._in_sight) * self._in_sight
            else:
                bits[0] += resolved
        count = len(self._there)
        return MarginalWeights(*((x / count).astype(np.float32) for x in (bits, finds)))

    def gains(self, rows: SampledRows, added: SampledRows) -> Float[np.ndarray, " K"]:
        """What some more sensors add together, for K choices of all their poses."""
        gains = np.zeros(len(next(iter(added.values()))))
        for there in self._there:
            new = {s: bits for s, bits in added.items() if s in there}
            if not new:
                continue
            weights, entropy, unfound = self._left(rows, there)
            union = np.logical_or.reduce([more.bits for more in new.values()])
            missed = np.ones((len(gains), len(entropy)), np.float32)
            for s, more in new.items():
                missed *= 1 - self._resolved(s, more.bits)
            finds = 1 - np.prod([1 - more.chance for more in new.values()], 0)
            alone = MarginalWeights(weights, unfound).dot(Rows(union, finds))
            gains += alone + (1 - missed) @ entropy
        return gains / len(self._there)


def _shares(problem: Problem, sample: Sample) -> Iterator[np.ndarray]:
    """What each voxel of a sample counts for in C (V,), O (T, V) and IG (V,), and each column for
    every class of road users alike in D (L,). Each sums to 1. Several cases stand one after
    another."""
    parts = []
    for part, tiled in zip(sample.arrays, sample.scenes, strict=True):
        (chunk,) = tiled.chunks
        solid = tiled.tiles.by_voxel(np.asarray(chunk.solid).swapaxes(0, 1))  # (T, V)
        reference = problem.options["occlusion_reference"]
        free = metrics.counted_by_occlusion(~solid, solid, reference).astype(float)
        if part.centered.inside is not None:
            free *= ~np.asarray(part.centered.inside).ravel()
        weight, entropy = np.asarray(part.weight, float), np.asarray(part.occupancy, float)
        entropy = np.asarray(metrics.entropy(jnp.asarray(entropy, float)), float)
        frames = np.maximum((free.sum(1) > 0).sum(), 1)  # those in which any voxel counts
        free = free / np.maximum(free.sum(1, keepdims=True), 1e-9) / frames
        places = weight[:: tiled.tiles.level_count]
        entropy = entropy / max(entropy.sum(), 1e-9)
        parts.append((weight / weight.sum(), free, entropy, places / places.sum()))
    return (np.concatenate(each, axis=-1) / len(parts) for each in zip(*parts, strict=True))
