"""A method's states as frozen dataclasses, and as the flat dicts that a checkpoint holds."""

from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any

from inspe_jax.placement.compile_ahead import CompileJob
from inspe_jax.placement.run import Method, Run, State

KEY = "checkpoint key"
"""Metadata of a field whose key in a checkpoint is not its name."""

States = type[Any] | Mapping[str, type[Any]]
"""The dataclass of a method's states; or one for each value of their field ``phase``."""


def method_of(
    name: str,
    summary: str,
    states: States,
    begin: Callable[[Run], Any],
    step: Callable[[Run, Any], Any],
    ahead: Callable[[Run], Mapping[str, CompileJob]] = lambda run: {},
) -> Method:
    """A row of the registry for a method whose states are instances of frozen dataclasses.

    The dataclasses' fields are numpy arrays, numbers and strings, so that a checkpoint can hold
    them. ``begin``, ``step`` and ``ahead`` as in :class:`~inspe_jax.placement.run.Method`.
    """

    def begin_flat(run: Run) -> State:
        return to_dict(begin(run))

    def step_flat(run: Run, held: State) -> State | None:
        following = step(run, from_dict(states, held))
        return None if following is None else to_dict(following)

    return Method(name, summary, begin_flat, step_flat, ahead)


def to_dict(state: Any) -> State:
    """A state's fields by their checkpoint keys."""
    return {_key(field): getattr(state, field.name) for field in fields(state)}


def from_dict(states: States, held: State) -> Any:
    """The state that :func:`to_dict` gave ``held`` for; other keys are ignored.

    Raises KeyError if a key is missing.
    """
    kind = states[held["phase"]] if isinstance(states, Mapping) else states
    return kind(**{field.name: held[_key(field)] for field in fields(kind)})


def _key(field: Any) -> str:
    return str(field.metadata.get(KEY, field.name))
