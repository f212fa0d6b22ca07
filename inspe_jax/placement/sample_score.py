"""The objective on a sample, from what each sensor alone has in view and sees.

A sensor at a pose is a row of W = V + T·V bits: f of each voxel, then f and in line of sight of
each frame and voxel. C and O are weighted unions of such rows. IG is the weighted chance that some
sensor resolves a voxel. So all three are monotone and submodular: the gain of a sensor only falls
as others are added.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float

from inspe_jax.placement.problem import Problem, Sample

KNOWN = ("coverage", "occlusion", "information_gain")
"""The metrics that are sums over the bits of a row. Others count nothing here."""
_PART = 256  # rows that are converted from bits to numbers at once


class SampleScore:
    """The score of sets of sensors on one sample of a problem.

    With ``failures`` in the objective it is the mean over the units of the score without that unit,
    which is submodular too. Two objectives are not submodular, and others stand in for them: the
    mean for the worst of several scenes, and the occlusion reference "roi" for "covered", whose
    union is weighted by itself.
    """

    def __init__(self, problem: Problem, sample: Sample) -> None:
        objective, each = problem.objective, problem.voxel_weights(sample)
        weights = objective.weights_by_name
        c, o, ig = (weights[name] for name in KNOWN)
        self.sample, self.price = sample, problem.price
        self._weight = c * each.weight
        self._free = o * each.free
        self._entropy = ig * each.entropy
        self._sighted = objective.visibility != "in_view"
        # Under "targets" and "line_of_sight", the rows count what is inside a vehicle as seen if no
        # other vehicle hides it. That is right for O; for IG such voxels are not in line of sight.
        inside = objective.occlusion_reference == "targets"
        inside &= objective.visibility == "line_of_sight"
        self._in_sight = ~(each.free > 0) if inside else np.ones(each.free.shape, bool)
        self._voxels = len(each.weight)
        everyone = range(len(problem.layout))
        # The sensors that work, in each of the failures whose mean the score is.
        self._there = [
            frozenset(everyone) - frozenset(lost)
            for lost in problem.sensor_sets[0].failures or [()]
        ]
        counts = [part.centered.heights.size for part in sample.arrays]
        reliability = [sensors.reliability for sensors in problem.sensor_sets]
        self._reliability = np.repeat(reliability, counts, 0).T

    def rows(self, f: Bool[np.ndarray, "K V"], seen: Bool[np.ndarray, "K T V"]) -> np.ndarray:
        """Bits (K, W) of K poses, from the results of :meth:`Problem.views`."""
        return np.concatenate([f, seen.reshape(len(f), -1)], 1)

    def view(self, problem: Problem, s: int, poses: Float[np.ndarray, "K 6"]) -> np.ndarray:
        """Bits (K, W) of sensor ``s`` at K poses about the scene's centre."""
        return self.rows(*problem.views(s, poses, self.sample))

    def _left(
        self, rows: Mapping[int, Bool[np.ndarray, " W"]], there: frozenset[int]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The weight not yet in view, that not yet seen, and the entropy left, by the sensors of
        ``rows`` that are in ``there``."""
        counted = [s for s in rows if s in there]
        union = np.zeros(self._voxels + self._free.size, bool)
        entropy = self._entropy
        for s in counted:
            union |= rows[s]
            entropy = entropy * (1 - self._resolved(s, rows[s]))
        weight = np.where(union[: self._voxels], 0.0, self._weight)
        return weight, np.where(union[self._voxels :], 0.0, self._free.ravel()), entropy

    def _resolved(self, s: int, row: Bool[np.ndarray, "*k W"]) -> Float[np.ndarray, "*k V"]:
        """The chance that sensor ``s`` alone resolves each voxel."""
        v = self._voxels
        if self._sighted:
            seen = row[..., v:].reshape(*row.shape[:-1], -1, v) & self._in_sight
            return seen.mean(-2) * self._reliability[s]
        return row[..., :v] * self._reliability[s]

    def value(self, rows: Mapping[int, Bool[np.ndarray, " W"]]) -> float:
        """The score of a set of sensors, given the bits of each."""
        total = self._weight.sum() + self._free.sum() + self._entropy.sum()
        left = [sum(part.sum() for part in self._left(rows, there)) for there in self._there]
        return float(total - np.mean(left) - self.price)

    def worth(self, rows: Mapping[int, Bool[np.ndarray, " W"]], s: int) -> np.ndarray:
        """What each bit (W,) of one more sensor ``s`` adds; the sum over its row is its gain."""
        worth = np.zeros(self._voxels + self._free.size)
        first, rest = worth[: self._voxels], worth[self._voxels :].reshape(self._free.shape)
        for there in self._there:
            if s not in there:
                continue
            weight, free, entropy = self._left(rows, there)
            first += weight
            rest += free.reshape(rest.shape)
            resolved = entropy * self._reliability[s]
            if self._sighted:
                rest += resolved / len(rest) * self._in_sight
            else:
                first += resolved
        return (worth / len(self._there)).astype(np.float32)

    def gains(
        self,
        rows: Mapping[int, Bool[np.ndarray, " W"]],
        added: Mapping[int, Bool[np.ndarray, "K W"]],
    ) -> Float[np.ndarray, " K"]:
        """What some more sensors add together, for K choices of all their poses."""
        gains = np.zeros(len(next(iter(added.values()))))
        for there in self._there:
            new = {s: bits for s, bits in added.items() if s in there}
            if not new:
                continue
            weight, free, entropy = self._left(rows, there)
            union = np.logical_or.reduce(list(new.values()))
            missed = np.ones((len(gains), self._voxels), np.float32)
            for s, bits in new.items():
                missed *= 1 - self._resolved(s, bits)
            gains += times(union, np.concatenate([weight, free])) + (1 - missed) @ entropy
        return gains / len(self._there)


def times(bits: Bool[np.ndarray, "K W"], worth: Float[np.ndarray, " W"]) -> np.ndarray:
    """The sums (K,) of ``worth`` over the set bits of each row."""
    worth = worth.astype(np.float32)
    parts = [bits[k : k + _PART].astype(np.float32) @ worth for k in range(0, len(bits), _PART)]
    return np.concatenate([np.zeros(0), *parts])
