"""Layouts and poses to try, for all methods that need no gradient."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int

from inspe_jax.core.arrays import on_host
from inspe_jax.core.parallel import parts_of
from inspe_jax.mounting.site import farthest_first
from inspe_jax.placement.space import Space

COLUMNS, FRAMES = 768, 6
"""Columns and frames in a sample on which layouts are compared. The next comparison has another
one, so that no layout is chosen because it suits one sample."""
BATCH = 32
"""Layouts in one step of grid and random search: about half a second on a large scene."""
SPACING = 8.0
"""Distance between neighbouring feet on the coarsest lattice [m]."""
FEET = 48
"""Most feet on the coarsest lattice."""

_ROWS, _SOME = 64, 8  # layouts in one compiled call, where there are more than some, or not
_FEW = 2  # so few layouts are faster without a compiled call


def project(space: Space, x: Float[np.ndarray, "M N"]) -> Float[np.ndarray, "M N"]:
    """The feasible layout nearest to each."""
    if len(x) <= _FEW:
        return np.stack([space.project(row, np) for row in np.asarray(x, float)])
    return _in_parts(_mapped(space)[0], x, _ROWS if len(x) > _SOME else _SOME)


def poses(space: Space, x: Float[np.ndarray, "M N"]) -> Float[np.ndarray, "M S p"]:
    """The poses of each layout, about the scene's centre [m, rad], as of :meth:`Space.poses`."""
    return _in_parts(_mapped(space)[1], x)


@lru_cache(maxsize=4)  # compiled functions keep their space in memory, so only a few are kept
def _mapped(space: Space) -> tuple[Any, Any]:
    return jax.jit(jax.vmap(space.project)), jax.jit(jax.vmap(space.poses))


def _in_parts(function: Any, x: np.ndarray, rows: int = _ROWS) -> np.ndarray:
    """A function of M layouts, called on parts of one shape so that it compiles once."""
    done = [np.asarray(function(on_host(part, float)), float) for part in parts_of(x, rows)]
    return np.concatenate(done)[: len(x)]


def of_unit(space: Space, u: int) -> Int[np.ndarray, " n"]:
    """The coordinates of a unit and its sensors: their indices."""
    index, members = space.index, list(space.given.members()[u])
    own = [index.base[u], index.arm[u], index.height[[u]]]
    return np.concatenate([*own, *(part[members].ravel() for part in index[3:])])


def lattice(space: Space, most: int = FEET) -> Float[np.ndarray, "F 2"]:
    """Candidate feet about the centre [m]: a lattice of :data:`SPACING`, and poles, the ``most``
    that are furthest apart, and the given foot of a unit that can stand on none."""
    feet = space.feet(SPACING)
    found = feet[farthest_first(feet, most)]
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
    """The feasible layouts nearest to ``x`` with sensors of unit ``u`` ``above`` the ground [m]."""
    index, x = space.index, np.array(x)
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
