"""The command line: thin, every command a few calls into the package.

A file for each group of commands; importing it adds its commands to the app.
"""

from inspe_jax.cli import dataset, generate, planning, score, search, show, study  # noqa: F401
from inspe_jax.cli.common import main

__all__ = ["main"]
