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
from inspe_jax.numerics import EXACT, Softness, Width, leave_one_out, step
from inspe_jax.scene.regions import Region
from inspe_jax.scene.scene import Scene
from inspe_jax.scene.voxels import check_memory
from inspe_jax.sensing.ground import Ground, about_center, poses_about_center
from inspe_jax.sensing.in_view import view_margins
from inspe_jax.sensing.layout import Layout
from inspe_jax.sensing.sensors import RayGrid
from inspe_jax.sensing.shadows import sight
from inspe_jax.sensing.visibility import check_layout

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

    Numbers; or JAX arrays, where the layout's poses are traced.
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


class Field(NamedTuple):
    """What is scored: the scene's arrays, or a sample of them.

    ``weight`` (V,) of the voxels' regions; ``occupancy`` (V,) is p̂, or None to take it from the
    frames of ``ground``.
    """

    ground: Ground
    weight: Float[Array, " V"]
    occupancy: Float[Array, " V"] | None = None


class Crew(NamedTuple):
    """The sensors' fixed side: ``groups`` of one ray grid, ``reliability`` (S,), and the
    ``failures``, groups of sensors that are left out in turn."""

    groups: tuple[tuple[RayGrid, tuple[int, ...]], ...]
    reliability: tuple[float, ...]
    failures: tuple[tuple[int, ...], ...] = ()


class Measures(NamedTuple):
    """C, O and IG: of all sensors in row 0, of all but failure g in row 1 + g; and by voxel."""

    coverage: Float[Array, " 1+G"]
    occlusion: Float[Array, " 1+G"]
    information_gain: Float[Array, " 1+G"]
    covered: Float[Array, " V"]
    resolved: Float[Array, " V"]
    occupancy: Float[Array, " V"]
    seen_share: Float[Array, " V"]


def measure(
    field: Field,
    poses: Float[Array, "S 6"],
    crew: Crew,
    voxel: float,
    softness: Softness = EXACT,
    *,
    occlusion_reference: str = "roi",
    visibility: str = "in_view",
) -> Measures:
    """The three metrics as functions of pose (about the scene's centre), in the paper's order.

    ``voxel`` is the edge of a voxel [m]. Differentiable in the poses where ``softness`` is not 0.
    """
    ground = field.ground
    in_field, on_ray = view_margins(poses, ground.centers, crew.groups, voxel / 2)
    f = step(in_field, softness.field) * step(on_ray, softness.ray)  # (S, V)
    seen = watch(
        ground,
        poses[:, :3],
        f,
        softness.shadow,
        failures=crew.failures,
        reference=occlusion_reference,
        share_sight=visibility == "line_of_sight",
    )
    occupancy = seen.occupancy if field.occupancy is None else field.occupancy
    q = f * (seen.sight_share * jnp.asarray(crew.reliability, float)[:, None])
    covered, resolved = leave_one_out(f, crew.failures), leave_one_out(q, crew.failures)
    return Measures(
        metrics.coverage(covered, field.weight),
        seen.occlusion,
        metrics.information_gain(resolved, occupancy),
        covered[0],
        resolved[0],
        occupancy,
        seen.seen_share,
    )


def evaluate(
    scene: Scene,
    layout: Layout,
    *,
    weights: tuple[float, float, float] = metrics.WEIGHTS,
    occlusion_reference: str = "roi",
    visibility: str = "in_view",
    softness: Any = 0.0,
) -> Scores:
    """Scores of a layout on a scene: exact ones, or soft ones that have gradients.

    ``weights`` of C, O, IG in P_sm; ``occlusion_reference`` as in
    :func:`~inspe_jax.metrics.occlusion_terms`; ``visibility`` for information
    gain, one of :data:`VISIBILITIES`; ``softness`` [m] is 0 for the exact scores, or the width of
    the soft reading, one for all margins or a :class:`~inspe_jax.numerics.Softness`. With
    poses P (S, 6) traced, ``evaluate(scene, layout.with_poses(P), softness=0.5).surrogate`` is
    differentiable in P; read exactly it is a step function, with gradient 0.

    Raises InspeError where a sensor is in the
    ground or out of reach of the scene, an option is unknown, the arrays would not
    fit in memory, or there is no traffic and so no entropy to resolve; unless
    information gain has weight 0, and then it is 0.
    """
    check_options(weights, occlusion_reference, visibility)
    check_layout(scene, layout)
    check_memory(scene.voxels.count, len(layout))
    ground = about_center(scene)
    each = tuple((s,) for s in range(len(layout)))
    measured = measure(
        Field(ground, jnp.asarray(scene.voxels.weight, float)),
        poses_about_center(scene, layout),
        Crew(layout.groups(), tuple(layout.reliability.tolist()), each),
        scene.voxels.size,
        Softness.of(softness, scene.voxels.size),
        occlusion_reference=occlusion_reference,
        visibility=visibility,
    )
    if weights[2] > 0:
        check_entropy(scene, measured.occupancy)
    c, o, ig = measured.coverage, measured.occlusion, measured.information_gain
    scores = jnp.stack([c, o, ig, metrics.surrogate(c, o, ig, weights)])
    total, *without = _numbers(scores.T)
    seen_any = _array(measured.covered).reshape(ground.heights.shape)  # (L, Z)
    return Scores(
        coverage=total[0],
        occlusion=total[1],
        information_gain=total[2],
        surrogate=total[3],
        information_gain_literal=_numbers(
            metrics.information_gain_literal(measured.resolved, measured.occupancy)
        ),
        region_coverage={
            region.key: _numbers(seen_any[scene.voxels.region == region].mean())
            for region in Region
            if (scene.voxels.region == region).any()
        },
        level_coverage=tuple(_numbers(seen_any.mean(0))),
        contributions=tuple(
            Contribution(sensor.name, *(a - b for a, b in zip(total, left, strict=True)))
            for sensor, left in zip(layout.sensors, without, strict=True)
        ),
        seen_share=_array(measured.seen_share).reshape(seen_any.shape).mean(1),
        settings=dict(
            weights=list(weights),
            occlusion_reference=occlusion_reference,
            visibility=visibility,
            softness=softness,
        ),
    )


def _array(x: Array) -> Any:
    """In NumPy, unless it is traced."""
    return x if isinstance(x, jax.core.Tracer) else np.asarray(x)


def _numbers(x: Any) -> Any:
    """Python numbers, nested as the array is; a traced array stays one, split along axis 0."""
    if not isinstance(x, jax.core.Tracer):
        return np.asarray(x, float).tolist()
    return [_numbers(row) for row in x] if x.ndim else x


def check_options(
    weights: tuple[float, float, float], occlusion_reference: str, visibility: str
) -> None:
    """Raise InspeError where an option of :func:`evaluate` is unknown."""
    if occlusion_reference not in metrics.OCCLUSION_REFERENCES:
        raise metrics.unknown_reference(occlusion_reference)
    if visibility not in VISIBILITIES:
        raise InspeError(f"visibility '{visibility}': one of {', '.join(VISIBILITIES)}")
    metrics.check_weights(weights)


def check_entropy(scene: Scene, occupancy: Float[Array, " V"]) -> None:
    """Raise InspeError where no voxel is occupied in some frames and free in others."""
    if isinstance(occupancy, jax.core.Tracer):
        return
    if not float(metrics.entropy(jnp.asarray(occupancy)).sum()) > 0:
        raise InspeError(
            f"{scene.name}: information gain needs traffic: no voxel of the scene is occupied in "
            "some frames and free in others, so there is no entropy to resolve; build the scene "
            "with a density of low, medium or high and at least 2 frames, or give it no weight"
        )


class Seen(NamedTuple):
    """What :func:`watch` gathers over the frames; row 0 is all sensors, 1 + g all but a failure."""

    occlusion: Float[Array, " 1+G"]
    occupancy: Float[Array, " V"]
    seen_share: Float[Array, " V"]
    sight_share: Float[Array, "S V"]


BLOCK = 1024
"""Columns watched at a time: what they need stays in a core's cache through all frames."""


@partial(jax.jit, static_argnames=("failures", "reference", "share_sight"))
def watch(
    ground: Ground,
    sensors: Float[Array, "S 3"],
    f: Float[Array, "S V"],
    width: Width = None,
    *,
    failures: tuple[tuple[int, ...], ...],
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
        covered = leave_one_out(f.reshape(flat), failures)

        @jax.checkpoint  # kept for the gradient, every frame's sight lines would not fit in memory
        def look(prisms: Prism) -> tuple[tuple, tuple]:
            spare_own = reference == "targets"
            clear = sight(sensors, prisms, columns, heights, width, spare_own=spare_own)
            solid = there * step(solid_top(columns, prisms)[:, None] - heights)
            visible = leave_one_out((f * clear).reshape(flat), failures)
            free, inside = (there - solid).ravel(), solid.ravel()
            terms = metrics.occlusion_terms(visible, covered, free, inside, reference)
            gathered = (inside, visible[0], clear.reshape(flat) if share_sight else jnp.ones(()))
            return gathered, terms

        def frame(sums: tuple, prisms: Prism) -> tuple[tuple, tuple]:
            gathered, terms = look(prisms)
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
    seen, original = (term.sum(0) for term in terms)  # (T, 1 + G), over the blocks
    occupancy, seen_share = (s.reshape(-1)[: length * levels] / frames for s in sums[:2])
    sight_share = jnp.ones_like(f)
    if share_sight:
        total = sums[2].swapaxes(0, 1).reshape(len(sensors), -1)  # (S, N·C·Z)
        sight_share = total[:, : length * levels] / frames
    return Seen(metrics.occlusion(seen, original), occupancy, seen_share, sight_share)
