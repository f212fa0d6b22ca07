"""Dataclasses as pytrees: what compiled programs take and give."""

from collections.abc import Iterable
from dataclasses import fields
from typing import Any, TypeVar

import jax

import inspe_jax.core.kept  # noqa: F401

Class = TypeVar("Class", bound=type)


def pytree(cls: Class) -> Class:
    """Register a dataclass with JAX; fields with ``metadata={"static": True}`` are no arrays. The
    class is part of the structure: JAX 0.10 takes dataclasses of as many fields for equal, and at
    times runs one's program on the other."""
    arrays = tuple(f.name for f in fields(cls) if not f.metadata.get("static"))
    static = tuple(f.name for f in fields(cls) if f.metadata.get("static"))
    keys = tuple(map(jax.tree_util.GetAttrKey, arrays))

    def flatten(of: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        return tuple(getattr(of, name) for name in arrays), tuple(getattr(of, n) for n in static)

    def flatten_with_keys(of: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        children, structure = flatten(of)
        return tuple(zip(keys, children, strict=True)), structure

    def unflatten(structure: tuple[Any, ...], children: Iterable[Any]) -> Any:
        given = dict(zip(arrays, children, strict=True))
        return cls(**given, **dict(zip(static, structure, strict=True)))

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)
    return cls
