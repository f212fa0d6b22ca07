"""The controls of one browser: for a new sensor, for the selected one, and the list of all."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import viser

from inspe_jax.core.words import visible
from inspe_jax.sensing.catalogue import devices
from inspe_jax.sensing.layout import Sensor
from inspe_jax.sensing.sensors import Spec
from inspe_jax.viewer.panel import bind, set_value

DIGITS = {"x": 2, "y": 2, "height": 2, "yaw": 1, "pitch": 1}
"""The numbers of a pose, with the decimals that are shown and typed."""
POSE = {key: f"{key} [°]" if key in ("yaw", "pitch") else f"{key} [m]" for key in DIGITS}
"""Their labels."""
NONE = "No sensor is selected"


def label_of(spec: Spec) -> str:
    """What a device is called in a list: its kind and its name."""
    return f"{spec.title}: {spec.name}"


class SensorControls:
    """Every control by name. When a person uses one, a method of ``view`` is called. A value that
    the program itself sets calls nothing."""

    def __init__(self, gui: viser.GuiApi, viewer: Any, view: Any) -> None:
        """``viewer`` applies what is typed, ``view`` has the methods that are bound below."""
        # Of four folders, the notes on the last change are below the first two, whose buttons then
        # stay where they are.
        after = float(viewer.panel.target.order)
        known = sorted((one.spec for one in devices().values()), key=lambda spec: spec.title)
        self._devices = {label_of(spec): spec.name for spec in known}
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
            label = label_of(held.spec)
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
