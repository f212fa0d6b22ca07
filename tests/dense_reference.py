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

from inspe_jax.core import geometry
from inspe_jax.core.convex import outlines
from inspe_jax.core.geometry import NEVER, Prism
from inspe_jax.core.numerics import Groups, Softness, Width, exact, leave_one_out, step
from inspe_jax.scoring import metrics
from inspe_jax.scoring.driver import MetricValues
from inspe_jax.scoring.tiled_scene import SceneArrays
from inspe_jax.sensing.ray_grid import RayGrid
from inspe_jax.sensing.sensor_array import SensorSet
from inspe_jax.visibility import bitmask
from inspe_jax.visibility.centered_scene import CenteredScene
from inspe_jax.visibility.in_view import density_view, in_view_margins, transform_of
from inspe_jax.visibility.soft_sight import Sights, clear_chance


def occlusion_terms(visible, covered, free, solid, reference):
    """(|V_orig| − |V_occ|, |V_orig|) of one frame: sums over the voxels of what counts."""
    counted = solid if reference == "targets" else free
    whole = covered if reference == "covered" else jnp.ones_like(covered)
    return visible @ counted, whole @ counted


def shadow_ceilings(
    sensors: Float[Array, "S 3"],
    prisms: Prism,
    columns: Float[Array, "L 2"],
    *,
    ignore_self_occlusion: bool = False,
) -> Float[Array, "S L"]:
    """Height [m] below which the prisms (B,) of one frame hide each column from each sensor."""

    def of_prism(sensor: Float[Array, "3"], terms: geometry.ShadowTerms) -> Float[Array, " L"]:
        dx, dy = columns[:, 0] - sensor[0], columns[:, 1] - sensor[1]
        own = ignore_self_occlusion
        return geometry.shadow_ceiling(terms, dx, dy, sensor[2], ignore_self_occlusion=own)

    def of_sensor(sensor: Float[Array, "3"]) -> Float[Array, " L"]:
        each = jax.vmap(of_prism, (None, 0))(sensor, geometry.shadow_terms(sensor, prisms))
        return each.max(0, initial=NEVER)

    return jax.vmap(of_sensor)(sensors)


def sight(
    sensors: Float[Array, "S 3"],
    prisms: Prism,
    columns: Float[Array, "L 2"],
    heights: Float[Array, "L Z"],
    width: Width = None,
    *,
    ignore_self_occlusion: bool = False,
) -> Float[Array, "S L Z"]:
    """Chance that the prisms (B,) of one frame leave each sensor's sight line to a voxel clear.

    As :func:`clear_chance` has it, but every prism is looked at from every column; read exactly, of
    all sensors together.
    """
    if exact(width):
        ceilings = shadow_ceilings(
            sensors, prisms, columns, ignore_self_occlusion=ignore_self_occlusion
        )
        return step(heights[None] - ceilings[:, :, None])
    frame = jax.tree.map(lambda leaf: leaf[None], prisms)
    marked = bitmask.marks(frame.valid.T)[..., None]
    spared = jnp.full((heights.shape[1], 1, len(columns)), ignore_self_occlusion)
    of = Sights(outlines(frame), marked, columns.T, heights.T, width, spared)
    return jax.lax.map(lambda sensor: clear_chance(sensor, of)[:, 0].T, sensors)


SensorsOfGrids = tuple[tuple[RayGrid, tuple[int, ...]], ...]
"""The sensors of each ray grid, by number."""


def of_grids(read, poses: Float[Array, "S 6"], groups: SensorsOfGrids) -> Array:
    """``read`` of each grid and its sensors' poses, in the sensors' order; a row or more each."""
    found = [read(grid, poses[jnp.array(s)]) for grid, s in groups]
    order = np.argsort(np.concatenate([index for _, index in groups]))
    return jax.tree.map(lambda *parts: jnp.concatenate(parts)[order], *found)


def view_margins(
    poses: Float[Array, "S 6"], centers: Float[Array, "V 3"], groups: SensorsOfGrids, half: float
) -> tuple[Float[Array, "S V"], Float[Array, "S V"]]:
    """:func:`in_view_margins` of all sensors."""

    def margins(grid: RayGrid, at: Float[Array, "s 6"]) -> tuple[Array, Array]:
        of_sensor = partial(in_view_margins, grid.rays, half, centers=centers)
        return jax.vmap(lambda pose: of_sensor(transform_of(pose)))(at)

    return of_grids(margins, poses, groups)


@partial(jax.jit, static_argnames=("groups", "half"))
def views(
    poses: Float[Array, "S 6"],
    ground: CenteredScene,
    groups: SensorsOfGrids,
    half: float,
    softness: Softness,
) -> Float[Array, "S V"]:
    """f of all sensors, all voxels at once."""
    centers = ground.centers
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
    f = views(poses, ground, sensor_set.groups, voxel / 2, softness)
    failures = Groups.of_rows(sensor_set.failures, len(poses))
    how = dict(failures=failures, reference=occlusion_reference, visibility=visibility)
    seen = accumulate_frames(ground, poses[:, :3], f, softness.shadow, **how)
    return summarise(field, f, seen, np.array(sensor_set.reliability), failures)


@jax.jit
def summarise(
    field: SceneArrays,
    f: Float[Array, "S V"],
    seen: "FrameSums",
    reliability: Float[Array, " S"],
    failures: Groups | None,
) -> MetricValues:
    """The metrics from what is in view and what is seen."""
    ground = field.centered
    occupancy = seen.occupancy if field.occupancy is None else field.occupancy
    q = f * (seen.sight_share * reliability.astype(f.dtype)[:, None])
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
    """Go through the frames, one after the other.

    Gives O, the occupancy p̂, and the share of frames in which each voxel is
    seen; unless ``visibility`` is ``in_view`` also that in which each sensor has each voxel in
    line of sight, else 1.
    """
    covered = leave_one_out(f, failures)

    @jax.checkpoint  # kept for the gradient, every frame's sight lines would not fit in memory
    def watch(prisms: Prism) -> tuple[tuple, tuple]:
        solid = step(solid_top(ground.columns, prisms)[:, None] - ground.heights)
        at = sensors, prisms, ground.columns, ground.heights, width
        look = partial(sight, *at)
        clear = line = look()
        if reference == "targets" or visibility == "past_others":
            clear = jnp.where(solid[None] > 0, look(ignore_self_occlusion=True), line)
        free, inside = (1.0 - solid).ravel(), solid.ravel()
        visible = leave_one_out(f * clear.reshape(f.shape), failures)
        terms = occlusion_terms(visible, covered, free, inside, reference)
        in_sight = (clear if visibility == "past_others" else line).reshape(f.shape)
        return (inside, visible[0] * free, in_sight), terms

    each, (seen, original) = jax.lax.map(watch, ground.prisms)
    occupancy, seen_share, sight_share = (of.mean(0) for of in each)
    if visibility == "in_view":
        sight_share = jnp.ones_like(f)
    return FrameSums(metrics.occlusion(seen, original), occupancy, seen_share, sight_share)


def solid_top(columns: Float[Array, "L 2"], prism: Prism) -> Float[Array, " L"]:
    """Top [m] of the highest prism that stands on each column; :data:`NEVER` where none does."""
    prism = jax.tree.map(lambda leaf: leaf[:, None], prism)  # (B, 1, …)
    tops = geometry.top_over(prism, columns[None, :, 0], columns[None, :, 1])
    return jnp.max(tops, axis=0, initial=NEVER)
