"""A control: the default search with central differences of the hard score for its gradient. What
the default gains over it in equal time is what its gradient gains."""

from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from inspe_jax.core.arrays import on_host
from inspe_jax.placement.methods.adam import Slope
from inspe_jax.placement.methods.greedy import method
from inspe_jax.placement.methods.local_search import VIEW_COST
from inspe_jax.placement.problem import Drawn, Problem, Sample
from inspe_jax.placement.sampled_objective import SampledObjective, rows_at

HALF = np.array([0.5, 0.5, 0.5, 0.0, 0.03, 0.03, 0.05])
"""Half of a difference in x, y, z [m], roll, which is not searched, pitch, yaw [rad] and lens."""


def differences(
    problem: Problem, poses: Float[Any, "S p"], on: Any, softness: Any
) -> tuple[float, Float[np.ndarray, "S p"]]:
    """The hard score of poses on samples ``on`` and its central differences, sensor by sensor."""
    sampled = SampledObjective(problem, Sample(jax.device_put(on), 0.0))
    half, steps = HALF[: poses.shape[1]], _steps(poses.shape[1])
    views = sampled.views({s: pose + steps for s, pose in enumerate(np.asarray(poses, float))})
    rows, slope = {s: rows_at(seen, 0) for s, seen in views.items()}, np.zeros(np.shape(poses))
    for s, seen in views.items():
        scores = sampled.scores(rows, np.full((len(steps), 1), s), [seen])
        value, after, before = np.split(scores, [1, 1 + len(steps) // 2])
        slope[s, half > 0] = (after - before) / (2 * half[half > 0])
    return float(value[0]), on_host(slope, float)


def _steps(numbers: int) -> Float[np.ndarray, "K p"]:
    """None, half a difference up in each number of a pose, and down in each."""
    away = np.diag(HALF[:numbers])[HALF[:numbers] > 0]
    return np.concatenate([0 * away[:1], away, -away])


def _cost(problem: Problem, drawn: Drawn) -> float:
    return len(_steps(6 + problem.layout.zooms)) * VIEW_COST * problem.sample_cost(drawn)


DIFFERENCES = method(
    "differences",
    "a control: greedy-adam with central differences of the hard score for gradients",
    Slope(differences, _cost),
)
