"""The methods that follow the gradient of the soft score."""

from inspe_jax.placement.methods.adam import ADAM
from inspe_jax.placement.methods.greedy_adam import GREEDY_ADAM
from inspe_jax.placement.methods.rounds import ROUNDS
from inspe_jax.placement.run import Method

GRADIENTS: tuple[Method, ...] = (ADAM, GREEDY_ADAM, *ROUNDS)
"""Rows of the registry."""
