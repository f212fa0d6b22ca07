"""Places without a map: regions, routes and poles of one's own make an intersection.

In a GeoJSON file, polygons have a property ``region``: driveway, junction, crosswalk, sidewalk or
shoulder; lines a ``route``, ``vehicle`` in the direction of travel or ``pedestrian`` in both, and
``width_m``; points are poles. Junctions are listed in the order of the file. The ground is level.
"""

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import shapely
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict, Field
from shapely.geometry import LineString, MultiPolygon, Point, Polygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import linemerge, unary_union

from inspe_jax.core.errors import InspeError, check_known
from inspe_jax.core.files import check_model
from inspe_jax.core.rigid import array
from inspe_jax.scene.geojson import SUFFIX, Feature, read_features
from inspe_jax.scene.georeference import Georeference, about
from inspe_jax.scene.intersection import (
    FOOTPATH_WIDTH,
    Arm,
    Intersection,
    Route,
    crossing_lines,
    walking_routes,
)
from inspe_jax.scene.lines import distance_from, resampled
from inspe_jax.scene.maps.bodies import NO_POLES
from inspe_jax.scene.maps.road_map import (
    MARGIN,
    RADIUS_READ,
    Areas,
    JunctionInfo,
    check_choice,
    clean,
    mounting_of,
    named_junction,
)
from inspe_jax.scene.regions import Region, regions_of
from inspe_jax.scene.voxels import check_range

WIDTHS = {"vehicle": 3.5, "pedestrian": FOOTPATH_WIDTH}  # of routes of which nothing says so [m]
TOUCH = 0.5  # a driveway this near to a junction meets it [m]
NARROW = 2.0  # an arm is wider [m]
WIDEST = 50.0  # the widest route [m]


class Line(NamedTuple):
    """A route: its ``line`` (N, 2) [m], who goes along it, and its width [m]."""

    line: Float[np.ndarray, "N 2"]
    user: str = "vehicle"
    width: float | None = None


def intersection_of(
    regions: Mapping[str, BaseGeometry],
    routes: Iterable[Line | tuple[Any, ...]] = (),
    poles: Sequence[Sequence[float]] | Float[np.ndarray, "P 2"] = (),
    *,
    name: str = "own place",
    center: tuple[float, float] | None = None,
    radius: float = 50.0,
    georeference: Georeference | None = None,
    source: str = "regions",
) -> Intersection:
    """An intersection of one's own regions, on level ground.

    Its arms are where driveways meet the junction. New poles may stand on sidewalks, shoulders and,
    where there are none beside the junction, at its corners. Without routes of pedestrians, they
    walk over the crosswalks.

    Args:
        regions: Shapely polygons [m] by name: driveway, junction, crosswalk, sidewalk, shoulder.
        routes: Each (line, user, width): points (N, 2) [m] in the direction of travel; ``vehicle``
            or ``pedestrian``; and the width [m], 3.5 or 2 if it is not given.
        poles: Feet of poles (P, 2) [m].
        name: Its name.
        center: (x, y) [m]; the middle of the junction if not given.
        radius: What is farther than this and 10 m is left out, and routes end there [m].
        georeference: The projection of the coordinates, if they have one.
        source: Where it comes from.

    Raises:
        InspeError: A name is of no region, there is no junction, no driveway meets it, or a route
            has fewer than two points or another user.

    >>> import shapely
    >>> along, across = shapely.box(-40, -5, 40, 5), shapely.box(-5, -40, 5, 40)
    >>> regions = {"junction": along & across, "driveway": along | across}
    >>> line = [(-40, -2), (40, -2)]
    >>> place = inspe_jax.intersection_of(regions, [(line, "vehicle")])
    >>> len(place.arms), place.routes[0].through
    (4, (2, 0))
    """
    check_range("radius", radius, RADIUS_READ)
    regions_of(tuple(regions))
    for key, shape in regions.items():
        _check_shape(shape, f"{source}: region '{key}'")
    given = {Region[key.upper()]: shape for key, shape in regions.items()}
    empty = shapely.MultiPolygon()
    areas: Areas = {region: clean(given.get(region, empty)) for region in Region}
    junction = areas[Region.JUNCTION]
    if junction.is_empty:
        raise InspeError(f"{source}: has no region 'junction'")
    areas[Region.DRIVEWAY] = areas[Region.DRIVEWAY].difference(junction)
    at = junction.centroid.coords[0] if center is None else center
    middle = np.array([*array(at, f"{source}: center", (2,)), 0.0])
    disc = Point(middle[:2]).buffer(radius + MARGIN, quad_segs=32)
    areas = {region: area.intersection(disc) for region, area in areas.items()}
    arms = _arms(areas)
    if not arms:
        raise InspeError(f"{source}: no driveway meets the junction within {radius:g} m")
    feet = array(poles, f"{source}: poles", (len(poles), 2)) if len(poles) else np.zeros((0, 2))
    feet = feet[distance_from(feet, middle) <= radius + MARGIN]
    place = Intersection(
        name=name,
        source=source,
        center=middle,
        regions=areas,
        arms=arms,
        routes=(),
        mounting=mounting_of(areas, [], arms, disc),
        poles=np.column_stack([feet, np.zeros(len(feet))]),
        ground_points=middle[None],
        notes=() if len(feet) else (NO_POLES,),
        georeference=georeference,
    )
    drives, walks, left = _routes(place, [Line(*one) for one in routes], radius, source)
    lanes = [route.waypoints for route in drives]
    crossings = crossing_lines([*shapely.get_parts(areas[Region.CROSSWALK])], lanes)
    walks = walks or [(line, WIDTHS["pedestrian"]) for line in crossings]
    found = [walk for line, width in walks for walk in walking_routes(place, [line], width)]
    lost = f"routes that do not come within {radius:g} m: {', '.join(map(str, left))}"
    notes = (*place.notes, *([lost] if left else []))
    return replace(place, routes=(*drives, *found), notes=notes)


def _check_shape(shape: Any, where: str) -> None:
    """Raise InspeError unless it is an area whose outline does not cross itself."""
    if not isinstance(shape, Polygon | MultiPolygon) or not shape.area > 0:
        raise InspeError(f"{where}: needs a polygon of shapely with an area")
    if not shape.is_valid:
        raise InspeError(f"{where}: {shapely.is_valid_reason(shape)}: draw it without crossings")


def _arms(areas: Areas) -> tuple[Arm, ...]:
    """Where each piece of driveway meets the junction, counter-clockwise from the east. A road
    with a gap between its directions is two."""
    found = list[Arm]()
    pieces = shapely.get_parts(areas[Region.DRIVEWAY].buffer(-TOUCH))  # not joined at corners
    for junction, part in product(shapely.get_parts(areas[Region.JUNCTION]), pieces):
        middle = np.array(junction.centroid.coords[0])
        meets = junction.boundary.intersection(part.buffer(2 * TOUCH))
        meets = linemerge(meets) if meets.geom_type == "MultiLineString" else meets
        for piece in shapely.get_parts(meets):
            if piece.length <= NARROW:
                continue
            ends = shapely.get_coordinates(piece)[[0, -1]]
            (x, y), mouth = ends[1] - ends[0], ends.mean(0)
            out = np.array([y, -x]) * (1 if np.dot([y, -x], mouth - middle) >= 0 else -1)
            if (width := float(np.hypot(x, y))) > NARROW:
                found.append(Arm((mouth[0], mouth[1]), float(np.arctan2(out[1], out[0])), width))
    middle = np.array(areas[Region.JUNCTION].centroid.coords or [(0.0, 0.0)])[0]
    away = [np.array(arm.mouth) - middle for arm in found]
    order = np.argsort([np.arctan2(y, x) % (2 * np.pi) for x, y in away])
    return tuple(found[k] for k in order)


def _routes(
    place: Intersection, lines: list[Line], radius: float, source: str
) -> tuple[list[Route], list[tuple[np.ndarray, float]], list[int]]:
    """The vehicles' routes, the lines along which people walk, with their widths, both cut at the
    radius, and the numbers of those that do not come so near."""
    drives, walks, left = list[Route](), list[tuple[np.ndarray, float]](), list[int]()
    mouths = np.array([arm.mouth for arm in place.arms])
    disc = Point(place.center[:2]).buffer(radius, quad_segs=32)
    junction = place.regions[Region.JUNCTION]
    for k, one in enumerate(lines):
        where, points = f"{source}: route {k + 1}", np.asarray(one.line, float)
        check_known(one.user, WIDTHS, f"{where}, user")
        if points.ndim != 2 or points.shape[1] != 2 or len(points) < 2:
            raise InspeError(f"{where}: needs two or more points x, y")
        width = WIDTHS[one.user] if one.width is None else one.width
        if not (np.isfinite(points).all() and 0 < width <= WIDEST):
            raise InspeError(f"{where}: needs finite points, and a width up to {WIDEST:g} m")
        within = [p for p in shapely.get_parts(LineString(points).intersection(disc)) if p.length]
        if not within:
            left.append(k + 1)
            continue
        path = max(within, key=lambda part: (part.intersection(junction).length, part.length))
        line = resampled(shapely.get_coordinates(path))
        if one.user == "pedestrian":
            walks.append((line, width))
            continue
        through = [-1, -1]
        inside = np.flatnonzero(shapely.intersects_xy(junction, *line.T))
        for end, at in enumerate((0, -1)):
            if len(inside) and 0 < inside[at] < len(line) - 1:
                through[end] = int(distance_from(mouths, line[inside[at]]).argmin())
        drives.append(Route(place.on_ground(line), width, "vehicle", (through[0], through[1])))
    return drives, walks, left


# ── GeoJSON ─────────────────────────────────────────────────────────────────


class _Properties(BaseModel):
    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)
    region: str | None = None
    route: Literal["vehicle", "pedestrian"] | None = None
    kind: Literal["pole"] = "pole"
    width_m: Annotated[float, Field(gt=0, le=WIDEST)] | None = None
    name: Any = None


class RegionFile:
    """A GeoJSON file of regions, with the methods of a
    :class:`~inspe_jax.scene.maps.road_map.RoadMap` that readers of maps need. Raises InspeError as
    :func:`~inspe_jax.scene.geojson.read_features`, and where a feature is none of a place."""

    notes: tuple[str, ...] = ()

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self.name = self.path.name.removesuffix(SUFFIX)
        features, _, _ = read_features(path, None)
        if any(one.properties.get("feature") in ("unit", "sensor") for one in features):
            raise InspeError(f"{path}: is a layout: inspe score SCENE {path}")
        rows = [(one, check_model(_Properties, one.properties, one.where)) for one in features]
        at = [shapely.get_coordinates(one.geometry) for one, own in rows if own.region]
        if not at:
            raise InspeError(
                f"{path}: no feature has a property 'region'; as bodies it goes with --bodies, as "
                "a layout with inspe score SCENE"
            )
        lon, lat = np.concatenate(at).mean(0)
        self.georeference = about(lat, lon)
        self.regions: dict[str, list[BaseGeometry]] = {}
        self.lines, self.poles = list[Line](), list[np.ndarray]()
        for one, own in rows:
            self._add(one, own)
        self.junctions = self.regions.get("junction", [])

    def _add(self, one: Feature, own: _Properties) -> None:
        shape = shapely.transform(one.geometry, self.georeference.from_degrees)
        kind = one.geometry.geom_type.removeprefix("Multi")
        if kind == "Polygon" and own.region is not None:
            check_known(own.region, [r.key for r in Region], f"{one.where}.properties: region")
            _check_shape(shape, one.where)
            self.regions.setdefault(own.region, []).extend(shapely.get_parts(shape))
        elif kind == "LineString" and own.route is not None:
            for part in shapely.get_parts(shape):
                self.lines.append(Line(shapely.get_coordinates(part), own.route, own.width_m))
        elif kind == "Point" and own.region is own.route is None:
            self.poles += [*shapely.get_coordinates(shape)]
        else:
            raise InspeError(
                f"{one.where}: polygons have a 'region', lines a 'route', points neither: this "
                f"{kind} does not"
            )

    def road_lines(self) -> list[Float[np.ndarray, "N 2"]]:
        """The lines of its vehicles' routes [m], for drawing."""
        return [one.line for one in self.lines if one.user == "vehicle"]

    def list_junctions(self) -> tuple[JunctionInfo, ...]:
        """Its junctions, numbered from 1."""
        crosswalks = self.regions.get("crosswalk", [])
        found = []
        for k, junction in enumerate(self.junctions):
            x0, y0, x1, y1 = junction.bounds
            size = max(x1 - x0, y1 - y0)
            near = sum(walk.distance(junction) < 8.0 for walk in crosswalks)
            middle = (junction.centroid.x, junction.centroid.y, 0.0)
            drive = unary_union(self.regions.get("driveway", [])).difference(junction)
            arms = _arms({Region.JUNCTION: junction, Region.DRIVEWAY: drive})
            found.append(JunctionInfo(k + 1, middle, len(arms), size, near, 0))
        return tuple(found)

    def read(
        self, junction: int | str | None, center: tuple[float, float] | None, radius: float
    ) -> Intersection:
        """One junction, or all about a ``center``: :func:`intersection_of`."""
        check_choice(junction, center)
        regions = {key: unary_union(shapes) for key, shapes in self.regions.items()}
        where = f"at {center}"
        if center is None:
            ids = range(1, len(self.junctions) + 1)
            number = named_junction(self.path.name, junction, ids)
            middle = self.junctions[number - 1].centroid
            center, where = (middle.x, middle.y), f"junction {number}"
        place = intersection_of(
            regions, self.lines, np.array(self.poles), center=center, radius=radius,
            name=f"{self.name} {where}", source=f"{self.path.name} (regions)",
            georeference=self.georeference,
        )  # fmt: skip
        return replace(place, map=self.path.resolve())
