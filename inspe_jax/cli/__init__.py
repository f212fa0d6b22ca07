"""The command line. Every command is a few calls into the package.

Importing a module adds its commands; :data:`~inspe_jax.cli.common.GROUPS` has them in order. What
``import inspe_jax`` does not load, such as matplotlib, Dask or Equinox, is imported inside the
commands.
"""

from inspe_jax.cli import dataset, perception, scene, score, search, show, study  # noqa: F401
from inspe_jax.cli.common import main

__all__ = ["main"]
