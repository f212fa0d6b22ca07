"""HM-ViT (Xiang et al. 2023): attention over agents and cells at once, by modality.

All agents' features at the cells of a window, then at those of a sparse grid over the whole map,
attend to one another.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
from jaxtyping import Array, Bool, Float

from inspe_jax.perception.fusion.heterogeneous import HeterogeneousAttention
from inspe_jax.perception.fusion.mean import mean_of
from inspe_jax.perception.fusion.windows import from_grids, from_windows, to_grids, to_windows
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
    attention: HeterogeneousAttention
    last_norm: CellNorm
    perceptron: Perceptron
    sparse: bool = eqx.field(static=True)

    def __init__(self, channels: int, modalities: Sequence[int], sparse: bool, key: Array) -> None:
        first, second = jax.random.split(key)
        self.norm, self.last_norm = CellNorm(channels), CellNorm(channels)
        self.attention = HeterogeneousAttention(channels, modalities, HEADS, first)
        self.perceptron = Perceptron(channels, 2 * channels, channels, second)
        self.sparse = sparse

    def __call__(
        self, x: Float[Array, "B A H W C"], present: Bool[Array, "B A"]
    ) -> Float[Array, "B A H W C"]:
        apart: Callable[..., Any] = to_grids if self.sparse else to_windows
        together: Callable[..., Any] = from_grids if self.sparse else from_windows
        x = x + together(self.attention(apart(self.norm(x), SIDE), present), *x.shape[2:4])
        return x + self.perceptron(self.last_norm(x))


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
