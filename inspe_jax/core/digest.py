"""Digests of content: of fields alone, so a checkpoint fits the same search in a later version."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any

import jax
import numpy as np

ORIGIN = "origin"
"""Key of the metadata of a field that says where a record came from, which is no content: digests
take the value under this key for it."""
OPTIONAL = {"optional": True}
"""Metadata of a field that digests leave out where it is None, as of before there was the field."""


def digest(thing: Any) -> str:
    """The SHA-256, as hexadecimal text, of an array, number, text, enumeration, polygon or
    dataclass, or of a mapping or sequence of these. Raises TypeError for anything else."""
    found = hashlib.sha256()
    _feed(found, thing)
    return found.hexdigest()


def _feed(found: "hashlib._Hash", thing: Any) -> None:
    """Add every part with its kind and size before it, so that two contents never look the same."""
    if isinstance(thing, np.ndarray | np.generic | jax.Array):
        array = np.asarray(thing)
        found.update(f"array {array.dtype.str} {array.shape};".encode())
        found.update(np.ascontiguousarray(array).tobytes())
    elif isinstance(thing, Enum):
        found.update(f"enum {type(thing).__name__}.{thing.name};".encode())
    elif thing is None or isinstance(thing, bool | int | float | str):
        found.update(f"{thing!r};".encode())
    elif is_dataclass(thing):
        found.update(f"record {type(thing).__name__};".encode())
        for part in fields(thing):
            value = part.metadata.get(ORIGIN, getattr(thing, part.name))
            if value is None and "optional" in part.metadata:
                continue
            found.update(f"{part.name}=".encode())
            _feed(found, value)
    elif isinstance(thing, Mapping):
        found.update(f"mapping {len(thing)};".encode())
        for key in sorted(thing, key=str):
            _feed(found, key)
            _feed(found, thing[key])
    elif isinstance(thing, Sequence):
        found.update(f"sequence {len(thing)};".encode())
        for item in thing:
            _feed(found, item)
    elif hasattr(thing, "wkb"):  # a polygon
        found.update(f"shape {len(thing.wkb)};".encode())
        found.update(thing.wkb)
    else:
        raise TypeError(f"a {type(thing).__name__} has no digest")
