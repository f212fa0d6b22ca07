"""What the ground looks like: a raster of regions and paint, and noise fixed to the ground."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float, Int
from PIL import Image, ImageDraw
from shapely.geometry import LineString, MultiPolygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from inspe_jax.scene.intersection import Intersection
from inspe_jax.scene.regions import PRECEDENCE, Region

CELL = 0.05  # edge of a cell of the raster [m]
STRIPE = 0.5  # width of the stripes of a zebra crossing, and of the gaps between them [m]
LINE = 0.12  # width of a line between lanes [m]

GRASS, PAINT = len(Region), len(Region) + 1
"""Labels in addition to the regions': no region, and white paint."""

ALBEDO = np.array(
    [
        [0.105, 0.105, 0.11],  # driveway: asphalt
        [0.09, 0.09, 0.095],  # junction
        [0.11, 0.11, 0.112],  # crosswalk, between its stripes
        [0.30, 0.29, 0.27],  # sidewalk: slabs
        [0.16, 0.155, 0.15],  # shoulder
        [0.07, 0.11, 0.04],  # grass
        [0.62, 0.62, 0.60],  # paint
    ]
)
"""Linear albedo of each label: plausible values, for asphalt that is some years old."""
ROUGH = np.array([0.25, 0.25, 0.25, 0.12, 0.25, 0.6, 0.12])
"""How strongly the noise changes the albedo of each label."""


@dataclass(frozen=True, eq=False)
class Surface:
    """Labels of cells of :data:`CELL` metres: the first at ``corner`` [m], rows northward."""

    labels: Int[np.ndarray, "N N"]
    corner: Float[np.ndarray, "2"]

    def label(self, xy: Float[np.ndarray, "R 2"]) -> Int[np.ndarray, " R"]:
        """The label at points: a region, :data:`PAINT` or :data:`GRASS`, as outside the raster."""
        x, y = np.floor((xy - self.corner).T / CELL).astype(int)
        size = len(self.labels)
        inside = (x >= 0) & (x < size) & (y >= 0) & (y < size)
        return np.where(inside, self.labels[np.where(inside, y, 0), np.where(inside, x, 0)], GRASS)

    def albedo(self, xy: Float[np.ndarray, "R 2"]) -> Float[np.ndarray, "R 3"]:
        """Linear albedo at points."""
        label = self.label(xy)
        grain = 0.5 * noise(xy / 0.07) + 0.3 * noise(xy / 0.6) + 0.2 * noise(xy / 5.0)
        colour = ALBEDO[label] * (1 + ROUGH[label] * 2 * (grain - 0.5))[:, None]
        x, y = np.abs(xy.T % 1.2 - 0.6)
        slabs = ((x > 0.575) | (y > 0.575)) & (label == Region.SIDEWALK)
        return np.where(slabs[:, None], 0.6 * colour, colour)


def lay_surface(intersection: Intersection, reach: float) -> Surface:
    """The ground of an intersection out to ``reach`` metres from its centre."""
    corner = intersection.center[:2] - reach
    size = int(np.ceil(2 * reach / CELL))
    image = Image.new("L", (size, size), GRASS)
    pen = ImageDraw.Draw(image)
    for region in reversed(PRECEDENCE):
        if region in intersection.regions:
            _fill(pen, intersection.regions[region], corner, int(region), GRASS)
    for shape in (*_zebras(intersection), *_lines(intersection)):
        _fill(pen, shape, corner, PAINT, None)
    return Surface(np.asarray(image), corner)


def _fill(
    pen: ImageDraw.ImageDraw, shape: BaseGeometry, corner: np.ndarray, label: int, hole: int | None
) -> None:
    """Draw a shape with a label, and its holes with ``hole``; None leaves them as they are."""
    for part in shapely.get_parts(shape):
        if part.geom_type != "Polygon" or part.is_empty:
            continue
        for ring, value in [(part.exterior, label), *((r, hole) for r in part.interiors)]:
            if value is not None:
                points = (np.asarray(ring.coords)[:, :2] - corner) / CELL
                pen.polygon([(float(x), float(y)) for x, y in points], fill=value)


def _zebras(intersection: Intersection) -> Iterator[BaseGeometry]:
    walks = intersection.regions.get(Region.CROSSWALK, MultiPolygon())
    for walk in shapely.get_parts(walks):
        corners = np.array(walk.minimum_rotated_rectangle.exterior.coords)[:4]
        sides = np.diff(corners[:3], axis=0)
        long, short = sides[np.argsort(-np.hypot(*sides.T))]
        start = corners.mean(0) - long / 2
        count = int(np.hypot(*long) / (2 * STRIPE))
        for k in range(count):
            at = start + long * (k + 0.5) / count
            stripe = LineString([at - short / 2, at + short / 2])
            yield stripe.buffer(STRIPE / 2, cap_style="flat").intersection(walk.buffer(-0.15))


def _lines(intersection: Intersection) -> list[BaseGeometry]:
    driveway = intersection.regions.get(Region.DRIVEWAY)
    if driveway is None or driveway.is_empty:
        return []
    crossed = (Region.JUNCTION, Region.CROSSWALK)
    others = [shape for region, shape in intersection.regions.items() if region in crossed]
    free = driveway.buffer(-0.7).difference(unary_union(others).buffer(0.8))
    sides = [
        LineString(route.waypoints[:, :2]).offset_curve(side * route.width / 2)
        for route in intersection.routes
        if route.user == "vehicle" and len(route.waypoints) > 1
        for side in (-1, 1)
    ]
    return [unary_union(sides).intersection(free).buffer(LINE / 2, cap_style="flat")]


def noise(at: Float[np.ndarray, "R 2"]) -> Float[np.ndarray, " R"]:
    """Smooth noise of 0 … 1 with spacing 1, always the same at the same point."""
    cell = np.floor(at.T)
    x, y = cell.astype(np.int64)
    part = (at.T - cell).astype(np.float32)
    east, north = part * part * (3 - 2 * part)
    south, far = ((1 - east) * _hashed(x, row) + east * _hashed(x + 1, row) for row in (y, y + 1))
    return south + north * (far - south)


def _hashed(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A number of 0 … 1 for each pair of integers: a hash, which overflows on purpose."""
    mixed = x.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    mixed ^= y.astype(np.uint64) * np.uint64(0xC2B2AE3D27D4EB4F)
    mixed = (mixed ^ (mixed >> np.uint64(29))) * np.uint64(0xBF58476D1CE4E5B9)
    return ((mixed ^ (mixed >> np.uint64(32))) >> np.uint64(40)).astype(np.float32) / 2**24
