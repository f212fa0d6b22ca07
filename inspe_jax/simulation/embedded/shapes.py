"""Low-polygon shapes of road users (``shapes.npz``) and their colours (``paint.toml``). A shape
fills a unit box: scaled by (length, width, height), that of a road user.

``made`` says how shapes were made. Each has a ``kind``, ``name``, natural ``size`` [m], ``steps``
of its cycle and counts; ``vertices``, ``faces`` and ``part`` hold all shapes, one after another.
"""

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files

import numpy as np
from jaxtyping import Float, Int

from inspe_jax.core.errors import check_known

_HERE = files("inspe_jax.simulation.embedded")
PHASES = 24  # number of steps of a cycle. Phases are rounded to a step

STRETCH = 0.15
"""Shapes fit boxes whose sides differ by this share at most, as models of one segment do."""


@dataclass(frozen=True)
class Shape:
    """A mesh that fills −0.5 … 0.5 on each axis: x forward, y left, z up; faces run
    counter-clockwise, seen from outside. Arrays are shared and read-only."""

    vertices: Float[np.ndarray, "N 3"]
    faces: Int[np.ndarray, "F 3"]
    part: Int[np.ndarray, " F"]


_Row = tuple[str, Float[np.ndarray, "3"], tuple[Shape, ...]]


def _read() -> tuple[tuple[str, ...], dict[str, _Row]]:
    """The parts; and by the shape's name its class, its natural size [m] and its steps."""
    with _HERE.joinpath("shapes.npz").open("rb") as f:
        data = dict(np.load(f))
    data["faces"] = data["faces"].astype(np.int32)
    for array in data.values():
        array.setflags(write=False)
    rows, vertex, face = dict[str, _Row](), 0, 0
    for i, name in enumerate(data["name"].tolist()):
        steps, n, m = (int(data[of][i]) for of in ("steps", "vertex_count", "face_count"))
        points = data["vertices"][vertex : vertex + steps * n].reshape(steps, n, 3)
        faces, part = data["faces"][face : face + m], data["part"][face : face + m]
        shapes = tuple(Shape(p, faces, part) for p in points)
        rows[name] = str(data["kind"][i]), data["size"][i], shapes
        vertex, face = vertex + steps * n, face + m
    return tuple(data["parts"].tolist()), rows


PARTS, _BY_NAME = _read()
"""The parts of road users, each of which has colours of its own; and the shapes."""
_PAINT = tomllib.loads(_HERE.joinpath("paint.toml").read_text(encoding="utf-8"))

VARIANTS: dict[str, tuple[str, ...]] = {
    kind: tuple(name for name, row in _BY_NAME.items() if row[0] == kind)
    for kind in dict.fromkeys(row[0] for row in _BY_NAME.values())
}
"""Names of the shapes of each class of road user."""


def shape_of(name: str, phase: float = 0.0) -> Shape:
    """The shape of a name; ``phase`` of a stride or a turn of the crank is in cycles."""
    check_known(name, _BY_NAME, "shape")
    steps = _BY_NAME[name][2]
    return steps[round(phase * PHASES) % len(steps)]


def natural_size(name: str) -> Float[np.ndarray, "3"]:
    """Length, width and height at which a shape has natural proportions [m]."""
    return _BY_NAME[name][1]


def fitting(kind: str, size: Sequence[float] | Float[np.ndarray, "3"]) -> tuple[str, ...]:
    """The names of a class's shapes that fit a box [m], or the one that is stretched least."""
    check_known(kind, VARIANTS, "class")
    own = np.array([natural_size(name) for name in VARIANTS[kind]])
    stretch = np.abs(np.log(np.asarray(size, float) / own))
    most = stretch[:, 2] if kind == "pedestrian" else stretch.max(1)
    found = np.flatnonzero(most <= np.log1p(STRETCH))
    return tuple(VARIANTS[kind][i] for i in (found if len(found) else [most.argmin()]))


def paint(kind: str, rng: np.random.Generator) -> Float[np.ndarray, "P 3"]:
    """Linear albedo of all :data:`PARTS` of a road user: drawn, and converted from sRGB."""
    check_known(kind, VARIANTS, "class")
    palettes = _PAINT["all"] | _PAINT.get(kind, {})
    srgb = np.zeros((len(PARTS), 3))
    for into, part in zip(srgb, PARTS, strict=True):
        shares = np.array([share for _, share in palettes[part]])
        drawn, _ = palettes[part][rng.choice(len(shares), p=shares / shares.sum())]
        rgb = np.array([*bytes.fromhex(drawn[1:])]) / 255
        into[:] = np.clip(rgb * rng.normal(1.0, 0.05), 0, 1)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
