"""Bodies of maps: shapes in plan, mended and cut, so that nothing stands where traffic goes."""

from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy
import shapely
import shapely.affinity
from shapely.geometry import Point, Polygon, box
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from inspe_jax.core.errors import InspeError
from inspe_jax.scene.intersection import Intersection, lines_of
from inspe_jax.scene.regions import Region
from inspe_jax.scene.statics import StaticBody, body
from inspe_jax.scene.street import HEADROOM, OVER_LANES, WALKED

# ── Sizes of bodies of which a map says none [m] ────────────────────────────

BUILDING = 6.0  # height of a building: two levels
BARRIERS = {"wall": (2.0, 0.25), "city_wall": (6.0, 1.0), "hedge": (1.5, 0.7), "fence": (1.8, 0.1)}
"""Height and width of barriers."""
TREE = {"height": 8.0, "diameter_crown": 5.0, "circumference": 0.94}
POLE = 6.0, 0.1  # height and radius of a pole
HEIGHTS = {
    "building": BUILDING,
    "wall": BARRIERS["wall"][0],
    "hedge": BARRIERS["hedge"][0],
    "tree": TREE["height"],
    "pole": POLE[0],
    "furniture": 1.0,
    "parked vehicle": 1.5,
}
"""Height of each kind of body of which a map says none."""


def crown_base(height: float) -> float:
    """Height at which the crown of a tree begins, of which a map says none."""
    return min(2.5, 0.4 * height)


SMALL = {"building": 0.5, "furniture": 0.1, "wall": 0.02, "hedge": 0.05, "tree": 0.2, "pole": 0.0,
         "parked vehicle": 0.5, "solid": 0.05}  # fmt: skip
"""Parts of less than this are left out [m²]."""
SAME_POLE = 0.5  # A signal this near to a pole of the map hangs on it [m]
NO_POLES = "no poles: the map does not say where any stand"
CUT_TOLERANCE = 0.05  # edges of cuts keep within this of where they were: arcs get few corners [m]


class Shape(NamedTuple):
    """What a map says of one body, as of a :class:`~inspe_jax.scene.statics.StaticBody`, on any
    polygons. A tree or a pole stands whole or not at all."""

    kind: str
    area: BaseGeometry
    height: float
    base: float = 0.0
    transmittance: float = 0.0
    trunk: float = 0.0


class Ways(NamedTuple):
    """Where traffic goes: the ground of vehicles and crossings, and with footpaths as well."""

    lanes: BaseGeometry
    paths: BaseGeometry

    @classmethod
    def of(cls, place: Intersection) -> "Ways":
        """Those of a place that has its regions and routes."""
        roads = (Region.DRIVEWAY, Region.JUNCTION, Region.CROSSWALK)
        lanes = unary_union([place.regions[r] for r in roads if r in place.regions])
        lines = lines_of(place.routes, "pedestrian")
        walked = shapely.buffer(lines, WALKED, cap_style="square", join_style="mitre")
        return cls(lanes, unary_union([lanes, *walked]))

    def under(self, base: float) -> BaseGeometry:
        """The ground over which nothing may be that begins so high [m]; empty for high bodies."""
        if base >= OVER_LANES:
            return Polygon()
        return self.lanes if base >= HEADROOM else self.paths


def with_bodies(
    place: Intersection, shapes: Iterable[Shape], reach: float, notes: list[str]
) -> Intersection:
    """A place with the bodies of its map that come within ``reach`` [m] of its centre.

    Outlines that cross themselves are mended. What is on lanes, crossings or the middle of
    footpaths is cut off; a tree or a pole there is left out, a crown begins above lanes or is
    narrower. Poles on the ground can carry sensors. ``notes`` get what was done.
    """
    ways, disc = Ways.of(place), Point(place.center[:2]).buffer(reach)
    shapely.prepare([disc, *ways])
    found: list[StaticBody] = []
    counts: Counter[str] = Counter()
    for shape in shapes:
        area = _mended(shape.area)
        if not disc.intersects(area):
            continue
        counts["mended"] += not shape.area.is_valid
        free = _free(shape._replace(area=area), ways, counts)
        made = [] if free is None else list(_bodies(free))
        counts["left out"] += not made
        found += made
    for key, words in (
        ("mended", "whose outline crosses itself: mended"),
        ("cut", "on lanes, crossings or footpaths: cut off there"),
        ("over lanes", "with a crown over lanes: it begins at 4.5 m there, or is narrower"),
        ("left out", "on lanes, crossings or footpaths, or without an area: left out"),
    ):
        if count := counts[key]:
            notes.append(f"{count} {'body' if count == 1 else 'bodies'} of the map {words}")
    feet = np.array([one.middle for one in found if one.kind == "pole" and one.base == 0])
    own = place.on_ground(feet) if len(feet) else np.zeros((0, 3))
    poles = np.asarray(place.poles, float).reshape(-1, 3)
    if len(own) and len(poles):  # a signal's mark is where its pole is
        poles = poles[scipy.spatial.cKDTree(own[:, :2]).query(poles[:, :2])[0] > SAME_POLE]
    return replace(place, bodies=tuple(found), poles=np.vstack([poles, own]))


def _mended(area: BaseGeometry) -> BaseGeometry:
    """The polygons of an area, each simple; empty if it has none."""
    if not area.is_valid:
        area = shapely.make_valid(area, method="structure")
    parts = shapely.get_parts(area)
    return unary_union([part for part in parts if part.geom_type in ("Polygon", "MultiPolygon")])


def _free(shape: Shape, ways: Ways, counts: "Counter[str]") -> Shape | None:
    """A shape without what is where traffic goes; None if nothing is left."""
    if shape.kind == "tree":
        return _free_tree(shape, ways, counts)
    taken = ways.under(shape.base)
    if not taken.intersects(shape.area):
        return shape
    if shape.kind == "pole":
        return None
    left = shape.area.difference(taken)
    left = unary_union([p for p in shapely.get_parts(left) if p.area > SMALL[shape.kind]])
    if left.is_empty:
        return None
    if shape.area.area - left.area < SMALL[shape.kind]:  # it touches a kerb
        return shape._replace(area=left)
    counts["cut"] += 1
    slim = left.simplify(CUT_TOLERANCE)
    return shape._replace(area=slim.difference(taken) if slim.intersects(taken) else slim)


def _free_tree(shape: Shape, ways: Ways, counts: "Counter[str]") -> Shape | None:
    """A tree whose crown is over no lane below :data:`OVER_LANES`."""
    foot = shape.area.centroid.buffer(shape.trunk) if shape.trunk > 0 else shape.area
    if ways.paths.intersects(foot):
        return None
    if not ways.under(shape.base).intersects(shape.area):
        return shape
    counts["over lanes"] += 1
    if shape.height >= OVER_LANES + 1.0:
        return shape._replace(base=OVER_LANES)
    middle = shape.area.centroid
    away, radius = middle.distance(ways.under(shape.base)), np.sqrt(shape.area.area / np.pi)
    share = float(away / radius) / 1.1  # its corners are up to 3 % farther out than its radius
    area = shapely.affinity.scale(shape.area, share, share, origin=middle)
    return shape._replace(area=area) if area.area > SMALL["tree"] else None


def _bodies(shape: Shape) -> Iterator[StaticBody]:
    rest = dict(base=shape.base, transmittance=shape.transmittance, trunk=shape.trunk)
    for simple in simple_pieces(shape.area):
        if simple.area > SMALL[shape.kind]:
            with suppress(InspeError):  # less than a millimetre wide
                yield body(shape.kind, simple.exterior.coords, shape.height, **rest)


def simple_pieces(area: BaseGeometry) -> Iterator[Polygon]:
    """Polygons in pieces without holes that together cover them: cut in two through each hole."""
    for part in shapely.get_parts(area):
        if part.geom_type != "Polygon":
            continue
        if not part.interiors:
            yield part
            continue
        hole = Polygon(part.interiors[0]).representative_point()
        west, south, east, north = part.bounds
        if east - west >= north - south:
            halves = box(west, south, hole.x, north), box(hole.x, south, east, north)
        else:
            halves = box(west, south, east, hole.y), box(west, hole.y, east, north)
        for half in halves:
            yield from simple_pieces(part.intersection(half))
