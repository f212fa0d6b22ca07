"""Reading signed margins: the only place that knows hard from soft.

Geometry returns margins in metres, positive where the statement holds.
:func:`step` reads one; readings are combined afterwards, as chances: with three
margins well inside, thresholding their product would give a weak maybe.
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


def leave_one_out(p: Float[Array, "S ..."]) -> Float[Array, "1+S ..."]:
    """Chance that some reading holds: of all s in row 0, of all but s in row 1 + s.

    That is 1 − ∏(1 − p), exactly 0 or 1 when every p is; unlike a clipped sum it
    keeps a gradient. ∏(1 − p) over the others is the whole product divided by 1 − p_s; factors that
    are exactly 0, where a sensor sees for certain, are counted and not divided.
    """
    miss = 1.0 - p
    certain = (miss == 0.0).astype(p.dtype)
    factor = jnp.where(certain > 0, 1.0, miss)
    product, count = jnp.prod(factor, axis=0, keepdims=True), certain.sum(0, keepdims=True)
    factors = jnp.concatenate([jnp.ones_like(product), factor])
    counts = jnp.concatenate([count, count - certain])
    return 1.0 - jnp.where(counts > 0, 0.0, product / factors)


def dot(x: Float[Array, "... V"], y: Float[Array, " V"]) -> Float[Array, "..."]:
    """Σ x·y along the last axis, in three levels of partial sums.

    Adding a million numbers one after another in single precision loses 1e-4 of
    the sum; in levels of about a hundred it keeps 1e-6.
    """
    n = y.shape[-1]
    block = max(1, round(n ** (1 / 3)))
    room = block * block * (-(-n // (block * block)))
    x = jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, room - n)])
    y = jnp.pad(y, (0, room - n)).reshape(-1, block, block)
    x = x.reshape(*x.shape[:-1], -1, block, block)
    return (x * y.reshape((1,) * (x.ndim - 3) + y.shape)).sum(-1).sum(-1).sum(-1)


def nonzero(x: Float[Array, "*n"], least: float = 1e-6) -> Float[Array, "*n"]:
    """``x`` kept at least ``least`` away from zero, on its own side: a safe denominator."""
    return jnp.where(jnp.abs(x) < least, jnp.where(x < 0, -least, least), x)
