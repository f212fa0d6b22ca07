"""The viewsheds of one sensor at many poses: what it has in view, and what it sees in each frame.

What searches choose candidates by.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt

from inspe_jax.core.parallel import Job, parts_of, run
from inspe_jax.scoring.tiled_scene import TiledScene, WorkChunk
from inspe_jax.sensing.rays import Rays
from inspe_jax.sensing.sensors import RayGrid
from inspe_jax.visibility.shadows import clear_masks, shadow_bounds
from inspe_jax.visibility.tiles import Tile
from inspe_jax.visibility.view_masks import view_masks

TOGETHER = 8
"""Poses in one compiled call: one shape for any number of them, and the same bits."""


def view_from_poses(
    grid: RayGrid,
    half: float,
    poses: Float[Array, "K 6"],
    world: TiledScene,
    *,
    ignore_self_occlusion: bool = False,
) -> tuple[Bool[np.ndarray, "K V"], Bool[np.ndarray, "K T V"]]:
    """What one sensor has in view and what it sees in each frame, from each of K poses.

    For a world of one share. With ``ignore_self_occlusion`` other vehicles alone hide what is
    inside one.
    """
    (share,) = world.shares
    assert share.solid is not None  # it is not bare
    rays = grid.rays
    lengths = rays.table.rows.shape + rays.table.nearest.shape
    key = (
        _see,
        grid.kind,
        lengths,
        share.solid.shape,
        share.prisms.top.shape,
        ignore_self_occlusion,
    )
    jobs: list[Job] = [
        (key, partial(_see, rays, half, part, share, ignore_self_occlusion=ignore_self_occlusion))
        for part in parts_of(np.asarray(poses), TOGETHER)
    ]
    views, seen = (np.concatenate(found)[: len(poses)] for found in zip(*run(jobs), strict=True))
    return world.tiles.by_voxel(views), world.tiles.by_voxel(seen)


@partial(jax.jit, static_argnames="ignore_self_occlusion")
def _see(
    rays: Rays,
    half: Float[Array, ""],
    poses: Float[Array, "K 6"],
    share: WorkChunk,
    *,
    ignore_self_occlusion: bool,
) -> tuple[UInt[Array, "K N C"], UInt[Array, "K T N C"]]:
    def one(pose: Array) -> tuple[Array, Array]:
        views = view_masks(rays, pose, share.tile, half)
        cast = shadow_bounds(pose[:3], share.prisms)

        def look(part: tuple[Tile, Array, Array]) -> Array:
            tile, view, solid = part
            return view[None] & clear_masks(
                pose[:3], cast, tile, solid if ignore_self_occlusion else None
            )

        def none(part: tuple[Tile, Array, Array]) -> Array:
            return jnp.zeros((len(share.prisms.top), len(part[1])), part[1].dtype)

        seen = jax.lax.map(
            lambda part: jax.lax.cond((part[1] != 0).any(), look, none, part),
            (share.tile, views, share.solid),
        )
        return views, seen.swapaxes(0, 1)

    return jax.lax.map(one, poses)
