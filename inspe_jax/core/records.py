"""Records of numbers: checked by their annotations, compared by content, shown in one line."""

from collections.abc import Mapping
from dataclasses import fields
from functools import cache
from html import escape
from typing import Any, get_args, get_origin

import jax
import numpy as np

from inspe_jax.core.errors import InspeError

KINDS = {
    "bool": ("b", "true or false"),
    "float": ("iuf", "numbers"),
    "int": ("iu", "whole numbers"),
    "uint": ("iu", "whole numbers"),
}
"""Which of NumPy's kinds of numbers an annotation allows, and what they are."""


def check_record(record: Any, where: str, **axes: int) -> None:
    """Raise InspeError where a dataclass has a number that is not finite, or an array that is not
    as its annotation says, such as ``Float[np.ndarray, "T B 3"]``.

    A letter is one length in the whole record; ``axes`` are those that are known. What is traced
    has no values to check and passes.
    """
    for name, kind, shape, optional in _numbers_of(type(record)):
        value = getattr(record, name)
        if isinstance(value, jax.core.Tracer) or (optional and value is None):
            continue
        allowed, words = KINDS[kind]
        try:
            array = np.asarray(value)
        except ValueError:  # rows of several lengths
            array = np.asarray(None)
        if array.size and array.dtype.kind not in allowed:
            got = f"an array of {array.dtype.name}" if array.ndim else repr(value)
            raise InspeError(f"{where}: {name} must be {words}, got {got}")
        if shape is not None:
            pairs = zip(shape, array.shape, strict=False)
            lengths = [int(x) if x.isdigit() else axes.setdefault(x, n) for x, n in pairs]
            if (len(shape), lengths) != (array.ndim, [*array.shape]):
                expected = ", ".join(str(axes.get(x, x)) for x in shape)
                raise InspeError(f"{where}: {name}: shape {array.shape}, expected ({expected})")
        check_values(array, f"{where}: {name}")


def check_values(
    values: Any, where: str, low: float = -np.inf, high: float = np.inf, there: Any = True
) -> None:
    """Raise InspeError with the index of the first value, of those ``there``, that is not finite or
    not from ``low`` to ``high``."""
    values = np.asarray(values)
    wrong = ~(np.isfinite(values) & (values >= low) & (values <= high)) & there
    if not wrong.any():
        return
    at = tuple(np.argwhere(wrong)[0].tolist())
    index = f"[{', '.join(map(str, at))}]" if at else ""
    limits = f"at least {low:g}" if high == np.inf else f"from {low:g} to {high:g}"
    fault = f"out of range: {limits}" if np.isfinite(values[at]) else "not finite"
    raise InspeError(f"{where}{index}: {values[at]:g} is {fault}")


@cache
def _numbers_of(cls: type) -> tuple[tuple[str, str, tuple[str, ...] | None, bool], ...]:
    """(name, kind, axes, whether None is allowed) of each field of numbers; axes are None for a
    tuple."""
    found = []
    for f in fields(cls):
        options = (f.type,) if get_origin(f.type) is tuple else get_args(f.type) or (f.type,)
        one, optional = options[0], type(None) in options
        inner = set(get_args(one)) - {...} if get_origin(one) is tuple else set()
        if hasattr(one, "dim_str"):
            kind = one.dtypes[-1].rstrip("0123456789_")
            found.append((f.name, kind, tuple(one.dim_str.split()), optional))
        elif one in (float, int):
            found.append((f.name, one.__name__, (), optional))
        elif inner and inner <= {float, int}:
            found.append((f.name, "float" if float in inner else "int", None, optional))
    return tuple(found)


class ByContent:
    """For dataclasses with ``eq=False``: equal, and of one hash, where all fields are.

    Arrays are compared by value: shape and numbers, whatever their precision.
    """

    def __eq__(self, other: object) -> bool:
        return type(other) is type(self) and _content(other) == _content(self)

    def __hash__(self) -> int:
        return hash(_content(self))


def _content(x: Any) -> Any:
    """``x`` in parts that have a hash and compare to True or False."""
    if isinstance(x, ByContent):
        return type(x), *(_content(getattr(x, f.name)) for f in fields(x))  # type: ignore[arg-type]
    if isinstance(x, jax.core.Tracer):
        return id(x)
    if isinstance(x, np.ndarray | jax.Array):
        return x.shape, (np.asarray(x, float) + 0.0).tobytes()  # + 0.0: no −0.0
    if isinstance(x, Mapping):
        return frozenset((key, _content(value)) for key, value in x.items())
    return tuple(map(_content, x)) if isinstance(x, list | tuple) else x


class Described:
    """For dataclasses with ``repr=False``: one line for a prompt, a small table for a notebook."""

    @property
    def facts(self) -> dict[str, Any]:
        """What is shown of it, by name."""
        raise NotImplementedError

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {', '.join(f'{k} {v}' for k, v in self.facts.items())}>"

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr><th>{escape(key)}</th><td>{escape(str(value))}</td></tr>"
            for key, value in self.facts.items()
        )
        return f"<table><caption>{type(self).__name__}</caption>{rows}</table>"
