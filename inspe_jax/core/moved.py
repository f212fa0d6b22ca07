"""Modules that have moved: their old names still work, with a warning that gives the new name."""

import warnings
from collections.abc import Callable
from importlib import import_module
from typing import Any


def moved(old: str, new: str) -> Callable[[str], Any]:
    """The ``__getattr__`` of a module ``old`` whose content is now in ``new``."""

    def get(name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        warnings.warn(f"{old} is now {new}", DeprecationWarning, stacklevel=2)
        return getattr(import_module(new), name)

    return get
