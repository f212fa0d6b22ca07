"""Shapes fill their boxes, show only their outsides, and have the parts of their class."""

import numpy as np
import pytest

from inspe_jax.core.errors import InspeError
from inspe_jax.scene.traffic.frames import CLASSES, ROAD_USERS
from inspe_jax.simulation.embedded.shapes import (
    PARTS,
    PHASES,
    VARIANTS,
    Shape,
    paint,
    shape_of,
)
from inspe_jax.simulation.embedded.shapes_mesh import triangulate

EVERY = [(kind, i) for kind in VARIANTS for i in range(len(VARIANTS[kind]))]
CARS = [i for kind, i in EVERY if kind == "car"]
NAMES = [VARIANTS[kind][i] for kind, i in EVERY]
SIZES = {user.name: np.array(user.size) for user in ROAD_USERS}
MOST = {"car": 150, "truck": 150, "cyclist": 250, "pedestrian": 200}

CUBE = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
SQUARES = [(0, 4, 5, 1), (2, 3, 7, 6), (0, 1, 3, 2), (4, 6, 7, 5), (0, 2, 6, 4), (1, 5, 7, 3)]
CUBE_FACES = np.array([face for a, b, c, d in SQUARES for face in ((a, b, c), (a, c, d))])

every = pytest.mark.parametrize(("kind", "variant"), EVERY, ids=NAMES)


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
    scene = core.EmbreeScene()
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


@every
@pytest.mark.parametrize("step", range(0, PHASES, 3))
def test_fills_the_unit_box(kind, variant, step):
    shape = shape_of(kind, variant, step / PHASES)
    assert (shape.vertices.min(0) == -0.5).all()
    assert (shape.vertices.max(0) == 0.5).all()
    assert shape.vertices.dtype == np.float32
    assert shape.faces.dtype == np.int32
    assert shape.part.dtype == np.int8


@every
def test_few_triangles_and_none_without_area(kind, variant):
    shape = shape_of(kind, variant)
    assert len(shape.faces) == len(shape.part) <= MOST[kind]
    at_size = corners(shape, SIZES[kind])
    across = np.cross(at_size[:, 1] - at_size[:, 0], at_size[:, 2] - at_size[:, 0])
    assert np.linalg.norm(across, axis=1).min() > 1e-4  # m²


@every
@pytest.mark.parametrize("phase", [0.0, 0.3])
def test_only_outsides_are_visible(kind, variant, phase):
    """From every side, level and from above: no gap shows the inside of a face.

    Limbs that intersect may show a few; they are thin.
    """
    triangles = corners(shape_of(kind, variant, phase), SIZES[kind])
    outward, radius = normals(triangles), np.linalg.norm(SIZES[kind]) / 2
    for azimuth in np.radians(np.arange(7, 360, 40)):
        for height in (0.0, 0.4, 1.0, 4.0):
            eye, rays = view(azimuth, height * 3 * radius, 3 * radius, 70, radius)
            hit = first_hits(triangles, eye, rays)
            rays, hit = rays[hit >= 0], hit[hit >= 0]
            inside = (outward[hit] * rays).sum(1) > 0
            assert inside.mean() <= (0.0 if kind in ("car", "truck") else 0.002), (azimuth, height)


@every
def test_volume_is_positive_and_less_than_the_box(kind, variant):
    """By the divergence theorem: an inside-out solid would count as negative."""
    a, b, c = np.moveaxis(corners(shape_of(kind, variant), np.ones(3)).astype(float), 1, 0)
    assert 0.01 < (a * np.cross(b, c)).sum() / 6 < 1


@pytest.mark.parametrize("variant", CARS, ids=VARIANTS["car"])
def test_a_car_covers_its_box(variant):
    """At least 70 % of what the box covers, from any pole 5 to 8 m high, 8 to 40 m away.

    For half of the azimuths, because both sides of a car are alike.
    """
    size = SIZES["car"]
    car, box = corners(shape_of("car", variant), size), (CUBE * size)[CUBE_FACES]
    share = []
    for azimuth in np.radians(np.arange(0, 181, 15)):
        for height in (5.0, 8.0):
            for distance in (8.0, 15.0, 25.0, 40.0):
                eye, rays = view(azimuth, height - size[2] / 2, distance, 100, 2.7)
                seen, whole = first_hits(car, eye, rays) >= 0, first_hits(box, eye, rays) >= 0
                assert not (seen & ~whole).sum() > 1  # the box contains the car
                share.append(seen.sum() / whole.sum())
    assert min(share) >= 0.7
    assert np.median(share) >= 0.74


@pytest.mark.parametrize("kind", ["car", "truck"])
def test_vehicles_stand_on_four_wheels(kind):
    for variant in range(len(VARIANTS[kind])):
        shape = shape_of(kind, variant)
        low = np.unique(shape.faces[shape.part == PARTS.index("tyre")])
        low = shape.vertices[low][shape.vertices[low, 2] < -0.4999]
        assert {(x > 0, y > 0) for x, y, _ in low} == {(f, s) for f in (0, 1) for s in (0, 1)}


def test_vehicles_are_alike_on_both_sides():
    for kind, variant in EVERY:
        if kind in ("car", "truck"):
            points = shape_of(kind, variant).vertices
            mirrored = {tuple(p) for p in points * np.float32([1, -1, 1])}
            assert {tuple(p) for p in points} == mirrored


@pytest.mark.parametrize("kind", ["cyclist", "pedestrian"])
def test_half_a_cycle_on_is_the_mirror_image(kind):
    for variant, name in enumerate(VARIANTS[kind]):
        if name == "walker.standing":
            continue
        for phase in (0.0, 0.25, 1 / 3):
            here, there = (shape_of(kind, variant, phase + on).vertices for on in (0.0, 0.5))
            away = np.abs(here[:, None] * [1, -1, 1] - there).max(-1)
            assert away.min(1).max() < 1e-6


def test_the_left_or_the_right_foot_is_in_front():
    for side, name in ((1, "walker.stride_left"), (-1, "walker.stride_right")):
        shape = shape_of("pedestrian", VARIANTS["pedestrian"].index(name))
        shoes = shape.vertices[np.unique(shape.faces[shape.part == PARTS.index("shoe")])]
        assert np.sign(shoes[np.argmax(shoes[:, 0]), 1]) == side
        assert np.sign(shoes[np.argmin(shoes[:, 0]), 1]) == -side


def test_a_walker_keeps_the_depth_of_the_trunk():
    """If the whole body were scaled with the stride, the chest would grow and shrink."""
    chest = []
    for step in range(PHASES):
        points = shape_of("pedestrian", 1, step / PHASES).vertices
        chest.append(
            np.ptp(points[(abs(points[:, 1]) < 0.25) & (abs(points[:, 2] - 0.26) < 0.01), 0])
        )
    assert max(chest) - min(chest) < 1e-6


def test_a_phase_goes_round_and_vehicles_have_none():
    assert shape_of("cyclist", 0, 1.25) is shape_of("cyclist", 0, 0.25)
    assert shape_of("cyclist", 0, 0.25) is not shape_of("cyclist", 0, 0.5)
    for kind, variant in (("car", 0), ("truck", 1), ("pedestrian", 0)):
        assert shape_of(kind, variant, 0.4) is shape_of(kind, variant)


def test_the_same_shape_and_paint_each_time():
    from inspe_jax.simulation.embedded import shapes

    for kind, variant in EVERY:
        before = shape_of(kind, variant, 0.3)
        shapes._shape.cache_clear()
        after = shape_of(kind, variant, 0.3)
        assert before is not after
        for a, b in zip(vars(before).values(), vars(after).values(), strict=True):
            assert np.array_equal(a, b)
        one, other = (paint(kind, np.random.default_rng(5)) for _ in range(2))
        assert all(np.array_equal(one[part], other[part]) for part in PARTS)


def test_shapes_are_shared_and_cannot_be_written_to():
    with pytest.raises(ValueError, match="read-only"):
        shape_of("car", 0).vertices[0, 0] = 1


def test_every_class_of_the_traffic_has_shapes_with_unique_names():
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
            assert all(
                c.shape == (3,) and (c >= 0).all() and (c <= 1).all() for c in painted.values()
            )


@pytest.mark.parametrize(
    ("kind", "parts"),
    [
        ("car", {"body", "window", "trim", "tyre", "hub", "lamp", "lamp rear"}),
        ("cyclist", {"tyre", "frame", "skin", "helmet", "cloth", "trousers", "shoe"}),
        ("pedestrian", {"skin", "hair", "cloth", "trousers", "shoe"}),
    ],
)
def test_parts_of_a_class(kind, parts):
    for variant, name in enumerate(VARIANTS[kind]):
        own = {"bag"} if name == "walker.standing" else set()
        assert {PARTS[p] for p in shape_of(kind, variant).part} == parts | own


def test_cars_have_the_colours_of_the_road():
    """Of 1 000 cars 35 % are white, 18 % neither white, grey nor black; 3 standard errors."""
    rng = np.random.default_rng(0)
    bodies = np.array([paint("car", rng)["body"] for _ in range(1000)])
    white = (bodies.min(1) > 0.6).mean()
    coloured = (bodies.max(1) > 1.6 * bodies.min(1) + 0.01).mean()
    assert white == pytest.approx(0.35, abs=0.046)
    assert coloured == pytest.approx(0.18, abs=0.037)


def test_unknown_shapes():
    with pytest.raises(InspeError, match="class 'tram': one of car, truck, cyclist, pedestrian"):
        shape_of("tram", 0)
    with pytest.raises(InspeError, match="car variant 5 is out of range: 0 to 4"):
        shape_of("car", 5)
    with pytest.raises(InspeError, match="class 'tram'"):
        paint("tram", np.random.default_rng(0))


@pytest.mark.parametrize("turn", [1, -1])
def test_triangles_of_a_polygon_add_up_to_it(turn):
    """A comb, with corners on a straight line, by the shoelace formula."""
    comb = [(0, 0), (2, 0), (5, 0), (5, 3), (4, 3), (4, 1), (3, 1), (3, 3), (2, 3), (1, 1), (0, 2)]
    points = np.array(comb[::turn], float)
    x, y = points.T
    area = abs(x @ np.roll(y, 1) - y @ np.roll(x, 1)) / 2
    each = [np.linalg.det(points[[b, c]] - points[a]) / 2 for a, b, c in triangulate(comb[::turn])]
    assert len(each) == len(comb) - 2
    assert min(each) > 0
    assert sum(each) == pytest.approx(area)
