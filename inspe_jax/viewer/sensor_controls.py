"""The controls of one browser's selected sensor: its device, its name, its pose; and the list."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import viser

from inspe_jax.sensing.catalogue import devices
from inspe_jax.sensing.layout import Layout
from inspe_jax.viewer.bindings import bind, bind_choice, set_value
from inspe_jax.viewer.score_panel import sensor_table
from inspe_jax.viewer.scorer import ScoredLayout

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


class SensorControls:
    """Every control by name. When a person uses one, a method of ``view`` is called.

    A value that the program itself sets calls nothing.
    """

    def __init__(
        self, gui: viser.GuiApi, viewer: Any, view: Any, orders: tuple[float, float, float]
    ) -> None:
        """``viewer`` refuses what is impossible, ``view`` has the methods that are bound below.
        ``orders`` are the places in the panel of the three folders."""
        known = list(devices())
        with gui.add_folder("Sensor", order=orders[0]):
            self.sensor = gui.add_dropdown("Sensor", ("1",))
            self.name = gui.add_text("Name", "")
            self.device = gui.add_dropdown("Device", known)
            self.pose = {
                key: gui.add_number(label, 0.0, step=round(0.1 ** DIGITS[key], DIGITS[key]))
                for key, label in POSE.items()
            }
            self.existing = gui.add_button_group(
                "Selected",
                ("Duplicate", "Remove"),
                hint="Copy the sensor that has the handle; remove all that are selected",
            )
            self.new = gui.add_dropdown("New device", known, hint="The device that Add mounts")
            self.add = gui.add_button(
                "Add", hint="Mount a new sensor as near as possible to the point you look at"
            )
        self.sensor_view = gui.add_folder("Through the sensor", order=orders[1])
        with gui.add_folder("All sensors", order=orders[2]):
            self.table = gui.add_html("")
            # What a click on a row of the table presses; the page shows only the table.
            self.row_buttons = gui.add_button_group("Select", ("1",))
            self.toggle_buttons = gui.add_button_group("Select together", ("1",))

        def selects(control: Any, ask: Callable[[], object]) -> None:
            bind(control, lambda _: ask(), refuse=viewer.restore)

        def changes(control: Any, ask: Callable[[], object]) -> None:
            bind(control, lambda _: ask(), refuse=viewer.restore, settle=viewer.settle)

        selects(self.sensor, lambda: view.select(self.sensor.options.index(self.sensor.value)))
        selects(self.row_buttons, lambda: view.select(int(self.row_buttons.value) - 1))
        selects(self.toggle_buttons, lambda: view.toggle(int(self.toggle_buttons.value) - 1))
        selects(self.name, lambda: view.rename(self.name.value))
        for key, number in self.pose.items():
            selects(number, partial(self._typed, view, key))
        changes(self.device, lambda: view.swap(self.device.value))
        changes(self.existing, lambda: self._do(view, self.existing.value))
        bind_choice(self.new)
        changes(self.add, lambda: view.add(self.new.value))

    def list_sensors(self, names: Sequence[str], in_hand: int) -> None:
        """List these sensors, numbered from 1, and choose the one at place ``in_hand``."""
        options = tuple(f"{k + 1}  {name}" for k, name in enumerate(names))
        if options != tuple(self.sensor.options):
            self.sensor.options = options
            numbers = tuple(str(k + 1) for k in range(len(names)))
            self.row_buttons.options = self.toggle_buttons.options = numbers
        set_value(self.sensor, options[in_hand])

    def offer_device(self, name: str) -> None:
        """Choose a device in the list; add it if the catalogue does not have it."""
        if name not in self.device.options:
            self.device.options = (*self.device.options, name)
        set_value(self.device, name)

    def show_table(
        self, layout: Layout, scored: ScoredLayout | None, selection: Sequence[int]
    ) -> None:
        """Show a row for each sensor of a layout, with what it adds to scores, if it has any."""
        self.table.content = sensor_table(layout, scored, selection)

    def searching(self, on: bool) -> None:
        """Leave only what selects, while a search runs."""
        self.existing.visible = not on
        for control in (self.device, self.new, self.name, *self.pose.values(), self.add):
            control.disabled = on

    def _typed(self, view: Any, key: str) -> None:
        view.type_number(key, float(self.pose[key].value))

    def _do(self, view: Any, what: str) -> None:
        if what == "Duplicate":
            view.duplicate()
        else:
            view.remove()
