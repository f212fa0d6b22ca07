"""What one browser has of its own: the sensors that it has selected, the handle on them, their
numbers, and what they see. The layout is everybody's."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from inspe_jax.sensing.layout import Layout
from inspe_jax.viewer.bindings import set_value
from inspe_jax.viewer.handle import Handle, HandleDrag
from inspe_jax.viewer.job_queue import DelayedAction
from inspe_jax.viewer.scorer import ScoredLayout
from inspe_jax.viewer.selection3d import Selection3D
from inspe_jax.viewer.sensor_controls import DIGITS, POSE, SensorControls
from inspe_jax.viewer.sensor_view import Look, SensorView

TYPED = 0.7
"""A typed number is applied after this time without another key [s], or before another action."""
NAMED = 2.0
"""The same for a name [s]: one pauses between words."""


class Gripped(NamedTuple):
    """While the handle is dragged: sensors, the layout at the start, whether they were moved."""

    chosen: tuple[int, ...]
    layout: Layout
    moved: bool = False


class BrowserView:
    """One browser's selected sensors.

    ``chosen`` are their places in the layout; the last of them has the handle, and the others move
    along with it.
    """

    def __init__(self, client: Any, viewer: Any) -> None:
        """``client`` has a panel and a scene of its own, ``viewer`` what all browsers share."""
        self.client, self._viewer = client, viewer
        self.chosen: tuple[int, ...] = (0,)
        self.dragging: Gripped | None = None
        self._layout: Layout = viewer.layout  # that the places are of
        self._typing = {key: DelayedAction() for key in (*POSE, "name")}
        self.controls = SensorControls(client.gui, viewer, self, viewer.panel.sensor_orders)
        self.selection3d = Selection3D(client.scene, viewer.scene3d.shift)
        self.handle = Handle(client.scene, self.on_drag)
        self.sensor_view = SensorView(
            client.gui,
            self.controls.sensor_view,
            viewer.case,
            viewer.queue.failed,
            self._show_points,
        )

    @property
    def selected(self) -> int:
        """The place of the sensor that has the handle."""
        return self.chosen[-1]

    def close(self) -> None:
        """Apply what is typed, and finish what is being recorded."""
        self.settle()
        self.sensor_view.close()

    # ── What the browser asks for; ``s`` is the place of a sensor in the layout ──

    def settle(self) -> None:
        """Apply the numbers that are typed, before another action."""
        for waiting in self._typing.values():
            waiting.run_now()

    def select(self, s: int) -> None:
        """Select another sensor, and no other."""
        self._choose(lambda: (s,))

    def toggle(self, s: int) -> None:
        """Select a sensor together with others, or no longer; the last one stays selected."""
        self._choose(
            lambda: (
                (*self.chosen, s)
                if s not in self.chosen
                else tuple(k for k in self.chosen if k != s) or self.chosen
            )
        )

    def step(self, by: int) -> None:
        """Select the sensor so many places after the selected one, round and round."""
        self.select((self.controls.chosen + by) % self.controls.count)

    def click_number(self, u: int, *, several: bool = False) -> None:
        """Of the sensors on a unit, select the one after the selected one, round and round; with
        ``several``, all of them, or none, together with others."""

        def found() -> tuple[int, ...]:
            units = [members for members in self._viewer.layout.members() if members]
            if u >= len(units):  # removed since
                return self.chosen
            members = tuple(units[u])
            if several:
                others = tuple(k for k in self.chosen if k not in members)
                there = set(members) <= set(self.chosen)
                return (others or self.chosen) if there else (*others, *members)
            after = [s for s in members if s > self.selected] if self.selected in members else []
            return ((*after, *members)[0],)

        self._choose(found)

    def swap(self, s: int, name: str) -> None:
        """Exchange a sensor's device."""
        self._viewer.change(partial(self._viewer.session.swap, s, name))

    def type_number(self, s: int, key: str, value: float) -> None:
        """Set a number of a sensor's pose, once nothing more is typed."""

        def change() -> None:
            session = self._viewer.session
            session.set_number(s, key, value, self._along(s))
            if session.notes:  # the sensor cannot be mounted there
                self._viewer.display.notify("Mounted nearby", "; ".join(session.notes), "orange")

        self._typing[key].start(TYPED, lambda: self._viewer.change(change))

    def rename(self, s: int, name: str) -> None:
        """Give a sensor another name, once nothing more is typed."""
        change = partial(self._viewer.session.rename, s, name)
        self._typing["name"].start(NAMED, lambda: self._viewer.change(change))

    def duplicate(self, s: int) -> None:
        """Add a copy of a sensor to its unit, and select it."""
        self._add(lambda: self._viewer.session.duplicate(s))

    def add(self, name: str) -> None:
        """Add a sensor, mounted as near as possible to the point that the browser looks at."""
        session, shift = self._viewer.session, self._viewer.scene3d.shift
        at = np.array(self.client.camera.look_at, float)[:2] + shift[:2]
        self._add(lambda: session.add(name, session.inside(at)))

    def remove(self, s: int) -> None:
        """Remove a sensor, and those that are selected together with it."""
        self._viewer.change(lambda: self._viewer.session.remove(s, *self._along(s)))

    def remove_chosen(self) -> None:
        """Remove what is selected."""
        self.remove(self.controls.chosen)

    # ── The handle ──

    def on_drag(self, drag: HandleDrag) -> None:
        """Do what an event of the handle asks for; on the event loop."""
        if drag.phase == "start":
            self._viewer.settle()
        key = ("drag", id(self)) if drag.phase == "update" else None
        self._viewer.queue.submit(lambda: self.drag(drag), key=key)

    def drag(self, drag: HandleDrag) -> None:
        """Let the sensors follow that were selected when the handle was gripped.

        During the drag their new place is drawn and scored; at the end the layout changes.
        """
        viewer = self._viewer
        if drag.phase == "start":
            self.dragging = Gripped(self.chosen, viewer.layout)
        if self.dragging is None or viewer.searching:
            return
        (*along, s), of, moved = self.dragging
        if of is not viewer.layout:  # another browser has changed it
            self.dragging = None
            viewer.show()
            return
        pose = drag.on(np.array(of.poses[s], float), viewer.scene3d.shift)
        if drag.phase == "update":
            self.dragging = self.dragging._replace(moved=True)
            where, _ = viewer.session.moved(s, pose, along)
            viewer.show_held(where)
            if s == self.selected:
                self._show_numbers(where)
        elif drag.phase == "end":
            self.dragging = None
            if moved:  # and not only clicked
                viewer.session.move(s, pose, along)
                viewer.after_change()

    # ── What is shown; on the thread of the queue ──

    def follow(self) -> None:
        """Have the same sensors selected in the layout as it is now."""
        before, self._layout = self._layout, self._viewer.layout
        names = [sensor.name for sensor in self._layout.sensors]
        if len(before) != len(names):
            kept = (before.sensors[k].name for k in self.chosen)
            last = (min(self.selected, len(names) - 1),)
            self.chosen = tuple(names.index(name) for name in kept if name in names) or last

    def show(self) -> None:
        """Show what is selected of the layout as it is now."""
        self.follow()
        s, layout = self.selected, self._layout
        sensor, pose = layout.sensors[s], np.asarray(layout.poses[s], float)
        searching = self._viewer.searching

        def show() -> None:
            controls = self.controls
            controls.list_sensors([sensor.name for sensor in layout.sensors], s)
            controls.offer_device(sensor.spec.name)
            controls.searching(searching)
            set_value(controls.name, sensor.name)

        self._on_loop(show)
        self._show_numbers(layout)
        self.handle.show(pose, self._viewer.scene3d.shift, visible=not searching)
        self.outline()

    def outline(self) -> None:
        """Draw the outlines of what is selected as wide as they should be."""
        scene3d = self._viewer.scene3d
        self.selection3d.outline([scene3d.outline(k) for k in self.chosen])

    def look(self, layout: Layout, frame: int, *, held: bool) -> None:
        """Look through the selected sensor of a layout, in a frame.

        While another browser drags its own sensors, this one's view waits for where they end.
        """
        others = (view for view in list(self._viewer.views.values()) if view is not self)
        if held and self.dragging is None and any(view.dragging for view in others):
            return
        s = min(self.selected, len(layout) - 1)
        self.sensor_view.look(Look(layout, s, frame, held))

    def show_table(self, layout: Layout, scored: ScoredLayout | None) -> None:
        """Show a row for each sensor of a layout, with what it adds to scores, if it has any."""
        self.controls.show_table(layout, scored, self.chosen)

    def _choose(self, found: Callable[[], tuple[int, ...]]) -> None:
        """Select the sensors at the places that ``found`` gives, as far as they are there."""
        self.settle()

        def job() -> None:
            last = len(self._viewer.layout) - 1
            self.follow()
            self.chosen = tuple(dict.fromkeys(min(s, last) for s in found()))
            self.show()
            self._viewer.display.show_selection(self)

        self._viewer.queue.submit(job)

    def _add(self, add: Callable[[], int]) -> None:
        """Do what adds a sensor and returns its place, and select it."""

        def job() -> None:
            s = add()
            self.follow()
            self.chosen = (s,)

        self._viewer.change(job)

    def _along(self, s: int) -> tuple[int, ...]:
        """The sensors that are selected together with one."""
        return tuple(k for k in self.chosen if k != s) if s == self.selected else ()

    def _show_numbers(self, layout: Layout) -> None:
        """Show the numbers of the selected sensor's pose."""
        numbers = self._viewer.session.numbers(layout, self.selected)

        def show() -> None:
            for key, value in numbers.items():
                set_value(self.controls.pose[key], round(value, DIGITS[key]))

        self._on_loop(show)

    def _on_loop(self, show: Callable[[], None]) -> None:
        """Set controls on the event loop, so that it cannot come between a typed number and its
        reader."""
        self._viewer.server.get_event_loop().call_soon_threadsafe(show)

    def _show_points(self, points: Float[np.ndarray, "N 3"] | None) -> None:
        self._viewer.queue.submit(
            lambda: self.selection3d.draw_points(points), key=("points", id(self))
        )
