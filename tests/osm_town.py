"""A made-up town as an OpenStreetMap extract, in metres east and north of a crossroads."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

LON, LAT = 11.575, 48.137
PHI = np.radians(LAT)
METRES = np.array(
    [
        111412.84 * np.cos(PHI) - 93.5 * np.cos(3 * PHI),
        111132.954 - 559.822 * np.cos(2 * PHI) + 1.175 * np.cos(4 * PHI),
    ]
)
"""Metres a degree of longitude and of latitude, on WGS 84."""
ROAD = {"highway": "secondary", "lanes": "2", "sidewalk": "both"}


def box(west: float, south: float, east: float, north: float) -> list[tuple[float, float]]:
    """The corners of a rectangle."""
    return [(west, south), (east, south), (east, north), (west, north)]


def degrees(points: Iterable[tuple[float, float]]) -> np.ndarray:
    """Longitude and latitude of points in metres (N, 2)."""
    return np.array([LON, LAT]) + np.array(list(points), float) / METRES


class Town:
    """Collects nodes, ways and relations and writes them."""

    def __init__(self) -> None:
        self.nodes: list[str] = []
        self.ways: list[str] = []
        self.relations: list[str] = []
        middle = self.node((0, 0), highway="traffic_signals")
        self.middle = middle
        for end in ((111, 0), (0, 111), (-111, 0), (0, -111)):
            near = self.node(tuple(0.2 * x for x in end), highway="crossing")
            self.way([self.node(end), near, middle], **ROAD)

    def node(self, at: tuple[float, ...], **tags: str) -> int:
        """Adds a node, and returns its id."""
        (lon, lat), name = degrees([at[:2]])[0], len(self.nodes) + 1
        self.nodes.append(f'<node id="{name}" lon="{lon:.9f}" lat="{lat:.9f}">{_tags(tags)}</node>')
        return name

    def way(self, nodes: Iterable[int], **tags: str) -> int:
        """Adds a way, and returns its id."""
        name = len(self.ways) + 1
        refs = "".join(f'<nd ref="{node}"/>' for node in nodes)
        self.ways.append(f'<way id="{name}">{refs}{_tags(tags)}</way>')
        return name

    def line(self, points: Iterable[tuple[float, float]], **tags: str) -> int:
        """Adds a way on nodes of its own."""
        return self.way([self.node(at) for at in points], **tags)

    def area(self, points: Iterable[tuple[float, float]], **tags: str) -> int:
        """Adds a closed way on nodes of its own."""
        nodes = [self.node(at) for at in points]
        return self.way([*nodes, nodes[0]], **tags)

    def relation(self, members: Iterable[tuple[int, str]], **tags: str) -> None:
        """Adds a multipolygon."""
        ways = "".join(f'<member type="way" ref="{w}" role="{role}"/>' for w, role in members)
        tags |= {"type": "multipolygon"}
        self.relations.append(
            f'<relation id="{len(self.relations) + 1}">{ways}{_tags(tags)}</relation>'
        )

    def write(self, path: Path) -> Path:
        """Writes the extract, and returns its path."""
        (w, s), (e, n) = degrees([(-200, -200), (200, 200)])
        bounds = f'<bounds minlon="{w}" minlat="{s}" maxlon="{e}" maxlat="{n}"/>'
        parts = "\n".join([bounds, *self.nodes, *self.ways, *self.relations])
        path.write_text(f'<?xml version="1.0"?>\n<osm version="0.6">\n{parts}\n</osm>\n')
        return path


def _tags(tags: dict[str, str]) -> str:
    def of(key: str) -> str:
        return key.replace("__", ":")

    quoted = {of(k): v.replace("&", "&amp;").replace('"', "&quot;") for k, v in tags.items()}
    return "".join(f'<tag k="{k}" v="{v}"/>' for k, v in quoted.items())


def full_town() -> Town:
    """Houses with heights of every sort, a courtyard, parts, trees, walls, poles, and mistakes."""
    town = Town()
    town.area(box(10, 10, 22, 20), building="yes", height="9 m")
    town.area(box(-22, 10, -10, 18), building="house", building__levels="3", roof__height="1.5")
    town.area(box(10, -20, 16, -14), building="garage")
    # A block about a courtyard: its outline in two ways.
    a, b, c, d = (town.node(at) for at in box(-40, -40, -12, -12))
    halves = town.way([a, b, c]), town.way([c, d, a])
    court = town.area(box(-32, -32, -20, -20))
    town.relation([*((way, "outer") for way in halves), (court, "inner")],
                  building="apartments", height="12")  # fmt: skip
    # A house in parts: a tower, a bay that hangs over a passage, and the rest.
    town.area(box(30, 10, 40, 20), building="yes", height="8")
    town.area(box(30, 10, 35, 20), building__part="yes", height="15")
    town.area(box(35, 10, 40, 15), building__part="yes", height="15", min_height="5")
    # Mistakes.
    town.area([(12, 26), (20, 34), (20, 26), (12, 34)], building="yes", height="5")
    town.area(box(24, 26, 30, 32), building="yes", height="about ten")
    town.area(box(32, 26, 38, 32), building="yes", height="3;4")
    town.area(box(24, 34, 30, 40), building="yes", height="9", min_height="12")
    town.area(box(-3, 25, 11, 31), building="yes", height="7")
    town.area(box(-2, 40, 2, 44), building="yes", height="7")
    town.area(box(-30, 22, -24, 28), building="yes", location="underground")
    town.area(box(-30, 30, -24, 36), building="no")
    town.area(box(500, 500, 510, 510), building="yes", height="20")
    town.area(box(-6, -40, 6, -30), building="roof", height="6")
    # Trees.
    town.node((8, 8), natural="tree")
    town.node((8, -9), natural="tree", height="12 m", diameter_crown="12", circumference="1.57")
    town.node((-8, 8), natural="tree", height="4", diameter_crown="12")
    town.node((0, 30), natural="tree")
    town.node((22, -8.5), natural="tree", height="6", diameter_crown="3")
    town.line([(15, -8.5), (39, -8.5)], natural="tree_row", height="10", diameter_crown="4")
    # Walls, a hedge, fences.
    town.line([(7, -25), (7, -35), (15, -35)], barrier="wall", height="7'3\"")
    town.line([(-7, 20), (-7, 30)], barrier="hedge")
    town.line([(-9, 20), (-9, 30)], barrier="fence", fence_type="wood", height="1.6")
    town.line([(-11, 20), (-11, 30)], barrier="fence", fence_type="chain_link")
    # Poles.
    town.node((6.5, 22), highway="street_lamp", height="7 m")
    town.node((7.5, 5.5), highway="traffic_signals")
    town.node((-9, 34), power="pole")
    town.node((25, 22.5), man_made="mast", height="20")
    town.node((2, 15), highway="street_lamp")
    town.node((9.9, 15), highway="street_lamp", support="wall_mounted")
    return town
