"""Learning what pictures show: perspective supervision (BEVFormer v2, Yang et al. 2023).

The originals of the encoders of pictures are pre-trained on a million of them. From a loss in
bird's-eye view alone, which reaches them through lift and splat, new ones learn slowly. So in
training, heat is also told on the pictures, at the road users that they show.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from inspe_jax.dataset.loading import Targets
from inspe_jax.dataset.loading.geometry import on_picture
from inspe_jax.perception.heat import bumps, class_heat, focal_loss
from inspe_jax.perception.inputs import Inputs

WEIGHT = 1.0
"""Of this loss beside those of heat and values."""
LEAST_PIXELS = 4
"""Pixels that show a road user who is to be found on a picture: a quarter of a cell's. Others are
as if they were not there."""
NEAREST = 0.5
"""Least depth of a box whose place on a picture is told [m]; nearer ones are cut by its edge."""
SPREAD, LEAST_SPREAD = 0.25, 0.5
"""Standard deviation of a bump, as a share of the box's extent, and at least [cells]."""


def perspective_loss(
    heat: Float[Array, "n h w K"], inputs: Inputs, targets: Targets
) -> Float[Array, ""]:
    """The focal loss of what is told on pictures, for each road user on each that shows one."""
    aim, shown = perspective_aims(inputs, targets, (heat.shape[1], heat.shape[2]))
    return WEIGHT * focal_loss(heat, aim, shown)


def perspective_aims(
    inputs: Inputs, targets: Targets, cells: tuple[int, int]
) -> tuple[Float[Array, "n h w K"], Bool[Array, "n M"]]:
    """The heat to be told on the ``cells`` (h, w) of each picture, and whom each picture shows.

    Bumps are at the middles of the boxes' extents on the picture.
    """
    assert inputs.pixels is not None
    assert inputs.unit is not None
    scale = np.array(cells) / inputs.pixels.shape[2:4]
    boxes = jnp.asarray(targets.boxes)
    seen = _on_pictures(_corners(boxes), jnp.asarray(inputs.pose), jnp.asarray(inputs.intrinsic))
    pixels = jnp.moveaxis(jnp.asarray(targets.pixels), -1, 1)  # (B, C, M)
    visible = (pixels >= LEAST_PIXELS) | (pixels == -1)  # -1: the set does not say
    shown = (
        visible & jnp.asarray(targets.mask)[:, None] & (jnp.asarray(inputs.unit) >= 0)[..., None]
    )
    shown &= seen[..., 2].min(-1) > NEAREST

    def along(axis: int) -> tuple[Array, Array, Array]:
        size = cells[1 - axis]
        at = seen[..., axis] * scale[1 - axis]
        low, high = jnp.clip(at.min(-1), 0, size), jnp.clip(at.max(-1), 0, size)
        middle = jnp.clip(jnp.floor((low + high) / 2), 0, size - 1)
        return middle, jnp.maximum(SPREAD * (high - low), LEAST_SPREAD), high > low

    (column, wide, some_wide), (row, high, some_high) = along(0), along(1)
    shown &= some_wide & some_high
    of_frames = (
        bumps(row, high, cells[0], shown),
        bumps(column, wide, cells[1], shown),
        jnp.broadcast_to(jnp.asarray(targets.kind)[:, None], shown.shape),
        shown,
    )
    down, across, kind, shown = (x.reshape(-1, *x.shape[2:]) for x in of_frames)
    return class_heat(down, across, kind), shown


def _corners(boxes: Float[Array, "B M 9"]) -> Float[Array, "B M 8 3"]:
    """The corners of boxes."""
    signs = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), -1).reshape(8, 3).astype(np.float32)
    off = signs[None, None] * boxes[:, :, None, 3:6]
    cos, sin = jnp.cos(boxes[..., 6, None]), jnp.sin(boxes[..., 6, None])
    turned = off[..., 0] * cos - off[..., 1] * sin, off[..., 0] * sin + off[..., 1] * cos
    return boxes[:, :, None, :3] + jnp.stack([*turned, off[..., 2]], -1)


def _on_pictures(
    corners: Float[Array, "B M 8 3"],
    pose: Float[Array, "B C 4 4"],
    intrinsic: Float[Array, "B C 3 3"],
) -> Float[Array, "B C M 8 3"]:
    """Column and row [pixels] and depth [m] of corners on each picture of their frame."""

    def one(points: Array, pose: Array, intrinsic: Array) -> Array:
        found: Array = on_picture(points.reshape(-1, 3), pose, intrinsic, jnp)
        return found.reshape(points.shape)

    return jax.vmap(jax.vmap(one, in_axes=(None, 0, 0)))(corners, pose, intrinsic)
