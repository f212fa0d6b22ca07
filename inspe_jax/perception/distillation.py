"""Learning from a teacher's maps (DiscoNet, Li et al. 2021).

The teacher is a detector of the LiDARs' pillars, joined over all units before anything else sees
them. At each cell, the student's features are to say what the teacher's say: the Kullback–Leibler
divergence of their distributions over channels.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

WEIGHT = 1.0
"""Of this loss beside those of heat and values. The divergence is a mean over cells here, and its
weight of 1e5 in DiscoNet's code is for a loss that is divided by more."""


def distillation(
    taught: Float[Array, "B h w c"], teacher: Float[Array, "B h w c"]
) -> Float[Array, ""]:
    """The divergence of the student's distribution over channels from the teacher's, for a cell."""
    target = jax.nn.log_softmax(lax.stop_gradient(teacher), -1)
    own = jax.nn.log_softmax(taught, -1)
    return WEIGHT * (jnp.exp(target) * (target - own)).sum(-1).mean()
