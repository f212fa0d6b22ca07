"""V2VNet (Wang et al. 2020): rounds of messages between agents, taken in by a gated unit."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from inspe_jax.perception.fusion.mean import mean_of
from inspe_jax.perception.layers import Conv

ROUNDS = 2


class ConvGRU(eqx.Module):
    """A gated recurrent unit (Cho et al. 2014) whose maps are convolutions."""

    gates: Conv
    candidate: Conv

    def __init__(self, channels: int, key: Array) -> None:
        first, second = jax.random.split(key)
        self.gates = Conv(2 * channels, 2 * channels, first)
        self.candidate = Conv(2 * channels, channels, second)

    def __call__(
        self, message: Float[Array, "*n h w c"], state: Float[Array, "*n h w c"]
    ) -> Float[Array, "*n h w c"]:
        both = jnp.concatenate([message, state], -1)
        update, reset = jnp.split(jax.nn.sigmoid(self.gates(both)), 2, -1)
        candidate = jnp.tanh(self.candidate(jnp.concatenate([message, reset * state], -1)))
        return (1 - update) * candidate + update * state


class V2VNet(eqx.Module):
    """Messages are a convolution of sender and receiver; the mean over senders is taken in."""

    receiver: Conv
    sender: Conv
    unit: ConvGRU

    def __init__(self, channels: int, modalities: tuple[int, ...], key: Array) -> None:
        a, b, c = jax.random.split(key, 3)
        # A convolution of a pair is the sum of one of each.
        self.receiver = Conv(channels, channels, a)
        self.sender = Conv(channels, channels, b)
        self.unit = ConvGRU(channels, c)

    def __call__(
        self, x: Float[Array, "B A H W C"], present: Bool[Array, "B A"]
    ) -> Float[Array, "B H W C"]:
        agents = x.shape[1]
        others = present[:, None] & ~jnp.eye(agents, dtype=bool)[None]  # (B, receiver, sender)
        count = jnp.maximum(others.sum(-1, keepdims=True), 1)
        weight = others.astype(x.dtype) / count.astype(x.dtype)
        state = x
        for _ in range(ROUNDS):
            pairs = self.receiver(state)[:, :, None] + self.sender(state)[:, None]
            messages = jax.nn.relu(pairs)  # (B, A, A, H, W, C)
            heard = jnp.einsum("bijhwc,bij->bihwc", messages, weight)
            state = self.unit(heard, state)
        return mean_of(state, present)
