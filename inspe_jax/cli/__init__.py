"""The command line. Every command is a few calls into the package.

:data:`~inspe_jax.cli.common.GROUPS` has the commands in order. A command's module is imported when
it is called; what ``inspe_jax.public`` does not load, such as matplotlib, Dask or Equinox, inside
the commands.
"""

from inspe_jax.cli.common import main

__all__ = ["main"]
