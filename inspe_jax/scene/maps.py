"""Maps of every kind, by the file's name: OpenDRIVE, SUMO's networks, OpenStreetMap."""

import os

from inspe_jax.scene.intersection import Intersection
from inspe_jax.scene.map_parts import JunctionInfo
from inspe_jax.scene.sumo_net import NET_SUFFIXES, OSM_SUFFIXES

MAP_SUFFIXES = (".xodr", *NET_SUFFIXES, *OSM_SUFFIXES)
"""How the names of map files end."""


def is_map(path: str | os.PathLike[str]) -> bool:
    """Whether a file's name is that of a map."""
    return str(path).lower().endswith(MAP_SUFFIXES)


def list_junctions(path: str | os.PathLike[str]) -> tuple[JunctionInfo, ...]:
    """The junctions of a map. Raises InspeError as :func:`read_map`."""
    if str(path).lower().endswith(".xodr"):
        from inspe_jax.scene import opendrive

        return opendrive.list_junctions(path)
    from inspe_jax.scene import sumo

    return sumo.list_junctions(path)


def read_map(
    path: str | os.PathLike[str],
    *,
    junction: str | int | None = None,
    center: tuple[float, float] | None = None,
    radius: float = 50.0,
) -> Intersection:
    """One junction of a map and its surroundings, by its id or a centre (x, y) [m].

    See :func:`~inspe_jax.scene.opendrive.read_opendrive` and
    :func:`~inspe_jax.scene.sumo.read_sumo`, which also say what errors they raise.
    """
    if str(path).lower().endswith(".xodr"):
        from inspe_jax.scene.opendrive import read_opendrive

        return read_opendrive(path, junction=junction, center=center, radius=radius)
    from inspe_jax.scene.sumo import read_sumo

    return read_sumo(path, junction=junction, center=center, radius=radius)
