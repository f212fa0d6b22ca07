"""Line of sight: does a vehicle cut the line to the voxel's centre? The rays do not matter."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt

from inspe_jax import masks
from inspe_jax.geometry import (
    FAR,
    NEVER,
    Prism,
    Shade,
    cut_margins,
    shade,
    shadow_ceiling,
    shadow_height,
)
from inspe_jax.numerics import Width, exact, step
from inspe_jax.sensing.tiles import CLOSE, Tile, levels


def shadow_ceilings(
    sensors: Float[Array, "S 3"],
    prisms: Prism,
    columns: Float[Array, "L 2"],
    *,
    spare_own: bool = False,
) -> Float[Array, "S L"]:
    """Height [m] below which the prisms (B,) of one frame hide each column from each sensor.

    A voxel whose centre is higher is in line of sight. The cost is columns ×
    prisms, not voxels × prisms. The scan over prisms keeps one number a column;
    unrolled by 8 it runs from registers.
    """

    def one(sensor: Float[Array, "3"]) -> Float[Array, " L"]:
        dx, dy = columns[:, 0] - sensor[0], columns[:, 1] - sensor[1]

        def lift(ceiling, prism_shade):  # type: ignore[no-untyped-def]
            new = shadow_ceiling(prism_shade, dx, dy, sensor[2], spare_own=spare_own)
            return jnp.maximum(ceiling, new), None

        start = jnp.full(len(columns), NEVER, columns.dtype)
        return jax.lax.scan(lift, start, shade(sensor, prisms), unroll=8)[0]

    return jax.vmap(one)(sensors)


WINNERS = 2
"""Prisms a column that soft sight lines are read against: those that hide most of it."""


def sight(
    sensors: Float[Array, "S 3"],
    prisms: Prism,
    columns: Float[Array, "L 2"],
    heights: Float[Array, "L Z"],
    width: Width = None,
    *,
    spare_own: bool = False,
) -> Float[Array, "S L Z"]:
    """Chance that the prisms (B,) of one frame leave each sensor's sight line to a voxel clear.

    Read exactly, the highest ceiling over a column decides. Softly, 1 − p of the
    :data:`WINNERS` prisms that hide most of the column are multiplied, p being the reading of how
    deep the line cuts in sideways times that of how far below the top; prisms that narrowly miss
    count. Who wins is found without differentiation.
    """
    if exact(width):
        ceilings = shadow_ceilings(sensors, prisms, columns, spare_own=spare_own)
        return step(heights[None] - ceilings[:, :, None])

    def one(sensor: Float[Array, "3"]) -> Float[Array, "L Z"]:
        clear = jnp.ones_like(heights)
        fixed, soft = jax.lax.stop_gradient((sensor, jnp.asarray(width, sensor.dtype)))
        for winner, mass in _winners(fixed, prisms, columns, heights[:, 0], soft, spare_own):
            won = jax.tree.map(lambda leaf: leaf[winner], prisms)  # noqa: B023
            beside, below = cut_margins(sensor, won, columns, heights)
            hidden = step(beside, width)[:, None] * step(below, width)
            clear *= 1.0 - jnp.where((mass > 0)[:, None], hidden, 0.0)
        return clear

    return jax.vmap(one)(sensors)


def _winners(
    sensor: Float[Array, "3"],
    prisms: Prism,
    columns: Float[Array, "L 2"],
    lowest: Float[Array, " L"],
    width: Float[Array, ""],
    spare_own: bool,
) -> list[tuple[Int[Array, " L"], Float[Array, " L"]]]:
    """The prisms that hide most of each column, and how much [m]: the height of the shadow over
    the lowest voxel, times how deep the line cuts in, both read in a cheap soft way. Only a prism
    that is none hides nothing: if those far from the line were cut off, each that comes near would
    add a jump, and the gradient would miss what the jumps add up to.
    """
    dx, dy = columns[:, 0] - sensor[0], columns[:, 1] - sensor[1]
    per_metre = jax.lax.rsqrt(jnp.maximum(dx * dx + dy * dy, 1e-9))

    def enter(best, prism):  # type: ignore[no-untyped-def]
        number, prism, cast = prism
        sx, sy = sensor[0] - prism.center[0], sensor[1] - prism.center[1]
        x, y = cast.cos * sx + cast.sin * sy, cast.cos * sy - cast.sin * sx
        ex, ey = cast.cos * dx + cast.sin * dy, cast.cos * dy - cast.sin * dx
        a, b = prism.half
        support = a * jnp.abs(ey) + b * jnp.abs(ex)
        beside = (support - jnp.abs(x * ey - y * ex)) * per_metre
        beside = jnp.minimum(beside, a + jnp.abs(ex) / 2 - jnp.abs(x + ex / 2))
        beside = jnp.minimum(beside, b + jnp.abs(ey) / 2 - jnp.abs(y + ey / 2))
        u = beside / width
        cuts = 0.5 * (1.0 + u * jax.lax.rsqrt(4.0 + u * u))
        ceiling, stands = shadow_height(cast, dx, dy, sensor[2])
        height = jnp.clip(ceiling - lowest, -20.0, 20.0)
        mass = cuts * (height + jnp.sqrt(height * height + 4.0 * width * width))
        mass = jnp.where(prism.valid & ~(stands & spare_own), mass, 0.0)
        for k, (held, index) in enumerate(best):
            more = mass > held
            best[k] = jnp.where(more, mass, held), jnp.where(more, number, index)
            mass, number = jnp.where(more, held, mass), jnp.where(more, index, number)
        return best, None

    count = len(prisms.top)
    none = (jnp.zeros_like(dx), jnp.zeros(len(dx), int))
    numbers = jnp.arange(count)
    table = (numbers, prisms, shade(sensor, prisms))
    best = jax.lax.scan(enter, [none] * min(WINNERS, count), table, unroll=4)[0]
    return [(index, mass) for mass, index in best]


# ── Exactly, tile by tile ───────────────────────────────────────────────────


class Casts(NamedTuple):
    """The prisms of T frames as one sensor sees them: what tells which tiles their shadows miss.

    ``shade`` (T, B) for the sight lines; of the circle about each prism, (B, T) each: its bearing
    ``x``, ``y``, the cosine and sine of half the angle it takes up, whether it is ``around`` the
    sensor, how far away it begins (``near`` [m]), and how far its shadow falls for each metre that
    the sensor is above the ground (``fall``).
    """

    shade: Shade
    x: Float[Array, "B T"]
    y: Float[Array, "B T"]
    cos: Float[Array, "B T"]
    sin: Float[Array, "B T"]
    around: Bool[Array, "B T"]
    near: Float[Array, "B T"]
    fall: Float[Array, "B T"]


def casts(sensor: Float[Array, "3"], prisms: Prism) -> Casts:
    """What one sensor's shadows need of the prisms (T, B), for all tiles."""
    x, y = prisms.center[..., 0] - sensor[0], prisms.center[..., 1] - sensor[1]
    span = jnp.hypot(prisms.half[..., 0], prisms.half[..., 1]) + CLOSE
    away = jnp.maximum(jnp.hypot(x, y), CLOSE)
    sin = jnp.minimum(span / away, 1.0)
    # Similar triangles: from the sensor over the far edge of the top down to the ground.
    above = sensor[2] - prisms.top
    fall = jnp.where(above > CLOSE, (away + span) / jnp.maximum(above, CLOSE), FAR)
    near = jnp.where(prisms.valid, away - span, FAR)
    columns = x / away, y / away, jnp.sqrt(1.0 - sin * sin), sin, away <= span, near, fall
    return Casts(shade(sensor, prisms), *(leaf.T for leaf in columns))


def may_shade(sensor: Float[Array, "3"], casts: Casts, tile: Tile) -> Bool[Array, "B T"]:
    """Whether a prism's shadow may touch a tile: if not, it does not.

    The circles about both overlap in bearing, the prism does not begin beyond the tile, and its
    shadow does not reach the ground before it.
    """
    x, y = tile.center[0] - sensor[0], tile.center[1] - sensor[1]
    span = tile.radius + CLOSE
    away = jnp.maximum(jnp.hypot(x, y), CLOSE)
    sin = jnp.minimum(span / away, 1.0)
    cos = jnp.sqrt(1.0 - sin * sin)
    between = (casts.x * x + casts.y * y) / away  # cosine of the angle between their bearings
    overlap = between >= cos * casts.cos - sin * casts.sin - CLOSE**2
    drop = jnp.maximum(sensor[2] - tile.low, CLOSE)  # more than 0: a prism above it hides all
    reaches = away - span <= drop * casts.fall + CLOSE
    return (overlap | casts.around | (away <= span)) & (casts.near <= away + span) & reaches


def clear_masks(
    sensor: Float[Array, "3"], casts: Casts, tile: Tile, *, spare_own: bool = False
) -> UInt[Array, "T C"]:
    """Masks of the voxels of one tile that are in line of sight of one sensor, in each frame.

    As :func:`shadow_ceilings` has it, but only the prisms are looked at that :func:`may_shade`
    leaves, the first of every frame, then the second: some two of forty.
    """
    dx, dy = tile.columns[0] - sensor[0], tile.columns[1] - sensor[1]
    frames = jnp.arange(casts.x.shape[1])

    def lift(ceiling: Array, prism: Array, some: Array) -> Array:
        of = jax.tree.map(lambda leaf: leaf[frames, prism][:, None], casts.shade)  # (T, 1)
        new = shadow_ceiling(of, dx[None], dy[None], sensor[2], spare_own=spare_own)
        return jnp.maximum(ceiling, jnp.where(some[:, None], new, NEVER))

    start = jnp.full((len(frames), len(dx)), NEVER, dx.dtype)
    marked = masks.marks(may_shade(sensor, casts, tile))
    ceiling = masks.fold_marked(marked, lift, start)
    return levels(tile.heights[:, None] > ceiling[None], tile.there.dtype)


@jax.jit
def sight_masks(sensor: Float[Array, "3"], prisms: Prism, tiles: Tile) -> UInt[Array, "N T C"]:
    """Masks of the voxels that are in line of sight of one sensor, in T frames of prisms (T, B)."""
    cast = casts(sensor, prisms)
    return jax.lax.map(lambda tile: clear_masks(sensor, cast, tile), tiles)
