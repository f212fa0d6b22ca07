"""The registry of map formats: OpenDRIVE, SUMO networks and OpenStreetMap.

To add a format, write a module that reads it and add its row to :data:`FORMATS`.
"""

import os
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from inspe_jax.core.errors import InspeError
from inspe_jax.scene.intersection import Intersection
from inspe_jax.scene.maps.parts import JunctionInfo
from inspe_jax.scene.maps.sumo.network import NET_SUFFIXES, OSM_SUFFIXES


@dataclass(frozen=True)
class MapFormat:
    """A format of map files.

    ``suffixes`` are those of its files, in lower case. ``module`` has a function
    ``list_junctions(path)`` and one with the name ``reader``, which is called as :func:`read_map`.
    It is imported on first use, because it may need a package of an extra.
    """

    name: str
    suffixes: tuple[str, ...]
    module: str
    reader: str

    def call(self, function: str, *given: Any, **options: Any) -> Any:
        """Call a function of the module."""
        return getattr(import_module(self.module), function)(*given, **options)


FORMATS = [
    MapFormat(
        "OpenDRIVE", (".xodr",), "inspe_jax.scene.maps.opendrive.reader", reader="read_opendrive"
    ),
    MapFormat(
        "SUMO network or OpenStreetMap",
        (*NET_SUFFIXES, *OSM_SUFFIXES),
        "inspe_jax.scene.maps.sumo.reader",
        reader="read_sumo",
    ),
]
"""The formats. The first that fits a file's name reads it."""


def map_suffixes() -> tuple[str, ...]:
    """The suffixes of map files."""
    return tuple(suffix for row in FORMATS for suffix in row.suffixes)


def is_map(path: str | os.PathLike[str]) -> bool:
    """Whether a file's name has the suffix of a map."""
    return str(path).lower().endswith(map_suffixes())


def _format_of(path: str | os.PathLike[str]) -> MapFormat:
    """The format of a file by its name. Raises InspeError if no format has that name."""
    name = str(path).lower()
    for row in FORMATS:
        if name.endswith(row.suffixes):
            return row
    raise InspeError(f"{path}: not a map: its name must end in {', '.join(map_suffixes())}")


def list_junctions(path: str | os.PathLike[str]) -> tuple[JunctionInfo, ...]:
    """The junctions of a map. Raises InspeError as :func:`read_map`."""
    return _format_of(path).call("list_junctions", path)


def read_map(
    path: str | os.PathLike[str],
    *,
    junction: str | int | None = None,
    center: tuple[float, float] | None = None,
    radius: float = 50.0,
) -> Intersection:
    """One junction of a map and its surroundings, by its id or a centre (x, y) [m].

    See :func:`~inspe_jax.scene.maps.opendrive.reader.read_opendrive` and
    :func:`~inspe_jax.scene.maps.sumo.reader.read_sumo`, which also say what errors they raise.
    """
    row = _format_of(path)
    return row.call(row.reader, path, junction=junction, center=center, radius=radius)
