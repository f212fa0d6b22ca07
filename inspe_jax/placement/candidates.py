"""Layouts and poses to try: what the baselines have in common."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from inspe_jax.core.parallel import parts_of
from inspe_jax.placement.coordinates import Coordinates
from inspe_jax.placement.space import Space

COLUMNS, FRAMES = 768, 6
"""Size of a sample: that of one gradient of the gradient methods."""
SPACING = 8.0
"""Distance of neighbouring feet on the coarsest lattice [m]."""
FEET = 48
"""Feet on the coarsest lattice, at most."""

_ROWS = 64  # layouts in one compiled call of what costs next to nothing
_FEW = 2  # layouts that are done sooner without
_FAR = 1e3  # beyond any limit [m]


def project(space: Space, x: Float[np.ndarray, "M N"]) -> Float[np.ndarray, "M N"]:
    """The nearest feasible layout to each."""
    if len(x) <= _FEW:
        return np.stack([space.project(row, np) for row in np.asarray(x, float)])
    return _in_parts(_mapped(space)[0], x)


def poses(space: Space, x: Float[np.ndarray, "M N"]) -> Float[np.ndarray, "M S 6"]:
    """Poses about the scene's centre."""
    return _in_parts(_mapped(space)[1], x)


@lru_cache(maxsize=4)  # a space lives on in its own compiled functions: keep few
def _mapped(space: Space) -> tuple[Any, Any]:
    compiled = (jax.jit(jax.vmap(space.project)), jax.jit(jax.vmap(space.poses)))
    project, poses = (lambda x, f=f: f(jnp.asarray(x, float)) for f in compiled)
    return project, poses


def _in_parts(function: Any, x: np.ndarray) -> np.ndarray:
    """A function of M layouts by parts of one shape, so that it is compiled once."""
    done = [np.asarray(function(part), float) for part in parts_of(x, _ROWS)]
    return np.concatenate(done)[: len(x)]


def coordinates(space: Space) -> Coordinates:
    """The index of each coordinate, by name."""
    return space.split(np.arange(space.size))


def lattice(space: Space, most: int = FEET) -> Float[np.ndarray, "F 2"]:
    """Feet :data:`SPACING` apart and poles; of more than ``most``, those that are furthest apart.

    Units that can stand on none of them, as on a span wire, have their given feet there too.
    """
    feet = space.feet(SPACING)
    away = np.full(len(feet), np.inf)
    chosen = [0] if len(feet) else []
    while len(chosen) < min(most, len(feet)):
        away = np.minimum(away, np.hypot(*(feet - feet[chosen[-1]]).T))
        chosen.append(int(away.argmax()))
    found = feet[chosen]
    given = space.split(space.start(space.given)[0]).base
    lost = given[~space.can_stand(found).any(1)]
    return np.concatenate([found, np.unique(lost, axis=0)])


def set_heights(
    space: Space,
    x: Float[np.ndarray, "M N"],
    u: int,
    sensors: Sequence[int],
    above: Float[np.ndarray, "M m"],
) -> Float[np.ndarray, "M N"]:
    """Layouts with all sensors of unit ``u`` at heights ``above`` the ground at its foot [m].

    Projected, so that they are nearest to that among the feasible ones.
    """
    index, x = coordinates(space), np.array(x)
    rise = index.rise[list(sensors)]
    x[:, rise] = 0.0
    x[:, index.height[u]] = (above.min(1) + above.max(1)) / 2
    x = project(space, x)
    x[:, rise] = above - x[:, index.height[u], None]
    return project(space, x)


def above_ground(space: Space, x: Float[np.ndarray, " N"]) -> Float[np.ndarray, " S"]:
    """Height of each sensor above the ground at its unit's foot [m]."""
    c = space.split(x)
    unit = np.array([sensor.unit for sensor in space.given.sensors])
    return c.height[unit] + c.rise


def limits(space: Space, x: Float[np.ndarray, " N"]) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest height of each sensor above the ground [m], and pitch [rad]: (S, 2) each.

    Found by projecting what is far beyond them.
    """
    index, ends = coordinates(space), np.tile(x, (2, 1))
    for part in (index.height, index.rise, index.pitch):
        ends[:, part] = [[-_FAR], [_FAR]]
    low, high = project(space, ends)
    heights = np.stack([above_ground(space, low), above_ground(space, high)], -1)
    return heights, np.stack([low[index.pitch], high[index.pitch]], -1)
