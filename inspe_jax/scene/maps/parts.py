"""What all map readers share: junctions, clean regions, crosswalks, mounting areas, footpaths."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
import shapely
from scipy.spatial import cKDTree
from shapely.geometry import Point, Polygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from inspe_jax.scene.intersection import Arm, Intersection, Route, corner_islands, mouth_crosswalks
from inspe_jax.scene.lines import resampled
from inspe_jax.scene.regions import Region

STEP = 1.0
"""Spacing of the stations sampled along lanes and routes [m]."""
CLUSTER = 35.0
"""Junctions whose middle is this near to ``center`` count as one [m]."""
MARGIN = 10.0
"""A map is read this much beyond the radius [m]."""
MOST_LISTED = 20
"""At most this many junctions are listed in an error."""


@dataclass(frozen=True)
class JunctionInfo:
    """A junction of a map: its id, middle (x, y, z) [m], arms, size, crosswalks and signals.

    ``size`` is the larger side of its bounding box [m]. ``crosswalks`` and ``signals`` count
    those that the map has near it.
    """

    id: int | str
    center: tuple[float, float, float]
    arms: int
    size: float
    crosswalks: int
    signals: int


def distance_from(points: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Plan distance of points (N, 2 or 3) from the middle [m]."""
    return np.hypot(*(points[:, :2] - middle[:2]).T)


def valid(shape: BaseGeometry) -> BaseGeometry:
    """The shape, repaired if its outline crosses itself."""
    return shape if shape.is_valid else shape.buffer(0)


def clean(shape: BaseGeometry) -> BaseGeometry:
    """A shape without seams and slivers of a few centimetres and without parts below 0.5 m².

    Corners stay square.
    """
    for step in (0.05, -0.12, 0.07):
        shape = shape.buffer(step, join_style="mitre")
    return unary_union([part for part in shapely.get_parts(shape) if part.area > 0.5])


def crosswalks_of(
    loops: Iterable[np.ndarray],
    areas: dict[Region, BaseGeometry],
    arms: tuple[Arm, ...],
    ground: np.ndarray,
    disc: Polygon,
    notes: list[str],
) -> list[BaseGeometry]:
    """The crosswalks of a map, from outlines (K, 3) each, inside the disc and near the ``ground``.

    ``ground`` (N, 3) are points on the ground. If the map has no crosswalk at the junction, strips
    across the arms' mouths are added, and a note says so.
    """
    index = cKDTree(ground[:, :2])
    walks = []
    for loop in loops:
        middle = loop.mean(0)
        level = ground[index.query(middle[:2])[1], 2]
        if disc.contains(Point(middle)) and abs(middle[2] - level) < 2.0:
            walks.append(valid(Polygon(loop[:, :2])))
    if any(walk.distance(areas[Region.JUNCTION]) < 8.0 for walk in walks):
        return walks
    if areas[Region.SIDEWALK].intersection(disc).is_empty:
        notes.append("no crosswalks: the map has none here, and no sidewalks they could join")
        return walks
    notes.append("the map has no crosswalks here; strips across the junction's mouths stand in")
    return walks + [mouth_crosswalks((arm,)) for arm in arms]


def crossing_lines(walks: list[BaseGeometry]) -> Iterator[np.ndarray]:
    """The middle line (N, 2) of each crosswalk, along its longer side and 3 m beyond both ends."""
    for walk in walks:
        corners = np.array(walk.minimum_rotated_rectangle.exterior.coords)[:4]
        sides = np.diff(corners[:3], axis=0)
        along = sides[np.argmax(np.hypot(*sides.T))]
        reach = along / 2 + 3.0 * along / np.linalg.norm(along)
        middle = corners.mean(0)
        yield resampled(np.array([middle - reach, middle + reach]))


def joined_lines(lines: list[np.ndarray]) -> Iterator[np.ndarray]:
    """Footpaths (N, 2), joined where the end of one is within 1.5 m of another; 5 m or longer."""
    lines = list(lines)

    def joint(line: np.ndarray) -> tuple[int, np.ndarray] | None:
        for i, other in enumerate(lines):
            for a, b in product((line, line[::-1]), (other, other[::-1])):
                if np.hypot(*(a[-1] - b[0])) < 1.5:
                    return i, np.concatenate([a, b])
        return None

    while lines:
        line = lines.pop()
        while found := joint(line):
            del lines[found[0]]
            line = found[1]
        if np.hypot(*np.diff(line, axis=0).T).sum() >= 5.0:
            yield resampled(line)


def walking_routes(place: Intersection, lines: Iterable[np.ndarray]) -> Iterator[Route]:
    """Footpaths (N, 2) as routes on the ground of a place, in both directions."""
    for line in lines:
        for path in (line, line[::-1]):
            yield Route(place.on_ground(path), 2.0, "pedestrian")


def mounting_of(
    regions: dict[Region, BaseGeometry],
    medians: list[BaseGeometry],
    arms: tuple[Arm, ...],
    disc: Polygon,
) -> BaseGeometry:
    """Where a pole may stand: sidewalks, shoulders and medians, but not carriageway or crosswalks.

    Islands at the corners are added only if none of these is beside the junction. Beside a sidewalk
    they would add nothing, and on a deck they would hang in the air.
    """
    standing = [regions[Region.SIDEWALK], regions[Region.SHOULDER], *medians]
    beside = unary_union(standing).distance(regions[Region.JUNCTION])
    if not beside <= 5.0:  # also if there is nothing: the distance is then not a number
        standing.append(corner_islands(arms))
    traffic = [regions[r] for r in (Region.DRIVEWAY, Region.JUNCTION, Region.CROSSWALK)]
    free = unary_union(standing).intersection(disc).difference(unary_union(traffic))
    return clean(free)
