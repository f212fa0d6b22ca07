"""Bit masks against plain sets of flags."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from inspe_jax.visibility import bitmask

tally_of = jax.jit(bitmask.count_levels, static_argnums=1)
counts_of = jax.jit(bitmask.count)


@jax.jit
def visits(flags):
    """The marks of each row of T, in the order of visits, with -1 where there is none left."""
    number, rows = flags.shape
    return bitmask.fold_marked(
        bitmask.marks(flags),
        lambda seen, index, some: (
            seen.at[:, 1:].set(seen[:, :-1]).at[:, 0].set(jnp.where(some, index, -1))
        ),
        jnp.full((rows, max(number, 1)), -1),
    )


@pytest.mark.parametrize(("n", "number"), [(1, 1), (8, 1), (9, 1), (32, 1), (70, 3)])
def test_packed_flags_come_back(n, number):
    """More of them than a word holds go on in the next."""
    flags = np.random.default_rng(n).uniform(size=(5, 3, n)) < 0.4
    words = bitmask.pack(flags)
    assert words.shape == (5, 3, number)
    assert words.dtype == bitmask.word(min(n, bitmask.WORD))
    np.testing.assert_array_equal(bitmask.unpack(words, n), flags)
    counts = sum(np.asarray(counts_of(words[..., k])) for k in range(number))
    np.testing.assert_array_equal(counts, flags.sum(-1))


@pytest.mark.parametrize("number", [0, 40, 65])
def test_marks_are_visited_once_and_in_order(number):
    """Every row's marks, as lists, whatever the others' lengths; bit 31 and full words included."""
    flags = np.random.default_rng(number).uniform(size=(number, 7)) < 0.3
    flags[:, 0], flags[:, 1] = True, False
    visited = np.asarray(visits(flags))
    for row, flag in zip(visited[:, ::-1], flags.T, strict=True):
        np.testing.assert_array_equal(row[row >= 0], np.flatnonzero(flag))


@pytest.mark.parametrize(("number", "bits"), [(1, 3), (255, 8), (256, 20), (600, 32)])
def test_bits_are_tallied_one_by_one(number, bits):
    """Against a sum of the bits; all of them set in one column, more than a byte can count."""
    flags = np.random.default_rng(bits).random((number, 7, bits)) < 0.7
    flags[:, 0] = True
    found = tally_of(bitmask.pack(flags)[..., 0], bits)
    np.testing.assert_array_equal(found, flags.sum(0))
