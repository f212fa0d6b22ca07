"""The controls of one browser's selected sensor: its device, its name, its pose; and the list."""

from collections.abc import Sequence
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
            self.existing = gui.add_button_group("This one", ("Duplicate", "Remove"))
            self.new = gui.add_dropdown("New device", known, hint="The device that Add mounts")
            self.add = gui.add_button(
                "Add", hint="Mount a new sensor as near as possible to the point you look at"
            )
        self.sensor_view = gui.add_folder("Through the sensor", order=orders[1])
        with gui.add_folder("All sensors", order=orders[2]):
            self.table = gui.add_html("")
            # What a click on a row of the table presses; the page shows only the table.
            self.rows = gui.add_button_group("Select", ("1",))
            self.boxes = gui.add_button_group("Select together", ("1",))

        bind(viewer, self.sensor, lambda _: view.select(self.chosen))
        bind(viewer, self.device, lambda _: view.swap(self.chosen, self.device.value))
        bind(viewer, self.name, lambda _: view.rename(self.chosen, self.name.value), settle=False)
        for key, number in self.pose.items():
            self._bind_number(viewer, view, key, number)
        which = {"Duplicate": view.duplicate, "Remove": view.remove}
        bind(viewer, self.existing, lambda _: which[self.existing.value](self.chosen))
        bind_choice(viewer, self.new)
        bind(viewer, self.add, lambda _: view.add(self.new.value))
        bind(viewer, self.rows, lambda _: view.select(int(self.rows.value) - 1))
        bind(viewer, self.boxes, lambda _: view.toggle(int(self.boxes.value) - 1))

    @property
    def chosen(self) -> int:
        """The place in the layout of the sensor that the list has chosen; 0 if none is."""
        value, options = self.sensor.value, self.sensor.options
        return options.index(value) if value in options else 0

    @property
    def count(self) -> int:
        """Number of sensors in the list."""
        return len(self.sensor.options)

    def list_sensors(self, names: Sequence[str], chosen: int) -> None:
        """List these sensors, numbered from 1, and choose the one at place ``chosen``."""
        options = tuple(f"{k + 1}  {name}" for k, name in enumerate(names))
        if options != tuple(self.sensor.options):
            self.sensor.options = options
            numbers = tuple(str(k + 1) for k in range(len(names)))
            self.rows.options = self.boxes.options = numbers
        set_value(self.sensor, options[chosen])

    def offer_device(self, name: str) -> None:
        """Choose a device in the list; add it if the catalogue does not have it."""
        if name not in self.device.options:
            self.device.options = (*self.device.options, name)
        set_value(self.device, name)

    def show_table(
        self, layout: Layout, scored: ScoredLayout | None, chosen: Sequence[int]
    ) -> None:
        """Show a row for each sensor, with what it adds to the scores."""
        self.table.content = sensor_table(layout, scored, chosen)

    def searching(self, on: bool) -> None:
        """Disable changes while a search runs."""
        self.existing.visible = not on
        for control in (self.device, self.new, self.name, *self.pose.values(), self.add):
            control.disabled = on

    def _bind_number(self, viewer: Any, view: Any, key: str, number: Any) -> None:
        def typed(_: Any) -> None:
            view.type_number(self.chosen, key, float(number.value))

        bind(viewer, number, typed, settle=False)
