"""What static bodies and the ground leave of what sensors see, the same in all frames."""

from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Array, Float, Num, UInt

from inspe_jax.core.parallel import Job, run
from inspe_jax.scoring.tiled_scene import TiledScene
from inspe_jax.visibility import bitmask
from inspe_jax.visibility.statics import past_statics_of_sensor


def past_statics(
    tiled: TiledScene,
    views: UInt[Array | np.ndarray, "S N C"],
    sensors: Float[Array | np.ndarray, "S 3"],
) -> Any:
    """Masks (S, N, C) of the voxels that neither bodies nor the ground hide from ``sensors``.

    ``views`` are masks of what each sensor has in view: tiles of which one has nothing are left
    out, and so are all of a scene without bodies.
    """
    statics, tile = tiled.statics, tiled.tiles.tile
    if statics is None:
        return views
    present = np.flatnonzero(np.asarray(views).any((1, 2)))
    key = past_statics_of_sensor, tile.heights.shape, statics.shapes
    jobs: list[Job] = [
        (key, partial(past_statics_of_sensor, sensors[s], statics, tile, views[s])) for s in present
    ]
    found = np.zeros_like(views)
    for s, mask in zip(present, run(jobs), strict=True):
        found[s] = mask
    return found


def sights_past_statics(
    tiled: TiledScene,
    sights: Num[Array | np.ndarray, "S N C Z"],
    views: UInt[Array | np.ndarray, "S N C"],
    sensors: Float[Array | np.ndarray, "S 3"],
) -> Any:
    """In how many frames each sensor has each voxel in line of sight, past what stands in all.

    ``sights`` are those numbers without that; ``views`` as in :func:`past_statics`.
    """
    if tiled.statics is None:
        return sights
    masks, levels = past_statics(tiled, views, sensors), sights.shape[-1]
    return sights * bitmask.unpack(np.asarray(masks)[..., None], levels)
