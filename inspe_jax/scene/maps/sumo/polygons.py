"""SUMO's polygon files (.poly.xml), as polyconvert writes them: what of them hides something."""

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from shapely.geometry import LineString, Point, Polygon

from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import check_input, check_xml
from inspe_jax.scene.geojson import Feature, known_georeference
from inspe_jax.scene.intersection import Intersection
from inspe_jax.scene.maps.openstreetmap.sizes import Sizes
from inspe_jax.scene.maps.sumo.network import NET_SUFFIXES, OSM_SUFFIXES, load_net

SUFFIX = ".poly.xml"
TYPES = {
    "building": "building",
    "barrier.wall": "wall",
    "barrier.hedge": "hedge",
    "natural.tree": "tree",
    "highway.street_lamp": "pole",
    "power.pole": "pole",
    "man_made.mast": "pole",
}
"""The kind of body of each type, which may go on after a point, as ``building.house``."""


def polygons_of(path: Path, place: Intersection) -> tuple[Feature, ...]:
    """The polygons and points of a file that are bodies, in the world metres of a place.

    Heights are those of parameters ``height`` and ``building:levels``, which polyconvert writes
    with ``--all-attributes``. Other types are left out. Raises InspeError if the place is not of a
    network that the coordinates could be of, or the file is no polygon file.
    """
    check_input(path)
    with path.open("rb") as f:
        check_xml(f, str(path), "additional")
    root = ET.parse(path).getroot()
    sizes, found = Sizes(), []
    for element in root:
        kind = _kind(element)
        if kind is None:
            continue
        where = f"{path}: <{element.tag}> '{element.get('id', '')}'"
        degrees = element.get("geo") in ("1", "true") or "lon" in element.attrib
        try:
            if element.tag == "poi":
                keys = ("lon", "lat") if degrees else ("x", "y")
                rows = [[element.attrib[key] for key in keys]]
            else:
                rows = [point.split(",")[:2] for point in element.attrib["shape"].split()]
            points = np.array(rows, float).reshape(-1, 2)
        except (KeyError, ValueError) as error:
            raise InspeError(f"{where}: a coordinate is missing or no number: {error}") from error
        at = _world(points, degrees, place, path)
        properties: dict[str, Any] = {"kind": kind}
        tags = {one.get("key", ""): one.get("value", "") for one in element.iterfind("param")}
        if kind == "building":
            of = element.get("type", "").partition(".")[2]
            base, height = sizes.heights(tags, tags.get("building", of))
            properties |= dict(base_m=base, height_m=height)
        elif (given := sizes.length(tags, "height")) is not None:
            properties["height_m"] = given
        closed = len(at) > 3 and (at[0] == at[-1]).all()
        if len(at) == 1 or closed or kind != "building":
            shape = Point(at[0]) if len(at) == 1 else Polygon(at) if closed else LineString(at)
            found.append(Feature(shape, properties, where))
    return tuple(found)


def _kind(element: ET.Element) -> str | None:
    """The kind of body of an element; None if it is none."""
    if element.tag not in ("poly", "poi"):
        return None
    own = element.get("type", "")
    return next((kind for name, kind in TYPES.items() if f"{own}.".startswith(f"{name}.")), None)


def _world(
    points: Float[np.ndarray, "N 2"], degrees: bool, place: Intersection, path: Path
) -> Float[np.ndarray, "N 2"]:
    if degrees:
        return known_georeference(place).from_degrees(points)
    if place.map is None or not str(place.map).lower().endswith((*NET_SUFFIXES, *OSM_SUFFIXES)):
        raise InspeError(
            f"{path}: is in the coordinates of a SUMO network; build the scene from that network "
            "or its OpenStreetMap extract, or write the file with --proj.plain-geo"
        )
    return load_net(place.map).to_world(points)[:, :2]
