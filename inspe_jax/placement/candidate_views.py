"""What one sensor has in view, and sees in each frame, from many poses.

Searches choose among candidate poses by it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt

from inspe_jax.core.arrays import on_host
from inspe_jax.core.parallel import Job, parts_of
from inspe_jax.scoring.accumulate import seen_by_sensor
from inspe_jax.scoring.detection import detection_curves
from inspe_jax.scoring.options import ScoreOptions
from inspe_jax.scoring.reading import BITS, Frames
from inspe_jax.scoring.target_evidence import target_evidence_of_sensor
from inspe_jax.scoring.tiled_scene import TiledScene, WorkChunk
from inspe_jax.sensing.rays import Rays
from inspe_jax.sensing.sensors import RayGrid
from inspe_jax.visibility import bitmask
from inspe_jax.visibility.centered_scene import Statics
from inspe_jax.visibility.statics import past_statics_masks
from inspe_jax.visibility.tiles import Tile, Tiles
from inspe_jax.visibility.view_masks import view_masks

FOUND = "detectability"
"""The metric whose chances are found with the views."""
TOGETHER = 8
"""Poses in one compiled call. With one shape for any number of poses, results are the same bits."""


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class Rows:
    """What one sensor has of a sample: a row, or a row for each of K poses.

    ``bits`` (K, 1 + T, V) are f of each voxel, then f and line of sight in each frame. ``chance``
    (K, Q, L) is that to find a road user of each of Q classes at each column; Q is 0 where it is
    not asked for.
    """

    bits: Bool[np.ndarray, "*k F V"]
    chance: Float[np.ndarray, "*k Q L"]

    @classmethod
    def joined(cls, parts: Sequence["Rows"], axis: int = 0) -> "Rows":
        """The rows of all parts: of further poses or, along axis −1, of further scenes."""
        if len(parts) == 1:
            return parts[0]
        bits, chance = [part.bits for part in parts], [part.chance for part in parts]
        return cls(np.concatenate(bits, axis), np.concatenate(chance, axis))

    def __getitem__(self, at: Any) -> "Rows":
        return Rows(self.bits[at], self.chance[at])

    def __len__(self) -> int:
        return len(self.bits)


def view_jobs(
    grid: RayGrid,
    half: float,
    poses: Float[Array | np.ndarray, "K 6"],
    tiled: TiledScene,
    asked: ScoreOptions,
    pixels: float = 1.0,
) -> list[Job]:
    """Jobs for what one sensor has in view, and sees in each frame, from each of K poses.

    Each gives the rows of :data:`TOGETHER` poses; after the last pose, it is repeated.
    ``poses`` are about the scene's centre, ``half`` is half a voxel's edge [m], and ``tiled`` is a
    scene in one chunk. ``pixels`` is the number of pixels that a ray stands for. The chances to
    find road users are of a sensor alone, as in detectability, if ``asked`` has that metric.
    """
    (chunk,) = tiled.chunks
    assert chunk.solid is not None  # the scene has masks
    rays = grid.rays
    lengths = rays.table.rows.shape + rays.table.nearest.shape
    found = tuple(metric for metric in asked.metrics if metric.name == FOUND)
    # Other metrics do not change what is seen: without them fewer programs are compiled.
    asked = asked._replace(metrics=found, detection=asked.detection if found else None)
    shapes = chunk.solid.shape, chunk.prisms.top.shape, tiled.statics and tiled.statics.shapes
    key = (_view, grid.kind, lengths, *shapes, asked)
    fixed = dict(chunk=chunk, statics=tiled.statics, last=tiled.tiles.last, asked=asked)
    given = partial(_view, rays, half, pixels, **fixed)

    def rows(part: np.ndarray) -> Rows:
        return _by_voxel(tiled.tiles, *given(part))

    return [(key, partial(rows, part)) for part in parts_of(on_host(poses, float), TOGETHER)]


def _by_voxel(tiles: Tiles, view: Array, seen: Array, chance: Array) -> Rows:
    """What :func:`_view` returns, in the scene's order of voxels and of columns."""
    count, number, classes, columns = chance.shape
    found = np.asarray(chance).reshape(count, tiles.slabs, number // tiles.slabs, classes, columns)
    found = found.sum(1).swapaxes(1, 2).reshape(count, classes, number // tiles.slabs * columns)
    found = found[..., np.asarray(tiles.place)].astype(np.float32)
    bits = [tiles.by_voxel(np.asarray(view))[:, None], tiles.by_voxel(np.asarray(seen))]
    return Rows(np.concatenate(bits, 1), found)


@partial(jax.jit, static_argnames="asked")
def _view(
    rays: Rays,
    half: Float[Array, ""],
    pixels: Float[Array, ""],
    poses: Float[Array, "K 6"],
    *,
    chunk: WorkChunk,
    statics: Statics | None,
    last: Bool[Array, " N"],
    asked: ScoreOptions,
) -> tuple[UInt[Array, "K N C"], UInt[Array, "K T N C"], Float[Array, "K N Q C"]]:
    """Views, what is seen in frames, and chances of Q classes; Q is 0 unless they are asked for."""
    curves = asked.detection or detection_curves()

    def view_from(pose: Array) -> tuple[Array, Array, Array]:
        views = view_masks(rays, pose, chunk.tile, half)
        past = ~jnp.zeros_like(views)
        if statics is not None:
            past = past_statics_masks(pose[:3], statics, chunk.tile, views)
            views &= past
        shadows = jax.tree.map(lambda leaf: leaf[0], BITS.shadows(pose[None, :3], chunk.prisms))

        def see_tile(part: tuple[Tile, Array, Array, Array, Array]) -> tuple[Array, Array]:
            tile, view, past, solid, last = part
            row, frames = (pose[:3], shadows, view), Frames(chunk.prisms, solid)
            seen, in_sight = seen_by_sensor(BITS, row, tile, frames, asked)
            if not asked.metrics:
                return seen, jnp.zeros((0, len(view)), tile.heights.dtype)
            number = BITS.level_sums(in_sight, len(tile.heights)).T
            sight = number.astype(tile.heights.dtype) / len(chunk.prisms.top)
            if statics is not None:
                sight *= bitmask.chances(past, len(tile.heights)).astype(sight.dtype)
            at = rays, pixels, pose, tile, sight, last, None, curves
            return seen, target_evidence_of_sensor(*at).chance

        def see_nothing(part: tuple[Tile, Array, Array, Array, Array]) -> tuple[Array, Array]:
            return jax.tree.map(
                lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(see_tile, part)
            )

        seen, chance = jax.lax.map(
            lambda part: jax.lax.cond((part[1] != 0).any(), see_tile, see_nothing, part),
            (chunk.tile, views, past, chunk.solid, last),
        )
        return views, seen.swapaxes(0, 1), chance

    return jax.lax.map(view_from, poses)
