"""An OpenDRIVE map: roads and links from its XML, and what CARLA says in the world frame.

CARLA is left-handed: ``position`` flips its y, ``heading_of`` its yaw.
"""

import io
import os
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from inspe_jax.core.errors import InspeError, error_at
from inspe_jax.core.files import TEXT, check_input, check_xml
from inspe_jax.scene.georeference import Georeference, of_open_drive
from inspe_jax.scene.lines import distance_from

INSET = 1e-3  # at the very end of a lane CARLA gives the next lane: queries stay inside [m]


@dataclass(frozen=True, eq=False)
class OpenDriveRoad:
    """A road of the XML: the start of each piece, its lanes by section, and its links."""

    id: int
    junction: int  # −1 outside junctions
    length: float
    pieces: Float[np.ndarray, "K 3"]  # x, y where each planView piece starts, and its length
    sections: tuple[tuple[float, float, dict[int, str]], ...]  # from s, to s, lane id → type
    links: dict[str, tuple[str, int, str]]  # 'start'/'end' → ('road'/'junction', id, contact)

    def near(self, middle: np.ndarray, reach: float) -> bool:
        """Whether a piece, nowhere farther from its start than its length, may come in reach."""
        away = distance_from(self.pieces, middle)
        return bool((away <= reach + self.pieces[:, 2] + 20.0).any())  # 20 m: half a wide road


def position(location: Any) -> np.ndarray:
    """CARLA's left-handed location in the world frame (3,) [m]."""
    return np.array([location.x, -location.y, location.z])


def read_roads(path: Path) -> tuple[str, ET.Element, dict[int, OpenDriveRoad]]:
    """The text of a map, its elements without namespaces, and its roads by id. Raises InspeError if
    it is not OpenDRIVE."""
    check_input(path, TEXT)
    text = path.read_bytes().decode("utf-8-sig", "replace")
    # Checked here: CARLA skips what it does not know, or aborts.
    check_xml(io.BytesIO(text.encode()), str(path), "OpenDRIVE")
    root = ET.fromstring(text.encode())
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    wrong = f"{path}: not OpenDRIVE: missing or wrong in a road"
    with error_at(wrong, AttributeError, KeyError, TypeError, ValueError):
        roads = {r.id: r for r in map(_road, root.iter("road"))}
    if not roads:
        raise InspeError(f"{path}: the map has no roads")
    return text, root, roads


def projection_of(root: ET.Element) -> tuple[Georeference | None, list[str]]:
    """The projection that the header names, if it can be used, and a note if it cannot."""
    # The header's offset leads from the roads' coordinates, here the world's, to the projection's.
    offset = root.find("header/offset")
    try:
        given = {} if offset is None else offset.attrib
        x, y, turn = (float(given.get(key, 0.0)) for key in ("x", "y", "hdg"))
        found = of_open_drive(root.findtext("header/geoReference", ""), (-x, -y))
        if found is not None:
            if turn:
                raise InspeError(f"an offset that turns by {turn:g} rad is not read")
            found.check()
    except (InspeError, ValueError) as error:
        return None, [f"no coordinates: the map's projection: {error}"]
    return found, []


def _road(element: ET.Element) -> OpenDriveRoad:
    length = float(element.attrib["length"])
    sections = element.findall("lanes/laneSection")
    bounds = [float(s.attrib["s"]) for s in sections] + [length]
    lanes = [
        {int(x.attrib["id"]): x.attrib["type"] for x in s.iter("lane") if x.get("id") != "0"}
        for s in sections
    ]
    links = {}
    for end, tag in (("start", "predecessor"), ("end", "successor")):
        link = element.find(f"link/{tag}")
        if link is not None:
            kind, contact = link.attrib["elementType"], link.get("contactPoint", "")
            links[end] = (kind, int(link.attrib["elementId"]), contact)
    pieces = [[float(g.attrib[k]) for k in ("x", "y", "length")] for g in element.iter("geometry")]
    return OpenDriveRoad(
        int(element.attrib["id"]),
        int(element.get("junction", -1)),
        length,
        np.array(pieces).reshape(-1, 3),
        tuple(zip(bounds, bounds[1:], lanes, strict=False)),
        links,
    )


@contextmanager
def quiet() -> Iterator[None]:
    """Silence C++ code, which writes to the file descriptors and not to ``sys.stderr``."""
    kept = {fd: os.dup(fd) for fd in (1, 2)}
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        for fd in kept:
            os.dup2(null, fd)
        yield
    finally:
        for fd, copy in kept.items():
            os.dup2(copy, fd)
            os.close(copy)
        os.close(null)


def loops_of(corners: list[np.ndarray]) -> Iterator[np.ndarray]:
    """Crosswalk outlines from CARLA's list of corners; an outline ends where it meets its start."""
    loop: list[np.ndarray] = []
    for corner in corners:
        if loop and np.allclose(corner, loop[0], atol=1e-3):
            if len(loop) > 2:
                yield np.array(loop)
            loop = []
        else:
            loop.append(corner)


def heading_of(waypoint: Any) -> np.ndarray:
    """Unit vector along a waypoint's lane in the world frame (2,)."""
    yaw = -np.radians(waypoint.transform.rotation.yaw)
    return np.array([np.cos(yaw), np.sin(yaw)])


def distinct_points(points: list[np.ndarray]) -> np.ndarray:
    """Points (P, 3) without those within 0.5 m of an earlier one, because roads share signals."""
    kept: list[np.ndarray] = []
    for point in points:
        if all(np.hypot(*(point - other)[:2]) >= 0.5 for other in kept):
            kept.append(point)
    return np.array(kept).reshape(-1, 3)
