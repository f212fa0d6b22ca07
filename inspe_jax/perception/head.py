"""The head of every detector, its targets, loss and decoding: CenterPoint's (Yin et al. 2021).

At the cell of a road user's middle, the heat of its class has a peak. What else is told there, the
values, are: the middle's place within the cell (x, y) [cells], z [m], the logarithms of length,
width and height [m], and sine and cosine of yaw.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from inspe_jax.dataset.loading import Targets
from inspe_jax.perception.heat import HeatHead, bumps, class_heat, focal_loss, per_road_user
from inspe_jax.perception.inputs import BevGrid
from inspe_jax.perception.layers import Block, Conv, enlarged
from inspe_jax.simulation.frame import KINDS

HIDDEN = 32
VALUES = 8

OVERLAP = 0.1
"""A box as far from its place as the Gaussian's radius still overlaps so much of the union."""
LEAST_RADIUS = 2.0
"""Least radius of a Gaussian [cells], as in CenterPoint: a pedestrian would have none."""

VALUE_WEIGHT = 0.5
"""Weight of the values' loss, which sums over eight; that of heat is 1."""

MOST = 100
"""Detections of a frame and class that are kept, so that many of one class crowd out no other:
nuScenes allows 500 of ten classes, and the densest traffic has 60 road users."""


LARGEST_LOG = 5.0
"""Largest logarithm of a side of a box, either way: 7 mm and 148 m. A training that diverges tells
larger ones, whose side is no number."""


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

    @jax.named_scope("head")
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


def aims(targets: Targets, grid: BevGrid) -> Aims:
    """The aims of road users; those outside the grid are left out. x runs along rows."""
    boxes = jnp.asarray(targets.boxes)
    place = (boxes[..., :2] + grid.half) / grid.cell
    cell = jnp.floor(place)
    inside = ((cell >= 0) & (cell < grid.side)).all(-1)
    mask = jnp.asarray(targets.mask) & inside
    size = jnp.maximum(boxes[..., 3:6], 0.01)  # padding has none
    values = jnp.concatenate(
        [
            place - cell,
            boxes[..., 2:3],
            jnp.log(size),
            jnp.sin(boxes[..., 6:7]),
            jnp.cos(boxes[..., 6:7]),
        ],
        -1,
    )
    row, column = (jnp.clip(cell[..., k], 0, grid.side - 1).astype(int) for k in range(2))
    # As is usual, a radius is three standard deviations of a Gaussian on 2 r + 1 cells.
    deviation = (2 * radius(size[..., 0] / grid.cell, size[..., 1] / grid.cell) + 1) / 6
    along, across = (
        bumps(at.astype(float), deviation, grid.side, mask) for at in (row, column)
    )  # (B, M, side)
    heat = class_heat(along, across, jnp.asarray(targets.kind))
    return Aims(heat, row, column, values, mask)


def radius(length: Float[Array, "*n"], width: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """How far a box can be off along both sides and still overlap :data:`OVERLAP` of the union.

    With l w the area and o the overlap, (l − r)(w − r) = 2 o / (1 + o) l w. Lengths and the result
    are in cells; it is at least :data:`LEAST_RADIUS`.
    """
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
    """Cells whose heat is the largest of 3 × 3, and the boxes that are told there.

    Velocities are 0: one frame does not tell them.
    """
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
    boxes = jnp.concatenate(
        [place, values[..., 2:3], size, yaw, jnp.zeros((*yaw.shape[:-1], 2))],
        -1,
    )
    return Peaks(boxes, kind, score)
