"""Line of sight: does a vehicle cut the line to the voxel's centre? The rays do not matter."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float, UInt

from inspe_jax.core.geometry import (
    FAR,
    NEVER,
    Cut,
    Line,
    Prism,
    ShadowTerms,
    below_top,
    plan_cut,
    plan_margin,
    shadow_ceiling,
    shadow_terms,
    stretch,
)
from inspe_jax.core.numerics import REACH, Width, exact, step
from inspe_jax.visibility import bitmask
from inspe_jax.visibility.tiles import CLOSE, Tile, levels


def shadow_ceilings(
    sensors: Float[Array, "S 3"],
    prisms: Prism,
    columns: Float[Array, "L 2"],
    *,
    ignore_self_occlusion: bool = False,
) -> Float[Array, "S L"]:
    """Height [m] below which the prisms (B,) of one frame hide each column from each sensor.

    A voxel whose centre is higher is in line of sight. The cost is columns ×
    prisms, not voxels × prisms. The scan over prisms keeps one number a column;
    unrolled by 8 it runs from registers.
    """

    def one(sensor: Float[Array, "3"]) -> Float[Array, " L"]:
        dx, dy = columns[:, 0] - sensor[0], columns[:, 1] - sensor[1]

        def lift(ceiling, prism_shade):  # type: ignore[no-untyped-def]
            new = shadow_ceiling(
                prism_shade, dx, dy, sensor[2], ignore_self_occlusion=ignore_self_occlusion
            )
            return jnp.maximum(ceiling, new), None

        start = jnp.full(len(columns), NEVER, columns.dtype)
        return jax.lax.scan(lift, start, shadow_terms(sensor, prisms), unroll=8)[0]

    return jax.vmap(one)(sensors)


WINNERS = 2
"""Prisms a column that soft sight lines are read against: those that hide most of it."""
WON = "won"
"""Name of who they are, for what is kept for a gradient: the sweep that finds them is most of the
work, and they take the least room."""


def soft_sight(
    sensor: Float[Array, "3"],
    prisms: Prism,
    marked: UInt[Array, "W F"],
    columns: Float[Array, "2 C"],
    heights: Float[Array, "Z C"],
    width: Width,
    *,
    ignore_self_occlusion: bool | Bool[Array, "Z F C"] = False,
) -> Float[Array, "Z F C"]:
    """Chance that the marked prisms (F, B) of each frame leave the lines to some voxels clear.

    Read exactly, the highest ceiling of all prisms over a column decides. Softly, 1 − p of the
    :data:`WINNERS` prisms that hide most of a column are multiplied, p being the reading of how
    deep the line cuts in sideways times that of how far below the top; prisms that narrowly miss
    count. Who wins is found without differentiation, by how much they hide of the lines to the
    first of ``heights``, the lowest. ``ignore_self_occlusion``: a prism does not hide the columns
    it stands on; or which voxels there it does not, and then one sweep finds who wins with and
    without it.
    """
    both = not isinstance(ignore_self_occlusion, bool)
    if exact(width):

        def clear(own: bool) -> Float[Array, "Z F C"]:
            ceilings = partial(
                shadow_ceilings, sensor[None], columns=columns.T, ignore_self_occlusion=own
            )
            over = jax.vmap(lambda prisms: ceilings(prisms=prisms)[0])(prisms)
            return step(heights[:, None] - over[None])

        return (
            jnp.where(ignore_self_occlusion, clear(True), clear(False))
            if both
            else clear(bool(ignore_self_occlusion))
        )
    x, y = columns[:, None]
    fixed, soft = jax.lax.stop_gradient((sensor, jnp.asarray(width, sensor.dtype)))
    # (7, F, B): a prism as it lies, to be fetched by its number.
    table = jnp.stack(
        [
            *(prisms.center[..., 0], prisms.center[..., 1], jnp.cos(prisms.yaw)),
            *(jnp.sin(prisms.yaw), prisms.half[..., 0], prisms.half[..., 1], prisms.top),
        ]
    )
    frames, count = prisms.top.shape
    spare = jnp.uint32(2 ** max(count - 1, 1).bit_length() - 1)

    sets = (False, True) if both else (ignore_self_occlusion,)

    def enter(best: Any, index: Array, some: Array) -> Any:
        prism = table[:, jnp.arange(frames), index][:, :, None]
        hides, stands = _hides(fixed, prism, x, y, heights[:1], soft)
        # The number in the last bits of how much it hides: the best are then kept by max alone.
        key = jax.lax.bitcast_convert_type(hides.astype(jnp.float32), jnp.uint32)
        key = (key & ~spare) | index.astype(jnp.uint32)[:, None]
        key = jnp.where((hides > 0) & some[:, None], key, jnp.uint32(0))
        kept = []
        for held, own in zip(best, sets, strict=True):
            new, ranks = jnp.where(stands, jnp.uint32(0), key) if own else key, []
            for k in range(len(held)):
                ranks.append(jnp.maximum(held[k], new))
                new = jnp.minimum(held[k], new)
            kept.append(tuple(ranks))
        return tuple(kept)

    nobody = jnp.zeros((frames, x.shape[-1]), jnp.uint32)
    none = ((nobody,) * min(WINNERS, count),) * len(sets)
    best = bitmask.fold_marked(marked, enter, none)
    best = jax.tree.map(partial(checkpoint_name, name=WON), best)
    # The sensor at every point: slopes are then added up point by point, and summed but once.
    sx, sy, sz = (jnp.broadcast_to(s, nobody.shape) for s in sensor)

    def clear_of(best: tuple[Array, ...]) -> Float[Array, "Z F C"]:
        cuts = []
        for key in best:
            won = jnp.take_along_axis(table, (key & spare).astype(jnp.int32)[None], 2)
            cut = plan_cut(_own_frame(won, sx, sy, x, y), (won[4], won[5]))
            hides = jnp.where(key > spare, step(cut.beside, width), 0.0)
            cuts.append((cut, won[6] - sz, hides))

        @jax.checkpoint
        def level(z: Float[Array, "1 C"]) -> Float[Array, "F C"]:
            clear = jnp.ones_like(sz)
            for cut, rise, hides in cuts:
                clear *= 1.0 - hides * step(below_top(cut, rise, sz - z), width)
            return clear

        return jax.lax.map(level, heights[:, None])

    if not both:
        return clear_of(best[0])
    nothing = jnp.zeros((len(heights), *nobody.shape), sz.dtype)

    def read(one: tuple[Array, Array]) -> Float[Array, "Z F C"]:
        asked, best = one
        return jax.lax.cond(asked, clear_of, lambda _: nothing, tuple(best))

    asked = jnp.stack([jnp.array(True), jnp.any(ignore_self_occlusion)])
    line, others = jax.lax.map(read, (asked, jnp.stack([jnp.stack(ranks) for ranks in best])))
    return jnp.where(ignore_self_occlusion, others, line)


def _own_frame(prism: Float[Array, "7 ..."], sx: Array, sy: Array, x: Array, y: Array) -> Line:
    """The line from (sx, sy) to (x, y) in a prism's own frame."""
    cx, cy, cos, sin = prism[:4]
    dx, dy, ox, oy = sx - cx, sy - cy, x - sx, y - sy
    return Line(
        *(cos * dx + sin * dy, cos * dy - sin * dx),
        *(cos * ox + sin * oy, cos * oy - sin * ox),
    )


def _hides(
    sensor: Float[Array, "3"],
    prism: Float[Array, "7 ..."],
    x: Float[Array, "*n"],
    y: Float[Array, "*n"],
    lowest: Float[Array, "*n"],
    width: Float[Array, ""],
) -> tuple[Float[Array, "*n"], Bool[Array, "*n"]]:
    """How much of a column a prism hides, in a cheap soft way: the reading of how deep the line to
    its lowest voxel cuts in, times how far that passes below the top [m]. Where the line leaves the
    prism is taken as where the stretch ends that the prism takes up along it. And whether the prism
    stands on the column.
    """
    a, b, top = prism[4:]
    line = _own_frame(prism, sensor[0], sensor[1], x, y)
    beside = plan_margin(line, (a, b))
    cut = Cut(beside, *stretch(line, (a, b)))
    below = below_top(cut, top - sensor[2], sensor[2] - lowest)
    hides = step(beside, width) * jnp.maximum(below + REACH * width, 0.0)
    return hides, (jnp.abs(line.x + line.ex) < a) & (jnp.abs(line.y + line.ey) < b)


# ── Tile by tile ───────────────────────────────────────────────────


class ShadowBounds(NamedTuple):
    """The prisms of T frames as one sensor sees them: what tells which tiles their shadows miss.

    ``terms`` (T, B) for the sight lines; of the circle about each prism, (B, T) each: its bearing
    ``x``, ``y``, the cosine and sine of half the angle it takes up, whether it is ``around`` the
    sensor, how far away it begins (``near`` [m]), its radius (``span`` [m]), and how far its shadow
    falls for each metre that the sensor is above the ground (``fall``).
    """

    terms: ShadowTerms
    x: Float[Array, "B T"]
    y: Float[Array, "B T"]
    cos: Float[Array, "B T"]
    sin: Float[Array, "B T"]
    around: Bool[Array, "B T"]
    near: Float[Array, "B T"]
    span: Float[Array, "B T"]
    fall: Float[Array, "B T"]


def shadow_bounds(sensor: Float[Array, "3"], prisms: Prism, wider: Any = 0.0) -> ShadowBounds:
    """What one sensor's shadows need of the prisms (T, B), for all tiles; ``wider`` and higher."""
    x, y = prisms.center[..., 0] - sensor[0], prisms.center[..., 1] - sensor[1]
    span = jnp.hypot(prisms.half[..., 0] + wider, prisms.half[..., 1] + wider) + CLOSE
    away = jnp.maximum(jnp.hypot(x, y), CLOSE)
    sin = jnp.minimum(span / away, 1.0)
    # Similar triangles: from the sensor over the far edge of the top down to the ground.
    above = sensor[2] - prisms.top - wider
    fall = jnp.where(above > CLOSE, (away + span) / jnp.maximum(above, CLOSE), FAR)
    near = jnp.where(prisms.valid, away - span, FAR)
    columns = x / away, y / away, jnp.sqrt(1.0 - sin * sin), sin, away <= span, near, span, fall
    return ShadowBounds(shadow_terms(sensor, prisms), *(leaf.T for leaf in columns))


def may_shade(
    sensor: Float[Array, "3"], shadow_bounds: ShadowBounds, tile: Tile
) -> Bool[Array, "B T"]:
    """Whether a prism's shadow may touch a tile: if not, it does not.

    The circles about both overlap in bearing, the prism does not begin beyond the tile, and its
    shadow does not reach the ground before it.
    """
    x, y = tile.center[0] - sensor[0], tile.center[1] - sensor[1]
    span = tile.radius + CLOSE
    away = jnp.maximum(jnp.hypot(x, y), CLOSE)
    sin = jnp.minimum(span / away, 1.0)
    cos = jnp.sqrt(1.0 - sin * sin)
    between = (
        shadow_bounds.x * x + shadow_bounds.y * y
    ) / away  # cosine of the angle between their bearings
    overlap = between >= cos * shadow_bounds.cos - sin * shadow_bounds.sin - CLOSE**2
    drop = jnp.maximum(sensor[2] - tile.low, CLOSE)  # more than 0: a prism above it hides all
    reaches = away - span <= drop * shadow_bounds.fall + CLOSE
    return (
        (overlap | shadow_bounds.around | (away <= span))
        & (shadow_bounds.near <= away + span)
        & reaches
    )


def stand_on(
    sensor: Float[Array, "3"], shadow_bounds: ShadowBounds, tile: Tile, solid: UInt[Array, "T C"]
) -> Bool[Array, "B T"]:
    """Whether a prism may stand on a column of a tile, with or without a ``solid`` voxel in it.

    By the circles about both; if not, it is :data:`~inspe_jax.visibility.tiles.CLOSE` away from all
    columns. Where no voxel is solid, only a prism may that is lower than some column's lowest.
    """
    away = shadow_bounds.near + shadow_bounds.span
    x = sensor[0] + away * shadow_bounds.x - tile.center[0]
    y = sensor[1] + away * shadow_bounds.y - tile.center[1]
    low = (shadow_bounds.terms.rise + sensor[2] <= tile.heights[0].max() + CLOSE).T
    close = jnp.hypot(x, y) <= shadow_bounds.span + tile.radius + CLOSE
    return close & (low | (solid != 0).any(1)[None])


OWN = 16
"""Frames that are gone through together for the prisms that stand on a tile."""


def clear_masks(
    sensor: Float[Array, "3"],
    shadow_bounds: ShadowBounds,
    tile: Tile,
    spared: UInt[Array, "T C"] | None = None,
) -> UInt[Array, "T C"]:
    """Masks of the voxels of one tile that are in line of sight of one sensor, in each frame.

    ``spared`` are masks of voxels inside vehicles that other vehicles alone may hide. As
    :func:`shadow_ceilings` has it, but only the prisms are looked at that :func:`may_shade`
    leaves, the first of every frame, then the second: some two of forty. Those that
    :func:`stand_on` the tile spare their own columns there, and hide in a second sweep, of few
    frames and fewer prisms, what is not ``spared``.
    """
    dx, dy = tile.columns[0] - sensor[0], tile.columns[1] - sensor[1]
    shading = may_shade(sensor, shadow_bounds, tile)
    every = jnp.arange(shading.shape[1])

    def above(frames: Array, marked: Array, standing: Array | None) -> UInt[Array, "F C"]:
        """Masks of what is above the ceilings of the marked prisms."""

        def lift(ceiling: Array, prism: Array, some: Array) -> Array:
            of = jax.tree.map(
                lambda leaf: leaf[frames, prism][:, None], shadow_bounds.terms
            )  # (F, 1)
            own = False if standing is None else standing[prism, frames][:, None]
            new = shadow_ceiling(of, dx[None], dy[None], sensor[2], ignore_self_occlusion=own)
            return jnp.maximum(ceiling, jnp.where(some[:, None], new, NEVER))

        start = jnp.full((len(frames), len(dx)), NEVER, dx.dtype)
        ceiling = bitmask.fold_marked(marked, lift, start)
        return levels(tile.heights[:, None] > ceiling[None], tile.there.dtype)

    if spared is None:
        return above(every, bitmask.marks(shading), None)
    standing = shading & stand_on(sensor, shadow_bounds, tile, spared)
    clear = above(every, bitmask.marks(shading), standing)
    number = standing.sum(0)
    order, marked = jnp.argsort(-number), bitmask.marks(standing)
    together = min(OWN, len(every))

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
    cast = shadow_bounds(sensor, prisms)
    return jax.lax.map(lambda tile: clear_masks(sensor, cast, tile), tiles)
