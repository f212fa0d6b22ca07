"""Tiles of voxels: neighbouring columns together, the levels of a column in one word.

Exact and soft scores take one tile after the other. A tile is small enough that most shadows and
fields of view miss it as a whole, and large enough for efficient array operations.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Num, Shaped, UInt

from inspe_jax.core.arrays import on_device, wide_bucket
from inspe_jax.core.geometry import NEVER, Prism, top_over
from inspe_jax.core.pytree import pytree
from inspe_jax.visibility import bitmask
from inspe_jax.visibility.centered_scene import CenteredScene
from inspe_jax.visibility.motion import Motion

COLUMNS = (96, 320)
"""Columns of a tile: in a small sample, and otherwise."""
CELL = 8
"""Columns of a cell: a tile is read softly cell by cell."""
CHUNKS = 8
"""Most chunks that the tiles are divided into. The number of tiles is a multiple of it."""
WIDE = 512
"""Up to so many tiles three of four may be padding: of more, masks would take gigabytes."""
CLOSE = 1e-2
"""Tests of whole tiles are wider by this [m], which is more than the error of single precision."""
CORE = 30.0
"""Radius of the core of the region of interest [m] (paper, section 3)."""


class Tile(NamedTuple):
    """C neighbouring columns of up to Z voxels. In :class:`Tiles`, N tiles have a leading axis.

    ``columns`` are x and y of the columns, ``heights`` z of the voxels' centres and ``ground`` that
    of the ground [m]. ``there`` is one mask for each column: a bit is 1 where the voxel exists. All
    columns are within ``radius`` of ``center``, and all centres of voxels are between the heights
    ``low`` and ``high`` [m]. A cell is C/K columns one after another; ``cells`` has the x and y of
    the middle of each, and the radius within which its columns are [m]. ``motion`` is how road
    users move at each column, None where that is not known.
    """

    columns: Float[Array, "*N 2 C"]
    heights: Float[Array, "*N Z C"]
    ground: Float[Array, "*N C"]
    there: UInt[Array, "*N C"]
    center: Float[Array, "*N 2"]
    radius: Float[Array, "*N"]
    low: Float[Array, "*N"]
    high: Float[Array, "*N"]
    cells: Float[Array, "*N 3 K"]
    motion: Motion | None = None

    @property
    def core(self) -> Bool[Array, "*N C"]:
        """Which columns are in the core: within :data:`CORE` of the scene's centre."""
        return jnp.hypot(self.columns[..., 0, :], self.columns[..., 1, :]) <= CORE


@pytree
@dataclass(frozen=True)
class Tiles:
    """All voxels in N tiles of up to C columns and as many levels as a word has bits.

    Where there are more levels, the columns are cut into slabs of levels. The tiles of the lowest
    slab come first. ``place`` is the number of each of the scene's columns among the columns of a
    slab's tiles; None where it is not needed. ``gaps``: voxels inside static bodies are not there.
    """

    tile: Tile
    place: Int[Array | np.ndarray, " L"] | None
    level_count: int = field(metadata={"static": True})
    gaps: bool = field(metadata={"static": True}, default=False)

    @property
    def slabs(self) -> int:
        """The number of slabs of levels that the columns are cut into."""
        return -(-self.level_count // bitmask.WORD)

    @property
    def last(self) -> Bool[np.ndarray, " N"]:
        """Whether no slab of levels is above each tile."""
        number = len(self.tile.there)
        return np.arange(number) >= number - number // self.slabs

    @property
    def column_levels(self) -> int | Num[Array, " MC"]:
        """How many levels columns have; of each, 1 at least, where bodies stand in some."""
        if not self.gaps:
            return self.level_count
        there = bitmask.count(self.tile.there).reshape(self.slabs, -1).sum(0)
        return jnp.maximum(there, 1).astype(float)

    def column_shares(self, found: Float[Array, "R MC"]) -> Float[Array, "R MC"]:
        """Numbers of each column's voxels as shares of those that it has."""
        if not self.gaps:
            return found / self.level_count
        return found / self.column_levels[None]  # type: ignore[index]  # it is an array

    def by_voxel(self, words: UInt[np.ndarray, "... N C"]) -> Bool[np.ndarray, "... V"]:
        """Masks of the tiles' columns as flags in the scene's order of voxels."""
        height = self.tile.heights.shape[-2]
        return self.of_voxels(bitmask.unpack(np.asarray(words)[..., None], height))

    def of_voxels(self, values: Shaped[np.ndarray, "... N C Z"]) -> Shaped[np.ndarray, "... V"]:
        """Values for each level of the tiles' columns, in the scene's order of voxels."""
        assert self.place is not None
        lead, height = values.shape[:-3], values.shape[-1]
        values = values.reshape(*lead, self.slabs, -1, height)[..., np.asarray(self.place), :]
        values = values.swapaxes(-3, -2).reshape(*lead, len(self.place), -1)  # (…, L, slabs·Z)
        return values[..., : self.level_count].reshape(*lead, -1)


def tiles_of(scene: CenteredScene, cell: int = CELL) -> Tiles:
    """The columns in tiles of nearly equal size, by halving along the longer side.

    Tiles end in padding, which repeats a column; some are padding only, for arrays of one shape.
    """
    columns, heights = np.asarray(scene.columns), np.asarray(scene.heights)
    few = -(-len(columns) // CHUNKS)
    size = next((size for size in COLUMNS if size >= few), COLUMNS[-1])
    parts = _halved(columns, np.arange(len(columns)), -(-len(columns) // size))
    number = wide_bucket(len(parts), CHUNKS, WIDE)
    index, real = np.zeros((number, size), int), np.zeros((number, size), bool)
    for t, part in enumerate(parts):
        part = _by_cell(columns, part)
        index[t], real[t, : len(part)] = part[-1], True
        index[t, : len(part)] = part
    place = np.empty(len(columns), int)
    place[index[real]] = np.flatnonzero(real)

    slab, exists = _slabs(heights.shape[1])
    slabs = len(slab)
    xy = columns[index].swapaxes(1, 2)  # (N, 2, C)
    z = heights[index][:, :, slab].transpose(2, 0, 3, 1)  # (slabs, N, Z, C)
    there = exists[:, None, None] & real[None, :, :, None]  # (slabs, N, C, Z)
    if scene.inside is not None:
        there = there & ~np.asarray(scene.inside)[index][:, :, slab].transpose(2, 0, 1, 3)
    there = bitmask.pack(there)[..., 0]  # (slabs, N, C)
    middle, away = _circles(xy)
    in_cells = xy.reshape(number, 2, -1, cell)
    cells = np.concatenate([x.reshape(number, -1, size // cell) for x in _circles(in_cells)], 1)

    def stacked(x: np.ndarray) -> Array:
        return on_device(x.reshape(slabs * number, *x.shape[2:]))

    def repeated(x: np.ndarray) -> Array:
        return stacked(np.broadcast_to(x, (slabs, *x.shape)))

    tile = Tile(
        columns=repeated(xy),
        heights=stacked(z),
        ground=repeated(np.asarray(scene.ground)[index]),
        there=stacked(there),
        center=repeated(middle),
        radius=repeated(away),
        low=stacked(z.min((2, 3))),
        high=stacked(z.max((2, 3))),
        cells=repeated(cells),
        motion=jax.tree.map(
            lambda of: repeated(np.moveaxis(np.asarray(of)[..., index], -2, 0)), scene.motion
        ),
    )
    return Tiles(tile, place, heights.shape[1], scene.inside is not None)


def _halved(
    columns: Float[np.ndarray, "L 2"], index: Int[np.ndarray, " l"], number: int
) -> list[Int[np.ndarray, " c"]]:
    """The numbers of the columns in ``number`` parts, whose sizes differ by at most one."""
    if number == 1:
        return [index]
    few = number // 2
    index, middle = _along_the_longer_side(columns, index), len(index) * few // number
    return _halved(columns, index[:middle], few) + _halved(columns, index[middle:], number - few)


def _by_cell(
    columns: Float[np.ndarray, "L 2"], index: Int[np.ndarray, " l"]
) -> Int[np.ndarray, " l"]:
    """The numbers of a tile's columns in cells of :data:`CELL` neighbours, the last with fewer."""
    if len(index) <= CELL:
        return index
    index = _along_the_longer_side(columns, index)
    middle = -(-len(index) // (2 * CELL)) * CELL
    return np.concatenate([_by_cell(columns, index[:middle]), _by_cell(columns, index[middle:])])


def _along_the_longer_side(
    columns: Float[np.ndarray, "L 2"], index: Int[np.ndarray, " l"]
) -> Int[np.ndarray, " l"]:
    """The numbers of columns in their order along the longer side of the box about them."""
    xy = columns[index]
    along = xy[:, (xy.max(0) - xy.min(0)).argmax()]
    return index[along.argsort(kind="stable")]


def _circles(
    xy: Float[np.ndarray, "*N C"],
) -> tuple[Float[np.ndarray, "*N"], Float[np.ndarray, "*M"]]:
    """The middle of N × 2 × … sets of columns, and the N × … radii about it in which they are."""
    middle = (xy.min(-1) + xy.max(-1)) / 2
    away = xy - middle[..., None]
    return middle, np.hypot(away[:, 0], away[:, 1]).max(-1)


def _slabs(levels: int) -> tuple[Int[np.ndarray, "slabs Z"], Bool[np.ndarray, "slabs Z"]]:
    """The levels of each slab, and which of them exist: the last slab may end in padding."""
    slabs = -(-levels // bitmask.WORD)
    index = np.arange(slabs * -(-levels // slabs)).reshape(slabs, -1)
    return np.minimum(index, levels - 1), index < levels


@jax.jit
def solid(tile: Tile, prisms: Prism) -> UInt[Array, "N T C"]:
    """Masks of the voxels of N tiles that are inside a vehicle, in each of T frames."""
    return jax.lax.map(unless_empty(lambda tile: solid_in(tile, prisms)), tile)


def unless_empty(work: Callable[..., Any]) -> Callable[..., Any]:
    """``work(tile, …)``; for a tile of padding only, zeros without any work."""

    def skipping(tile: Tile, *given: Any) -> Any:
        skip = partial(zeros_of, work)
        return jax.lax.cond((tile.there != 0).any(), work, skip, tile, *given)

    return skipping


def zeros_of(work: Callable[..., Any], *given: Any) -> Any:
    """Zeros of the shapes and types that ``work(*given)`` returns."""
    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(work, *given))


def solid_in(tile: Tile, prisms: Prism) -> UInt[Array, "T C"]:
    """Masks of the voxels of one tile that are inside a vehicle, in each of T frames."""
    frames = jnp.arange(len(prisms.top))
    span = jnp.hypot(prisms.half[..., 0], prisms.half[..., 1])  # (T, B)
    x, y = prisms.center[..., 0] - tile.center[0], prisms.center[..., 1] - tile.center[1]
    near = jnp.hypot(x, y) < span + tile.radius + CLOSE
    near &= prisms.valid & (prisms.top > tile.low)

    def raise_top(top: Array, index: Array, some: Array) -> Array:
        prism = jax.tree.map(lambda leaf: leaf[frames, index][:, None], prisms)
        prism = prism._replace(valid=prism.valid & some[:, None])
        return jnp.maximum(top, top_over(prism, *tile.columns[:, None]))

    start = jnp.full((len(frames), tile.columns.shape[1]), NEVER, tile.columns.dtype)
    top = bitmask.fold_marked(bitmask.marks(near.T), raise_top, start)
    return pack_levels(tile.heights[:, None] < top[None], tile.there.dtype) & tile.there[None]


def pack_levels(flags: Bool[Array, "Z ..."], kind: jnp.dtype) -> UInt[Array, "..."]:
    """Flags for each of Z levels as masks of type ``kind``."""
    each = (jnp.where(flags[z], kind.type(1 << z), kind.type(0)) for z in range(len(flags)))
    return sum(each, jnp.zeros(flags.shape[1:], kind))
