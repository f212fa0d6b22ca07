"""What a detector takes of a batch. An agent has the LiDARs, or the cameras, of a unit."""

from dataclasses import asdict, dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Int32, UInt8

from inspe_jax.core.errors import InspeError
from inspe_jax.dataset.loading import Batch, PillarGrid, Pillars

MULTIPLE = 32
"""Cells along a side are a multiple of this: fused maps have half as many, in windows of 16."""


@dataclass(frozen=True)
class BevGrid:
    """The cells of bird's-eye view about the middle of the intersection: ``half`` to each side,
    ``low`` to ``high`` above the ground, ``cell`` wide [m], of which a pedestrian has about one."""

    half: float = 51.2
    cell: float = 0.8
    low: float = -1.0
    high: float = 5.0

    @property
    def side(self) -> int:
        """Number of cells along each side."""
        return round(2 * self.half / self.cell)

    def check(self) -> None:
        """Raise InspeError if the maps of detectors do not fit the grid."""
        self.pillars().check()
        if self.side % MULTIPLE:
            raise InspeError(
                f"grid: {self.side} cells of {self.cell:g} m a side: a multiple of {MULTIPLE} "
                f"is needed, as with half {MULTIPLE * self.cell / 2:g} m"
            )

    def pillars(self) -> PillarGrid:
        """How points are divided among the same cells, for each unit: 6,000 at most."""
        return PillarGrid(**asdict(self), most_pillars=min(6000, self.side**2))


class Inputs(NamedTuple):
    """Of B frames, G agents of LiDARs, U agents of cameras and C cameras; ``unit`` is the number of
    each camera's agent, −1 for padding, and ``present`` says which agents there are."""

    pillars: Pillars | None
    pixels: UInt8[np.ndarray, "B C H W 3"] | None
    intrinsic: Float32[np.ndarray, "B C 3 3"] | None
    pose: Float32[np.ndarray, "B C 4 4"] | None
    unit: Int32[np.ndarray, "B C"] | None
    present: Bool[np.ndarray, "B A"]


class Agents(NamedTuple):
    """How many agents of LiDARs and of cameras a frame has at most."""

    lidars: int
    cameras: int


def inputs_of(batch: Batch, agents: Agents) -> Inputs:
    """The inputs of a batch, filled up to the number of ``agents``. Raises InspeError at more."""
    lidars, cameras = batch.lidars, batch.cameras
    pillars, unit, present = None, None, []
    if lidars is not None and lidars.pillars is not None:
        pillars = _filled_up(lidars.pillars, agents.lidars)
        present.append(pillars.counts.any(-1))
    if cameras is not None:
        # The place of each unit among the frame's, in the order of their numbers; 0 is padding.
        rank = [np.unique([0, *row], return_inverse=True)[1][1:] - 1 for row in cameras.unit]
        unit = np.where(cameras.present, rank, -1).astype(np.int32)
        _check_count(int(unit.max(initial=-1)) + 1, agents.cameras, "cameras")
        present.append((unit[..., None] == np.arange(agents.cameras)).any(1))
    there = np.concatenate(present, -1)
    # A frame without an agent has the first: attention to nothing has no value.
    there[~there.any(-1), 0] = True
    if cameras is None:
        return Inputs(pillars, None, None, None, None, there)
    return Inputs(pillars, cameras.pixels, cameras.intrinsic, cameras.pose, unit, there)


def _filled_up(pillars: Pillars, count: int) -> Pillars:
    missing = count - pillars.counts.shape[1]
    used = np.flatnonzero(pillars.counts.any(axis=(0, 2)))
    _check_count(int(used.max(initial=-1)) + 1, count, "LiDARs")
    if missing <= 0:
        return Pillars(*(part[:, :count] for part in pillars))
    more = [(0, 0), (0, missing)]
    return Pillars(*(np.pad(part, more + [(0, 0)] * (part.ndim - 2)) for part in pillars))


def _check_count(there: int, most: int, what: str) -> None:
    if there > most:
        raise InspeError(
            f"a frame has {there} units with {what}, but the detector was made for {most}: train "
            f"one on a set with as many"
        )
