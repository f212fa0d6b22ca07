"""In view, exactly: masks of the voxels that a ray of a sensor passes through."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, UInt

from inspe_jax.core.geometry import Point
from inspe_jax.sensing.rays import Rays
from inspe_jax.sensing.sensors import RayGrid
from inspe_jax.visibility import bitmask
from inspe_jax.visibility.in_view import (
    SLACK,
    Scalar,
    Stance,
    best_ray,
    stance_at,
    to_body,
    touches,
)
from inspe_jax.visibility.tiles import Tile

CHUNK = 256
"""Columns whose unsure voxels are looked at together."""


def in_view_masks(
    grid: RayGrid, pose: Float[Array, "6"], tiles: Tile, half: float
) -> UInt[Array, "N C"]:
    """:func:`view_masks` of a grid of rays."""
    return view_masks(grid.rays, pose, tiles, half)


@jax.jit
def view_masks(
    rays: Rays, pose: Float[Array, "6"], tiles: Tile, half: Scalar
) -> UInt[Array, "N C"]:
    """Masks of the voxels that one sensor has in view: where both of :func:`in_view_margins` are
    positive. (A voxel that the candidates there miss, columns being many voxels apart, may be told
    by its nearest ray here.)

    Nearly all are told by their nearest ray (:func:`_sure`), level by level in the tiles that the
    field of view touches; the rest, some 2 %, by the six rays of :func:`_candidates`.

    Compiled once for each kind of grid.
    """
    stance = stance_at(pose)
    x, y, up = stance.position

    def look(tile: Tile) -> tuple[Array, Array]:
        dx, dy = tile.columns[0] - x, tile.columns[1] - y

        def level(z: Array, found: tuple[Array, Array]) -> tuple[Array, Array]:
            seen, unsure = found
            hit, miss = _sure(rays, half, stance.turn, (dx, dy, tile.heights[z] - up))
            bit = jnp.ones((), seen.dtype) << z.astype(seen.dtype)
            none = jnp.zeros((), seen.dtype)
            return seen | jnp.where(hit, bit, none), unsure | jnp.where(hit | miss, none, bit)

        none = jnp.zeros_like(tile.there)
        seen, unsure = jax.lax.fori_loop(0, len(tile.heights), level, (none, none))
        return seen & tile.there, unsure & tile.there

    def one(tile: Tile) -> tuple[Array, Array]:
        none = jnp.zeros_like(tile.there)
        some = touches(rays, half, stance, tile) & (tile.there != 0).any()
        return jax.lax.cond(some, look, lambda _: (none, none), tile)

    seen, unsure = jax.lax.map(one, tiles)
    return _settle(rays, half, stance, tiles, seen, unsure)


def _sure(
    rays: Rays, half: Scalar, turn: Float[Array, "3 3"], offset: Point
) -> tuple[Bool[Array, "*n"], Bool[Array, "*n"]]:
    """(whether a voxel surely is in view, whether it surely is not).

    It is where the line through a point p of a ray, near its centre q, meets the cube, by the axes
    across the line that separate a line from a cube; p must be near beside |q|, so that the line
    tells directions apart, and what it meets of the cube within the reach. It is not between rows
    or columns, or so far outside the field of view that no corner is inside.
    """
    q = to_body(turn, offset)
    to, slack = rays.to_ray(q)
    away = [sum(turn[k, m] * to[m] for m in range(3)) for k in range(3)]
    p = [offset[k] + away[k] for k in range(3)]
    squared = q[0] * q[0] + q[1] * q[1] + q[2] * q[2]
    corner = 3.0**0.5 * half + SLACK
    hit = 4 * (to[0] * to[0] + to[1] * to[1] + to[2] * to[2]) <= squared
    hit &= (squared > 4 * half * half) & (jnp.sqrt(squared) + corner <= rays.table.reach)
    for k in range(3):
        across = jnp.abs(away[k - 1] * p[k - 2] - away[k - 2] * p[k - 1])
        hit &= across <= (half - SLACK - slack) * (jnp.abs(p[k - 1]) + jnp.abs(p[k - 2]))

    def extent(direction: Point) -> Float[Array, "*n"]:
        turned = (sum(turn[k, m] * direction[m] for m in range(3)) for k in range(3))
        return (half + SLACK) * sum(map(jnp.abs, turned), jnp.zeros_like(q[0]))

    miss = (rays.field_margin(q) < -corner) | rays.between(q, half + SLACK, extent)
    return hit, miss


def _settle(
    rays: Rays,
    half: Scalar,
    stance: Stance,
    tiles: Tile,
    seen: UInt[Array, "N C"],
    unsure: UInt[Array, "N C"],
) -> UInt[Array, "N C"]:
    """``seen`` and those of the unsure voxels that one of the candidate rays passes through.

    :data:`CHUNK` columns at a time, one unsure voxel of each; a column that has no more makes room
    for the next.
    """
    columns, heights = tiles.columns.swapaxes(-1, -2), tiles.heights.swapaxes(-1, -2)
    columns, heights = columns.reshape(-1, 2), heights.reshape(seen.size, -1)
    shape, seen, unsure = seen.shape, seen.ravel(), unsure.ravel()
    number = (unsure != 0).sum()
    queue = jnp.nonzero(unsure, size=len(seen), fill_value=len(seen))[0]

    def more(state: Any) -> Array:
        begun, _, left, _ = state
        return (begun < number) | (left != 0).any()

    def look(state: Any) -> Any:
        begun, column, left, seen = state
        turn = begun + jnp.cumsum(left == 0) - 1
        enters = (left == 0) & (turn < number)
        column = jnp.where(enters, queue.at[turn].get(mode="clip"), column)
        left = jnp.where(enters, unsure.at[column].get(mode="fill", fill_value=0), left)

        at = columns.at[column].get(mode="clip")
        height = heights.at[column, bitmask.lowest(left)].get(mode="clip")
        passes = best_ray(rays, half, stance, jnp.column_stack([at, height]))[0] > 0
        new = jnp.where(passes, left & (~left + 1), 0) | seen.at[column].get(mode="clip")
        seen = seen.at[jnp.where(left != 0, column, len(seen))].set(new, mode="drop")
        return begun + enters.sum(), column, left & (left - 1), seen

    nothing = jnp.zeros(CHUNK, unsure.dtype)
    start = (jnp.zeros_like(number), jnp.full(CHUNK, len(seen)), nothing, seen)
    return jax.lax.while_loop(more, look, start)[3].reshape(shape)
