"""Versions of this package, of Python and of libraries."""

import platform
from collections.abc import Sequence
from importlib import metadata

__version__ = "1.0.0"


def versions(libraries: Sequence[str]) -> dict[str, str]:
    """The versions of this package, of Python and of ``libraries``, by name."""
    own = {"inspe_jax": __version__, "python": platform.python_version()}
    return own | {name: metadata.version(name) for name in libraries}
