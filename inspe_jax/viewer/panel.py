"""The controls beside the scene: buttons, numbers, and the text between them."""

from collections.abc import Callable, Sequence
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import viser

from inspe_jax.placement.optimise import DEFAULT_METHOD, METHODS
from inspe_jax.scoring.viewshed import Visibility
from inspe_jax.viewer.score_panel import VISIBILITY_NAMES

SECONDS = 60.0  # usual time of a search [s]
SLATE = (86, 104, 122)  # colour of buttons that are not the main one of their folder
BLIND_SPOTS = "Blind spots"
"""The title of their folder, while what is in it is of the layout in hand."""


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


class Key(NamedTuple):
    """A key of the page: what it does in ``words``, the ``key``, the ``modifier`` held with it,
    both in ``text``, and what it asks of the viewer on behalf of a browser."""

    words: str
    key: Any
    modifier: Any
    text: str
    ask: Callable[[Any, Any], object]


KEYS = (
    Key("Undo", "Z", "cmd/ctrl", "Ctrl+Z", lambda v, _: v.undo_or_redo("Undo")),
    Key("Redo", "Z", "cmd/ctrl+shift", "Ctrl+Shift+Z", lambda v, _: v.undo_or_redo("Redo")),
    Key("Save layout", "S", "cmd/ctrl", "Ctrl+S", lambda v, _: v.save()),
    Key("Remove what is selected", "delete", None, "Delete", lambda v, c: v.remove(c)),
    Key("Look at the whole intersection", "home", None, "Home", lambda v, c: v.look_at_all(c)),
    Key("List the keys", "H", None, "H or ?", lambda _, client: _list_keys(client)),
)
"""Not heard while a number is typed. Arrows and W, A, S, D, Q, E are viser's, for the camera."""


class Panel:
    """Every control by name. When a person uses one, a method of ``viewer`` is called. A value that
    the program itself sets calls nothing."""

    def __init__(self, gui: viser.GuiApi, viewer: Any, frames: int) -> None:
        """``viewer`` has the methods that are bound below; there are ``frames`` of traffic."""
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(0, 114, 178))
        gui.main_panel.dock_right()
        self._gui, self._viewer, self._frames = gui, viewer, frames
        self._changes = partial(bind, settle=viewer.settle)
        self.offers: list[Any] = []
        self.earlier = gui.add_folder("Earlier work", visible=False)
        self.headline = gui.add_html("")
        self.edit = gui.add_button_group("", ("Undo", "Redo", "Save"))
        self.scores = gui.add_html("")
        self.target = gui.add_number(
            "Target", 0.0, min=0.0, max=1.0, step=0.01,
            hint="The P_sm that the layout should reach, as an orange mark: a search ends there; "
            "0 for none",
        )  # fmt: skip
        self.notes = gui.add_html("", order=float(self.target.order) + 0.3, visible=False)
        with gui.add_folder("Search"):
            self.method = gui.add_dropdown("Method", list(METHODS), initial_value=DEFAULT_METHOD)
            self.seconds = gui.add_number("Time [s]", SECONDS, min=1.0, step=10.0)
            self.optimise = gui.add_button("Optimise from here", color="green")
            self.stop = gui.add_button("Stop", color="orange", visible=False)
            self.bar = gui.add_progress_bar(0.0, visible=False)
            self.course = gui.add_markdown(
                "It may move every unit to wherever units can stand, also to new poles. It "
                "compiles first; that does not count as its time."
            )
        self.blind_spots = gui.add_folder(BLIND_SPOTS, visible=False)
        with gui.add_folder("Traffic"):
            self.frame = gui.add_slider("Frame", 0, max(frames - 1, 1), 1, 0, disabled=frames < 2)
            self.shown = {
                kind: gui.add_checkbox(name, kind is not Visibility.SEEN)
                for kind, name in VISIBILITY_NAMES.items()
            }
        with gui.add_folder("File"):
            self.file = gui.add_html("")
            self.save = gui.add_button("Save layout")
            self.download = gui.add_button("Download layout", color=SLATE)
            self.report = gui.add_button("Write report", hint="Beside the layout, and download it")

        self.keys: dict[str, Any] = {}
        for key in KEYS:
            command = gui.add_command(key.words, hotkey=key.key, modifier=key.modifier)
            self._changes(command, partial(key.ask, viewer))
            self.keys[key.words] = command
        edit = {which: partial(viewer.undo_or_redo, which) for which in ("Undo", "Redo")}
        edit["Save"] = viewer.save
        self._changes(self.edit, lambda _: edit[self.edit.value]())
        self._changes(self.optimise, lambda _: viewer.optimise())
        bind(self.stop, lambda _: viewer.stop())
        bind(self.target, lambda _: viewer.queue.submit(viewer.display.update_panel, key="target"))
        bind(self.frame, lambda _: viewer.select_frame())
        for box in self.shown.values():
            bind(box, lambda _: viewer.queue.submit(viewer.display.draw_voxels, key="ticks"))
        self._changes(self.save, lambda _: viewer.save())
        self._changes(self.download, viewer.download)
        self._changes(self.report, viewer.write_report)

    def offer_earlier(self, earlier: Sequence[Path]) -> None:
        """Offer to open layouts that an earlier run has left."""
        if not earlier:
            return
        names = [
            f"`{at.name}` of {datetime.fromtimestamp(at.stat().st_mtime):%d %B, %H:%M}"
            for at in earlier
        ]
        self.earlier.visible = True
        with self.earlier:
            self._gui.add_markdown(
                f"An earlier run has left {' and '.join(names)}. "
                "They are not replaced unless you say so."
            )
            for number, at in enumerate(earlier):
                self.offers.append(self._gui.add_button(f"Open {at.name}"))
                ask = partial(lambda k, _: self._viewer.open_earlier(k), number)
                self._changes(self.offers[-1], ask)
            leave = self._gui.add_button("Leave them", color="gray")
            self._changes(leave, lambda _: setattr(self.earlier, "visible", False))

    def withdraw(self, number: int) -> None:
        """Stop offering a layout, since it is open."""
        self.offers[number].visible = False
        self.earlier.visible = any(offer.visible for offer in self.offers)

    def ask_replace(self, path: Path, other: Path) -> None:
        """Ask whether to save in ``path``, a file of an earlier run, or in ``other``, a new one."""
        question = self._gui.add_modal(f"Replace {path.name}?")

        def offer(words: str, color: Any, at: Path | None) -> None:
            def answer(_: Any) -> None:
                question.close()
                if at is not None:
                    self._viewer.save(at)

            self._changes(self._gui.add_button(words, color=color), answer)

        words = "was not written by this run of the viewer. It may hold other work."
        with question:
            self._gui.add_markdown(f"`{path.name}` {words}")
            offer(f"Save as {other.name}", None, other)
            offer(f"Replace {path.name}", "red", path)
            offer("Cancel", "gray", None)

    @property
    def shown_frame(self) -> int:
        """The slider's frame. With a single frame the slider still has two places."""
        return min(max(int(self.frame.value), 0), self._frames - 1)

    def searching(self, on: bool) -> None:
        """Disable changes while a search runs, and show the button that stops it."""
        self.stop.visible = self.bar.visible = on
        self.optimise.visible = self.edit.visible = not on
        choices = self.method, self.seconds, self.target
        for control in (*choices, self.save, self.report, *self.offers):
            control.disabled = on


def _list_keys(client: Any) -> None:
    words = "; ".join(f"{key.text}: {key.words[0].lower()}{key.words[1:]}" for key in KEYS)
    more = "Arrows, W, A, S, D, Q and E move your view."
    client.add_notification("Keys", f"{words}. {more}", auto_close_seconds=20.0)
