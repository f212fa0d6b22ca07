"""Lift, Splat, Shoot (Philion and Fidler 2020): pictures as maps in bird's-eye view.

Each cell of a picture has features and a distribution over depth. *Lift*: features times chance at
each depth along the cell's ray. *Splat*: all that falls into a cell of the map is added up.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from inspe_jax.perception.encoders.images import ImageEncoder
from inspe_jax.perception.inputs import BevGrid, Inputs
from inspe_jax.perception.layers import Conv

NEAREST, FARTHEST, DEPTHS = 4.0, 80.0, 40
"""Depths of the distribution [m], and how many there are: from a road user below the camera to the
far corner of the region seen from the near one. They grow by a constant factor (8 %), since the
depth that a picture tells has an error in proportion to it."""


class LiftSplat(eqx.Module):
    """Pictures of each agent as a map of features."""

    images: ImageEncoder
    lift: Conv
    grid: BevGrid = eqx.field(static=True)
    units: int = eqx.field(static=True)

    def __init__(self, name: str, grid: BevGrid, units: int, channels: int, key: Array) -> None:
        first, second = jax.random.split(key)
        self.images = ImageEncoder(name, 64, first)
        self.lift = Conv(64, DEPTHS + channels, second, width=1)
        self.grid, self.units = grid, units

    def __call__(self, inputs: Inputs) -> Float[Array, "B U H W C"]:
        assert inputs.pixels is not None
        frames, _, high, wide, _ = inputs.pixels.shape
        pixels = jnp.asarray(inputs.pixels).reshape(-1, high, wide, 3)
        found = self.lift(self.images(pixels))  # (B C, h, w, D + c)
        chance = jax.nn.softmax(found[..., :DEPTHS], -1)
        lifted = chance[..., None] * found[..., None, DEPTHS:]  # (B C, h, w, D, c)
        cell = self._cells(inputs, (high, wide), found.shape[1:3])
        count = frames * self.units * self.grid.side**2
        flat = jnp.zeros((count, lifted.shape[-1]))
        flat = flat.at[cell.reshape(-1)].add(lifted.reshape(-1, lifted.shape[-1]), mode="drop")
        return flat.reshape(frames, self.units, self.grid.side, self.grid.side, -1)

    def _cells(
        self, inputs: Inputs, picture: tuple[int, int], cells: tuple[int, ...]
    ) -> Float[Array, "BC h w D"]:
        """The cell of the map that each depth of each ray is in; outside of it, one past the last.

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
        pose = jnp.asarray(inputs.pose)
        ray = jnp.einsum("bcij,bchwj->bchwi", pose[..., :3, :3], body)
        depths = np.geomspace(NEAREST, FARTHEST, DEPTHS, dtype=np.float32)
        point = ray[..., None, :] * depths[None, None, None, None, :, None]
        point = point + pose[:, :, None, None, None, :3, 3]
        place = jnp.floor((point[..., :2] + self.grid.half) / self.grid.cell).astype(int)
        inside = ((place >= 0) & (place < side)).all(-1)
        inside &= (point[..., 2] >= self.grid.low) & (point[..., 2] < self.grid.high)
        agent = jnp.arange(len(units))[:, None] * self.units + units
        flat = (agent[..., None, None, None] * side + place[..., 0]) * side + place[..., 1]
        inside &= (units >= 0)[..., None, None, None]
        return jnp.where(inside, flat, len(units) * self.units * side**2)
