"""V2X-ViT (Xu et al. 2022): attention between agents by their type, and within windows of each.

Three layers, each of heterogeneous attention over the agents at a cell, of attention within windows
at three scales whose results are weighed (split attention, Zhang et al. 2020), and of a perceptron.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from inspe_jax.perception.fusion.heterogeneous import HeterogeneousAttention
from inspe_jax.perception.fusion.mean import mean_of
from inspe_jax.perception.fusion.windows import from_windows, offsets, to_windows
from inspe_jax.perception.layers import CellNorm, Linear, Perceptron, attend

LAYERS = 3
HEADS = 4
WINDOWS = {4: 4, 8: 2, 16: 1}
"""Sides of windows [cells], and heads of each: larger windows have fewer, as in the paper."""


class WindowAttention(eqx.Module):
    """Attention within windows of one size, with a bias by offset (Liu et al. 2021)."""

    project: Linear
    output: Linear
    bias: Float[Array, "heads offsets"]
    side: int = eqx.field(static=True)
    heads: int = eqx.field(static=True)

    def __init__(self, channels: int, side: int, heads: int, key: Array) -> None:
        first, second = jax.random.split(key)
        self.project = Linear(channels, 3 * channels, first, bias=False)
        self.output = Linear(channels, channels, second)
        self.bias = jnp.zeros((heads, (2 * side - 1) ** 2))
        self.side, self.heads = side, heads

    def __call__(self, x: Float[Array, "*n h w c"]) -> Float[Array, "*n h w c"]:
        high, wide, channels = x.shape[-3:]
        tokens = to_windows(self.project(x), self.side)
        split = tokens.reshape(*tokens.shape[:-1], 3, self.heads, channels // self.heads)
        query, key, value = (split[..., k, :, :] for k in range(3))
        bias = self.bias[:, offsets(self.side)]
        bias = bias.reshape((1,) * (query.ndim - 3) + bias.shape)
        found = attend(query, key, value, bias=bias)
        return from_windows(self.output(found.reshape(*tokens.shape[:-1], channels)), high, wide)


class Layer(eqx.Module):
    """Attention between agents, attention within windows, and a perceptron, each added on."""

    norms: tuple[CellNorm, CellNorm, CellNorm]
    agents: HeterogeneousAttention
    windows: tuple[WindowAttention, ...]
    weigh: Perceptron
    perceptron: Perceptron

    def __init__(self, channels: int, types: Sequence[int], key: Array) -> None:
        a, b, c, *keys = jax.random.split(key, 3 + len(WINDOWS))
        self.norms = (CellNorm(channels), CellNorm(channels), CellNorm(channels))
        self.agents = HeterogeneousAttention(channels, types, HEADS, a)
        self.windows = tuple(
            WindowAttention(channels, side, heads, own)
            for (side, heads), own in zip(WINDOWS.items(), keys, strict=True)
        )
        self.weigh = Perceptron(channels, channels // 2, len(WINDOWS) * channels, b)
        self.perceptron = Perceptron(channels, 2 * channels, channels, c)

    def __call__(
        self, x: Float[Array, "B A H W C"], present: Bool[Array, "B A"]
    ) -> Float[Array, "B A H W C"]:
        x = x + self._agents(self.norms[0](x), present)
        x = x + self._windows(self.norms[1](x))
        return x + self.perceptron(self.norms[2](x))

    def _agents(
        self, x: Float[Array, "B A H W C"], present: Bool[Array, "B A"]
    ) -> Float[Array, "B A H W C"]:
        """Each cell is a window by itself."""
        cells = x.reshape(*x.shape[:2], -1, 1, x.shape[-1])
        return self.agents(cells, present).reshape(x.shape)

    def _windows(self, x: Float[Array, "B A H W C"]) -> Float[Array, "B A H W C"]:
        branches = jnp.stack([window(x) for window in self.windows])  # (S, B, A, H, W, C)
        scores = self.weigh(branches.sum(0).mean((2, 3)))
        scores = scores.reshape(*scores.shape[:2], len(self.windows), -1)
        return jnp.einsum("sbahwc,basc->bahwc", branches, jax.nn.softmax(scores, 2))


class V2XViT(eqx.Module):
    """The layers, then the mean over agents. ``types`` are the agents' modalities."""

    layers: list[Layer]

    def __init__(self, channels: int, types: Sequence[int], key: Array) -> None:
        self.layers = [Layer(channels, types, own) for own in jax.random.split(key, LAYERS)]

    def __call__(
        self, x: Float[Array, "B A H W C"], present: Bool[Array, "B A"]
    ) -> Float[Array, "B H W C"]:
        for layer in self.layers:
            x = layer(x, present)
        return mean_of(x, present)
