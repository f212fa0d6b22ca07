"""Deprecated: the rays' walker looks at voxels, and is in :mod:`inspe_jax.visibility.raycast`."""

from inspe_jax.core.moved import moved

__getattr__ = moved(__name__, "inspe_jax.visibility.raycast")
