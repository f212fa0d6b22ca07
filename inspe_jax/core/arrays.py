"""NumPy arrays for compiled code: padded to a few lengths, so that scenes and layouts of similar
size share a program, and put on the device."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


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


@partial(jax.custom_vjp, nondiff_argnums=(1,))
def pad_rows(rows: Float[Array | np.ndarray, "s n"], count: int) -> Any:
    """``count`` rows: those given, then the first one repeated. In NumPy unless traced, the
    gradient too: JAX would compile a program for every number of rows."""
    if isinstance(rows, jax.core.Tracer):
        return jnp.concatenate([rows, jnp.repeat(rows[:1], count - len(rows), 0)])
    rows = np.asarray(rows)
    return np.concatenate([rows, np.repeat(rows[:1], count - len(rows), 0)])


def _pad_rows_forward(rows: Any, count: int) -> tuple[Any, Any]:
    return pad_rows(rows, count), np.zeros(len(rows), bool)


def _pad_rows_backward(count: int, rows: Any, slope: Any) -> tuple[Any]:
    number = len(rows)
    if isinstance(slope, jax.core.Tracer):
        return (slope[:number].at[0].add(slope[number:].sum(0)),)
    slope = np.array(slope)
    slope[0] += slope[number:].sum(0)
    return (on_device(slope[:number]),)


pad_rows.defvjp(_pad_rows_forward, _pad_rows_backward)


def from_center(center: Float[np.ndarray, "3"], poses: Any) -> Any:
    """World poses (…, 6) relative to a centre [m]: traced, or in NumPy."""
    shift = np.concatenate([center, np.zeros(3)])
    if isinstance(poses, jax.core.Tracer):
        return jnp.asarray(poses - shift[None], float)
    return on_host(np.asarray(poses) - shift, float)
