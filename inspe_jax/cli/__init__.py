"""The command line. Every command is a few calls into the package.

Each group of commands has a module. Importing the module adds its commands, so the order of the
imports is the order of the commands in ``inspe --help``. What ``import inspe_jax`` does not load,
such as matplotlib, Dask or Equinox, is imported inside the commands.
"""

from inspe_jax.cli import scene, score, search, show  # noqa: F401  # isort: skip
from inspe_jax.cli import study, dataset, perception  # noqa: F401  # isort: skip
from inspe_jax.cli.common import main

__all__ = ["main"]
