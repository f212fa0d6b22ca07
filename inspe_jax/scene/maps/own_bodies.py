"""Bodies of one's own from files: GeoJSON, CSV, and SUMO's polygons."""

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import shapely
from pydantic import BaseModel, ConfigDict, Field
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry

from inspe_jax.core.errors import InspeError, check_known
from inspe_jax.core.files import check_model
from inspe_jax.scene.geojson import read_features
from inspe_jax.scene.intersection import Intersection
from inspe_jax.scene.maps.bodies import Shape, with_bodies
from inspe_jax.scene.maps.sumo.polygons import SUFFIX, polygons_of
from inspe_jax.scene.maps.usual_sizes import BARRIERS, BUILDING, FURNITURE, POLE, TREE, TREE_BASE
from inspe_jax.scene.statics import HIGHEST, KINDS, LEAFY, octagon

PARKED = 1.5
"""Height of a parked vehicle of which the file says none [m]."""
HEIGHTS = {
    "building": BUILDING,
    "wall": BARRIERS["wall"][0],
    "hedge": BARRIERS["hedge"][0],
    "tree": TREE["height"],
    "pole": POLE[0],
    "furniture": FURNITURE,
    "parked vehicle": PARKED,
}
"""Height of each kind of body of which the file says none [m]."""
USUAL = {"Polygon": "building", "LineString": "wall", "Point": "pole"}
"""The kind of body of a geometry of which the file says none."""

_Metres = Annotated[float, Field(gt=0, le=HIGHEST)]


class _Body(BaseModel):
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
    :data:`~inspe_jax.scene.statics.KINDS`, ``height_m``, ``base_m``, ``width_m`` of a line,
    ``diameter_m`` of a point, and ``transmittance``. What is missing is usual
    (:data:`USUAL`, :data:`HEIGHTS`). Of SUMO's polygons (.poly.xml) it is what
    :func:`~inspe_jax.scene.maps.sumo.polygons.polygons_of` finds. Poles can carry sensors. What is
    in the way of traffic is cut off, as of a map's bodies.

    Raises InspeError as :func:`~inspe_jax.scene.geojson.read_features`, if a property is wrong, and
    if nothing is so near.
    """
    if str(path).lower().endswith(SUFFIX):
        features = polygons_of(Path(path), place)
    else:
        features, _ = read_features(path, place)
    shapes = [
        made
        for k, one in enumerate(features)
        for made in _shapes(
            one.geometry, check_model(_Body, one.properties, f"{path}: features[{k}].properties"),
            f"{path}: features[{k}]",
        )
    ]  # fmt: skip
    if not shapes:
        raise InspeError(f"{path}: has no features")
    middle = shapely.Point(place.center[:2])
    nearest = min(middle.distance(one.area) for one in shapes)
    if nearest > reach:
        raise InspeError(
            f"{path}: nothing within {reach:g} m of {place.name}: the nearest is {nearest:,.0f} m "
            "away; coordinates are a longitude and then a latitude"
        )
    notes: list[str] = []
    found = with_bodies(replace(place, bodies=()), shapes, reach, notes)
    words = (f"{os.path.basename(path)}: {note.replace('of the map ', '')}" for note in notes)
    return replace(found, bodies=(*place.bodies, *found.bodies), notes=(*place.notes, *words))


def _shapes(geometry: BaseGeometry, own: _Body, where: str) -> Iterator[Shape]:
    """The bodies of one feature."""
    for part in shapely.get_parts(geometry):
        if part.geom_type not in USUAL or part.is_empty:
            raise InspeError(f"{where}: a {part.geom_type} is no body: {', '.join(USUAL)}")
        kind = own.kind or USUAL[part.geom_type]
        check_known(kind, KINDS, f"{where}: kind")
        height, base = own.height_m or HEIGHTS[kind], own.base_m
        if base >= height:
            raise InspeError(f"{where}: base_m {base:g} m must be below height_m {height:g} m")
        trunk, through = 0.0, own.transmittance
        if kind == "tree":
            lowest, share = TREE_BASE
            base = base or min(lowest, share * height)
            trunk = TREE["circumference"] / (2 * np.pi)
            through = LEAFY if through is None else through
        area = part
        if part.geom_type == "LineString":
            usual = BARRIERS["hedge" if kind == "hedge" else "wall"][1]
            area = part.buffer((own.width_m or usual) / 2, cap_style="flat", join_style="mitre")
        elif part.geom_type == "Point":
            usual = TREE["diameter_crown"] if kind == "tree" else 2 * POLE[1]
            radius = (own.diameter_m or usual) / 2
            area, trunk = Polygon(octagon(part.coords[0], radius)), min(trunk, radius / 2)
        yield Shape(kind, area, height, base, through or 0.0, trunk)
