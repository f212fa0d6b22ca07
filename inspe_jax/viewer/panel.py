"""The controls beside the scene: those that all browsers share, and those of one browser for new
sensors, for the selected one, and the list of all."""

from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import viser

from inspe_jax.core.words import visible
from inspe_jax.placement.optimise import DEFAULT_METHOD, METHODS
from inspe_jax.scoring.viewshed import Visibility
from inspe_jax.sensing.catalogue import devices
from inspe_jax.sensing.layout import Sensor
from inspe_jax.viewer.score_panel import VISIBILITY_NAMES

SECONDS = 60.0  # usual time of a search [s]
SLATE = (86, 104, 122)  # colour of buttons that are not the main one of their folder
BLIND_SPOTS = "Blind spots"
"""The title of their folder, while what is in it is of the layout in hand."""
DIGITS = {"x": 2, "y": 2, "height": 2, "yaw": 1, "pitch": 1}
"""The numbers of a pose, with the decimals that are shown and typed."""
POSE = {key: f"{key} [°]" if key in ("yaw", "pitch") else f"{key} [m]" for key in DIGITS}
"""Their labels."""
NONE, DEVICE = "No sensor is selected", "{0.title}: {0.name}"  # in the lists


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
        bind(self.stop, lambda _: viewer.queue.submit(viewer.searcher.stop))
        bind(self.target, lambda _: viewer.queue.submit(viewer.display.update_panel, key="target"))
        bind(self.frame, lambda _: viewer.scorer.select_frame(self.shown_frame))
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


class SensorControls:
    """The same of one browser: a method of ``view`` is called, once ``viewer`` has applied what is
    typed."""

    def __init__(self, gui: viser.GuiApi, viewer: Any, view: Any) -> None:
        # Of four folders, the notes on the last change are below the first two, whose buttons then
        # stay where they are.
        after = float(viewer.panel.target.order)
        known = sorted((one.spec for one in devices().values()), key=lambda spec: spec.title)
        self._devices = {DEVICE.format(spec): spec.name for spec in known}
        with gui.add_folder("New sensor", order=after + 0.1):
            hint = "The device that Add mounts"
            self.new = gui.add_dropdown("New device", list(self._devices), hint=hint)
            hint = "Mount a new sensor as near as possible to the point you look at"
            self.add = gui.add_button("Add", hint=hint)
        with gui.add_folder("Sensor", order=after + 0.2):
            self.sensor = gui.add_dropdown("Sensor", ("1",))
            self.name = gui.add_text("Name", "")
            self.device = gui.add_dropdown("Device", list(self._devices))
            self.pose = {
                key: gui.add_number(label, 0.0, step=round(0.1 ** DIGITS[key], DIGITS[key]))
                for key, label in POSE.items()
            }
            self.existing = gui.add_button_group(
                "Selected",
                ("Duplicate", "Remove"),
                hint="Copy the sensor that has the handle; remove all that are selected",
            )
        self.sensor_view = gui.add_folder("Through the sensor", order=after + 0.4)
        with gui.add_folder("All sensors", order=after + 0.5):
            self.table = gui.add_html("")
            # What a click on a row of the table presses; the page shows only the table.
            self.row_buttons = gui.add_button_group("Select", ("1",))
            self.toggle_buttons = gui.add_button_group("Select together", ("1",))

        changes = partial(bind, settle=viewer.settle)
        existing = {"Duplicate": view.duplicate, "Remove": view.remove}
        bind(self.sensor, lambda _: view.select(self.sensor.options.index(self.sensor.value)))
        bind(self.row_buttons, lambda _: view.select(int(self.row_buttons.value) - 1))
        bind(self.toggle_buttons, lambda _: view.select(int(self.toggle_buttons.value) - 1, True))
        bind(self.name, lambda _: view.rename(self.name.value))
        for key, number in self.pose.items():
            bind(number, partial(lambda key, _: view.type_number(key, self.pose[key].value), key))
        changes(self.device, lambda _: view.swap(self._devices[self.device.value]))
        changes(self.existing, lambda _: existing[self.existing.value]())
        changes(self.add, lambda _: view.add(self._devices[self.new.value]))

    def show(self, sensors: Sequence[Sensor], in_hand: int | None, *, change: bool) -> None:
        """List the sensors, numbered from 1; show that at place ``in_hand``, if one is; enable only
        what selects unless the layout may ``change``."""
        held = None if in_hand is None else sensors[in_hand]
        options = tuple(f"{k + 1}  {visible(one.name)}" for k, one in enumerate(sensors))
        options += (NONE,) if held is None else ()
        if options != tuple(self.sensor.options):
            self.sensor.options = options
            numbers = tuple(str(k + 1) for k in range(len(sensors)))
            self.row_buttons.options = self.toggle_buttons.options = numbers
        set_value(self.sensor, NONE if in_hand is None else options[in_hand])
        if held is not None:
            label = DEVICE.format(held.spec)
            if label not in self.device.options:  # the catalogue does not have it
                self._devices[label] = held.spec.name
                self.device.options = (*self.device.options, label)
            set_value(self.device, label)
        set_value(self.name, "" if held is None else held.name)
        self.new.disabled = self.add.disabled = not change
        self.existing.visible = can = change and held is not None
        for control in (self.device, self.name, *self.pose.values()):
            control.disabled = not can

    def show_pose(self, numbers: Mapping[str, float]) -> None:
        """Show the numbers of a pose."""
        for key, value in numbers.items():
            set_value(self.pose[key], round(value, DIGITS[key]))
