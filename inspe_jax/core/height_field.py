"""Sight line against the ground: a surface of triangles over a square lattice.

The surface is linear between the points where the line from sensor s to column c, in plan s + t·(c
− s), crosses edges of triangles. These lie on x = k, y = k and x − y = k, in steps of the lattice.
Where the surface has the height h at a crossing, it hides the column below the ceiling z_s + (h −
z_s)/t (:func:`ground_ceiling`, exact scores), and the sensor sees the voxel at height z only from
above z + (h − z)/(1 − t) (:func:`ground_margin`, soft scores).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from inspe_jax.core.geometry import FAR, NEVER

FAMILIES = ((1, 0), (0, 1), (1, -1))  # k = a·(x, y) on the lines of each family
BESIDE = 1e-5
"""Crossings so near an end of the line, as a share of it, are the sensor's or the column's own."""


class HeightField(NamedTuple):
    """The ground's surface relative to the scene's centre: the lattice's first point (``corner``),
    the edge of its cells (``step``), and the heights of its points and the ``highest`` [m]. Cells
    are cut from their first point to the opposite one. ``steepest`` is the largest slope."""

    corner: Float[Array, "2"]
    step: Float[Array, ""]
    heights: Float[Array, "X Y"]
    highest: Float[Array, ""]
    steepest: Float[Array, ""]


class Lines(NamedTuple):
    """One family of lines and what of them lies between a sensor (``at``) and some columns
    (``to``), both in steps of the lattice; ``begin`` and ``along`` are a·s and a·(c − s). The lines
    ``first`` to ``last`` are crossed."""

    axis: tuple[int, int]
    at: Float[Array, "2"]
    to: Float[Array, "2 C"]
    begin: Float[Array, ""]
    along: Float[Array, " C"]
    first: Int[Array, ""]
    last: Int[Array, ""]


def lines_between(
    field: HeightField, sensor: Float[Array, "3"], columns: Float[Array, "2 C"], after: Array
) -> list[Lines]:
    """The lines of each family that sight lines cross beyond the share ``after`` of their way."""
    at = (sensor[:2] - field.corner) / field.step
    to = (columns - field.corner[:, None]) / field.step
    size, found = field.heights.shape, []
    for a, b in FAMILIES:
        begin, end = a * at[0] + b * at[1], a * to[0] + b * to[1]
        near = begin + after * (end - begin)
        low, high = -(size[1] - 1) if b < 0 else 0, size[0] - 1 if a else size[1] - 1
        first = jnp.ceil(jnp.minimum(near, end).min() - BESIDE)
        last = jnp.floor(jnp.maximum(near, end).max() + BESIDE)
        bounds = (jnp.clip(k, low, high + 1).astype(int) for k in (first, last))
        found.append(Lines((a, b), at, to, begin, end - begin, *bounds))
    return found


def crossing(
    field: HeightField, lines: Lines, k: Int[Array, "*n"]
) -> tuple[Float[Array, "*n C"], Float[Array, "*n C"], Bool[Array, "*n C"]]:
    """Where sight lines cross line ``k``: the share t of their way, the surface's height there, and
    whether there is such a crossing on the surface."""
    k = jnp.asarray(k)
    along, *way = (
        x[None] if k.ndim > 1 else x for x in (lines.along, *(lines.to - lines.at[:, None]))
    )
    crosses = jnp.abs(along) >= BESIDE
    t = (k.astype(along.dtype) - lines.begin) / jnp.where(crosses, along, 1.0)
    # Compilers may compute x and y anew for each use. With the product bounded before it is added,
    # none rounds both at once, so that all uses see the same x and y, and the same edge.
    x, y = (lines.at[n] + jnp.maximum(t * way[n], -FAR) for n in (0, 1))
    size, along_x = field.heights.shape, lines.axis != (1, 0)
    # The edge of a line's triangles begins at a point of the lattice, and ends one further.
    running = x if along_x else y
    start = jnp.floor(jax.lax.stop_gradient(running))
    start = jnp.clip(start, 0, size[0 if along_x else 1] - 2).astype(int)
    k = jnp.broadcast_to(k, start.shape)
    i, j = (start, {0: k, 1: start - k}[lines.axis[0]]) if along_x else (k, start)
    ends = [(i, j), (i + int(along_x), j + int(lines.axis != (0, 1)))]
    low, high = (
        field.heights[jnp.clip(m, 0, size[0] - 1), jnp.clip(n, 0, size[1] - 1)] for m, n in ends
    )
    height = low + (running - start.astype(low.dtype)) * (high - low)
    there = (t > BESIDE) & (t < 1 - BESIDE) & crosses
    there &= (x >= 0) & (y >= 0) & (x <= size[0] - 1) & (y <= size[1] - 1)
    return t, height, there


def fold_crossings(
    field: HeightField,
    sensor: Float[Array, "3"],
    columns: Float[Array, "2 C"],
    lowest: Float[Array, ""],
    spare: float | Array,
    add: Callable[..., Any],
    start: Any,
) -> Any:
    """``total = add(total, number, t, height, there)`` over all crossings but those before which a
    line from ``spare`` metres below the sensor is above all ground. Line k of family f has the
    number 3·k + f."""
    height = sensor[2] - spare
    clear = (height - field.highest) / jnp.maximum(height - lowest, 1e-3)
    after = jnp.where(height > field.highest, jnp.clip(clear, 0.0, 1.0), 0.0)
    for f, lines in enumerate(lines_between(field, sensor, columns, after)):

        def step(k: Array, total: Any, f: int = f, lines: Lines = lines) -> Any:
            return add(total, 3 * k + f, *crossing(field, lines, k))

        start = jax.lax.fori_loop(lines.first, lines.last + 1, step, start)
    return start


def ground_ceiling(
    field: HeightField,
    sensor: Float[Array, "3"],
    columns: Float[Array, "2 C"],
    lowest: Float[Array, ""],
) -> Float[Array, " C"]:
    """The height [m] below which the ground hides each column from a sensor, :data:`NEVER` where
    nothing does. ``lowest`` is at most the height of the voxels that matter."""

    def lift(ceiling: Array, _: Array, t: Array, height: Array, there: Array) -> Array:
        above = sensor[2] + (height - sensor[2]) / jnp.where(there, t, 1.0)
        return jnp.maximum(ceiling, jnp.where(there, above, NEVER))

    start = jnp.full_like(columns[0], NEVER)
    return fold_crossings(field, sensor, columns, lowest, 0.0, lift, start)


def ground_margin(
    field: HeightField,
    sensor: Float[Array, "3"],
    columns: Float[Array, "2 C"],
    heights: Float[Array, "Z C"],
    lowest: Float[Array, ""],
    beyond: float | Array,
) -> Float[Array, "Z C"]:
    """How far the sensor is too low to see each voxel over the ground [m]; negative if it sees it.
    Margins of less than −``beyond`` may be any such. Only the sensor has a gradient."""
    fixed = jax.lax.stop_gradient(sensor)

    def needed(t: Array, height: Array) -> Array:
        t, height = (x if x.ndim > 1 else x[None] for x in (t, height))
        return heights + (height - heights) / (1.0 - t)

    def higher(
        best: tuple[Array, Array], number: Array, t: Array, height: Array, there: Array
    ) -> tuple[Array, Array]:
        least = jnp.where(there[None], needed(jnp.where(there, t, 0.5), height), NEVER)
        over = least > best[0]
        return jnp.where(over, least, best[0]), jnp.where(over, number, best[1])

    nothing = jnp.full_like(heights, NEVER), jnp.full(heights.shape, -1)
    _, decides = fold_crossings(field, fixed, columns, lowest, beyond, higher, nothing)
    decides = jax.lax.stop_gradient(decides)
    found = jnp.full_like(heights, -FAR)
    for f, lines in enumerate(lines_between(field, sensor, columns, jnp.zeros(()))):
        own = (decides >= 0) & (decides % 3 == f)
        t, height, there = crossing(field, lines, jnp.where(own, decides // 3, 0))
        ours = own & there
        margin = needed(jnp.where(ours, t, 0.5), jnp.where(ours, height, 0.0)) - sensor[2]
        found = jnp.where(ours, margin, found)
    return found
