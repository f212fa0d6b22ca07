"""Arrays made in NumPy: filled up to a few lengths, and handed to the device as they are.

What is compiled is compiled for the lengths of its arrays. With a few lengths, scenes and layouts
of similar size share it.
"""

from typing import Any

import jax
import numpy as np
from jaxtyping import Array


def bucket(count: int, least: int) -> int:
    """The least of ``least`` times 1, 2, 3, 4, 6, 8, 12, 16, … that holds so many; 0 for none."""
    if count <= 0:
        return 0
    length = least
    while length < count:
        length, half = 2 * length, 3 * length // 2
        if length > 2 * least and half >= count:
            return half
    return length


def wide_bucket(count: int, least: int, most: float = np.inf) -> int:
    """The least of ``least`` times 1, 4, 16, … that holds so many, where what is filled up is
    skipped; a :func:`bucket` where that would be more than ``most``. 0 for none."""
    length = least if count > 0 else 0
    while length < count:
        length *= 4
    return length if length <= most else bucket(count, least)


def on_host(x: Any, kind: Any = None) -> np.ndarray:
    """In NumPy, in the precision that JAX is set to; ``kind`` is float, or None for that of x."""
    x = np.asarray(x, kind)
    return x.astype(jax.dtypes.canonicalize_dtype(x.dtype), copy=False)


def on_device(x: Any, kind: Any = None) -> Array:
    """An array as JAX has it. jnp.asarray compiles a program for each new shape, this none."""
    return jax.device_put(on_host(x, kind))
