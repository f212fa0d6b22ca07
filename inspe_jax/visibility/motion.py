"""How road users of each class move about each column: what a radar's Doppler has to tell.

Frames are taken together: road users within about :data:`BLUR` of a column, at any time, say how
often one there moves, how fast and which way, and how many others are about.
"""

from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Array, Float

from inspe_jax.scene.traffic.frames import ROAD_USERS, TrafficFrames

BLUR = 2.0
"""Standard deviation of the weights by distance [m]: a lane and half of the next one."""
STANDS = 0.1
"""Slower road users stand [m/s]."""
PRIOR = 1.0
"""A column's mean has so many road users more, that move as their class does all over the scene."""
_CELL = 1.0  # edge of the cells that road users are counted in [m]


class Motion(NamedTuple):
    """How road users of K classes move at C columns.

    ``moving`` is the share that moves. ``spread`` is the mean of v vᵀ over those that do, xx, xy
    and yy [m²/s²]. ``density`` is the number of all road users per area [1/m²].
    """

    moving: Float[Array | np.ndarray, "*N K C"]
    spread: Float[Array | np.ndarray, "*N K 3 C"]
    density: Float[Array | np.ndarray, "*N C"]


def motion_of(traffic: TrafficFrames, columns: Float[np.ndarray, "L 2"]) -> Motion:
    """How the road users of all frames move about columns, at x and y in the world [m].

    Where a class is not seen, it moves as it does elsewhere in the scene, in any direction. A class
    that is nowhere moves at its top speed in any direction; so do all where none ever moves, as in
    frames without velocities.
    """
    low = columns.min(0) - 4 * BLUR
    shape = np.ceil((columns.max(0) + 4 * BLUR - low) / _CELL).astype(int)
    edges = [a + _CELL * np.arange(n + 1) for a, n in zip(low, shape, strict=True)]
    x, y = ((columns - low) / _CELL).astype(int).T
    velocity = np.where(traffic.valid[..., None], traffic.velocity, 0.0)[..., :2]
    moves = np.linalg.norm(velocity, axis=-1) > STANDS
    known = bool(moves.any())
    alike = 2 * np.pi * (BLUR / _CELL) ** 2  # from a mean over cells to a sum of weights up to 1
    moving, spread, density = [], [], np.zeros(len(columns))
    for kind, user in enumerate(ROAD_USERS):
        own = traffic.valid & (traffic.kind == kind)
        some, (vx, vy) = moves[own].astype(float), velocity[own].T
        share, square = 1.0, user.top_speed**2
        if known and len(some):
            share = float(some.mean())
            square = float(((vx * vx + vy * vy) * some).sum() / max(some.sum(), 1.0))
        at = traffic.center[own]
        near = [
            scipy.ndimage.gaussian_filter(
                np.histogram2d(at[:, 0], at[:, 1], edges, weights=weights)[0], BLUR / _CELL
            )[x, y]
            for weights in (
                np.ones(len(some)),
                some,
                *(some * v for v in (vx * vx, vx * vy, vy * vy)),
            )
        ]
        density += near[0] / (traffic.frame_count * _CELL**2)
        count, number, *squares = alike * known * np.stack(near)
        number += PRIOR * share
        squares[0] += PRIOR * share * square / 2
        squares[2] += PRIOR * share * square / 2
        moving.append(number / (count + PRIOR))
        spread.append(np.stack(squares) / np.maximum(number, 1e-9))
    return Motion(np.stack(moving), np.stack(spread), density)
