"""A layout in somebody's hands: moved, turned, added to, taken back, always as mounting allows.

Nothing here knows a browser: every change gives a layout, and the last ones are remembered.
"""

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

REMEMBERED = 200
"""Changes that can be taken back."""
HEIGHT = 6.0
"""At which a new sensor hangs above the ground [m]."""
BESIDE = 0.8
"""A copy is turned by this share of the field of view: the two views then overlap a little."""


Mounted = tuple[Layout, tuple[str, ...]]
"""A layout, and what mounting made of it in words."""


class Session:
    """A layout on a scene, and what was done to it.

    ``layout`` is the one in hand; ``notes`` say what mounting made of the last change.
    """

    def __init__(
        self, scene: Scene, layout: Layout, constraints: Constraints | None = None
    ) -> None:
        """The layout is taken as it is, also where it breaks a rule: see :meth:`faults`."""
        self.scene, self.layout = scene, layout
        self.constraints = constraints or Constraints()
        self.notes: tuple[str, ...] = ()
        self._past: list[Layout] = []
        self._future: list[Layout] = []
        self._space: Space | None = None
        self._own = {sensor.spec.name: sensor.spec for sensor in layout.sensors}

    def faults(self) -> list[Fault]:
        """What keeps the layout from being mounted; empty where nothing does."""
        try:
            return self._space_for(self.layout).faults(self.layout)
        except InspeError as wrong:
            return [Fault(tuple(range(len(self.layout))), str(wrong))]

    # ── Changes ──

    def moved(self, s: int, pose: Float[np.ndarray, "6"]) -> Mounted:
        """Where sensor ``s`` would be if it were let go at a world pose; nothing changes.

        Its unit goes with it in plan, as it stands on one foot, and its sensors keep their heights
        above the ground there; what the pose adds to its own height, and its direction, are its
        own. Mounting gives the nearest that it allows.
        """
        old = self.layout
        unit = old.sensors[s].unit
        members, poses = list(old.members()[unit]), np.array(old.poses, float)
        stood, shift = np.array(old.units[unit].base[:2]), pose[:2] - poses[s, :2]
        foot = stood + shift
        ground = self._ground(foot)
        poses[s, 2:] = pose[2:]
        poses[members, :2] += shift
        poses[members, 2] += ground - self._ground(stood)
        units = list(old.units)
        units[unit] = replace(units[unit], base=(*foot.tolist(), ground))
        return self._mounted(replace(old, poses=poses, units=tuple(units)))

    def move(self, s: int, pose: Float[np.ndarray, "6"]) -> None:
        """Let sensor ``s`` go at a world pose: see :meth:`moved`."""
        self.take(*self.moved(s, pose))

    def height(self, s: int) -> float:
        """Of sensor ``s`` above the ground at its unit's foot [m]."""
        unit = self.layout.units[self.layout.sensors[s].unit]
        return float(self.layout.poses[s, 2]) - self._ground(np.array(unit.base[:2]))

    def add(self, name: str, at: Float[np.ndarray, "2"]) -> int:
        """A new sensor of a device on a unit of its own at ``at`` [m]; gives its place.

        It looks at the scene's centre. Raises InspeError where the catalogue has no such device.
        """
        spec, old, foot = device(name).spec, self.layout, np.asarray(at, float)
        ground = self._ground(foot)
        to = self.scene.voxels.center[:2] - foot
        pitch = -np.arctan2(HEIGHT, max(np.hypot(*to), 1.0)) if spec.aimed else 0.0
        pose = [*foot, ground + HEIGHT, 0.0, pitch, np.arctan2(to[1], to[0])]
        unit = Unit(_free("unit", [u.name for u in old.units]), (*foot.tolist(), ground))
        sensor = Sensor(_free(spec.name, [s.name for s in old.sensors]), spec, len(old.units))
        wanted = replace(
            old,
            poses=np.vstack([np.asarray(old.poses, float), pose]),
            sensors=(*old.sensors, sensor),
            units=(*old.units, unit),
        )
        self.take(*self._mounted(wanted))
        return len(self.layout) - 1

    def duplicate(self, s: int) -> int:
        """A sensor like ``s`` on its unit, turned to the left of it; gives its place."""
        old = self.layout
        sensor, poses = old.sensors[s], np.asarray(old.poses, float)
        wide = sensor.spec.field_of_view[0] % (2 * np.pi)  # 0 for one that looks all round
        pose = poses[s] + [0, 0, 0, 0, 0, BESIDE * wide]
        copy = replace(sensor, name=_free(sensor.name, [x.name for x in old.sensors]))
        after = s + 1  # beside its model, so that sensors stay in the order of their units
        wanted = replace(
            old,
            poses=np.insert(poses, after, pose, axis=0),
            sensors=(*old.sensors[:after], copy, *old.sensors[after:]),
        )
        self.take(*self._mounted(wanted))
        return after

    def remove(self, s: int) -> None:
        """Take a sensor away, and its unit if that carries no other.

        Raises InspeError where it is the last.
        """
        old = self.layout
        if len(old) == 1:
            raise InspeError("the last sensor stays: a layout has at least one")
        keep = [k for k in range(len(old)) if k != s]
        used = sorted({old.sensors[k].unit for k in keep})
        sensors = tuple(replace(old.sensors[k], unit=used.index(old.sensors[k].unit)) for k in keep)
        poses = np.asarray(old.poses, float)[keep]
        units = tuple(old.units[u] for u in used)
        self.take(replace(old, poses=poses, sensors=sensors, units=units))

    def swap(self, s: int, name: str) -> None:
        """Another device in place of sensor ``s``: of the opened layout, or of the catalogue.

        Raises InspeError where there is no such device.
        """
        sensors = list(self.layout.sensors)
        spec = self._own[name] if name in self._own else device(name).spec
        sensors[s] = replace(sensors[s], spec=spec)
        self.take(*self._mounted(replace(self.layout, sensors=tuple(sensors))))

    def take(self, layout: Layout, notes: tuple[str, ...] = ()) -> None:
        """Go on with another layout; the one before can be had again by :meth:`undo`."""
        self._past = [*self._past[1 - REMEMBERED :], self.layout]
        self._future = []
        self.layout, self.notes = layout, notes

    # ── Back and forth ──

    def undo(self) -> bool:
        """Take the last change back; whether there is one."""
        return self._go(self._past, self._future)

    def redo(self) -> bool:
        """Do again what was taken back last; whether anything was."""
        return self._go(self._future, self._past)

    def _go(self, there: list[Layout], here: list[Layout]) -> bool:
        if not there:
            return False
        here.append(self.layout)
        self.layout, self.notes = there.pop(), ()
        return True

    # ── Mounting ──

    def _mounted(self, wanted: Layout) -> Mounted:
        """The nearest layout that mounting allows; the wanted one where there is none."""
        try:
            space = self._space_for(wanted)
            x, notes = space.start(wanted)
            found = space.layout(x)
        except InspeError as wrong:
            return wanted, (str(wrong),)
        return found, notes

    def _space_for(self, wanted: Layout) -> Space:
        """Where these sensors may be.

        Kept from one change to the next where only poses differ, unless a unit comes to hang over
        the middle of the junction or leaves it: there it is mounted otherwise.
        """
        kept = self._space
        if (
            kept is None
            or _names(kept.given) != _names(wanted)
            or (on_span(kept.given, kept.site) != on_span(wanted, kept.site)).any()
        ):
            self._space = kept = Space(self.scene, wanted, self.constraints)
        return kept

    def _ground(self, foot: Float[np.ndarray, "2"]) -> float:
        return float(self.scene.intersection.ground(foot[None])[0])


def _names(layout: Layout) -> tuple[object, ...]:
    """All of a layout but where things are."""
    return layout.name, layout.sensors, tuple(unit.name for unit in layout.units)


def _free(name: str, taken: Sequence[str]) -> str:
    """The name with the first number after it that nobody has."""
    return next(f"{name} {k}" for k in range(1, len(taken) + 2) if f"{name} {k}" not in taken)
