"""Line of sight past static bodies and the ground: found once for all frames, as neither moves.

A body is convex prisms (:mod:`inspe_jax.core.convex`), the ground a surface of triangles
(:mod:`inspe_jax.core.height_field`). They hide a voxel where the line from the sensor to the
voxel's centre meets one of them. Read exactly, a prism hides if less than :data:`HALF` of the light
passes through it. Read softly, what all prisms and the ground let through is multiplied.
"""

import operator
from collections.abc import Callable
from functools import partial, reduce
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt

from inspe_jax.core.convex import ConvexPrism, convex_shadow, convex_terms
from inspe_jax.core.geometry import FAR, NEVER, Prism
from inspe_jax.core.height_field import HeightField, ground_ceiling, ground_margin
from inspe_jax.core.numerics import Width, certain_beyond, step
from inspe_jax.core.parallel import jit_job
from inspe_jax.visibility.centered_scene import Statics
from inspe_jax.visibility.shadows import ShadowBounds, may_shade, shadow_bounds
from inspe_jax.visibility.soft_sight import HALF, Sights, cell_marks, clear_chance
from inspe_jax.visibility.tiles import CLOSE, Tile, pack_levels, unless_empty

TOGETHER = 16
"""Prisms that are read exactly at once; a divisor of
:data:`~inspe_jax.visibility.centered_scene.PARTS`."""


def _bounds(sensor: Float[Array, "3"], bodies: ConvexPrism, wider: Any = 0.0) -> ShadowBounds:
    """The bounds of one sensor's shadows of the circles around prisms, ``wider`` by so much [m]."""
    low, high = bodies.corners.min(1), bodies.corners.max(1)
    middle = (low + high) / 2
    away = bodies.corners - middle[:, None]
    radius = jnp.hypot(away[..., 0], away[..., 1]).max(1)
    around = Prism(
        center=middle,
        yaw=jnp.zeros_like(radius),
        half=jnp.stack([radius, jnp.zeros_like(radius)], -1),
        top=bodies.top,
        valid=bodies.valid,
    )
    return shadow_bounds(sensor, jax.tree.map(lambda leaf: leaf[None], around), wider)


def past_statics_masks(
    sensor: Float[Array, "3"], statics: Statics, tiles: Tile, views: UInt[Array, "N C"]
) -> UInt[Array, "N C"]:
    """Masks of the voxels of N tiles that neither bodies nor the ground hide from a sensor.

    ``views`` are masks of what the sensor has in view; in a tile of which it has nothing are none.
    """
    hide = [_behind_bodies(sensor, statics.bodies)] if statics.bodies is not None else []
    hide += [_behind_ground(sensor, statics.ground)] if statics.ground is not None else []

    @unless_empty
    def of_tile(tile: Tile) -> UInt[Array, " C"]:
        return reduce(operator.and_, [clear(tile) for clear in hide], tile.there)

    def unless_unseen(part: tuple[Tile, Array]) -> UInt[Array, " C"]:
        tile, view = part
        nothing = jnp.zeros_like(tile.there)
        return jax.lax.cond((view != 0).any(), of_tile, lambda _: nothing, tile)

    return jax.lax.map(unless_unseen, (tiles, views))


def _behind_bodies(
    sensor: Float[Array, "3"], bodies: ConvexPrism
) -> Callable[[Tile], UInt[Array, " C"]]:
    """What gives masks of the voxels of a tile that no body hides.

    What stands on the ground hides all below its shadow's ceiling: of many prisms the highest
    ceiling decides. What begins above the ground hides levels in between.
    """
    hides = bodies.valid & (bodies.clear < HALF)
    stands = bodies.bottom <= -FAR / 2
    terms, bounds = convex_terms(sensor, bodies), _bounds(sensor, bodies)

    def clear(tile: Tile) -> UInt[Array, " C"]:
        dx, dy = tile.columns[0] - sensor[0], tile.columns[1] - sensor[1]
        near = may_shade(sensor, bounds, tile)[:, 0] & hides
        # Those that stand first, then those that begin above the ground, then all others.
        order = jnp.argsort(jnp.where(near, jnp.where(stands, 0, 1), 2), stable=True)
        order = jnp.pad(order, (0, TOGETHER))
        ends = (near & stands).sum(), near.sum()

        def shadows(index: Int[Array, " B"], some: Bool[Array, " B"]) -> tuple[Array, Array]:
            of = jax.tree.map(lambda leaf: leaf[index], terms)
            floor, ceiling = convex_shadow(of, dx, dy, sensor[2])  # (B, C)
            return floor, jnp.where(some[:, None], ceiling, NEVER)

        def lift(ceiling: Array, index: Array, some: Array) -> Array:
            return jnp.maximum(ceiling, shadows(index, some)[1].max(0))

        def hide(hidden: Array, index: Array, some: Array) -> Array:
            floor, ceiling = shadows(index, some)
            z = tile.heights[:, None]  # (Z, 1, C)
            between = ((z > floor[None]) & (z < ceiling[None])).any(1)
            return hidden | pack_levels(between, tile.there.dtype)

        ceiling = _fold(order, 0, ends[0], lift, jnp.full_like(dx, NEVER))
        hidden = _fold(order, ends[0], ends[1], hide, jnp.zeros_like(tile.there))
        return pack_levels(tile.heights > ceiling[None], tile.there.dtype) & ~hidden

    return clear


def _behind_ground(
    sensor: Float[Array, "3"], ground: HeightField
) -> Callable[[Tile], UInt[Array, " C"]]:
    """What gives masks of the voxels of a tile that the ground does not hide."""

    def clear(tile: Tile) -> UInt[Array, " C"]:
        rises = partial(ground_ceiling, ground, sensor, tile.columns, tile.low)
        nothing = jnp.full_like(tile.ground, NEVER)
        ceiling = jax.lax.cond(_may_rise(sensor, ground, tile), rises, lambda: nothing)
        return pack_levels(tile.heights > ceiling[None], tile.there.dtype)

    return clear


def _may_rise(
    sensor: Float[Array, "3"], ground: HeightField, tile: Tile, spare: Any = 0.0
) -> Bool[Array, ""]:
    """Whether the ground may rise to a sight line from ``spare`` [m] below the sensor to a tile.

    Where no slope is steeper than the line from the sensor to a column's foot, it does not.
    """
    away = jnp.hypot(tile.center[0] - sensor[0], tile.center[1] - sensor[1]) + tile.radius + CLOSE
    return sensor[2] - spare - tile.ground.max() < ground.steepest * away + CLOSE


def _fold(
    order: Int[Array, " P+"],
    begin: Int[Array, ""] | int,
    end: Int[Array, ""],
    add: Callable[..., Array],
    start: Array,
) -> Array:
    """``total = add(total, indices, some)`` over a stretch of ``order``, :data:`TOGETHER` at once.

    ``some`` is false for what is beyond the ``end``; ``order`` is longer by that many.
    """

    def step(i: Array, total: Array) -> Array:
        first = begin + i * TOGETHER
        index = jax.lax.dynamic_slice_in_dim(order, first, TOGETHER)
        return add(total, index, first + jnp.arange(TOGETHER) < end)

    return jax.lax.fori_loop(0, -(-(end - begin) // TOGETHER), step, start)


past_statics_of_sensor = jit_job(past_statics_masks)
"""The same, compiled for one sensor."""


def past_statics_chance(
    sensor: Float[Array, "3"], statics: Statics, tile: Tile, width: Width
) -> Float[Array, "Z C"]:
    """The chance that bodies and the ground leave a sensor's line to each voxel of a tile clear.

    It is ∏ (1 − p·(1 − transmittance)) over all prisms, with p the product of the margins of a cut
    read with ``width`` [m], and of the ground, whose margin is how far the sensor is too low. What
    narrowly misses counts too. Pieces of one body are taken as independent, so that at widths above
    their own size some light comes through. Only the sensor has a gradient.
    """
    clear, fixed = jnp.ones_like(tile.heights), jax.lax.stop_gradient(sensor)
    beyond = certain_beyond(width)
    if (bodies := statics.bodies) is not None:
        frame = jax.tree.map(lambda leaf: leaf[None], bodies)
        marked = cell_marks(fixed, frame, _bounds(fixed, bodies, beyond), tile, beyond)
        sights = Sights(frame, marked, tile.columns, tile.heights, width)
        clear *= clear_chance(sensor, sights, None, False)[:, 0]
    if (ground := statics.ground) is not None:

        def over(at: Array) -> Array:
            given = ground, at, tile.columns, tile.heights, tile.low, beyond
            return 1.0 - step(ground_margin(*given), width)

        clear *= jax.lax.cond(
            _may_rise(fixed, ground, tile, beyond), over, lambda _: jnp.ones_like(clear), sensor
        )
    return clear
