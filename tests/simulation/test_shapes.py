"""Shapes fill their boxes, show only their outsides, and have the parts of their class."""

import numpy as np
import pytest

from inspe_jax.core.errors import InspeError
from inspe_jax.scene.traffic.frames import CLASSES, ROAD_USERS
from inspe_jax.simulation.embedded import shapes
from inspe_jax.simulation.embedded.embree import Caster
from inspe_jax.simulation.embedded.shapes import PARTS, VARIANTS, fitting, paint, shape_of

pytest.importorskip("embreex", reason="no wheels of Embree for this platform")

EVERY = [(kind, name) for kind in VARIANTS for name in VARIANTS[kind]]
ADULT = ROAD_USERS[CLASSES.index("pedestrian")].size
ALIKE = ("car", "truck")
"""Classes of vehicles, which are solid; limbs of the others intersect."""


def test_shapes_fill_the_unit_box_and_fit_a_box_of_their_size():
    for kind, name in EVERY:
        assert name in fitting(kind, shapes.natural_size(name))
        moves = shape_of(name) is not shape_of(name, 0.5)
        for step in range(0, shapes.PHASES, 3) if moves else (0,):
            shape = shape_of(name, step / shapes.PHASES)
            assert (shape.vertices.min(0) == -0.5).all(), name
            assert (shape.vertices.max(0) == 0.5).all(), name
            types = shape.vertices.dtype, shape.faces.dtype, shape.part.dtype
            assert types == (np.float32, np.int32, np.int8)
            assert not shape.vertices.flags.writeable


@pytest.mark.parametrize(("kind", "name"), EVERY)
def test_only_outsides_are_visible(kind, name):
    """From all around and above, towards all of the box: no gap shows the inside of a face. Limbs
    that intersect may show a few; of a vehicle a ray may slip through at a seam, which in single
    precision is not always straight."""
    size, shape, rng = shapes.natural_size(name), shape_of(name, 0.3), np.random.default_rng(0)
    triangles = (shape.vertices * size)[shape.faces]
    eyes = rng.normal(size=(20_000, 3))
    eyes[:, 2] = np.abs(eyes[:, 2])
    eyes *= 3 * np.linalg.norm(size) / np.linalg.norm(eyes, axis=1, keepdims=True)
    rays = rng.uniform(-0.5, 0.5, eyes.shape) * size - eyes
    hit = Caster(triangles).cast(eyes, rays / np.linalg.norm(rays, axis=1, keepdims=True), 1e4).face
    met = hit >= 0
    out = np.cross(*(triangles[hit[met], k] - triangles[hit[met], 0] for k in (1, 2)))
    inside = (out * rays[met]).sum(1) > 0
    assert met.mean() > 0.1
    assert inside.sum() <= (3 if kind in ALIKE else 0.002 * met.sum())


def test_every_class_has_shapes_and_every_part_is_used_and_painted():
    assert tuple(VARIANTS) == CLASSES
    used = {PARTS[p] for _, name in EVERY for p in shape_of(name).part}
    assert used == set(PARTS)
    for kind in VARIANTS:
        for seed in range(50):
            colours = paint(kind, np.random.default_rng(seed))
            assert colours.shape == (len(PARTS), 3)
            assert 0 <= colours.min() <= colours.max() <= 1


@pytest.mark.parametrize(("kind", "size", "fit"), [
    ("truck", (16.5, 2.55, 4.0), {"truck.articulated", "truck.container",
                                  "truck.articulated_tank", "truck.road_train"}),
    ("truck", (30.0, 2.55, 4.0), {"truck.road_train"}),  # none: the nearest
    ("car", (3.7, 1.66, 1.48), {name for name in VARIANTS["car"] if "van" not in name}),
    ("pedestrian", ADULT, {name for name in VARIANTS["pedestrian"] if "child" not in name}),
    ("cyclist", (2.5, 0.7, 1.75), {"bicycle.cargo", "motorcycle.tourer"}),
    ("pedestrian", (0.3, 0.3, 0.8), {"walker.child_3"}),
])  # fmt: skip
def test_the_size_of_a_box_decides(kind, size, fit):
    """Among others: the length, for what is long; the height, for children."""
    found = {*fitting(kind, size)}
    assert found
    assert found <= fit


def test_unknown_shapes():
    with pytest.raises(InspeError, match="class 'tram': one of car, truck, cyclist"):
        fitting("tram", (9, 2, 3))
    with pytest.raises(InspeError, match=r"shape 'car\.jeep': one of car\.micro"):
        shape_of("car.jeep")
