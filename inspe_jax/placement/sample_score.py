"""The objective on a sample, from what each sensor alone has in view, sees and finds.

What a sensor has from a pose is a row, :class:`Rows`. C and O are weighted unions of its bits. IG
is the weighted chance that some sensor resolves a voxel, and D that some sensor finds a road user,
1 − ∏(1 − p). So all four are monotone and submodular: the gain of a sensor only falls as others
are added. What one more sensor adds to D is Σ w·∏(1 − p)·p', with the product over the others: no
factor exceeds 1.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt

from inspe_jax.core.arrays import on_host
from inspe_jax.core.parallel import Job, parts_of, run
from inspe_jax.placement.problem import Problem, Sample
from inspe_jax.scoring import metrics
from inspe_jax.scoring.accumulate import seen_by_sensor
from inspe_jax.scoring.detection import detection_curves
from inspe_jax.scoring.options import ScoreOptions
from inspe_jax.scoring.reading import BITS, Frames
from inspe_jax.scoring.target_evidence import target_evidence_of_sensor
from inspe_jax.scoring.tiled_scene import TiledScene, WorkChunk
from inspe_jax.sensing.rays import Rays
from inspe_jax.sensing.sensors import RayGrid
from inspe_jax.visibility import bitmask
from inspe_jax.visibility.centered_scene import Statics
from inspe_jax.visibility.statics import past_statics_masks
from inspe_jax.visibility.tiles import Tile, zeros_of
from inspe_jax.visibility.view_masks import view_masks

FOUND = "detectability"
"""The metric whose chances are found with the views."""
KNOWN = ("coverage", "occlusion", "information_gain", FOUND)
"""The metrics that are sums over a row. Others count nothing here."""
LEAST = 1e-6
"""A gain that is smaller is rounding."""
TOGETHER = 8
"""Poses in one compiled call. With one shape for any number of poses, results are the same bits."""
_PART = 256  # rows that are converted from bits to numbers at once


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class Rows:
    """What one sensor has of a sample: a row, or a row for each of K poses.

    ``bits`` (K, 1 + T, V) are f of each voxel, then f and line of sight in each frame. ``chance``
    (K, Q, L) is that to find a road user of each of Q classes at each column; Q is 0 where it is
    not asked for.
    """

    bits: Bool[np.ndarray, "*k F V"]
    chance: Float[np.ndarray, "*k Q L"]

    @classmethod
    def joined(cls, parts: Sequence["Rows"], axis: int = 0) -> "Rows":
        """The rows of all parts: of further poses or, along axis −1, of further scenes."""
        if len(parts) == 1:
            return parts[0]
        bits, chance = [part.bits for part in parts], [part.chance for part in parts]
        return cls(np.concatenate(bits, axis), np.concatenate(chance, axis))

    def __getitem__(self, at: Any) -> "Rows":
        return Rows(self.bits[at], self.chance[at])

    def __len__(self) -> int:
        return len(self.bits)


def view_jobs(
    grid: RayGrid,
    half: float,
    poses: Float[Array | np.ndarray, "K 6"],
    tiled: TiledScene,
    options: ScoreOptions,
    pixels: float = 1.0,
) -> list[Job]:
    """Jobs for what one sensor has in view, and sees in each frame, from each of K poses.

    Each gives the rows of :data:`TOGETHER` poses; after the last pose, it is repeated.
    ``poses`` are about the scene's centre, ``half`` is half a voxel's edge [m], and ``tiled`` is a
    scene in one chunk. ``pixels`` is the number of pixels that a ray stands for. The chances to
    find road users are of a sensor alone, as in detectability, if ``options`` has that metric.
    """
    (chunk,) = tiled.chunks
    assert chunk.solid is not None  # the scene has masks
    rays = grid.rays
    lengths = rays.table.rows.shape + rays.table.nearest.shape
    found = tuple(metric for metric in options.metrics if metric.name == FOUND)
    # Other metrics do not change what is seen: without them fewer programs are compiled.
    options = options._replace(metrics=found, detection=options.detection if found else None)
    shapes = chunk.solid.shape, chunk.prisms.top.shape, tiled.statics and tiled.statics.shapes
    key = (_view, grid.kind, lengths, *shapes, options)
    fixed = dict(chunk=chunk, statics=tiled.statics, last=tiled.tiles.last, options=options)

    def rows(part: np.ndarray) -> Rows:
        """What :func:`_view` returns, in the scene's order of voxels and of columns."""
        view, seen, chance = map(np.asarray, _view(rays, half, pixels, part, **fixed))
        tiles, (count, number, classes, columns) = tiled.tiles, chance.shape
        found = chance.reshape(count, tiles.slabs, number // tiles.slabs, classes, columns)
        found = found.sum(1).swapaxes(1, 2).reshape(count, classes, number // tiles.slabs * columns)
        found = found[..., np.asarray(tiles.place)].astype(np.float32)
        bits = [tiles.by_voxel(view)[:, None], tiles.by_voxel(seen)]
        return Rows(np.concatenate(bits, 1), found)

    return [(key, partial(rows, part)) for part in parts_of(on_host(poses, float), TOGETHER)]


@partial(jax.jit, static_argnames="options")
def _view(
    rays: Rays,
    half: Float[Array, ""],
    pixels: Float[Array, ""],
    poses: Float[Array, "K 6"],
    *,
    chunk: WorkChunk,
    statics: Statics | None,
    last: Bool[Array, " N"],
    options: ScoreOptions,
) -> tuple[UInt[Array, "K N C"], UInt[Array, "K T N C"], Float[Array, "K N Q C"]]:
    """Views, what is seen in frames, and chances of Q classes; Q is 0 unless they are asked for."""
    curves = options.detection or detection_curves()

    def view_from(pose: Array) -> tuple[Array, Array, Array]:
        views = view_masks(rays, pose, chunk.tile, half)
        past = ~jnp.zeros_like(views)
        if statics is not None:
            past = past_statics_masks(pose[:3], statics, chunk.tile, views)
            views &= past
        shadows = jax.tree.map(lambda leaf: leaf[0], BITS.shadows(pose[None, :3], chunk.prisms))

        def see_tile(part: tuple[Tile, Array, Array, Array, Array]) -> tuple[Array, Array]:
            tile, view, past, solid, last = part
            row, frames = (pose[:3], shadows, view), Frames(chunk.prisms, solid)
            seen, in_sight, _ = seen_by_sensor(BITS, row, tile, frames, options)
            if not options.metrics:
                return seen, jnp.zeros((0, len(view)), tile.heights.dtype)
            number = BITS.level_sums(in_sight, len(tile.heights)).T
            sight = number.astype(tile.heights.dtype) / len(chunk.prisms.top)
            if statics is not None:
                sight *= bitmask.chances(past, len(tile.heights)).astype(sight.dtype)
            at = rays, pixels, pose, tile, sight, last, None, curves
            return seen, target_evidence_of_sensor(*at).chance

        seen, chance = jax.lax.map(
            lambda part: jax.lax.cond(
                (part[1] != 0).any(), see_tile, partial(zeros_of, see_tile), part
            ),
            (chunk.tile, views, past, chunk.solid, last),
        )
        return views, seen.swapaxes(0, 1), chance

    return jax.lax.map(view_from, poses)


# ── Scores from rows ──────────────────────────────────────────────────────────


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
        classes = len((problem.options.detection or detection_curves()).counted)
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
                new = view_jobs(grid, half, at, tiled, problem.options, pixels)
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
    every class of road users alike in D (L,), case after case. Each sums to 1."""
    parts = []
    for part, tiled in zip(sample.arrays, sample.scenes, strict=True):
        (chunk,) = tiled.chunks
        solid = tiled.tiles.by_voxel(np.asarray(chunk.solid).swapaxes(0, 1))  # (T, V)
        reference = problem.readings["occlusion_reference"]
        free = metrics.counted_by_occlusion(~solid, solid, reference).astype(float)
        if part.centered.inside is not None:
            free *= ~np.asarray(part.centered.inside).ravel()
        weight, entropy = np.asarray(part.weight, float), np.asarray(part.occupancy, float)
        entropy = np.asarray(metrics.entropy(on_host(entropy)), float)
        frames = np.maximum((free.sum(1) > 0).sum(), 1)  # those in which any voxel counts
        free = free / np.maximum(free.sum(1, keepdims=True), 1e-9) / frames
        places = weight[:: tiled.tiles.level_count]
        entropy = entropy / max(entropy.sum(), 1e-9)
        parts.append((weight / weight.sum(), free, entropy, places / places.sum()))
    return (np.concatenate(each, axis=-1) / len(parts) for each in zip(*parts, strict=True))
