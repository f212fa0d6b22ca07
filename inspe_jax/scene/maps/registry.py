"""The registry of map formats. To add one, write a module that reads it and a row of
:data:`FORMATS`."""

import os
from pkgutil import resolve_name

import numpy as np

from inspe_jax.core.errors import InspeError, check_known
from inspe_jax.scene.geojson import SUFFIX as GEOJSON
from inspe_jax.scene.intersection import Intersection
from inspe_jax.scene.maps.road_map import JunctionInfo, RoadMap
from inspe_jax.scene.maps.sumo.network import NET_SUFFIXES, OSM_SUFFIXES, SIDES

FORMATS: dict[tuple[str, ...], str] = {
    (".xodr",): "inspe_jax.scene.maps.opendrive.reader:load_map",
    (*NET_SUFFIXES, *OSM_SUFFIXES): "inspe_jax.scene.maps.sumo.reader:load_net",
    (GEOJSON,): "inspe_jax.scene.maps.own_regions:RegionFile",
}
"""For the suffixes of files, in lower case, a module and in it what opens such a file as
a :class:`~inspe_jax.scene.maps.road_map.RoadMap`, or as what has the same ``georeference``,
``list_junctions``, ``road_lines`` and ``read``. The first row that fits a name opens it. Modules
are imported on first use: they may need an extra."""
FAR = 100.0  # a junction farther than this from a point is not the one that is meant [m]


def is_map(path: str | os.PathLike[str]) -> bool:
    """Whether a file's name has the suffix of a map."""
    return any(str(path).lower().endswith(suffixes) for suffixes in FORMATS)


def check_side(path: str | os.PathLike[str], driving_side: str | None) -> None:
    """Raise InspeError for neither ``left`` nor ``right``, or a map that says itself on which side
    traffic drives; None is that of the map or its country."""
    if driving_side is not None:
        if not str(path).lower().endswith(OSM_SUFFIXES):
            raise InspeError(f"{path}: only OpenStreetMap takes a driving side; leave it out")
        check_known(driving_side, SIDES, f"{path}: driving side")


def open_map(path: str | os.PathLike[str], driving_side: str | None = None) -> RoadMap:
    """The map of a file; ``driving_side`` as in :func:`read_map`. Raises InspeError if an extra or
    the file is missing, if the file is not a map, or as :func:`check_side`."""
    check_side(path, driving_side)
    for suffixes, reader in FORMATS.items():
        if str(path).lower().endswith(suffixes):
            return resolve_name(reader)(path, *(() if driving_side is None else (driving_side,)))
    known = ", ".join(suffix for suffixes in FORMATS for suffix in suffixes)
    raise InspeError(f"{path}: not a map: its name must end in {known}")


def list_junctions(
    path: str | os.PathLike[str], driving_side: str | None = None
) -> tuple[JunctionInfo, ...]:
    """The junctions of a map, ``driving_side`` as in :func:`read_map`. Raises as :func:`open_map`.

    >>> [(one.id, one.arms) for one in inspe_jax.list_junctions("crossroads.xodr")]
    [(100, 4)]
    """
    return open_map(path, driving_side).list_junctions()


def junction_at(
    path: str | os.PathLike[str], lat: float, lon: float, driving_side: str | None = None
) -> JunctionInfo:
    """The junction of a map that is nearest to a latitude and longitude.

    Args:
        path: File of one of the :data:`FORMATS`.
        lat, lon: Latitude and longitude [degrees].
        driving_side: As in :func:`read_map`.

    Raises:
        InspeError: The map has no projection, every junction is farther than :data:`FAR`, or as
            :func:`read_map`.
    """
    whole = open_map(path, driving_side)
    georeference = whole.georeference
    if georeference is None:
        raise InspeError(
            f"{path}: the map does not say where on the Earth it is: choose a place with "
            "--junction ID or --center X Y; --list shows the junctions"
        )
    if not (abs(lat) <= 90 and abs(lon) <= 180):
        raise InspeError(f"{lat:g},{lon:g}: a latitude of -90 to 90, and then a longitude")
    at = georeference.from_degrees(np.array([[lon, lat]]))[0]
    found = whole.list_junctions()
    away = [float(np.hypot(*(np.array(one.center[:2]) - at))) for one in found]
    if not found:
        raise InspeError(f"{path}: the map has no junction")
    if not min(away) <= FAR:
        middle = georeference.to_degrees(np.mean([one.center[:2] for one in found], 0)[None])[0]
        raise InspeError(
            f"{path}: no junction within {FAR:g} m of {lat:g},{lon:g}; the middle of the map's "
            f"junctions is at {middle[1]:.5f},{middle[0]:.5f} (latitude, longitude)"
        )
    return found[int(np.argmin(away))]


def read_map(
    path: str | os.PathLike[str],
    *,
    junction: str | int | None = None,
    center: tuple[float, float] | None = None,
    radius: float = 50.0,
    driving_side: str | None = None,
) -> Intersection:
    """One junction of a map and its surroundings, in world metres (ENU).

    Coordinates are those of the map; of a network, those of the map that it was made from. Lanes
    are read to ``radius`` + 10 m, but none on another level. OpenStreetMap extracts and OpenDRIVE
    bring their bodies, and extracts the ground between points that have a height (``ele``).

    Args:
        path: File of one of the :data:`FORMATS`.
        junction: Id of a junction of OpenDRIVE, or of a node of a network.
        center: (x, y) [m] in place of an id. All junctions within 35 m count as one.
        radius: Routes begin and end there [m].
        driving_side: ``left`` or ``right`` for an OpenStreetMap extract, in place of its country's.

    Raises:
        InspeError: An extra or the file is missing, the file is not a map, or it has no such
            junction or no road near.

    >>> place = inspe_jax.read_map("crossroads.xodr", junction=100, radius=40)
    >>> place.name, len(place.arms)
    ('crossroads junction 100', 4)
    """
    return open_map(path, driving_side).read(junction, center, radius)
