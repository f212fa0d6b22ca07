"""Controls of the page, and what is called when a browser uses one."""

from collections.abc import Callable
from typing import Any


def bind(
    control: Any,
    ask: Callable[[Any], object],
    *,
    refuse: Callable[[], None],
    settle: Callable[[], None] = lambda: None,
) -> None:
    """Call ``ask`` with the browser that uses a control, on the event loop, so that order is kept.

    ``control`` is a button, a command with a key, or has a value. For a value that is not an
    option, ``refuse`` is called instead. ``settle`` is called before, to apply typed numbers.
    """

    async def called(event: Any) -> None:
        if event.client is None:
            return
        options = getattr(control, "options", None)
        if options is not None and control.value not in options:
            refuse()
            return
        settle()
        ask(event.client)

    names = ("on_click", "on_trigger", "on_update")
    register = next(getattr(control, name) for name in names if hasattr(control, name))
    register(called)


def bind_choice(control: Any, chosen: Callable[[], object] = lambda: None) -> None:
    """Choose the first option in place of a value that is none, in a list that nothing follows
    until a button is pressed. ``chosen`` is called when a browser chooses an option."""
    bind(control, lambda _: chosen(), refuse=lambda: set_value(control, control.options[0]))


def set_value(control: Any, value: Any) -> None:
    """Set a control's value in every browser that has it. viser's types declare it read-only."""
    control.value = value
