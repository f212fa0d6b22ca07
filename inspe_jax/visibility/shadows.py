"""Line of sight: does a vehicle cut the line from a sensor to a voxel's centre?

Rays do not matter here. Vehicles are prisms, with shadows of :mod:`inspe_jax.core.geometry`.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, UInt

from inspe_jax.core.geometry import FAR, NEVER, Prism, ShadowTerms, shadow_ceiling, shadow_terms
from inspe_jax.visibility import bitmask
from inspe_jax.visibility.tiles import CLOSE, Tile, pack_levels


class ShadowBounds(NamedTuple):
    """Bounds of one sensor's shadows in T frames, which tell the tiles that a shadow misses.

    ``terms`` are those of the sight lines, all numbers in one array, to be fetched together. The
    others are of the circle around each prism in
    plan: the unit vector ``x``, ``y`` from the sensor to its centre; ``cos`` and ``sin`` of half
    the angle that it takes up; whether the sensor is inside it (``around``); how far away it begins
    (``near`` [m]); its radius (``span`` [m]); and ``fall``, how far from the sensor the shadow
    reaches for each metre of the sensor's height above the ground.
    """

    terms: Float[Array, "N T B"]
    x: Float[Array, "B T"]
    y: Float[Array, "B T"]
    cos: Float[Array, "B T"]
    sin: Float[Array, "B T"]
    around: Bool[Array, "B T"]
    near: Float[Array, "B T"]
    span: Float[Array, "B T"]
    fall: Float[Array, "B T"]


def shadow_bounds(sensor: Float[Array, "3"], prisms: Prism, wider: Any = 0.0) -> ShadowBounds:
    """The bounds of one sensor's shadows of prisms (T, B), the same for all tiles.

    Prisms are taken ``wider`` and higher by so much [m], along the sight line and across it; then
    the circle is that about any rectangle about the prism.
    """
    x, y = prisms.center[..., 0] - sensor[0], prisms.center[..., 1] - sensor[1]
    soft = not (isinstance(wider, float) and wider == 0)
    span = prisms.half.sum(-1) if soft else jnp.hypot(prisms.half[..., 0], prisms.half[..., 1])
    span += jnp.sqrt(2.0) * wider + CLOSE
    away = jnp.maximum(jnp.hypot(x, y), CLOSE)
    sin = jnp.minimum(span / away, 1.0)
    # Similar triangles: from the sensor over the far edge of the top down to the ground.
    above = sensor[2] - prisms.top - wider
    fall = jnp.where(above > CLOSE, (away + span) / jnp.maximum(above, CLOSE), FAR)
    near = jnp.where(prisms.valid, away - span, FAR)
    columns = x / away, y / away, jnp.sqrt(1.0 - sin * sin), sin, away <= span, near, span, fall
    terms = jnp.stack([leaf.astype(x.dtype) for leaf in shadow_terms(sensor, prisms)])
    return ShadowBounds(terms, *(leaf.T for leaf in columns))


def may_shade(sensor: Float[Array, "3"], bounds: ShadowBounds, tile: Tile) -> Bool[Array, "B T"]:
    """Whether a prism's shadow may touch a tile; where it is false, the shadow misses the tile.

    It may if the circles around both overlap in bearing, the prism does not begin beyond the tile,
    and the shadow does not reach the ground before the tile.
    """
    x, y = tile.center[0] - sensor[0], tile.center[1] - sensor[1]
    span = tile.radius + CLOSE
    away = jnp.maximum(jnp.hypot(x, y), CLOSE)
    sin = jnp.minimum(span / away, 1.0)
    cos = jnp.sqrt(1.0 - sin * sin)
    between = (bounds.x * x + bounds.y * y) / away  # cosine of the angle between their bearings
    overlap = between >= cos * bounds.cos - sin * bounds.sin - CLOSE**2
    # A prism that is higher than the sensor hides all behind it: drop > 0 lets it reach the tile.
    drop = jnp.maximum(sensor[2] - tile.low, CLOSE)
    reaches = away - span <= drop * bounds.fall + CLOSE
    return (overlap | bounds.around | (away <= span)) & (bounds.near <= away + span) & reaches


def may_stand_on(
    sensor: Float[Array, "3"], bounds: ShadowBounds, tile: Tile, solid: UInt[Array, "T C"]
) -> Bool[Array, "B T"]:
    """Whether a prism may stand on a column of a tile, whether or not a voxel there is ``solid``.

    Where it is false, the prism is at least :data:`~inspe_jax.visibility.tiles.CLOSE` away from all
    columns. Where no voxel of a frame is solid, only one below some column's lowest voxel may.
    """
    away = bounds.near + bounds.span
    x = sensor[0] + away * bounds.x - tile.center[0]
    y = sensor[1] + away * bounds.y - tile.center[1]
    low = (ShadowTerms(*bounds.terms).rise + sensor[2] <= tile.heights[0].max() + CLOSE).T
    close = jnp.hypot(x, y) <= bounds.span + tile.radius + CLOSE
    return close & (low | (solid != 0).any(1)[None])


STANDING_FRAMES = 16
"""Frames that are worked on at once for the prisms that stand on a tile."""


def clear_masks(
    sensor: Float[Array, "3"],
    bounds: ShadowBounds,
    tile: Tile,
    spared: UInt[Array, "T C"] | None = None,
) -> UInt[Array, "T C"]:
    """Masks of the voxels of one tile that are in line of sight of one sensor, in each frame.

    These are the voxels above every prism's :func:`~inspe_jax.core.geometry.shadow_ceiling`. Only
    the prisms that :func:`may_shade` the tile are taken, one of every frame at once.

    ``spared`` are masks of voxels inside vehicles that only other vehicles may hide. Then there are
    two passes. In the first, a prism that :func:`may_stand_on` the tile does not hide its own
    columns. In the second, of few frames and fewer prisms, it hides there what is not ``spared``.
    """
    dx, dy = tile.columns[0] - sensor[0], tile.columns[1] - sensor[1]
    shading = may_shade(sensor, bounds, tile)
    every = jnp.arange(shading.shape[1])

    def above(frames: Array, marked: Array, standing: Array | None) -> UInt[Array, "F C"]:

        def lift(ceiling: Array, prism: Array, some: Array) -> Array:
            of = ShadowTerms(*bounds.terms[:, frames, prism][..., None])  # (F, 1)
            of = of._replace(x_inside=of.x_inside > 0, y_inside=of.y_inside > 0)
            own = False if standing is None else standing[prism, frames][:, None]
            new = shadow_ceiling(of, dx[None], dy[None], sensor[2], ignore_self_occlusion=own)
            return jnp.maximum(ceiling, jnp.where(some[:, None], new, NEVER))

        start = jnp.full((len(frames), len(dx)), NEVER, dx.dtype)
        ceiling = bitmask.fold_marked(marked, lift, start)
        return pack_levels(tile.heights[:, None] > ceiling[None], tile.there.dtype)

    if spared is None:
        return above(every, bitmask.marks(shading), None)
    standing = shading & may_stand_on(sensor, bounds, tile, spared)
    clear = above(every, bitmask.marks(shading), standing)
    number = standing.sum(0)
    order, marked = jnp.argsort(-number), bitmask.marks(standing)
    together = min(STANDING_FRAMES, len(every))

    def hide(part: Array, clear: Array) -> Array:
        # The last part may go back to frames of the one before, which hides nothing more.
        frames = jax.lax.dynamic_slice_in_dim(order, part * together, together)
        others = above(frames, marked[:, frames], None)
        return clear.at[frames].set(clear[frames] & (spared[frames] | others))

    parts = -(-(number > 0).sum() // together)
    return jax.lax.fori_loop(0, parts, hide, clear)


@jax.jit
def sight_masks(sensor: Float[Array, "3"], prisms: Prism, tiles: Tile) -> UInt[Array, "N T C"]:
    """Masks of the voxels that are in line of sight of one sensor, in T frames of prisms (T, B)."""
    bounds = shadow_bounds(sensor, prisms)
    return jax.lax.map(lambda tile: clear_masks(sensor, bounds, tile), tiles)
