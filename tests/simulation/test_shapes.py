"""Shapes fill their boxes, show only their outsides, and have the parts of their class."""

from importlib import resources

import numpy as np
import pytest

from inspe_jax.core.errors import InspeError
from inspe_jax.scene.traffic.frames import CLASSES, ROAD_USERS
from inspe_jax.simulation.embedded.road_users import _variant
from inspe_jax.simulation.embedded.shapes import (
    PARTS,
    PHASES,
    VARIANTS,
    Shape,
    fitting,
    natural_size,
    paint,
    shape_of,
)

EVERY = [(kind, i) for kind in VARIANTS for i in range(len(VARIANTS[kind]))]
NAMES = [VARIANTS[kind][i] for kind, i in EVERY]
MEAN = {user.name: np.array(user.size) for user in ROAD_USERS}
ALIKE = ("car", "truck")
"""Classes of vehicles, which are solid; limbs of the others intersect."""


def moves(kind: str, variant: int) -> bool:
    return shape_of(kind, variant) is not shape_of(kind, variant, 0.5)


def corners(shape: Shape, size: np.ndarray) -> np.ndarray:
    """Triangles (F, 3, 3) of a shape at a given size, centred at 0."""
    return (shape.vertices * size)[shape.faces]


def normals(triangles: np.ndarray) -> np.ndarray:
    across = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return across / np.linalg.norm(across, axis=1, keepdims=True)


def first_hits(triangles: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Index of the triangle that each ray hits first, by Embree; −1 for none."""
    core = pytest.importorskip("embreex.rtcore_scene")
    mesh = pytest.importorskip("embreex.mesh_construction")
    scene = core.EmbreeScene(robust=True)  # else rays slip through between faces
    mesh.TriangleMesh(scene, triangles.astype(np.float32))
    rays = np.broadcast_to(origins, directions.shape).astype(np.float32)
    return scene.run(rays, directions.astype(np.float32))


def view(azimuth: float, height: float, distance: float, pixels: int, radius: float):
    """Position and rays of a camera on a pole that looks at the middle of a box [m, rad].

    Each ray has a random place in its pixel: otherwise edges along rows count a row too many.
    """
    eye = np.array([distance * np.cos(azimuth), distance * np.sin(azimuth), height])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    up = np.cross(right, eye / np.linalg.norm(eye))
    rng = np.random.default_rng(0)
    row, column = np.indices((pixels, pixels)) + rng.random((2, pixels, pixels))
    rays = radius * (
        (2 * row / pixels - 1)[..., None] * up + (2 * column / pixels - 1)[..., None] * right
    )
    rays = rays.reshape(-1, 3) - eye
    return eye, rays / np.linalg.norm(rays, axis=1, keepdims=True)


def test_shapes_fill_the_unit_box_and_fit_a_box_of_their_size():
    for kind, variant in EVERY:
        assert variant in fitting(kind, natural_size(kind, variant))
        for step in range(0, PHASES, 3) if moves(kind, variant) else (0,):
            shape = shape_of(kind, variant, step / PHASES)
            assert (shape.vertices.min(0) == -0.5).all(), shape.name
            assert (shape.vertices.max(0) == 0.5).all(), shape.name
            types = shape.vertices.dtype, shape.faces.dtype, shape.part.dtype
            assert types == (np.float32, np.int32, np.int8)
            assert not shape.vertices.flags.writeable


@pytest.mark.parametrize(
    ("kind", "variant", "phase"),
    [(k, i, p) for k, i in EVERY for p in (0.0, 0.3) if p == 0 or moves(k, i)],
)
def test_only_outsides_are_visible(kind, variant, phase):
    """From every side, level and from above: no gap shows the inside of a face.

    Limbs that intersect may show a few; they are thin. Of a vehicle one ray may slip through, where
    a strip that is split meets one that is not: in single precision the seam has no width of its
    own, but is not always straight.
    """
    size = natural_size(kind, variant)
    triangles = corners(shape_of(kind, variant, phase), size)
    outward, radius = normals(triangles), np.linalg.norm(size) / 2
    for azimuth in np.radians(np.arange(7, 360, 60)):
        for height in (0.0, 0.4, 1.0, 4.0):
            eye, rays = view(azimuth, height * 3 * radius, 3 * radius, 70, radius)
            hit = first_hits(triangles, eye, rays)
            rays, hit = rays[hit >= 0], hit[hit >= 0]
            inside = (outward[hit] * rays).sum(1) > 0
            assert inside.sum() <= (1 if kind in ALIKE else 0.002 * len(hit)), (azimuth, height)


@pytest.mark.parametrize("kind", ALIKE)
def test_vehicles_stand_on_wheels_at_all_corners(kind):
    for variant in range(len(VARIANTS[kind])):
        shape = shape_of(kind, variant)
        low = np.unique(shape.faces[shape.part == PARTS.index("tyre")])
        low = shape.vertices[low][shape.vertices[low, 2] < -0.4999]
        assert {(x > 0, y > 0) for x, y, _ in low} == {(f, s) for f in (0, 1) for s in (0, 1)}


def test_the_left_or_the_right_foot_is_in_front():
    for side, name in ((1, "walker.stride_left"), (-1, "walker.stride_right")):
        shape = shape_of("pedestrian", VARIANTS["pedestrian"].index(name))
        shoes = shape.vertices[np.unique(shape.faces[shape.part == PARTS.index("shoe")])]
        assert np.sign(shoes[np.argmax(shoes[:, 0]), 1]) == side
        assert np.sign(shoes[np.argmin(shoes[:, 0]), 1]) == -side


def test_a_phase_goes_round_and_vehicles_have_none():
    assert shape_of("cyclist", 0, 1.25) is shape_of("cyclist", 0, 0.25)
    assert shape_of("cyclist", 0, 0.25) is not shape_of("cyclist", 0, 0.5)
    for kind, variant in (("car", 0), ("truck", 1), ("pedestrian", 0)):
        assert shape_of(kind, variant, 0.4) is shape_of(kind, variant)


def test_every_class_of_the_traffic_has_shapes_with_unique_names():
    with np.load(resources.files("inspe_jax.simulation.embedded") / "shapes.npz") as data:
        assert tuple(data["parts"]) == PARTS
        assert "commit" in str(data["made"])
    assert tuple(VARIANTS) == CLASSES
    assert len(set(NAMES)) == len(NAMES)
    assert [shape_of(kind, variant).name for kind, variant in EVERY] == NAMES


def test_every_part_is_used_and_painted():
    used = {PARTS[p] for kind, variant in EVERY for p in shape_of(kind, variant).part}
    assert used == set(PARTS)
    for kind in VARIANTS:
        for seed in range(50):
            painted = paint(kind, np.random.default_rng(seed))
            assert tuple(painted) == PARTS
            colours = np.array(list(painted.values()))
            assert colours.shape == (len(PARTS), 3)
            assert 0 <= colours.min() <= colours.max() <= 1


@pytest.mark.parametrize(
    ("kind", "parts"),
    [
        ("car", {"body", "window", "trim", "tyre", "hub", "lamp", "lamp rear"}),
        ("truck", {"body", "window", "trim", "tyre", "hub", "lamp", "lamp rear"}),
        ("cyclist", {"tyre", "skin", "helmet", "cloth", "trousers", "shoe"}),
        ("pedestrian", {"skin", "cloth", "trousers", "shoe"}),
    ],
)
def test_parts_of_a_class(kind, parts):
    """What each shape has, and what only some have."""
    some = {
        "car": set(),
        "truck": {"cargo", "tub", "load"},
        "cyclist": {"frame", "bag", "cargo", "trim", "lamp", "lamp rear"},
        "pedestrian": {"hair", "bag", "helmet"},
    }
    for variant, name in enumerate(VARIANTS[kind]):
        own = {PARTS[p] for p in shape_of(kind, variant).part}
        assert parts <= own <= parts | some[kind]
        assert ({"lamp", "lamp rear"} <= own) == name.startswith(("car", "truck", "bus", "motor"))


def test_cars_have_the_colours_of_the_road():
    """Of 1 000 cars 35 % are white, 18 % neither white, grey nor black; 3 standard errors."""
    rng = np.random.default_rng(0)
    bodies = np.array([paint("car", rng)["body"] for _ in range(1000)])
    white = (bodies.min(1) > 0.6).mean()
    coloured = (bodies.max(1) > 1.6 * bodies.min(1) + 0.01).mean()
    assert white == pytest.approx(0.35, abs=0.046)
    assert coloured == pytest.approx(0.18, abs=0.037)


@pytest.mark.parametrize(
    ("kind", "size", "fit"),
    [
        ("truck", (16.5, 2.55, 4.0), {"truck.articulated", "truck.container",
                                      "truck.articulated_tank", "truck.road_train"}),
        ("truck", (18.3, 2.55, 3.1), {"bus.articulated"}),
        ("truck", (30.0, 2.55, 4.0), {"truck.road_train"}),  # none: the nearest
        ("car", (2.6, 1.6, 1.5), {"car.micro"}),
        ("car", (5.9, 2.0, 2.7), {"car.high_van"}),
        ("cyclist", (2.5, 0.7, 1.75), {"bicycle.cargo", "motorcycle.tourer"}),
        ("pedestrian", (0.5, 0.5, 1.05), {"walker.child_3", "walker.child_5"}),
        ("pedestrian", (0.3, 0.3, 0.8), {"walker.child_3"}),
    ],
)  # fmt: skip
def test_the_size_of_a_box_decides(kind, size, fit):
    """Among others: the length, for what is long; the height, for children."""
    found = {VARIANTS[kind][i] for i in fitting(kind, size)}
    assert found
    assert found <= fit
    assert {VARIANTS[kind][_variant(kind, track, 0, np.array(size))] for track in range(80)} == (
        found
    )


def test_no_small_car_is_a_van_and_no_adult_a_child():
    for track in range(300):
        small = VARIANTS["car"][_variant("car", track, 1, np.array([3.7, 1.66, 1.48]))]
        assert "van" not in small
        assert "bus" not in small
        adult = VARIANTS["pedestrian"][_variant("pedestrian", track, 1, MEAN["pedestrian"])]
        assert "child" not in adult
        assert _variant("car", track, 1, MEAN["car"]) == _variant("car", track, 1, MEAN["car"])


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: shape_of("tram", 0), "class 'tram': one of car, truck, cyclist, pedestrian"),
        (lambda: shape_of("car", 99), r"car variant 99 is out of range: 0 to \d+"),
        (lambda: paint("tram", np.random.default_rng(0)), "class 'tram'"),
    ],
)
def test_unknown_shapes(call, words):
    with pytest.raises(InspeError, match=words):
        call()
