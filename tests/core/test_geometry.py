from functools import partial

import jax
import numpy as np
import pytest

from inspe_jax.core import geometry
from inspe_jax.core.geometry import NEVER, Prism

singles = partial(np.array, dtype=np.float32)
compiled_margin, compiled_rotation = jax.jit(geometry.ray_cube_margin), jax.jit(geometry.rotation)


def prism(x=10.0, top=1.5, valid=True):
    """4 m long and 2 m wide."""
    return Prism(singles([x, 0.0]), singles(0.0), singles([2, 1]), singles(top), np.array(valid))


@partial(jax.jit, static_argnums=3)
def compiled_ceiling(sensor, column, prism, ignore_self_occlusion):
    d, seen = column - sensor[:2], geometry.shadow_terms(sensor, prism)
    return geometry.shadow_ceiling(
        seen, d[:1], d[1:], sensor[2], ignore_self_occlusion=ignore_self_occlusion
    )


def ceiling(sensor, column, ignore_self_occlusion=False, **shape):
    at = singles(sensor), singles(column)
    return float(compiled_ceiling(*at, prism(**shape), ignore_self_occlusion)[0])


def test_rotation_follows_the_conventions():
    """Yaw turns x to y, pitch lifts the nose, roll turns y to z; all are orthonormal."""
    turn = lambda *angles: np.asarray(compiled_rotation(singles(np.radians(angles))))  # noqa: E731
    np.testing.assert_allclose(turn(0.0, 0.0, 90.0) @ [1, 0, 0], [0, 1, 0], atol=1e-6)
    np.testing.assert_allclose(turn(0.0, 30.0, 0.0) @ [1, 0, 0], [3**0.5 / 2, 0, 0.5], atol=1e-6)
    np.testing.assert_allclose(turn(90.0, 0.0, 0.0) @ [0, 1, 0], [0, 0, 1], atol=1e-6)
    # Yaw is outermost: pitched up by 30°, then heading north.
    np.testing.assert_allclose(turn(0.0, 30.0, 90.0) @ [1, 0, 0], [0, 3**0.5 / 2, 0.5], atol=1e-6)
    r = turn(10.0, -20.0, 130.0)
    np.testing.assert_allclose(r @ r.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(r) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize(("direction", "offset", "reach", "margin"), [
    ((1, 0, 0), (5, 0, 0), 100, 0.5),  # through the centre
    ((1, 0, 0), (5, 0.3, 0), 100, 0.2),  # 0.2 m inside one face
    ((1, 0, 0), (5, 0.8, 0), 100, -0.3),  # misses it by 0.3 m
    ((1, 0, 0), (5, 0, 0), 4.6, 0.1),  # ends 0.1 m inside
    ((1, 0, 0), (5, 0, 0), 4.0, -0.5),  # ends 0.5 m before
    ((1, 0, 0), (-5, 0, 0), 100, -4.5),  # behind
    ((0, 0, 0), (0, 0, 0), 100, 0.5),  # a sensor in the cube
    ((2**-0.5, 2**-0.5, 0), (5, 5, 0), 100, 0.5),
    # Diagonal ray past an edge: support √½, offset 1.2·√½ across.
    ((2**-0.5, 2**-0.5, 0), (5, 6.2, 0), 100, 2**0.5 / 2 * (1 - 1.2)),
])  # fmt: skip
def test_ray_cube_margin_by_hand(direction, offset, reach, margin):
    d, o = (tuple(singles([v]) for v in vector) for vector in (direction, offset))
    assert float(compiled_margin(d, float(reach), o, 0.5)[0]) == pytest.approx(margin, abs=1e-5)


OVER, LOW = (0.0, 0.0, 5.0), (0.0, 0.0, 1.0)


@pytest.mark.parametrize(("sensor", "column", "how", "height"), [
    # From 5 m up over the car's far top edge, 12 m away and 1.5 m high: 5 − 3.5·24/12 at 24 m.
    (OVER, (24.0, 0.0), {}, -2.0),
    (OVER, (15.0, 0.0), {}, 0.625),
    (LOW, (16.0, 0.0), dict(top=3.0), 5.0),  # from below, over the near top edge of a truck
    (OVER, (7.9, 0.0), {}, NEVER),  # before it
    (OVER, (24.0, 3.0), {}, NEVER),  # beside it
    (OVER, (-24.0, 0.0), {}, NEVER),  # on the other side
    (OVER, (24.0, 0.0), dict(valid=False), NEVER),
    (OVER, (10.0, 0.5), {}, 1.5),  # inside it, up to the top
    (OVER, (10.0, 0.5), dict(ignore_self_occlusion=True), NEVER),
    (OVER, (24.0, 0.0), dict(ignore_self_occlusion=True), -2.0),
    (OVER, (4.0, 0.0), dict(x=0.0), 5 - 3.5 * 2),  # from a mast over it, t₀ = 0
])  # fmt: skip
def test_the_ceiling_of_a_shadow_by_hand(sensor, column, how, height):
    assert ceiling(sensor, column, **how) == pytest.approx(height, abs=1e-4)


@pytest.mark.parametrize("x", [-2.0, 2.0])
def test_a_sensor_in_the_plane_of_a_side_sees_as_from_either_side_of_it(x):
    """Sensor 5 m beside the prism, exactly in the plane of its front or back."""
    for column in ((x + 1, 5.0), (x - 1, 5.0), (x + 9, -9.0), (x - 9, -9.0), (0.0, 8.0)):
        exact, left, right = (ceiling((x + d, -5.0, 5.0), column, x=0.0) for d in (0, -1e-4, 1e-4))
        assert min(abs(exact - left), abs(exact - right)) < 1e-2
    assert np.isfinite(ceiling((x, -5.0, 5.0), (x, 5.0), x=0.0))


def test_a_prism_has_its_top_where_it_stands():
    prisms = Prism(
        center=singles([[0.0, 0.0], [0.5, 0.0], [9.0, 9.0]]),
        yaw=singles([0.0, np.pi / 2, 0.0]),
        half=singles([[2.0, 1.0], [2.0, 1.0], [1.0, 1.0]]),
        top=singles([1.5, 3.0, 2.0]),
        valid=np.array([True, True, False]),
    )
    x, y = singles([[0.0, -1.0, 0.5, 9.0, 5.0]] * 3), singles([[0.0, 0.0, 1.9, 9.0, 5.0]] * 3)
    each = jax.tree.map(lambda leaf: leaf[:, None], prisms)
    found = jax.jit(geometry.top_over)(each, x, y).max(0)
    assert found.tolist() == [3.0, 1.5, 3.0, NEVER, NEVER]
