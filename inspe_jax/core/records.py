"""Records of numbers: checked by their annotations, compared by content, shown in one line."""

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from html import escape
from types import UnionType
from typing import Any, Union, get_args, get_origin

import jax
import numpy as np

from inspe_jax.core.errors import InspeError, brief, wrong_kind

NUMBERS = {
    "bool": ("b", "true or false"),
    "float": ("iuf", "numbers"),
    "int": ("iu", "whole numbers"),
    "uint": ("iu", "whole numbers"),
}
"""Which of NumPy's kinds of numbers an annotation allows, and what they are."""


def check_record(record: Any, where: str, **axes: int) -> None:
    """Raise InspeError where a dataclass, or one in it, has a value of another kind than annotated,
    a number that is not finite, or an array of another shape, as of ``Float[Array, "T B 3"]``.

    A letter is one length in a whole record; ``axes`` are known ones. What is traced passes. A
    record's own ``_check`` adds to this; it is given what its messages begin with.
    """
    _walk(record, f"{where}: ", axes)


def _walk(record: Any, prefix: str, axes: dict[str, int]) -> None:
    for f in fields(record):
        _check(getattr(record, f.name), f.type, prefix + f.name, axes)
    if hasattr(record, "_check"):
        record._check(prefix)


def _check(value: Any, kind: Any, where: str, axes: dict[str, int]) -> None:
    if get_origin(kind) in (Union, UnionType):
        if value is None and type(None) in get_args(kind):
            return
        kind = get_args(kind)[0]
    if hasattr(kind, "dim_str"):
        _check_array(value, kind.dtypes[-1].rstrip("0123456789_"), kind.dim_str, where, axes)
    elif kind in (float, int):
        if type(value) is not kind or not math.isfinite(value):  # else all is well
            _check_array(value, kind.__name__, "", where, axes)
    elif get_origin(kind) is tuple:
        if not isinstance(value, tuple | list):
            raise wrong_kind(where, value, "a tuple")
        kinds = get_args(kind)
        if kinds[-1] is Ellipsis:
            kinds = kinds[:1] * len(value)
        if len(kinds) != len(value):
            raise wrong_kind(where, value, f"{len(kinds)} values")
        for k, (one, own) in enumerate(zip(value, kinds, strict=True)):
            _check(one, own, f"{where}[{k}]", axes)
    elif isinstance(kind, type) and kind is not Any:
        if not isinstance(value, kind):
            raise wrong_kind(where, value, f"a {kind.__name__}")
        if is_dataclass(value):
            _walk(value, f"{where}.", {})


def _check_array(value: Any, kind: str, shape: str, where: str, axes: dict[str, int]) -> None:
    if isinstance(value, jax.core.Tracer):
        return
    try:
        array = np.asarray(value)
    except ValueError:  # rows of several lengths
        array = np.asarray(None)
    allowed, words = NUMBERS[kind]
    if array.size and array.dtype.kind not in allowed:
        got = f"an array of {array.dtype.name}" if array.ndim else brief(array.item())
        raise InspeError(f"{where}: must be {words}, got {got}")
    letters = shape.split()
    pairs = zip(letters, array.shape, strict=False)
    lengths = [int(x) if x.isdigit() else axes.setdefault(x, n) for x, n in pairs]
    if (len(letters), lengths) != (array.ndim, [*array.shape]):
        expected = ", ".join(str(axes.get(x, x)) for x in letters)
        raise InspeError(f"{where}: shape {array.shape}, expected ({expected})")
    if array.dtype.kind == "f":
        check_values(array, where)


def check_values(
    values: Any, where: str, low: float = -np.inf, high: float = np.inf, there: Any = True
) -> None:
    """Raise InspeError with the index of the first value, of those ``there``, that is not finite or
    not from ``low`` to ``high``; what is traced passes."""
    if any(isinstance(x, jax.core.Tracer) for x in (values, there)):
        return
    values = np.asarray(values)
    wrong = ~(np.isfinite(values) & (values >= low) & (values <= high)) & there
    if not wrong.any():
        return
    at = tuple(np.argwhere(wrong)[0].tolist())
    index = f"[{', '.join(map(str, at))}]" if at else ""
    limits = f"at least {low:g}" if high == np.inf else f"from {low:g} to {high:g}"
    fault = f"out of range: {limits}" if np.isfinite(values[at]) else "not finite"
    raise InspeError(f"{where}{index}: {values[at]:g} is {fault}")


class ByContent:
    """For dataclasses with ``eq=False``: equal, and of one hash, where all fields are; arrays by
    shape and numbers, whatever their precision."""

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
    """For dataclasses with ``repr=False``: ``_facts`` in a line, or as a table in a notebook."""

    def _facts(self) -> dict[str, Any]:
        raise NotImplementedError

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {', '.join(f'{k} {v}' for k, v in self._facts().items())}>"

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr><th>{escape(key)}</th><td>{escape(str(value))}</td></tr>"
            for key, value in self._facts().items()
        )
        return f"<table><caption>{type(self).__name__}</caption>{rows}</table>"
