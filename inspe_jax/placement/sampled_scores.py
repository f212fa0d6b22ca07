"""The score of poses on samples: programs that are compiled for one problem and serve others."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from inspe_jax.core.numerics import Softness
from inspe_jax.placement.objective import COMBINATIONS
from inspe_jax.scoring import metrics
from inspe_jax.scoring.exact import count_exactly
from inspe_jax.scoring.options import ScoreOptions
from inspe_jax.scoring.sensor_array import SensorArray
from inspe_jax.scoring.soft import read_softly
from inspe_jax.scoring.summary import MetricValues
from inspe_jax.scoring.tiled_scene import TiledScene


class ScoreTerms(NamedTuple):
    """What a score depends on besides the poses and the sample.

    ``sensors`` and ``voxel``, a voxel's edge [m], of every case; ``weights`` of every metric by
    name; ``failures``, the number of units that are left out in turn, or 0.
    """

    sensors: tuple[SensorArray, ...]
    voxel: tuple[float, ...]
    weights: dict[str, Float[np.ndarray | Array, ""]]
    failures: Int[np.ndarray | Array, ""]


@jax.jit
def scores(
    measures: list[MetricValues], weights: dict[str, Any], failures: Int[Any, ""]
) -> Float[Array, " N"]:
    """P_sm of N cases; with failures, the mean of P_sm without each unit in turn."""
    found = []
    for m in measures:
        kind = m.column_coverage.dtype
        named = {name: jnp.asarray(weight, kind) for name, weight in weights.items()}
        p = metrics.surrogate(m.values, named)  # (1 + G,)
        number = jnp.arange(len(p))
        real = (number > 0) & (number <= failures)
        without = jnp.where(real, p, 0.0).sum() / jnp.maximum(failures, 1).astype(p.dtype)
        found.append(jnp.where(failures > 0, without, p[0]))
    return jnp.stack(found)


@partial(jax.jit, static_argnames="asked")
def hard_scores(
    poses: Float[Array, "S 6"],
    scenes: tuple[TiledScene, ...],
    terms: ScoreTerms,
    *,
    asked: ScoreOptions,
) -> Float[Array, " N"]:
    """P_sm of N cases, read hard; ``poses`` are about the scene's centre and padded."""
    measures = [
        count_exactly(tiled, poses, sensors, voxel, asked)
        for tiled, sensors, voxel in zip(scenes, terms.sensors, terms.voxel, strict=True)
    ]
    return scores(measures, terms.weights, terms.failures)


@partial(jax.jit, static_argnames=("asked", "over"))
def soft_slope(
    poses: Float[Array, "S 6"],
    scenes: tuple[TiledScene, ...],
    terms: ScoreTerms,
    softness: Float[Array, ""],
    *,
    asked: ScoreOptions,
    over: str,
) -> tuple[Float[Array, ""], Float[Array, "S 6"]]:
    """The combined score of all cases, read with ``softness`` [m], and its gradient in the poses.

    ``scenes`` are samples or whole scenes, in tiles; ``over`` is one of :data:`COMBINATIONS`.
    ``poses`` are about the scene's centre and padded.
    """
    width = Softness.of(softness)

    def score(poses: Array) -> Array:
        measures = [
            read_softly(tiled, poses, sensors, voxel, width, options=asked)
            for tiled, sensors, voxel in zip(scenes, terms.sensors, terms.voxel, strict=True)
        ]
        return COMBINATIONS[over][0](scores(measures, terms.weights, terms.failures))

    return jax.value_and_grad(score)(poses)
