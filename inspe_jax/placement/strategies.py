"""The paper's placements by name, generated for any intersection.

A strategy is a row of :data:`STRATEGIES`: a rule that aims cameras, a rule that
places LiDARs, or both. A rule reads a :class:`Site` and returns :class:`View`\\ s;
what stands together is then joined into units. After InSPE (arXiv 2504.08240),
section 4, which names the placements and counts their devices; where exactly they
stand is this module's reading of it, written for the engineer who has to mount it:

- *corner*: a signal pole that stands near, else the nearest mounting area, where
  the left kerb of an arm (looking outward) meets the right kerb of the next.
  Where the gap between two arms is wide, as on the far side of a T, each kerb has
  a corner of its own.
- *roadside*: a pole at the right kerb of an arm, :data:`SETBACK` outside the mouth.
- *centre*: on a span wire over the middle of the junction: the one unit whose
  ``base`` may lie in a driving lane, since it hangs above the traffic. At a
  roundabout that base is on the central island.

Everything is laid out relative to the intersection's first arm, so a layout turns
with its intersection.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np
from jaxtyping import Float
from shapely.geometry import LineString, MultiPoint, Point, Polygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import nearest_points, unary_union

from inspe_jax.errors import InspeError, nearest
from inspe_jax.scene.intersection import Arm, Intersection
from inspe_jax.scene.regions import Region
from inspe_jax.scene.scene import Scene
from inspe_jax.sensing.devices import device
from inspe_jax.sensing.layout import UNIT_HEIGHT, UNIT_PLAN, Layout, Sensor, Unit, make_layout
from inspe_jax.sensing.sensors import CameraSpec, LidarSpec, Spec

POLE_HEIGHTS = (3.0, 12.0)
"""Allowed height of a sensor on a pole [m above the ground]."""
CENTRAL_HEIGHTS = (5.0, 12.0)
"""… and of one over the middle of the junction, where lorries pass beneath."""
SMALL = 11.0
"""A junction whose mouths lie nearer to its centre than this on average is small [m]."""
SETBACK = 8.0
"""A roadside pole stands this far outside the mouth of its arm [m]."""
CORE = 25.0
"""Mouths are taken to lie no further than this from the centre [m]."""
MAST = 1.5
"""Length of a mast arm, from the pole towards the junction [m]."""

_CLEARANCE = CENTRAL_HEIGHTS[0]  # a mast arm may reach over a lane only above this [m]
_WIDE = np.radians(135.0)  # between two arms further apart, each kerb has its own corner
_ASIDE = 7.0  # a pole further than this from an arm's kerb line is far beside it [m]
_POLE_REACH = {"corner": 8.0, "roadside": 3.0}  # a standing pole this near is used [m]
_INSET = 0.3  # from a mounting area's edge to a new pole [m]
_APART = 2.5  # between the poles of two units: more than one unit spans [m]
_DEPTH_SHARE = 0.6  # aim no further than this share of a camera's depth [–]
_NEAREST_AIM = 5.0  # aim no nearer, measured in plan [m]
_AIM_HEIGHT = 1.0  # aim at people and bodywork, not at the asphalt [m]


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class View:
    """One sensor of a strategy.

    ``post`` names where it stands and ``foot`` is that place (x, y) [m];
    ``offset`` (x, y) from there to the sensor [m]; ``height`` above the ground at
    the foot [m]; ``yaw`` and ``pitch`` [rad].
    """

    post: str
    foot: Float[np.ndarray, "2"]
    offset: Float[np.ndarray, "2"]
    height: float
    yaw: float
    pitch: float


@dataclass(frozen=True, eq=False)
class Site:
    """What a rule may ask of an intersection: its arms in order, and where poles stand.

    ``radius`` bounds the region of interest [m]; ``depth`` is how far the cameras
    see [m]; ``camera_height`` and ``lidar_height`` [m] are None where the rule
    chooses.
    """

    place: Intersection
    radius: float
    depth: float
    camera_height: float | None = None
    lidar_height: float | None = None

    @property
    def center(self) -> Float[np.ndarray, "2"]:
        """Middle of the junction in plan [m]."""
        return np.asarray(self.place.center, float)[:2]

    @cached_property
    def arms(self) -> tuple[Arm, ...]:
        """The arms, counter-clockwise by the place of their mouths, from the record's first.

        A mouth further than :data:`CORE` from the centre, as on a motorway, is
        drawn in along its arm: from further out cameras would watch the road and
        not the junction.
        """
        # By place, not bearing: a ramp and its motorway have nearly the same bearing.
        first, *others = self.place.arms
        start = self.azimuth(first.mouth)
        others.sort(key=lambda arm: (self.azimuth(arm.mouth) - start) % (2 * np.pi))
        return tuple(self._drawn_in(arm) for arm in (first, *others))

    def _drawn_in(self, arm: Arm) -> Arm:
        along = np.array([np.cos(arm.bearing), np.sin(arm.bearing)])
        way = np.asarray(arm.mouth) - self.center
        aside = way - (way @ along) * along
        furthest = np.sqrt(max(CORE**2 - aside @ aside, 0.0))
        x, y = np.asarray(arm.mouth) - max(way @ along - furthest, 0.0) * along
        return replace(arm, mouth=(float(x), float(y)))

    def azimuth(self, point: tuple[float, float] | Float[np.ndarray, "2"]) -> float:
        """Direction of a point from the centre [rad]."""
        x, y = np.asarray(point) - self.center
        return float(np.arctan2(y, x))

    @cached_property
    def gaps(self) -> Float[np.ndarray, " N"]:
        """Angle from each arm to the next, about the centre [rad]."""
        azimuth = np.array([self.azimuth(arm.mouth) for arm in self.arms])
        return (np.roll(azimuth, -1) - azimuth) % (2 * np.pi)

    @property
    def camera_count(self) -> int:
        """Eight at junctions of four arms or more; six at three-armed and small ones."""
        away = [np.hypot(*(np.asarray(arm.mouth) - self.center)) for arm in self.arms]
        return 8 if len(self.arms) >= 4 and np.mean(away) >= SMALL else 6

    @cached_property
    def lanes(self) -> BaseGeometry:
        """Ground that vehicles' lanes sweep."""
        return unary_union(
            [
                # Mitred: round joins would turn a layout slightly when the world turns.
                LineString(route.waypoints[:, :2]).buffer(
                    route.width / 2, cap_style="flat", join_style="mitre"
                )
                for route in self.place.routes
                if route.user == "vehicle" and len(route.waypoints) > 1
            ]
        )

    @cached_property
    def ground(self) -> BaseGeometry:
        """Where a new pole may be put: mounting area near enough, off lanes and crosswalks."""
        crosswalks = self.place.regions.get(Region.CROSSWALK, Polygon())
        near = Point(self.center).buffer(self.radius, quad_segs=64)
        free = self.place.mounting.intersection(near).difference(self.lanes).difference(crosswalks)
        return unary_union([_inset(part) for part in getattr(free, "geoms", [free])])

    @cached_property
    def poles(self) -> Float[np.ndarray, "P 2"]:
        """Feet of the poles that stand already, within the radius and off the lanes [m]."""
        feet = np.asarray(self.place.poles, float).reshape(-1, 3)[:, :2]
        keep = [
            np.hypot(*(foot - self.center)) <= self.radius
            and not self.lanes.intersects(Point(foot))
            for foot in feet
        ]
        return feet[np.array(keep, bool)]

    @cached_property
    def corners(self) -> Float[np.ndarray, "2N 2"]:
        """Feet of the corner poles [m]: one at the left kerb of each arm, then at the right kerbs.

        The left ones suffice where gaps are narrow: each is the right one of the
        next arm too. So there the right ones stand back by :data:`SETBACK`.
        """
        after = self.arms[1:] + self.arms[:1]
        left = [
            kerb(arm, +1) if gap > _WIDE else (kerb(arm, +1) + kerb(following, -1)) / 2
            for arm, following, gap in zip(self.arms, after, self.gaps, strict=True)
        ]
        before = np.roll(self.gaps, 1)
        right = [
            kerb(arm, -1, 0.0 if gap > _WIDE else SETBACK)
            for arm, gap in zip(self.arms, before, strict=True)
        ]
        return self._stand([*left, *right], "corner")

    @cached_property
    def roadsides(self) -> Float[np.ndarray, "2N 2"]:
        """Feet of the roadside poles: one at the right kerb of each arm, then at the left ones."""
        wanted = [kerb(arm, side, SETBACK) for side in (-1, +1) for arm in self.arms]
        return self._stand(wanted, "roadside")

    def _stand(self, wanted: list[np.ndarray], post: str) -> Float[np.ndarray, "N 2"]:
        """The nearest place to each wanted one that can carry a pole; no two on one spot."""
        feet: list[np.ndarray] = []
        for spot in wanted:
            poles = [p for p in self.poles if all(np.hypot(*(p - f)) > _APART for f in feet)]
            distance = [np.hypot(*(p - spot)) for p in poles]
            if poles and min(distance) <= _POLE_REACH[post]:
                feet.append(poles[int(np.argmin(distance))])
                continue
            free = self.ground.difference(MultiPoint(feet).buffer(_APART, quad_segs=64))
            free = self.ground if free.is_empty else free
            if free.is_empty:
                raise InspeError(
                    f"{self.place.name}: no mounting area and no pole off the driving lanes within "
                    f"{self.radius:g} m of the centre: a {post} pole has nowhere to stand"
                )
            feet.append(np.array(nearest_points(free, Point(spot))[0].coords[0]))
        return np.array(feet)

    def camera(
        self,
        post: str,
        foot: Float[np.ndarray, "2"],
        target: Float[np.ndarray, "2"],
        *,
        yaw: float | None = None,
        height: float = 6.0,
        mast: float = 0.0,
    ) -> View:
        """A camera that looks at ``target`` (x, y) [m], or along ``yaw`` [rad] as far as that.

        The optical axis meets the target 1 m above its ground, but no nearer than
        5 m in plan and no further than 0.6 of the camera's depth, so that the
        footprint is neither the pole's foot nor beyond what the camera perceives.
        ``mast`` is how far it hangs from the pole towards the junction [m], where
        it is high enough to clear the traffic.
        """
        height = self.camera_height or height
        inward = self.center - foot
        reach = min(mast, float(np.hypot(*inward))) if height >= _CLEARANCE else 0.0
        offset = reach * inward / max(float(np.hypot(*inward)), 1e-9)
        way = target - foot - offset
        if yaw is None:
            yaw = float(np.arctan2(way[1], way[0]))
        along = float(way @ [np.cos(yaw), np.sin(yaw)])
        distance = min(max(along, _NEAREST_AIM), max(_DEPTH_SHARE * self.depth, _NEAREST_AIM))
        here, there = self.place.ground(np.array([foot, target]))
        drop = here + height - there - _AIM_HEIGHT
        return View(post, foot, offset, height, yaw, float(-np.arctan2(drop, distance)))

    def lidar(self, post: str, foot: Float[np.ndarray, "2"], *, height: float = 5.0) -> View:
        """A level LiDAR on the pole, its zero azimuth towards the centre of the junction.

        Level, since it spins: what a tilt gains towards the junction it loses behind.
        """
        way = self.center - foot
        yaw = float(np.arctan2(way[1], way[0])) if way.any() else self.arms[0].bearing
        return View(post, foot, np.zeros(2), self.lidar_height or height, yaw, 0.0)


def _inset(part: BaseGeometry) -> BaseGeometry:
    """The part less a rim, a thinner rim where it is narrow; nothing of a sliver."""
    wide = part.buffer(-_INSET, join_style="mitre")
    return part.buffer(-_INSET / 3, join_style="mitre") if wide.is_empty else wide


def kerb(arm: Arm, side: int, outward: float = 0.0) -> Float[np.ndarray, "2"]:
    """An arm's kerb, ``outward`` [m] of its mouth; side +1 is left looking outward, −1 right."""
    along = np.array([np.cos(arm.bearing), np.sin(arm.bearing)])
    across = np.array([-along[1], along[0]])
    return np.asarray(arm.mouth) + outward * along + side * arm.width / 2 * across


def spread(azimuths: Float[np.ndarray, " N"], count: int) -> list[int]:
    """Indices of the ``count`` ≥ 1 directions [rad] that lie most evenly round the circle.

    The smallest angle between neighbours is as large as it can be; the first of
    equals wins.
    """
    if count >= len(azimuths):
        return list(range(len(azimuths)))

    def narrowest(chosen: tuple[int, ...]) -> float:
        around = np.sort(azimuths[list(chosen)] % (2 * np.pi))
        between = np.diff(np.append(around, around[0] + 2 * np.pi))
        return float(between.min().round(6)) if count > 1 else 0.0

    best = max(combinations(range(len(azimuths)), count), key=narrowest)
    return list(best)


# ── The rules ───────────────────────────────────────────────────────────────


def central_cameras(site: Site) -> list[View]:
    """Cameras all round over the centre, each aimed at where its line leaves the junction.

    The first looks along the widest arm.
    """
    junction = site.place.regions.get(Region.JUNCTION, Polygon())
    mouths = [Point(arm.mouth) for arm in site.arms]
    hull = unary_union([junction, Point(site.center), *mouths]).convex_hull
    main = max(site.arms, key=lambda arm: arm.width).bearing
    views = []
    for yaw in main + 2 * np.pi * np.arange(site.camera_count) / site.camera_count:
        along = np.array([np.cos(yaw), np.sin(yaw)])
        line = LineString([site.center, site.center + site.radius * along])
        edge = site.center + line.intersection(hull).length * along
        views.append(site.camera("centre", site.center, edge, yaw=float(yaw), height=7.0))
    return views


def corner_cameras(site: Site) -> list[View]:
    """Each arm's corner pole looks out along the arm, then back along it over the junction.

    A pole far beside its arm, as at a roundabout, looks out at the arm instead:
    along it there would be no road to see. With two arms only, the poles at their
    other kerbs look out as well.
    """
    arms = site.arms
    left, right = np.split(site.corners, 2)

    def out(i: int, foot: np.ndarray, post: str) -> View:
        bearing, ahead = arms[i].bearing, kerb(arms[i], 0, 10.0)
        aside = abs((foot - ahead) @ [-np.sin(bearing), np.cos(bearing)]) - arms[i].width / 2
        yaw = bearing if aside <= _ASIDE else None
        return site.camera(post, foot, ahead, yaw=yaw, mast=MAST)

    def back(i: int) -> View:
        yaw = arms[i].bearing + np.pi
        return site.camera(f"corner {i + 1}", left[i], site.center, yaw=yaw, mast=MAST)

    return _fill(
        site,
        lambda i: out(i, left[i], f"corner {i + 1}"),
        back,
        lambda i: out(i, right[i], f"right corner {i + 1}"),
    )


def roadside_cameras(site: Site) -> list[View]:
    """Each arm's roadside pole watches its crosswalk and the junction, then its driveway.

    With two arms only, poles at their other kerbs watch the crosswalks as well.
    """
    arms = site.arms
    right, left = np.split(site.roadsides, 2)

    def inward(i: int, foot: np.ndarray, post: str) -> View:
        mouth = np.asarray(arms[i].mouth)
        return site.camera(post, foot, mouth + (site.center - mouth) / 3)

    def outward(i: int) -> View:
        return site.camera(f"roadside {i + 1}", right[i], kerb(arms[i], 0, SETBACK + 20.0))

    return _fill(
        site,
        lambda i: inward(i, right[i], f"roadside {i + 1}"),
        outward,
        lambda i: inward(i, left[i], f"left roadside {i + 1}"),
    )


def _fill(site: Site, *tiers: Callable[[int], View]) -> list[View]:
    """The site's number of cameras: one an arm, tier by tier; a part of a tier is spread."""
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
    """The four corners that lie most evenly round the junction, one LiDAR each.

    A wide gap offers two; with fewer than four arms the widest gaps do.
    """
    left, right = np.split(site.corners, 2)
    feet = {f"corner {i + 1}": foot for i, foot in enumerate(left)}
    before = np.roll(site.gaps, 1).round(6)  # so that equal gaps stay equal in a turned world
    extra = max(4 - len(left), int((before > _WIDE).sum()))
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
    """A named placement: its rules, the LiDAR the paper gives it, and the heights allowed [m]."""

    cameras: Rule | None = None
    lidars: Rule | None = None
    lidar: str = "paper-lidar-64"
    heights: tuple[float, float] = POLE_HEIGHTS


STRATEGIES: dict[str, Strategy] = {
    "Cam-c": Strategy(cameras=central_cameras, heights=CENTRAL_HEIGHTS),
    "Cam-d1": Strategy(cameras=corner_cameras),
    "Cam-d2": Strategy(cameras=roadside_cameras),
    "L-c": Strategy(lidars=central_lidar, heights=CENTRAL_HEIGHTS),
    "L-d1": Strategy(lidars=corner_lidars, lidar="paper-lidar-32"),
    "L-d2": Strategy(lidars=roadside_lidars),
    "Cam-c/L-c": Strategy(central_cameras, central_lidar, heights=CENTRAL_HEIGHTS),
    "Cam-d1/L-d1": Strategy(corner_cameras, corner_lidars, "paper-lidar-32"),
    "Cam-d2/L-d2": Strategy(roadside_cameras, roadside_lidars),
}
"""The nine placements of the paper's Table 2. Adding one is adding a row."""


def strategy(
    scene: Scene,
    name: str,
    *,
    camera: str = "paper-camera-midday",
    lidar: str | None = None,
    camera_height: float | None = None,
    lidar_height: float | None = None,
) -> Layout:
    """The layout that a strategy of :data:`STRATEGIES` gives on a scene.

    ``name`` in any case. ``camera`` and ``lidar`` name devices of the catalogue;
    None is the paper's LiDAR for the strategy (its discussion of L-d2 has the
    32-beam one: ``lidar="paper-lidar-32"``). ``camera_height`` and
    ``lidar_height`` [m above the ground] replace the usual 6 and 5 m, at the
    centre 7 and 6.5 m. What the strategy has no sensor for is checked and has no
    effect.

    Raises InspeError on an unknown name or device, a device of the other kind, a
    height out of range, and where the intersection has fewer than two arms or
    nowhere to put a pole.
    """
    known = {key.lower(): key for key in STRATEGIES}
    key = known.get(name.strip().lower())
    if key is None:
        raise InspeError(
            f"no strategy '{name}': {', '.join(STRATEGIES)}{nearest(name, tuple(STRATEGIES))}"
        )
    row = STRATEGIES[key]
    place = scene.intersection
    if len(place.arms) < 2:
        raise InspeError(
            f"{place.name}: it has {len(place.arms)} arm{'s' * (not place.arms)}; strategies need "
            "at least 2 roads that meet"
        )
    seeing = _device("camera", camera, CameraSpec)
    ranging = _device("lidar", lidar or row.lidar, LidarSpec)
    low, high = row.heights
    for option, height in (("camera_height", camera_height), ("lidar_height", lidar_height)):
        if height is not None and not low <= height <= high:
            raise InspeError(
                f"{option} {height:g} m is out of range for {key}: between {low:g} and {high:g} m"
            )
    site = Site(place, scene.voxels.radius, seeing.grid.reach, camera_height, lidar_height)
    views: list[tuple[View, Spec]] = []
    for rule, spec in ((row.cameras, seeing), (row.lidars, ranging)):
        views += [(view, spec) for view in rule(site)] if rule else []
    return _join(key, place, views)


def _device(option: str, name: str, kind: type[CameraSpec] | type[LidarSpec]) -> Spec:
    spec = device(name).spec
    if not isinstance(spec, kind):
        raise InspeError(f"{option} '{name}' is a {spec.kind}: name a {kind.kind} device")
    return spec


def _join(name: str, place: Intersection, views: list[tuple[View, Spec]]) -> Layout:
    """One layout of all views: a view joins the first unit that it stands near enough to."""
    units: list[Unit] = []
    sensors: list[Sensor] = []
    poses: list[np.ndarray] = []
    for view, spec in views:
        for u, unit in enumerate(units):
            pose = _pose(view, unit)
            members = [p for p, sensor in zip(poses, sensors, strict=True) if sensor.unit == u]
            if _within_unit(view.foot, np.array(unit.base[:2])) and all(
                _within_unit(pose, other) for other in members
            ):
                break
        else:
            u = len(units)
            taken = any(view.post == unit.name for unit in units)
            x, y = view.foot.tolist()
            z = float(place.ground(view.foot)[0])
            units.append(Unit(f"{view.post}, {spec.kind}" if taken else view.post, (x, y, z)))
            pose = _pose(view, units[u])
        count = sum(sensor.unit == u and sensor.spec.kind == spec.kind for sensor in sensors)
        sensors.append(Sensor(f"{units[u].name} {spec.kind} {count + 1}", spec, u))
        poses.append(pose)
    return make_layout(sensors, units, np.array(poses), name)


def _within_unit(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two plan points or poses may belong to one unit."""
    apart = np.abs(a - b)
    return bool(np.hypot(*apart[:2]) <= UNIT_PLAN and (apart[2:3] <= UNIT_HEIGHT).all())


def _pose(view: View, unit: Unit) -> Float[np.ndarray, "6"]:
    """x, y, z, roll, pitch, yaw of a view from a unit's base [m, rad]."""
    position = np.array(unit.base) + [*view.offset, view.height]
    yaw = np.arctan2(np.sin(view.yaw), np.cos(view.yaw))
    return np.array([*position, 0.0, view.pitch, yaw])
