"""Encoders of pictures: of blocks as in EfficientNet (Tan and Le 2019) or ResNet (He et al. 2016).

Both give maps at a quarter of the picture's sides, where coarser maps, enlarged, are joined to
finer ones twice: those at a sixteenth to those at an eighth, as in Lift, Splat, Shoot, and what
comes of it to the stem's. On a picture of 400 x 300 from 7 m above the road, a cell of an eighth is
6 m of the road 30 m away. They have fewer blocks than their originals and are not pre-trained.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, UInt8

from inspe_jax.perception.layers import Block, Conv, Depthwise, Norm, Perceptron, enlarged

STEM = (16, 24)
"""Channels at a half and a quarter of the sides, which two blocks give: the inverted residuals that
EfficientNet has there widen maps of 60,000 cells, and would take a CPU longer than all that follows
(EfficientNetV2 has none there either)."""
WIDTHS = (48, 96)
"""Channels at an eighth and a sixteenth of the sides; EfficientNet-B0 has 40 and 112."""
EXPANSION = 3
"""How many times wider an inverted residual is inside; EfficientNet has 6, for 1,000 classes, which
takes twice as long."""
JOINED = 64
"""Channels of the stages' maps after they are joined."""


class InvertedResidual(eqx.Module):
    """EfficientNet's MBConv: widen, convolve each channel, weigh channels by the whole picture
    (squeeze and excitation, Hu et al. 2018), narrow."""

    widen: Block
    depthwise: Depthwise
    norm: Norm
    weigh: Perceptron
    narrow: Block

    def __init__(self, inputs: int, outputs: int, key: Array, *, stride: int = 1) -> None:
        inside = inputs * EXPANSION
        a, b, c, d = jax.random.split(key, 4)
        self.widen = Block(inputs, inside, a, width=1, activation=jax.nn.swish)
        self.depthwise = Depthwise(inside, b, stride=stride)
        self.norm = Norm(inside)
        self.weigh = Perceptron(inside, max(1, inputs // 4), inside, c, activation=jax.nn.swish)
        self.narrow = Block(inside, outputs, d, width=1, activation=jax.nn.identity)

    def __call__(self, x: Float[Array, "n h w c"]) -> Float[Array, "n hs ws d"]:
        inside = jax.nn.swish(self.norm(self.depthwise(self.widen(x))))
        weight = jax.nn.sigmoid(self.weigh(inside.mean((1, 2))))
        found = self.narrow(inside * weight[:, None, None])
        return found + x if found.shape == x.shape else found


class Bottleneck(eqx.Module):
    """ResNet's bottleneck: narrow, convolve, widen, beside a shortcut."""

    narrow: Block
    convolve: Block
    widen: Block
    shortcut: Conv | None

    def __init__(self, inputs: int, outputs: int, key: Array, *, stride: int = 1) -> None:
        a, b, c, d = jax.random.split(key, 4)
        inside = outputs // 2
        self.narrow = Block(inputs, inside, a, width=1)
        self.convolve = Block(inside, inside, b, stride=stride)
        self.widen = Block(inside, outputs, c, width=1, activation=jax.nn.identity)
        same = inputs == outputs and stride == 1
        self.shortcut = None if same else Conv(inputs, outputs, d, width=1, stride=stride)

    def __call__(self, x: Float[Array, "n h w c"]) -> Float[Array, "n hs ws d"]:
        beside = x if self.shortcut is None else self.shortcut(x)
        return jax.nn.relu(self.widen(self.convolve(self.narrow(x))) + beside)


BLOCKS: dict[str, type[InvertedResidual] | type[Bottleneck]] = {
    "efficientnet": InvertedResidual,
    "resnet": Bottleneck,
}
"""By name of the encoder: what its stages are made of."""


class ImageEncoder(eqx.Module):
    """A stem, whose two blocks each halve the sides; two stages of two blocks, of which the first
    does; and their maps joined."""

    stem: tuple[Block, Block]
    stages: list[tuple[Any, Any]]
    join: Block
    join_stem: Block

    def __init__(self, name: str, channels: int, key: Array) -> None:
        block: Callable[..., Any] = BLOCKS[name]
        first, second, third, last, *keys = jax.random.split(key, 4 + 2 * len(WIDTHS))
        self.stem = (Block(3, STEM[0], first, stride=2), Block(*STEM, second, stride=2))
        self.stages, inputs = [], STEM[-1]
        for k, width in enumerate(WIDTHS):
            halve = block(inputs, width, keys[2 * k], stride=2)
            self.stages.append((halve, block(width, width, keys[2 * k + 1])))
            inputs = width
        self.join = Block(sum(WIDTHS), JOINED, third)
        self.join_stem = Block(STEM[-1] + JOINED, channels, last)

    def __call__(self, pixels: UInt8[Array, "n H W 3"]) -> Float[Array, "n h w c"]:
        x = pixels.astype(jnp.float32) / 127.5 - 1
        for block in self.stem:
            x = block(x)
        maps = [x]
        for halve, keep in self.stages:
            maps.append(keep(halve(maps[-1])))
        stem, finer, coarser = maps
        return self.join_stem(_beside(stem, self.join(_beside(finer, coarser))))


def _beside(
    finer: Float[Array, "n h w c"], coarser: Float[Array, "n i j d"]
) -> Float[Array, "n h w e"]:
    """The channels of both, at the finer map's cells, which are half as wide."""
    high, wide = finer.shape[1:3]
    return jnp.concatenate([finer, enlarged(coarser, 2)[:, :high, :wide]], -1)
