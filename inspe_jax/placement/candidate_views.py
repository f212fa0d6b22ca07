"""What one sensor has in view, and sees in each frame, from many poses.

Searches choose among candidate poses by it.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt

from inspe_jax.core.convex import ConvexPrism
from inspe_jax.core.parallel import Job, parts_of, run
from inspe_jax.scoring.accumulate import seen_by_sensor
from inspe_jax.scoring.asked import Asked
from inspe_jax.scoring.exact import BITS
from inspe_jax.scoring.reading import Frames
from inspe_jax.scoring.tiled_scene import TiledScene, WorkChunk
from inspe_jax.sensing.rays import Rays
from inspe_jax.sensing.sensors import RayGrid
from inspe_jax.visibility.statics import past_statics_masks
from inspe_jax.visibility.tiles import Tile
from inspe_jax.visibility.view_masks import view_masks

TOGETHER = 8
"""Poses in one compiled call. With one shape for any number of poses, results are the same bits."""


def view_from_poses(
    grid: RayGrid, half: float, poses: Float[Array, "K 6"], tiled: TiledScene, asked: Asked
) -> tuple[Bool[np.ndarray, "K V"], Bool[np.ndarray, "K T V"]]:
    """What one sensor has in view, and what it sees in each frame, from each of K poses.

    ``poses`` are about the scene's centre, ``half`` is half a voxel's edge [m], and ``tiled`` is a
    scene in one chunk. Gives f for each pose and voxel, and f and line of sight for each frame.
    """
    (chunk,) = tiled.chunks
    assert chunk.solid is not None  # the scene has masks
    rays = grid.rays
    lengths = rays.table.rows.shape + rays.table.nearest.shape
    # Metrics do not change what is seen: without them fewer programs are compiled.
    asked = asked._replace(metrics=(), detection=None)
    bodies = 0 if tiled.statics is None else len(tiled.statics.top)
    key = (_view, grid.kind, lengths, chunk.solid.shape, chunk.prisms.top.shape, bodies, asked)
    jobs: list[Job] = [
        (key, partial(_view, rays, half, part, chunk, tiled.statics, asked=asked))
        for part in parts_of(np.asarray(poses), TOGETHER)
    ]
    views, seen = (np.concatenate(found)[: len(poses)] for found in zip(*run(jobs), strict=True))
    return tiled.tiles.by_voxel(views), tiled.tiles.by_voxel(seen)


@partial(jax.jit, static_argnames="asked")
def _view(
    rays: Rays,
    half: Float[Array, ""],
    poses: Float[Array, "K 6"],
    chunk: WorkChunk,
    statics: ConvexPrism | None,
    *,
    asked: Asked,
) -> tuple[UInt[Array, "K N C"], UInt[Array, "K T N C"]]:
    def view_from(pose: Array) -> tuple[Array, Array]:
        views = view_masks(rays, pose, chunk.tile, half)
        if statics is not None:
            views &= past_statics_masks(pose[:3], statics, chunk.tile, views)
        shadows = jax.tree.map(lambda leaf: leaf[0], BITS.shadows(pose[None, :3], chunk.prisms))

        def see_tile(part: tuple[Tile, Array, Array]) -> Array:
            tile, view, solid = part
            row = pose[:3], shadows, view
            return seen_by_sensor(BITS, row, tile, Frames(chunk.prisms, solid), asked)[0]

        def see_nothing(part: tuple[Tile, Array, Array]) -> Array:
            return jnp.zeros((len(chunk.prisms.top), len(part[1])), part[1].dtype)

        seen = jax.lax.map(
            lambda part: jax.lax.cond((part[1] != 0).any(), see_tile, see_nothing, part),
            (chunk.tile, views, chunk.solid),
        )
        return views, seen.swapaxes(0, 1)

    return jax.lax.map(view_from, poses)
