"""DiscoNet (Li et al. 2021): a graph of agents whose edges have a weight for each cell.

Its teacher joins the pillars of all units from the start; the distillation loss is in
:mod:`inspe_jax.perception.training.train`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from inspe_jax.perception.fusion.mean import mean_of
from inspe_jax.perception.layers import Linear, Perceptron

HIDDEN = (32, 8)
"""Channels of the edges' network. DiscoNet has 128, 32 and 8."""


class DiscoNet(eqx.Module):
    """Edge weights are 1 × 1 convolutions of a pair of agents, and sum to one over senders."""

    receiver: Linear
    sender: Linear
    edge: Perceptron

    def __init__(self, channels: int, modalities: tuple[int, ...], key: Array) -> None:
        a, b, c = jax.random.split(key, 3)
        # A linear map of a pair is the sum of one of each; together, their input has variance 2.
        self.receiver = Linear(channels, HIDDEN[0], a)
        self.sender = Linear(channels, HIDDEN[0], b, bias=False)
        self.edge = Perceptron(HIDDEN[0], HIDDEN[1], 1, c)

    def __call__(
        self, x: Float[Array, "B A H W C"], present: Bool[Array, "B A"]
    ) -> Float[Array, "B H W C"]:
        pairs = self.receiver(x)[:, :, None] + self.sender(x)[:, None]  # (B, A, A, H, W, c)
        scores = self.edge(jax.nn.relu(pairs))[..., 0]
        scores = jnp.where(present[:, None, :, None, None], scores, -jnp.inf)
        weights = jax.nn.softmax(scores, 2)
        return mean_of(jnp.einsum("bijhw,bjhwc->bihwc", weights, x), present)
