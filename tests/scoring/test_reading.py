"""Sets as bits and as numbers, against flags in NumPy: the same operations, the same counts."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from inspe_jax.core.geometry import Prism
from inspe_jax.core.numerics import Groups, Softness
from inspe_jax.scoring import metrics
from inspe_jax.scoring.numbers import Numbers
from inspe_jax.scoring.reading import Bits, Frames
from inspe_jax.visibility import bitmask

S, Z, F, C = 5, 6, 7, 9
"""Sensors, levels, frames and columns."""
UNITS = ((0, 3), (1,), (4,))
READINGS = [Bits(), Numbers(Softness())]


def as_set(reading, flags):
    """Flags (…, Z, F, C) or (…, Z, C), levels third or second from the end, as sets."""
    if isinstance(reading, Numbers):
        return flags.astype(np.float32)
    axis = -3 if flags.shape[-3:] == (Z, F, C) else -2
    return bitmask.pack(np.moveaxis(flags, axis, -1))[..., 0]


def frames(solid):
    """Frames of nothing but these flags (Z, F, C) of solid voxels."""
    none = np.zeros((F, 1))
    prisms = Prism(np.zeros((F, 1, 2)), none, np.ones((F, 1, 2)), none, none > 0)
    words = bitmask.pack(np.moveaxis(solid, 0, -1))[..., 0]
    return Frames(prisms, words)


@pytest.fixture(params=READINGS, ids=["bits", "numbers"])
def reading(request):
    return request.param


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def test_sets_are_counted_as_flags(reading, rng):
    a, b = rng.uniform(size=(2, Z, F, C)) < 0.4
    rows = rng.uniform(size=(3, Z, C)) < 0.5

    @jax.jit
    def found(a, b, rows, given):
        both = reading.both(a, b)
        return (
            reading.count(a),
            reading.count(both),
            reading.count(reading.outside(a, both)),
            reading.solid(given, Z),
            reading.count_both(rows, a),
            reading.column_sums(a),
            reading.level_sums(a, Z),
        )

    expected = (
        a.sum((0, 2)),
        (a & b).sum((0, 2)),
        (a & ~b).sum((0, 2)),
        as_set(reading, b),
        (rows[:, :, None] & a[None]).sum((1, 3)),
        a.sum((0, 1)),
        a.sum(1).T,
    )
    sets = (as_set(reading, flags) for flags in (a, b, rows))
    jax.tree.map(np.testing.assert_array_equal, found(*sets, frames(b)), expected)


def test_unions_of_all_sensors_and_without_each_group(reading, rng):
    """Of sensors that see much, little and, having nothing in view, nothing."""
    views = rng.uniform(size=(S, Z, C)) < np.array([0.9, 0.3, 0.0, 0.5, 0.2])[:, None, None]
    visible = views[:, :, None] & (rng.uniform(size=(S, Z, F, C)) < 0.6)
    of = rng.uniform(size=(Z, F, C)) < 0.7
    groups = (), UNITS, tuple((s,) for s in range(S))

    def look(row, visible):
        return visible[row[0]], reading.level_sums(visible[row[0]], Z)

    @jax.jit
    def found(views, visible, of):
        def without(units):
            failures, rows = Groups.of_rows(units, S), (jnp.arange(S), None, views)
            union, sights = reading.over_sensors(look, rows, (visible,), failures)
            return union.all, sights, union.count(of), reading.any_of(views, failures)

        return [without(units) for units in groups]

    def expected(units):
        left = [range(S), *([s for s in range(S) if s not in unit] for unit in units)]
        return (
            as_set(reading, visible.any(0)),
            np.moveaxis(visible.sum(2), 1, 2),
            np.array([(visible[list(some)].any(0) & of).sum((0, 2)) for some in left]),
            np.array([as_set(reading, views[list(some)].any(0)) for some in left]),
        )

    sets = (as_set(reading, flags) for flags in (views, visible, of))
    jax.tree.map(np.testing.assert_array_equal, found(*sets), [*map(expected, groups)])


def test_occlusion_references_by_hand(reading):
    """(seen, original). Voxels: visible, covered but hidden, not covered, solid and in sight."""

    def make(*flags, axis=0):
        column = np.moveaxis(np.array(flags, bool)[:, None, None], 0, axis)
        if isinstance(reading, Numbers):
            return column.astype(np.float32)
        return bitmask.pack(np.moveaxis(column, axis, -1))[..., 0]

    visible, solid, covered = make(1, 0, 0, 1), make(0, 0, 0, 1), make(1, 1, 0, 1, axis=1)

    @jax.jit
    def found(visible, covered, free, solid):
        rows = jnp.zeros(1), None, covered
        union, _ = reading.over_sensors(lambda row, seen: (seen, None), rows, (visible,), None)
        terms = partial(metrics.occlusion_terms, reading, union, covered, free, solid)
        return {reference: terms(reference) for reference in ("roi", "covered", "targets")}

    counts = jax.device_get(found(visible, covered, make(1, 1, 1, 0), solid))
    terms = {reference: tuple(x.item() for x in of) for reference, of in counts.items()}
    assert terms == dict(roi=(1, 3), covered=(1, 2), targets=(1, 1))
