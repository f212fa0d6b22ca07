"""In view, read exactly: masks of the voxels that some ray of a sensor passes through."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, UInt

from inspe_jax.core.geometry import Point
from inspe_jax.core.parallel import jit_job
from inspe_jax.sensing.rays import Rays
from inspe_jax.visibility import bitmask
from inspe_jax.visibility.in_view import (
    SLACK,
    RigidTransform,
    Scalar,
    best_ray,
    may_touch_field,
    to_body,
    transform_of,
)
from inspe_jax.visibility.tiles import Tile

CHUNK = 256
"""Columns of which one undecided voxel each is tested at once."""


def view_masks(
    rays: Rays, pose: Float[Array, "*p"], tiles: Tile, half: Scalar
) -> UInt[Array, "N C"]:
    """Masks of the voxels that one sensor has in view: some ray passes through the voxel.

    Only the tiles that the field of view touches are tested, one level after the other. For nearly
    all voxels, the nearest ray decides (:func:`_by_nearest_ray`). For the rest, some 2 %, six rays
    do, as in :func:`~inspe_jax.visibility.in_view.in_view_margins`. A few voxels are in view here
    whose margins say otherwise: in very wide cameras and on rows with a steep elevation, the
    nearest ray may pass through a voxel that all six rays miss.

    Grids of one kind share a compiled program if their arrays have equal shapes.
    """
    transform = transform_of(pose)
    rays, transform = transform.through(rays), transform._replace(lens=None)
    x, y, up = transform.position

    def test_tile(tile: Tile) -> tuple[Array, Array]:
        dx, dy = tile.columns[0] - x, tile.columns[1] - y

        def test_level(z: Array, found: tuple[Array, Array]) -> tuple[Array, Array]:
            seen, undecided = found
            offset = dx, dy, tile.heights[z] - up
            hit, miss = _by_nearest_ray(rays, half, transform.to_world, offset)
            bit = jnp.ones((), seen.dtype) << z.astype(seen.dtype)
            none = jnp.zeros((), seen.dtype)
            return seen | jnp.where(hit, bit, none), undecided | jnp.where(hit | miss, none, bit)

        none = jnp.zeros_like(tile.there)
        seen, undecided = jax.lax.fori_loop(0, len(tile.heights), test_level, (none, none))
        return seen & tile.there, undecided & tile.there

    def unless_missed(tile: Tile) -> tuple[Array, Array]:
        none = jnp.zeros_like(tile.there)
        some = may_touch_field(rays, half, transform, tile) & (tile.there != 0).any()
        return jax.lax.cond(some, test_tile, lambda _: (none, none), tile)

    seen, undecided = jax.lax.map(unless_missed, tiles)
    return _settle(rays, half, transform, tiles, seen, undecided)


views_of_sensor = jit_job(view_masks)
"""The same, compiled for one sensor."""


def _by_nearest_ray(
    rays: Rays, half: Scalar, to_world: Float[Array, "3 3"], offset: Point
) -> tuple[Bool[Array, "*n"], Bool[Array, "*n"]]:
    """(whether a voxel surely is in view, whether it surely is not).

    Let q be the voxel's centre and p the point of a ray near it. The voxel is in view if the line
    from the sensor through p meets the cube: the separating axes are the cross products of the line
    with the cube's three. Three conditions make this sure: |p − q| is at most |q|/2, the sensor is
    further than an edge from q, and the whole cube is within the reach. The voxel is not in view if
    it lies between two rows or two columns, or has no corner in the field of view.
    """
    q = to_body(to_world, offset)
    to, slack = rays.to_ray(q)
    away = [sum(to_world[k, m] * to[m] for m in range(3)) for k in range(3)]
    p = [offset[k] + away[k] for k in range(3)]
    squared = q[0] * q[0] + q[1] * q[1] + q[2] * q[2]
    corner = 3.0**0.5 * half + SLACK
    hit = 4 * (to[0] * to[0] + to[1] * to[1] + to[2] * to[2]) <= squared
    hit &= (squared > 4 * half * half) & (jnp.sqrt(squared) + corner <= rays.table.reach)
    for k in range(3):
        across = jnp.abs(away[k - 1] * p[k - 2] - away[k - 2] * p[k - 1])
        hit &= across <= (half - SLACK - slack) * (jnp.abs(p[k - 1]) + jnp.abs(p[k - 2]))

    def extent(direction: Point) -> Float[Array, "*n"]:
        turned = (sum(to_world[k, m] * direction[m] for m in range(3)) for k in range(3))
        return (half + SLACK) * sum(map(jnp.abs, turned), jnp.zeros_like(q[0]))

    outside = rays.surely_outside(q, rays.table.edges, corner)
    return hit, outside | rays.between(q, half + SLACK, extent)


def _settle(
    rays: Rays,
    half: Scalar,
    transform: RigidTransform,
    tiles: Tile,
    seen: UInt[Array, "N C"],
    undecided: UInt[Array, "N C"],
) -> UInt[Array, "N C"]:
    """``seen``, and of the undecided voxels those that one of the six rays passes through.

    The loop tests one undecided voxel of each of :data:`CHUNK` columns at once. A column that has
    no more of them gives its place to the next column in the queue.
    """
    columns, heights = tiles.columns.swapaxes(-1, -2), tiles.heights.swapaxes(-1, -2)
    columns, heights = columns.reshape(-1, 2), heights.reshape(seen.size, -1)
    shape, seen, undecided = seen.shape, seen.ravel(), undecided.ravel()
    number = (undecided != 0).sum()
    queue = jnp.nonzero(undecided, size=len(seen), fill_value=len(seen))[0]

    def unfinished(state: Any) -> Array:
        begun, _, left, _ = state
        return (begun < number) | (left != 0).any()

    def test_next(state: Any) -> Any:
        begun, column, left, seen = state
        place = begun + jnp.cumsum(left == 0) - 1
        enters = (left == 0) & (place < number)
        column = jnp.where(enters, queue.at[place].get(mode="clip"), column)
        left = jnp.where(enters, undecided.at[column].get(mode="fill", fill_value=0), left)

        at = columns.at[column].get(mode="clip")
        height = heights.at[column, bitmask.lowest_bit(left)].get(mode="clip")
        passes = best_ray(rays, half, transform, jnp.column_stack([at, height]))[0] > 0
        new = jnp.where(passes, left & (~left + 1), 0) | seen.at[column].get(mode="clip")
        seen = seen.at[jnp.where(left != 0, column, len(seen))].set(new, mode="drop")
        return begun + enters.sum(), column, left & (left - 1), seen

    nothing = jnp.zeros(CHUNK, undecided.dtype)
    start = (jnp.zeros_like(number), jnp.full(CHUNK, len(seen)), nothing, seen)
    return jax.lax.while_loop(unfinished, test_next, start)[3].reshape(shape)
