"""Layers of detectors. Maps are (…, H, W, C); norms are over one map: a batch's are much alike."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

Activation = Callable[[Any], Any]
Map = Float[Array, "*n h w c"]

NEAR_ZERO = 1e-5  # added to variances, as is usual
GROUPS = 8  # groups of channels of a norm; every number of channels is a multiple of it


def _he(key: Array, shape: tuple[int, ...], inputs: int) -> Float[Array, "..."]:
    """Weights for an input of variance 1 and a rectifier behind (He et al. 2015)."""
    return jax.random.normal(key, shape, jnp.float32) * (2 / inputs) ** 0.5


class Linear(eqx.Module):
    """A matrix on the last axis."""

    weight: Float[Array, "c d"]
    bias: Float[Array, " d"] | None

    def __init__(self, inputs: int, outputs: int, key: Array, *, bias: bool = True) -> None:
        self.weight = _he(key, (inputs, outputs), inputs)
        self.bias = jnp.zeros(outputs) if bias else None

    def __call__(self, x: Float[Array, "*n c"]) -> Float[Array, "*n d"]:
        found = x @ self.weight
        return found if self.bias is None else found + _under(self.bias, found)


class Conv(eqx.Module):
    """A convolution of maps, with zeros around them; a ``stride`` divides their sides."""

    weight: Float[Array, "k k c d"]
    bias: Float[Array, " d"]
    stride: int = eqx.field(static=True)

    def __init__(
        self, inputs: int, outputs: int, key: Array, *, width: int = 3, stride: int = 1
    ) -> None:
        self.weight = _he(key, (width, width, inputs, outputs), width * width * inputs)
        self.bias = jnp.zeros(outputs)
        self.stride = stride

    def __call__(self, x: Map) -> Float[Array, "*n hs ws d"]:
        maps = x.reshape(-1, *x.shape[-3:])
        strides, axes = (self.stride, self.stride), ("NHWC", "HWIO", "NHWC")
        found = lax.conv_general_dilated(maps, self.weight, strides, "SAME", dimension_numbers=axes)
        return (found + _under(self.bias, found)).reshape(*x.shape[:-3], *found.shape[1:])


class Depthwise(eqx.Module):
    """A convolution of each channel: shifted maps are faster on CPUs than XLA's groups."""

    weight: Float[Array, "k k c"]
    stride: int = eqx.field(static=True)

    def __init__(self, channels: int, key: Array, *, stride: int = 1) -> None:
        self.weight = _he(key, (3, 3, channels), 9)
        self.stride = stride

    def __call__(self, x: Float[Array, "n h w c"]) -> Float[Array, "n hs ws c"]:
        _, high, wide, _ = x.shape
        step, padded = self.stride, jnp.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)))
        weight = self.weight[None, None, None]
        parts = [
            padded[:, i : i + high : step, j : j + wide : step] * weight[:, :, :, i, j]
            for i, j in np.ndindex(3, 3)
        ]
        return sum(parts[1:], parts[0])


class Norm(eqx.Module):
    """Normalisation over all cells and a group of channels (Wu and He 2018), in one reading."""

    scale: Float[Array, " c"]
    shift: Float[Array, " c"]

    def __init__(self, channels: int) -> None:
        self.scale, self.shift = jnp.ones(channels), jnp.zeros(channels)

    def __call__(self, x: Map) -> Map:
        mean, square = (self._of_groups(moment.mean((-3, -2))) for moment in (x, jnp.square(x)))
        steep = lax.rsqrt(jnp.maximum(square - mean**2, 0) + NEAR_ZERO)
        slope = steep * _under(self.scale, steep)
        level = _under(self.shift, slope) - mean * slope
        return x * slope[..., None, None, :] + level[..., None, None, :]

    def _of_groups(self, moments: Float[Array, "*n c"]) -> Float[Array, "*n c"]:
        parts = moments.reshape(*moments.shape[:-1], GROUPS, -1)
        mean = jnp.broadcast_to(parts.mean(-1, keepdims=True), parts.shape)
        return mean.reshape(moments.shape)


class CellNorm(eqx.Module):
    """Normalisation of the channels of each cell by themselves (Ba et al. 2016)."""

    scale: Float[Array, " c"]
    shift: Float[Array, " c"]

    def __init__(self, channels: int) -> None:
        self.scale, self.shift = jnp.ones(channels), jnp.zeros(channels)

    def __call__(self, x: Float[Array, "*n c"]) -> Float[Array, "*n c"]:
        off = x - x.mean(-1, keepdims=True)
        found = off * lax.rsqrt(jnp.square(off).mean(-1, keepdims=True) + NEAR_ZERO)
        return found * _under(self.scale, found) + _under(self.shift, found)


class Block(eqx.Module):
    """A convolution, a norm and a rectifier, or another activation."""

    conv: Conv
    norm: Norm
    activation: Activation = eqx.field(static=True)

    def __init__(
        self,
        inputs: int,
        outputs: int,
        key: Array,
        *,
        width: int = 3,
        stride: int = 1,
        activation: Activation = jax.nn.relu,
    ) -> None:
        self.conv = Conv(inputs, outputs, key, width=width, stride=stride)
        self.norm = Norm(outputs)
        self.activation = activation

    def __call__(self, x: Map) -> Float[Array, "*n hs ws d"]:
        return self.activation(self.norm(self.conv(x)))


class Perceptron(eqx.Module):
    """Two linear maps with a rectifier, or another activation, between, of each cell by itself."""

    inner: Linear
    outer: Linear
    activation: Activation = eqx.field(static=True)

    def __init__(
        self,
        inputs: int,
        hidden: int,
        outputs: int,
        key: Array,
        *,
        activation: Activation = jax.nn.relu,
    ) -> None:
        first, second = jax.random.split(key)
        self.inner = Linear(inputs, hidden, first)
        self.outer = Linear(hidden, outputs, second)
        self.activation = activation

    def __call__(self, x: Float[Array, "*n c"]) -> Float[Array, "*n d"]:
        return self.outer(self.activation(self.inner(x)))


def enlarged(x: Map, times: int) -> Float[Array, "*n ht wt c"]:
    """Maps with every cell repeated ``times`` along both sides."""
    return jnp.repeat(jnp.repeat(x, times, -3), times, -2) if times > 1 else x


def attend(
    query: Float[Array, "*n q h c"],
    key: Float[Array, "*n k h c"],
    value: Float[Array, "*n k h d"],
    mask: Any = None,
    bias: Any = None,
) -> Float[Array, "*n q h d"]:
    """Scaled dot-product attention with heads h (Vaswani et al. 2017). ``mask`` (…, k) is true for
    at least one key; ``bias`` is added to the scores (…, h, q, k)."""
    scores = jnp.einsum("...qhc,...khc->...hqk", query, key) * query.shape[-1] ** -0.5
    if bias is not None:
        scores = scores + bias
    if mask is not None:
        scores = jnp.where(mask[..., None, None, :], scores, -jnp.inf)
    return jnp.einsum("...hqk,...khd->...qhd", jax.nn.softmax(scores, -1), value)


def _under(vector: Float[Array, " c"], x: Float[Array, "*n c"]) -> Float[Array, "*n c"]:
    """A vector with the axes of ``x`` before it: ranks are promoted nowhere by themselves."""
    return vector.reshape((1,) * (x.ndim - 1) + vector.shape)
