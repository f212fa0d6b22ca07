"""Bodies of one's own from GeoJSON and CSV files."""

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
import shapely
from pydantic import BaseModel, ConfigDict, Field
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry

from inspe_jax.core.errors import InspeError, check_known
from inspe_jax.core.files import check_model
from inspe_jax.scene.geojson import Feature, read_features
from inspe_jax.scene.intersection import Intersection
from inspe_jax.scene.maps import bodies
from inspe_jax.scene.maps.bodies import Shape
from inspe_jax.scene.statics import HIGHEST, LEAFY, octagon

LARGE = 10.0  # what lies this much beyond the reach may still come into it, as a crown [m]
NAMED = 20  # most poles that are named because they are left out
USUAL = {"Polygon": "building", "LineString": "wall", "Point": "pole"}
"""The kind of body of a geometry of which the file says none."""
SAME = {"street_lamp": "pole", "lamp_post": "pole"}  # OpenStreetMap's and others' words for kinds

_Metres = Annotated[float, Field(gt=0, le=HIGHEST)]


class _Properties(BaseModel):
    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)
    kind: str | None = None
    height_m: _Metres | None = None
    base_m: Annotated[float, Field(ge=0, le=HIGHEST)] = 0.0
    width_m: _Metres | None = None
    diameter_m: _Metres | None = None
    transmittance: Annotated[float, Field(ge=0, le=1)] | None = None


def with_own_bodies(
    place: Intersection, path: str | os.PathLike[str], reach: float
) -> Intersection:
    """A place with the bodies of a file besides its own, within ``reach`` [m] of its centre.

    Polygons, lines and points; properties are ``kind``, one of
    :data:`~inspe_jax.scene.maps.bodies.HEIGHTS`, ``height_m``, ``base_m``, ``width_m`` of a line,
    ``diameter_m`` of a point, and ``transmittance``; what is missing is usual. They are treated as
    a map's: :func:`~inspe_jax.scene.maps.bodies.with_bodies`. Raises InspeError as
    :func:`~inspe_jax.scene.geojson.read_features`, if a property is wrong, and if nothing is near.
    """
    features, _, bare = read_features(path, place)
    if not features:
        raise InspeError(f"{path}: has no features that are bodies")
    away = shapely.distance([one.geometry for one in features], shapely.Point(place.center[:2]))
    if away.min() > reach + LARGE:
        raise InspeError(
            f"{path}: nothing within {reach:g} m of {place.name}: the nearest is "
            f"{away.min():,.0f} m away; coordinates are a longitude and then a latitude"
        )
    near = [one for one, far in zip(features, away, strict=True) if far <= reach + LARGE]
    shapes = list(_once(made for one in near for made in _shapes(one)))
    notes: list[str] = []
    found = bodies.with_bodies(replace(place, bodies=()), shapes, reach, notes)
    poles = [one.polygon for one in found.bodies if one.kind == "pole"]
    kept = tuple(
        one
        for one in place.bodies
        if one.kind != "pole" or not shapely.dwithin(poles, one.polygon, bodies.SAME_POLE).any()
    )
    if len(near) < len(features):
        far = f"{len(features) - len(near)} of {len(features)} features"
        notes.append(f"{far} are farther than {reach:g} m: left out")
    if bare:
        notes.append(f"features without a geometry: {', '.join(map(str, bare[:NAMED]))}: left out")
    lost = list(_poles_left_out(features, poles, place, reach))
    notes += lost[:NAMED]
    notes += [f"and {len(lost) - NAMED:,} more poles: left out"] if len(lost) > NAMED else []
    words = [f"{os.path.basename(path)}: {note.replace('of the map ', '')}" for note in notes]
    before = tuple(note for note in place.notes if note != bodies.NO_POLES or not len(found.poles))
    return replace(found, bodies=(*kept, *found.bodies), notes=(*before, *words))


def _poles_left_out(
    features: Sequence[Feature], poles: list[Polygon], place: Intersection, reach: float
) -> Iterator[str]:
    """A line for each pole of the file that is not among ``poles``: its name or number, and why."""
    for one in features:
        kind = _kind_of(one.properties.get("kind"), one.geometry)
        if kind != "pole" or shapely.dwithin(poles, one.geometry, bodies.SAME_POLE).any():
            continue
        away = one.geometry.distance(shapely.Point(place.center[:2]))
        far = f"{away:.0f} m from the centre, farther than {reach:g} m"
        name = one.properties.get("name") or one.where.rpartition(": ")[2]
        why = far if away > reach else "on lanes, crossings or footpaths"
        yield f"pole {name}: left out: {why}"


def _kind_of(given: Any, geometry: BaseGeometry) -> Any:
    return SAME.get(str(given), given) or USUAL.get(geometry.geom_type)


def _once(shapes: Iterable[Shape]) -> Iterator[Shape]:
    feet: list[BaseGeometry] = []
    for one in shapes:
        if one.kind != "pole" or not shapely.dwithin(feet, one.area, bodies.SAME_POLE).any():
            feet += [one.area] * (one.kind == "pole")
            yield one


def _shapes(one: Feature) -> Iterator[Shape]:
    where, own = one.where, check_model(_Properties, one.properties, f"{one.where}.properties")
    for part in shapely.get_parts(shapely.get_parts(one.geometry)):
        if part.geom_type not in USUAL or part.is_empty:
            raise InspeError(f"{where}: a {part.geom_type} is no body: {', '.join(USUAL)}")
        kind = _kind_of(own.kind, part)
        check_known(kind, bodies.HEIGHTS, f"{where}: kind")
        height, base = own.height_m or bodies.HEIGHTS[kind], own.base_m
        if base >= height:
            raise InspeError(f"{where}: base_m {base:g} m must be below height_m {height:g} m")
        trunk, through = 0.0, own.transmittance
        if kind == "tree":
            base = base or bodies.crown_base(height)
            trunk = bodies.TREE["circumference"] / (2 * np.pi)
            through = LEAFY if through is None else through
        area = part
        if part.geom_type == "LineString":
            usual = bodies.BARRIERS["hedge" if kind == "hedge" else "wall"][1]
            area = part.buffer((own.width_m or usual) / 2, cap_style="flat", join_style="mitre")
        elif part.geom_type == "Point":
            usual = bodies.TREE["diameter_crown"] if kind == "tree" else 2 * bodies.POLE[1]
            radius = (own.diameter_m or usual) / 2
            area, trunk = Polygon(octagon(part.coords[0], radius)), min(trunk, radius / 2)
        yield Shape(kind, area, height, base, through or 0.0, trunk)
