"""PointPillars (Lang et al. 2019): a small network of each point, the maximum of each pillar."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from inspe_jax.dataset.loading import PillarGrid, Pillars, pillar_features, taken
from inspe_jax.perception.layers import Perceptron


class PillarEncoder(eqx.Module):
    """Pillars of each agent as a map of features."""

    network: Perceptron
    grid: PillarGrid = eqx.field(static=True)

    def __init__(self, grid: PillarGrid, channels: int, key: Array) -> None:
        self.network = Perceptron(9, channels, channels, key)
        self.grid = grid

    @jax.named_scope("pillars")
    def __call__(self, pillars: Pillars) -> Float[Array, "B G H W C"]:
        features = pillar_features(pillars, self.grid, jnp) * _scales(self.grid)
        there = taken(pillars, self.grid, jnp)
        points = jnp.where(there[..., None], jax.nn.relu(self.network(features)), 0.0)
        return self._spread(points.max(-2), pillars)

    def _spread(
        self, values: Float[Array, "B G P C"], pillars: Pillars
    ) -> Float[Array, "B G H W C"]:
        """Each pillar's value at its cell, and 0 elsewhere."""
        side, (frames, agents, _, channels) = self.grid.side, values.shape
        cell = jnp.asarray(pillars.cells[..., 0] * side + pillars.cells[..., 1])
        first = jnp.arange(frames * agents).reshape(frames, agents, 1) * side**2
        # Padding goes behind the last cell, where it is dropped.
        at = jnp.where(jnp.asarray(pillars.counts) > 0, cell + first, frames * agents * side**2)
        flat = jnp.zeros((frames * agents * side**2, channels))
        flat = flat.at[at.reshape(-1)].set(values.reshape(-1, channels), mode="drop")
        return flat.reshape(frames, agents, side, side, channels)


def _scales(grid: PillarGrid) -> Float[Array, "1 1 1 1 9"]:
    """What brings x, y, z, intensity, and the two offsets, to about 1."""
    tall = grid.high - grid.low
    scales = [1 / grid.half] * 2 + [2 / tall, 1.0] + [2 / grid.cell] * 2 + [2 / tall]
    return jnp.asarray(np.array(scales + [2 / grid.cell] * 2, np.float32))[None, None, None, None]
