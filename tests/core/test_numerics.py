from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from inspe_jax.core.errors import InspeError
from inspe_jax.core.numerics import Groups, Softness, arctan2, dot, leave_one_out, step

EACH = tuple((s,) for s in range(5))

compiled_step, compiled_rest = map(jax.jit, (step, leave_one_out))
singles = partial(np.array, dtype=np.float32)
"""What is given to compiled functions: an array of NumPy needs no program of its own."""


def test_a_margin_is_read_hard_at_zero_and_soft_around_it():
    margin = singles([-1.0, 0.0, 1e-6, 2.0])
    assert compiled_step(margin).tolist() == [0, 0, 1, 1]
    # u = 1/2 ± 1/(2·3·0.5) = 1/6 and 5/6; u²·(3 − 2u) by hand
    soft = compiled_step(singles([-1.0, 0.0, 1.0, 2.0]), 0.5)
    np.testing.assert_allclose(soft, [2 / 27, 0.5, 25 / 27, 1.0], atol=1e-6)
    sharp = compiled_step(singles([-0.3, -0.01, 0.01, 0.3]), 1e-4)
    np.testing.assert_allclose(sharp, [0, 0, 1, 1], atol=1e-6)


def test_readings_are_exact_on_certainties_and_multiply_as_chances():
    p = singles([[0.0, 1.0, 0.5], [0.0, 1.0, 0.5]])
    left = [[0.0, 1.0, 0.75], [0.0, 1.0, 0.5], [0.0, 1.0, 0.5]]
    assert compiled_rest(p, Groups.of_rows(EACH[:2], 2)).tolist() == left
    assert compiled_rest(p, Groups.of_rows((), 2)).tolist() == left[:1]


@pytest.mark.parametrize("groups", [EACH, ((0, 3), (1,), (2, 4)), ((0, 1, 2, 3, 4),)])
@pytest.mark.parametrize("certain", [0, 1, 2])
def test_leave_one_out_equals_leaving_out(certain, groups):
    """Against the product over the array with the rows deleted, with 0, 1 or 2 rows certain."""
    p = np.random.default_rng(3).uniform(0, 0.9, (5, 7)).astype(np.float32)
    p[:certain] = 1.0
    expected = [1 - np.prod(1 - p, 0)]
    expected += [1 - np.prod(1 - np.delete(p, group, 0), 0) for group in groups]
    for room in (len(groups), 7):  # for more groups, which leaves all in
        found = compiled_rest(p, Groups.of_rows(groups, 5, room))
        rows = np.stack(expected + expected[:1] * (room - len(groups)))
        np.testing.assert_allclose(found, rows, atol=1e-6)


def test_a_certain_reading_leaves_a_finite_gradient():
    """Dividing ∏(1 − p) by a factor of 0 would not."""
    p = singles([[1.0, 0.2], [1.0, 0.7], [0.3, 1.0]])
    slope = jax.jit(jax.jacobian(lambda p: leave_one_out(p, Groups.of_rows(EACH[:3], 3)).sum()))(p)
    # d/dp₂ of voxel 0: only where 0 and 1 do not both stand is something missed, which never is.
    np.testing.assert_allclose(slope, [[0.7, 0.3], [0.7, 0.8], [0.0, 1.34]], atol=1e-6)


def test_softness_is_one_width_or_one_for_each_kind():
    for nothing in (0, 0.0, np.int64(0), np.zeros(()), jnp.zeros(())):
        assert Softness.of(nothing) == Softness.of(Softness(nothing, nothing)) == Softness.of(0)
        assert Softness.of(nothing).exact
    one = Softness.of(0.3)
    assert (float(one.field), one.shadow, one.rays) == (pytest.approx(0.3), one.field, "density")
    mixed = Softness.of(Softness(field=0.5, shadow=0.0))
    assert (float(mixed.field), mixed.shadow, mixed.rays) == (0.5, None, "density")
    assert not Softness(rays="density").exact
    given = jnp.asarray(0.3)  # a number of JAX's is none that is traced
    inside = jax.jit(lambda: Softness.of(Softness.of(given)).field)()
    assert float(inside) == pytest.approx(0.3)
    wrong = "1", [0.5], np.ones(2), np.float32(-1), jnp.asarray(-1.0)
    for bad in (-1.0, Softness(shadow=-0.1), float("nan"), float("inf"), *wrong):
        with pytest.raises(InspeError, match="softness"):
            Softness.of(bad)
    with pytest.raises(InspeError, match="rays 'dense': one of exact, density"):
        Softness.of(Softness(0.5, 0.5, "dense"))


def test_dot_keeps_single_precision_over_two_million_terms():
    """Against float64. Partial sums of ~126 terms: 3·126·2⁻²⁴ ≈ 2e-5 at worst, 1e-6 typically."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, 1, (2, 2_000_003)).astype(np.float32)
    exact = float(x.astype(float) @ y.astype(float))
    assert float(jax.jit(dot)(x, y)) == pytest.approx(exact, rel=2e-6)
    assert jax.jit(dot)(singles(np.ones((3, 5))), singles(range(5))).tolist() == [10.0] * 3


def test_the_angle_is_that_of_the_c_library():
    """To 2e-7 rad all round, on the axes and diagonals, and at any scale; 0 at the origin."""
    angle = np.concatenate([np.linspace(-np.pi, np.pi, 20001), np.arange(-4, 5) * np.pi / 4])
    compiled = jax.jit(arctan2)
    for scale in (1e-6, 1.0, 1e4):
        x, y = (np.append(scale * f(angle).astype(np.float32), 0) for f in (np.cos, np.sin))
        found = np.asarray(compiled(y, x))
        off = np.abs(found - np.arctan2(y.astype(float), x.astype(float)))
        assert np.minimum(off, 2 * np.pi - off).max() < 4e-7
        assert found[-1] == 0
