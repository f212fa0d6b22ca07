"""A scene as scores need it: tiles of columns, runs of frames, masks of solid voxels.

It is made once for a scene, or for a sample of one, and serves every layout.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import jax
import numpy as np
from jaxtyping import Array, Float, Int, UInt

from inspe_jax.core.arrays import on_device, wide_bucket
from inspe_jax.core.geometry import Prism
from inspe_jax.core.parallel import cores, untraced
from inspe_jax.core.pytree import pytree
from inspe_jax.scene.scene import Scene
from inspe_jax.visibility import bitmask
from inspe_jax.visibility.centered_scene import CenteredScene, Statics, about_center
from inspe_jax.visibility.tiles import CELL, CHUNKS, Tile, Tiles, solid, tiles_of

FRAMES = 128
"""Frames in one chunk: what a tile needs of so many stays in a core's cache."""

ENTROPIC = 4096
"""Least length of the arrays of voxels that may have entropy, and the length of parts of sums."""
MANY_ENTROPIC = 2**18
"""Up to this length three of four such voxels may be padding; a gradient keeps all entries."""


class SceneArrays(NamedTuple):
    """The arrays of a scene, or of a sample of its columns and frames.

    ``weight`` (V,) is the weight of each voxel's region. ``occupancy`` (V,) is p̂, the share of
    frames in which a voxel is occupied; None means the share in the frames of ``centered``.
    """

    centered: CenteredScene
    weight: Float[Array, " V"]
    occupancy: Float[Array, " V"] | None = None


@pytree
@dataclass(frozen=True)
class WorkChunk:
    """Some of the tiles in some of the frames: the work of one core.

    ``prisms`` (F, B) are the road users of the frames, ``solid`` masks of the voxels inside a
    vehicle, None in a scene without masks. The tiles are every ``step``-th one from ``first`` on;
    the frames start at ``begin``.
    """

    tile: Tile
    prisms: Prism
    solid: UInt[Array, "n F C"] | None
    first: int = field(metadata={"static": True}, default=0)
    step: int = field(metadata={"static": True}, default=1)
    begin: int = field(metadata={"static": True}, default=0)

    @property
    def tiles(self) -> slice:
        """Which of all tiles are in the chunk."""
        return slice(self.first, None, self.step)

    @property
    def frames(self) -> slice:
        """Which of all frames are in the chunk."""
        return slice(self.begin, self.begin + len(self.prisms.top))


@pytree
@dataclass(frozen=True)
class TiledScene:
    """What scores need of a scene or of a sample of one. It is the same for every layout.

    ``weight`` is the region weight of the columns of the M tiles of a slab, 0 for padding; of a
    column with voxels inside a body it is the share that the others are of it. ``occupancy`` is p̂
    of the voxels that may have entropy, padded with 0 at the end. ``column`` and ``level`` say
    which these are: the column's number among the tiles' columns, and the level in its slab; they
    are empty if ``occupancy`` (N, Z, C) is of all voxels of the tiles.
    ``statics`` are the bodies and the ground; None where there are none.
    """

    tiles: Tiles
    chunks: tuple[WorkChunk, ...]
    weight: Float[Array, " MC"]
    occupancy: Float[Array, "*U"]
    column: Int[Array, " U"]
    level: Int[Array, " U"]
    frame_count: int = field(metadata={"static": True})
    statics: Statics | None = None

    @property
    def voxel_occupancy(self) -> Float[np.ndarray, " V"]:
        """p̂ in the scene's order of voxels. It is 0 also where p̂ = 1: neither has entropy."""
        return self.tiles.of_voxels(self.tile_occupancy)

    @property
    def tile_occupancy(self) -> Float[np.ndarray, "N C Z"]:
        """The same of the tiles' voxels."""
        there = self.tiles.tile.there
        found = np.zeros((there.size, self.tiles.tile.heights.shape[-2]))
        share = np.asarray(self.occupancy, float)
        real = share > 0  # the others are padding
        column, level = (np.asarray(at)[real] for at in (self.column, self.level))
        found[column, level] = share[real]
        return found.reshape(*there.shape, -1)

    @property
    def bucketed(self) -> "TiledScene":
        """This without the arrays that have another length in every scene.

        So a program compiled for one scene serves other scenes of similar size.
        """
        return replace(self, tiles=replace(self.tiles, place=None))

    @cached_property
    def apart(self) -> "list[tuple[Int[np.ndarray, ' n'], TiledScene]]":
        """The tiles with some column, each with those above it: their numbers, and they alone
        without what :func:`~inspe_jax.scoring.driver.summarise` needs."""
        numbers = np.arange(len(self.tiles.tile.there)).reshape(self.tiles.slabs, -1).T
        whole = jax.tree.map(np.asarray, self.tiles.tile)
        rows = [at for at in numbers if whole.there[at].any()]

        def parts() -> list[TiledScene]:
            none = on_device(np.zeros(0), float)
            rest = replace(self.bucketed, weight=none, occupancy=none, column=none, level=none)
            found = []
            for tile in (_rows(whole, at) for at in rows):
                chunks = tuple(replace(chunk, tile=tile) for chunk in rest.chunks)
                found.append(replace(rest, tiles=replace(rest.tiles, tile=tile), chunks=chunks))
            return found

        return list(zip(rows, untraced(parts), strict=True))


_kept_scenes: "WeakKeyDictionary[Scene, dict[tuple, TiledScene]]" = WeakKeyDictionary()


def tiled_scene_of(scene: Scene, *, whole: bool = False, masks: bool = True) -> TiledScene:
    """A scene's :class:`TiledScene`, its tiles and frames divided into chunks for all cores.

    ``whole``: all tiles are in every chunk, for one core or one device. ``masks``: a whole one has
    the masks of solid voxels. Soft scores do without: a compiled gradient would hold several copies
    of them as constants. It is kept as long as the scene, one for each precision of JAX.
    """
    kept = _kept_scenes.setdefault(scene, {})
    key = whole, masks, jax.dtypes.canonicalize_dtype(float)
    if key not in kept:
        kept[key] = untraced(lambda: _tile_whole(scene, masks) if whole else _tile_scene(scene))
    return kept[key]


def _tile_whole(scene: Scene, masks: bool) -> TiledScene:
    tiled, prisms = tiled_scene_of(scene), about_center(scene).prisms
    chunks, tile = [], tiled.tiles.tile
    for begin in range(0, tiled.frame_count, FRAMES):
        part = _rows(prisms, slice(begin, begin + FRAMES))
        chunks.append(WorkChunk(tile, part, solid(tile, part) if masks else None, begin=begin))
    return replace(tiled, chunks=tuple(chunks))


def _rows(arrays: Any, rows: slice | Int[np.ndarray, " N"]) -> Any:
    """Some rows of arrays. NumPy takes them: JAX would compile a program for every shape."""
    return jax.tree.map(lambda leaf: on_device(np.asarray(leaf)[rows]), arrays)


def _tile_scene(scene: Scene) -> TiledScene:
    centered = about_center(scene)
    tiles = tiles_of(centered)
    total = len(centered.prisms.top)
    chunks, counts = [], np.zeros((*tiles.tile.there.shape, tiles.tile.heights.shape[1]), int)
    ends = np.linspace(0, total, -(-total // FRAMES) + 1).round().astype(int)
    for begin, end in pairwise(ends.tolist()):
        prisms = _rows(centered.prisms, slice(begin, end))
        inside = solid(tiles.tile, prisms)
        counts += np.asarray(by_level(inside, counts.shape[-1]))
        step = min(cores(), CHUNKS)
        for first in range(step):
            tile, own = _rows((tiles.tile, inside), slice(first, None, step))
            chunks.append(WorkChunk(tile, prisms, own, first, step, begin))
    counts = counts.reshape(-1, counts.shape[-1])
    column, level = np.nonzero((counts > 0) & (counts < total))
    spare = wide_bucket(len(column), ENTROPIC, MANY_ENTROPIC) - len(column)
    occupancy = np.pad(counts[column, level] / total, (0, spare))
    column, level = np.pad(column, (0, spare)), np.pad(level, (0, spare))
    weight, inside = scene.voxels.column_weight, scene.inside_statics
    if inside is not None:
        weight = weight * (1.0 - inside.mean(1))
    return TiledScene(
        tiles,
        tuple(chunks),
        _column_weight(tiles, weight),
        on_device(occupancy, float),
        on_device(column),
        on_device(level),
        total,
        centered.statics,
    )


def tiled_sample(sample: SceneArrays, masks: bool = True) -> TiledScene:
    """The :class:`TiledScene` of some columns and frames, in one chunk.

    Samples of one size give tiled scenes of one shape. ``masks`` as in :func:`tiled_scene_of`;
    without them, it is for soft scores, and every column is a cell: they are far apart.
    """
    assert sample.occupancy is not None  # p̂ over all frames, not over the sample's
    tiles = tiles_of(sample.centered, CELL if masks else 1)
    prisms, levels = sample.centered.prisms, tiles.level_count
    if sample.centered.inside is None:
        weight = np.asarray(sample.weight)[::levels]
    else:  # voxels inside a body have no weight
        weight = np.asarray(sample.weight).reshape(-1, levels).mean(1)
    height = tiles.tile.heights.shape[1]
    columns = len(tiles.tile.there) // tiles.slabs * tiles.tile.there.shape[1]
    level = np.arange(levels)
    column = np.asarray(tiles.place)[:, None] + level // height * columns  # (L, Z)
    return TiledScene(
        tiles,
        (WorkChunk(tiles.tile, prisms, solid(tiles.tile, prisms) if masks else None),),
        _column_weight(tiles, weight),
        sample.occupancy,
        on_device(column.reshape(-1)),
        on_device(np.tile(level % height, len(column))),
        len(prisms.top),
        statics=sample.centered.statics,
    )


def _column_weight(tiles: Tiles, weight: Float[np.ndarray, " L"]) -> Float[Array, " MC"]:
    """The columns' weights in the tiles' order, 0 for padding."""
    found = np.zeros(tiles.tile.there.size // tiles.slabs)
    found[np.asarray(tiles.place)] = weight
    return on_device(found, float)


@partial(jax.jit, static_argnames="levels")
def by_level(words: UInt[Array, "N F C"], levels: int) -> Int[Array, "N C Z"]:
    """In how many frames each level's bit is set."""
    return jax.lax.map(lambda tile: bitmask.count_levels(tile, levels), words)
