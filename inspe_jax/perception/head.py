"""What detectors tell, what they are to tell, and the losses: as CenterPoint's (Yin et al. 2021).

*Heat* peaks at the cell of each road user's middle (Law and Deng 2018; Zhou et al. 2019). *Values*
there are the place within the cell (x, y) [cells], z [m], logarithms of length, width and height
[m], and sine and cosine of yaw. Detectors of cameras also tell heat on pictures in training.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from inspe_jax.dataset.loading import Targets
from inspe_jax.dataset.loading.geometry import on_picture
from inspe_jax.perception.inputs import BevGrid, Inputs
from inspe_jax.perception.layers import Block, Conv, enlarged
from inspe_jax.simulation.frame import KINDS

Heat = Float[Array, "*n h w K"]

RARE = -2.19
"""First bias of the heat: a chance of 0.1, as in focal loss (Lin et al. 2017)."""
HARD, FAR = 2.0, 4.0
"""Exponents of the focal loss: cells that are right already, and cells near a peak, count less."""


class HeatHead(Conv):
    """Heat of each class before the sigmoid, from each cell's features."""

    def __init__(self, inputs: int, key: Array) -> None:
        super().__init__(inputs, len(KINDS), key, width=1)
        self.bias = jnp.full(len(KINDS), RARE, jnp.float32)


def bumps(
    at: Float[Array, "*n M"], deviation: Float[Array, "*n M"], count: int, mask: Bool[Array, "*n M"]
) -> Float[Array, "*n M c"]:
    """Gaussians on ``count`` cells, of height 1 at the cells ``at``; 0 outside ``mask``."""
    cells = jnp.arange(count).astype(float).reshape((1,) * at.ndim + (count,))
    off = (cells - at[..., None]) / deviation[..., None]
    return jnp.where(mask[..., None], jnp.exp(-0.5 * off**2), 0.0)


def class_heat(
    down: Float[Array, "n M h"], across: Float[Array, "n M w"], kind: Int[Array, "n M"]
) -> Heat:
    """The heat of each class at each cell: the highest of its road users' bumps, given by axis."""

    def one(rows: Array, columns: Array, own: Array) -> Array:
        both = rows[:, :, None] * columns[:, None]  # (M, h, w)
        return jnp.stack([(both * k[:, None, None]).max(0) for k in own.T], -1)

    own = jax.nn.one_hot(kind, len(KINDS))
    return lax.map(lambda x: one(*x), (down, across, own))


def per_road_user(total: Float[Array, ""], mask: Bool[Array, "*n"]) -> Float[Array, ""]:
    """A sum of losses, for each road user in ``mask`` on average."""
    return total / jnp.maximum(mask.sum(), 1).astype(float)


def focal_loss(heat: Heat, aim: Heat, mask: Bool[Array, "*m"]) -> Float[Array, ""]:
    """The loss of heat before the sigmoid, for each road user in ``mask`` on average."""
    chance, none = jax.nn.log_sigmoid(heat), jax.nn.log_sigmoid(-heat)
    right = -((1 - jnp.exp(chance)) ** HARD) * chance
    wrong = -((1 - aim) ** FAR) * jnp.exp(chance) ** HARD * none
    return per_road_user(jnp.where(aim == 1, right, wrong).sum(), mask)


HIDDEN = 32
VALUES = 8

OVERLAP = 0.1
"""A box as far from its place as the Gaussian's radius still overlaps so much of the union."""
LEAST_RADIUS = 2.0
"""Least radius of a Gaussian [cells], as in CenterPoint: a pedestrian would have none."""

UNSEEN = 1 - 1e-6
"""Height of the flat bump of a road user that does not count: no positive, hardly a negative."""

VALUE_WEIGHT = 0.5  # weight of the values' loss, which sums over eight; that of heat is 1

MOST = 100  # detections of a frame and class that are kept; nuScenes allows 500 of ten classes
LARGEST_LOG = 5.0
"""Largest logarithm of a side of a box, either way: 7 mm and 148 m, for trainings that diverge."""


class HeadOutput(NamedTuple):
    """What the head tells: heat before the sigmoid, and the values."""

    heat: Float[Array, "B H W K"]
    values: Float[Array, "B H W 8"]


class CenterHead(eqx.Module):
    """Maps at half the cells' resolution to heat and values at the whole."""

    shared: Block
    heat_block: Block
    value_block: Block
    heat: HeatHead
    values: Conv

    def __init__(self, channels: int, key: Array) -> None:
        a, b, c, d, e = jax.random.split(key, 5)
        self.shared = Block(channels, HIDDEN, a)
        self.heat_block = Block(HIDDEN, HIDDEN, b)
        self.value_block = Block(HIDDEN, HIDDEN, c)
        self.heat = HeatHead(HIDDEN, d)
        self.values = Conv(HIDDEN, VALUES, e, width=1)

    def __call__(self, x: Float[Array, "B h w c"]) -> HeadOutput:
        shared = self.shared(enlarged(x, 2))
        heat, values = self.heat_block(shared), self.value_block(shared)
        return HeadOutput(self.heat(heat), self.values(values))


class Aims(NamedTuple):
    """What the head is to tell: heat everywhere, and values at the cell of each road user."""

    heat: Float[Array, "B H W K"]
    row: Int[Array, "B M"]
    column: Int[Array, "B M"]
    values: Float[Array, "B M 8"]
    mask: Bool[Array, "B M"]


def aims(targets: Targets, grid: BevGrid, counted: Bool[Array, "B M"] | None = None) -> Aims:
    """The aims of road users in the grid; x runs along rows. Of those that are not ``counted``,
    nothing is to be told: neither that they are there nor that they are not."""
    boxes = jnp.asarray(targets.boxes)
    place = (boxes[..., :2] + grid.half) / grid.cell
    cell = jnp.floor(place)
    inside = ((cell >= 0) & (cell < grid.side)).all(-1)
    there = jnp.asarray(targets.mask) & inside
    mask = there if counted is None else there & counted
    unseen = (there & ~mask)[..., None]
    size = jnp.maximum(boxes[..., 3:6], 0.01)  # padding has none
    z, yaw = boxes[..., 2:3], boxes[..., 6:7]
    values = jnp.concatenate([place - cell, z, jnp.log(size), jnp.sin(yaw), jnp.cos(yaw)], -1)
    row, column = (jnp.clip(cell[..., k], 0, grid.side - 1).astype(int) for k in range(2))
    # As is usual, a radius is three standard deviations of a Gaussian on 2 r + 1 cells.
    reach = radius(size[..., 0] / grid.cell, size[..., 1] / grid.cell)

    def spread(at: Float[Array, "B M"]) -> Float[Array, "B M c"]:
        bump = bumps(at, (2 * reach + 1) / 6, grid.side, there)
        cells = jnp.arange(grid.side).astype(float)[None, None]
        near = jnp.abs(cells - at[..., None]) <= reach[..., None]
        return jnp.where(near & unseen, UNSEEN, bump)

    along, across = (spread(at.astype(float)) for at in (row, column))
    heat = class_heat(along, across, jnp.asarray(targets.kind))
    return Aims(heat, row, column, values, mask)


def radius(length: Float[Array, "*n"], width: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """How far a box can be off along both sides and still overlap :data:`OVERLAP` of the union
    [cells]: (l − r)(w − r) = 2 o / (1 + o) l w; at least :data:`LEAST_RADIUS`."""
    both = length + width
    apart = jnp.sqrt(both**2 - 4 * length * width * (1 - OVERLAP) / (1 + OVERLAP))
    return jnp.maximum((both - apart) / 2, LEAST_RADIUS)


def loss(found: HeadOutput, aim: Aims) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Those of heat and of values, for each road user on average."""
    heat = focal_loss(found.heat, aim.heat, aim.mask)
    frame = jnp.arange(len(aim.row))[:, None]
    off = jnp.abs(found.values[frame, aim.row, aim.column] - aim.values).sum(-1)
    return heat, VALUE_WEIGHT * per_road_user(jnp.where(aim.mask, off, 0).sum(), aim.mask)


class Peaks(NamedTuple):
    """The highest peaks of each frame, :data:`MOST` of each class, with boxes as of targets."""

    boxes: Float[Array, "B N 9"]
    kind: Int[Array, "B N"]
    score: Float[Array, "B N"]


def peaks(found: HeadOutput, grid: BevGrid) -> Peaks:
    """Cells whose heat is the largest of 3 × 3, and the boxes there, with velocity 0."""
    heat = jax.nn.sigmoid(found.heat)
    around = lax.reduce_window(heat, -jnp.inf, lax.max, (1, 3, 3, 1), (1, 1, 1, 1), "SAME")
    flat = jnp.where(heat == around, heat, 0.0).reshape(len(heat), -1, len(KINDS))
    score, cell = lax.top_k(flat.swapaxes(1, 2), MOST)  # (B, K, MOST)
    kind = jnp.broadcast_to(jnp.arange(len(KINDS))[None, :, None], cell.shape)
    score, cell, kind = (part.reshape(len(heat), -1) for part in (score, cell, kind))
    row, column = cell // grid.side, cell % grid.side
    values = found.values[jnp.arange(len(heat))[:, None], row, column]
    place = (jnp.stack([row, column], -1).astype(float) + values[..., :2]) * grid.cell - grid.half
    yaw = jnp.arctan2(values[..., 6], values[..., 7])[..., None]
    size = jnp.exp(jnp.clip(values[..., 3:6], -LARGEST_LOG, LARGEST_LOG))
    still = jnp.zeros((*yaw.shape[:-1], 2))
    return Peaks(jnp.concatenate([place, values[..., 2:3], size, yaw, still], -1), kind, score)


LEAST_PIXELS = 4
"""Pixels that show a road user who is to be found on a picture: a quarter of a cell's."""
NEAREST = 0.5
"""Least depth of a box whose place on a picture is told [m]; nearer ones are cut by its edge."""
SPREAD, LEAST_SPREAD = 0.25, 0.5
"""Standard deviation of a bump, as a share of the box's extent, and at least [cells]."""


def perspective_aims(
    inputs: Inputs, targets: Targets, cells: tuple[int, ...]
) -> tuple[Heat, Bool[Array, "n M"]]:
    """The heat to be told on the ``cells`` (h, w) of each picture, and whom each shows: perspective
    supervision (BEVFormer v2, Yang et al. 2023), as encoders are not pre-trained."""
    assert inputs.pixels is not None
    assert inputs.unit is not None
    scale = np.array(cells) / inputs.pixels.shape[2:4]
    boxes = jnp.asarray(targets.boxes)
    on_each = jax.vmap(jax.vmap(partial(on_picture, xp=jnp), in_axes=(None, 0, 0)))
    cameras = jnp.asarray(inputs.pose), jnp.asarray(inputs.intrinsic)
    seen = on_each(_corners(boxes), *cameras)  # (B, C, M, 8, 3)
    pixels = jnp.moveaxis(jnp.asarray(targets.pixels), -1, 1)  # (B, C, M)
    visible = (pixels >= LEAST_PIXELS) | (pixels == -1)  # -1: the set does not say
    shown = visible & jnp.asarray(targets.mask)[:, None] & (seen[..., 2].min(-1) > NEAREST)
    shown &= (jnp.asarray(inputs.unit) >= 0)[..., None]

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
    signs = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), -1).reshape(8, 3).astype(np.float32)
    off = signs[None, None] * boxes[:, :, None, 3:6]
    cos, sin = jnp.cos(boxes[..., 6, None]), jnp.sin(boxes[..., 6, None])
    turned = off[..., 0] * cos - off[..., 1] * sin, off[..., 0] * sin + off[..., 1] * cos
    return boxes[:, :, None, :3] + jnp.stack([*turned, off[..., 2]], -1)
