"""What one browser has of its own: the sensors that it has selected, the handle on them, their
numbers, and what they see. The layout is everybody's."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from inspe_jax.core.errors import InspeError
from inspe_jax.sensing.layout import Layout
from inspe_jax.viewer.job_queue import DelayedAction
from inspe_jax.viewer.panel import POSE, SensorControls
from inspe_jax.viewer.scene3d import HandleDrag, Selection3D
from inspe_jax.viewer.score_panel import sensor_table
from inspe_jax.viewer.sensor_view import SensorShot, SensorView
from inspe_jax.viewer.session import LayoutSession
from inspe_jax.viewer.workers import ScoredLayout

TYPED = 0.7
"""A typed number is applied after this time without another key [s], or before another action."""
NAMED = 2.0  # the same for a name [s]: one pauses between words


class Gripped(NamedTuple):
    """While the handle is dragged: sensors, the layout at the start, whether they were moved."""

    selection: tuple[int, ...]
    layout: Layout
    moved: bool = False


class BrowserView:
    """What one browser has of its own: a selection, a handle, controls, and a recording.

    ``selection`` are the places of the selected sensors in the layout. The last of them is
    ``in_hand``: it has the handle, and the others move along with it. None is selected once another
    change than :meth:`remove` has removed them.
    """

    def __init__(self, client: Any, viewer: Any) -> None:
        """``client`` has a panel and a scene of its own, ``viewer`` what all browsers share."""
        self.client, self._viewer = client, viewer
        self.selection: tuple[int, ...] = (0,)
        self.dragging: Gripped | None = None
        self._layout: Layout = viewer.layout  # that the places are of
        self._typing = {key: DelayedAction() for key in (*POSE, "name")}
        self.controls = SensorControls(client.gui, viewer, self)
        self.selection3d = Selection3D(client.scene, viewer.scene3d.shift, self.on_drag)
        folder, failed = self.controls.sensor_view, viewer.queue.failed
        self.sensor_view = SensorView(client.gui, folder, viewer.case, failed, self._show_points)

    @property
    def in_hand(self) -> int | None:
        """The place of the sensor that has the handle, if one has."""
        return self.selection[-1] if self.selection else None

    # ── What the browser asks for. Places are those in the layout when it is done ──

    def settle(self) -> None:
        """Apply the numbers that are typed, before another action."""
        for waiting in self._typing.values():
            waiting.run_now()

    def select(self, s: int, toggle: bool = False) -> None:
        """Select another sensor, and no other; with ``toggle`` together with those that are, or no
        longer. The last one stays selected."""
        self.settle()

        def job() -> None:
            self.follow()
            if self.dragging is None and s < len(self._viewer.layout):
                others = tuple(k for k in self.selection if k != s and toggle)
                more = () if toggle and s in self.selection else (s,)
                self.selection = others + more or self.selection
            self._viewer.queue.submit(show, key=("selection", id(self)))

        def show() -> None:
            self.show()
            self._viewer.display.show_selection(self)

        self._viewer.queue.submit(job)

    def swap(self, name: str) -> None:
        """Exchange the device of the sensor in hand."""
        self._change(lambda session, s: session.swap(s, name))

    def type_number(self, key: str, value: float) -> None:
        """Set a number of the pose of the sensor in hand, once nothing more is typed; that of the
        others changes by as much."""

        def change(session: LayoutSession, s: int) -> None:
            session.set_number(s, key, value, self.selection[:-1])

        self._typing[key].start(TYPED, partial(self._change, change))

    def rename(self, name: str) -> None:
        """Give the sensor in hand another name, once nothing more is typed."""
        rename = partial(self._change, lambda session, s: session.rename(s, name))
        self._typing["name"].start(NAMED, rename)

    def duplicate(self) -> None:
        """Add a copy of the sensor in hand to its unit, and select it."""
        self._change(lambda session, s: self._hold(session.duplicate(s)))

    def add(self, name: str) -> None:
        """Add a sensor, mounted as near as possible to the point that the browser looks at."""
        viewer = self._viewer
        at = np.array(self.client.camera.look_at, float)[:2] + viewer.scene3d.shift[:2]
        viewer.change(lambda: self._hold(viewer.session.add(name, at)))

    def remove(self) -> None:
        """Remove what is selected, and select the sensor after it."""

        def change(session: LayoutSession, s: int) -> None:
            session.remove(*self.selection)
            self._hold(min(s, len(session.layout) - 1))

        self._change(change)

    # ── The handle ──

    def on_drag(self, drag: HandleDrag) -> None:
        """Do what an event of the handle asks for; on the event loop."""
        if drag.phase == "start":
            self._viewer.settle()
        key = ("drag", id(self)) if drag.phase == "update" else None
        self._viewer.queue.submit(lambda: self.drag(drag), key=key)

    def drag(self, drag: HandleDrag) -> None:
        """Let the sensors follow that were selected when the handle was gripped. During the drag
        their new place is drawn and scored; at the end the layout changes."""
        viewer = self._viewer
        if drag.phase == "start":
            if not viewer.searching and self.selection:
                self.dragging = Gripped(self.selection, viewer.layout)
            return
        self.drop_outdated()
        gripped = self.dragging
        if drag.phase == "end":
            self.dragging = None
        if gripped is None:
            if drag.phase == "end":
                self.show()  # the handle back on its sensor
            return
        (*along, s), of, moved = gripped
        pose = drag.on(np.array(of.poses[s], float))
        if drag.phase == "update":
            self.dragging = gripped._replace(moved=True)
            where, _ = viewer.session.moved(s, pose, along)
            viewer.show_held(where)
            self._show_numbers(where)
        elif moved:  # and not only clicked
            viewer.session.move(s, pose, along)
            viewer.changed()

    # ── What is shown; on the thread of the queue ──

    def follow(self) -> None:
        """Have the same sensors selected in the layout as it is now, as far as they are there."""
        before, self._layout = self._layout, self._viewer.layout
        old, new = ([sensor.name for sensor in of.sensors] for of in (before, self._layout))
        if old == new:
            return
        # Of as many sensors, one whose name is gone has another name.
        places = {s: new.index(name) for s, name in enumerate(old) if name in new}
        if len(old) == len(new):
            places = {s: places.get(s, s) for s in range(len(old))}
        kept = tuple(places[s] for s in self.selection if s in places)
        self.selection = tuple(dict.fromkeys(kept))

    def drop_outdated(self) -> bool:
        """End a drag of a layout that another browser has changed, or that is searched from;
        returns whether there was one."""
        viewer, gripped = self._viewer, self.dragging
        if gripped is None or (gripped.layout is viewer.layout and not viewer.searching):
            return False
        self.dragging = None
        if not viewer.searching:
            viewer.show()
        return True

    def show(self) -> None:
        """Show what is selected of the layout as it is now, except for what is being dragged."""
        self.follow()
        s, layout, searching = self.in_hand, self._layout, self._viewer.searching
        self._on_loop(lambda: self.controls.show(layout.sensors, s, change=not searching))
        if s is None:
            self.selection3d.gizmo.visible = False
        elif self.dragging is None:
            self._show_numbers(layout)
            self.selection3d.put_handle(np.asarray(layout.poses[s], float), visible=not searching)

    def show_outlines(self) -> None:
        """Draw the outlines of what is selected as wide as they should be."""
        scene3d = self._viewer.scene3d
        self.selection3d.draw_outlines([scene3d.outline(k) for k in self.selection])

    def look(self, layout: Layout, frame: int) -> None:
        """Look through the sensor in hand of a layout, in a frame. While another browser drags its
        own sensors, this one looks at the layout as it was before."""
        held = self.dragging is not None
        others = (view for view in list(self._viewer.views.values()) if view is not self)
        if not held and any(view.dragging for view in others):
            layout = self._viewer.layout
        s = None if self.in_hand is None else min(self.in_hand, len(layout) - 1)
        self.sensor_view.look(SensorShot(layout, s, frame, held))

    def show_table(self, layout: Layout, scored: ScoredLayout | None) -> None:
        """Show a row for each sensor of a layout, with what it adds to scores, if it has any."""
        self.controls.table.content = sensor_table(layout, scored, self.selection)

    def _change(self, change: Callable[[LayoutSession, int], None]) -> None:
        """Have the layout changed, of which a sensor is in hand."""
        self._viewer.change(lambda: change(self._viewer.session, self._held()))

    def _hold(self, s: int) -> None:
        """Select a sensor alone, of the layout as it has just become."""
        self.follow()
        self.selection = (s,)

    def _show_numbers(self, layout: Layout) -> None:
        numbers = self._viewer.session.numbers(layout, self._held())
        self._on_loop(lambda: self.controls.show_pose(numbers))

    def _held(self) -> int:
        if self.in_hand is None:
            raise InspeError("no sensor is selected: select one first")
        return self.in_hand

    def _on_loop(self, show: Callable[[], None]) -> None:
        """Set controls on the event loop, so that it cannot come between a typed number and its
        reader."""
        self._viewer.server.get_event_loop().call_soon_threadsafe(show)

    def _show_points(self, points: Float[np.ndarray, "N 3"] | None) -> None:
        draw = partial(self.selection3d.draw_points, points)
        self._viewer.queue.submit(draw, key=("points", id(self)))
