"""HM-ViT (Xiang et al. 2023): attention over agents and cells at once, by modality.

All agents' features at the cells of a window, then at those of a sparse grid over the whole map,
attend to one another. Matrices go by the modality of sender and receiver.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from inspe_jax.perception.fusion.mean import mean_of
from inspe_jax.perception.fusion.windows import (
    ByModality,
    from_grids,
    from_windows,
    to_grids,
    to_windows,
)
from inspe_jax.perception.layers import CellNorm, Perceptron

BLOCKS = 1
"""Pairs of attention within windows and within sparse grids. HM-ViT has three; one takes as long as
all that comes before it."""
HEADS = 2
SIDE = 4
"""Cells along the side of a window and of a sparse grid."""


class GraphAttention(eqx.Module):
    """Cells of all agents attend to one another within windows, or within sparse grids."""

    norm: CellNorm
    queries: ByModality
    keys: ByModality
    values: ByModality
    relations: ByModality
    messages: ByModality
    outputs: ByModality
    last_norm: CellNorm
    perceptron: Perceptron
    modalities: tuple[int, ...] = eqx.field(static=True)
    sparse: bool = eqx.field(static=True)

    def __init__(self, channels: int, modalities: Sequence[int], sparse: bool, key: Array) -> None:
        kinds, each = max(modalities) + 1, channels // HEADS
        a, b, c, d, e, f, g = jax.random.split(key, 7)
        self.norm, self.last_norm = CellNorm(channels), CellNorm(channels)
        self.queries, self.keys, self.values, self.outputs = (
            ByModality((kinds,), channels, channels, own) for own in (a, b, c, d)
        )
        self.relations, self.messages = (
            ByModality((kinds, kinds, HEADS), each, each, own) for own in (e, f)
        )
        self.perceptron = Perceptron(channels, 2 * channels, channels, g)
        self.modalities, self.sparse = tuple(modalities), sparse

    def __call__(
        self, x: Float[Array, "B A H W C"], present: Bool[Array, "B A"]
    ) -> Float[Array, "B A H W C"]:
        apart: Callable[..., Any] = to_grids if self.sparse else to_windows
        together: Callable[..., Any] = from_grids if self.sparse else from_windows
        x = x + together(self._attend(apart(self.norm(x), SIDE), present), *x.shape[2:4])
        return x + self.perceptron(self.last_norm(x))

    def _attend(
        self, x: Float[Array, "B A M T C"], present: Bool[Array, "B A"]
    ) -> Float[Array, "B A M T C"]:
        kinds = np.array(self.modalities)
        query, key, value = (
            jnp.einsum("bamtc,acd->bamtd", x, part.weight[kinds]).reshape(*x.shape[:4], HEADS, -1)
            for part in (self.queries, self.keys, self.values)
        )
        # Matrices by the modalities of receiver and sender, (A, A, heads, c, c).
        relation, message = (
            part.weight[kinds[:, None], kinds[None, :]] for part in (self.relations, self.messages)
        )
        asked = jnp.einsum("bimtuc,ijucd->bimtjud", query, relation)
        sent = jnp.einsum("bjmsuc,ijucd->bijmsud", value, message)
        scores = jnp.einsum("bimtjud,bjmsud->bmuitjs", asked, key) * query.shape[-1] ** -0.5
        scores = jnp.where(present[:, None, None, None, None, :, None], scores, -jnp.inf)
        weights = jax.nn.softmax(scores, (-2, -1))
        found = jnp.einsum("bmuitjs,bijmsud->bimtud", weights, sent).reshape(x.shape)
        return jnp.einsum("bamtc,acd->bamtd", found, self.outputs.weight[kinds])


class HMViT(eqx.Module):
    """Blocks of attention within windows and within sparse grids, then the mean over agents."""

    blocks: list[tuple[GraphAttention, GraphAttention]]

    def __init__(self, channels: int, modalities: Sequence[int], key: Array) -> None:
        keys = jax.random.split(key, (BLOCKS, 2))
        self.blocks = [
            (
                GraphAttention(channels, modalities, False, local),
                GraphAttention(channels, modalities, True, sparse),
            )
            for local, sparse in keys
        ]

    def __call__(
        self, x: Float[Array, "B A H W C"], present: Bool[Array, "B A"]
    ) -> Float[Array, "B H W C"]:
        for local, sparse in self.blocks:
            x = sparse(local(x, present), present)
        return mean_of(x, present)
