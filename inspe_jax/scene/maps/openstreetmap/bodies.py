"""The bodies of an OpenStreetMap extract: buildings, trees, walls, hedges, fences and poles. Not
read: woods, bushes and other plants, power towers, and fences that one sees through."""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
import shapely
from jaxtyping import Float
from shapely.geometry import LineString, Point, Polygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from inspe_jax.scene.geojson import known_georeference
from inspe_jax.scene.intersection import Intersection
from inspe_jax.scene.lines import distinct
from inspe_jax.scene.maps.bodies import BARRIERS, BUILDING, SMALL, TREE, Shape, crown_base
from inspe_jax.scene.maps.openstreetmap.extract import Tags, Way, read_extract
from inspe_jax.scene.statics import HIGHEST, LEAFY, octagon
from inspe_jax.scene.terrain import HIGHEST as HIGHEST_LAND
from inspe_jax.scene.terrain import LOWEST

BEYOND = 200.0  # nodes are read this far beyond the reach [m]: outlines are cut there
NOT_THERE = ("no", "demolished", "razed", "ruins", "proposed", "planned", "none", "")
"""Values of ``building`` of what hides nothing."""
HUNG = ("wall", "wall_mounted", "ceiling", "catenary", "suspension", "wire", "ground")
"""The ``support`` of lamps that stand on no pole."""
LEVEL = 3.0  # height of a level of a building [m]
LOW_BUILDING = 3.0  # the same, of those of LOW [m]: one level
LOW = ("garage", "garages", "carport", "shed", "hut", "kiosk", "bungalow", "static_caravan",
       "toilets", "greenhouse", "service", "boathouse", "container", "guardhouse")  # fmt: skip
ROOF = 5.0, 0.5  # height and thickness of a roof without walls, as of a filling station [m]
SOLID_FENCES = ("brick", "concrete", "corrugated_metal", "metal_sheet", "panel", "wood")
"""The ``fence_type`` of fences that one does not see through."""
TREE_SPACING = 8.0  # distance of the trees of a row [m]
POLES = {
    ("highway", "street_lamp"): (8.0, 0.09),
    ("highway", "traffic_signals"): (3.4, 0.07),
    ("power", "pole"): (9.0, 0.14),
    ("man_made", "mast"): (15.0, 0.3),
}
"""Height and radius of poles [m], by their tag."""
FOOT, INCH = 0.3048, 0.0254
_METRES = re.compile(r"(\d+(?:[.,]\d+)?|\.\d+)\s*(m|metres?|meters?|cm|ft|feet)?", re.IGNORECASE)
_FEET = re.compile(r"(\d+(?:\.\d+)?)\s*'\s*(?:(\d+(?:\.\d+)?)\s*(?:\"|''))?")
_UNITS = {"cm": 0.01, "ft": FOOT, "feet": FOOT}


def length_of(text: str) -> float | None:
    """The metres of a tag, as of ``12``, ``12.5 m``, ``40 ft`` and ``3'6"``; None for others."""
    text = text.strip()
    if match := _METRES.fullmatch(text):
        return float(match[1].replace(",", ".")) * _UNITS.get((match[2] or "m").lower(), 1.0)
    if match := _FEET.fullmatch(text):
        return float(match[1]) * FOOT + float(match[2] or 0) * INCH
    return None


@dataclass
class Sizes:
    """Reads sizes from tags, and keeps count of those that are assumed or make no sense."""

    assumed: "Counter[str]" = field(default_factory=Counter)
    senseless: list[str] = field(default_factory=list)

    def value(
        self,
        tags: Tags,
        key: str,
        least: float = 0.1,
        most: float = HIGHEST,
        *,
        read: Callable[[str], float | None] = length_of,
    ) -> float | None:
        """What ``read`` makes of a key, a length [m]; None where it is not between the limits."""
        if key not in tags:
            return None
        with suppress(ValueError):
            value = read(tags[key])
            if value is not None and least <= value <= most:
                return value
        self.senseless.append(f"{key}={tags[key]}")
        return None

    def heights(self, tags: Tags, kind: str) -> tuple[float, float]:
        """The base and the height of a building or a part of one; ``kind`` is its tag's value."""

        def number(key: str) -> float | None:
            return self.value(tags, key, 0.0, 200.0, read=float)

        height = self.value(tags, "height")
        levels, base = number("building:levels"), self.value(tags, "min_height", 0.0)
        if height is None and levels is not None:
            over = self.value(tags, "roof:height", 0.0)
            if over is None:
                over = (number("roof:levels") or 0.0) * LEVEL
            height = levels * LEVEL + over
            if not 0 < height <= HIGHEST:
                height = None
        if base is None and (start := number("building:min_level")) is not None:
            base = start * LEVEL
        if kind == "roof":
            top, thick = ROOF
            top = height or top
            return (top - thick if base is None and top > thick else base or 0.0), top
        if height is None:
            self.assumed["building"] += 1
            height = (LOW_BUILDING if kind in LOW else BUILDING) + (base or 0.0)
        if base is not None and base >= height:
            self.senseless.append(f"min_height={base:g} of height={height:g}")
            base = None
        return base or 0.0, height

    def size_or(self, tags: Tags, key: str, kind: str, default: float, *limits: float) -> float:
        """The length under a key [m], between limits, or a default that is counted."""
        value = self.value(tags, key, *limits)
        if value is None and key == "height":
            self.assumed[kind] += 1
        return default if value is None else value

    def notes(self) -> list[str]:
        """What was assumed, in words."""
        ways = {
            "building": f"{BUILDING:g} m high ({LOW_BUILDING:g} m for garages, sheds and the like)",
            "tree": f"{TREE['height']:g} m high",
            "wall": "of a usual height",
            "pole": "of a usual height",
        }
        found = [
            f"no height is given for {self.assumed[kind]} of the map's {kind}s: taken as {words}"
            for kind, words in ways.items()
            if self.assumed[kind]
        ]
        if self.senseless:
            some = ", ".join(dict.fromkeys(self.senseless[:3]))
            found.append(f"{len(self.senseless)} sizes of the map's bodies make no sense ({some})")
        return found


class BodyReader:
    """Reads what an extract has beside lanes within ``reach`` [m] of the centre of a place;
    ``notes`` get what was assumed. Raises InspeError where the place has no georeference, and as
    :func:`~inspe_jax.scene.maps.openstreetmap.extract.read_extract`."""

    def __init__(self, path: Path, place: Intersection, reach: float, notes: list[str]) -> None:
        self.notes, self.sizes = notes, Sizes()
        middle, georeference = place.center[:2], known_georeference(place)
        self.disc = Point(middle).buffer(reach)
        square = shapely.segmentize(Point(middle).buffer(reach + BEYOND, cap_style="square"), 50.0)
        degrees = georeference.to_degrees(shapely.get_coordinates(square))
        (west, south), (east, north) = degrees.min(0).tolist(), degrees.max(0).tolist()
        self.extract = read_extract(path, (west, south, east, north))
        at = np.array([*self.extract.nodes.values()], float).reshape(-1, 2)
        self.at = dict(zip(self.extract.nodes, georeference.from_degrees(at), strict=True))
        self.open = 0  # outlines that could not be closed

    def spot_heights(self) -> Float[np.ndarray, "N 3"]:
        """The nodes that have a height (``ele``) of this Earth, in world metres."""
        found = []
        for name, tags in self.extract.node_tags.items():
            with suppress(ValueError):
                if LOWEST < (height := float(tags.get("ele", "").removesuffix("m"))) < HIGHEST_LAND:
                    found.append((*self.at[name], height))
        return np.array(found, float).reshape(-1, 3)

    def shapes(self) -> list[Shape]:
        """Its bodies, those of each kind in the order of the file."""
        trees = list(self._trees())
        found = [*self._buildings(), *self._barriers(), *trees, *self._rows(trees), *self._poles()]
        if self.open:
            self.notes.append(
                "outlines of the map that go beyond the extract or are not closed: "
                f"{self.open}, left out or closed by a straight line"
            )
        self.notes += self.sizes.notes()
        return found

    def _near(self, *of: Float[np.ndarray, "N 2"] | Float[np.ndarray, "2"]) -> bool:
        """Whether what lies between points may come into the disc."""
        points = shapely.MultiPoint(np.vstack([np.zeros((0, 2)), *of]))
        return bool(points.convex_hull.intersects(self.disc))

    def _line(self, way: Way) -> Float[np.ndarray, "N 2"]:
        return np.array([self.at[n] for n in way.nodes if n in self.at], float).reshape(-1, 2)

    def _outline(self, way: Way) -> BaseGeometry | None:
        """The area within a closed way; None if it has none."""
        line = self._line(way)
        if not self._near(line):
            return None
        if len(np.unique(line, axis=0)) < 3 or way.nodes[0] != way.nodes[-1]:
            self.open += 1
            return None
        self.open += any(n not in self.at for n in way.nodes)
        return Polygon(line)

    def _areas(self) -> Iterator[tuple[Tags, BaseGeometry]]:
        drawn = set()
        for relation in self.extract.relations.values():
            if relation.tags.get("type") != "multipolygon":
                continue
            ways = [(name, role) for name, role in relation.ways if name in self.extract.ways]
            outer = [name for name, role in ways if role != "inner"]
            tags = relation.tags
            if not _is_area(tags):  # as was usual once: the tags are those of the outline
                own = [self.extract.ways[name].tags for name in outer]
                tags = next((t for t in own if _is_area(t)), {})
            if not tags:
                continue
            drawn |= {name for name in outer if _is_area(self.extract.ways[name].tags)}
            area = self._rings(outer)
            if not self._near(*(self._line(self.extract.ways[name]) for name in outer)):
                continue
            missing = len(ways) < len(relation.ways)
            self.open += area.is_empty or missing
            if not area.is_empty:
                holes = self._rings(name for name, role in ways if role == "inner")
                yield tags, area.difference(holes)
        for name, way in self.extract.ways.items():
            if name not in drawn and _is_area(way.tags):
                outline = self._outline(way)
                if outline is not None:
                    yield way.tags, outline

    def _rings(self, names: Iterable[str]) -> BaseGeometry:
        lines = [self._line(self.extract.ways[name]) for name in names]
        edges = [LineString(line) for line in lines if len(line) > 1]
        if not edges:
            return Polygon()
        joined = shapely.get_parts(shapely.line_merge(unary_union(edges)))
        return unary_union(list(shapely.get_parts(shapely.polygonize(joined))))

    def _buildings(self) -> Iterator[Shape]:
        """Buildings and their parts; parts stand in for the buildings that they are part of."""
        whole, parts = list[Shape](), list[Shape]()
        for tags, area in self._areas():
            if "barrier" in tags and not _is_building(tags):
                height, _ = BARRIERS["hedge"]
                height = self.sizes.size_or(tags, "height", "wall", height)
                yield Shape("hedge", area, height)
                continue
            part = "building" not in tags
            base, height = self.sizes.heights(tags, tags["building:part" if part else "building"])
            (parts if part else whole).append(Shape("building", area, height, base))
        yield from parts
        tree_of = shapely.STRtree([part.area for part in parts])
        for one in whole:
            area = one.area
            within = [parts[k].area for k in tree_of.query(area)]
            if within and area.is_valid:
                left = area.difference(unary_union([w.buffer(0) for w in within]))
                left = left.buffer(-0.05, join_style="mitre").buffer(0.05, join_style="mitre")
                if left.area < SMALL["building"]:
                    continue
                if left.area < area.area - SMALL["building"]:
                    area = left
            yield one._replace(area=area)

    def _barriers(self) -> Iterator[Shape]:
        for way in self.extract.ways.values():
            kind = way.tags.get("barrier", "")
            if kind not in BARRIERS or _is_area(way.tags):
                continue
            if kind == "fence" and way.tags.get("fence_type") not in SOLID_FENCES:
                continue
            line = self._line(way)
            if not self._near(line):
                continue
            height, width = BARRIERS[kind]
            height = self.sizes.size_or(way.tags, "height", "wall", height)
            width = self.sizes.size_or(way.tags, "width", "wall", width, 0.02, 10.0)
            line = distinct(line) if len(line) > 1 else line
            for ends in pairwise(line):
                stretch = LineString(ends).buffer(width / 2, cap_style="flat")
                yield Shape("hedge" if kind == "hedge" else "wall", stretch, height)

    def _trees(self) -> Iterator[Shape]:
        for name, tags in self.extract.node_tags.items():
            if tags.get("natural") == "tree" and self._near(self.at[name]):
                yield self._tree(tags, self.at[name])

    def _rows(self, trees: list[Shape]) -> Iterator[Shape]:
        """Trees along tree rows, where none are mapped on their own."""
        mapped, count = shapely.STRtree([tree.area.centroid for tree in trees]), 0
        for way in self.extract.ways.values():
            line = self._line(way)
            if way.tags.get("natural") != "tree_row" or len(line) < 2 or not self._near(line):
                continue
            row = LineString(line)
            gaps = max(1, round(row.length / TREE_SPACING))
            for k in range(gaps + 1):
                at = row.interpolate(k / gaps, normalized=True)
                own = mapped.query(at, "dwithin", TREE_SPACING / 2)
                if at.intersects(self.disc) and not len(own):
                    count += 1
                    yield self._tree(way.tags, np.array(at.coords[0]))
        if count:
            rows = f"{count} trees stand {TREE_SPACING:g} m apart in the map's tree rows"
            self.notes.append(rows)

    def _tree(self, tags: Tags, at: Float[np.ndarray, "2"]) -> Shape:
        height = self.sizes.size_or(tags, "height", "tree", TREE["height"], 1.0, 120.0)
        across, around = (
            self.sizes.size_or(tags, key, "tree", TREE[key], *limits)
            for key, *limits in (("diameter_crown", 0.3, 60.0), ("circumference", 0.05, 15.0))
        )
        crown, trunk = Polygon(octagon(at, across / 2)), min(around / (2 * np.pi), across / 4)
        return Shape("tree", crown, height, crown_base(height), LEAFY, trunk)

    def _poles(self) -> Iterator[Shape]:
        """Poles beside ways: a node of a road that has signals says only where drivers stop."""
        roads = [way for way in self.extract.ways.values() if "highway" in way.tags]
        on_roads = {node for way in roads for node in way.nodes}
        for name, tags in self.extract.node_tags.items():
            known = next((size for (k, v), size in POLES.items() if tags.get(k) == v), None)
            if known is None or name in on_roads or tags.get("support") in HUNG:
                continue
            if self._near(self.at[name]):
                height = self.sizes.size_or(tags, "height", "pole", known[0], 1.0)
                yield Shape("pole", Polygon(octagon(self.at[name], known[1])), height)


def _is_building(tags: Tags) -> bool:
    """Whether tags are those of a building, or a part of one, above ground."""
    key = "building" if "building" in tags else "building:part"
    sunk = tags.get("location") == "underground" or tags.get("layer", "").startswith("-")
    return tags.get(key, "no") not in NOT_THERE and not sunk


def _is_area(tags: Tags) -> bool:
    return _is_building(tags) or (tags.get("barrier") == "hedge" and tags.get("area") == "yes")
