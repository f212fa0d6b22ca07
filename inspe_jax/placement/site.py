"""What a placement rule may ask of an intersection: where poles stand, how a sensor is aimed."""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np
import shapely
from jaxtyping import Bool, Float
from shapely.geometry import LineString, MultiPoint, Point, Polygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import nearest_points, unary_union

from inspe_jax.core.errors import InspeError
from inspe_jax.placement.convex_regions import merge
from inspe_jax.scene.intersection import Arm, Intersection
from inspe_jax.scene.regions import Region

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
WIDE = float(np.radians(135.0))
"""Between two arms further apart than this each kerb has its own corner [rad]."""
ASIDE = 7.0
"""A pole further than this from an arm's kerb line is far beside it [m]."""

_CLEARANCE = CENTRAL_HEIGHTS[0]  # a mast arm may reach over a lane only above this [m]
_POLE_REACH = {"corner": 8.0, "roadside": 3.0}  # a standing pole this near is used [m]
_INSET = 0.3  # from a mounting area's edge to a new pole [m]
_CHORD = 0.1  # curved edges become chords this near to them [m]
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
    see [m]; ``camera_height`` and ``lidar_height`` [m] and ``camera_pitch`` [rad]
    are None where the rule chooses.
    """

    place: Intersection
    radius: float
    depth: float
    camera_height: float | None = None
    lidar_height: float | None = None
    camera_pitch: float | None = None

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

    def edge(self, yaw: float) -> Float[np.ndarray, "2"]:
        """Where a line from the centre along ``yaw`` [rad] leaves the junction and its mouths."""
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
    def free(self) -> BaseGeometry:
        """Mounting area within the radius, off lanes and crosswalks, to its very edge."""
        crosswalks = self.place.regions.get(Region.CROSSWALK, Polygon())
        near = Point(self.center).buffer(self.radius, quad_segs=64)
        return self.place.mounting.intersection(near).difference(self.lanes).difference(crosswalks)

    @cached_property
    def ground(self) -> BaseGeometry:
        """Where a new pole may be put: the free mounting area less a rim."""
        return unary_union([_inset(part) for part in getattr(self.free, "geoms", [self.free])])

    @cached_property
    def core(self) -> BaseGeometry:
        """The ground of new poles with chords for its curved edges; never outside the free area."""
        core = self.ground.simplify(_CHORD)
        return core if self.free.covers(core) else core.intersection(self.free)

    def convex(
        self, foot: Float[np.ndarray, "2"] | None = None, reach: float = np.inf
    ) -> list[Float[np.ndarray, "N 2"]]:
        """Outlines of convex pieces that cover the core, about the centre, the largest first.

        Only of what lies within ``reach`` of ``foot`` (x, y) about the centre [m], if given.
        """
        core = self.core
        if foot is not None:
            core = core.intersection(Point(self.center + foot).buffer(reach))
        parts = [p for p in shapely.get_parts(core) if isinstance(p, Polygon) and not p.is_empty]
        triangles = [
            np.array(t.exterior.coords)[:3]
            for part in parts
            for t in shapely.constrained_delaunay_triangles(part).geoms
        ]
        found = merge(np.array(triangles).reshape(-1, 3, 2) - self.center)
        return sorted(found, key=lambda outline: -Polygon(outline).area)

    def carries(
        self,
        foot: Float[np.ndarray, "2"],
        *,
        areas: bool = True,
        poles: bool = True,
        within: float = 0.0,
    ) -> bool:
        """Whether a unit may stand at ``foot`` (x, y) [m]: on free mounting area or on a pole.

        The rim of an area counts. ``within`` is the rounding allowed [m].
        """
        away = np.hypot(*(self.poles - foot).T)
        on_pole = poles and len(away) > 0 and away.min() <= within
        return bool(on_pole or (areas and self.free.distance(Point(foot)) <= within))

    def over_lane(self, point: Float[np.ndarray, "2"]) -> bool:
        """Whether a point (x, y) [m] is over ground that vehicles' lanes sweep."""
        return bool(self.lanes.contains(Point(point)))

    def lattice(self, spacing: float) -> Float[np.ndarray, "F 2"]:
        """Feet on the core, about the centre [m]: one in each square of a lattice that meets it.

        It is the point nearest to the middle of the square, so that areas narrower than
        ``spacing`` have their share too.
        """
        steps = np.arange(-np.ceil(self.radius / spacing), np.ceil(self.radius / spacing) + 1)
        middles = np.stack(np.meshgrid(steps, steps, indexing="ij"), -1).reshape(-1, 2) * spacing
        if self.core.is_empty:
            return np.zeros((0, 2))
        shapely.prepare(self.core)
        lines = shapely.shortest_line(shapely.points(middles + self.center), self.core)
        feet = shapely.get_coordinates(lines).reshape(-1, 2, 2)[:, 1] - self.center
        return feet[np.abs(feet - middles).max(1) <= spacing / 2]

    def lane_cells(self, reach: float, cell: float) -> Bool[np.ndarray, "G G"]:
        """Which squares of a raster touch a lane; cell (0, 0) has its corner at −reach, −reach.

        About the centre [m]; a square within a tenth of its edge of a lane may count too.
        """
        # A square touches no lane that its middle is further from than half its diagonal.
        swept = self.lanes.buffer(0.75 * cell).simplify(0.02 * cell)
        shapely.prepare(swept)
        count = int(np.ceil(2 * reach / cell))
        x, y = np.meshgrid(*[(np.arange(count) + 0.5) * cell - reach] * 2, indexing="ij")
        return shapely.contains_xy(swept, x + self.center[0], y + self.center[1])

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
            kerb(arm, +1) if gap > WIDE else (kerb(arm, +1) + kerb(following, -1)) / 2
            for arm, following, gap in zip(self.arms, after, self.gaps, strict=True)
        ]
        before = np.roll(self.gaps, 1)
        right = [
            kerb(arm, -1, 0.0 if gap > WIDE else SETBACK)
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
        it is high enough to clear the traffic. A site's own ``camera_pitch`` stands instead.
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
        aimed = float(-np.arctan2(drop, distance))
        pitch = aimed if self.camera_pitch is None else self.camera_pitch
        return View(post, foot, offset, height, yaw, pitch)

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

    The largest angle between neighbours is as small as it can be, then the smallest
    as large; the first of equals wins.
    """
    if count >= len(azimuths):
        return list(range(len(azimuths)))

    def evenness(chosen: tuple[int, ...]) -> tuple[float, float]:
        around = np.sort(azimuths[list(chosen)] % (2 * np.pi))
        between = np.diff(np.append(around, around[0] + 2 * np.pi)).round(6)
        return -float(between.max()), float(between.min())

    best = max(combinations(range(len(azimuths)), count), key=evenness)
    return list(best)
