"""GeoJSON (RFC 7946) and CSV of points: features in world metres, or in degrees."""

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import shapely
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict
from shapely.geometry import shape
from shapely.geometry.base import BaseGeometry

from inspe_jax.core.errors import InspeError, error_at
from inspe_jax.core.files import check_kind, check_model, read_csv, read_json
from inspe_jax.scene.georeference import WGS84, Georeference, wgs84
from inspe_jax.scene.intersection import Intersection

SUFFIX = ".geojson"
_AT = ("longitude", "latitude")  # columns of a CSV file


class Feature(NamedTuple):
    """A feature: its geometry in plan [m], its properties, and where it is in the file."""

    geometry: BaseGeometry
    properties: dict[str, Any]
    where: str


class _Entry(BaseModel):
    model_config = ConfigDict(extra="allow")
    type: Literal["Feature"]
    geometry: dict[str, Any] | None = None
    properties: dict[str, Any] | None = None


class _Named(BaseModel):
    name: str


class _System(BaseModel):
    properties: _Named


class _File(BaseModel):
    model_config = ConfigDict(extra="allow")
    type: Literal["FeatureCollection"]
    features: list[_Entry]
    crs: _System | None = None


def known_georeference(place: Intersection) -> Georeference:
    """The projection of a place. Raises InspeError if it has none."""
    if place.georeference is None:
        raise InspeError(
            f"{place.name}: has no coordinates on the Earth; build the scene from a map that has "
            "them: OpenStreetMap, or a network or OpenDRIVE with a projection"
        )
    return place.georeference


def read_features(
    path: str | os.PathLike[str],
    place: Intersection | None,
    wanted: Callable[[dict[str, Any]], bool] = lambda properties: True,
) -> tuple[tuple[Feature, ...], dict[str, Any], list[int]]:
    """The features of a file in the world metres of a place, or in degrees without one; its further
    members; and the numbers of features without a geometry, which are left out.

    Coordinates are longitudes and latitudes, or those of an older GeoJSON file's ``crs``. A CSV
    file has a row for each point, with columns ``latitude``, ``longitude`` and properties.
    ``wanted`` says by its properties whether a feature is read. Raises InspeError if the place has
    no coordinates, the file is no such file, or a wanted feature has none.
    """
    georeference = None if place is None else known_georeference(place)
    check_kind(Path(path))
    content = _points(Path(path)) if str(path).lower().endswith(".csv") else read_json(Path(path))
    found = check_model(_File, content, str(path))
    system = WGS84 if found.crs is None else found.crs.properties.name

    def to_world(points: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2"]:
        degrees = wgs84(system, points)
        return degrees if georeference is None else georeference.from_degrees(degrees)

    features, bare = [], []
    for k, entry in enumerate(found.features):
        where = f"{path}: features[{k}]"
        properties = {key: v for key, v in (entry.properties or {}).items() if v is not None}
        if not wanted(properties):
            continue
        if entry.geometry is None:
            bare.append(k)
            continue
        try:
            geometry = shapely.force_2d(shape(entry.geometry))
        except (ValueError, TypeError, KeyError, AttributeError, IndexError, OverflowError,
                RecursionError, shapely.errors.ShapelyError) as error:  # fmt: skip
            raise InspeError(f"{where}.geometry: no geometry of GeoJSON") from error
        if geometry.is_empty:
            raise InspeError(f"{where}.geometry: has no coordinates")
        with error_at(f"{path}: crs"):
            moved = shapely.transform(geometry, to_world)
        if not np.isfinite(shapely.get_coordinates(moved)).all():
            at = shapely.get_coordinates(geometry)[0].tolist()
            raise InspeError(
                f"{where}: {at} is no longitude and latitude; write the file in "
                "WGS 84, as GeoJSON has to be, or name its projection in 'crs'"
            )
        features.append(Feature(moved, properties, where))
    return tuple(features), found.model_extra or {}, bare


def _points(path: Path) -> dict[str, Any]:
    """A CSV file of points as the content of a GeoJSON file."""
    features = []
    for k, row in enumerate(read_csv(path)):
        try:
            at = [float(row[key]) for key in _AT]
        except (KeyError, TypeError, ValueError) as error:
            raise InspeError(
                f"{path}: row {k + 1}: needs a number under each of 'latitude' and 'longitude'; "
                f"columns are {', '.join(row)}"
            ) from error
        point = {"type": "Point", "coordinates": at}
        own = {key: _number(v) for key, v in row.items() if v and key not in _AT}
        features.append({"type": "Feature", "geometry": point, "properties": own})
    return {"type": "FeatureCollection", "features": features}


def _number(text: str) -> float | str:
    with suppress(ValueError):
        return float(text)
    return text
