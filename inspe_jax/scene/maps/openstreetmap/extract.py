"""Reads an OpenStreetMap extract as a stream, and keeps what lies in a box of degrees."""

import gzip
import io
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from inspe_jax.core.errors import error_at

Tags = dict[str, str]
ORDER = ("node", "way", "relation")  # each consists of those before it
Box = tuple[float, float, float, float]  # west, south, east and north in degrees; no date line


class Way(NamedTuple):
    """A way: the nodes that it goes through, and its tags."""

    nodes: tuple[str, ...]
    tags: Tags


class Relation(NamedTuple):
    """A relation: its ways with their roles, and its tags."""

    ways: tuple[tuple[str, str], ...]
    tags: Tags


@dataclass
class Extract:
    """What an extract has in a box, by id: positions (longitude, latitude) of nodes, tags of those
    that have some, ways with a node there, and relations with such a way."""

    nodes: dict[str, tuple[float, float]] = field(default_factory=dict)
    node_tags: dict[str, Tags] = field(default_factory=dict)
    ways: dict[str, Way] = field(default_factory=dict)
    relations: dict[str, Relation] = field(default_factory=dict)


def read_extract(path: Path, area: Box) -> Extract:
    """What an extract has in a box, in memory that grows with that, and not with the file, which is
    read again if it is in another order than :data:`ORDER`. Raises InspeError where it is no
    XML."""
    found = Extract()
    with error_at(f"{path}: not well-formed XML", ET.ParseError, OSError, EOFError):
        for _ in ORDER:
            if _read(path, area, found):
                break
    return found


def _read(path: Path, area: Box, found: Extract) -> bool:
    """Adds a file's elements to what was found. Returns whether each came after its parts."""
    west, south, east, north = area
    behind, sorted_ = ORDER[0], True
    for element in _elements(path):
        kind, name = element.tag, element.get("id", "")
        sorted_ &= ORDER.index(kind) >= ORDER.index(behind)
        behind = kind
        if not name or element.get("action") == "delete" or element.get("visible") == "false":
            continue
        if kind == "node":
            try:
                lon, lat = float(element.attrib["lon"]), float(element.attrib["lat"])
            except (KeyError, ValueError):
                continue
            if west <= lon <= east and south <= lat <= north:
                found.nodes[name] = lon, lat
                if len(element):
                    found.node_tags[name] = _tags(element)
        elif kind == "way":
            nodes = tuple(nd.get("ref", "") for nd in element.iterfind("nd"))
            if any(node in found.nodes for node in nodes):
                found.ways[name] = Way(nodes, _tags(element))
        else:
            members = [m for m in element.iterfind("member") if m.get("type") == "way"]
            ways = tuple((m.get("ref", ""), m.get("role", "")) for m in members)
            if any(way in found.ways for way, _ in ways):
                found.relations[name] = Relation(ways, _tags(element))
    return sorted_


def opened(path: Path) -> io.BufferedIOBase:
    """A file to read, unpacked if it is packed with gzip."""
    return gzip.open(path) if path.name.lower().endswith(".gz") else path.open("rb")


def _elements(path: Path) -> Iterator[ET.Element]:
    """The nodes, ways and relations of a file, one at a time: each is gone when the next comes."""
    with opened(path) as f:
        events = ET.iterparse(f, events=("start", "end"))
        root = next(events)[1]
        for event, element in events:
            if event == "end" and element.tag in ORDER:
                yield element
                root.clear()


def _tags(element: ET.Element) -> Tags:
    return {t.get("k", ""): t.get("v", "") for t in element.iterfind("tag")}
