"""How agents' maps, in the intersection's frame, become one: by the mean of what each has fused."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from inspe_jax.perception.layers import CellNorm, Conv, Linear, Map, Perceptron, attend

AgentMaps = Float[Array, "B A H W C"]
Present = Bool[Array, "B A"]
FusedMap = Float[Array, "B H W C"]


def mean_of(x: AgentMaps, present: Present) -> FusedMap:
    """The mean over agents that are ``present``."""
    there = present.astype(x.dtype)
    return jnp.einsum("bahwc,ba->bhwc", x, there / there.sum(1, keepdims=True))


class Mean(eqx.Module):
    """No fusion but the mean: for detectors with one agent."""

    def __init__(self, channels: int, modalities: Sequence[int], key: Array) -> None:
        """It has no parameters."""

    def __call__(self, x: AgentMaps, present: Present) -> FusedMap:
        return mean_of(x, present)


class AttFuse(Mean):
    """AttFuse (Xu et al. 2022, OPV2V): agents' features at a cell attend to one another."""

    def __call__(self, x: AgentMaps, present: Present) -> FusedMap:
        cells = jnp.moveaxis(x, 1, 3)[..., None, :]  # (B, H, W, A, 1, C)
        found = attend(cells, cells, cells, present[:, None, None])
        return mean_of(jnp.moveaxis(found[..., 0, :], 3, 1), present)


EDGES = (32, 8)  # channels of the edges' network. DiscoNet has 128, 32 and 8


class DiscoNet(eqx.Module):
    """DiscoNet (Li et al. 2021): a graph of agents whose edges have a weight for each cell, by 1 ×
    1 convolutions of pairs, which sum to one over senders. Of four maps, one is distilled."""

    receiver: Linear
    sender: Linear
    edge: Perceptron

    def __init__(self, channels: int, modalities: Sequence[int], key: Array) -> None:
        a, b, c = jax.random.split(key, 3)
        # A linear map of a pair is the sum of one of each; together, their input has variance 2.
        self.receiver = Linear(channels, EDGES[0], a)
        self.sender = Linear(channels, EDGES[0], b, bias=False)
        self.edge = Perceptron(EDGES[0], EDGES[1], 1, c)

    def __call__(self, x: AgentMaps, present: Present) -> FusedMap:
        pairs = self.receiver(x)[:, :, None] + self.sender(x)[:, None]  # (B, A, A, H, W, c)
        scores = self.edge(jax.nn.relu(pairs))[..., 0]
        scores = jnp.where(present[:, None, :, None, None], scores, -jnp.inf)
        return mean_of(jnp.einsum("bijhw,bjhwc->bihwc", jax.nn.softmax(scores, 2), x), present)


ROUNDS = 2


class ConvGRU(eqx.Module):
    """A gated recurrent unit (Cho et al. 2014) whose maps are convolutions."""

    gates: Conv
    candidate: Conv

    def __init__(self, channels: int, key: Array) -> None:
        first, second = jax.random.split(key)
        self.gates = Conv(2 * channels, 2 * channels, first)
        self.candidate = Conv(2 * channels, channels, second)

    def __call__(self, message: Map, state: Map) -> Map:
        both = jnp.concatenate([message, state], -1)
        update, reset = jnp.split(jax.nn.sigmoid(self.gates(both)), 2, -1)
        candidate = jnp.tanh(self.candidate(jnp.concatenate([message, reset * state], -1)))
        return (1 - update) * candidate + update * state


class V2VNet(eqx.Module):
    """V2VNet (Wang et al. 2020): rounds of messages, convolutions of sender and receiver, whose
    mean a gated unit takes in. They are not compressed, and no perceptron follows."""

    receiver: Conv
    sender: Conv
    unit: ConvGRU

    def __init__(self, channels: int, modalities: Sequence[int], key: Array) -> None:
        a, b, c = jax.random.split(key, 3)
        # A convolution of a pair is the sum of one of each.
        self.receiver = Conv(channels, channels, a)
        self.sender = Conv(channels, channels, b)
        self.unit = ConvGRU(channels, c)

    def __call__(self, x: AgentMaps, present: Present) -> FusedMap:
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


def to_windows(x: Map, side: int, *, sparse: bool = False) -> Float[Array, "*n m t c"]:
    """m windows of t = side² cells: neighbours, or spread evenly if ``sparse`` (Tu et al. 2022)."""
    *leading, high, wide, channels = x.shape
    if sparse:
        parts = x.reshape(-1, side, high // side, side, wide // side, channels)
        parts = parts.transpose(0, 2, 4, 1, 3, 5)
    else:
        parts = x.reshape(-1, high // side, side, wide // side, side, channels).swapaxes(2, 3)
    return parts.reshape(*leading, -1, side * side, channels)


def from_windows(x: Float[Array, "*n m t c"], high: int, wide: int, *, sparse: bool = False) -> Map:
    """The inverse of :func:`to_windows`."""
    *leading, _, tokens, channels = x.shape
    side = round(tokens**0.5)
    parts = x.reshape(-1, high // side, wide // side, side, side, channels)
    parts = parts.transpose(0, 3, 1, 4, 2, 5) if sparse else parts.swapaxes(2, 3)
    return parts.reshape(*leading, high, wide, channels)


def offsets(side: int) -> Int[np.ndarray, "t t"]:
    """For each two cells of a window, the number of the offset between them, of (2 side − 1)²."""
    at = np.stack(np.meshgrid(*[np.arange(side)] * 2, indexing="ij"), -1).reshape(-1, 2)
    apart = at[:, None] - at[None] + side - 1
    return apart[..., 0] * (2 * side - 1) + apart[..., 1]


def _by_modality(shape: tuple[int, ...], key: Array) -> Float[Array, "*k c d"]:
    """A matrix for each modality, or for each pair of them, that keeps variance."""
    return jax.random.normal(key, shape, jnp.float32) * shape[-2] ** -0.5


class HeterogeneousAttention(eqx.Module):
    """In each window, the cells of all agents attend to one another, by modality: as in V2X-ViT (Xu
    et al. 2022) and HM-ViT (Xiang et al. 2023). Queries, keys, values and outputs have matrices by
    modality; relations and messages, by those of receiver and sender."""

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

    def __call__(self, x: Float[Array, "B A M T C"], present: Present) -> Float[Array, "B A M T C"]:
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


HM_HEADS = 2
HM_SIDE = 4  # cells along the side of a window and of a sparse grid


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
        self.attention = HeterogeneousAttention(channels, modalities, HM_HEADS, first)
        self.perceptron = Perceptron(channels, 2 * channels, channels, second)
        self.sparse = sparse

    def __call__(self, x: AgentMaps, present: Present) -> AgentMaps:
        windows = self.attention(to_windows(self.norm(x), HM_SIDE, sparse=self.sparse), present)
        x = x + from_windows(windows, *x.shape[2:4], sparse=self.sparse)
        return x + self.perceptron(self.last_norm(x))


class HMViT(eqx.Module):
    """HM-ViT (Xiang et al. 2023): cells of all agents attend to one another within windows, then
    within sparse grids (once; its code has two pairs, parts by modality, and a bias by offset)."""

    blocks: list[GraphAttention]

    def __init__(self, channels: int, modalities: Sequence[int], key: Array) -> None:
        self.blocks = [
            GraphAttention(channels, modalities, sparse, own)
            for sparse, own in zip((False, True), jax.random.split(key), strict=True)
        ]

    def __call__(self, x: AgentMaps, present: Present) -> FusedMap:
        for block in self.blocks:
            x = block(x, present)
        return mean_of(x, present)


V2X_LAYERS = 3
V2X_HEADS = 4
V2X_WINDOWS = {4: 4, 8: 2, 16: 1}
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

    def __call__(self, x: Map) -> Map:
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

    def __init__(self, channels: int, modalities: Sequence[int], key: Array) -> None:
        a, b, c, *keys = jax.random.split(key, 3 + len(V2X_WINDOWS))
        self.norms = (CellNorm(channels), CellNorm(channels), CellNorm(channels))
        self.agents = HeterogeneousAttention(channels, modalities, V2X_HEADS, a)
        self.windows = tuple(
            WindowAttention(channels, side, heads, own)
            for (side, heads), own in zip(V2X_WINDOWS.items(), keys, strict=True)
        )
        self.weigh = Perceptron(channels, channels // 2, len(V2X_WINDOWS) * channels, b)
        self.perceptron = Perceptron(channels, 2 * channels, channels, c)

    def __call__(self, x: AgentMaps, present: Present) -> AgentMaps:
        cells = self.norms[0](x).reshape(*x.shape[:2], -1, 1, x.shape[-1])
        x = x + self.agents(cells, present).reshape(x.shape)  # each cell is a window by itself
        x = x + self._windows(self.norms[1](x))
        return x + self.perceptron(self.norms[2](x))

    def _windows(self, x: AgentMaps) -> AgentMaps:
        branches = jnp.stack([window(x) for window in self.windows])  # (S, B, A, H, W, C)
        scores = self.weigh(branches.sum(0).mean((2, 3)))
        scores = scores.reshape(*scores.shape[:2], len(self.windows), -1)
        return jnp.einsum("sbahwc,basc->bahwc", branches, jax.nn.softmax(scores, 2))


class V2XViT(eqx.Module):
    """V2X-ViT (Xu et al. 2022): layers of attention over agents, of split attention within windows
    (Zhang et al. 2020), and of a perceptron; then the mean over agents."""

    layers: list[Layer]

    def __init__(self, channels: int, modalities: Sequence[int], key: Array) -> None:
        keys = jax.random.split(key, V2X_LAYERS)
        self.layers = [Layer(channels, modalities, own) for own in keys]

    def __call__(self, x: AgentMaps, present: Present) -> FusedMap:
        for layer in self.layers:
            x = layer(x, present)
        return mean_of(x, present)
