"""Low-polygon shapes of the road users, made in code: cameras and LiDARs record these.

A shape fills a unit box. Scaled by (length, width, height) it fills the box of a road user exactly,
so that the boxes in a data set are the true extents.

Why these modules (``shapes*.py``) and not a library: the primitives of Trimesh are boxes, cylinders
and extrusions. They would replace a small part of ``shapes_mesh`` only, and would not say which
part of a vehicle or a person each triangle belongs to, which its colour needs. The rest says what
cars and people look like. Trimesh would also be one more dependency of recording.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float, Int

from inspe_jax.core.errors import InspeError
from inspe_jax.simulation.embedded.shapes_mesh import PARTS, Mesh
from inspe_jax.simulation.embedded.shapes_paint import paint
from inspe_jax.simulation.embedded.shapes_people import POSTURES, WALKERS, cyclist, pedestrian
from inspe_jax.simulation.embedded.shapes_vehicles import CARS, car, truck

__all__ = ["PARTS", "PHASES", "VARIANTS", "Shape", "paint", "shape_of"]

VARIANTS: dict[str, tuple[str, ...]] = {
    "car": tuple(CARS),
    "truck": ("truck.box", "truck.tipper", "truck.bus"),
    "cyclist": tuple(POSTURES),
    "pedestrian": ("walker.standing", *WALKERS),
}
"""Names of the shapes of each class of road user."""

PHASES = 24
"""Number of steps of a cycle. Phases are rounded to a step, so that shapes can be cached."""

_MAKERS: dict[str, Callable[[str, float], Mesh]] = {
    "car": lambda name, _: car(name),
    "truck": lambda name, _: truck(name),
    "cyclist": cyclist,
    "pedestrian": pedestrian,
}


@dataclass(frozen=True)
class Shape:
    """A mesh that fills −0.5 … 0.5 on each axis: x forward, y left, z up, the ground at −0.5.

    The corners of a face run counter-clockwise, seen from outside. ``part`` is an index into
    ``PARTS``. At the mean size of its class the shape has natural proportions. The arrays are
    shared and read-only.
    """

    vertices: Float[np.ndarray, "N 3"]
    faces: Int[np.ndarray, "F 3"]
    part: Int[np.ndarray, " F"]
    name: str


def shape_of(kind: str, variant: int, phase: float = 0.0) -> Shape:
    """The shape of a road user of class ``kind``; ``variant`` is an index into its ``VARIANTS``.

    ``phase`` is how far a stride (pedestrian) or a turn of the crank (cyclist) has come, in cycles.
    It is rounded to a step of :data:`PHASES`, and ignored for people who stand and for vehicles.
    Raises InspeError for an unknown class or variant.
    """
    if kind not in VARIANTS:
        raise InspeError(f"class '{kind}': one of {', '.join(VARIANTS)}")
    if not 0 <= variant < len(VARIANTS[kind]):
        raise InspeError(
            f"{kind} variant {variant} is out of range: 0 to {len(VARIANTS[kind]) - 1}"
        )
    name = VARIANTS[kind][variant]
    moves = name in POSTURES or name in WALKERS
    return _shape(kind, name, round(phase * PHASES) % PHASES if moves else 0)


@cache
def _shape(kind: str, name: str, step: int) -> Shape:
    mesh = _MAKERS[kind](name, step / PHASES)
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    shape = Shape(
        ((mesh.vertices - low) / (high - low) - 0.5).astype(np.float32),
        mesh.faces.astype(np.int32),
        mesh.part.astype(np.int8),
        name,
    )
    for array in (shape.vertices, shape.faces, shape.part):
        array.setflags(write=False)
    return shape
