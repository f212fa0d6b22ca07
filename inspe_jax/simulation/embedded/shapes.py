"""Low-polygon shapes of the road users, made in code: what cameras and LiDARs are shown.

A shape fills a unit box, so that scaling by (length, width, height) fits it to an
oriented prism of the traffic, and the ground truth is the shape's own extent.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float, Int

from inspe_jax.core.errors import InspeError
from inspe_jax.simulation.embedded.shapes_mesh import PARTS, Mesh
from inspe_jax.simulation.embedded.shapes_paint import paint, reflectance
from inspe_jax.simulation.embedded.shapes_people import POSTURES, WALKERS, cyclist, pedestrian
from inspe_jax.simulation.embedded.shapes_vehicles import CARS, car, truck

__all__ = ["PARTS", "PHASES", "VARIANTS", "Shape", "paint", "reflectance", "shape_of"]

VARIANTS: dict[str, tuple[str, ...]] = {
    "car": tuple(CARS),
    "truck": ("truck.box", "truck.tipper", "truck.bus"),
    "cyclist": tuple(POSTURES),
    "pedestrian": ("walker.standing", *WALKERS),
}
"""Names of the shapes of each class of road user."""

PHASES = 24
"""Steps of a cycle to which phases are rounded, so that shapes can be kept."""

_MAKERS: dict[str, Callable[[str, float], Mesh]] = {
    "car": lambda name, _: car(name),
    "truck": lambda name, _: truck(name),
    "cyclist": cyclist,
    "pedestrian": pedestrian,
}


@dataclass(frozen=True)
class Shape:
    """A mesh that fills −0.5 … 0.5 on each axis: x forward, y left, z up, the ground at −0.5.

    Faces wind counter-clockwise seen from outside; ``part`` indexes ``PARTS``.
    Scaled to the mean size of its class it has its natural proportions. The arrays
    are shared and cannot be written to.
    """

    vertices: Float[np.ndarray, "N 3"]
    faces: Int[np.ndarray, "F 3"]
    part: Int[np.ndarray, " F"]
    name: str


def shape_of(kind: str, variant: int, phase: float = 0.0) -> Shape:
    """The shape of a class's variant, an index into its ``VARIANTS``.

    ``phase`` is where in a stride (pedestrian) or a turn of the crank (cyclist) it
    is, in cycles, to the nearest of :data:`PHASES`; who stands or drives has none.
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
