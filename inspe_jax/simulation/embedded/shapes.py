"""Low-polygon shapes of the road users, made in code: cameras and LiDARs record these.

A shape fills a unit box. Scaled by (length, width, height) it fills the box of a road user exactly,
so that the boxes in a data set are the true extents. Each shape is a row of a table: ``CARS``,
``TRUCKS`` and ``BUSES``, ``RIDERS`` and ``PEOPLE``. To add one, add its row.

Why these modules (``shapes*.py``) and not a library: the primitives of Trimesh are boxes, cylinders
and extrusions. They would replace a small part of ``shapes_mesh`` only, and would not say which
part of a vehicle or a person each triangle belongs to, which its colour needs. The rest says what
cars and people look like. Trimesh would also be one more dependency of recording.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Protocol

import numpy as np
from jaxtyping import Float, Int

from inspe_jax.core.errors import InspeError
from inspe_jax.simulation.embedded.shapes_cars import CARS, car
from inspe_jax.simulation.embedded.shapes_mesh import PARTS, Mesh
from inspe_jax.simulation.embedded.shapes_paint import paint
from inspe_jax.simulation.embedded.shapes_people import PEOPLE, pedestrian
from inspe_jax.simulation.embedded.shapes_riders import RIDERS, pedals, rider
from inspe_jax.simulation.embedded.shapes_trucks import BUSES, TRUCKS, truck

__all__ = ["PARTS", "PHASES", "VARIANTS", "Shape", "fitting", "natural_size", "paint", "shape_of"]


class Row(Protocol):
    """A row of a table of shapes: ``size`` are length, width, height in natural proportions [m]."""

    @property
    def size(self) -> tuple[float, float, float]: ...


ROWS: dict[str, Mapping[str, Row]] = {
    "car": CARS,
    "truck": {**TRUCKS, **BUSES},
    "cyclist": RIDERS,
    "pedestrian": PEOPLE,
}
"""The tables of shapes of each class of road user."""

VARIANTS: dict[str, tuple[str, ...]] = {kind: tuple(rows) for kind, rows in ROWS.items()}
"""Names of the shapes of each class of road user."""

PHASES = 24
"""Number of steps of a cycle. Phases are rounded to a step, so that shapes can be cached."""

STRETCH = 0.15
"""A shape fits a box if no side of the box is larger or smaller than its own by a larger share.

Models of one segment differ by about as much; a saloon that is stretched by more is no saloon.
"""

_MAKERS: dict[str, Callable[[str, float], Mesh]] = {
    "car": lambda name, _: car(name),
    "truck": lambda name, _: truck(name),
    "cyclist": rider,
    "pedestrian": pedestrian,
}


@dataclass(frozen=True)
class Shape:
    """A mesh that fills −0.5 … 0.5 on each axis: x forward, y left, z up, the ground at −0.5.

    The corners of a face run counter-clockwise, seen from outside. ``part`` is an index into
    ``PARTS``. At its :func:`natural_size` the shape has natural proportions. The arrays are shared
    and read-only.
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
    return _shape(kind, name, round(phase * PHASES) % PHASES if moves(kind, name) else 0)


def moves(kind: str, name: str) -> bool:
    """Whether a shape has phases: people who walk, and riders who pedal."""
    if kind == "pedestrian":
        return PEOPLE[name].stands is None
    return kind == "cyclist" and pedals(name)


def natural_size(kind: str, variant: int) -> tuple[float, float, float]:
    """Length, width and height at which a shape has natural proportions [m]."""
    return ROWS[kind][VARIANTS[kind][variant]].size


def fitting(kind: str, size: Sequence[float] | Float[np.ndarray, "3"]) -> Int[np.ndarray, " M"]:
    """The variants of a class that fit a box of ``size`` (length, width, height) [m], M ≥ 1.

    Those that need to be stretched by at most :data:`STRETCH`, or if there are none, the one that
    needs it least. Of pedestrians only the height counts: what they take up in plan is their
    stride. Raises InspeError for an unknown class.
    """
    if kind not in VARIANTS:
        raise InspeError(f"class '{kind}': one of {', '.join(VARIANTS)}")
    own = np.array([row.size for row in ROWS[kind].values()])
    stretch = np.abs(np.log(np.asarray(size, float) / own))
    most = stretch[:, 2] if kind == "pedestrian" else stretch.max(1)
    found = np.flatnonzero(most <= np.log1p(STRETCH))
    return found if len(found) else np.array([most.argmin()])


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
