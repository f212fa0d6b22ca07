"""Lift, Splat, Shoot (Philion and Fidler 2020): pictures as maps in bird's-eye view.

Each cell of a picture has features and a distribution over depth. *Lift*: features times chance at
each depth along the cell's ray. *Splat*: each cell of the map has the mean of what falls into it.

The depths of a ray are those at which it is at certain heights, as in BEVHeight (Yang et al. 2023):
sensors at the roadside look down on a road that they know, and a few heights tell a place as well
as many depths do, of which most lie below the road. Heights are those of the intersection's frame:
a road user on a ramp that leads further down than the least of them is placed nearer than it is.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from inspe_jax.perception.encoders.images import ImageEncoder
from inspe_jax.perception.heat import HeatHead
from inspe_jax.perception.inputs import BevGrid, Inputs
from inspe_jax.perception.layers import Conv

FEATURES = 32
"""Channels of a picture's cells before they are lifted."""
HEIGHTS = np.array([-2.4, -1.6, -0.8, -0.2, 0.2, 0.6, 1.0, 1.4, 1.8, 2.6], np.float32)
"""Heights of what a cell of a picture shows [m]. On a level road, the middles of road users are at
0.8 to 1.8 m. The others are for slopes, and for cells that a road user is not in the middle of."""
EMPTY_WEIGHT = 0.05
"""Weight of features of 0 in the mean of each cell of the map, so that a cell into which hardly any
chance falls is much like one that no pixel shows."""


class LiftSplat(eqx.Module):
    """Pictures of each agent as a map of features; and heat on the pictures, for training."""

    images: ImageEncoder
    heat: HeatHead
    lift: Conv
    grid: BevGrid = eqx.field(static=True)
    units: int = eqx.field(static=True)

    def __init__(self, name: str, grid: BevGrid, units: int, channels: int, key: Array) -> None:
        first, second, third = jax.random.split(key, 3)
        self.images = ImageEncoder(name, FEATURES, first)
        self.lift = Conv(FEATURES, len(HEIGHTS) + channels, second, width=1)
        self.heat = HeatHead(FEATURES, third)
        self.grid, self.units = grid, units

    @jax.named_scope("pictures")
    def __call__(self, inputs: Inputs) -> tuple[Float[Array, "B U H W C"], Float[Array, "n h w K"]]:
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
        """The cell of the map that each height on each ray is in; outside of it, one past the last.

        A cell of the features stands for the middle of its part of the picture.
        """
        assert inputs.intrinsic is not None
        assert inputs.unit is not None
        # With one agent of cameras, it has all of them.
        side, units = self.grid.side, jnp.minimum(jnp.asarray(inputs.unit), self.units - 1)
        rows, columns = (
            (np.arange(count, dtype=np.float32) + 0.5) * (pixels / count)
            for count, pixels in zip(cells, picture, strict=True)
        )
        at = np.stack(
            [*np.meshgrid(columns, rows), np.ones(cells)], -1, dtype=np.float32
        )  # (h, w, 3)
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
