"""Maps at three scales, and one map made of them (a feature pyramid, Lin et al. 2017)."""

import equinox as eqx
import jax
from jaxtyping import Array, Float

from inspe_jax.perception.layers import Block, enlarged

WIDTHS = (64, 96, 128)
"""Channels at a half, a quarter and an eighth of the side. As PointPillars' 64, 128, 256, but that
a CPU would take three times as long for these."""

Maps = tuple[Float[Array, "*n h w c"], ...]
"""Maps at three scales."""


class Pyramid(eqx.Module):
    """Two blocks a scale; the first of them halves the sides."""

    blocks: list[tuple[Block, Block]]

    def __init__(self, inputs: int, key: Array) -> None:
        self.blocks = []
        for channels, own in zip(WIDTHS, jax.random.split(key, len(WIDTHS)), strict=True):
            first, second = jax.random.split(own)
            halve = Block(inputs, channels, first, stride=2)
            self.blocks.append((halve, Block(channels, channels, second)))
            inputs = channels

    @jax.named_scope("pyramids")
    def __call__(self, x: Float[Array, "*n h w c"]) -> Maps:
        found = []
        for halve, keep in self.blocks:
            x = keep(halve(x))
            found.append(x)
        return tuple(found)


class Neck(eqx.Module):
    """The three scales at the largest of them, added up."""

    level: list[Block]
    smooth: Block

    def __init__(self, channels: int, key: Array) -> None:
        *keys, last = jax.random.split(key, len(WIDTHS) + 1)
        self.level = [
            Block(width, channels, own, width=1) for width, own in zip(WIDTHS, keys, strict=True)
        ]
        self.smooth = Block(channels, channels, last)

    @jax.named_scope("pyramids")
    def __call__(self, maps: Maps) -> Float[Array, "*n h w c"]:
        parts = [
            enlarged(level(x), 2**k)
            for k, (level, x) in enumerate(zip(self.level, maps, strict=True))
        ]
        return self.smooth(sum(parts[1:], parts[0]))
