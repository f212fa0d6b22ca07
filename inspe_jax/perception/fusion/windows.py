"""Maps as windows of cells."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int


def to_windows(x: Float[Array, "*n h w c"], side: int) -> Float[Array, "*n m t c"]:
    """Neighbouring cells together: m windows of t = side² cells."""
    *leading, high, wide, channels = x.shape
    parts = x.reshape(*leading, high // side, side, wide // side, side, channels)
    return jnp.swapaxes(parts, -4, -3).reshape(*leading, -1, side * side, channels)


def from_windows(x: Float[Array, "*n m t c"], high: int, wide: int) -> Float[Array, "*n h w c"]:
    """The inverse of :func:`to_windows`."""
    *leading, _, tokens, channels = x.shape
    side = round(tokens**0.5)
    parts = x.reshape(*leading, high // side, wide // side, side, side, channels)
    return jnp.swapaxes(parts, -4, -3).reshape(*leading, high, wide, channels)


def to_grids(x: Float[Array, "*n h w c"], side: int) -> Float[Array, "*n m t c"]:
    """Cells far apart together: t = side² of them, evenly over the map (Tu et al. 2022)."""
    *leading, high, wide, channels = x.shape
    parts = x.reshape(*leading, side, high // side, side, wide // side, channels)
    order = [*range(len(leading)), *(len(leading) + k for k in (1, 3, 0, 2, 4))]
    return parts.transpose(order).reshape(*leading, -1, side * side, channels)


def from_grids(x: Float[Array, "*n m t c"], high: int, wide: int) -> Float[Array, "*n h w c"]:
    """The inverse of :func:`to_grids`."""
    *leading, _, tokens, channels = x.shape
    side = round(tokens**0.5)
    parts = x.reshape(*leading, high // side, wide // side, side, side, channels)
    order = [*range(len(leading)), *(len(leading) + k for k in (2, 0, 3, 1, 4))]
    return parts.transpose(order).reshape(*leading, high, wide, channels)


def offsets(side: int) -> Int[np.ndarray, "t t"]:
    """For each two cells of a window, the number of the offset between them, of (2 side − 1)²."""
    at = np.stack(np.meshgrid(*[np.arange(side)] * 2, indexing="ij"), -1).reshape(-1, 2)
    apart = at[:, None] - at[None] + side - 1
    return apart[..., 0] * (2 * side - 1) + apart[..., 1]
