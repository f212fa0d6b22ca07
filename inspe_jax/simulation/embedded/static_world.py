"""The static world: ground, kerbs, buildings, trees and poles, as triangles with a material. What
is not of the scene or its mesh stands clear of sight lines inside the region."""

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int
from shapely.geometry import Point, Polygon
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from inspe_jax.scene.intersection import LOW, Intersection, Mesh
from inspe_jax.scene.maps.bodies import Ways
from inspe_jax.scene.regions import Region
from inspe_jax.scene.statics import StaticBody
from inspe_jax.scene.street import HEADROOM, OVER_LANES
from inspe_jax.scene.terrain import MARGIN, lattice_faces
from inspe_jax.simulation.embedded import static_bodies
from inspe_jax.simulation.embedded.embree import F33, R3, Caster
from inspe_jax.simulation.embedded.static_bodies import Material, Part, prism, walls
from inspe_jax.simulation.embedded.surface import GRASS, Surface, lay_surface, noise

SRGB = 2.2  # exponent of sRGB's curve, nearly
HORIZON = 400.0  # the ground reaches this far from the centre [m]
KERB_SIZE = (0.15, 0.12)  # width and height of a kerb [m]
POLE_RADIUS = 0.08
POLE_HEIGHT = 6.0
CLEAR = 2.0  # least distance of trees and buildings from any region [m]
CARRIAGEWAY = (Region.DRIVEWAY, Region.JUNCTION, Region.CROSSWALK)
"""Regions in which nothing stands."""
BUILDINGS, TREES = 44, 60  # how many the generator tries to place

_LABELS = np.array([0, 2, 3, 3, 9, 9, 6, 4, 20, 14, 15, 20])
"""CARLA's semantic labels of each :data:`Material`; the ground has those of its own labels."""
GROUND_LABELS = np.array([1, 1, 1, 2, 25, 10, 24])
"""CARLA's semantic labels of the regions of the ground, and of grass and paint."""
_PLAIN = {
    Material.KERB: (0.34, 0.34, 0.34),
    Material.ROOF: (0.16, 0.12, 0.11),
    Material.TRUNK: (0.11, 0.075, 0.05),
    Material.POLE: (0.28, 0.29, 0.30),
}
_FURNITURE = np.array([[0.18, 0.20, 0.20], [0.12, 0.17, 0.13], [0.30, 0.30, 0.29]])
_WALLS = np.array(
    [[0.42, 0.36, 0.30], [0.34, 0.17, 0.12], [0.50, 0.48, 0.44], [0.30, 0.31, 0.33]]
    + [[0.46, 0.38, 0.24]]
)


@dataclass(frozen=True, eq=False)
class StaticWorld:
    """Triangles relative to ``center`` [m], with material, number of the building or tree, and
    colour, if of their own; ``poles`` are tops in the world [m]."""

    center: Float[np.ndarray, "3"]
    triangles: F33
    material: Int[np.ndarray, " F"]
    body: Int[np.ndarray, " F"]
    surface: Surface
    poles: Float[np.ndarray, "P 3"]
    colour: Float[np.ndarray, "F 3"]

    @cached_property
    def caster(self) -> Caster:
        """Its triangles, ready for rays."""
        return Caster(self.triangles)

    def paved(self, point: R3) -> Bool[np.ndarray, " R"]:
        """Whether the ground at points of it is paved, and so wet in rain."""
        label: np.ndarray = self.surface.label(point[:, :2] + self.center[:2])
        return label != GRASS

    def look(
        self, face: Int[np.ndarray, " R"], point: R3, normal: R3
    ) -> tuple[R3, Int[np.ndarray, " R"]]:
        """Linear albedo and CARLA's label at points where rays hit its faces (−1: nothing)."""
        material = np.where(face >= 0, self.material[face], -1)
        body = np.where(face >= 0, self.body[face], 0)
        albedo, semantic = np.zeros((len(face), 3), np.float32), _LABELS[material]
        ground = material == Material.GROUND
        world = point[:, :2] + self.center[:2]
        albedo[ground] = self.surface.albedo(world[ground])
        semantic[ground] = GROUND_LABELS[self.surface.label(world[ground])]
        for kind, colour in _PLAIN.items():
            albedo[material == kind] = colour
        rough = material == Material.WALL
        stone = 0.7 + 0.6 * noise(point[rough][:, :2] * 3.1 + point[rough][:, 2:] * 4.3)
        albedo[rough] = np.array([0.34, 0.31, 0.27]) * stone[:, None]
        box = material == Material.FURNITURE
        albedo[box] = _FURNITURE[body[box] % len(_FURNITURE)]
        own = material >= Material.PARKED_CAR  # as those of meshes
        albedo[own] = self.colour[face[own]]
        crown = material == Material.CROWN
        leaf = 0.6 + 0.8 * noise(point[crown][:, :2] * 2.5 + point[crown][:, 2:] * 1.7)
        tint = 0.8 + 0.4 * (body[crown] * 0.618 % 1.0)
        albedo[crown] = np.array([0.065, 0.11, 0.035]) * (leaf * tint)[:, None]
        wall = material == Material.BUILDING
        albedo[wall] = _facade_colours(point[wall], normal[wall], body[wall])
        return albedo, semantic


def _facade_colours(point: R3, normal: R3, body: Int[np.ndarray, " R"]) -> R3:
    """Linear albedo of walls: plaster or brick with rows of windows, one every 2.8 m and 3 m."""
    along = point[:, 1] * normal[:, 0] - point[:, 0] * normal[:, 1]
    across, up = along % 2.8, (point[:, 2] + 0.4) % 3.0
    pane = (across > 0.8) & (across < 2.1) & (up > 1.0) & (up < 2.4)
    frame = (across > 0.7) & (across < 2.2) & (up > 0.9) & (up < 2.5)
    plaster = 0.9 + 0.2 * noise(np.column_stack([along, point[:, 2]]) * 1.3)
    colour = _WALLS[body % len(_WALLS)] * plaster[:, None]
    colour = np.where(frame[:, None], 0.55, colour)
    return np.where(pane[:, None], [0.05, 0.06, 0.075], colour)


def build_static_world(
    intersection: Intersection,
    radius: float,
    masts: Float[np.ndarray, "U 4"],
    bodies: Sequence[StaticBody] = (),
) -> StaticWorld:
    """The static world of an intersection, out to :data:`HORIZON`. ``masts`` holds foot (x, y, z)
    and height of each unit's mast [m]; those over the carriageway hang on wires and get none. Other
    buildings and trees stand at random places, seeded by the intersection's name."""
    center = np.asarray(intersection.center, float)
    road = [s for r, s in intersection.regions.items() if r in CARRIAGEWAY]
    masts = masts[~shapely.intersects_xy(unary_union(road), *masts[:, :2].T)]
    fixed, poles, surface = _all_but_masts(intersection, radius, tuple(bodies))
    apart = [p for p in poles if all(np.hypot(*(p[:2] - m[:2])) > 0.5 for m in masts)]
    posts = np.array([*masts, *apart], float).reshape(-1, 4)
    parts = [*(Part(_tube(p[:3], POLE_RADIUS, p[3]), Material.POLE) for p in posts), *fixed]
    sizes = [len(part.triangles) for part in parts]
    colours = [np.broadcast_to(part.colour, (len(part.triangles), 3)) for part in parts]
    return StaticWorld(
        center=center,
        triangles=(np.concatenate([part.triangles for part in parts]) - center).astype(np.float32),
        material=np.repeat([part.material for part in parts], sizes),
        body=np.repeat([part.body for part in parts], sizes),
        surface=surface,
        poles=posts[:, :3] + np.array([0.0, 0.0, 1.0]) * posts[:, 3:],
        colour=np.concatenate(colours).astype(np.float32),
    )


@lru_cache(maxsize=4)
def _all_but_masts(
    intersection: Intersection, radius: float, bodies: tuple[StaticBody, ...]
) -> tuple[tuple[Part, ...], Float[np.ndarray, "P 4"], Surface]:
    """All but poles, foot (x, y, z) and height of each pole [m], and surface; takes longest."""
    rng = np.random.default_rng(zlib.crc32(intersection.name.encode()))
    own = unary_union([one.polygon for one in bodies])
    mesh = intersection.mesh if any(one.kind == "solid" for one in bodies) else None
    parts = [Part(_ground(intersection, radius), Material.GROUND)]
    if mesh is None:
        parts += [Part(ring, Material.KERB) for ring in _kerbs(intersection)]
        taken = unary_union(list(intersection.regions.values())).buffer(CLEAR)
        if bodies:
            taken = unary_union([taken, own.buffer(CLEAR)])
        built = list[Polygon]()
        for k, corners in enumerate(_plots(intersection, taken, radius, rng)):
            base, height = static_bodies.foot_of(corners, intersection), float(rng.uniform(6, 18))
            sides, roof, _ = prism(corners, base, base + static_bodies.FOUNDATION + height)
            parts += [Part(sides, Material.BUILDING, body=k), Part(roof, Material.ROOF, body=k)]
            built.append(Polygon(corners).buffer(1.0))
        taken = unary_union([taken, *built])
        for k, (foot, height) in enumerate(_trees(intersection, taken, radius, rng)):
            parts.append(Part(_tube(foot, 0.18, 0.45 * height), Material.TRUNK, body=k))
            parts.append(Part(_crown(foot, height, rng), Material.CROWN, body=k))
    else:
        faces, colour = _surveyed(mesh, intersection)
        parts.append(Part(faces, Material.SURVEYED, colour))
    for k, one in enumerate(bodies):
        if mesh is None or one.kind != "solid":
            parts += [part._replace(body=k) for part in static_bodies.body_parts(one, intersection)]
    surface = lay_surface(intersection, radius + MARGIN)
    return tuple(parts), _poles(intersection, radius, own), surface


def _poles(place: Intersection, radius: float, own: BaseGeometry) -> Float[np.ndarray, "P 4"]:
    """Feet and heights of the poles of the place that are near and clear of its bodies ``own``."""
    feet = np.asarray(place.poles, float)
    away = np.hypot(*(feet - np.asarray(place.center, float))[:, :2].T)
    beside = shapely.dwithin(shapely.points(feet[:, :2]), own, 0.5)
    feet = feet[(away <= radius + MARGIN) & ~beside]
    return np.column_stack([feet, np.full(len(feet), POLE_HEIGHT)])


def _surveyed(mesh: Mesh, place: Intersection) -> tuple[F33, Float[np.ndarray, "F 3"]]:
    """The faces of a mesh, and their albedos: without the ground's, those beyond the known ground,
    and what stands in the way of traffic, as scores."""
    triangles = mesh.world
    corners = triangles.reshape(-1, 3)
    over = (corners[:, 2] - place.ground(corners[:, :2])).reshape(-1, 3)
    low, high = place.ground_points[:, :2].min(0), place.ground_points[:, :2].max(0)
    known = ((triangles[..., :2] >= low) & (triangles[..., :2] <= high)).all((1, 2))
    ways, middle = Ways.of(place), triangles[..., :2].mean(1)
    in_way = np.zeros(len(triangles), bool)
    for base in (0.0, HEADROOM):
        area = ways.under(base)
        shapely.prepare(area)
        below = over.max(1) < (HEADROOM if base == 0 else OVER_LANES)
        in_way |= below & shapely.contains_xy(area, *middle.T)
    shown = (over.max(1) > LOW) & known & ~in_way
    return triangles[shown], (mesh.colour[shown] / 255.0) ** SRGB


def _ground(intersection: Intersection, radius: float) -> F33:
    """The ground as a grid of 1 m on the map and coarser beyond; two triangles if it is flat."""
    center = intersection.center
    heights = intersection.ground_points[:, 2]
    if np.ptp(heights) < 1e-6:
        lines = np.array([-HORIZON, HORIZON])
    else:
        near = np.arange(-np.ceil(radius + MARGIN), np.ceil(radius + MARGIN) + 1)
        far = np.linspace(near[-1], HORIZON, 20)[1:]
        lines = np.concatenate([-far[::-1], near, far])
    x, y = np.meshgrid(center[0] + lines, center[1] + lines, indexing="ij")
    z = intersection.ground(np.column_stack([x.ravel(), y.ravel()])).reshape(x.shape)
    return np.stack([x, y, z], -1).reshape(-1, 3)[lattice_faces(*x.shape)]


def _kerbs(intersection: Intersection) -> Iterator[F33]:
    regions = intersection.regions
    road = [regions[r] for r in (Region.DRIVEWAY, Region.JUNCTION) if r in regions]
    foot = [regions[r] for r in (Region.SIDEWALK, Region.SHOULDER) if r in regions]
    if not road or not foot:
        return
    carriageway = unary_union(road)
    edge = carriageway.boundary.intersection(unary_union(foot).buffer(0.3))
    if Region.CROSSWALK in regions:
        edge = edge.difference(regions[Region.CROSSWALK].buffer(0.5))
    width, height = KERB_SIZE
    ribbon = edge.segmentize(3.0).buffer(width / 2, cap_style="flat", join_style="mitre")
    for part in shapely.get_parts(ribbon.difference(carriageway)):
        for ring in [part.exterior, *part.interiors] if part.geom_type == "Polygon" else []:
            line = np.asarray(ring.coords)[:-1, :2]
            low = np.column_stack([line, intersection.ground(line) - 0.05])
            yield walls(low, low + [0.0, 0.0, height + 0.05])
        top = static_bodies.flat_triangles(part)
        z = intersection.ground(top.reshape(-1, 2)).reshape(-1, 3) + height
        yield np.concatenate([top, z[..., None]], -1)


def _tube(foot: np.ndarray, radius: float, height: float) -> F33:
    turn = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    ring = foot + radius * np.column_stack([np.cos(turn), np.sin(turn), np.zeros(8)])
    top = ring + [0.0, 0.0, height]
    cap = np.broadcast_to(foot + [0.0, 0.0, height], (8, 3))
    return np.concatenate([walls(ring, top), np.stack([top, np.roll(top, -1, 0), cap], 1)])


def _plots(
    intersection: Intersection, taken: BaseGeometry, radius: float, rng: np.random.Generator
) -> Iterator[Float[np.ndarray, "4 2"]]:
    """Corners of buildings that face the streets and keep clear of ``taken`` and of each other."""
    built: list[Polygon] = []
    streets = unary_union(list(intersection.regions.values())).boundary
    for _ in range(BUILDINGS):
        for _ in range(25):
            away = radius + rng.uniform(6, 60)
            turn = rng.uniform(0, 2 * np.pi)
            at = intersection.center[:2] + away * np.array([np.cos(turn), np.sin(turn)])
            size = rng.uniform([9, 8], [22, 16]) / 2
            close = streets.interpolate(streets.project(Point(at)))
            facing = np.arctan2(close.y - at[1], close.x - at[0])
            axes = np.array([[np.cos(facing), np.sin(facing)], [-np.sin(facing), np.cos(facing)]])
            corners = at + (np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * size) @ axes
            shape = Polygon(corners)
            clear = shape.distance(Point(intersection.center[:2])) > radius + CLEAR
            if clear and shape.disjoint(taken) and all(shape.distance(b) > 1.5 for b in built):
                built.append(shape)
                yield corners
                break


def _trees(
    intersection: Intersection, taken: BaseGeometry, radius: float, rng: np.random.Generator
) -> Iterator[tuple[Float[np.ndarray, "3"], float]]:
    for _ in range(TREES):
        height = rng.uniform(4.5, 9.0)
        for _ in range(15):
            turn, away = rng.uniform(0, 2 * np.pi), radius + rng.uniform(4, 45)
            at = intersection.center[:2] + away * np.array([np.cos(turn), np.sin(turn)])
            if Point(at).distance(taken) > 0.35 * height:
                yield np.array([*at, intersection.ground(at[None])[0]]), float(height)
                break


def _crown(foot: np.ndarray, height: float, rng: np.random.Generator) -> F33:
    tall, wide = 0.62 * height / 2, 0.28 * height
    rows, columns = 5, 8
    up = np.linspace(-np.pi / 2, np.pi / 2, rows + 1)[:, None]
    turn = np.linspace(0, 2 * np.pi, columns, endpoint=False)[None]
    lump = 1 + rng.uniform(-0.18, 0.18, (rows + 1, columns))
    lump[[0, -1]] = 1.0
    x = wide * np.cos(up) * np.cos(turn) * lump
    y = wide * np.cos(up) * np.sin(turn) * lump
    z = np.broadcast_to(tall * np.sin(up), x.shape)
    ball = np.stack([x, y, z], -1) + foot + [0.0, 0.0, height - tall]
    return walls(ball[:-1], ball[1:])
