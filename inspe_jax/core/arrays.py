"""NumPy arrays for compiled code: padded to a few lengths, so that scenes and layouts of similar
size share a program, and put on the device."""

from typing import Any

import jax
import numpy as np
from jaxtyping import Array


def bucket(count: int, least: int) -> int:
    """The smallest of ``least`` × (1, 2, 3, 4, 6, 8, 12, …) not below ``count``; 0 if that is 0."""
    if count <= 0:
        return 0
    length = least
    while length < count:
        length, half = 2 * length, 3 * length // 2
        if length > 2 * least and half >= count:
            return half
    return length


def wide_bucket(count: int, least: int, most: float = np.inf) -> int:
    """The smallest of ``least`` × (1, 4, 16, …) that is ``count`` or more; 0 if ``count`` is 0; and
    if that is more than ``most``, :func:`bucket`. For arrays whose padding is skipped."""
    length = least if count > 0 else 0
    while length < count:
        length *= 4
    return length if length <= most else bucket(count, least)


def on_host(x: Any, kind: Any = None) -> np.ndarray:
    """``x`` as a NumPy array in JAX's precision. ``kind`` is float, or None for the type of x."""
    x = np.asarray(x, kind)
    return x.astype(jax.dtypes.canonicalize_dtype(x.dtype), copy=False)


def on_device(x: Any, kind: Any = None) -> Array:
    """``x`` as a JAX array. Unlike jnp.asarray, this compiles no program for a new shape."""
    return jax.device_put(on_host(x, kind))
