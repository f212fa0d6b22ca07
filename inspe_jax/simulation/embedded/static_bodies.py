"""The static bodies of a scene as triangles: the same outlines and heights that scores take, but
for rounded crowns, with gaps that let light through, and shapes of parked vehicles."""

from collections.abc import Callable, Iterator
from enum import IntEnum
from functools import partial
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Float
from numpy.random import Generator
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry

from inspe_jax.core.geometry import rotation
from inspe_jax.scene.intersection import Intersection
from inspe_jax.scene.statics import StaticBody, octagon
from inspe_jax.simulation.embedded.embree import F33
from inspe_jax.simulation.embedded.road_users import box_of, is_box, kind_of
from inspe_jax.simulation.embedded.shapes import fitting, paint, shape_of

FOUNDATION = 0.5
"""What stands on the ground begins this far below the lowest ground at its corners [m]."""
RINGS = ((0.0, 0.80), (0.15, 0.97), (0.4, 1.0), (0.65, 0.97), (0.85, 0.85), (1.0, 0.55))
"""The rings of a crown: height as a share of the crown's, and size as a share of its outline's."""
_BETWEEN = 3  # points of a ring to each side of the crown's outline

Material = IntEnum(
    "Material",
    "GROUND KERB BUILDING ROOF TRUNK CROWN POLE WALL FURNITURE PARKED_CAR PARKED_TRUCK SURVEYED",
    start=0,
)
"""What faces are made of; parked vehicles and meshes (SURVEYED) have colours of their own."""


class Part(NamedTuple):
    """Triangles of one material [m], colours of their own, and the number of their body."""

    triangles: F33
    material: Material
    colour: float | Float[np.ndarray, "F 3"] = 0.0
    body: int = 0


def body_parts(one: StaticBody, place: Intersection) -> Iterator[Part]:
    """The triangles of one body on the ground of a place."""
    level = float(place.ground(one.middle[None])[0])
    # Its look depends on its own place alone: other bodies do not change it.
    yield from _LOOKS[one.kind](one, place, level, np.random.default_rng(one.number))


def walls(low: Float[np.ndarray, "*n N 3"], high: Float[np.ndarray, "*n N 3"]) -> F33:
    """The walls between two rings of points: two triangles for each side."""
    a, b, c, d = low, np.roll(low, -1, -2), np.roll(high, -1, -2), high
    return np.concatenate([np.stack([a, b, c], -2), np.stack([a, c, d], -2)]).reshape(-1, 3, 3)


def flat_triangles(shape: BaseGeometry) -> Float[np.ndarray, "F 3 2"]:
    """Triangles that cover a shape, with its corners."""
    cut = shapely.get_parts(shapely.constrained_delaunay_triangles(shape))
    return np.array([np.asarray(t.exterior.coords)[:3, :2] for t in cut]).reshape(-1, 3, 2)


def prism(outline: Float[np.ndarray, "N 2"], bottom: float, top: float) -> tuple[F33, F33, F33]:
    """The sides, the top and the bottom of a prism."""
    low = np.column_stack([outline, np.full(len(outline), bottom)])
    high = low + [0.0, 0.0, top - bottom]
    flat = flat_triangles(Polygon(outline))

    def lid(z: float) -> np.ndarray:
        return np.concatenate([flat, np.full((*flat.shape[:2], 1), z)], 2)

    return walls(low, high), lid(top), lid(bottom)


def _bottom(one: StaticBody, place: Intersection, level: float) -> float:
    """Where a body begins [m]; below the ground if it stands on it."""
    return level + one.base if one.base > 0 else foot_of(one.outline, place)


def foot_of(outline: Float[np.ndarray, "N 2"], place: Intersection) -> float:
    """Below the lowest ground at the corners of what stands on it [m]."""
    return float(place.ground(outline).min()) - FOUNDATION


def _solid(
    side: Material,
    top: Material,
    one: StaticBody,
    place: Intersection,
    level: float,
    rng: Generator,
) -> Iterator[Part]:
    sides, lid, floor = prism(one.outline, _bottom(one, place, level), level + one.height)
    yield Part(_thinned(sides, one, rng), side)
    yield Part(_thinned(lid, one, rng), top)
    if one.base > 0:
        yield Part(_thinned(floor, one, rng), side)
    yield from _trunk(one, place, level)


def _trunk(one: StaticBody, place: Intersection, level: float) -> Iterator[Part]:
    if one.trunk > 0:
        outline = octagon(one.middle, one.trunk)
        sides, lid, _ = prism(outline, foot_of(outline, place), level + one.base)
        yield Part(np.concatenate([sides, lid]), Material.TRUNK)


def _thinned(faces: F33, one: StaticBody, rng: Generator) -> Float[np.ndarray, "f 3 3"]:
    """Faces without those that light passes: a ray meets two, so a share of √transmittance."""
    if one.transmittance == 0:
        return faces
    return faces[rng.uniform(size=len(faces)) >= np.sqrt(one.transmittance)]


def _tree(one: StaticBody, place: Intersection, level: float, rng: Generator) -> Iterator[Part]:
    """A crown of rings like the outline, smaller at both ends, with leaves left out."""
    bottom = _bottom(one, place, level)
    tall = level + one.height - bottom
    share = np.arange(_BETWEEN)[:, None] / _BETWEEN
    ahead = np.roll(one.outline, -1, 0)[:, None]
    outline = (one.outline[:, None] * (1 - share) + ahead * share).reshape(-1, 2)
    rings = []
    for up, wide in RINGS:
        # Lumps go inwards only: the crown stays within its prism.
        size = wide * (1 - rng.uniform(0, 0.1, (len(outline), 1)))
        ring = one.middle + size * (outline - one.middle)
        rings.append(np.column_stack([ring, np.full(len(ring), bottom + up * tall)]))
    ball = np.array(rings)
    faces = [walls(ball[:-1], ball[1:])]
    for ring, middle in ((ball[0], bottom), (ball[-1], bottom + tall)):
        tip = np.broadcast_to([*one.middle, middle], ring.shape)
        faces.append(np.stack([ring, np.roll(ring, -1, 0), tip], 1))
    yield Part(_thinned(np.concatenate(faces), one, rng), Material.CROWN)
    yield from _trunk(one, place, level)


def _parked(one: StaticBody, place: Intersection, level: float, rng: Generator) -> Iterator[Part]:
    """The shape of a vehicle that fits, in a colour of its own; a plain box on other outlines."""
    if not is_box(one):
        yield from _FURNITURE(one, place, level, rng)
        return
    size, yaw = box_of(one)
    kind = kind_of(size)
    shape, colours = shape_of(str(rng.choice(fitting(kind, size)))), paint(kind, rng)
    turn = rotation(np.array([0.0, 0.0, yaw]), np)
    at = np.array([*one.middle, level + one.height / 2])
    corners = (shape.vertices * size) @ turn.T + at
    material = Material.PARKED_TRUCK if kind == "truck" else Material.PARKED_CAR
    yield Part(corners[shape.faces], material, colours[shape.part])


_FURNITURE = partial(_solid, Material.FURNITURE, Material.FURNITURE)
_LOOKS: dict[str, Callable[..., Iterator[Part]]] = {
    "building": partial(_solid, Material.BUILDING, Material.ROOF),
    "wall": partial(_solid, Material.WALL, Material.WALL),
    "hedge": partial(_solid, Material.CROWN, Material.CROWN),
    "tree": _tree,
    "pole": partial(_solid, Material.POLE, Material.POLE),
    "furniture": _FURNITURE,
    "parked vehicle": _parked,
    "solid": partial(_solid, Material.BUILDING, Material.ROOF),
}
"""How each of :data:`~inspe_jax.scene.statics.KINDS` looks."""
