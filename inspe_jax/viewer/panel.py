"""The controls beside the scene: buttons, numbers, and the text between them."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import viser

from inspe_jax.placement.optimise import DEFAULT_METHOD, METHODS
from inspe_jax.scene.traffic.frames import CLASSES
from inspe_jax.scoring.viewshed import Visibility
from inspe_jax.sensing.catalogue import devices
from inspe_jax.sensing.conditions import Conditions, lights, weathers
from inspe_jax.viewer.score_panel import REFERENCE, VISIBILITY_NAMES
from inspe_jax.viewer.store import EarlierFile

SECONDS = 60.0
"""Usual time of a search [s]."""
POSE = {
    "x": "x [m]",
    "y": "y [m]",
    "height": "height [m]",
    "yaw": "yaw [°]",
    "pitch": "pitch [°]",
}
"""The numbers of a pose, with their labels."""
DIGITS = {"x": 2, "y": 2, "height": 2, "yaw": 1, "pitch": 1}
"""The decimals with which they are shown and typed."""


SLATE = (86, 104, 122)
"""Colour of buttons that are not the main one of their folder."""
REGIONS = "regions"
GROUND: dict[str, str | None] = {REGIONS: None} | {f"finding a {name}": name for name in CLASSES}
"""What the ground can be coloured by: its regions, or the chance to find a road user there."""


KEYS: tuple[tuple[str, Any, Any, str], ...] = (
    ("Undo", "Z", "cmd/ctrl", "Ctrl+Z"),
    ("Redo", "Z", "cmd/ctrl+shift", "Ctrl+Shift+Z"),
    ("Save layout", "S", "cmd/ctrl", "Ctrl+S"),
    ("Select the next sensor", "N", None, "N"),
    ("Select the sensor before", "N", "shift", "Shift+N"),
    ("Remove the selected sensor", "delete", None, "Delete"),
    ("Look at the whole intersection", "home", None, "Home"),
    ("List the keys", "H", None, "H or ?"),
)
"""What keys do: words, the key, what is held with it, and both in words. They are not heard while a
number is typed. Arrows and W, A, S, D, Q, E move the camera, which is viser's."""


class Panel:
    """Every control by name. When a person uses one, a method of ``viewer`` is called.

    A value that the program itself sets calls nothing.
    """

    def __init__(self, gui: viser.GuiApi, viewer: Any, frames: int, around: Conditions) -> None:
        """``viewer`` has the methods that are bound below; ``frames`` of traffic there are, and
        the conditions at the start are those ``around``."""
        known = list(devices())
        plain: Any = dict(show_logo=False, show_share_button=False, brand_color=(0, 114, 178))
        gui.configure_theme(**plain)
        gui.main_panel.dock_right()
        self._gui, self._viewer, self._frames = gui, viewer, frames
        self._question: Any = None
        self.offers: list[Any] = []
        self.earlier = gui.add_folder("Earlier work", visible=False)
        self.headline = gui.add_html("")
        self.edit = gui.add_button_group("", ("Undo", "Redo", "Save"))
        self.scores = gui.add_html("")
        self.compare = gui.add_button_group("Compare", ("Set as A", "Swap with A"), hint=REFERENCE)
        with gui.add_folder("Sensor"):
            self.sensor = gui.add_dropdown("Sensor", ("1",))
            self.name = gui.add_text("Name", "")
            self.device = gui.add_dropdown("Device", known)
            self.pose = {
                key: gui.add_number(label, 0.0, step=round(0.1 ** DIGITS[key], DIGITS[key]))
                for key, label in POSE.items()
            }
            self.existing = gui.add_button_group("This one", ("Duplicate", "Remove"))
            self.new = gui.add_dropdown("New device", known, hint="The device that Add mounts")
            self.add = gui.add_button(
                "Add", hint="Mount a new sensor as near as possible to the point you look at"
            )
        self.sensor_view = gui.add_folder("Through the sensor")
        with gui.add_folder("All sensors"):
            self.table = gui.add_html("")
        with gui.add_folder("Search"):
            self.method = gui.add_dropdown("Method", list(METHODS), initial_value=DEFAULT_METHOD)
            self.seconds = gui.add_number("Time [s]", SECONDS, min=1.0, step=10.0)
            self.optimise = gui.add_button("Optimise from here", color="green")
            self.stop = gui.add_button("Stop", color="orange", visible=False)
            self.bar = gui.add_progress_bar(0.0, visible=False)
            self.course = gui.add_markdown("", visible=False)
        self.blind_spots = gui.add_folder("Blind spots", visible=False)
        with gui.add_folder("Traffic, light and weather"):
            self.frame = gui.add_slider("Frame", 0, max(frames - 1, 1), 1, 0, disabled=frames < 2)
            self.play = gui.add_checkbox("Play", False, disabled=frames < 2)
            self.light = gui.add_dropdown("Light", lights(), initial_value=around.light)
            given = _weather(around)
            self.weather = gui.add_dropdown(
                "Weather", list(dict.fromkeys((*weathers(), given))), initial_value=given
            )
            self.ground = gui.add_dropdown(
                "Ground",
                list(GROUND),
                hint="Colour the ground by its regions; or by the chance that a detector finds a "
                "road user who stands there, mean over all frames. Voxels are then not drawn.",
            )
            self.shown = {
                kind: gui.add_checkbox(name, kind is not Visibility.SEEN)
                for kind, name in VISIBILITY_NAMES.items()
            }
        with gui.add_folder("File"):
            self.file = gui.add_markdown("")
            self.save = gui.add_button("Save layout")
            self.download = gui.add_button("Download layout", color=SLATE)
            self.report = gui.add_button("Write report", hint="And offer it for download here")

        keys: dict[str, Callable[[Any], None]] = {
            "Undo": lambda _: viewer.undo_or_redo("Undo"),
            "Redo": lambda _: viewer.undo_or_redo("Redo"),
            "Save layout": lambda _: viewer.save(),
            "Select the next sensor": lambda _: viewer.select(self._beside(1)),
            "Select the sensor before": lambda _: viewer.select(self._beside(-1)),
            "Remove the selected sensor": lambda _: viewer.remove(self.chosen),
            "Look at the whole intersection": viewer.look_at_all,
            "List the keys": _list_keys,
        }
        self.keys = {
            words: gui.add_command(words, hotkey=key, modifier=held) for words, key, held, _ in KEYS
        }
        for words, command in self.keys.items():
            self._bind_click(command, keys[words])
        self._bind(self.edit, lambda: self._edit(self.edit.value))
        compare = {"Set as A": viewer.set_reference, "Swap with A": viewer.swap_reference}
        self._bind(self.compare, lambda: compare[self.compare.value]())
        self._bind(self.sensor, lambda: viewer.select(self.chosen))
        self._bind(self.device, lambda: viewer.swap(self.chosen, self.device.value))
        self._bind(self.name, lambda: viewer.rename(self.chosen, self.name.value), settle=False)
        for key, number in self.pose.items():
            self._bind(number, partial(self._typed, viewer, key), settle=False)
        which = {"Duplicate": viewer.duplicate, "Remove": viewer.remove}
        self._bind(self.existing, lambda: which[self.existing.value](self.chosen))
        for choice in (self.new, self.method):
            self._bind(choice, lambda: None)
        self._bind(self.optimise, viewer.optimise)
        self._bind(self.stop, viewer.stop)
        self._bind(self.frame, viewer.select_frame)
        self._bind(self.play, viewer.select_frame)
        for choice in (self.light, self.weather):
            self._bind(choice, viewer.change_conditions)
        self._bind(self.ground, viewer.color_ground)
        for box in self.shown.values():
            self._bind(box, viewer.show_voxels)
        self._bind(self.save, viewer.save)
        self._bind_click(self.add, lambda client: viewer.add(self.new.value, client))
        self._bind_click(self.download, viewer.download)
        self._bind_click(self.report, viewer.write_report)

    def offer_earlier(self, earlier: Sequence[EarlierFile]) -> None:
        """Offer to open layouts that an earlier run has left."""
        if not earlier:
            return
        self.earlier.visible = True
        with self.earlier:
            self._gui.add_markdown(
                f"An earlier run has left {' and '.join(one.words for one in earlier)}. "
                "They are not replaced unless you say so."
            )
            for number, one in enumerate(earlier):
                self.offers.append(self._gui.add_button(f"Open {one.path.name}"))
                self._bind(self.offers[-1], partial(self._viewer.open_earlier, number))
            self._bind(self._gui.add_button("Leave them", color="gray"), self._leave)

    def withdraw(self, number: int) -> None:
        """Stop offering a layout, since it is open."""
        self.offers[number].visible = False
        if not any(offer.visible for offer in self.offers):
            self._leave()

    def _leave(self) -> None:
        self.earlier.visible = False

    def ask_replace(self, name: str, other: str) -> None:
        """Ask whether to replace the file ``name`` of an earlier run; ``other`` is a free name."""
        self._end_question()
        self._question = self._gui.add_modal(f"Replace {name}?")
        with self._question:
            self._gui.add_markdown(
                f"`{name}` was not written by this run of the viewer. It may hold other work."
            )
            for answer, then in (
                (self._gui.add_button(f"Save as {other}"), self._viewer.save_beside),
                (self._gui.add_button(f"Replace {name}", color="red"), self._viewer.replace),
                (self._gui.add_button("Cancel", color="gray"), lambda: None),
            ):
                self._bind(answer, partial(self._answer, then))

    def _answer(self, then: Callable[[], None]) -> None:
        self._end_question()
        then()

    def _end_question(self) -> None:
        if self._question is not None:
            self._question.close()
            self._question = None

    def _typed(self, viewer: Any, key: str) -> None:
        viewer.type_number(self.chosen, key, float(self.pose[key].value))

    @property
    def road_user(self) -> str | None:
        """The class of road users by whose chance the ground is coloured; None for its regions."""
        return GROUND.get(self.ground.value)

    @property
    def shown_frame(self) -> int:
        """The slider's frame. With a single frame the slider still has two places."""
        return min(max(int(self.frame.value), 0), self._frames - 1)

    @property
    def chosen(self) -> int:
        """The chosen sensor's place in the layout; 0 if none is chosen."""
        value, options = self.sensor.value, self.sensor.options
        return options.index(value) if value in options else 0

    def _edit(self, what: str) -> None:
        if what == "Save":
            self._viewer.save()
        else:
            self._viewer.undo_or_redo(what)

    def _beside(self, step: int) -> int:
        """The place of the sensor so many places after the chosen one, round and round."""
        return (self.chosen + step) % len(self.sensor.options)

    def show_conditions(self, around: Conditions) -> None:
        """Choose the light and the weather that there are."""
        set_value(self.light, around.light)
        set_value(self.weather, _weather(around))

    def list_sensors(self, names: Sequence[str], chosen: int) -> None:
        """List these sensors, numbered from 1, and choose the one at place ``chosen``."""
        options = tuple(f"{k + 1}  {name}" for k, name in enumerate(names))
        if options != tuple(self.sensor.options):
            self.sensor.options = options
        set_value(self.sensor, options[chosen])

    def offer_device(self, name: str) -> None:
        """Choose a device in the list; add it if the catalogue does not have it."""
        if name not in self.device.options:
            self.device.options = (*self.device.options, name)
        set_value(self.device, name)

    def searching(self, on: bool) -> None:
        """Disable changes while a search runs, and show the button that stops it."""
        self.stop.visible = self.bar.visible = self.course.visible = on
        self.optimise.visible = self.existing.visible = self.compare.visible = not on
        self.edit.visible = not on
        choices = self.device, self.new, self.method, self.seconds, self.light, self.weather
        buttons = self.add, self.save, self.report, *self.offers
        for control in (*choices, self.name, *self.pose.values(), *buttons):
            control.disabled = on

    def _bind_click(self, button: Any, ask: Callable[[Any], None]) -> None:
        """Call ``ask`` with the browser that clicks a button, or presses the key of a command, once
        typed numbers are applied."""

        async def called(event: Any) -> None:
            if event.client is not None:
                self._viewer.settle()
                ask(event.client)

        register = getattr(button, "on_click", None) or button.on_trigger
        register(called)

    def _bind(self, control: Any, ask: Callable[[], None], *, settle: bool = True) -> None:
        """Call ``ask`` when a browser uses a control, on the event loop, so that order is kept.

        With ``settle``, typed numbers are applied before. A value that is not an option is refused.
        """

        async def called(event: Any) -> None:
            if event.client is None:
                return
            options = getattr(control, "options", None)
            if options is not None and control.value not in options:
                if control in (self.new, self.method):
                    set_value(control, options[0])
                self._viewer.restore()
                return
            if settle:
                self._viewer.settle()
            ask()

        register = getattr(control, "on_click", None) or control.on_update
        register(called)


def _weather(around: Conditions) -> str:
    """The weather's name, with its intensity if that is not the usual one."""
    return around.weather_text if around.unusual else around.weather


def _list_keys(client: Any) -> None:
    """Tell a browser what keys do."""
    words = "; ".join(f"{key}: {what[0].lower()}{what[1:]}" for what, _, _, key in KEYS)
    more = "Arrows, W, A, S, D, Q and E move your view."
    client.add_notification("Keys", f"{words}. {more}", auto_close_seconds=20.0)


def set_value(control: Any, value: Any) -> None:
    """Set a control's value in every browser. viser's types declare it read-only."""
    control.value = value
