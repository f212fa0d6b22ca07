"""The roads of an OpenDRIVE map (1.4 to 1.8), of its XML."""

import io
import xml.etree.ElementTree as ET
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import TEXT, check_input, check_kind, check_xml
from inspe_jax.scene.georeference import Georeference, of_open_drive
from inspe_jax.scene.lines import distance_from
from inspe_jax.scene.maps.opendrive.geometry import (
    LONGEST,
    Crossfall,
    Cubics,
    ReferenceLine,
    number,
)
from inspe_jax.scene.maps.road_map import FAR, Id

INSET = 1e-3  # lanes and offsets may jump at the ends of sections: cuts stay inside [m]
HEIGHTS = (("inner", "heightInner"), ("outer", "heightOuter"))  # of a lane, and as some write it
UTF_16 = (b"\xff\xfe", b"\xfe\xff")
WIDEST = 200.0  # no lane is so wide, and none so far from its road's line [m]
HIGHEST = 1e4  # no road is so high [m]
FALL = 5.0  # no road's surface is so far from level across [m]


class Lane(NamedTuple):
    """A lane of a section: ``onward`` if its traffic runs with s, ``level`` if it does not tilt
    with its road, ``edge`` its width, or where its outer edge is if ``is_border``, ``heights`` rows
    of where and how high its two edges are over the road [m], ``links`` from 'start' and 'end'."""

    kind: str
    onward: bool
    level: bool
    edge: Cubics
    is_border: bool
    heights: Float[np.ndarray, "H 3"]
    links: dict[str, list[int]]


class Section(NamedTuple):
    """A stretch of a road [m], and its lanes by id, from the middle outwards."""

    start: float
    end: float
    lanes: dict[int, Lane]


class LaneCut(NamedTuple):
    """A lane's middle line, inner and outer edge, and width [m] at stations."""

    middle: Float[np.ndarray, "N 3"]
    inner: Float[np.ndarray, "N 3"]
    outer: Float[np.ndarray, "N 3"]
    width: Float[np.ndarray, " N"]


@dataclass(frozen=True, eq=False)
class OpenDriveRoad:
    """A road: ``links`` are 'start'/'end' → ('road'/'junction', id, contact)."""

    id: Id
    name: str
    junction: Id  # −1 outside junctions
    length: float
    line: ReferenceLine
    elevation: Cubics
    superelevation: Cubics
    crossfall: Crossfall
    offset: Cubics
    sections: tuple[Section, ...]
    links: dict[str, tuple[str, Id, str]]

    @classmethod
    def of(cls, element: ET.Element) -> "OpenDriveRoad":
        """That of an element. Raises ValueError where something is missing or wrong in it."""
        length, left_hand = number(element, "length"), element.get("rule") == "LHT"
        if not 0 < length < LONGEST:
            raise ValueError(f"length of <road> is {length:g}")
        found = sorted(element.iterfind("lanes/laneSection"), key=lambda one: number(one, "s"))
        if any(one.get("singleSide") in ("true", "1") for one in found):
            raise ValueError("a <laneSection> of a single side")
        bounds = [*(number(one, "s") for one in found), length]
        sections = tuple(
            Section(start, end, _lanes(one, left_hand, end - start))
            for one, (start, end) in zip(found, pairwise(bounds), strict=True)
            if end > start
        )
        if not sections:
            raise ValueError("no <laneSection> in it")
        links = {}
        for end, tag in (("start", "predecessor"), ("end", "successor")):
            if (link := element.find(f"link/{tag}")) is not None:
                kind, other = link.get("elementType", "road"), identity(link.get("elementId", ""))
                contact = link.get("contactPoint", "")
                if kind == "road" and contact not in ("start", "end") and not link.get("elementS"):
                    given = f"is '{contact[:40]}'" if contact else "is missing"
                    raise ValueError(f"contactPoint of its <{tag}> {given}; write start or end")
                links[end] = (kind, other, contact)
        offset = Cubics(element.iterfind("lanes/laneOffset"))
        elevation = Cubics(element.iterfind("elevationProfile/elevation"))
        for cubics, most in ((offset, WIDEST), (elevation, HIGHEST)):
            if abs(cubics(np.linspace(0.0, length, 9))).max() > most:
                raise ValueError(f"its lane offset or elevation is over {most:g} m")
        fall = Crossfall(element.iterfind("lateralProfile/shape"))
        road = cls(
            identity(element.get("id", "")),
            element.get("name", ""),
            identity(element.get("junction") or "-1") if element.get("junction") != "none" else -1,
            length,
            ReferenceLine(element),
            elevation,
            Cubics(element.iterfind("lateralProfile/superelevation")),
            fall,
            offset,
            sections,
            links,
        )
        level = replace(road, crossfall=Crossfall([]))
        for section in sections if len(fall.starts) else ():
            s = np.union1d(np.linspace(section.start, section.end, 9), fall.starts)
            s = s[(s >= section.start) & (s <= section.end)]
            both = (one.cuts(section, s).values() for one in (road, level))
            if any(abs(a.outer - b.outer)[:, 2].max() > FALL for a, b in zip(*both, strict=True)):
                raise ValueError(f"its lateral <shape> is over {FALL:g} m high")
        return road

    def near(self, middle: np.ndarray, reach: float) -> bool:
        """Whether a piece, nowhere farther from its start than its length, may come in reach."""
        away = distance_from(self.line.starts, middle)
        return bool((away <= reach + self.line.lengths + 20.0).any())  # 20 m: half a wide road

    def points(
        self, s: Float[np.ndarray, " N"], t: np.ndarray, tilted: np.ndarray | None = None
    ) -> Float[np.ndarray, "..."]:
        """The points (…, N, 3) at s and t (…, N), where the road tilts as at ``tilted``."""
        at, heading = self.line.at(s)
        tilt, tilted = self.superelevation(s), t if tilted is None else tilted
        across = t + tilted * (np.cos(tilt) - 1)
        x, y = at[:, 0] - across * np.sin(heading), at[:, 1] + across * np.cos(heading)
        up = tilted * np.sin(tilt) + self.crossfall(s, tilted)
        return np.stack([x, y, self.elevation(s) + up], -1)

    def cuts(self, section: Section, s: Float[np.ndarray, " N"]) -> dict[int, LaneCut]:
        """The lanes of a section at stations."""
        inset = min(INSET, (section.end - section.start) / 4)
        s = np.clip(s, section.start + inset, section.end - inset)
        last, hinge = dict.fromkeys((1, -1), self.offset(s)), dict[int, np.ndarray]()
        rows, tilted = [], []  # of each lane where its middle and its edges are, in t
        for lane, one in section.lanes.items():
            side, inner = (1 if lane > 0 else -1), last[1 if lane > 0 else -1]
            edge = one.edge(s - section.start)
            outer = inner + side * np.maximum(side * (edge - inner) if one.is_border else edge, 0.0)
            rows.append(((inner + outer) / 2, inner, outer))
            tilted.append((hinge.setdefault(side, inner),) * 3 if one.level else rows[-1])
            last[side] = outer
        t, tilts = (np.reshape(x, (-1, 3, len(s))) for x in (rows, tilted))
        points, found = self.points(s, t, tilts), {}
        for (lane, one), (middle, inner, outer), (_, t, u) in zip(
            section.lanes.items(), points, rows, strict=True
        ):
            for edge, lift in zip((inner, outer), one.heights.T[1:], strict=True):
                if len(lift):
                    rise = np.interp(s - section.start, one.heights[:, 0], lift)
                    edge[:, 2] += rise
                    middle[:, 2] += rise / 2
            found[lane] = LaneCut(middle, inner, outer, abs(u - t))
        return found

    def kinds(self) -> set[str]:
        """The types of its lanes."""
        return {lane.kind for section in self.sections for lane in section.lanes.values()}

    def section_at(self, s: float) -> int:
        """The index of the section at s."""
        return max(0, sum(one.start <= s for one in self.sections) - 1)


def _lanes(element: ET.Element, left_hand: bool, length: float) -> dict[int, Lane]:
    found, at = {}, np.linspace(0.0, length, 9)
    for lane in element.iter("lane"):
        name, kind = int(number(lane, "id")), lane.get("type", "none")
        widths, borders = lane.findall("width"), lane.findall("border")
        if name and kind != "none" and not widths and not borders:
            raise ValueError(f"no <width> and no <border> in lane {name}")
        edge = Cubics(widths or borders, "sOffset")
        if not widths and name < 0 and (edge.rows[:, 1] > 0).any():  # written as if on the left
            edge.rows[:, 1:] *= -1
        if abs(edge(at)).max() > WIDEST:
            raise ValueError(f"lane {name} is wider than {WIDEST:g} m")
        rows = [
            [number(h, "sOffset"), *(number(h, k if h.get(k) else old) for k, old in HEIGHTS)]
            for h in lane.iter("height")
        ]
        links = {
            end: [int(number(link, "id")) for link in lane.iterfind(f"link/{tag}")]
            for end, tag in (("start", "predecessor"), ("end", "successor"))
        }
        found[name] = Lane(
            kind,
            ((name < 0) != left_hand) != (lane.get("direction") == "reversed"),
            lane.get("level") in ("true", "1"),
            edge,
            not widths,
            np.array(rows).reshape(-1, 3),
            links,
        )
    found.pop(0, None)
    return {name: found[name] for name in sorted(found, key=abs)}


def identity(text: str) -> Id:
    """The id of a road or junction: a number if it is written as one."""
    text = text.strip()
    short = len(text) < 19 and (text == "-1" or (text.isascii() and text.isdigit()))
    return int(text) if short and str(int(text)) == text else text


def listed(name: Id) -> tuple[bool, Id]:
    """The order of ids: numbers before words."""
    return isinstance(name, str), name


def read_tree(path: Path) -> ET.Element:
    """The elements of a map without namespaces. Raises InspeError if it is not OpenDRIVE."""
    check_input(path, TEXT)
    check_kind(path)
    data = path.read_bytes()
    if not data.startswith(UTF_16):
        data = data.decode("utf-8-sig", "replace").strip().encode()
        data = data[max(0, data.find(b"<?xml ")) :]  # a comment may stand before it
    check_xml(io.BytesIO(data), str(path), "OpenDRIVE")
    root = ET.fromstring(data)
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    return root


def read_roads(
    root: ET.Element,
) -> tuple[dict[Id, tuple[ET.Element, OpenDriveRoad]], list[tuple[Id, str]]]:
    """The roads of a map by id, with elements, and of those left out junction, name and why."""
    found: dict[Id, tuple[ET.Element, OpenDriveRoad]] = {}
    out = []
    for element in root.iterfind("road"):
        try:
            road = OpenDriveRoad.of(element)
            if road.id in found:
                raise ValueError("another road has this id")
            found[road.id] = element, road
        except ValueError as error:
            junction = identity(element.get("junction", ""))
            out.append((junction, f"road {element.get('id')} ({error})"))
    return found, out


def moved_near(root: ET.Element) -> tuple[float, float]:
    """Take coordinates too large for single precision from a point near; returns it (x, y) [m]."""
    pieces = list[tuple[ET.Element, float, float]]()
    for piece in root.iterfind("road/planView/geometry"):
        with suppress(ValueError):  # said of its road
            pieces.append((piece, number(piece, "x"), number(piece, "y")))
    at = np.array([place for _, *place in pieces])
    if not len(at) or abs(middle := np.median(at, 0)).max() < FAR:
        return 0.0, 0.0
    x, y = np.round(middle, -3).tolist()
    for piece, east, north in pieces:
        piece.set("x", repr(east - x))
        piece.set("y", repr(north - y))
    return x, y


def projection_of(
    root: ET.Element, moved: tuple[float, float]
) -> tuple[Georeference | None, list[str]]:
    """The projection that the header names, if it can be used, and a note if it cannot."""
    # The header's offset leads from the roads' coordinates, here the world's, to the projection's.
    offset = root.find("header/offset")
    try:
        given = {} if offset is None else offset.attrib
        x, y, turn = (float(given.get(key, 0.0)) for key in ("x", "y", "hdg"))
        text = root.findtext("header/geoReference", "")
        found = of_open_drive(text, (-x - moved[0], -y - moved[1]))
        if found is not None:
            if turn:
                raise InspeError(f"an offset that turns by {turn:g} rad is not read")
            if "+units=" in text and "+units=m " not in f"{text} ":
                raise InspeError("its unit is not the metre, which OpenDRIVE's is: lengths are "
                                 "taken as metres; write +units=m if they are")  # fmt: skip
            found.check()
    except (InspeError, ValueError) as error:
        return None, [f"no coordinates: the map's projection: {error}"]
    return found, []
