"""The mean over the agents that are there."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def mean_of(x: Float[Array, "B A H W C"], present: Bool[Array, "B A"]) -> Float[Array, "B H W C"]:
    """The mean over agents that are ``present``."""
    there = present.astype(x.dtype)
    return jnp.einsum("bahwc,ba->bhwc", x, there / there.sum(1, keepdims=True))


class Mean(eqx.Module):
    """No fusion but the mean: for detectors with one agent."""

    def __init__(self, channels: int, modalities: tuple[int, ...], key: Array) -> None:
        """It has no parameters."""

    def __call__(
        self, x: Float[Array, "B A H W C"], present: Bool[Array, "B A"]
    ) -> Float[Array, "B H W C"]:
        return mean_of(x, present)
