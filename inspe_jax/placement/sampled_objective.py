"""The objective on a sample, of sensors whose views are found one by one: given each sensor's
:class:`Rows`, the metrics' own code scores any set of them without geometry."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from itertools import islice
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Num, UInt

from inspe_jax.core.arrays import on_device, on_host
from inspe_jax.core.parallel import Job, jit_job, parts_of, run, shapes_of
from inspe_jax.placement.objective import COMBINATIONS
from inspe_jax.placement.problem import Problem, Sample, ScoreTerms, scores
from inspe_jax.scoring.accumulate import count_tile, seen_by_sensor
from inspe_jax.scoring.detection import detection_curves
from inspe_jax.scoring.driver import MetricValues, readings_of_tile, summarise_readings
from inspe_jax.scoring.metric import TileEvidence
from inspe_jax.scoring.options import ScoreOptions
from inspe_jax.scoring.reading import BITS, PRECOMPUTED, Frames
from inspe_jax.scoring.target_evidence import TargetEvidence, target_evidence_of_sensor
from inspe_jax.scoring.tiled_scene import TiledScene, WorkChunk
from inspe_jax.sensing.ray_grid import RayGrid
from inspe_jax.sensing.rays import Rays
from inspe_jax.sensing.sensor_array import SensorArray
from inspe_jax.visibility import bitmask
from inspe_jax.visibility.centered_scene import Statics
from inspe_jax.visibility.statics import past_statics_masks
from inspe_jax.visibility.tiles import Tile, zeros_of
from inspe_jax.visibility.view_masks import view_masks

LEAST = 1e-6
"""A gain that is smaller is rounding."""
TOGETHER = 8
"""Poses in one compiled call. With one shape for any number of poses, results are the same bits."""
SETS = 8
"""Sets of sensors that one compiled call scores."""


class SceneRows(NamedTuple):
    """What one sensor has of a sample of one scene: N slabs of levels, C columns, T frames.

    ``view`` and ``seen`` are masks of voxels in view, and seen in each frame; ``sights`` counts the
    frames with each voxel in line of sight, and ``targets`` is what the sensor has on road users,
    both None unless a metric asks. ``pose`` is about the centre. Zeros are no sensor's.
    """

    pose: Float[Array, "*k 6"]
    view: UInt[Array, "*k N C"]
    seen: UInt[Array, "*k N T C"]
    sights: Num[Array, "*k N C Z"] | None
    targets: TargetEvidence | None


Rows = tuple[SceneRows, ...]
"""What one sensor has of the samples of all cases: a row, or a row for each of K poses."""
SampledRows = Mapping[int, Rows]
"""The row of each of some sensors."""


def rows_at(rows: Rows, at: Any) -> Rows:
    """One of K rows, or some of them."""
    return jax.tree.map(lambda leaf: leaf[at], rows)


def joined(parts: Sequence[Rows]) -> Rows:
    """The rows of all parts, those of further poses."""
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def view_jobs(
    grid: RayGrid,
    half: float,
    poses: Float[Array | np.ndarray, "K 6"],
    tiled: TiledScene,
    options: ScoreOptions,
    pixels: float = 1.0,
) -> list[Job]:
    """Jobs for the :class:`SceneRows` of one sensor, each of :data:`TOGETHER` of its K poses about
    the centre; the last pose fills up. ``half`` is half a voxel's edge [m], ``tiled`` a scene in
    one chunk, ``pixels`` the number that a ray stands for."""
    (chunk,) = tiled.chunks
    assert chunk.solid is not None  # the scene has masks
    rays = grid.rays
    lengths = rays.table.rows.shape + rays.table.nearest.shape
    targets = options.target_fields if any(metric.targets for metric in options.metrics) else ()
    kept = any(metric.sight and not metric.targets for metric in options.metrics)
    kept |= options.visibility != "in_view"
    # Metrics do not change what is seen: without them fewer programs are compiled.
    options = options.counted._replace(detection=options.detection if targets else None)
    shapes = chunk.solid.shape, chunk.prisms.top.shape, tiled.statics and tiled.statics.shapes
    key = (_view, grid.kind, lengths, *shapes, tiled.tiles.slabs, options, targets, kept)
    fixed: dict[str, Any] = dict(
        chunk=chunk, statics=tiled.statics, last=tiled.tiles.last, options=options
    )
    fixed |= dict(slabs=tiled.tiles.slabs, targets=targets, kept=kept)

    def rows(part: np.ndarray) -> SceneRows:
        return jax.tree.map(np.asarray, _view(rays, half, pixels, part, **fixed))

    return [(key, partial(rows, part)) for part in parts_of(on_host(poses, float), TOGETHER)]


@partial(jit_job, static_argnames=("options", "slabs", "targets", "kept"))
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
    slabs: int,
    targets: tuple[str, ...],
    kept: bool,
) -> SceneRows:
    """The rows of K poses, with ``targets`` of road users; ``kept``: with numbers of frames."""
    curves = options.detection or detection_curves()

    def view_from(pose: Array) -> SceneRows:
        views = view_masks(rays, pose, chunk.tile, half)
        past = ~jnp.zeros_like(views)
        if statics is not None:
            past = past_statics_masks(pose[:3], statics, chunk.tile, views)
            views &= past
        shadows = jax.tree.map(lambda leaf: leaf[0], BITS.shadows(pose[None, :3], chunk.prisms))

        def see_tile(part: tuple[Tile, Array, Array, Array, Array]) -> Any:
            tile, view, past, solid, last = part
            row, frames = (pose[:3], shadows, view), Frames(chunk.prisms, solid)
            seen, in_sight, _ = seen_by_sensor(BITS, row, tile, frames, options)
            if not options.sight:
                return seen, None, None
            sights = BITS.level_sums(in_sight, len(tile.heights))  # (C, Z)
            if statics is not None:
                there = bitmask.chances(past, len(tile.heights)).T
                sights = sights * there.astype(sights.dtype)
            if not targets:
                return seen, sights, None
            share = sights.T.astype(tile.heights.dtype) / len(chunk.prisms.top)
            at = rays, pixels, pose, tile, share, last, None, curves
            return seen, sights if kept else None, target_evidence_of_sensor(*at).only(targets)

        found = jax.lax.map(
            lambda part: jax.lax.cond(
                (part[1] != 0).any(), see_tile, partial(zeros_of, see_tile), part
            ),
            (chunk.tile, views, past, chunk.solid, last),
        )
        beside = partial(_side_by_side, slabs=slabs)
        seen, sights, on_targets = found
        on_targets = jax.tree.map(lambda leaf: beside(leaf, axis=leaf.ndim - 1), on_targets)
        sights = None if sights is None else beside(sights, axis=1)
        return SceneRows(pose, beside(views, axis=1), beside(seen, axis=2), sights, on_targets)

    return jax.lax.map(view_from, poses)


def _side_by_side(found: Any, slabs: int, axis: int) -> Any:
    """Arrays (N, …, C, …) of tiles as (slabs, …, N/slabs · C, …); ``axis`` is C's."""
    each = found.reshape(slabs, -1, *found.shape[1:])
    each = each.transpose(0, *range(2, axis + 1), 1, *range(axis + 1, each.ndim))
    return each.reshape(*each.shape[:axis], -1, *each.shape[axis + 2 :])


# ── Scores of sets ──────────────────────────────────────────────────────────


def one_tile_a_slab(tiled: TiledScene) -> TiledScene:
    """A sample in one chunk with one tile for each slab of levels: rows need no culling."""
    tiles, (chunk,), slabs = tiled.tiles, tiled.chunks, tiled.tiles.slabs
    old: Any = jax.tree.map(np.asarray, tiles.tile)
    names = ("columns", "heights", "ground", "there", "cells")
    each = ((name, getattr(old, name)) for name in names)
    tile = old._replace(
        **{name: _side_by_side(x, slabs, x.ndim - 1) for name, x in each},
        center=np.zeros((slabs, 2), old.low.dtype),
        radius=np.full(slabs, np.inf, old.low.dtype),
        low=old.low.reshape(slabs, -1).min(1),
        high=old.high.reshape(slabs, -1).max(1),
        motion=None,  # what sensors have on road users is in their rows
    )
    chunk = replace(chunk, tile=tile, solid=_side_by_side(np.asarray(chunk.solid), slabs, 2))
    none: Any = np.zeros(0, int)
    whole = replace(
        tiled,
        tiles=replace(tiles, tile=tile, place=None),
        chunks=(chunk,),
        occupancy=_side_by_side(tiled.tile_occupancy.swapaxes(1, 2), slabs, 2),
        column=none,
        level=none,
        statics=None,
    )
    return jax.tree.map(on_device, whole)


def measure_rows(
    tiled: TiledScene, rows: SceneRows, sensors: SensorArray, options: ScoreOptions
) -> MetricValues:
    """The metrics of S sensors from the row of each, on a sample of one tile a slab."""
    (chunk,), whole = tiled.chunks, tiled.tiles.slabs == 1

    def read_tile(part: tuple[Tile, Array, Array, tuple]) -> Any:
        tile, last, solid, (view, seen, sights, targets) = part
        given, frames = (rows.pose[:, :3], (seen, sights), view), Frames(chunk.prisms, solid)
        counts = count_tile(PRECOMPUTED, tile, given, frames, sensors.failures, options)
        of_sensors = view, sights, tiled.frame_count, rows.pose, sensors
        at = TileEvidence(PRECOMPUTED, tile, *of_sensors, last, whole, options.detection, targets)
        return readings_of_tile(at, counts, options)

    by_tile = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 1, 0), rows[1:])
    found = jax.lax.map(read_tile, (chunk.tile, tiled.tiles.last, chunk.solid, by_tile))
    return summarise_readings(found, tiled, sensors.failures, None, options)


@partial(jit_job, static_argnames=("options", "over"))
def set_scores(
    fixed: tuple[SceneRows, ...],
    at: Int[Array, "K n"],
    choices: tuple[SceneRows, ...],
    scenes: tuple[TiledScene, ...],
    terms: ScoreTerms,
    *,
    options: ScoreOptions,
    over: str,
) -> Float[Array, " K"]:
    """Combined scores of K sets: ``fixed`` rows, but ``choices`` (K, n) for the sensors ``at``."""

    def score(chosen: tuple[Array, tuple[SceneRows, ...]]) -> Array:
        rows = jax.tree.map(lambda every, new: every.at[chosen[0]].set(new), fixed, chosen[1])
        each = zip(scenes, rows, terms.sensors, strict=True)
        measures = [measure_rows(*of, options) for of in each]
        return COMBINATIONS[over][0](scores(measures, terms.weights, terms.failures))

    return jax.lax.map(score, (at, choices))


class SampledObjective:
    """The objective of sets of sensors on one sample of a problem, without what poles cost."""

    def __init__(self, problem: Problem, sample: Sample) -> None:
        self.problem, self.sample = problem, sample
        self._nobody: Any = None  # a row of zeros

    @cached_property
    def _scenes(self) -> tuple[TiledScene, ...]:
        return tuple(one_tile_a_slab(tiled) for tiled in self.sample.scenes)

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
        done, found = iter(run(jobs)), dict[int, list[SceneRows]]()
        for sensors, count in wanted:
            rows, first = joined([(of,) for of in islice(done, count)]), 0
            for s in sensors:
                found.setdefault(s, []).extend(rows_at(rows, slice(first, first + len(poses[s]))))
                first += len(poses[s])
        if self._nobody is None:
            some = tuple(next(iter(found.values())))
            self._nobody = jax.tree.map(lambda leaf: np.zeros_like(leaf[0]), some)
        return {s: tuple(parts) for s, parts in found.items()}

    def scores(
        self, rows: SampledRows, at: Int[np.ndarray, "K n"], choices: Sequence[Rows]
    ) -> Float[np.ndarray, " K"]:
        """The scores of K sets: the sensors of ``rows``, and in set k the sensors ``at[k]``, of
        which the i-th has row k of ``choices[i]``. One that is no number counts as the worst."""
        problem, scenes = self.problem, self._scenes
        places = range(len(problem.terms.sensors[0].kind))
        fixed = _stacked([rows.get(s, self._nobody) for s in places])
        given = _stacked(choices, 1)
        how = dict(options=problem.options, over=problem.objective.over)
        kinds = tuple(sensors.kinds for sensors in problem.terms.sensors)
        shapes = shapes_of(scenes, fixed, problem.terms)
        key = (set_scores, *how.values(), kinds, at.shape[1], shapes)
        jobs: list[Job] = []
        for first in range(0, len(at), SETS):
            index = np.minimum(np.arange(first, first + SETS), len(at) - 1)
            part = fixed, at[index].astype(np.int32), rows_at(given, index), scenes, problem.terms
            jobs.append((key, partial(set_scores, *part, **how)))
        found = np.concatenate(run(jobs))[: len(at)].astype(float)
        return np.where(np.isnan(found), -np.inf, found)

    def value(self, rows: SampledRows) -> float:
        """The score of a set of sensors, given the row of each."""
        s, own = next(iter(rows.items()), (0, self._nobody))
        return float(self.scores(rows, np.array([[s]]), [rows_at(own, None)])[0])


def _stacked(rows: Sequence[Rows], axis: int = 0) -> Rows:
    return jax.tree.map(lambda *leaves: np.stack(leaves, axis), *rows)
