"""How installation errors change a score: slopes by sensor, and scores after random errors."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from inspe_jax.core.errors import InspeError
from inspe_jax.placement.objective import Objective
from inspe_jax.placement.problem import AnyScene, Problem, cases_of
from inspe_jax.placement.run import check_seed
from inspe_jax.scoring.tiled_scene import tiled_scene_of
from inspe_jax.sensing.conditions import Conditions
from inspe_jax.sensing.layout import Layout

SOFTNESS = 0.2
"""Softness of the slopes [m]; rays are read as a density."""
POSITION_STEP = 0.1
"""Shift for which slopes along x, y and z are given [m]."""
LIMITS = dict(position=(0, 2, " m"), angle=(0, 30, "°"), samples=(1, 10_000, ""))
"""Allowed range of each option, with its unit."""


@dataclass(frozen=True)
class Slopes:
    """What P_sm gains when one sensor moves by 10 cm along x, y or z, or turns by 1° to the left
    (``yaw``) or up (``pitch``): derivatives, so small where a search has ended."""

    sensor: str
    x: float
    y: float
    z: float
    yaw: float
    pitch: float


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class Tolerance:
    """How installation errors change the objective: the exact ``score`` as planned, those ``left``
    (M,) after M random errors, ``slopes`` of each sensor, and the ``settings``."""

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
        """The objective that 95 of 100 installations reach: the 5 % quantile."""
        return float(np.quantile(self.left, 0.05))


def check_errors(position: float, angle: float, samples: int, seed: int) -> None:
    """Raise InspeError where an option of :func:`tolerance` is out of range."""
    check_seed(seed)
    given = dict(position=position, angle=float(np.degrees(angle)), samples=samples)
    for name, value in given.items():
        low, high, unit = LIMITS[name]
        if not low <= round(value, 9) <= high:
            raise InspeError(
                f"{name} {value:g}{unit} is out of range: between {low}{unit} and {high}{unit}"
            )


def tolerance(
    scene: AnyScene,
    layout: Layout | str,
    *,
    position: float = 0.1,
    angle: float = float(np.radians(1.0)),
    samples: int = 50,
    seed: int = 0,
    objective: Objective | None = None,
    progress: Callable[[int, int], None] | None = None,
    conditions: Conditions | str | None = None,
) -> Tolerance:
    """Slopes of the objective for every sensor, and the objectives after random errors.

    Every sensor is shifted along x, y and z, and turned in yaw and pitch. Slopes are those of the
    soft score: the exact score is a step function, and has none.

    Args:
        scene, layout, conditions: As in :func:`inspe_jax.evaluate`, also by name.
        position, angle: Standard deviations of independent normal errors [m, rad].
        samples: Number of random installations, whose scores are exact.
        seed: Of their errors.
        objective: What is scored, P_sm if None.
        progress: Called with (installations done, installations).

    Returns:
        The slopes, the score as planned, and those of the installations.

    Raises:
        InspeError: An option is out of range, or as :func:`inspe_jax.evaluate`.
    """
    check_errors(position, angle, samples, seed)
    problem = Problem(cases_of(scene, conditions), layout, objective)
    layout = problem.layout
    planned = problem.exact_of(layout)
    worlds = tuple(
        tiled_scene_of(case.scene, whole=True, masks=False).bucketed for case in problem.cases
    )
    softness = jnp.asarray(SOFTNESS, float)
    slope = np.asarray(problem.slope(problem.poses_of(layout), worlds, softness)[1], float)
    per = np.array([POSITION_STEP] * 3 + [np.radians(1.0)] * 3)
    rows = tuple(
        Slopes(sensor.name, *(row[:6] * per)[[0, 1, 2, 5, 4]].tolist())
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
            softness=SOFTNESS,
            **problem.cases[0].conditions.record,
            objective=asdict(problem.objective),
        ),
    )
