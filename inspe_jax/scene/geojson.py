"""GeoJSON (RFC 7946) and CSV of points: features in world metres."""

import csv
import io
import os
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import shapely
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict
from shapely.geometry import shape
from shapely.geometry.base import BaseGeometry

from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import check_input, check_model, read_json
from inspe_jax.scene.georeference import Georeference
from inspe_jax.scene.intersection import Intersection

SUFFIXES = (".geojson", ".json")
_DEGREES = ("CRS84", "4326")  # at the end of the name of a coordinate system of degrees


class Feature(NamedTuple):
    """A feature of a file: its geometry in plan, in world metres, and its properties."""

    geometry: BaseGeometry
    properties: dict[str, Any]


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


def georeference_of(place: Intersection) -> Georeference:
    """The projection of a place. Raises InspeError if it has none."""
    if place.georeference is None:
        raise InspeError(
            f"{place.name}: has no coordinates on the Earth; build the scene from a map that has "
            "them: OpenStreetMap, or a network or OpenDRIVE with a projection"
        )
    return place.georeference


def read_features(
    path: str | os.PathLike[str], place: Intersection
) -> tuple[tuple[Feature, ...], dict[str, Any]]:
    """The features of a file in the world metres of a place, and its further members.

    Coordinates are longitudes and latitudes, or those of the projection that an older GeoJSON file
    names in ``crs``. Features without a geometry are left out. A CSV file has a row for each point,
    with columns ``latitude``, ``longitude`` and those of its properties. Raises InspeError if the
    place has no coordinates, the file is no such file, or its coordinates are none.
    """
    lies = georeference_of(place)
    content = _points(Path(path)) if str(path).lower().endswith(".csv") else read_json(Path(path))
    found = check_model(_File, content, str(path))
    to_degrees = None
    if found.crs is not None and not found.crs.properties.name.endswith(_DEGREES):
        other = Georeference(found.crs.properties.name)
        try:
            other.check()
        except InspeError as error:
            raise InspeError(f"{path}: crs: {error}") from None
        to_degrees = other.to_degrees

    def to_world(points: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2"]:
        return lies.from_degrees(points if to_degrees is None else to_degrees(points))

    features = []
    for k, entry in enumerate(found.features):
        if entry.geometry is None:
            continue
        try:
            geometry = shapely.force_2d(shape(entry.geometry))
        except (ValueError, TypeError, KeyError, AttributeError, IndexError,
                shapely.errors.ShapelyError) as error:  # fmt: skip
            raise InspeError(f"{path}: features[{k}].geometry: no geometry: {error}") from error
        moved = shapely.transform(geometry, to_world)
        if not np.isfinite(shapely.get_coordinates(moved)).all():
            at = shapely.get_coordinates(geometry)[0].tolist()
            raise InspeError(
                f"{path}: features[{k}]: {at} is no longitude and latitude; write the file in "
                "WGS 84, as GeoJSON has to be, or name its projection in 'crs'"
            )
        features.append(Feature(moved, entry.properties or {}))
    return tuple(features), found.model_extra or {}


def _points(path: Path) -> dict[str, Any]:
    """A CSV file of points as the content of a GeoJSON file."""
    check_input(path)
    try:
        rows = list(csv.DictReader(io.StringIO(path.read_text("utf-8-sig"))))
    except (UnicodeDecodeError, csv.Error) as error:
        raise InspeError(f"{path}: not CSV: {error}") from error
    features = []
    for k, row in enumerate(rows):
        try:
            at = [float(row.pop(key)) for key in ("longitude", "latitude")]
        except (KeyError, TypeError, ValueError) as error:
            raise InspeError(
                f"{path}: row {k + 1}: needs a number under each of 'latitude' and 'longitude': "
                f"{error}"
            ) from error
        point = {"type": "Point", "coordinates": at}
        own = {key: _number(value) for key, value in row.items() if key and value}
        features.append({"type": "Feature", "geometry": point, "properties": own})
    return {"type": "FeatureCollection", "features": features}


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text
