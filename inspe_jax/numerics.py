"""Reading signed margins: the only place that knows hard from soft.

Geometry returns margins in metres, positive where the statement holds.
:func:`step` reads one; :func:`all_of` and :func:`any_of` combine readings. Each
margin is read first and combined afterwards: with three margins well inside,
thresholding their product would give a weak maybe.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def step(margin: Float[Array, "*n"], softness: float = 0.0) -> Float[Array, "*n"]:
    """1 where ``margin`` [m] is positive, 0 elsewhere; a logistic of width ``softness`` [m].

    ``softness`` is a Python number; 0 is the exact reading, and a margin of
    exactly 0 counts as a miss.
    """
    if softness == 0.0:
        return (margin > 0).astype(margin.dtype)
    return jax.nn.sigmoid(margin / softness)


def any_of(p: Float[Array, "*n"], axis: int) -> Float[Array, "*m"]:
    """Chance that at least one of independent readings holds: 1 − ∏(1 − p).

    Exactly 0 or 1 when every p is; unlike a clipped sum it keeps a gradient.
    """
    return 1.0 - jnp.prod(1.0 - p, axis=axis)


def any_other(p: Float[Array, "S *n"]) -> Float[Array, "S *n"]:
    """For each s, :func:`any_of` over all but s, along the first axis.

    ∏(1 − p) over the others is the whole product divided by 1 − p_s; factors that
    are exactly 0, where a sensor sees for certain, are counted and not divided.
    """
    miss = 1.0 - p
    certain = miss == 0.0
    factor = jnp.where(certain, 1.0, miss)
    others_certain = certain.sum(0) - certain > 0
    return 1.0 - jnp.where(others_certain, 0.0, jnp.prod(factor, axis=0) / factor)


def nonzero(x: Float[Array, "*n"], least: float = 1e-6) -> Float[Array, "*n"]:
    """``x`` kept at least ``least`` away from zero, on its own side: a safe denominator."""
    return jnp.where(jnp.abs(x) < least, jnp.where(x < 0, -least, least), x)
