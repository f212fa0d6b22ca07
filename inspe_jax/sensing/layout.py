"""A layout: infrastructure units, their sensors and the sensors' poses, and its YAML file.

The file is in metres and degrees of the world frame; notebooks/01_score_a_layout.ipynb shows one::

    units:
      - name: north-east pole
        base: [12.0, 11.5]           # x, y; a third number is the height of the base
        sensors:
          - {device: paper-camera, height: 6.0, yaw_deg: -135.0}  # also offset, pitch_deg, roll_deg

Sensors are in the order of the file, unit by unit, unless ``order`` has their names in another.
``devices`` describes those that are not in the catalogue, with its keys, or ``like`` another. A
sensor of a camera whose ``hfov_deg`` is a range has an ``hfov_deg`` of its own, how its varifocal
lens is set; without one it is in the middle of the range, by its logarithm.
``profile`` names the profile that the layout was made under, ``searched_for`` what a search has
maximised, where that is not the usual P_sm, such as
``{weights: {detectability: 1.0}, regions: [crosswalk], road_users: [pedestrian]}``.
"""

import os
from collections import Counter
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import yaml
from jaxtyping import Array, Float
from pydantic import BaseModel, Field

from inspe_jax.core.digest import ORIGIN
from inspe_jax.core.errors import InspeError, check_known, error_at, wrong_kind
from inspe_jax.core.files import STRICT, check_model, json_value, read_yaml, write_text
from inspe_jax.core.geometry import rotation
from inspe_jax.core.pytree import pytree
from inspe_jax.core.records import ByContent, Described, check_record
from inspe_jax.scene.profiles import profile_of
from inspe_jax.scene.regions import regions_of
from inspe_jax.scene.scene import Scene
from inspe_jax.scene.traffic.frames import CLASSES
from inspe_jax.sensing.catalogue import check_spec, device, devices, spec_of, table_of
from inspe_jax.sensing.kinds import focal_of, hfov_of
from inspe_jax.sensing.ray_grid import RayGrid
from inspe_jax.sensing.sensors import CameraSpec, Pose, Spec

UNIT_PLAN = 2.0  # largest distance between sensors of one unit in plan [m]
UNIT_HEIGHT = 4.0  # largest difference in height between sensors of one unit [m]
ROUNDING = 1e-6  # rounding of decimals in a file may add this to a distance [m]


@dataclass(frozen=True)
class Unit:
    """An infrastructure unit: sensors that share a processor and stand at one base, x, y and the
    height of the ground there [m], in the world frame."""

    name: str
    base: tuple[float, float, float]


@dataclass(frozen=True)
class Sensor:
    """One sensor of a layout: its specification and the index of its unit."""

    name: str
    spec: Spec
    unit: int


@dataclass(frozen=True)
class Goal:
    """What a search has maximised: ``weights`` by metric; ``regions`` and ``road_users``, by name,
    that alone count, all if none is given; and ``failures``, whether a score is N−1."""

    weights: tuple[tuple[str, float], ...]
    regions: tuple[str, ...] = ()
    road_users: tuple[str, ...] = ()
    failures: bool = False

    @property
    def words(self) -> str:
        """Such as "detectability (crosswalk, pedestrian only)"."""
        parts = [name if w == 1 else f"{w:g} {name}" for name, w in self.weights]
        only = ", ".join((*self.regions, *self.road_users))
        words = " + ".join(parts).replace("_", " ") + (f" ({only} only)" if only else "")
        return words + ", N−1" * self.failures

    @property
    def record(self) -> dict[str, Any]:
        """The content of a layout file under ``searched_for``."""
        record = json_value(self) | {"weights": dict(self.weights)}
        return {key: value for key, value in record.items() if value}


@pytree
@dataclass(frozen=True, eq=False, repr=False)
class Layout(ByContent, Described):
    """Sensors with their poses; equal where all of them is, by value. ``poses`` are x, y, z, roll,
    pitch, yaw in world metres and radians, which alone are differentiated. ``profile`` names the
    profile that the layout was made under, None if unknown; ``goal`` is what the search that found
    it has maximised, None if that is the usual P_sm."""

    poses: Float[Array | np.ndarray, "S 6"]
    sensors: tuple[Sensor, ...] = field(metadata={"static": True})
    units: tuple[Unit, ...] = field(metadata={"static": True})
    name: str = field(metadata={"static": True}, default="layout")
    profile: str | None = field(metadata={"static": True}, default=None)
    goal: Goal | None = field(metadata={"static": True, ORIGIN: None}, default=None)

    def __len__(self) -> int:
        return len(self.sensors)

    @property
    def zooms(self) -> bool:
        """Whether some camera has a varifocal lens; then the poses of a search have a lens each."""
        limits = (sensor.spec.lens_limits for sensor in self.sensors)
        return any(low < high for low, high in limits)

    def _facts(self) -> dict[str, Any]:
        each = Counter(sensor.spec.name for sensor in self.sensors)
        devices = " + ".join(f"{count} {name}" for name, count in each.items())
        made = {"profile": self.profile} if self.profile else {}
        return {"name": self.name, "sensors": devices, "units": len(self.units)} | made

    def _check(self, prefix: str) -> None:
        if not self.sensors:
            raise InspeError(f"{prefix}the layout is empty: it needs at least one sensor")
        for sensor in self.sensors:
            if not 0 <= sensor.unit < len(self.units):
                raise InspeError(f"{prefix}sensor '{sensor.name}': there is no unit {sensor.unit}")
            check_spec(sensor.spec)

    def with_poses(self, poses: Float[Any, "S 6"]) -> "Layout":
        """The same sensors at other world poses, traced or not: an array, or rows of numbers.
        Raises InspeError on a wrong shape.

        >>> higher = layout.with_poses(layout.poses + [0, 0, 1, 0, 0, 0])
        >>> higher.pose(0).z - layout.pose(0).z
        1.0
        """
        found = poses if hasattr(poses, "shape") else _numbers(poses)
        if tuple(found.shape) != (len(self), 6):
            raise InspeError(f"poses have shape {tuple(found.shape)}, expected ({len(self)}, 6)")
        return replace(self, poses=found)

    def rays(self, s: int) -> tuple[np.ndarray, np.ndarray, float]:
        """Every ray of sensor ``s``: origin (3,) [m], unit directions (R, 3), reach [m], world.

        >>> origin, directions, reach = layout.rays(0)
        >>> origin.shape, directions.shape, reach
        ((3,), (19200, 3), 38.0)
        """
        pose = np.asarray(self.poses[s], float)
        grid = self.sensors[s].spec.grid
        turn = rotation(pose[3:], np)
        return pose[:3], grid.directions() @ turn.T, grid.reach

    def pose(self, s: int) -> Pose:
        """The pose of sensor ``s``, by name.

        >>> pose = layout.pose(0)
        >>> [round(float(number), 1) for number in pose]
        [9.3, 9.3, 6.5, 0.0, 0.0, 0.0]
        """
        return Pose(*np.asarray(self.poses[s], float).tolist())

    def groups(self) -> tuple[tuple[RayGrid, tuple[int, ...]], ...]:
        """Sensors with the same grid of rays, as (grid, indices), so that each compiles once."""
        found: dict[RayGrid, list[int]] = {}
        for s, sensor in enumerate(self.sensors):
            found.setdefault(sensor.spec.grid, []).append(s)
        return tuple((grid, tuple(index)) for grid, index in found.items())

    def members(self) -> tuple[tuple[int, ...], ...]:
        """Indices of each unit's sensors.

        >>> layout.members()
        ((0, 1), (2, 3), (4, 5), (6, 7))
        """
        return tuple(
            tuple(s for s, sensor in enumerate(self.sensors) if sensor.unit == u)
            for u in range(len(self.units))
        )

    @property
    def reliability(self) -> Float[np.ndarray, " S"]:
        """The reliability of each sensor's device; :func:`~inspe_jax.sensing.conditions.perceiving`
        gives the devices that of a scene."""
        return np.array([sensor.spec.reliability for sensor in self.sensors])


def make_layout(
    sensors: list[Sensor],
    units: list[Unit],
    poses: Float[np.ndarray, "S 6"],
    name: str = "layout",
    where: str | None = None,
    *,
    unit_rule: bool = True,
) -> Layout:
    """A checked layout, its sensors in the order given.

    Args:
        sensors, units: Those of the layout.
        poses: (S, 6) x, y, z [m], roll, pitch, yaw [rad], or rows of :class:`Pose`.
        name: Of the layout.
        where: What error messages name, the layout if None.
        unit_rule: Sensors of one unit are at most 2 m apart in plan and 4 m in height.

    Raises:
        InspeError: The layout is empty, poses are not finite or of another shape, a unit is missing
            or broken up, a device has impossible numbers, or two sensors or units have one name.

    >>> units = [inspe_jax.Unit("pole", (12.0, 12.0, 0.0))]
    >>> sensors = [inspe_jax.Sensor("north", inspe_jax.device("paper-camera").spec, 0)]
    >>> inspe_jax.make_layout(sensors, units, [inspe_jax.Pose(12, 12, 6, yaw=np.pi / 2)]).pose(0).z
    6.0
    """
    where = where or name
    poses = _numbers(poses)
    layout = Layout(poses, tuple(sensors), tuple(units), name)
    check_record(layout, where, S=len(sensors))
    for kind, names in (("sensor", [s.name for s in sensors]), ("unit", [u.name for u in units])):
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise InspeError(f"{where}: two {kind}s are named '{twice}'")
    for unit, members in zip(units, layout.members(), strict=True):
        for a, b in combinations(members if unit_rule else (), 2):
            _check_pair(where, unit, sensors[a], sensors[b], poses[b] - poses[a])
    return layout


def _numbers(poses: Any) -> Float[np.ndarray, "S 6"]:
    """Poses as an array of their own. Raises InspeError where they are no numbers."""
    try:
        return np.array(poses, float)
    except (TypeError, ValueError):
        raise InspeError(
            "poses: give rows of six numbers, x, y, z [m], roll, pitch, yaw [rad]; traced ones to "
            "Layout.with_poses"
        ) from None


def _check_pair(where: str, unit: Unit, a: Sensor, b: Sensor, apart: np.ndarray) -> None:
    plan, height = float(np.hypot(apart[0], apart[1])), float(abs(apart[2]))
    for distance, limit, how in ((plan, UNIT_PLAN, "in plan"), (height, UNIT_HEIGHT, "in height")):
        if distance > limit + ROUNDING:
            raise InspeError(
                f"{where}: unit '{unit.name}': sensors '{a.name}' and '{b.name}' are "
                f"{distance:.2f} m apart {how}; at most {limit:g} m"
            )


# ── The file ────────────────────────────────────────────────────────────────


_Metres = Annotated[float, Field(ge=-1e6, le=1e6)]
_World = Annotated[float, Field(ge=-1e8, le=1e8)]  # northings are up to 1e7, some have a prefix
_Degrees = Annotated[float, Field(ge=-360, le=360)]


class _SensorEntry(BaseModel, **STRICT):
    device: str
    hfov_deg: Annotated[float, Field(gt=0, lt=180)] | None = None
    height: _Metres
    yaw_deg: _Degrees
    pitch_deg: Annotated[float, Field(ge=-90, le=90)] = 0.0
    roll_deg: _Degrees = 0.0
    offset: Annotated[list[_Metres], Field(min_length=2, max_length=2)] = [0.0, 0.0]
    name: str | None = None


class _UnitEntry(BaseModel, **STRICT):
    name: str | None = None
    base: Annotated[list[_World], Field(min_length=2, max_length=3)]
    sensors: Annotated[list[_SensorEntry], Field(min_length=1)]


class _GoalEntry(BaseModel, **STRICT):
    weights: dict[str, float]
    regions: list[str] = []
    road_users: list[str] = []
    failures: bool = False


class _LayoutFile(BaseModel, **STRICT):
    name: str | None = None
    profile: str | None = None
    searched_for: _GoalEntry | None = None
    devices: dict[str, Any] = {}
    order: list[str] = []
    units: Annotated[list[_UnitEntry], Field(min_length=1)]


def load_layout(
    path: str | os.PathLike[str], scene: Scene | None = None, *, unit_rule: bool = True
) -> Layout:
    """Read a layout file.

    Args:
        path: The file; its form is in this module's docstring.
        scene: A base of two numbers stands on its ground, or at height 0 without one.
        unit_rule: As in :func:`make_layout`.

    Raises:
        InspeError: Names the file, the key and what is allowed.
    """
    path = Path(path)
    return parse_layout(read_yaml(path), str(path), path.stem, scene, unit_rule=unit_rule)


def parse_layout(
    content: Any, where: str, name: str, scene: Scene | None = None, *, unit_rule: bool = True
) -> Layout:
    """A layout from the content of a layout file, as :func:`load_layout`; errors name ``where``."""
    if not content:
        raise InspeError(f"{where}: the layout is empty: it needs 'units', each with 'sensors'")
    entry = check_model(_LayoutFile, content, where)
    if entry.profile is not None:
        with error_at(f"{where}: profile"):
            profile_of(entry.profile)
    own = {
        key: spec_of(table, key, f"{where}: devices.{key}") for key, table in entry.devices.items()
    }
    sensors: list[Sensor] = []
    units: list[Unit] = []
    poses: list[Pose] = []
    for u, unit in enumerate(entry.units):
        x, y = unit.base[:2]
        on_ground = scene.intersection.ground(np.array([[x, y]]))[0] if scene else 0.0
        z = unit.base[2] if len(unit.base) == 3 else float(on_ground)
        units.append(Unit(unit.name or f"unit {u + 1}", (x, y, z)))
        for k, item in enumerate(unit.sensors):
            with error_at(f"{where}: units[{u}].sensors[{k}].device"):
                spec = own.get(item.device) or device(item.device).spec
            if item.hfov_deg is not None:
                with error_at(f"{where}: units[{u}].sensors[{k}].hfov_deg"):
                    spec = with_hfov(spec, item.hfov_deg)
            sensors.append(Sensor(item.name or f"{units[u].name} {k + 1}", spec, u))
            (dx, dy), height = item.offset, item.height
            angles = np.radians([item.roll_deg, item.pitch_deg, item.yaw_deg])
            poses.append(Pose(x + dx, y + dy, z + height, *angles.tolist()))
    names = [sensor.name for sensor in sensors]
    if entry.order and sorted(entry.order) != sorted(names):
        raise InspeError(f"{where}: order: must name each sensor once: {', '.join(names)}")
    rows = [names.index(one) for one in entry.order or names]
    ordered, at = [sensors[s] for s in rows], np.array(poses)[rows]
    layout = make_layout(ordered, units, at, entry.name or name, where, unit_rule=unit_rule)
    return replace(layout, profile=entry.profile, goal=_goal(entry.searched_for, where))


def lens_keys(spec: Spec) -> dict[str, float]:
    """How a varifocal lens is set, as a layout file has it; nothing for others."""
    if not isinstance(spec, CameraSpec) or spec.focal_range is None:
        return {}
    return {"hfov_deg": round(hfov_of(spec.width, spec.focal), 9)}


def device_words(spec: Spec) -> str:
    """The name of a device, and how its varifocal lens is set."""
    return ", ".join([spec.name, *(f"{view:.1f}°" for view in lens_keys(spec).values())])


def with_hfov(spec: Spec, hfov_deg: float) -> Spec:
    """A camera with its varifocal lens set to a horizontal field of view. Raises InspeError if its
    lens cannot be set so."""
    if not isinstance(spec, CameraSpec) or spec.focal_range is None:
        raise InspeError(f"'{spec.name}' has no varifocal lens (hfov_deg: [40, 100] of a device)")
    wide, narrow = (hfov_of(spec.width, focal) for focal in spec.focal_range)
    if not narrow - 1e-6 <= hfov_deg <= wide + 1e-6:
        raise InspeError(f"{hfov_deg:g} is not between {narrow:g} and {wide:g} of '{spec.name}'")
    focal = np.clip(focal_of(spec.width, hfov_deg), *spec.focal_range)
    return replace(spec, focal=float(focal))


def _goal(entry: _GoalEntry | None, where: str) -> Goal | None:
    if entry is None:
        return None
    with error_at(f"{where}: searched_for"):
        regions_of(entry.regions)
        for name in entry.road_users:
            check_known(name, CLASSES, "road user")
    named = tuple(entry.regions), tuple(entry.road_users)
    return Goal(tuple(entry.weights.items()), *named, entry.failures)


def save_layout(layout: Layout, path: str | os.PathLike[str]) -> None:
    """Write a layout file that :func:`load_layout` reads back to the same poses, to 1e-9. Raises
    InspeError as :func:`layout_text` does.

    >>> inspe_jax.save_layout(layout, "layout.yaml")
    >>> inspe_jax.load_layout("layout.yaml").sensors == layout.sensors
    True
    """
    write_text(path, layout_text(layout))


def layout_text(layout: Layout) -> str:
    """The text that :func:`save_layout` writes. Raises InspeError if it could not be read back, as
    with two devices of one name or a pitch beyond the vertical."""
    if not isinstance(layout, Layout):
        raise wrong_kind("layout", layout, "a Layout to save")
    poses = np.asarray(layout.poses, float)
    units: list[dict[str, Any]] = []
    for unit, members in zip(layout.units, layout.members(), strict=True):
        entries = []
        for s in members:
            sensor = layout.sensors[s]
            *offset, height = (poses[s, :3] - np.array(unit.base)).round(9).tolist()
            roll, pitch, yaw = np.degrees(poses[s, 3:]).round(9).tolist()
            at = dict(height=height, offset=offset, yaw_deg=yaw, pitch_deg=pitch, roll_deg=roll)
            named = dict(name=sensor.name, device=sensor.spec.name)
            entries.append(named | lens_keys(sensor.spec) | at)
        units.append(dict(name=unit.name, base=list(unit.base), sensors=entries))
    content = {"name": layout.name, **made_with(layout), "units": units}
    check_model(_LayoutFile, content, f"{layout.name}, to be saved")
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None)
    return "# Metres and degrees, world frame; see inspe_jax.sensing.layout.\n" + text


def made_with(layout: Layout) -> dict[str, Any]:
    """A layout's profile, its goal, the devices that its file must describe, and the order of its
    sensors; without those it lacks, or that are the file's own. Raises InspeError where two devices
    have one name."""
    in_file = [s for members in layout.members() for s in members]
    made = {
        "profile": layout.profile,
        "searched_for": layout.goal and layout.goal.record,
        "devices": _own_devices(layout),
        "order": [] if in_file == sorted(in_file) else [x.name for x in layout.sensors],
    }
    return {key: value for key, value in made.items() if value}


def _own_devices(layout: Layout) -> dict[str, dict[str, Any]]:
    """The devices that are not in the catalogue, or differ from it, by name."""
    known, found = devices(), {}
    for spec in dict.fromkeys(sensor.spec.with_lens(0.0) for sensor in layout.sensors):
        if spec.name in found:
            raise InspeError(f"{layout.name}, to be saved: two devices are named '{spec.name}'")
        if spec.name not in known or known[spec.name].spec != spec:
            found[spec.name] = table_of(spec)
    return found
