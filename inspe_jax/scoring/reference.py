"""The three metrics as functions of pose, in the open: every voxel, frame and sensor a number.

Margins are read softly or hard. What is fast (:mod:`inspe_jax.scoring.exact` and
:mod:`inspe_jax.scoring.soft`) is tested against this, every vehicle against every column.
"""

from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from inspe_jax.core.arrays import bucket, on_device
from inspe_jax.core.geometry import Prism, solid_top
from inspe_jax.core.numerics import EXACT, Groups, Softness, Width, leave_one_out, step
from inspe_jax.scoring import metrics
from inspe_jax.sensing.layout import Layout
from inspe_jax.sensing.rays import Kind, RayTable
from inspe_jax.sensing.sensors import RayGrid, longer
from inspe_jax.visibility.centered_scene import CenteredScene
from inspe_jax.visibility.in_view import TOGETHER, view_margins
from inspe_jax.visibility.shadows import sight


class SceneArrays(NamedTuple):
    """What is scored: the scene's arrays, or a sample of them.

    ``weight`` (V,) of the voxels' regions; ``occupancy`` (V,) is p̂, or None to take it from the
    frames of ``ground``.
    """

    ground: CenteredScene
    weight: Float[Array, " V"]
    occupancy: Float[Array, " V"] | None = None


class SensorSet(NamedTuple):
    """The sensors' fixed side: ``groups`` of one ray grid, ``reliability`` (S,), and the
    ``failures``, groups of sensors that are left out in turn."""

    groups: tuple[tuple[RayGrid, tuple[int, ...]], ...]
    reliability: tuple[float, ...]
    failures: tuple[tuple[int, ...], ...] = ()

    @classmethod
    def of(cls, layout: Layout, failures: tuple[tuple[int, ...], ...] = ()) -> "SensorSet":
        """The sensors of a layout."""
        return cls(layout.groups(), tuple(layout.reliability.tolist()), failures)


SENSORS = 4
"""Sensors that there is room for, at least."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SensorArray:
    """The sensors' fixed side as arrays: what is compiled serves other sensors of these kinds.

    There is room for S sensors, the first ones being those of a :class:`SensorSet`. ``kind`` (S,)
    is the number of each one's kind among ``kinds``; where it is none of them, there is no sensor.
    ``table`` are the numbers of each one's grid of rays.
    """

    table: RayTable
    kind: Int[Array | np.ndarray, " S"]
    reliability: Float[Array | np.ndarray, " S"]
    failures: Groups | None
    kinds: tuple[Kind, ...] = field(metadata={"static": True})

    def filled(self, poses: Float[Array | np.ndarray, "s 6"]) -> Any:
        """Poses of the sensors, and the first one's again where there is none; traced or not."""
        return filled_up(poses, len(self.kind))


@partial(jax.custom_vjp, nondiff_argnums=(1,))
def filled_up(rows: Float[Array | np.ndarray, "s n"], count: int) -> Any:
    """So many rows, the first one repeated at the end.

    A function of its own, with a slope of its own, to be worked out in NumPy unless it is traced:
    else a program would be compiled for every number of rows.
    """
    if isinstance(rows, jax.core.Tracer):
        return jnp.concatenate([rows, jnp.repeat(rows[:1], count - len(rows), 0)])
    rows = np.asarray(rows)
    return np.concatenate([rows, np.repeat(rows[:1], count - len(rows), 0)])


def _filled_up_forward(rows: Any, count: int) -> tuple[Any, Any]:
    return filled_up(rows, count), np.zeros(len(rows), bool)


def _filled_up_backward(count: int, kept: Any, slope: Any) -> tuple[Any]:
    number = len(kept)
    if isinstance(slope, jax.core.Tracer):
        return (slope[:number].at[0].add(slope[number:].sum(0)),)
    slope = np.array(slope)
    slope[0] += slope[number:].sum(0)
    return (on_device(slope[:number]),)


filled_up.defvjp(_filled_up_forward, _filled_up_backward)


@lru_cache(maxsize=64)
def sensor_array(crew: SensorSet, spare: int = 0) -> SensorArray:
    """The arrays of a crew, with room for ``spare`` sensors more at least."""
    kinds = tuple(sorted({grid.kind for grid, _ in crew.groups}, key=lambda kind: kind.name))
    grids = {s: grid for grid, index in crew.groups for s in index}
    count, room = len(grids), bucket(len(grids) + spare, SENSORS)
    tables = [grids[min(s, count - 1)].table for s in range(room)]
    lengths = [max(len(table[k]) for table in tables) for k in range(2)]
    tables = [
        table._replace(
            rows=longer(table.rows, lengths[0]), nearest=longer(table.nearest, lengths[1])
        )
        for table in tables
    ]
    kind = [kinds.index(grids[s].kind) for s in range(count)] + [len(kinds)] * (room - count)
    reliability = np.pad(np.array(crew.reliability, float), (0, room - count))
    each = len(crew.failures) == count
    groups = room if each else bucket(len(crew.failures), SENSORS)
    return SensorArray(
        RayTable(*(np.stack(column) for column in zip(*tables, strict=True))),
        np.array(kind, np.int32),
        reliability,
        Groups.of_rows(crew.failures, room, groups),
        kinds,
    )


class MetricValues(NamedTuple):
    """Every metric by name: of all sensors in row 0, of all but failure g in row 1 + g.

    ``column_coverage`` and ``level_coverage`` are the shares in view of each column's and of each
    level's voxels; ``seen_share`` is the share of frames and levels in which each column is seen;
    ``entropy`` is H(Ω), what there is to gain.
    """

    values: dict[str, Float[Array, " 1+G"]]
    column_coverage: Float[Array, " L"]
    level_coverage: Float[Array, " Z"]
    entropy: Float[Array, ""]
    seen_share: Float[Array, " L"]

    def of_scene(self, place: Any, failures: int) -> "MetricValues":
        """These of arrays that are filled up, as they are of a scene: its columns, so many rows."""
        if not isinstance(self.column_coverage, jax.core.Tracer):
            place, self = jax.tree.map(np.asarray, (place, self))
        rows = slice(1 + failures)
        return self._replace(
            values={name: value[rows] for name, value in self.values.items()},
            column_coverage=self.column_coverage[place],
            seen_share=self.seen_share[place],
        )


def measure(
    field: SceneArrays,
    poses: Float[Array, "S 6"],
    crew: SensorSet,
    voxel: float,
    softness: Softness = EXACT,
    *,
    occlusion_reference: str = "roi",
    visibility: str = "in_view",
) -> MetricValues:
    """The three metrics as functions of pose (about the scene's centre), in the paper's order.

    ``voxel`` is the edge of a voxel [m]. Differentiable in the poses where ``softness`` is not 0.
    """
    ground = field.ground
    in_field, on_ray = view_margins(poses, ground.centers, crew.groups, voxel / 2)
    f = step(in_field, softness.field) * step(on_ray, softness.ray)  # (S, V)
    failures = Groups.of_rows(crew.failures, len(poses))
    seen = accumulate_frames(
        ground,
        poses[:, :3],
        f,
        softness.shadow,
        failures=failures,
        reference=occlusion_reference,
        visibility=visibility,
    )
    occupancy = seen.occupancy if field.occupancy is None else field.occupancy
    q = f * (seen.sight_share * jnp.asarray(crew.reliability, float)[:, None])
    covered, resolved = leave_one_out(f, failures), leave_one_out(q, failures)
    remaining, total = metrics.entropy_terms(resolved, occupancy)
    by_column = covered[0].reshape(ground.heights.shape)
    return MetricValues(
        dict(
            coverage=metrics.coverage(covered, field.weight),
            occlusion=seen.occlusion,
            information_gain=metrics.information_gain(remaining, total),
        ),
        column_coverage=by_column.mean(1),
        level_coverage=by_column.mean(0),
        entropy=total,
        seen_share=seen.seen_share.reshape(ground.heights.shape).mean(1),
    )


class FrameSums(NamedTuple):
    """What :func:`accumulate_frames` gathers over the frames; row 0 is all sensors, 1 + g all but a
    failure."""

    occlusion: Float[Array, " 1+G"]
    occupancy: Float[Array, " V"]
    seen_share: Float[Array, " V"]
    sight_share: Float[Array, "S V"]


BLOCK = 1024
"""Columns watched at a time: what they need stays in a core's cache through all frames."""


def ignores_self_occlusion(reference: str, visibility: str) -> bool:
    """Whether what is asked for is hidden by other vehicles alone, where it is inside one."""
    return reference == "targets" or visibility == "past_others"


@partial(jax.jit, static_argnames=("reference", "visibility"))
def accumulate_frames(
    ground: CenteredScene,
    sensors: Float[Array, "S 3"],
    f: Float[Array, "S V"],
    width: Width = None,
    *,
    failures: Groups | None,
    reference: str,
    visibility: str,
) -> FrameSums:
    """Go through the frames once for each block of columns.

    Gives O, the occupancy p̂, and the share of frames in which each voxel is
    seen; unless ``visibility`` is ``in_view`` also that in which each sensor has each voxel in
    line of sight, else 1.
    """
    share_sight = visibility != "in_view"
    (length, levels), frames = ground.heights.shape, len(ground.prisms.top)

    def block(part: tuple[Array, ...]) -> tuple[tuple, tuple]:
        there, columns, heights, f = part  # (C, 1), (C, 2), (C, Z), (C, S, Z)
        f = f.swapaxes(0, 1)  # (S, C, Z)
        flat = (len(sensors), -1)
        covered = leave_one_out(f.reshape(flat), failures)

        @jax.checkpoint  # kept for the gradient, every frame's sight lines would not fit in memory
        def look(prisms: Prism) -> tuple[tuple, tuple]:
            solid = there * step(solid_top(columns, prisms)[:, None] - heights)
            clear = line = sight(sensors, prisms, columns, heights, width)
            if ignores_self_occlusion(reference, visibility):
                others = sight(sensors, prisms, columns, heights, width, ignore_self_occlusion=True)
                clear = jnp.where(solid[None] > 0, others, line)
            visible = leave_one_out((f * clear).reshape(flat), failures)
            free, inside = (there - solid).ravel(), solid.ravel()
            terms = metrics.occlusion_terms(visible, covered, free, inside, reference)
            in_sight = clear if visibility == "past_others" else line
            share = in_sight.reshape(flat) if share_sight else jnp.ones(())
            return (inside, visible[0] * free, share), terms

        def some(sums: tuple, prisms: Prism) -> tuple[tuple, tuple]:
            gathered, terms = jax.vmap(look)(prisms)
            return jax.tree.map(lambda x, new: x + new.sum(0), sums, gathered), terms

        zeros = jnp.zeros_like(covered[0])
        start = (zeros, zeros, jnp.zeros(f.shape).reshape(flat) if share_sight else jnp.zeros(()))
        return jax.lax.scan(some, start, prisms)

    # Frames that are gone through together, if that is little: XLA's loops are slow.
    few = TOGETHER // (len(sensors) * min(length, BLOCK) * levels)
    together = max(n for n in range(1, frames + 1) if frames % n == 0 and n <= max(few, 1))
    split = frames // together, together
    prisms = jax.tree.map(lambda x: x.reshape(*split, *x.shape[1:]), ground.prisms)

    def blocks(x: Array) -> Array:
        """(L, …) as (N, C, …), padded with zeros."""
        count = -(-length // BLOCK)
        size = -(-length // count)
        x = jnp.pad(x, [(0, count * size - length)] + [(0, 0)] * (x.ndim - 1))
        return x.reshape(count, size, *x.shape[1:])

    by_column = f.reshape(-1, length, levels).swapaxes(0, 1)
    parts = (jnp.ones((length, 1)), ground.columns, ground.heights, by_column)
    sums, terms = jax.lax.map(block, tuple(map(blocks, parts)))
    # (T, 1 + G), over the blocks
    seen, original = (term.sum(0).reshape(frames, -1) for term in terms)
    occupancy, seen_share = (s.reshape(-1)[: length * levels] / frames for s in sums[:2])
    sight_share = jnp.ones_like(f)
    if share_sight:
        total = sums[2].swapaxes(0, 1).reshape(len(sensors), -1)  # (S, N·C·Z)
        sight_share = total[:, : length * levels] / frames
    return FrameSums(metrics.occlusion(seen, original), occupancy, seen_share, sight_share)
