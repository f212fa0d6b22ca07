"""Where poles may stand at an intersection, and how sensors on them are aimed."""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np
import shapely
from jaxtyping import Bool, Float
from shapely.geometry import LineString, MultiPoint, Point, Polygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import nearest_points, unary_union

from inspe_jax.core.convex import merge
from inspe_jax.core.errors import InspeError
from inspe_jax.mounting.brackets import AT_AXIS, bracket_length, separate
from inspe_jax.scene.intersection import Arm, Intersection
from inspe_jax.scene.regions import Region
from inspe_jax.scene.statics import StaticBody
from inspe_jax.sensing.layout import UNIT_PLAN

POLE_HEIGHTS = (3.0, 12.0)  # lowest and highest height of a sensor on a pole [m above the ground]
CENTRAL_HEIGHTS = (5.0, 12.0)  # the same over the middle of the junction: trucks pass beneath [m]
SMALL = 11.0  # a junction is small if the mean distance of its mouths is below this [m]
SETBACK = 8.0  # a roadside pole stands this far outside the mouth of its arm [m]
CORE = 25.0  # mouths farther than this from the centre are moved in along their arm [m]
MAST = 1.5  # length of a mast arm, from the pole towards the junction [m]
WIDE = float(np.radians(135.0))  # between arms farther apart, each kerb has its own corner [rad]
ASIDE = 7.0  # a pole farther than this from an arm's kerb line is far beside the arm [m]

_CLEARANCE = CENTRAL_HEIGHTS[0]  # a mast arm may reach over a lane only above this [m]
_POLE_REACH = {"corner": 8.0, "roadside": 3.0}  # an existing pole this near is used [m]
_INSET = 0.3  # from a mounting area's edge to a new pole [m]
_CHORD = 0.1  # largest distance between a curved edge and its chords [m]
_APART = 2.5  # between the poles of two units: more than the size of one unit [m]
_DEPTH_SHARE = 0.6  # farthest aim, as a share of a camera's depth [–]
_NEAREST_AIM = 5.0  # nearest aim, measured in plan [m]
_AIM_HEIGHT = 1.0  # aim this high above the ground, at people and vehicle bodies [m]


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class View:
    """One sensor of a strategy: the ``post`` and its ``foot`` (x, y), the ``offset`` from there,
    the ``height`` above the ground at the foot [m], and its angles [rad]."""

    post: str
    foot: Float[np.ndarray, "2"]
    offset: Float[np.ndarray, "2"]
    height: float
    yaw: float
    pitch: float


@dataclass(frozen=True, eq=False)
class Site:
    """An intersection as a placement rule sees it: its arms in order, and places for poles.

    ``radius`` bounds the region of interest, ``depth`` is the cameras' effective one [m]. Heights
    [m] and ``camera_pitch`` [rad] are None if the rule chooses them. No unit stands in one of the
    ``bodies``, nor within UNIT_PLAN of one as high as the ``lowest`` sensor [m].
    """

    place: Intersection
    radius: float
    depth: float
    camera_height: float | None = None
    lidar_height: float | None = None
    camera_pitch: float | None = None
    bodies: tuple[StaticBody, ...] = ()
    lowest: float = POLE_HEIGHTS[0]

    @property
    def center(self) -> Float[np.ndarray, "2"]:
        """Middle of the junction in plan [m]."""
        return np.asarray(self.place.center, float)[:2]

    @cached_property
    def arms(self) -> tuple[Arm, ...]:
        """The arms, counter-clockwise by the place of their mouths, from the intersection's first.
        A mouth farther than :data:`CORE` from the centre, as on a motorway, is moved in."""
        # By place, not bearing: a ramp and its motorway have nearly the same bearing.
        start = self.azimuth(self.place.arms[0].mouth)
        arms = sorted(
            self.place.arms, key=lambda arm: (self.azimuth(arm.mouth) - start) % (2 * np.pi)
        )
        return tuple(map(self._moved_in, arms))

    def _moved_in(self, arm: Arm) -> Arm:
        along, out = arm.axes[0], np.asarray(arm.mouth) - self.center
        aside = out - (out @ along) * along
        furthest = np.sqrt(max(CORE**2 - aside @ aside, 0.0))
        x, y = np.asarray(arm.mouth) - max(out @ along - furthest, 0.0) * along
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

    def edge(self, yaw: float) -> Float[np.ndarray, "2"]:
        """The point where a line from the centre along ``yaw`` [rad] leaves the junction."""
        along = np.array([np.cos(yaw), np.sin(yaw)])
        line = LineString([self.center, self.center + self.radius * along])
        return self.center + line.intersection(self._hull).length * along

    @cached_property
    def _hull(self) -> BaseGeometry:
        junction = self.place.regions.get(Region.JUNCTION, Polygon())
        mouths = [Point(arm.mouth) for arm in self.arms]
        return unary_union([junction, Point(self.center), *mouths]).convex_hull

    @property
    def camera_count(self) -> int:
        """Cameras of a strategy: 8 at junctions of 4 arms or more, 6 at smaller ones."""
        away = [np.hypot(*(np.asarray(arm.mouth) - self.center)) for arm in self.arms]
        return 8 if len(self.arms) >= 4 and np.mean(away) >= SMALL else 6

    @cached_property
    def free(self) -> BaseGeometry:
        """The mounting area within the radius, off lanes and crosswalks, with its rim."""
        crosswalks = self.place.regions.get(Region.CROSSWALK, Polygon())
        near = Point(self.center).buffer(self.radius, quad_segs=64)
        open_ = self.place.mounting.intersection(near).difference(self.place.lanes)
        open_ = open_.difference(crosswalks)
        return open_.difference(unary_union(list(self.rooms))) if self.bodies else open_

    @cached_property
    def rooms(self) -> tuple[BaseGeometry, ...]:
        """The ground on which each body lets no unit stand."""
        return tuple(
            one.polygon.buffer(UNIT_PLAN if one.height > self.lowest else 0.0)
            for one in self.bodies
        )

    @cached_property
    def carriers(self) -> tuple[StaticBody, ...]:
        """The bodies that are poles for units: high enough, and well away from each other."""
        feet = np.asarray(self.place.poles, float).reshape(-1, 3)[:, :2]
        poles = [one for one in self.bodies if one.kind == "pole" and one.base == 0
                 and one.height >= self.lowest]  # fmt: skip
        known = [one for one in poles if (np.hypot(*(feet - one.middle).T) <= AT_AXIS).any()]
        return separate(known)

    def carrier_at(self, foot: Float[np.ndarray, "2"]) -> StaticBody | None:
        """The pole among the bodies that carries a unit at ``foot`` (x, y), if one does."""
        return next((p for p in self.carriers if np.hypot(*(foot - p.middle)) <= AT_AXIS), None)

    def _bracket(self, foot: Float[np.ndarray, "2"], yaw: float) -> Float[np.ndarray, "2"]:
        """From a foot to a sensor that hangs on its side of ``yaw`` [rad]; 0 for a new pole."""
        pole = self.carrier_at(foot)
        length = 0.0 if pole is None else bracket_length(pole)
        return length * np.array([np.cos(yaw), np.sin(yaw)])

    def body_near(self, foot: Float[np.ndarray, "2"], within: float = 0.0) -> StaticBody | None:
        """The first body that lets no unit stand at ``foot`` (x, y), deeper than ``within`` [m]."""
        carried, at = self.carrier_at(foot) is not None, Point(foot)
        for one, room in zip(self.bodies, self.rooms, strict=True):
            if carried and one in self.carriers:
                continue
            if room.contains(at) and room.boundary.distance(at) > within:
                return one
        return None

    @cached_property
    def ground(self) -> BaseGeometry:
        """Where a new pole may be put: the free mounting area without its rim."""
        return unary_union([_inset(part) for part in getattr(self.free, "geoms", [self.free])])

    @cached_property
    def core(self) -> BaseGeometry:
        """The ground of new poles, with chords for curved edges; never outside the free area."""
        core = self.ground.simplify(_CHORD)
        return core if self.free.covers(core) else core.intersection(self.free)

    def convex(self) -> list[Float[np.ndarray, "N 2"]]:
        """Outlines of convex pieces that cover the core, about the centre, the largest first."""
        triangles = [
            np.array(t.exterior.coords)[:3]
            for part in shapely.get_parts(self.core)
            if isinstance(part, Polygon) and not part.is_empty
            for t in shapely.constrained_delaunay_triangles(part).geoms
        ]
        found = merge(np.array(triangles).reshape(-1, 3, 2) - self.center)
        return sorted(found, key=lambda outline: -Polygon(outline).area)

    def carries(
        self, foot: Float[np.ndarray, "2"], within: float, *, areas: bool = True, poles: bool = True
    ) -> bool:
        """Whether free mounting area or a pole is ``within`` [m] of ``foot`` (x, y), for a unit."""
        on_pole = poles and (np.hypot(*(self.poles - foot).T) <= within).any()
        return bool(on_pole or (areas and self.free.distance(Point(foot)) <= within))

    def over_lane(self, point: Float[np.ndarray, "2"]) -> bool:
        """Whether a point (x, y) [m] is over a lane of vehicles."""
        return bool(self.place.lanes.contains(Point(point)))

    def lattice(self, spacing: float) -> Float[np.ndarray, "F 2"]:
        """Feet on the core, about the centre [m]: one in each square of a lattice that meets it,
        the core's point nearest to the middle of the square."""
        half = int(np.ceil(self.radius / spacing))
        middles = (np.indices((2 * half + 1,) * 2).reshape(2, -1).T - half) * spacing
        if self.core.is_empty:
            return np.zeros((0, 2))
        shapely.prepare(self.core)
        lines = shapely.shortest_line(shapely.points(middles + self.center), self.core)
        feet = shapely.get_coordinates(lines).reshape(-1, 2, 2)[:, 1] - self.center
        return feet[np.abs(feet - middles).max(1) <= spacing / 2]

    def lane_cells(self, reach: float, cell: float) -> Bool[np.ndarray, "G G"]:
        """Whether each square of a raster about the centre [m] touches a lane, or nearly so, by a
        tenth of its edge. Cell (0, 0) has its corner at (−reach, −reach)."""
        # A square touches no lane that is farther from its middle than half its diagonal.
        swept = self.place.lanes.buffer(0.75 * cell).simplify(0.02 * cell)
        shapely.prepare(swept)
        x, y = (np.indices((int(np.ceil(2 * reach / cell)),) * 2) + 0.5) * cell - reach
        return shapely.contains_xy(swept, x + self.center[0], y + self.center[1])

    @cached_property
    def poles(self) -> Float[np.ndarray, "P 2"]:
        """Feet of the existing poles within the radius, off the lanes and free of bodies [m]."""
        feet = np.asarray(self.place.poles, float).reshape(-1, 3)[:, :2]
        return feet[np.array([not self.why_none(foot) for foot in feet], bool)]

    def why_none(self, foot: Float[np.ndarray, "2"]) -> str:
        """Why an existing pole at ``foot`` (x, y) carries no unit; empty if it can."""
        if (away := np.hypot(*(foot - self.center))) > self.radius:
            return f"{away:.0f} m from the centre, beyond the radius of {self.radius:g} m"
        if self.place.lanes.intersects(Point(foot)):
            return "on a driving lane"
        if (body := self.body_near(foot)) is None:
            return ""
        if body.kind != "pole" or np.hypot(*(foot - body.middle)) > AT_AXIS:
            return f"in or beside a {body.kind}"
        if body.height < self.lowest:
            return f"{body.height:g} m high, lower than the lowest sensor, {self.lowest:g} m"
        return "too thick for brackets, or too near to another pole"

    @cached_property
    def corners(self) -> Float[np.ndarray, "2N 2"]:
        """Feet of the corner poles [m]: one at the left kerb of each arm, then at the right kerbs.
        One pole serves both sides of a narrow gap; then the right one is :data:`SETBACK` farther
        out."""
        arms, wide = self.arms, self.gaps > WIDE
        facing = zip(arms, arms[1:] + arms[:1], wide, strict=True)
        left = [a.kerb(+1) if alone else (a.kerb(+1) + b.kerb(-1)) / 2 for a, b, alone in facing]
        before = zip(arms, np.roll(wide, 1), strict=True)
        right = [arm.kerb(-1, 0.0 if alone else SETBACK) for arm, alone in before]
        return self._stand(left + right, "corner")

    @cached_property
    def roadsides(self) -> Float[np.ndarray, "2N 2"]:
        """Feet of the roadside poles [m]: at the right kerb of each arm, then at the left kerbs."""
        wanted = [arm.kerb(side, SETBACK) for side in (-1, +1) for arm in self.arms]
        return self._stand(wanted, "roadside")

    def _stand(self, wanted: list[np.ndarray], post: str) -> Float[np.ndarray, "N 2"]:
        """The places for poles nearest to the wanted ones, all different."""
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
        """A camera that looks at ``target`` (x, y) [m], 1 m above the ground, or along ``yaw``
        [rad] as far, at 5 m or more in plan and at most at 0.6 of its depth. ``mast`` is the length
        of an arm towards the junction [m], none if the camera is too low to hang over traffic."""
        height, inward, aim = self.camera_height or height, self.center - foot, target - foot
        reach = min(mast, float(np.hypot(*inward))) if height >= _CLEARANCE else 0.0
        offset = reach * inward / max(float(np.hypot(*inward)), 1e-9)
        if not offset.any():
            offset = self._bracket(foot, np.arctan2(aim[1], aim[0]) if yaw is None else yaw)
        to = aim - offset
        if yaw is None:
            yaw = float(np.arctan2(to[1], to[0]))
        along = float(to @ [np.cos(yaw), np.sin(yaw)])
        distance = min(max(along, _NEAREST_AIM), max(_DEPTH_SHARE * self.depth, _NEAREST_AIM))
        here, there = self.place.ground(np.array([foot, target]))
        drop = here + height - there - _AIM_HEIGHT
        aimed = float(-np.arctan2(drop, distance))
        pitch = aimed if self.camera_pitch is None else self.camera_pitch
        return View(post, foot, offset, height, yaw, pitch)

    def lidar(self, post: str, foot: Float[np.ndarray, "2"], *, height: float = 5.0) -> View:
        """A level LiDAR on the pole, with azimuth 0 towards the centre of the junction."""
        to = self.center - foot
        yaw = float(np.arctan2(to[1], to[0])) if to.any() else self.arms[0].bearing
        offset = self._bracket(foot, yaw)
        return View(post, foot, offset, self.lidar_height or height, yaw, 0.0)


def _inset(part: BaseGeometry) -> BaseGeometry:
    """A part of an area without its rim, or a thinner rim if it is narrow; empty for a sliver."""
    wide = part.buffer(-_INSET, join_style="mitre")
    return part.buffer(-_INSET / 3, join_style="mitre") if wide.is_empty else wide


def farthest_first(points: Float[np.ndarray, "N 2"], most: int) -> list[int]:
    """Indices of up to ``most`` points: the first, then always the farthest from those before."""
    away = np.full(len(points), np.inf)
    chosen = [0] if len(points) else []
    while len(chosen) < min(most, len(points)):
        away = np.minimum(away, np.hypot(*(points - points[chosen[-1]]).T))
        chosen.append(int(away.argmax()))
    return chosen


def spread(azimuths: Float[np.ndarray, " N"], count: int) -> list[int]:
    """Indices of the ``count`` ≥ 1 directions [rad] with the smallest largest angle between
    neighbours; among equals, the largest smallest angle; among equals again, the first."""
    if count >= len(azimuths):
        return list(range(len(azimuths)))

    def evenness(chosen: tuple[int, ...]) -> tuple[float, float]:
        around = np.sort(azimuths[list(chosen)] % (2 * np.pi))
        between = np.diff(np.append(around, around[0] + 2 * np.pi)).round(6)
        return -float(between.max()), float(between.min())

    best = max(combinations(range(len(azimuths)), count), key=evenness)
    return list(best)
