"""AttFuse (Xu et al. 2022, OPV2V): at each cell, agents attend to one another."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from inspe_jax.perception.fusion.mean import mean_of
from inspe_jax.perception.layers import attend


class AttFuse(eqx.Module):
    """Scaled dot-product attention of the features themselves."""

    def __init__(self, channels: int, modalities: tuple[int, ...], key: Array) -> None:
        """It has no parameters."""

    def __call__(
        self, x: Float[Array, "B A H W C"], present: Bool[Array, "B A"]
    ) -> Float[Array, "B H W C"]:
        cells = jnp.moveaxis(x, 1, 3)[..., None, :]  # (B, H, W, A, 1, C)
        found = attend(cells, cells, cells, present[:, None, None])
        return mean_of(jnp.moveaxis(found[..., 0, :], 3, 1), present)
