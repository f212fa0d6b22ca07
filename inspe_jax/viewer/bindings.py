"""Controls of the page, and what is called when a browser uses one."""

from collections.abc import Callable
from typing import Any


def bind(
    control: Any, ask: Callable[[Any], object], settle: Callable[[], None] = lambda: None
) -> None:
    """Call ``ask`` with the browser that uses a control, on the event loop, so that order is kept.

    ``control`` is a button, a command with a key, or has a value. Nothing is called for a value
    that is not an option any more. ``settle`` is called before, to apply typed numbers.
    """

    async def called(event: Any) -> None:
        options = getattr(control, "options", None)
        if event.client is None or (options is not None and control.value not in options):
            return
        settle()
        ask(event.client)

    names = ("on_click", "on_trigger", "on_update")
    register = next(getattr(control, name) for name in names if hasattr(control, name))
    register(called)


def set_value(control: Any, value: Any) -> None:
    """Set a control's value in every browser that has it. viser's types declare it read-only."""
    control.value = value
