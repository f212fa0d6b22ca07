"""Heat: maps with a peak at each road user of a class, and their loss (Law and Deng 2018; Zhou et
al. 2019). Detectors tell heat in bird's-eye view; in training, those of cameras also on pictures.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from inspe_jax.perception.layers import Conv
from inspe_jax.simulation.frame import KINDS

RARE = -2.19
"""First bias of the heat: a chance of 0.1, so that the loss does not begin with every cell being
wrong (Lin et al. 2017, focal loss)."""
HARD, FAR = 2.0, 4.0
"""Exponents of the focal loss: cells that are right already, and cells near a peak, count less."""


class HeatHead(Conv):
    """Heat of each class before the sigmoid, from each cell's features."""

    def __init__(self, inputs: int, key: Array) -> None:
        super().__init__(inputs, len(KINDS), key, width=1)
        self.bias = jnp.full(len(KINDS), RARE, jnp.float32)


def bumps(
    at: Float[Array, "*n M"],
    deviation: Float[Array, "*n M"],
    count: int,
    mask: Bool[Array, "*n M"],
) -> Float[Array, "*n M c"]:
    """Gaussians on ``count`` cells, of height 1 at the cells ``at``; 0 outside ``mask``."""
    cells = jnp.arange(count).astype(float).reshape((1,) * at.ndim + (count,))
    off = (cells - at[..., None]) / deviation[..., None]
    return jnp.where(mask[..., None], jnp.exp(-0.5 * off**2), 0.0)


def class_heat(
    down: Float[Array, "n M h"], across: Float[Array, "n M w"], kind: Int[Array, "n M"]
) -> Float[Array, "n h w K"]:
    """The heat of road users whose bumps along rows and columns are given: the highest of each
    class at each cell."""

    def one(rows: Array, columns: Array, own: Array) -> Array:
        both = rows[:, :, None] * columns[:, None]  # (M, h, w)
        return jnp.stack([(both * k[:, None, None]).max(0) for k in own.T], -1)

    own = jax.nn.one_hot(kind, len(KINDS))
    return lax.map(lambda x: one(*x), (down, across, own))


def per_road_user(total: Float[Array, ""], mask: Bool[Array, "*n"]) -> Float[Array, ""]:
    """A sum of losses, for each road user in ``mask`` on average."""
    return total / jnp.maximum(mask.sum(), 1).astype(float)


def focal_loss(
    heat: Float[Array, "*n K"], aim: Float[Array, "*n K"], mask: Bool[Array, "*m"]
) -> Float[Array, ""]:
    """The loss of heat before the sigmoid, for each road user in ``mask`` on average."""
    chance, none = jax.nn.log_sigmoid(heat), jax.nn.log_sigmoid(-heat)
    right = -((1 - jnp.exp(chance)) ** HARD) * chance
    wrong = -((1 - aim) ** FAR) * jnp.exp(chance) ** HARD * none
    return per_road_user(jnp.where(aim == 1, right, wrong).sum(), mask)
