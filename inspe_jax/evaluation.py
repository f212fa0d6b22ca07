"""Score a layout on a scene: visibility in, the four metrics out."""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from inspe_jax import metrics
from inspe_jax.errors import InspeError
from inspe_jax.geometry import Prism, solid_top
from inspe_jax.numerics import leave_one_out, step
from inspe_jax.scene.regions import Region
from inspe_jax.scene.scene import Scene
from inspe_jax.scene.voxels import check_memory
from inspe_jax.sensing.layout import Layout
from inspe_jax.sensing.visibility import (
    Ground,
    about_center,
    check_layout,
    poses_about_center,
    shadow_ceilings,
    view_margin,
)

VISIBILITIES = ("in_view", "line_of_sight")
"""What information gain calls visible: f as in the paper, or f × the share of frames in sight."""


@dataclass(frozen=True)
class Contribution:
    """What the layout loses when one sensor is left out, metric by metric."""

    sensor: str
    coverage: float
    occlusion: float
    information_gain: float
    surrogate: float


@dataclass(frozen=True)
class Scores:
    """The scores of one layout on one scene, each between 0 and 1, higher is better.

    ``region_coverage`` and ``level_coverage`` are unweighted shares of the voxels
    of one region and of one level (lowest first); ``contributions`` has one row a
    sensor, in the layout's order, and can be negative only for occlusion with the
    reference ``covered``, whose voxels change with the sensors; ``seen_share`` (L,) is the
    share of frames and levels in which each column is seen; ``settings`` are the
    options used.
    """

    coverage: float
    occlusion: float
    information_gain: float
    surrogate: float
    information_gain_literal: float
    region_coverage: dict[str, float]
    level_coverage: tuple[float, ...]
    contributions: tuple[Contribution, ...]
    seen_share: Float[np.ndarray, " L"]
    settings: dict[str, Any]


def evaluate(
    scene: Scene,
    layout: Layout,
    *,
    weights: tuple[float, float, float] = metrics.WEIGHTS,
    occlusion_reference: str = "roi",
    visibility: str = "in_view",
) -> Scores:
    """Exact scores of a layout on a scene.

    ``weights`` of C, O, IG in P_sm; ``occlusion_reference`` as in
    :func:`~inspe_jax.metrics.occlusion_terms`; ``visibility`` for information
    gain, one of :data:`VISIBILITIES`. Raises InspeError where a sensor is in the
    ground or out of reach of the scene, an option is unknown, the arrays would not
    fit in memory, or there is no traffic and so no entropy to resolve; unless
    information gain has weight 0, and then it is 0.
    """
    if occlusion_reference not in metrics.OCCLUSION_REFERENCES:
        raise metrics.unknown_reference(occlusion_reference)
    if visibility not in VISIBILITIES:
        raise InspeError(f"visibility '{visibility}': one of {', '.join(VISIBILITIES)}")
    metrics.check_weights(weights)
    check_layout(scene, layout)
    check_memory(scene.voxels.count, len(layout))
    ground, poses = about_center(scene), poses_about_center(scene, layout)
    f = step(view_margin(scene, layout))  # (S, V)
    seen = watch(
        ground,
        poses[:, :3],
        f,
        reference=occlusion_reference,
        share_sight=visibility == "line_of_sight",
    )
    if weights[2] > 0 and not float(metrics.entropy(seen.occupancy).sum()) > 0:
        raise InspeError(
            f"{scene.name}: information gain needs traffic: no voxel of the scene is occupied in "
            "some frames and free in others, so there is no entropy to resolve; build the scene "
            "with a density of low, medium or high and at least 2 frames, or give it no weight"
        )
    weight = jnp.asarray(scene.voxels.weight, float)
    q = f * (seen.sight_share * jnp.asarray(layout.reliability, float)[:, None])
    covered, resolved = leave_one_out(f), leave_one_out(q)  # (1 + S, V)
    c = metrics.coverage(covered, weight)
    ig = metrics.information_gain(resolved, seen.occupancy)
    scores = jnp.stack([c, seen.occlusion, ig, metrics.surrogate(c, seen.occlusion, ig, weights)])
    total, *without = np.asarray(scores, float).T.tolist()
    seen_any = np.asarray(covered[0]).reshape(ground.heights.shape)  # (L, Z)
    return Scores(
        coverage=total[0],
        occlusion=total[1],
        information_gain=total[2],
        surrogate=total[3],
        information_gain_literal=float(
            metrics.information_gain_literal(resolved[0], seen.occupancy)
        ),
        region_coverage={
            region.key: float(seen_any[scene.voxels.region == region].mean())
            for region in Region
            if (scene.voxels.region == region).any()
        },
        level_coverage=tuple(seen_any.mean(0).tolist()),
        contributions=tuple(
            Contribution(sensor.name, *np.subtract(total, left).tolist())
            for sensor, left in zip(layout.sensors, without, strict=True)
        ),
        seen_share=np.asarray(seen.seen_share).reshape(seen_any.shape).mean(1),
        settings=dict(
            weights=list(weights), occlusion_reference=occlusion_reference, visibility=visibility
        ),
    )


class Seen(NamedTuple):
    """What :func:`watch` gathers over the frames; row 0 is all sensors, 1 + s all but one."""

    occlusion: Float[Array, " 1+S"]
    occupancy: Float[Array, " V"]
    seen_share: Float[Array, " V"]
    sight_share: Float[Array, "S V"]


BLOCK = 1024
"""Columns watched at a time: what they need stays in a core's cache through all frames."""


@partial(jax.jit, static_argnames=("reference", "share_sight"))
def watch(
    ground: Ground,
    sensors: Float[Array, "S 3"],
    f: Float[Array, "S V"],
    *,
    reference: str,
    share_sight: bool,
) -> Seen:
    """Go through the frames once for each block of columns.

    Gives O, the occupancy p̂, and the share of frames in which each voxel is
    seen; with ``share_sight`` also that in which each sensor has each voxel in
    line of sight, else 1.
    """
    (length, levels), frames = ground.heights.shape, len(ground.prisms.top)

    def block(part: tuple[Array, ...]) -> tuple[tuple, tuple]:
        there, columns, heights, f = part  # (C, 1), (C, 2), (C, Z), (C, S, Z)
        f = f.swapaxes(0, 1)  # (S, C, Z)
        flat = (len(sensors), -1)
        covered = leave_one_out(f.reshape(flat))

        def frame(sums: tuple, prisms: Prism) -> tuple[tuple, tuple]:
            spare_own = reference == "targets"
            ceilings = shadow_ceilings(sensors, prisms, columns, spare_own=spare_own)
            clear = step(heights[None] - ceilings[:, :, None])
            solid = there * step(solid_top(columns, prisms)[:, None] - heights)
            visible = leave_one_out((f * clear).reshape(flat))
            free, inside = (there - solid).ravel(), solid.ravel()
            terms = metrics.occlusion_terms(visible, covered, free, inside, reference)
            gathered = (inside, visible[0], clear.reshape(flat) if share_sight else 1.0)
            return jax.tree.map(jnp.add, sums, gathered), terms

        zeros = jnp.zeros_like(covered[0])
        start = (zeros, zeros, jnp.zeros(f.shape).reshape(flat) if share_sight else jnp.zeros(()))
        return jax.lax.scan(frame, start, ground.prisms)

    def blocks(x: Array) -> Array:
        """(L, …) as (N, C, …), padded with zeros."""
        count = -(-length // BLOCK)
        x = jnp.pad(x, [(0, count * BLOCK - length)] + [(0, 0)] * (x.ndim - 1))
        return x.reshape(count, BLOCK, *x.shape[1:])

    by_column = f.reshape(-1, length, levels).swapaxes(0, 1)
    parts = (jnp.ones((length, 1)), ground.columns, ground.heights, by_column)
    sums, terms = jax.lax.map(block, tuple(map(blocks, parts)))
    seen, original = (term.sum(0) for term in terms)  # (T, 1 + S), over the blocks
    occupancy, seen_share = (s.reshape(-1)[: length * levels] / frames for s in sums[:2])
    sight_share = jnp.ones_like(f)
    if share_sight:
        total = sums[2].swapaxes(0, 1).reshape(len(sensors), -1)  # (S, N·C·Z)
        sight_share = total[:, : length * levels] / frames
    return Seen(metrics.occlusion(seen, original), occupancy, seen_share, sight_share)
