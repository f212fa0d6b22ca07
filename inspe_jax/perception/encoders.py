"""From points or pictures to maps in bird's-eye view, one an agent, and to maps at three scales."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from inspe_jax.dataset.loading import PillarGrid, Pillars, pillar_features, taken
from inspe_jax.perception.head import Heat, HeatHead
from inspe_jax.perception.inputs import BevGrid, Inputs
from inspe_jax.perception.layers import Block, Conv, Depthwise, Map, Norm, Perceptron, enlarged


class PillarEncoder(eqx.Module):
    """PointPillars (Lang et al. 2019): a small network of each point, and each pillar's maximum."""

    network: Perceptron
    grid: PillarGrid = eqx.field(static=True)

    def __init__(self, grid: PillarGrid, channels: int, key: Array) -> None:
        self.network = Perceptron(9, channels, channels, key)
        self.grid = grid

    def __call__(self, pillars: Pillars) -> Float[Array, "B G H W C"]:
        features = pillar_features(pillars, self.grid, jnp) * _scales(self.grid)
        there = taken(pillars, self.grid, jnp)
        points = jnp.where(there[..., None], jax.nn.relu(self.network(features)), 0.0)
        values = points.max(-2)  # (B, G, P, C)
        side, (frames, agents, _, channels) = self.grid.side, values.shape
        cell = jnp.asarray(pillars.cells[..., 0] * side + pillars.cells[..., 1])
        first = jnp.arange(frames * agents).reshape(frames, agents, 1) * side**2
        # Padding goes behind the last cell, where it is dropped.
        at = jnp.where(jnp.asarray(pillars.counts) > 0, cell + first, frames * agents * side**2)
        flat = jnp.zeros((frames * agents * side**2, channels))
        flat = flat.at[at.reshape(-1)].set(values.reshape(-1, channels), mode="drop")
        return flat.reshape(frames, agents, side, side, channels)


def _scales(grid: PillarGrid) -> Float[Array, "1 1 1 1 9"]:
    tall = grid.high - grid.low
    scales = [1 / grid.half] * 2 + [2 / tall, 1.0] + [2 / grid.cell] * 2 + [2 / tall]
    return jnp.asarray(np.array(scales + [2 / grid.cell] * 2, np.float32))[None, None, None, None]


WIDTHS = (64, 96, 128)
"""Channels at 1/2, 1/4 and 1/8 of the side: PointPillars' 64, 128, 256 take thrice as long."""

Maps = tuple[Map, ...]  # maps at three scales


class Pyramid(eqx.Module):
    """Maps at three scales: two blocks a scale, of which the first halves the sides."""

    blocks: list[tuple[Block, Block]]

    def __init__(self, inputs: int, key: Array) -> None:
        self.blocks = []
        for channels, own in zip(WIDTHS, jax.random.split(key, len(WIDTHS)), strict=True):
            first, second = jax.random.split(own)
            halve = Block(inputs, channels, first, stride=2)
            self.blocks.append((halve, Block(channels, channels, second)))
            inputs = channels

    def __call__(self, x: Map) -> Maps:
        found = []
        for halve, keep in self.blocks:
            x = keep(halve(x))
            found.append(x)
        return tuple(found)


class Neck(eqx.Module):
    """The three scales at the largest of them, added up (a feature pyramid, Lin et al. 2017)."""

    level: list[Block]
    smooth: Block

    def __init__(self, channels: int, key: Array) -> None:
        *keys, last = jax.random.split(key, len(WIDTHS) + 1)
        pairs = zip(WIDTHS, keys, strict=True)
        self.level = [Block(width, channels, own, width=1) for width, own in pairs]
        self.smooth = Block(channels, channels, last)

    def __call__(self, maps: Maps) -> Map:
        pairs = zip(self.level, maps, strict=True)
        parts = [enlarged(level(x), 2**k) for k, (level, x) in enumerate(pairs)]
        return self.smooth(sum(parts[1:], parts[0]))


STEM = (16, 24)
"""Channels at a half and a quarter of the sides. EfficientNet's inverted residuals there would take
a CPU longer than all that follows (EfficientNetV2 has none there either)."""
STAGES = (48, 96)
"""Channels at an eighth and a sixteenth of the sides; EfficientNet-B0 has 40 and 112."""
EXPANSION = 3
"""How many times wider an inverted residual is inside: EfficientNet has 6, for 1,000 classes."""
JOINED = 64  # channels of the stages' maps after they are joined


class InvertedResidual(eqx.Module):
    """EfficientNet's MBConv, with squeeze and excitation (Hu et al. 2018)."""

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


Residual = type[InvertedResidual] | type[Bottleneck]
"""What the stages of an encoder of pictures are made of."""


class ImageEncoder(eqx.Module):
    """A stem of two blocks and two stages of two blocks, each halving the sides, with maps joined
    twice: a sixteenth to an eighth, as in Lift, Splat, Shoot, and that to the stem's quarter.

    Blocks are as in EfficientNet (Tan and Le 2019) or ResNet (He et al. 2016), not pre-trained.
    """

    stem: tuple[Block, Block]
    stages: list[tuple[Any, Any]]
    join: Block
    join_stem: Block

    def __init__(self, block: Residual, channels: int, key: Array) -> None:
        first, second, third, last, *keys = jax.random.split(key, 4 + 2 * len(STAGES))
        self.stem = (Block(3, STEM[0], first, stride=2), Block(*STEM, second, stride=2))
        self.stages, inputs = [], STEM[-1]
        for k, width in enumerate(STAGES):
            halve = block(inputs, width, keys[2 * k], stride=2)
            self.stages.append((halve, block(width, width, keys[2 * k + 1])))
            inputs = width
        self.join = Block(sum(STAGES), JOINED, third)
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


FEATURES = 32  # channels of a picture's cells before they are lifted
HEIGHTS = np.array([-2.4, -1.6, -0.8, -0.2, 0.2, 0.6, 1.0, 1.4, 1.8, 2.6], np.float32)
"""Heights of what a cell of a picture shows [m]: middles are at 0.8 to 1.8 m on level roads."""
EMPTY_WEIGHT = 0.05
"""Weight of features of 0 in a cell, for those into which hardly any chance falls."""


class LiftSplat(eqx.Module):
    """Pictures of each agent as a map of features, and heat on them, for training (Lift, Splat,
    Shoot, Philion and Fidler 2020): features times the chance of each depth along a ray fall into
    the map, and each cell has their mean. Depths are those of certain heights above the road, as in
    BEVHeight (Yang et al. 2023)."""

    images: ImageEncoder
    heat: HeatHead
    lift: Conv
    grid: BevGrid = eqx.field(static=True)
    units: int = eqx.field(static=True)

    def __init__(
        self, block: Residual, grid: BevGrid, units: int, channels: int, key: Array
    ) -> None:
        first, second, third = jax.random.split(key, 3)
        self.images = ImageEncoder(block, FEATURES, first)
        self.lift = Conv(FEATURES, len(HEIGHTS) + channels, second, width=1)
        self.heat = HeatHead(FEATURES, third)
        self.grid, self.units = grid, units

    def __call__(self, inputs: Inputs) -> tuple[Float[Array, "B U H W C"], Heat]:
        assert inputs.pixels is not None
        frames, _, high, wide, _ = inputs.pixels.shape
        pixels = jnp.asarray(inputs.pixels).reshape(-1, high, wide, 3)
        features = self.images(pixels)  # (B C, h, w, c)
        found = self.lift(features)
        chance = jax.nn.softmax(found[..., : len(HEIGHTS)], -1)
        cell = self._cells(inputs, (high, wide), found.shape[1:3]).reshape(chance.shape)
        maps = self._splat(chance, found[..., len(HEIGHTS) :], cell, frames)
        maps = maps.reshape(frames, self.units, self.grid.side, self.grid.side, -1)
        return maps, self.heat(features)

    def _splat(
        self,
        chance: Float[Array, "n h w D"],
        features: Float[Array, "n h w c"],
        cell: Int[Array, "n h w D"],
        frames: int,
    ) -> Float[Array, "m c"]:
        """The mean of the features that fall into each of all maps' cells, by their chance."""

        def total(x: Array) -> Array:
            count = frames * self.units * self.grid.side**2
            zero = jnp.zeros((count, x.shape[-1]))
            return zero.at[cell.reshape(-1)].add(x.reshape(-1, x.shape[-1]), mode="drop")

        lifted = total(chance[..., None] * features[..., None, :])
        return lifted / (total(chance[..., None]) + EMPTY_WEIGHT)

    def _cells(
        self, inputs: Inputs, picture: tuple[int, int], cells: tuple[int, ...]
    ) -> Int[Array, "B C h w D"]:
        """The cell of the map that each height on each ray is in; outside, one past the last."""
        assert inputs.intrinsic is not None
        assert inputs.unit is not None
        # With one agent of cameras, it has all of them.
        side, units = self.grid.side, jnp.minimum(jnp.asarray(inputs.unit), self.units - 1)
        rows, columns = (
            (np.arange(count, dtype=np.float32) + 0.5) * (pixels / count)
            for count, pixels in zip(cells, picture, strict=True)
        )
        each = *np.meshgrid(columns, rows), np.ones(cells)
        at = np.stack(each, -1, dtype=np.float32)  # (h, w, 3)
        seen = jnp.einsum("bcij,hwj->bchwi", jnp.linalg.inv(jnp.asarray(inputs.intrinsic)), at)
        # From right, down, forward to the body's forward, left, up.
        body = jnp.stack([seen[..., 2], -seen[..., 0], -seen[..., 1]], -1)
        pose = jnp.asarray(inputs.pose)[:, :, None, None]
        ray = jnp.einsum("bchwij,bchwj->bchwi", pose[..., :3, :3], body)
        rise = HEIGHTS[None, None, None, None] - pose[..., 2, 3, None]  # (B, C, 1, 1, D)
        ahead = rise * ray[..., 2:] > 0  # and not behind the camera, nor never
        depth = jnp.where(ahead, rise / jnp.where(ahead, ray[..., 2:], 1), 0)
        point = pose[..., None, :2, 3] + depth[..., None] * ray[..., None, :2]
        place = jnp.floor((point + self.grid.half) / self.grid.cell)
        inside = ahead & ((place >= 0) & (place < side)).all(-1)
        inside &= (units >= 0)[..., None, None, None]
        row, column = (place[..., k].astype(int) for k in range(2))
        agent = jnp.arange(len(units))[:, None] * self.units + units
        flat = (agent[..., None, None, None] * side + row) * side + column
        return jnp.where(inside, flat, len(units) * self.units * side**2)
