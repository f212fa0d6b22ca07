"""What an installation error costs: slopes by sensor, and the scores that random errors leave."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from inspe_jax.core.errors import InspeError
from inspe_jax.placement.problem import Case, Objective, Problem
from inspe_jax.placement.run import check_seed
from inspe_jax.scene.scene import Scene
from inspe_jax.scoring.tiled_scene import tiled_scene_without_masks
from inspe_jax.sensing.layout import Layout
from inspe_jax.visibility.centered_scene import poses_about_center

SOFTNESS = 0.2
"""Softness of the slopes [m]: edges of fields of view and shadows are averaged over about so much.
Which voxels single rays meet is read exactly and has no slope."""
POSITION_STEP = 0.1
"""Slopes along x, y and z are given for a shift of this much [m]."""
LIMITS = dict(position=(0, 2, " m"), angle=(0, 30, "°"), samples=(1, 10_000, ""))
"""Allowed installation errors [m, degrees] and number of random ones, with their units."""


@dataclass(frozen=True)
class Slopes:
    """What P_sm gains when one sensor is moved: by 10 cm along x, y or z, turned up or left by 1°.

    Negative where it loses; of first order, so that both are small where a search has ended.
    """

    sensor: str
    x: float
    y: float
    z: float
    yaw: float
    pitch: float


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class Tolerance:
    """How much of a score survives its installation.

    ``score`` is the exact objective as planned; ``left`` (M,) the exact objectives after M random
    errors; ``slopes`` has a row a sensor; ``settings`` are the options used.
    """

    score: float
    slopes: tuple[Slopes, ...]
    left: Float[np.ndarray, " M"]
    settings: dict[str, Any]

    @property
    def mean(self) -> float:
        """Mean objective after the errors."""
        return float(self.left.mean())

    @property
    def low(self) -> float:
        """Objective that 95 of 100 installations reach."""
        return float(np.quantile(self.left, 0.05))


def tolerance(
    scene: Scene | Case,
    layout: Layout,
    *,
    position: float = 0.1,
    angle: float = float(np.radians(1.0)),
    samples: int = 50,
    seed: int = 0,
    objective: Objective | None = None,
    softness: float = SOFTNESS,
    progress: Callable[[int, int], None] | None = None,
) -> Tolerance:
    """Slopes of the score of every sensor, and the scores that random errors leave.

    Every sensor is shifted along x, y and z and turned in yaw and pitch by independent
    normal errors with standard deviations ``position`` [m] and ``angle`` [rad], ``samples``
    times; the scores are exact. Slopes are those of the soft score at ``softness`` [m]: the exact
    one is a staircase with no slope of its own. A case brings its own light and weather.
    ``progress(done, total)`` is called on the way.

    Raises InspeError where an option is out of range, or as :func:`inspe_jax.evaluate` does.
    """
    check_seed(seed)
    given = dict(position=position, angle=float(np.degrees(angle)), samples=samples)
    for name, value in given.items():
        low, high, unit = LIMITS[name]
        if not low <= round(value, 9) <= high:
            raise InspeError(
                f"{name} {value:g}{unit} is out of range: between {low}{unit} and {high}{unit}"
            )
    if not softness > 0:
        raise InspeError(f"softness {softness:g} m: more than 0; the exact score has no slope")
    problem = Problem(scene, layout, objective)
    planned = problem.exact_of(layout)
    poses = poses_about_center(problem.cases[0].scene, layout)
    worlds = tuple(tiled_scene_without_masks(case.scene).bucketed for case in problem.cases)
    slope = np.asarray(problem.slope(poses, worlds, jnp.asarray(softness, float))[1], float)
    per = np.array([POSITION_STEP] * 3 + [np.radians(1.0)] * 3)
    rows = tuple(
        Slopes(sensor.name, *(row * per)[[0, 1, 2, 5, 4]].tolist())
        for sensor, row in zip(layout.sensors, slope, strict=True)
    )
    rng = np.random.default_rng([seed, 7])
    size = np.array([position] * 3 + [0.0] + [angle] * 2)
    left = []
    for done in range(samples):
        error = rng.normal(size=(len(layout), 6)) * size
        left.append(problem.exact_of(layout.with_poses(np.asarray(layout.poses) + error)))
        if progress:
            progress(done + 1, samples)
    return Tolerance(
        planned,
        rows,
        np.array(left),
        dict(
            position=position,
            angle_deg=float(np.degrees(angle)),
            samples=samples,
            seed=seed,
            softness=softness,
            **problem.cases[0].conditions.record,
            objective=asdict(problem.objective),
        ),
    )
