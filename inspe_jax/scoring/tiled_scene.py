"""A scene as scores go through it: tiles of columns, runs of frames, masks of solid voxels.

Made once for a scene or a sample of one, the same for every layout.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt

from inspe_jax.core import sharding
from inspe_jax.core.arrays import on_device, wide_bucket
from inspe_jax.core.geometry import Prism
from inspe_jax.core.parallel import cores, untraced
from inspe_jax.scene.scene import Scene
from inspe_jax.visibility import bitmask
from inspe_jax.visibility.centered_scene import CenteredScene, about_center
from inspe_jax.visibility.tiles import SHARES, Tile, Tiles, one_tile, solid, tiles_of

FRAMES = 128
"""Frames that are gone through together: what a tile needs of them stays in a core's cache."""

UNSURE = 4096
"""Voxels that may have entropy that there is room for, at least, and that are gone through
together."""
MANY = 2**18
"""Such voxels up to which three of four may be padding: gradients have numbers for each."""


class SceneArrays(NamedTuple):
    """What is scored: the scene's arrays, or a sample of them.

    ``weight`` (V,) of the voxels' regions; ``occupancy`` (V,) is p̂, or None to take it from the
    frames of ``ground``.
    """

    ground: CenteredScene
    weight: Float[Array, " V"]
    occupancy: Float[Array, " V"] | None = None


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class WorkChunk:
    """Some of the tiles and some of the frames: what one core goes through.

    ``prisms`` (F, B); ``solid`` (n, F, C) are masks of the voxels inside a vehicle, None in a bare
    world. The tiles are every ``step``-th from the ``first``, the frames those from ``begin``.
    Where it is ``split``, every device has some of the frames.
    """

    tile: Tile
    prisms: Prism
    solid: UInt[Array, "n F C"] | None
    first: int = field(metadata={"static": True}, default=0)
    step: int = field(metadata={"static": True}, default=1)
    begin: int = field(metadata={"static": True}, default=0)
    split: bool = field(metadata={"static": True}, default=False)

    @property
    def tiles(self) -> slice:
        """The share's tiles among all."""
        return slice(self.first, None, self.step)

    @property
    def frames(self) -> slice:
        """The share's frames among all."""
        return slice(self.begin, self.begin + len(self.prisms.top))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TiledScene:
    """What scores need of a scene, or of a sample of one, the same for every layout.

    ``weight`` (M·C,) is the weight of the tiles' columns, 0 for padding. ``occupancy`` (U,) is p̂
    of the voxels that may have entropy, and 0 in the end, to fill it up; ``column`` and ``level``
    (U,) say which they are: column among the tiles' columns, level in the slab. ``split`` are the
    tiles as they are :func:`dealt` to the devices; None where there is one device.
    """

    tiles: Tiles
    chunks: tuple[WorkChunk, ...]
    weight: Float[Array, " MC"]
    occupancy: Float[Array, " U"]
    column: Int[Array, " U"]
    level: Int[Array, " U"]
    frame_count: int = field(metadata={"static": True})
    split: Tile | None = None

    @property
    def voxel_occupancy(self) -> Float[np.ndarray, " V"]:
        """p̂ of the voxels as the scene has them; 0 where it is 1, which has no entropy either."""
        there = self.tiles.tile.there
        found = np.zeros((there.size, self.tiles.tile.heights.shape[-2]))
        share = np.asarray(self.occupancy, float)
        unsure = share > 0  # the others fill it up
        column, level = (np.asarray(at)[unsure] for at in (self.column, self.level))
        found[column, level] = share[unsure]
        return self.tiles.of_voxels(found.reshape(*there.shape, -1))

    @property
    def bucketed(self) -> "TiledScene":
        """The world without what has a length of its own in every scene: what is compiled for it
        serves others too."""
        return replace(self, tiles=replace(self.tiles, place=None), split=None)


_worlds: "WeakKeyDictionary[Scene, dict[tuple[str, jnp.dtype], TiledScene]]" = WeakKeyDictionary()


def tiled_scene_of(scene: Scene) -> TiledScene:
    """A scene's :class:`TiledScene`, made when it is first asked for and kept as long as the scene.

    One for each precision that JAX is set to.
    """
    return _kept(scene, "shared out", _make_world)


def whole_tiled_scene_of(scene: Scene) -> TiledScene:
    """A scene's :class:`TiledScene` with all tiles in every share: for one core, or one device."""
    return _kept(scene, "whole", _make_whole)


def bare_tiled_scene_of(scene: Scene) -> TiledScene:
    """The same without the masks of solid voxels, for soft scores: as constants of what is
    compiled for a gradient they would be there several times over."""
    return _kept(scene, "bare", lambda scene: _make_whole(scene, bare=True))


def _kept(scene: Scene, kind: str, make: Callable[[Scene], TiledScene]) -> TiledScene:
    kept = _worlds.setdefault(scene, {})
    key = kind, jnp.zeros((), float).dtype
    if key not in kept:
        kept[key] = untraced(lambda: make(scene))
    return kept[key]


def _make_whole(scene: Scene, bare: bool = False) -> TiledScene:
    world, prisms = tiled_scene_of(scene), about_center(scene).prisms
    chunks, tile = [], world.tiles.tile
    for begin in range(0, world.frame_count, FRAMES):
        part = _some(prisms, slice(begin, begin + FRAMES))
        chunks.append(WorkChunk(tile, part, None if bare else solid(tile, part), begin=begin))
    return replace(world, chunks=tuple(chunks), split=None)


def _some(arrays: Any, rows: slice | Int[np.ndarray, " N"]) -> Any:
    """Some rows of arrays: taken in NumPy, which has nothing to compile for another shape."""
    return jax.tree.map(lambda leaf: on_device(np.asarray(leaf)[rows]), arrays)


def _make_world(scene: Scene) -> TiledScene:
    ground = about_center(scene)
    tiles = tiles_of(ground)
    total = len(ground.prisms.top)
    chunks, counts = [], np.zeros((*tiles.tile.there.shape, tiles.tile.heights.shape[1]), int)
    everywhere = sharding.put(tiles.tile, None) if sharding.devices() > 1 else tiles.tile
    for begin, end, split in _runs(total):
        prisms = _some(ground.prisms, slice(begin, end))
        inside = solid(tiles.tile, prisms)
        counts += np.asarray(by_level(inside, counts.shape[-1]))
        if split:
            parts = sharding.put(prisms, 0), sharding.put(inside, 1)
            chunks.append(WorkChunk(everywhere, *parts, begin=begin, split=True))
            continue
        step = min(cores(), SHARES)
        for first in range(step):
            tile, own = _some((tiles.tile, inside), slice(first, None, step))
            chunks.append(WorkChunk(tile, prisms, own, first, step, begin))
    counts = counts.reshape(-1, counts.shape[-1])
    column, level = np.nonzero((counts > 0) & (counts < total))
    spare = wide_bucket(len(column), UNSURE, MANY) - len(column)
    occupancy = np.pad(counts[column, level] / total, (0, spare))
    column, level = np.pad(column, (0, spare)), np.pad(level, (0, spare))
    return TiledScene(
        tiles,
        tuple(chunks),
        _column_weight(tiles, scene.voxels.column_weight),
        on_device(occupancy, float),
        on_device(column),
        on_device(level),
        total,
        _split(tiles.tile) if sharding.divides(len(tiles.tile.there)) else None,
    )


def _split(tile: Tile) -> Tile:
    return sharding.put(_some(tile, dealt(len(tile.there))), 0)


def dealt(tiles: int) -> Int[np.ndarray, " N"]:
    """Tiles by their numbers, those of one device after those of another: dealt out one by one, so
    that the padding at the end is shared too."""
    return np.arange(tiles).reshape(-1, sharding.devices()).T.ravel()


def _runs(total: int) -> list[tuple[int, int, bool]]:
    """(from, to, whether it is split among the devices) of each run of frames.

    A device goes through at most :data:`FRAMES` together. The last few, where the number of
    devices does not divide them, are for one device.
    """
    number, runs = sharding.devices(), []
    whole = total // number * number if number > 1 else 0
    for begin, end, each in ((0, whole, number), (whole, total, 1)):
        if begin < end:
            parts = -(-(end - begin) // (FRAMES * each))
            at = np.linspace(begin // each, end // each, parts + 1).round().astype(int) * each
            runs += [(*ends, each > 1) for ends in pairwise(at.tolist())]
    return runs


def tiled_sample(sample: SceneArrays) -> TiledScene:
    """The :class:`TiledScene` of some columns and frames, in one share.

    Samples of one size make worlds of one shape.
    """
    tiles = tiles_of(sample.ground)
    weight = np.asarray(sample.weight[:: tiles.level_count])
    return _in_one_share(sample, tiles, _column_weight(tiles, weight))


def sample_in_one_tile(sample: SceneArrays) -> TiledScene:
    """The same in one tile, traced or not, and bare."""
    tiles = one_tile(sample.ground)
    return _in_one_share(sample, tiles, sample.weight[:: tiles.level_count], bare=True)


def _in_one_share(
    sample: SceneArrays, tiles: Tiles, weight: Float[Array, " MC"], bare: bool = False
) -> TiledScene:
    assert sample.occupancy is not None  # that of all frames
    ground = sample.ground
    levels, height = tiles.level_count, tiles.tile.heights.shape[1]
    inside = None if bare else solid(tiles.tile, ground.prisms)
    chunk = WorkChunk(tiles.tile, ground.prisms, inside)
    assert tiles.place is not None  # they are just made
    columns = len(tiles.tile.there) // tiles.slabs * tiles.tile.there.shape[1]
    level = np.arange(levels)
    column = np.asarray(tiles.place)[:, None] + level // height * columns  # (L, Z)
    return TiledScene(
        tiles,
        (chunk,),
        weight,
        sample.occupancy,
        on_device(column.reshape(-1)),
        on_device(np.tile(level % height, len(column))),
        len(ground.prisms.top),
    )


def _column_weight(tiles: Tiles, weight: Float[np.ndarray, " L"]) -> Float[Array, " MC"]:
    found = np.zeros(tiles.tile.there.size // tiles.slabs)
    found[np.asarray(tiles.place)] = weight
    return on_device(found, float)


@partial(jax.jit, static_argnames="levels")
def by_level(words: UInt[Array, "N F C"], levels: int) -> Int[Array, "N C Z"]:
    """In how many frames each level's bit is set."""
    return jax.lax.map(lambda tile: bitmask.count_levels(tile, levels), words)
