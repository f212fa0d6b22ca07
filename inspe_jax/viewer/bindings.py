"""Controls of the page, and what is called when a browser uses one."""

from collections.abc import Callable
from typing import Any


def bind(viewer: Any, control: Any, ask: Callable[[Any], object], *, settle: bool = True) -> None:
    """Call ``ask`` with the browser that uses a control, on the event loop, so that order is kept.

    ``control`` is a button, a command with a key, or has a value. A value that is not an option
    is refused. With ``settle``, typed numbers are applied before.
    """

    async def called(event: Any) -> None:
        if event.client is None:
            return
        options = getattr(control, "options", None)
        if options is not None and control.value not in options:
            viewer.restore()
            return
        if settle:
            viewer.settle()
        ask(event.client)

    kinds = (getattr(control, name, None) for name in ("on_click", "on_trigger", "on_update"))
    register = next(kind for kind in kinds if kind is not None)
    register(called)


def bind_choice(viewer: Any, control: Any) -> None:
    """Refuse a value that is not an option, of a control that nothing follows until a button is
    pressed: the first option is chosen then."""

    async def called(event: Any) -> None:
        if event.client is not None:
            if control.value not in control.options:
                set_value(control, control.options[0])
            viewer.settle()

    control.on_update(called)


def set_value(control: Any, value: Any) -> None:
    """Set a control's value in every browser that has it. viser's types declare it read-only."""
    control.value = value
