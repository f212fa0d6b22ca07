"""The controls beside the scene: what can be pressed, and what it says."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import viser

from inspe_jax.placement.optimise import DEFAULT_METHOD, METHODS
from inspe_jax.sensing.devices import devices
from inspe_jax.viewer.board import SIGHTS
from inspe_jax.viewshed import Sight

SECONDS = 60.0
"""What a search is given if nobody says otherwise [s]."""
POSE = {
    "x": "x [m]",
    "y": "y [m]",
    "height": "height [m]",
    "yaw": "yaw [°]",
    "pitch": "pitch [°]",
}
"""The numbers of a pose, to a tenth."""


class Panel:
    """Every control by name. What a person does to one is asked of ``asked``'s method of its name.

    A value that the program sets asks for nothing.
    """

    def __init__(self, gui: viser.GuiApi, asked: Any, frames: int) -> None:
        """``asked`` has a method for each: see what is bound below."""
        known = list(devices())
        self.board = gui.add_html("")
        self.edit = gui.add_button_group("Change", ("Undo", "Redo"))
        with gui.add_folder("Sensor"):
            self.sensor = gui.add_dropdown("Sensor", ("1",))
            self.device = gui.add_dropdown("Device", known)
            self.pose = {key: gui.add_number(label, 0.0, step=0.1) for key, label in POSE.items()}
            self.existing = gui.add_button_group("This one", ("Duplicate", "Remove"))
            self.new = gui.add_dropdown("New device", known, hint="What Add puts up")
            self.add = gui.add_button(
                "Add", hint="A new sensor, mounted nearest to what you look at"
            )
        with gui.add_folder("Search"):
            self.method = gui.add_dropdown("Method", list(METHODS), initial_value=DEFAULT_METHOD)
            self.seconds = gui.add_number("Time [s]", SECONDS, min=1.0, step=10.0)
            self.optimise = gui.add_button("Optimise from here", color="green")
            self.stop = gui.add_button("Stop", color="orange", visible=False)
            self.bar = gui.add_progress_bar(0.0, visible=False)
            self.course = gui.add_markdown("", visible=False)
        with gui.add_folder("Traffic"):
            self.frame = gui.add_slider("Frame", 0, max(frames - 1, 1), 1, 0, disabled=frames < 2)
            self.play = gui.add_checkbox("Play", False, disabled=frames < 2)
            self.shown = {
                kind: gui.add_checkbox(name, kind is not Sight.SEEN)
                for kind, name in SIGHTS.items()
            }
        with gui.add_folder("File"):
            self.file = gui.add_markdown("")
            self.save = gui.add_button("Save layout")
            self.report = gui.add_button("Write report")

        self._bind(self.edit.on_click, lambda: asked.undo_or_redo(self.edit.value))
        self._bind(self.sensor.on_update, lambda: asked.select(self.chosen))
        self._bind(self.device.on_update, lambda: asked.swap(self.chosen, self.device.value))
        for key, number in self.pose.items():
            self._bind(number.on_update, partial(self._typed, asked, key))
        which = {"Duplicate": asked.duplicate, "Remove": asked.remove}
        self._bind(self.existing.on_click, lambda: which[self.existing.value](self.chosen))
        self._bind(self.optimise.on_click, asked.optimise)
        self._bind(self.stop.on_click, asked.stop)
        self._bind(self.frame.on_update, asked.watch)
        self._bind(self.play.on_update, asked.watch)
        for box in self.shown.values():
            self._bind(box.on_update, asked.show_voxels)
        self._bind(self.save.on_click, asked.save)
        self._bind(self.report.on_click, asked.write_report)

        @self.add.on_click
        async def _(event: Any) -> None:
            asked.add(self.new.value, event.client)

    def _typed(self, asked: Any, key: str) -> None:
        asked.type_number(self.chosen, key, float(self.pose[key].value))

    @property
    def chosen(self) -> int:
        """The place in the layout of the sensor that is chosen."""
        return int(self.sensor.value.split()[0]) - 1

    def list_sensors(self, names: Sequence[str], chosen: int) -> None:
        """Offer these sensors, numbered, and choose one."""
        options = tuple(f"{k + 1}  {name}" for k, name in enumerate(names))
        if options != tuple(self.sensor.options):
            self.sensor.options = options
        put(self.sensor, options[chosen])

    def offer_device(self, name: str) -> None:
        """Show a device, which the catalogue may not have."""
        if name not in self.device.options:
            self.device.options = (*self.device.options, name)
        put(self.device, name)

    def searching(self, on: bool) -> None:
        """While a search runs, nothing can be changed, and it can be stopped."""
        self.stop.visible = self.bar.visible = self.course.visible = on
        self.optimise.visible = self.edit.visible = self.existing.visible = not on
        others = (self.device, self.new, self.add, self.method, self.seconds, self.save)
        for control in (*others, *self.pose.values(), self.report):
            control.disabled = on

    @staticmethod
    def _bind(register: Callable[[Any], Any], ask: Callable[[], None]) -> None:
        """Ask where a browser did it: on the event loop, so that things stay in order."""

        async def called(event: Any) -> None:
            if event.client is not None:
                ask()

        register(called)


def put(control: Any, value: Any) -> None:
    """Set a control's value, in every browser. Types of the library have it read-only."""
    control.value = value
