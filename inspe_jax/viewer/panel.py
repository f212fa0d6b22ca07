"""The controls beside the scene: what can be pressed, and what it says."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import viser

from inspe_jax.placement.optimise import DEFAULT_METHOD, METHODS
from inspe_jax.scoring.viewshed import Visibility
from inspe_jax.sensing.catalogue import devices
from inspe_jax.viewer.score_panel import SIGHTS
from inspe_jax.viewer.store import Earlier

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
        self._gui, self._asked = gui, asked
        self._question: Any = None
        self.offers: list[Any] = []
        self.earlier = gui.add_folder("Earlier work", visible=False)
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
                kind: gui.add_checkbox(name, kind is not Visibility.SEEN)
                for kind, name in SIGHTS.items()
            }
        with gui.add_folder("File"):
            self.file = gui.add_markdown("")
            self.save = gui.add_button("Save layout")
            self.report = gui.add_button("Write report")

        self._bind(self.edit, lambda: asked.undo_or_redo(self.edit.value))
        self._bind(self.sensor, lambda: asked.select(self.chosen))
        self._bind(self.device, lambda: asked.swap(self.chosen, self.device.value))
        for key, number in self.pose.items():
            self._bind(number, partial(self._typed, asked, key), settle=False)
        which = {"Duplicate": asked.duplicate, "Remove": asked.remove}
        self._bind(self.existing, lambda: which[self.existing.value](self.chosen))
        for choice in (self.new, self.method):
            self._bind(choice, lambda: None)
        self._bind(self.optimise, asked.optimise)
        self._bind(self.stop, asked.stop)
        self._bind(self.frame, asked.watch)
        self._bind(self.play, asked.watch)
        for box in self.shown.values():
            self._bind(box, asked.show_voxels)
        self._bind(self.save, asked.save)
        self._bind(self.report, asked.write_report)

        @self.add.on_click
        async def _(event: Any) -> None:
            asked.settle()
            asked.add(self.new.value, event.client)

    def offer_earlier(self, earlier: Sequence[Earlier]) -> None:
        """Offer layouts that an earlier run has left; until none is wanted any more."""
        if not earlier:
            return
        self.earlier.visible = True
        with self.earlier:
            self._gui.add_markdown(
                f"An earlier run has left {' and '.join(one.words for one in earlier)}. "
                "Nothing here replaces that unasked."
            )
            for number, one in enumerate(earlier):
                self.offers.append(self._gui.add_button(f"Open {one.path.name}"))
                self._bind(self.offers[-1], partial(self._asked.open_earlier, number))
            self._bind(self._gui.add_button("Leave them", color="gray"), self._leave)

    def withdraw(self, number: int) -> None:
        """Offer a layout no more: it is open."""
        self.offers[number].visible = False
        if not any(offer.visible for offer in self.offers):
            self._leave()

    def _leave(self) -> None:
        self.earlier.visible = False

    def ask_replace(self, name: str, other: str) -> None:
        """Ask whether a file of an earlier run is to be replaced."""
        self._end_question()
        self._question = self._gui.add_modal(f"Replace {name}?")
        with self._question:
            self._gui.add_markdown(
                f"`{name}` was not written by this run of the viewer, and may hold other work."
            )
            for answer, then in (
                (self._gui.add_button(f"Save as {other}"), self._asked.save_beside),
                (self._gui.add_button(f"Replace {name}", color="red"), self._asked.replace),
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

    def _typed(self, asked: Any, key: str) -> None:
        asked.type_number(self.chosen, key, float(self.pose[key].value))

    @property
    def chosen(self) -> int:
        """The place in the layout of the sensor that is chosen; 0 where none of them is."""
        value, options = self.sensor.value, self.sensor.options
        return options.index(value) if value in options else 0

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
        for control in (*others, *self.pose.values(), *self.offers, self.report):
            control.disabled = on

    def _bind(self, control: Any, ask: Callable[[], None], *, settle: bool = True) -> None:
        """Ask where a browser did it: on the event loop, so that things stay in order.

        What is typed counts before (``settle``). A value that is none of the options asks nothing.
        """

        async def called(event: Any) -> None:
            if event.client is None:
                return
            options = getattr(control, "options", None)
            if options is not None and control.value not in options:
                if control in (self.new, self.method):
                    put(control, options[0])
                self._asked.restore()
                return
            if settle:
                self._asked.settle()
            ask()

        register = getattr(control, "on_click", None) or control.on_update
        register(called)


def put(control: Any, value: Any) -> None:
    """Set a control's value, in every browser. Types of the library have it read-only."""
    control.value = value
