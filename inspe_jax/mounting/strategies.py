"""The paper's placements by name, generated for any intersection (InSPE, arXiv 2504.08240, section
4). A *corner* is where the left kerb of an arm (looking outward) meets the right kerb of the next;
a *roadside* pole is at an arm's right kerb, :data:`SETBACK` outside the mouth; the *centre* is a
span wire, or the island of a roundabout. A layout turns with its intersection."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from inspe_jax.core.errors import InspeError, check_known
from inspe_jax.mounting.site import (
    ASIDE,
    CENTRAL_HEIGHTS,
    MAST,
    POLE_HEIGHTS,
    SETBACK,
    WIDE,
    Site,
    View,
    spread,
)
from inspe_jax.scene.intersection import Intersection
from inspe_jax.scene.profiles import DEFAULT_PROFILE, Profile, profile_of
from inspe_jax.scene.scene import Scene, scene_of
from inspe_jax.sensing.catalogue import device
from inspe_jax.sensing.layout import UNIT_HEIGHT, UNIT_PLAN, Layout, Sensor, Unit, make_layout
from inspe_jax.sensing.named import LAYOUT_RULES
from inspe_jax.sensing.sensors import CameraSpec, LidarSpec, Spec


def central_cameras(site: Site) -> list[View]:
    """Cameras over the centre in all directions, from the widest arm's on, aimed at the edge."""
    main = max(site.arms, key=lambda arm: arm.width).bearing
    views = []
    for yaw in main + 2 * np.pi * np.arange(site.camera_count) / site.camera_count:
        edge = site.edge(float(yaw))
        views.append(site.camera("centre", site.center, edge, yaw=float(yaw), height=7.0))
    return views


def corner_cameras(site: Site) -> list[View]:
    """A camera on each arm's corner pole looks along the arm, or at it from far beside; a second
    one looks back. With two arms, cameras at their other kerbs look out as well."""
    arms, corners = site.arms, site.corners

    def out(i: int, right: bool = False) -> View:
        foot, ahead = corners[i + right * len(arms)], arms[i].kerb(0, 10.0)
        aside = abs((foot - ahead) @ arms[i].axes[1]) - arms[i].width / 2
        yaw = arms[i].bearing if aside <= ASIDE else None
        post = f"right corner {i + 1}" if right else f"corner {i + 1}"
        return site.camera(post, foot, ahead, yaw=yaw, mast=MAST)

    def back(i: int) -> View:
        yaw = arms[i].bearing + np.pi
        return site.camera(f"corner {i + 1}", corners[i], site.center, yaw=yaw, mast=MAST)

    return _fill(site, out, back, lambda i: out(i, right=True))


def roadside_cameras(site: Site) -> list[View]:
    """A camera on each arm's roadside pole looks at the crosswalk and junction, a second outward;
    with only two arms, cameras on the poles at their other kerbs look at the crosswalks as well."""
    arms, feet = site.arms, site.roadsides

    def inward(i: int, left: bool = False) -> View:
        mouth, post = np.asarray(arms[i].mouth), "left roadside" if left else "roadside"
        target = mouth + (site.center - mouth) / 3
        return site.camera(f"{post} {i + 1}", feet[i + left * len(arms)], target)

    def outward(i: int) -> View:
        return site.camera(f"roadside {i + 1}", feet[i], arms[i].kerb(0, SETBACK + 20.0))

    return _fill(site, inward, outward, lambda i: inward(i, left=True))


def _fill(site: Site, *tiers: Callable[[int], View]) -> list[View]:
    """The site's number of cameras: one for each arm in each tier, spread evenly in the last."""
    azimuths = np.array([site.azimuth(arm.mouth) for arm in site.arms])
    views: list[View] = []
    for tier in tiers:
        views += [tier(i) for i in spread(azimuths, site.camera_count - len(views))]
        if len(views) == site.camera_count:
            break
    return views


def central_lidar(site: Site) -> list[View]:
    """One LiDAR over the centre, just below the cameras."""
    return [site.lidar("centre", site.center, height=6.5)]


def corner_lidars(site: Site) -> list[View]:
    """A LiDAR at each of the four corners that lie most evenly round the junction. A wide gap has
    two corners; with fewer than four arms, the widest gaps have two."""
    left, right = np.split(site.corners, 2)
    feet = {f"corner {i + 1}": foot for i, foot in enumerate(left)}
    before = np.roll(site.gaps, 1).round(6)  # so that equal gaps stay equal in a turned world
    extra = max(4 - len(left), int((before > WIDE).sum()))
    for i in np.argsort(-before, kind="stable")[:extra]:
        feet[f"right corner {i + 1}"] = right[i]
    posts = list(feet)
    azimuths = np.array([site.azimuth(foot) for foot in feet.values()])
    return [site.lidar(posts[i], feet[posts[i]]) for i in spread(azimuths, 4)]


def roadside_lidars(site: Site) -> list[View]:
    """Two LiDARs on the roadside poles that stand most nearly opposite each other."""
    feet = site.roadsides[: len(site.arms)]
    azimuths = np.array([site.azimuth(foot) for foot in feet])
    return [site.lidar(f"roadside {i + 1}", feet[i]) for i in spread(azimuths, 2)]


Rule = Callable[[Site], list[View]]


@dataclass(frozen=True)
class Strategy:
    """A named placement: its rules, the beams of its LiDARs, and the allowed heights [m]."""

    cameras: Rule | None = None
    lidars: Rule | None = None
    beams: int = 64
    heights: tuple[float, float] = POLE_HEIGHTS


STRATEGIES: dict[str, Strategy] = {
    "Cam-c": Strategy(cameras=central_cameras, heights=CENTRAL_HEIGHTS),
    "Cam-d1": Strategy(cameras=corner_cameras),
    "Cam-d2": Strategy(cameras=roadside_cameras),
    "L-c": Strategy(lidars=central_lidar, heights=CENTRAL_HEIGHTS),
    "L-d1": Strategy(lidars=corner_lidars, beams=32),
    "L-d2": Strategy(lidars=roadside_lidars),
    "Cam-c/L-c": Strategy(central_cameras, central_lidar, heights=CENTRAL_HEIGHTS),
    "Cam-d1/L-d1": Strategy(corner_cameras, corner_lidars, 32),
    "Cam-d2/L-d2": Strategy(roadside_cameras, roadside_lidars),
}
"""The nine placements of the paper's Table 2. To add one, add a row."""


def strategy(
    scene: Scene | str,
    name: str,
    *,
    camera: str | Spec | None = None,
    lidar: str | Spec | None = None,
    camera_height: float | None = None,
    lidar_height: float | None = None,
    camera_pitch_deg: float | None = None,
) -> Layout:
    """The layout that a strategy of :data:`STRATEGIES` gives on a scene.

    Options that are None are those of the scene's profile. If the profile has None too, cameras are
    at 6 m and LiDARs at 5 m, at the centre at 7 and 6.5 m, and each camera is aimed at its target.
    The paper's discussion of L-d2 uses ``lidar="paper-lidar-32"``.

    Args:
        scene: A scene, or the name of one.
        name: Of the strategy, in lower or upper case.
        camera, lidar: Names of devices in the catalogue, or specs.
        camera_height, lidar_height: Above the ground [m].
        camera_pitch_deg: In degrees; negative is down.

    Raises:
        InspeError: A name or device is unknown, a device is of another kind, a height or pitch is
            out of range, or the intersection has fewer than two arms or no place for a pole.

    >>> inspe_jax.strategy(scene, "L-d1", lidar="hesai-xt32")
    <Layout: name L-d1, sensors 4 hesai-xt32, units 4, profile paper>
    """
    scene = scene_of(scene)
    own, place = scene.profile, scene.intersection
    chosen = choose(name, camera, lidar, camera_height, lidar_height, camera_pitch_deg, own)
    row = STRATEGIES[chosen.name]
    if len(place.arms) < 2:
        raise InspeError(
            f"{place.name}: it has {len(place.arms)} arm{'s' * (not place.arms)}; strategies need "
            "at least 2"
        )
    depth = chosen.camera.grid.reach
    site = Site(place, scene.voxels.radius, depth, *chosen.mounted, bodies=scene.statics)
    rules = (row.cameras, chosen.camera), (row.lidars, chosen.lidar)
    views = [(view, spec) for rule, spec in rules if rule for view in rule(site)]
    return replace(join(chosen.name, place, views), profile=own.name)


LAYOUT_RULES.update(dict.fromkeys(STRATEGIES, strategy))


class Chosen(NamedTuple):
    """A strategy's name, its devices, and how they are mounted: the heights of cameras and LiDARs
    [m] and the cameras' pitch [rad], each None where the rule chooses it."""

    name: str
    camera: Spec
    lidar: Spec
    mounted: tuple[float | None, float | None, float | None]


def choose(
    name: str,
    camera: str | Spec | None = None,
    lidar: str | Spec | None = None,
    camera_height: float | None = None,
    lidar_height: float | None = None,
    camera_pitch_deg: float | None = None,
    profile: Profile | None = None,
) -> Chosen:
    """The strategy and devices that the options of :func:`strategy` mean under a profile."""
    own = profile or profile_of(DEFAULT_PROFILE)
    camera_height = own.camera_height if camera_height is None else camera_height
    lidar_height = own.lidar_height if lidar_height is None else lidar_height
    pitch_deg = own.camera_pitch_deg if camera_pitch_deg is None else camera_pitch_deg
    known = {key.lower(): key for key in STRATEGIES}
    key = known.get(name.strip().lower(), name)
    check_known(key, STRATEGIES, "no strategy")
    row = STRATEGIES[key]
    low, high = row.heights
    for option, height in (("camera_height", camera_height), ("lidar_height", lidar_height)):
        if height is not None and not low <= height <= high:
            raise InspeError(
                f"{option} {height:g} m is out of range for {key}: between {low:g} and {high:g} m"
            )
    if pitch_deg is not None and not -90 <= pitch_deg <= 0:
        raise InspeError(f"camera_pitch_deg {pitch_deg:g}: between -90, straight down, and 0")
    seeing = _device("camera", camera or own.camera, CameraSpec)
    usual = {32: own.lidar_32, 64: own.lidar_64}[row.beams]
    pitch = None if pitch_deg is None else float(np.radians(pitch_deg))
    mounted = camera_height, lidar_height, pitch
    return Chosen(key, seeing, _device("lidar", lidar or usual, LidarSpec), mounted)


def _device(option: str, of: str | Spec, kind: type[Spec]) -> Spec:
    spec = device(of).spec if isinstance(of, str) else of
    if not isinstance(spec, kind):
        raise InspeError(f"{option} '{spec.name}' is a {spec.kind}: name a {kind.kind} device")
    return spec


def join(name: str, place: Intersection, views: list[tuple[View, Spec]]) -> Layout:
    """One layout of all views. A view joins the first unit that is near enough."""
    units: list[Unit] = []
    sensors: list[Sensor] = []
    poses: list[np.ndarray] = []
    for view, spec in views:
        for u, unit in enumerate(units):
            near = [np.array(unit.base[:2]) - view.foot]
            pose = _pose(view, unit)
            near += [pose - p for p, own in zip(poses, sensors, strict=True) if own.unit == u]
            if all(map(_within_unit, near)):
                break
        else:
            u = len(units)
            taken = any(view.post == unit.name for unit in units)
            x, y = view.foot.tolist()
            z = float(place.ground(view.foot)[0])
            units.append(Unit(f"{view.post}, {spec.kind}" if taken else view.post, (x, y, z)))
        count = sum(own.unit == u and own.spec.kind == spec.kind for own in sensors)
        sensors.append(Sensor(f"{units[u].name} {spec.kind} {count + 1}", spec, u))
        poses.append(_pose(view, units[u]))
    order = sorted(range(len(sensors)), key=lambda s: sensors[s].unit)
    return make_layout([sensors[s] for s in order], units, np.array(poses)[order], name)


def _within_unit(apart: np.ndarray) -> bool:
    """Whether plan points or poses that are so far apart may belong to one unit."""
    return bool(np.hypot(*apart[:2]) <= UNIT_PLAN and (np.abs(apart[2:3]) <= UNIT_HEIGHT).all())


def _pose(view: View, unit: Unit) -> Float[np.ndarray, "6"]:
    """x, y, z, roll, pitch, yaw of a view from a unit's base [m, rad]."""
    position = np.array(unit.base) + [*view.offset, view.height]
    yaw = np.arctan2(np.sin(view.yaw), np.cos(view.yaw))
    return np.array([*position, 0.0, view.pitch, yaw])
