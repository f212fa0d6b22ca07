"""Deprecated: recording needs no data set; see :mod:`inspe_jax.simulation.embedded.recorder`."""

from inspe_jax.core.moved import moved

__getattr__ = moved(__name__, "inspe_jax.simulation.embedded.recorder")
