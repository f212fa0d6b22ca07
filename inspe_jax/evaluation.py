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
from inspe_jax.numerics import any_of, any_other, step
from inspe_jax.scene.regions import Region
from inspe_jax.scene.scene import Scene
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
    sensor, in the layout's order; ``seen_share`` (L,) is the share of frames and
    levels in which each column is seen; ``settings`` are the options used.
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
    ground, an option is unknown, or there is no traffic (no entropy to resolve).
    """
    if occlusion_reference not in metrics.OCCLUSION_REFERENCES:
        raise InspeError(
            f"occlusion_reference '{occlusion_reference}': one of "
            f"{', '.join(metrics.OCCLUSION_REFERENCES)}"
        )
    if visibility not in VISIBILITIES:
        raise InspeError(f"visibility '{visibility}': one of {', '.join(VISIBILITIES)}")
    check_layout(scene, layout)
    ground, poses = about_center(scene), poses_about_center(scene, layout)
    f = step(view_margin(scene, layout))  # (S, V)
    seen = watch(
        ground,
        poses[:, :3],
        f,
        reference=occlusion_reference,
        share_sight=visibility == "line_of_sight",
    )
    if not float(metrics.entropy(seen.occupancy).sum()) > 0:
        raise InspeError(
            f"{scene.name}: information gain needs traffic: no voxel of the scene is occupied in "
            "some frames and free in others, so there is no entropy to resolve; build the scene "
            "with a density of low, medium or high and at least 2 frames"
        )
    weight = jnp.asarray(scene.voxels.weight, float)
    q = f * seen.sight_share * jnp.asarray(layout.reliability, float)[:, None]
    rows = []  # all sensors, then each left out
    for fuse, o in ((any_of_all, seen.occlusion), (any_other, seen.occlusion_without)):
        c = metrics.coverage(fuse(f), weight)
        ig = metrics.information_gain(fuse(q), seen.occupancy)
        rows.append(jnp.stack([c, o, ig, metrics.surrogate(c, o, ig, weights)], -1))
    total, without = np.asarray(rows[0], float), np.asarray(rows[1], float)
    covered = np.asarray(any_of_all(f)).reshape(ground.heights.shape)  # (L, Z)
    return Scores(
        *total.tolist(),
        information_gain_literal=float(
            metrics.information_gain_literal(any_of_all(q), seen.occupancy)
        ),
        region_coverage={
            region.key: float(covered[scene.voxels.region == region].mean())
            for region in Region
            if (scene.voxels.region == region).any()
        },
        level_coverage=tuple(covered.mean(0).tolist()),
        contributions=tuple(
            Contribution(sensor.name, *lost)
            for sensor, lost in zip(layout.sensors, (total - without).tolist(), strict=True)
        ),
        seen_share=np.asarray(seen.seen_share).reshape(covered.shape).mean(1),
        settings=dict(
            weights=list(weights), occlusion_reference=occlusion_reference, visibility=visibility
        ),
    )


any_of_all = partial(any_of, axis=0)


class Seen(NamedTuple):
    """What :func:`watch` gathers over the frames."""

    occlusion: Float[Array, ""]
    occlusion_without: Float[Array, " S"]
    occupancy: Float[Array, " V"]
    seen_share: Float[Array, " V"]
    sight_share: Float[Array, "S V"] | float


@partial(jax.jit, static_argnames=("reference", "share_sight"))
def watch(
    ground: Ground,
    sensors: Float[Array, "S 3"],
    f: Float[Array, "S V"],
    *,
    reference: str,
    share_sight: bool,
) -> Seen:
    """Go through the frames once, one frame's arrays in memory at a time.

    Gives O of all sensors and with each left out, the occupancy p̂, and the share
    of frames in which each voxel is seen; with ``share_sight`` also the share in
    which each sensor has each voxel in line of sight (else 1).
    """
    covered, covered_without = any_of_all(f), any_other(f)

    def frame(sums, prisms: Prism):  # type: ignore[no-untyped-def]
        ceilings = shadow_ceilings(
            sensors, prisms, ground.columns, spare_own=reference == "targets"
        )
        clear = step(ground.heights - ceilings[:, :, None]).reshape(f.shape)
        solid = step(solid_top(ground.columns, prisms)[:, None] - ground.heights).ravel()
        p = f * clear
        visible = any_of_all(p)
        terms = (
            metrics.occlusion_terms(visible, covered, solid, reference),
            metrics.occlusion_terms(any_other(p), covered_without, solid, reference),
        )
        gathered = (solid, visible, clear) if share_sight else (solid, visible)
        return jax.tree.map(jnp.add, sums, gathered), terms

    zeros = jnp.zeros_like(covered)
    start = (zeros, zeros, jnp.zeros_like(f)) if share_sight else (zeros, zeros)
    sums, (all_, without) = jax.lax.scan(frame, start, ground.prisms)
    shares = [total / len(ground.prisms.top) for total in sums]
    return Seen(
        metrics.occlusion(*all_),
        metrics.occlusion(*without),
        shares[0],
        shares[1],
        shares[2] if share_sight else 1.0,
    )
