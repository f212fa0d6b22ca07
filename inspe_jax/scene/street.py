"""Street furniture made up for any place, where nobody drives or walks and no pole stands near."""

import zlib
from collections.abc import Callable, Iterator
from itertools import islice
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Float
from shapely.geometry import LineString, Point
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from inspe_jax.core.errors import InspeError, check_known
from inspe_jax.scene.intersection import Intersection, lines_of
from inspe_jax.scene.regions import Region
from inspe_jax.scene.statics import StaticBody, pole, tree, upright_box
from inspe_jax.scene.traffic.frames import BodySize, TrafficFrames, drawn_size
from inspe_jax.scene.traffic.waypoint.paths import with_walkways

STATICS = ("none", "map", "street")
"""The static bodies that a scene may be built with: none, those of its map, or made-up ones."""

BEYOND = 10.0  # bodies stand up to this far outside the region of interest [m]
LANE_GAP = 0.05  # least distance of a body from the edge of a lane, where kerbs are [m]
WALKED = 0.8  # nothing stands so near to a footpath's middle [m]: people walk 0.5 m beside it
HEADROOM = 2.4  # nothing hangs lower over footpaths [m]; 2.5 m is the usual clearance (RASt 06)
OVER_LANES = 4.5  # nothing hangs lower over lanes, whose clearance this is [m]
FROM_CROSSING = 5.0  # no vehicle, tree, wall or hedge is so near a crossing (German StVO § 12) [m]
FROM_POLES = 2.5  # nothing stands this near to an existing pole [m]: sensors on it reach 2 m far
MEDIAN = 8.0  # nobody parks between two carriageways that are less than this apart [m]
APART = 0.3  # bodies are at least so far apart on the ground [m]
PARKED = (
    BodySize(0.20, (3.6, 1.64, 1.50)),
    BodySize(0.35, (4.1, 1.76, 1.48)),
    BodySize(0.25, (4.6, 1.83, 1.46)),
    BodySize(0.12, (4.7, 1.89, 1.70)),
    BodySize(0.08, (5.3, 1.99, 2.10)),
)
"""Shares and sizes of parked vehicles [m]: city car, small car, saloon or estate, SUV and van."""


def statics_of(
    name: str, place: Intersection, radius: float, traffic: TrafficFrames
) -> tuple[StaticBody, ...]:
    """The static bodies of a name, without those that traffic touches, but for a map's buildings
    and a mesh's solids. Raises InspeError for another name, or if the place's map brings no
    bodies."""
    check_known(name, STATICS, "statics")
    if name == "none":
        return ()
    if name == "street":
        return untouched(street_bodies(place, radius), traffic)
    found = map_bodies(place, radius)
    kept = untouched(found, traffic)
    return tuple(one for one in found if one.kind in ("building", "solid") or one in kept)


def map_bodies(place: Intersection, radius: float) -> tuple[StaticBody, ...]:
    """The bodies that a place's map brings, out to :data:`BEYOND` its region of interest. Raises
    InspeError where it brings none."""
    if not place.bodies:
        raise InspeError(
            f"{place.name}: {place.source} brings no bodies here; an OpenStreetMap extract (.osm) "
            "with buildings, trees, walls or poles does, and so does OpenDRIVE (.xodr) with such "
            "<object> elements; statics 'street' makes some up"
        )
    area = Point(place.center[:2]).buffer(radius + BEYOND)
    return tuple(one for one in place.bodies if one.polygon.intersects(area))


def street_bodies(place: Intersection, radius: float) -> tuple[StaticBody, ...]:
    """Street furniture of a place, the same for any traffic; where nobody walks, lamps only."""
    rng = np.random.default_rng([0, zlib.crc32(place.name.encode())])
    room = _Room(place, radius)
    town = (_signals, _shelters, _parked, _lamps, _trees, _boxes, _walls)
    for fill in (_lamps,) if room.walked.is_empty else town:
        fill(room, rng)
    return tuple(room.bodies)


def untouched(bodies: tuple[StaticBody, ...], traffic: TrafficFrames) -> tuple[StaticBody, ...]:
    """The bodies that no road user touches in any frame: recorded traffic may use any ground."""
    on = traffic.valid
    if not bodies or not on.any():
        return bodies
    center, yaw, half = traffic.center[on], traffic.yaw[on], traffic.size[on] / 2
    along = np.stack([np.cos(yaw), np.sin(yaw)], -1) * half[:, :1]
    across = np.stack([-np.sin(yaw), np.cos(yaw)], -1) * half[:, 1:2]
    ring = [center[:, :2] + i * along + j * across for i, j in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
    tree_of = shapely.STRtree(shapely.polygons(np.stack(ring, 1)))
    return tuple(one for one in bodies if not len(tree_of.query(_footprint(one), "intersects")))


def _footprint(one: StaticBody) -> BaseGeometry:
    """The ground that a body takes: a tree's is that of its trunk."""
    return Point(one.middle).buffer(one.trunk) if one.base > 0 else one.polygon


class Spot(NamedTuple):
    """A place along a line: the point, and unit vectors along the line and away from the lanes."""

    at: Float[np.ndarray, "2"]
    along: Float[np.ndarray, "2"]
    out: Float[np.ndarray, "2"]

    @property
    def yaw(self) -> float:
        """The direction of the line [rad]."""
        return float(np.arctan2(self.along[1], self.along[0]))

    def moved(self, out: float) -> Float[np.ndarray, "2"]:
        """The point so far away from the lanes [m]."""
        return self.at + out * self.out


class _Room:
    """Where there is room for bodies, and those that stand already."""

    def __init__(self, place: Intersection, radius: float) -> None:
        self.place = place
        self.bodies: list[StaticBody] = []
        self.area = Point(place.center[:2]).buffer(radius + BEYOND)
        near = self.area.buffer(5.0)
        paths = lines_of(with_walkways(place, radius).routes, "pedestrian")
        some = [r for r in (Region.CROSSWALK, Region.JUNCTION) if r in place.regions]
        self.lanes = place.lanes.intersection(near)
        self.walked = unary_union([path.buffer(WALKED) for path in paths]).intersection(near)
        self.crossings = unary_union([place.regions[r] for r in some]).intersection(near)
        self.poles = unary_union([Point(foot[:2]).buffer(FROM_POLES) for foot in place.poles])
        ground = unary_union(list(place.regions.values())).intersection(near)
        self.kerb = self.lanes.boundary.intersection(self.area)
        self.back = ground.boundary.intersection(self.area)

    def takes(self, one: StaticBody, from_crossings: float) -> bool:
        foot, hangs = _footprint(one), one.polygon
        return (
            self.area.contains(hangs)
            and foot.distance(self.lanes) >= LANE_GAP - 1e-6
            and not foot.intersects(self.walked)
            and (self.crossings.is_empty or hangs.distance(self.crossings) >= from_crossings)
            and not hangs.intersects(self.poles)
            and (one.base >= OVER_LANES or hangs.distance(self.lanes) >= LANE_GAP - 1e-6)
            and (one.base >= HEADROOM or not hangs.intersects(self.walked))
            and all(
                foot.distance(_footprint(other)) >= APART
                and not (one.trunk and other.trunk and hangs.intersects(other.polygon))
                for other in self.bodies
            )
        )

    def add(self, *tries: StaticBody, from_crossings: float = 0.3) -> None:
        """Let the first body stand that may stand where it is, if any."""
        self.bodies += islice((one for one in tries if self.takes(one, from_crossings)), 1)

    def along(self, line: BaseGeometry, step: Callable[[], float]) -> Iterator[Spot]:
        """Spots along the parts of a line, ``step()`` metres apart, within the area."""
        for part in shapely.get_parts(shapely.line_merge(line)):
            if part.geom_type not in ("LineString", "LinearRing") or part.length < 2.0:
                continue
            way = step() / 2
            while way < part.length - 1.0:
                ends = [np.array(part.interpolate(way + d).coords[0]) for d in (-0.5, 0.5)]
                at, along = np.array(part.interpolate(way).coords[0]), ends[1] - ends[0]
                way += step()
                size = np.hypot(*along)
                if size < 0.8:  # a corner
                    continue
                along = along / size
                out = np.array([-along[1], along[0]])
                left, right = (Point(at + s * 0.3 * out).distance(self.lanes) for s in (1, -1))
                yield Spot(at, along, out if left > right else -out)


def _signals(room: _Room, rng: np.random.Generator) -> None:
    """A signal post at either kerb of each arm, where drivers stop, unless a pole is there."""
    for arm in room.place.arms:
        ahead, across = arm.axes
        for side in (-1, 1):
            foot = np.array(arm.mouth) + 4.2 * ahead + side * (arm.width / 2 + 0.4) * across
            room.add(pole(foot, radius=0.07, height=3.4))


def _lamps(room: _Room, rng: np.random.Generator) -> None:
    """Lamp posts at the kerb, some 25 m apart."""
    for spot in room.along(room.kerb, lambda: float(rng.uniform(22, 28))):
        room.add(pole(spot.moved(0.5), radius=0.09, height=8.0))


def _shelters(room: _Room, rng: np.random.Generator) -> None:
    """Up to two bus shelters at the back of the sidewalk, at least 40 m apart."""
    spots = list(room.along(room.back, lambda: float(rng.uniform(3, 6))))
    found: list[StaticBody] = []
    for spot in (spots[k] for k in rng.permutation(len(spots))):
        tries = (
            upright_box("furniture", spot.moved(out), (4.0, 1.3, 2.4), spot.yaw)
            for out in (-0.7, 0.0, 0.3)
        )
        fits = next((one for one in tries if room.takes(one, 3 * FROM_CROSSING)), None)
        if fits and all(fits.polygon.distance(other.polygon) > 40 for other in found):
            found.append(fits)
            room.bodies.append(fits)
        if len(found) == 2:
            return


def _parked(room: _Room, rng: np.random.Generator) -> None:
    """Vehicles along the kerb, in rows with gaps: some 60 % of the places are taken."""
    for spot in room.along(room.kerb, lambda: float(rng.uniform(5.4, 6.4))):
        if rng.uniform() > 0.6:
            continue
        first = drawn_size(PARKED, rng)
        sizes = [first, *(size for _, size in reversed(PARKED) if size[1] < first[1])]
        turn = spot.yaw + np.pi * bool(rng.uniform() < 0.2)
        across = LineString([spot.moved(0.3), spot.moved(MEDIAN)])
        if not across.intersects(room.lanes):
            feet = [(spot.moved(LANE_GAP + size[1] / 2), size) for size in sizes]
            tries = [upright_box("parked vehicle", *foot, turn) for foot in feet]
            room.add(*tries, from_crossings=FROM_CROSSING)


def _trees(room: _Room, rng: np.random.Generator) -> None:
    """Rows of trees at the back of sidewalks, 9 to 12 m apart, each row of one size."""
    for part in shapely.get_parts(shapely.line_merge(room.back)):
        radius, height, base = rng.uniform([1.5, 5.5, 2.5], [2.2, 8.0, 3.0])
        for spot in room.along(part, lambda: float(rng.uniform(9, 12))):
            wide = radius * rng.uniform(0.9, 1.1)
            tries = [
                tree(spot.moved(out), radius=wide, height=height, base=base, trunk=0.14)
                for out in (-0.3, 0.3)
            ]
            room.add(*tries, from_crossings=FROM_CROSSING)


def _boxes(room: _Room, rng: np.random.Generator) -> None:
    """Switch boxes at the back of sidewalks, some 35 m apart."""
    for spot in room.along(room.back, lambda: float(rng.uniform(28, 42))):
        room.add(upright_box("furniture", spot.moved(-0.25), (1.1, 0.4, 1.3), spot.yaw))


def _walls(room: _Room, rng: np.random.Generator) -> None:
    """Walls and hedges behind sidewalks, in stretches with gaps."""
    for spot in room.along(room.back, lambda: float(rng.uniform(9, 16))):
        kind, width, height = ("hedge", 0.7, 1.5) if rng.uniform() < 0.5 else ("wall", 0.25, 1.8)
        long, height = float(rng.uniform(5, 8)), height * float(rng.uniform(0.8, 1.15))
        one = upright_box(kind, spot.moved(0.2 + width / 2), (long, width, height), spot.yaw)
        room.add(one, from_crossings=FROM_CROSSING)
