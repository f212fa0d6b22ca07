"""Bit masks: a column's levels are the bits of one word.

A shadow clears the low bits of what a sensor has in view, the union of sensors is OR, and a count
of voxels one of bits: one operation for up to 32 voxels, exact in any order.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt

WORD = 32
"""Bits of the longest word, and so the most levels in one mask."""


def word(bits: int) -> Any:
    """The shortest unsigned integer type of at least ``bits`` bits, at most :data:`WORD`."""
    return next(t for t in (jnp.uint8, jnp.uint16, jnp.uint32) if bits <= jnp.iinfo(t).bits)


def pack(flags: Bool[np.ndarray, "... n"]) -> UInt[np.ndarray, "... w"]:
    """Flags along the last axis as the bits of words, lowest bit first; padded with zeros."""
    n = flags.shape[-1]
    kind = np.dtype(word(min(n, WORD)))
    size = kind.itemsize * 8
    flags = np.pad(flags, [(0, 0)] * (flags.ndim - 1) + [(0, -n % size)])
    return np.packbits(flags, axis=-1, bitorder="little").view(kind.newbyteorder("<")).astype(kind)


def chances(masks: UInt[Array, "..."], levels: int) -> Float[Array, "Z ..."]:
    """1 for each level whose bit is set in a mask, 0 for the others."""
    z = jnp.arange(levels, dtype=masks.dtype).reshape(-1, *[1] * masks.ndim)
    return ((masks[None] >> z) & masks.dtype.type(1)).astype(float)


def unpack(masks: UInt[np.ndarray, "... w"], n: int) -> Bool[np.ndarray, "... n"]:
    """The first ``n`` bits of words as flags: the inverse of :func:`pack`."""
    masks = np.ascontiguousarray(masks, masks.dtype.newbyteorder("<"))
    return np.unpackbits(masks.view(np.uint8), axis=-1, count=n, bitorder="little").astype(bool)


def count(masks: UInt[Array, "*n"]) -> Int[Array, "*n"]:
    """How many bits are set in each word."""
    return jax.lax.population_count(masks).astype(jnp.int32)


BYTE = 255
"""Most masks whose bits a byte can count."""


def count_levels(masks: UInt[Array, "F ..."], n: int) -> Int[Array, "... Z"]:
    """In how many of F masks each of the first ``n`` bits is set; as bytes if F ≤ :data:`BYTE`.

    Four bits are spread over the four bytes of a word, so that one sum counts all four.
    """
    masks, count = jax.lax.optimization_barrier(masks), len(masks)
    parts = max(-(-count // BYTE), 1)
    each = -(-count // parts)
    masks = jnp.pad(masks, [(0, parts * each - count)] + [(0, 0)] * (masks.ndim - 1))
    masks = masks.reshape(parts, each, *masks.shape[1:])
    counts = []
    for z in range(0, n, 4):
        four = ((masks >> masks.dtype.type(z)) & masks.dtype.type(15)).astype(jnp.uint32)
        # Bit k of the four times 2^(7k) is bit 8k, the lowest one of byte k.
        spread = (four * jnp.uint32(0x00204081)) & jnp.uint32(0x01010101)
        sums = spread.sum(1, dtype=jnp.uint32)
        for k in range(min(4, n - z)):
            counts.append((sums >> jnp.uint32(8 * k)).astype(jnp.uint8))
    found = jnp.stack(counts, -1)  # (parts, …, Z)
    return found[0] if parts == 1 else found.astype(jnp.int32).sum(0)


def marks(flags: Bool[Array, "B ..."]) -> UInt[Array, "W ..."]:
    """B flags along the first axis as the bits of W = ⌈B/32⌉ words. A mark is a bit that is set."""
    number, rest = len(flags), flags.shape[1:]
    words = -(-number // WORD)
    flags = jnp.pad(flags, [(0, words * WORD - number)] + [(0, 0)] * len(rest))
    bit = jnp.uint32(1) << jnp.arange(words * WORD, dtype=jnp.uint32) % WORD
    found = jnp.where(flags, bit.reshape(-1, *(1 for _ in rest)), jnp.uint32(0))
    found = found.reshape(words, WORD, *rest)
    while found.shape[1] > 1:  # as a sum along the axis, XLA would compute one flag after the other
        half = found.shape[1] // 2
        found = found[:, :half] | found[:, half:]
    return found[:, 0]


def with_mark(
    marked: UInt[Array, "W T K"], index: Int[Array, " T"], where: Bool[Array, "T K"]
) -> UInt[Array, "W T K"]:
    """Marks with a further one: number ``index`` of each row, in the places ``where`` it is."""
    bit = jnp.uint32(1) << (index % WORD).astype(jnp.uint32)
    word = jnp.arange(len(marked), dtype=index.dtype)[:, None] == (index // WORD)[None]
    return jnp.where(word[:, :, None] & where[None], marked | bit[None, :, None], marked)


def lowest_bit(masks: UInt[Array, "*n"]) -> Int[Array, "*n"]:
    """Number of the lowest bit that is set; meaningless where none is."""
    return jnp.minimum(count((masks & (~masks + 1)) - 1), WORD - 1)


def first_mark(marked: UInt[Array, "W ..."]) -> tuple[Int[Array, "..."], UInt[Array, "W ..."]]:
    """The number of the first mark of :func:`marks`, −1 if there is none; and the other marks."""
    found = jnp.full(marked.shape[1:], -1)
    rest = []
    for w in range(len(marked)):
        mask = marked[w]
        here = (found < 0) & (mask != 0)
        found = jnp.where(here, w * WORD + lowest_bit(mask), found)
        rest.append(jnp.where(here, mask & (mask - 1), mask))
    return found, jnp.stack(rest)


def fold_marked(
    marked: UInt[Array, "W T"],
    add: Callable[[Any, Int[Array, " T"], Bool[Array, " T"]], Any],
    start: Any,
) -> Any:
    """``total = add(total, index, some)`` for one mark after another, in all T rows at once.

    ``index`` is the number of each row's mark; ``some`` is false for the rows that have no marks
    left. There are as many steps as the row with the most marks has marks.
    """
    if not len(marked):  # no flags
        return start

    def step(state: tuple[Any, Array]) -> tuple[Any, Array]:
        total, marked = state
        some = (marked != 0).any(0)
        index, marked = first_mark(marked)
        return add(total, jnp.maximum(index, 0), some), marked

    return jax.lax.while_loop(lambda state: (state[1] != 0).any(), step, (start, marked))[0]
