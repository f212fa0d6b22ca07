"""Sight lines past upright prisms, read softly: vehicles in each frame, and bodies in all of them.

The chance that a line is clear is ∏ (1 − p) over the prisms, with p from the one cut of
:func:`~inspe_jax.core.convex.sight_cut`. Every margin is a distance that the sensor has to move, so
that p is about the mean of the exact reading over places of the sensor near by, and slopes are
those of exact scores averaged over such places.

Only what may be hidden is read: cells of neighbouring columns with the prisms that are marked for
them, in blocks of cells with about as many marks, which stay in a core's nearest cache.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt

from inspe_jax.core.convex import NO_LEVER, SEAM, ConvexPrism, SightCut, sight_cut
from inspe_jax.core.geometry import FAR
from inspe_jax.core.numerics import Width, exact, slope_of_step, step
from inspe_jax.visibility import bitmask
from inspe_jax.visibility.shadows import ShadowBounds, may_shade
from inspe_jax.visibility.tiles import CLOSE, Tile, pack_levels

LINES = 2048
"""Sight lines that are read at once."""
HALF = 0.5
"""Read exactly, a crown hides what is behind it if its transmittance is less than this."""
LEVEL = 6e-6
"""Tops count as higher by this [m]: a voxel level with the top that it lies on is hidden, as it is
read exactly; for certain at widths up to 0.1 mm, as 6e-6 = REACH · 1e-4 · NO_LEVER. It is a few
roundings of a height of 10 m in single precision."""


class Sights(NamedTuple):
    """What sight lines are read of: prisms (F, B) in F frames, those that are ``marked`` for each
    frame and each of K cells of as many columns, the ``columns`` and the ``heights`` of voxels.

    ``spared`` are voxels that a prism which stands on their column does not hide; None for none.
    """

    prisms: ConvexPrism
    marked: UInt[Array, "W F K"]
    columns: Float[Array, "2 C"]
    heights: Float[Array, "Z C"]
    width: Width
    spared: Bool[Array, "Z F C"] | None = None


class SightsRead(NamedTuple):
    """How ``clear`` lines are, and marks of the prisms on which that depends (``sloped``): those
    that hide some line neither not at all nor for certain. :func:`packed`, ``clear`` are masks of
    the levels that are not hidden for certain."""

    clear: Float[Array, "Z F C"] | UInt[Array, "F C"]
    sloped: UInt[Array, "W F K"]


def packed(read: SightsRead) -> SightsRead:
    """What was read, in little room."""
    return read._replace(
        clear=pack_levels(read.clear > 0, jnp.dtype(bitmask.word(len(read.clear))))
    )


def read_sights(
    sensor: Float[Array, "3"], of: Sights, known: SightsRead | None = None, solid: bool = True
) -> SightsRead:
    """The chance that prisms leave the line from a sensor to each voxel clear, in each frame.

    ``solid``: all prisms stand on the ground and let no light through. ``known`` is what was read
    before: where it is packed, the marked prisms, which need be those that have a slope only, are
    looked at again.
    """
    if known is not None and known.clear.ndim == 3:
        return known
    words, frames, cells = of.marked.shape
    shape = len(of.heights), frames, of.columns.shape[1]
    # 0 where a line is known to be hidden for certain.
    clear = jnp.ones(shape) if known is None else bitmask.chances(known.clear, len(of.heights))
    blocks, block = _blocks(of, solid)

    def read(number: Array, found: SightsRead) -> SightsRead:
        rows = block(number)
        clear, sloped = rows.read(sensor)
        if known is not None:
            clear *= found.clear.at[:, rows.number].get(mode="fill", fill_value=0)
        put = lambda all_, new: all_.at[:, rows.number].set(new, mode="drop", unique_indices=True)  # noqa: E731
        return SightsRead(*map(put, found, (clear, sloped)))

    sloped = jnp.zeros((words, frames * cells), of.marked.dtype)
    start = SightsRead(clear.reshape(len(clear), frames * cells, -1), sloped)
    clear, sloped = jax.lax.fori_loop(0, blocks, read, start)
    sloped = sloped.reshape(of.marked.shape) if known is None else known.sloped
    return SightsRead(clear.reshape(shape), sloped)


@partial(jax.custom_vjp, nondiff_argnums=(3,))
def clear_chance(
    sensor: Float[Array, "3"], of: Sights, known: SightsRead | None = None, solid: bool = True
) -> Float[Array, "Z F C"]:
    """The same chance, with a gradient in the sensor's place; ``known`` if it is read already."""
    return read_sights(sensor, of, known, solid).clear


def _forward(
    sensor: Array, of: Sights, known: SightsRead | None, solid: bool
) -> tuple[Array, tuple]:
    known = read_sights(sensor, of, known, solid)
    return known.clear, (sensor, of._replace(marked=known.sloped), known.clear)


def _backward(solid: bool, kept: tuple, wanted: Float[Array, "Z F C"]) -> tuple:
    """Cell by cell again, of the prisms that have a slope: nothing else of a prism is kept."""
    sensor, of, clear = kept
    frames, cells = of.marked.shape[1:]
    blocks, block = _blocks(of, solid)
    # A line has a slope where it is neither clear nor hidden for certain.
    wanted = jnp.where(clear < 1.0, wanted * clear, 0.0)
    wanted = wanted.reshape(len(wanted), frames * cells, -1)

    def add(number: Array, slope: Array) -> Array:
        rows = block(number)
        return slope + rows.slope(sensor, wanted.at[:, rows.number].get(mode="fill", fill_value=0))

    return jax.lax.fori_loop(0, blocks, add, jnp.zeros_like(sensor)), None, None


clear_chance.defvjp(_forward, _backward)


class _Rows(NamedTuple):
    """A block of R cells of G columns: the ``number`` of each among frames × cells, what lines are
    read as, and the ``slope`` of their weighted sum, with weights times how clear they are."""

    number: Int[Array, " R"]
    read: Callable[[Float[Array, "3"]], tuple[Float[Array, "Z R G"], UInt[Array, "W R"]]]
    slope: Callable[[Float[Array, "3"], Float[Array, "Z R G"]], Float[Array, "3"]]


def _blocks(of: Sights, solid: bool) -> tuple[Array, Callable[[Array], _Rows]]:
    """The number of blocks of cells that have marks, and what gives one. Most marks come first."""
    words, frames, cells = of.marked.shape
    each = of.columns.shape[1] // cells
    marked = of.marked.reshape(words, frames * cells)
    count = bitmask.count(marked).sum(0)
    together = min(max(LINES // each, 1), count.size)
    order = _most_first(count)
    spare = count.size + jnp.arange(-count.size % together, dtype=order.dtype)
    order = jnp.concatenate([order, spare])
    table, shape = _packed(of.prisms)

    def block(number: Array) -> _Rows:
        number = jax.lax.dynamic_slice_in_dim(order, number * together, together)
        frame, cell = jnp.divmod(jnp.minimum(number, count.size - 1), cells)
        x, y = of.columns.reshape(2, cells, each)[:, cell]
        z = of.heights.reshape(-1, cells, each)[:, cell]
        marks = marked.at[:, number].get(mode="fill", fill_value=0)
        spared = None
        if of.spared is not None:
            spared = of.spared.reshape(len(z), frames, cells, each)[:, frame, cell]

        def meeting(
            sensor: Float[Array, "3"], index: Array, some: Array
        ) -> tuple[ConvexPrism, SightCut, InPlan]:
            """A prism of each row, how lines cut it in plan, and the chance that they meet it."""
            prism = _unpacked(table[:, frame, index][:, :, None], shape)
            cut = sight_cut(prism, sensor[0], sensor[1], x, y)
            plan = _in_plan(cut, of.width)
            return prism, cut, plan._replace(met=jnp.where(some[:, None], plan.met, 0.0))

        def hides(
            prism: ConvexPrism, cut: SightCut, plan: InPlan, sz: Array, level: tuple
        ) -> tuple[Array, AtLevel]:
            """How much of a level a prism of each row hides, and what that comes from."""
            z, spared = level
            at = _at_level(prism, plan, z, sz, of.width, solid)
            found = plan.met * at.hidden
            if spared is not None:  # by those that stand on the column
                found *= jnp.where(spared, (cut.depth <= 0).astype(found.dtype), 1.0)
            return found, at

        def read(sensor: Float[Array, "3"]) -> tuple[Float[Array, "Z R G"], UInt[Array, "W R"]]:
            def hide(found: tuple, index: Array, some: Array) -> tuple:
                clear, sloped = found
                prism = *meeting(sensor, index, some), sensor[2]

                def level(between: Array, of: tuple) -> tuple[Array, Array]:
                    hidden, _ = hides(*prism, of[1:])
                    return between + hidden * (1.0 - hidden), of[0] * (1.0 - hidden)

                # Level by level, or XLA would find the cut again for each.
                between, clear = jax.lax.scan(level, jnp.zeros_like(x), (clear, z, spared))
                mark = (between > 0).any(1)[:, None]
                return clear, bitmask.with_mark(sloped[..., None], index, mark)[..., 0]

            return bitmask.fold_marked(marks, hide, (jnp.ones_like(z), jnp.zeros_like(marks)))

        def slope(sensor: Float[Array, "3"], wanted: Float[Array, "Z R G"]) -> Float[Array, "3"]:
            """∂∏(1 − pᵢ) = −Σ ∂pᵢ · ∏/(1 − pᵢ). Where a prism hides for certain, pᵢ = 1, its own
            slope is 0, and so is what the others add.
            """
            dx, dy = sensor[0] - x, sensor[1] - y
            length = jnp.sqrt(jnp.maximum(dx * dx + dy * dy, 1e-9))
            ux, uy = dx / length, dy / length

            def add(slope: Array, index: Array, some: Array) -> Array:
                prism, cut, plan = meeting(sensor, index, some)

                def add_level(sums: tuple, of_level: tuple) -> tuple[tuple, None]:
                    wanted, *level = of_level
                    hidden, at = hides(prism, cut, plan, sensor[2], tuple(level))
                    some = (hidden > 0) & (hidden < 1.0)
                    wanted = jnp.where(some, -wanted / jnp.where(some, 1.0 - hidden, 1.0), 0.0)
                    met = (plan.met * by for by in (at.by_near, at.by_far, at.by_height))
                    slopes = zip(sums, (at.hidden, *met), strict=True)
                    return tuple(total + wanted * by for total, by in slopes), None

                sums = (jnp.zeros_like(x),) * 4
                (by_met, by_near, by_far, by_height), _ = jax.lax.scan(
                    add_level, sums, (wanted, z, spared)
                )
                margins = plan.by_left, plan.by_right, plan.by_ahead
                by_left, by_right, by_ahead = (by_met * by for by in margins)
                along = by_left * cut.along_left + by_right * cut.along_right
                along += by_ahead * cut.along_ahead - by_near * cut.near / length
                along -= by_far * jnp.where(cut.far < 1.0, cut.far, 0.0) / length
                across = by_left * cut.of_left + by_right * cut.of_right
                across += by_ahead * cut.of_ahead + by_near * cut.of_near + by_far * cut.of_far
                new = along * ux - across * uy, along * uy + across * ux, by_height
                return slope + jnp.stack([part.sum() for part in new])

            return bitmask.fold_marked(marks, add, jnp.zeros_like(sensor))

        return _Rows(number, read, slope)

    return -(-(count > 0).sum() // together), block


def cell_marks(
    sensor: Float[Array, "3"],
    prisms: ConvexPrism,
    bounds: ShadowBounds,
    tile: Tile,
    reach: float | Array,
) -> UInt[Array, "W F K"]:
    """Marks of the prisms (F, B) that may hide something of each cell of a tile; no other one does.

    Of those that :func:`~inspe_jax.visibility.shadows.may_shade` the tile, these are not aside of
    all lines from the cell, nor behind cell or sensor, and their shadows do not end before it.
    ``bounds`` are those of the prisms, and ``reach`` [m] is how far the sensor may have to move.
    """
    marked = bitmask.marks(may_shade(sensor, bounds, tile))
    x, y, radius = tile.cells[:, None]  # (1, K)
    radius = radius + CLOSE
    dx, dy = sensor[0] - x, sensor[1] - y
    squared = jnp.maximum(dx * dx + dy * dy, 1e-9)
    length = jnp.sqrt(squared)
    # From anywhere in the cell to anywhere within reach of the sensor, lines are between the two
    # straight edges that touch both circles: aside of the middle line by so much over their cosine.
    close = length <= radius + reach
    cosine = jnp.sqrt(jnp.maximum(1.0 - (radius + reach) ** 2 / squared, 1e-6))
    # A prism hides the lowest voxel only if it is within so much of the line for each metre of its
    # top above it.
    longest = jnp.sqrt((length + radius) ** 2 + reach * reach)
    drop = jnp.maximum(sensor[2] - tile.low - reach, CLOSE)
    table, shape = _packed(prisms)
    frames = jnp.arange(marked.shape[1])

    def add(found: Array, index: Array, some: Array) -> Array:
        prism = _unpacked(table[:, frames, index][:, :, None], shape)
        ends = (FAR, -FAR, FAR, -FAR, -FAR)
        left, right, first, last, away = (jnp.full_like(dx, k) for k in ends)
        for k in range(len(prism.offset)):
            nx, ny = prism.normal[k, 0], prism.normal[k, 1]
            away = jnp.maximum(away, nx * x + ny * y - prism.offset[k])
            cx, cy = prism.corners[k, 0] - x, prism.corners[k, 1] - y
            share, aside = (cx * dx + cy * dy) / squared, (cx * dy - cy * dx) / length
            wide = radius * jnp.abs(1.0 - share) + reach * jnp.maximum(share, NO_LEVER)
            wide = wide / cosine + CLOSE
            left, right = jnp.minimum(left, aside - wide), jnp.maximum(right, aside + wide)
            first, last = jnp.minimum(first, share), jnp.maximum(last, share)
        meets = (left < 0) & (right > 0) & (last * length > -radius - CLOSE)
        meets &= (first - 1.0) * length < reach + radius
        meets |= close
        share = jnp.maximum((prism.top - tile.low) / drop, 0.0) + NO_LEVER
        share = jnp.where(prism.top > sensor[2] - reach - CLOSE, FAR, share)
        meets &= (away - radius <= share * longest + CLOSE) & some[:, None]
        return bitmask.with_mark(found, index, meets)

    nothing = jnp.zeros((*marked.shape, tile.cells.shape[-1]), jnp.uint32)
    return bitmask.fold_marked(marked, add, nothing)


def _most_first(count: Int[Array, " N"]) -> Int[Array, " N"]:
    """The numbers of the greatest counts first: sorted as one integer each, which is the faster."""
    bits = max(count.size - 1, 1).bit_length()
    key = (jnp.uint32(2 ** (32 - bits) - 1) - count.astype(jnp.uint32)) << bits
    key = jax.lax.sort(key | jnp.arange(count.size, dtype=jnp.uint32), is_stable=False)
    return (key & jnp.uint32(2**bits - 1)).astype(jnp.int32)


class InPlan(NamedTuple):
    """The chance that a line meets a prism in plan, its derivatives by the cut's margins, and the
    cut's ``near`` and ``far``, each with one over it."""

    met: Float[Array, "*n"]
    by_left: Float[Array, "*n"]
    by_right: Float[Array, "*n"]
    by_ahead: Float[Array, "*n"]
    near: tuple[Float[Array, "*n"], Float[Array, "*n"]]
    far: tuple[Float[Array, "*n"], Float[Array, "*n"]]


def _in_plan(cut: SightCut, width: Width) -> InPlan:
    """A line meets a prism ahead if it passes neither to the left nor to the right of it."""
    left, right = cut.left + SEAM, cut.right + SEAM
    sides = jnp.maximum(step(left, width) + step(right, width) - 1.0, 0.0)
    ahead = step(cut.ahead, width)
    return InPlan(
        sides * ahead,
        ahead * slope_of_step(left, width),
        ahead * slope_of_step(right, width),
        sides * slope_of_step(cut.ahead, width),
        *((at, 1.0 / jnp.maximum(at, NO_LEVER)) for at in (cut.near, cut.far)),
    )


class AtLevel(NamedTuple):
    """How much of lines to one level a prism hides where they meet it in plan, and the derivatives
    of that by ``near`` and ``far`` of the cut and by the sensor's height."""

    hidden: Float[Array, "R G"]
    by_near: Float[Array, "R G"]
    by_far: Float[Array, "R G"]
    by_height: Float[Array, "R G"]


def _at_level(
    prism: ConvexPrism,
    plan: InPlan,
    z: Float[Array, "R G"],
    sz: Float[Array, ""],
    width: Width,
    solid: bool,
) -> AtLevel:
    """What a prism hides of lines to heights ``z`` that meet it in plan.

    A line is lowest in the prism where it leaves it if it falls, and where it enters if it rises;
    which of them decides is told by the line that touches the top, so that nothing jumps where the
    sensor passes a voxel's height. At a share τ of the line from the voxel its height is
    z + (sz − z)·τ, and it moves by τ where the sensor moves by 1; by NO_LEVER at least.
    """

    def rises(height: Array, is_near: Array) -> tuple[Array, Array, Array]:
        """The rise for the line to pass ``height`` at τ; its derivatives in τ and sensor height."""
        at, lever = (jnp.where(is_near, *each) for each in zip(plan.near, plan.far, strict=True))
        need = (height - z - (sz - z) * at) * lever
        by_at = jnp.where(at > NO_LEVER, need, 0.0) + sz - z
        return need, -by_at * lever, -at * lever

    top = prism.top + LEVEL
    low_is_near, high_is_near = top > z, prism.bottom < z
    below, by_low, by_height = rises(top, low_is_near)
    hidden, by = step(below, width), slope_of_step(below, width)
    by_low, by_height = by * by_low, by * by_height
    # Multiplied by 0 or 1: what is selected here, XLA computes point by point.
    near = low_is_near.astype(by_low.dtype)
    by_near, by_far = by_low * near, by_low * (1.0 - near)
    if not solid:
        beneath, by_high, by_rise = rises(prism.bottom, high_is_near)
        opaque = step(HALF - prism.clear) if exact(width) else 1.0 - prism.clear
        over, by_over = step(-beneath, width) * opaque, slope_of_step(-beneath, width) * opaque
        by_high = -hidden * by_over * by_high
        by_near = by_near * over + jnp.where(high_is_near, by_high, 0.0)
        by_far = by_far * over + jnp.where(high_is_near, 0.0, by_high)
        by_height = by_height * over - hidden * by_over * by_rise
        hidden *= over
    return AtLevel(hidden, by_near, by_far, by_height)


def _packed(prisms: ConvexPrism) -> tuple[Float[Array, "N F B"], list[tuple[int, ...]]]:
    """All numbers of prisms in one array, to be fetched together, and the shapes of one's own."""
    numbers = prisms._replace(valid=prisms.top)  # of no use here
    lead = prisms.top.shape
    shapes = [leaf.shape[len(lead) :] for leaf in numbers]
    each = zip(numbers, shapes, strict=True)
    # Each is turned by itself: turned together, all would be copied once more.
    flat = [jnp.moveaxis(leaf.reshape(*lead, math.prod(shape)), -1, 0) for leaf, shape in each]
    return jnp.concatenate(flat), shapes


def _unpacked(table: Float[Array, "N R 1"], shapes: list[tuple[int, ...]]) -> ConvexPrism:
    """The prisms of :func:`_packed`, with the table's other axes behind their own."""
    ends = np.cumsum([math.prod(shape) for shape in shapes])[:-1]
    parts = zip(jnp.split(table, ends), shapes, strict=True)
    return ConvexPrism(*(part.reshape(*shape, *table.shape[1:]) for part, shape in parts))
