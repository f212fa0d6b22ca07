"""A method's state as a frozen dataclass, and as the flat dict that a checkpoint holds."""

from collections.abc import Callable
from dataclasses import fields
from typing import Any, TypeVar

from inspe_jax.placement.run import Method, Run, State

S = TypeVar("S")

KEY = "checkpoint key"
"""Metadata of a field whose key in a checkpoint is not its name."""


def method_of(
    name: str,
    summary: str,
    state: type[S],
    begin: Callable[[Run], S],
    step: Callable[[Run, S], S | None],
) -> Method:
    """A row of the registry for a method whose states are instances of a frozen dataclass.

    The dataclass's fields are numpy arrays, numbers and strings, so that a checkpoint can hold
    them. ``begin`` and ``step`` as in :class:`~inspe_jax.placement.run.Method`.
    """

    def begin_flat(run: Run) -> State:
        return to_dict(begin(run))

    def step_flat(run: Run, held: State) -> State | None:
        following = step(run, from_dict(state, held))
        return None if following is None else to_dict(following)

    return Method(name, summary, begin_flat, step_flat)


def to_dict(state: Any) -> State:
    """A state's fields by their checkpoint keys."""
    return {_key(field): getattr(state, field.name) for field in fields(state)}


def from_dict(kind: type[S], held: State) -> S:
    """The state that :func:`to_dict` gave ``held`` for. Raises KeyError if a key is missing."""
    return kind(**{field.name: held[_key(field)] for field in fields(kind)})  # type: ignore[arg-type]


def _key(field: Any) -> str:
    return str(field.metadata.get(KEY, field.name))
