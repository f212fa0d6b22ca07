"""An OpenDRIVE map: roads and links from its XML, and the course of its lanes from CARLA.

CARLA is left-handed. ``position`` flips its y and ``heading_of`` its yaw, as
:mod:`inspe_jax.core.carla_frame` explains.
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

from inspe_jax.core.errors import InspeError, needs
from inspe_jax.core.files import TEXT, cached_by_file, check_input, check_xml
from inspe_jax.scene.georeference import Georeference, of_open_drive
from inspe_jax.scene.maps.bodies import Shape
from inspe_jax.scene.maps.lane_strips import LaneStrip
from inspe_jax.scene.maps.opendrive.objects import shapes_of
from inspe_jax.scene.maps.parts import STEP, distance_from

TRAFFIC_LIGHT = "1000001"

INSET = 1e-3
"""At the very end of a lane CARLA gives the next lane, so queries stay this much inside [m]."""


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
        """Whether a piece may come within reach: it is nowhere farther from its start than its
        length."""
        away = distance_from(self.pieces, middle)
        return bool((away <= reach + self.pieces[:, 2] + 20.0).any())  # 20 m: half a wide road


@dataclass(frozen=True, eq=False)
class TownMap:
    """A map: CARLA's, and what its XML adds. Positions are world metres (ENU)."""

    source: str
    carla: Any
    roads: dict[int, OpenDriveRoad]
    crosswalks: tuple[np.ndarray, ...]  # outlines, each (K, 3)
    signals: Float[np.ndarray, "P 3"]
    shapes: tuple[Shape, ...] = ()
    georeference: Georeference | None = None
    notes: tuple[str, ...] = ()  # on the shapes and the projection

    def at(self, road: int, lane: int, s: float) -> Any:
        """CARLA's waypoint in the middle of a lane, s [m] along the road; None beyond its ends."""
        return self.carla.get_waypoint_xodr(road, lane, s)

    def along(self, road: int, lane: int, start: float, end: float, spacing: float) -> list[Any]:
        """CARLA's waypoints along a lane from one s to another, about ``spacing`` [m] apart."""
        inset, count = min(INSET, (end - start) / 4), int(np.ceil((end - start) / spacing)) + 1
        stations = np.linspace(start + inset, end - inset, max(2, count)).tolist()
        return [w for s in stations if (w := self.at(road, lane, s)) is not None]

    def box(self, junction: int | str) -> tuple[np.ndarray, float]:
        """Middle (3,) and larger side of a junction's bounding box [m]."""
        for road in self.roads.values():
            if road.junction == junction:
                for lane in road.sections[0][2]:
                    waypoint = self.at(road.id, lane, road.length / 2)
                    if waypoint is not None and waypoint.get_junction() is not None:
                        box = waypoint.get_junction().bounding_box
                        return position(box.location), 2 * max(box.extent.x, box.extent.y)
        raise InspeError(f"{self.source}: junction {junction} has no lanes")


def position(location: Any) -> np.ndarray:
    """CARLA's left-handed location in the world frame (3,) [m]."""
    return np.array([location.x, -location.y, location.z])


@cached_by_file(8)
def load_map(path: Path) -> TownMap:
    """The map of a file, cached while the file does not change.

    Raises InspeError if the CARLA client or the file is missing, or if it is not OpenDRIVE.
    """
    check_input(path, TEXT)
    text = path.read_bytes().decode("utf-8-sig", "replace")
    # Checked here: CARLA skips what it does not know, or aborts.
    check_xml(io.BytesIO(text.encode()), str(path), "OpenDRIVE")
    root = ET.fromstring(text.encode())
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]  # without its namespace
    try:
        roads = {r.id: r for r in map(_road, root.iter("road"))}
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InspeError(f"{path}: not OpenDRIVE: missing or wrong in a road: {error}") from error
    if not roads:
        raise InspeError(f"{path}: the map has no roads")
    where = "Linux and Windows, Python up to 3.12"
    with needs("reading OpenDRIVE needs the CARLA client", "opendrive", where):
        import carla
    try:
        with _quiet():
            parsed = carla.Map(path.stem, text)
            corners = [position(c) for c in parsed.get_crosswalks()]
            marks = [m for m in parsed.get_all_landmarks() if m.type == TRAFFIC_LIGHT]
    except (RuntimeError, IndexError) as error:
        raise InspeError(f"{path}: the CARLA client cannot read this map ({error})") from error
    signals = _deduplicate([position(m.transform.location) for m in marks])
    shapes, notes = shapes_of(root)
    georeference, on_it = _georeference(root)
    crosswalks = tuple(_loops(corners))
    return TownMap(
        path.name, parsed, roads, crosswalks, signals, shapes, georeference, (*notes, *on_it)
    )


def _georeference(root: ET.Element) -> tuple[Georeference | None, list[str]]:
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
def _quiet() -> Iterator[None]:
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


def _loops(corners: list[np.ndarray]) -> Iterator[np.ndarray]:
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


def _deduplicate(points: list[np.ndarray]) -> np.ndarray:
    """Points (P, 3) without those within 0.5 m of an earlier one, because roads share signals."""
    kept: list[np.ndarray] = []
    for point in points:
        if all(np.hypot(*(point - other)[:2]) >= 0.5 for other in kept):
            kept.append(point)
    return np.array(kept).reshape(-1, 3)


def lane_strips_near(town: TownMap, middle: np.ndarray, reach: float) -> list[LaneStrip]:
    """Every lane with a width that comes within ``reach`` [m] of the middle, cut to that reach."""
    found: list[LaneStrip] = []
    for road in town.roads.values():
        if not road.near(middle, reach):
            continue
        for start, end, lanes in road.sections:
            for lane, kind in lanes.items():
                line = town.along(road.id, lane, start, end, STEP)
                if len(line) < 2 or max(w.lane_width for w in line) < 0.05:
                    continue
                center = np.array([position(w.transform.location) for w in line])
                ahead = np.array([heading_of(w) for w in line])
                width = np.array([w.lane_width for w in line])
                strip = LaneStrip.along(road.id, lane, road.junction, kind, center, ahead, width)
                # One lane's width farther, so that the disc cuts the lane, and not its stations.
                found += strip.runs(distance_from(center, middle) <= reach + width.max() + STEP)
    return found
