"""Changes to a layout: sensors moved, turned, added, exchanged, and all of it undone. Every change
gives the nearest layout that can be mounted. Nothing here knows of browsers."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from inspe_jax.core.errors import InspeError
from inspe_jax.placement.constraints import Constraints
from inspe_jax.placement.feasibility import Fault, on_span
from inspe_jax.placement.space import Space
from inspe_jax.scene.scene import Scene
from inspe_jax.sensing.catalogue import device
from inspe_jax.sensing.layout import Layout, Sensor, Unit

HEIGHT = 6.0  # height of a new sensor above the ground [m]
TOLD = 0.01  # a number that comes out farther from what was typed is said [m, degrees]
BESIDE = 0.8
"""A copy is turned by this fraction of the field of view, so that both views overlap a little."""

LARGEST = 1e9  # a number that is typed is not larger [m, degrees]: poses are in single precision

MountedLayout = tuple[Layout, tuple[str, ...]]
"""A layout, and in words how it differs from the one that was asked for."""


class LayoutSession:
    """A layout on a scene, with its history. ``layout`` is the layout as it is now; ``notes`` say
    how mounting has altered the last change."""

    def __init__(self, scene: Scene, layout: Layout) -> None:
        """The layout is taken as it is, even if it breaks a rule of mounting: :meth:`faults`."""
        self.scene, self.layout = scene, layout
        self.constraints = Constraints()
        self.notes: tuple[str, ...] = ()
        self._past: list[Layout] = []
        self._future: list[Layout] = []
        self._space: Space | None = None
        self._own = {sensor.spec.name: sensor.spec.with_lens(0.0) for sensor in layout.sensors}

    def faults(self) -> list[Fault]:
        """The rules of mounting that the layout breaks; empty if it can be mounted."""
        try:
            return self._space_for(self.layout).faults(self.layout)
        except InspeError as wrong:
            return [Fault(tuple(range(len(self.layout))), str(wrong))]

    # ── Changes ──

    def moved(
        self, s: int, pose: Float[np.ndarray, "6"], along: Sequence[int] = ()
    ) -> MountedLayout:
        """The nearest layout that can be mounted with sensor ``s`` let go at a world pose, or at
        the rim of the region of interest; the session does not change.

        Its unit moves with it in plan, and other sensors there keep their heights above the ground.
        The sensors ``along`` move, rise and turn by as much.
        """
        old, pose, notes = self.layout, np.array(pose, float), list[str]()
        pose[:2] = self._inside(pose[:2], old.units[old.sensors[s].unit].name, notes)
        poses, units = np.array(old.poses, float), list(old.units)
        was = poses[s].copy()
        for unit in {old.sensors[k].unit for k in (s, *along)}:
            members, foot = list(old.members()[unit]), np.array(units[unit].base[:2])
            shift = pose[:2] - was[:2]
            if unit != old.sensors[s].unit:
                shift = self._inside(foot + shift, units[unit].name, notes) - foot
            ground = self._ground(foot + shift)
            poses[members, :2] += shift
            poses[members, 2] += ground - self._ground(foot)
            units[unit] = replace(units[unit], base=(*(foot + shift).tolist(), ground))
        together = list({s, *along})
        poses[together, 2] += pose[2] - was[2]
        poses[together, 3:] += (pose[3:] - was[3:] + np.pi) % (2 * np.pi) - np.pi
        poses[s, 3:] = pose[3:]
        return self._mounted(replace(old, poses=poses, units=tuple(units)), notes)

    def move(self, s: int, pose: Float[np.ndarray, "6"], along: Sequence[int] = ()) -> None:
        """Move sensor ``s`` to a world pose, and others along: see :meth:`moved`."""
        self.take(*self.moved(s, pose, along))

    def set_number(self, s: int, key: str, value: float, along: Sequence[int] = ()) -> None:
        """Set a number of a sensor's pose: "x" or "y" in the world [m], "height" above the ground
        [m], "yaw" or "pitch" [degrees]; the sensors ``along`` change by as much. Raises InspeError
        if it is not finite, or larger than :data:`LARGEST`."""
        if not abs(value) <= LARGEST:
            raise InspeError(f"{key}: {value} is not a finite number, or too large")
        pose = np.array(self.layout.poses[s], float)
        if key == "height":
            pose[2] += value - self.numbers(self.layout, s)["height"]
        elif key in ("x", "y"):
            pose["xy".index(key)] = value
        else:
            pose[{"pitch": 4, "yaw": 5}[key]] = np.radians(value)
        self.move(s, pose, along)
        stands, turns = self.numbers(self.layout, s)[key], key in ("yaw", "pitch")
        away = (stands - value + 180) % 360 - 180 if turns else stands - value
        if abs(away) > TOLD:
            unit = "°" if turns else " m"
            asked = f"{key} is {stands:.2f}{unit}, not {value:.10g}{unit} as asked for"
            self.notes = (asked, *self.notes)

    def rename(self, s: int, name: str) -> None:
        """Give sensor ``s`` another name; an empty one changes nothing. Raises InspeError if
        another sensor has it."""
        name, sensors = name.strip(), list(self.layout.sensors)
        if name in ("", sensors[s].name):
            return
        if any(name == other.name for k, other in enumerate(sensors) if k != s):
            raise InspeError(f"another sensor is named '{name}': give each its own name")
        sensors[s] = replace(sensors[s], name=name)
        self.take(replace(self.layout, sensors=tuple(sensors)))

    def numbers(self, layout: Layout, s: int) -> dict[str, float]:
        """The numbers of a sensor's pose, as :meth:`set_number` has them; the height is above the
        ground at its unit's foot."""
        x, y, z, _, pitch, yaw = np.asarray(layout.poses[s], float).tolist()
        foot = np.array(layout.units[layout.sensors[s].unit].base[:2])
        turns = dict(yaw=math.degrees(yaw), pitch=math.degrees(pitch))
        return dict(x=x, y=y, height=z - self._ground(foot), **turns)

    def add(self, name: str, at: Float[np.ndarray, "2"]) -> int:
        """Add a sensor of a device that looks at the scene's centre, on a unit of its own at ``at``
        [m], or at the rim of the region of interest; returns its number. Raises InspeError if the
        catalogue has no such device."""
        spec, old, notes = device(name).spec, self.layout, list[str]()
        unit_name = _free("unit", [u.name for u in old.units])
        foot = self._inside(np.asarray(at, float), unit_name, notes)
        ground = self._ground(foot)
        to = self.scene.voxels.center[:2] - foot
        pitch = -np.arctan2(HEIGHT, max(np.hypot(*to), 1.0)) if spec.aimed else 0.0
        pose = [*foot, ground + HEIGHT, 0.0, pitch, np.arctan2(to[1], to[0])]
        unit = Unit(unit_name, (*foot.tolist(), ground))
        sensor = Sensor(_free(spec.name, [s.name for s in old.sensors]), spec, len(old.units))
        wanted = replace(
            old,
            poses=np.vstack([np.asarray(old.poses, float), pose]),
            sensors=(*old.sensors, sensor),
            units=(*old.units, unit),
        )
        self.take(*self._mounted(wanted, notes, added=(unit.name,)))
        return len(self.layout) - 1

    def duplicate(self, s: int) -> int:
        """Add a copy of sensor ``s`` to its unit, turned to its left; returns its number."""
        old = self.layout
        sensor, poses = old.sensors[s], np.asarray(old.poses, float)
        # A sensor that looks all round is not turned.
        wide = sensor.spec.field_of_view[0] % (2 * np.pi)
        pose = poses[s] + [0, 0, 0, 0, 0, BESIDE * wide]
        copy = replace(sensor, name=_free(sensor.name, [x.name for x in old.sensors]))
        after = s + 1  # after the original, so that sensors stay in the order of units
        wanted = replace(
            old,
            poses=np.insert(poses, after, pose, axis=0),
            sensors=(*old.sensors[:after], copy, *old.sensors[after:]),
        )
        self.take(*self._mounted(wanted))
        return after

    def remove(self, *which: int) -> None:
        """Remove sensors, and units that carry no other; notes name those units. Raises InspeError
        if no sensor would be left."""
        old = self.layout
        keep = [k for k in range(len(old)) if k not in which]
        if not keep:
            what = f"all {len(old)} sensors" if len(old) > 1 else "the last sensor"
            raise InspeError(f"{what} cannot be removed: a layout has at least one")
        used = sorted({old.sensors[k].unit for k in keep})
        sensors = tuple(replace(old.sensors[k], unit=used.index(old.sensors[k].unit)) for k in keep)
        poses = np.asarray(old.poses, float)[keep]
        units = tuple(old.units[u] for u in used)
        bare = {old.sensors[s].unit for s in which} - set(used)
        notes = (f"unit '{old.units[u].name}' removed with its last sensor" for u in sorted(bare))
        self.take(replace(old, poses=poses, sensors=sensors, units=units), tuple(notes))

    def swap(self, s: int, name: str) -> None:
        """Exchange the device of sensor ``s`` for one of the opened layout or of the catalogue.
        Raises InspeError if there is no such device."""
        sensors = list(self.layout.sensors)
        spec = self._own[name] if name in self._own else device(name).spec
        sensors[s] = replace(sensors[s], spec=spec)
        self.take(*self._mounted(replace(self.layout, sensors=tuple(sensors))))

    def take(self, layout: Layout, notes: tuple[str, ...] = ()) -> None:
        """Continue with another layout; :meth:`undo` brings back the one before."""
        self._past.append(self.layout)
        self._future.clear()
        self.layout, self.notes = layout, notes

    # ── Undo and redo ──

    def undo(self) -> bool:
        """Undo the last change; returns False if there is none."""
        return self._go(self._past, self._future)

    def redo(self) -> bool:
        """Redo the change that was undone last; returns False if there is none."""
        return self._go(self._future, self._past)

    def _go(self, there: list[Layout], here: list[Layout]) -> bool:
        if not there:
            return False
        here.append(self.layout)
        self.layout, self.notes = there.pop(), ()
        return True

    # ── Mounting ──

    def _mounted(
        self, wanted: Layout, before: Sequence[str] = (), added: Sequence[str] = ()
    ) -> MountedLayout:
        """The nearest layout that can be mounted; the wanted one if there is none. ``before`` are
        notes on what was done before, ``added`` the names of its new units."""
        wanted = replace(wanted, goal=None)  # it is not what a search has found
        try:
            space = self._space_for(wanted)
            x, notes = space.start(wanted, added)
            found = space.layout(x)
        except InspeError as wrong:
            return wanted, (*before, str(wrong))
        return found, (*before, *notes)

    def _space_for(self, wanted: Layout) -> Space:
        """Where the sensors of a layout may be: kept for the next change if only poses differ, and
        no unit has come to hang over the middle of the junction, or has left it."""
        kept = self._space
        if (
            kept is None
            or _names(kept.given) != _names(wanted)
            or (on_span(kept.given, kept.site) != on_span(wanted, kept.site)).any()
        ):
            self._space = kept = Space(self.scene, wanted, self.constraints)
        return kept

    def _inside(
        self, at: Float[np.ndarray, "2"], unit: str, notes: list[str]
    ) -> Float[np.ndarray, "2"]:
        """The nearest point [m] within the region of interest; it is noted if it is another. Raises
        InspeError if it is not finite."""
        center, radius = self.scene.voxels.center[:2], self.scene.voxels.radius
        away = float(np.hypot(*(at - center)))
        if not np.isfinite(away):  # of a camera in a window without a size
            raise InspeError("there is no such place")
        if away <= radius:
            return at
        back = f"{away - radius:.2f} m back to the rim of the region of interest"
        notes.append(f"unit '{unit}' brought {back}, whose radius is {radius:g} m")
        return center + (at - center) * radius / away

    def _ground(self, foot: Float[np.ndarray, "2"]) -> float:
        return float(self.scene.intersection.ground(foot[None])[0])


def _names(layout: Layout) -> tuple[object, ...]:
    return layout.name, layout.sensors, tuple(unit.name for unit in layout.units)


def _free(name: str, taken: Sequence[str]) -> str:
    """The name with the first free number after it."""
    return next(f"{name} {k}" for k in range(1, len(taken) + 2) if f"{name} {k}" not in taken)
