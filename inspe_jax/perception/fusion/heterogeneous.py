"""Attention between agents of several modalities: the heterogeneous attention of V2X-ViT (Xu et al.
2022) and, over more than one cell, of HM-ViT (Xiang et al. 2023)."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float


def _by_modality(shape: tuple[int, ...], key: Array) -> Float[Array, "*k c d"]:
    """A matrix for each modality, or for each pair of them, that keeps variance."""
    return jax.random.normal(key, shape, jnp.float32) * shape[-2] ** -0.5


class HeterogeneousAttention(eqx.Module):
    """In each window, the cells of all agents attend to one another.

    Queries, keys, values and outputs have matrices by the modality of the agent. How well a sender
    matches a receiver, and what the receiver takes of it, have matrices by both modalities.
    """

    queries: Float[Array, "k c c"]
    keys: Float[Array, "k c c"]
    values: Float[Array, "k c c"]
    relations: Float[Array, "k k h d d"]
    messages: Float[Array, "k k h d d"]
    outputs: Float[Array, "k c c"]
    modalities: tuple[int, ...] = eqx.field(static=True)
    heads: int = eqx.field(static=True)

    def __init__(self, channels: int, modalities: Sequence[int], heads: int, key: Array) -> None:
        kinds, each = max(modalities) + 1, channels // heads
        *of_one, relations, messages = jax.random.split(key, 6)
        self.queries, self.keys, self.values, self.outputs = (
            _by_modality((kinds, channels, channels), own) for own in of_one
        )
        self.relations, self.messages = (
            _by_modality((kinds, kinds, heads, each, each), own) for own in (relations, messages)
        )
        self.modalities, self.heads = tuple(modalities), heads

    def __call__(
        self, x: Float[Array, "B A M T C"], present: Bool[Array, "B A"]
    ) -> Float[Array, "B A M T C"]:
        """``x`` has M windows of T cells for each agent; absent agents are attended to by none."""
        kinds = np.array(self.modalities)
        query, key, value = (
            jnp.einsum("bamtc,acd->bamtd", x, part[kinds]).reshape(*x.shape[:4], self.heads, -1)
            for part in (self.queries, self.keys, self.values)
        )
        relation, message = (  # (receiver, sender, heads, c, c)
            part[kinds[:, None], kinds[None, :]] for part in (self.relations, self.messages)
        )
        asked = jnp.einsum("bimtuc,ijucd->bimtjud", query, relation)
        told = jnp.einsum("bjmsuc,ijucd->bijmsud", value, message)
        scores = jnp.einsum("bimtjud,bjmsud->bmuitjs", asked, key) * query.shape[-1] ** -0.5
        scores = jnp.where(present[:, None, None, None, None, :, None], scores, -jnp.inf)
        weights = jax.nn.softmax(scores, (-2, -1))
        found = jnp.einsum("bmuitjs,bijmsud->bimtud", weights, told).reshape(x.shape)
        return jnp.einsum("bamtc,acd->bamtd", found, self.outputs[kinds])
