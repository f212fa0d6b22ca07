"""The metrics in the open, as an oracle: every voxel, frame and sensor a number.

Every vehicle against every column, nothing left out and nothing packed into bits. The package's own
scores go tile by tile and share what they can; they are tested against this.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from inspe_jax.core.geometry import Prism, solid_top
from inspe_jax.core.numerics import Groups, Softness, Width, exact, leave_one_out, step
from inspe_jax.scoring import metrics
from inspe_jax.scoring.sensor_array import SensorSet
from inspe_jax.scoring.summary import MetricValues
from inspe_jax.scoring.tiled_scene import SceneArrays
from inspe_jax.sensing.sensors import RayGrid
from inspe_jax.visibility import bitmask
from inspe_jax.visibility.centered_scene import CenteredScene
from inspe_jax.visibility.in_view import TOGETHER, density_view, in_view_margins, transform_of
from inspe_jax.visibility.shadows import shadow_ceilings, soft_sight


def occlusion_terms(visible, covered, free, solid, reference):
    """(|V_orig| − |V_occ|, |V_orig|) of one frame: sums over the voxels of what counts."""
    counted = solid if reference == "targets" else free
    whole = covered if reference == "covered" else jnp.ones_like(covered)
    return visible @ counted, whole @ counted


def sight(
    sensors: Float[Array, "S 3"],
    prisms: Prism,
    columns: Float[Array, "L 2"],
    heights: Float[Array, "L Z"],
    width: Width = None,
    *,
    at_sensor: bool = False,
    ignore_self_occlusion: bool = False,
) -> Float[Array, "S L Z"]:
    """Chance that the prisms (B,) of one frame leave each sensor's sight line to a voxel clear.

    As :func:`soft_sight` has it, but every prism is looked at from every column; read exactly, of
    all sensors together.
    """
    if exact(width):
        ceilings = shadow_ceilings(
            sensors, prisms, columns, ignore_self_occlusion=ignore_self_occlusion
        )
        return step(heights[None] - ceilings[:, :, None])
    frame = jax.tree.map(lambda leaf: leaf[None], prisms)
    marked = bitmask.marks(frame.valid.T)

    def one(sensor: Float[Array, "3"]) -> Float[Array, "L Z"]:
        at = sensor, frame, marked, columns.T, heights.T, width
        own = dict(at_sensor=at_sensor, ignore_self_occlusion=ignore_self_occlusion)
        return soft_sight(*at, **own)[:, 0].T

    return jax.lax.map(one, sensors)


SensorsOfGrids = tuple[tuple[RayGrid, tuple[int, ...]], ...]
"""The sensors of each ray grid, by number."""


def of_grids(read, poses: Float[Array, "S 6"], groups: SensorsOfGrids) -> Array:
    """``read`` of each grid and its sensors' poses, in the sensors' order; a row or more each."""
    found = [read(grid, poses[jnp.array(s)]) for grid, s in groups]
    order = np.argsort(np.concatenate([index for _, index in groups]))
    return jax.tree.map(lambda *parts: jnp.concatenate(parts)[order], *found)


def view_margins(
    poses: Float[Array, "S 6"],
    centers: Float[Array, "V 3"],
    groups: SensorsOfGrids,
    half: float,
) -> tuple[Float[Array, "S V"], Float[Array, "S V"]]:
    """:func:`in_view_margins` of all sensors."""
    return of_grids(lambda grid, at: in_view_margins(grid, at, centers, half), poses, groups)


def views(
    poses: Float[Array, "S 6"],
    centers: Float[Array, "V 3"],
    groups: SensorsOfGrids,
    half: float,
    softness: Softness,
) -> Float[Array, "S V"]:
    """f of all sensors, all voxels at once."""
    if softness.rays != "density":
        field, ray = view_margins(poses, centers, groups, half)
        return step(field, softness.field) * step(ray)

    def chances(grid: RayGrid, at: Float[Array, "s 6"]) -> Float[Array, "s V"]:
        each = partial(density_view, grid.rays, half, centers=centers, softness=softness.field)
        return jnp.stack([each(transform_of(pose)) for pose in at])

    return of_grids(chances, poses, groups)


def measure(
    field: SceneArrays,
    poses: Float[Array, "S 6"],
    sensor_set: SensorSet,
    voxel: float,
    softness: Softness = Softness(),  # noqa: B008  # it does not change
    *,
    occlusion_reference: str = "roi",
    visibility: str = "in_view",
) -> MetricValues:
    """The three metrics as functions of pose (about the scene's centre), in the paper's order.

    ``voxel`` is the edge of a voxel [m]. Differentiable in the poses where ``softness`` is not 0.
    """
    ground = field.centered
    f = views(poses, ground.centers, sensor_set.groups, voxel / 2, softness)
    failures = Groups.of_rows(sensor_set.failures, len(poses))
    seen = accumulate_frames(
        ground,
        poses[:, :3],
        f,
        softness.shadow,
        failures=failures,
        reference=occlusion_reference,
        visibility=visibility,
        at_sensor=softness.shadows_at_sensor,
    )
    occupancy = seen.occupancy if field.occupancy is None else field.occupancy
    q = f * (seen.sight_share * jnp.asarray(sensor_set.reliability, float)[:, None])
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


@partial(jax.jit, static_argnames=("reference", "visibility", "at_sensor"))
def accumulate_frames(
    ground: CenteredScene,
    sensors: Float[Array, "S 3"],
    f: Float[Array, "S V"],
    width: Width = None,
    *,
    failures: Groups | None,
    reference: str,
    visibility: str,
    at_sensor: bool = False,
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
        def watch(prisms: Prism) -> tuple[tuple, tuple]:
            solid = there * step(solid_top(columns, prisms)[:, None] - heights)
            look = partial(sight, sensors, prisms, columns, heights, width, at_sensor=at_sensor)
            clear = line = look()
            if reference == "targets" or visibility == "past_others":
                others = look(ignore_self_occlusion=True)
                clear = jnp.where(solid[None] > 0, others, line)
            visible = leave_one_out((f * clear).reshape(flat), failures)
            free, inside = (there - solid).ravel(), solid.ravel()
            terms = occlusion_terms(visible, covered, free, inside, reference)
            in_sight = clear if visibility == "past_others" else line
            share = in_sight.reshape(flat) if share_sight else jnp.ones(())
            return (inside, visible[0] * free, share), terms

        def some(sums: tuple, prisms: Prism) -> tuple[tuple, tuple]:
            gathered, terms = jax.vmap(watch)(prisms)
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
