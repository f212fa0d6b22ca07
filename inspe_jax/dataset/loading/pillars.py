"""Divides points among the pillars of a grid (PointPillars, Lang et al. 2019)."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from inspe_jax.core.errors import InspeError
from inspe_jax.core.records import check_values
from inspe_jax.dataset.loading.batch import Pillars


@dataclass(frozen=True)
class PillarGrid:
    """A square grid of pillars about the middle of the intersection, out to ``half`` and from
    ``low`` to ``high`` above the ground, each ``cell`` wide [m]. At random, ``most_points`` of a
    pillar's points are kept, and ``most_pillars`` pillars.

    The default, 256 × 256 pillars of 0.4 m as usual for OPV2V, can be halved eight times. Clouds
    fill 6,400 (the paper's LiDARs) to 14,000 pillars (Velodyne HDL-64E); 16 points hold 94 % of the
    latter.

    >>> dataset.PillarGrid(half=40.0, cell=0.4).side
    200
    """

    half: float = 51.2
    cell: float = 0.4
    low: float = -1.0
    high: float = 5.0
    most_points: int = 16
    most_pillars: int = 8000

    @property
    def side(self) -> int:
        """Number of cells along each side."""
        return round(2 * self.half / self.cell)

    def check(self) -> None:
        """Raise InspeError where a value is out of range."""
        if not (0 < self.cell <= 2 * self.half < np.inf):
            raise InspeError(f"pillars: cell {self.cell} m must be above 0 and fit {self.half} m")
        if abs(self.side * self.cell - 2 * self.half) > 1e-6 * self.half:
            raise InspeError(
                f"pillars: {2 * self.half:g} m are not a whole number of cells of {self.cell:g} m: "
                f"use half: {self.side * self.cell / 2:g}"
            )
        if not self.low < self.high:
            raise InspeError(f"pillars: low {self.low} m must be below high {self.high} m")
        for name in ("most_points", "most_pillars"):
            check_values(getattr(self, name), f"pillars: {name}", 1)

    def empty(self, *leading: int) -> Pillars:
        """Arrays without a point, with these leading axes."""
        shape = (*leading, self.most_pillars)
        return Pillars(
            np.zeros((*shape, self.most_points, 4), np.float32),
            np.zeros(shape, np.int32),
            np.zeros((*shape, 2), np.int32),
        )

    def fill(
        self, points: Float[np.ndarray, "N 4"], out: Pillars, rng: np.random.Generator | None = None
    ) -> None:
        """Put points, in random order, into empty pillars; ``rng`` draws which are kept."""
        side, nowhere = self.side, self.side**2
        x, y, z = np.ascontiguousarray(points[:, :3].T)
        inside = (x >= -self.half) & (x < self.half) & (y >= -self.half) & (y < self.half)
        inside &= (z >= self.low) & (z < self.high)
        # The least makes up for rounding at the upper edge.
        column, row = (
            np.minimum(((axis + self.half) * (1 / self.cell)).astype(np.int32), side - 1)
            for axis in (x, y)
        )
        cell = np.where(inside, column * side + row, nowhere)  # (N,)
        occupancy = np.bincount(cell, minlength=nowhere + 1)[:nowhere]
        pillars = np.flatnonzero(occupancy)
        if len(pillars) > self.most_pillars:
            draw = np.random.default_rng(0) if rng is None else rng
            pillars = np.sort(draw.permutation(pillars)[: self.most_pillars])
        # The pillar of each point; points of none come last. Sorting 16 bits takes one pass.
        kind = np.uint16 if len(pillars) < 2**16 else np.int64
        slot = np.full(nowhere + 1, len(pillars), kind)
        slot[pillars] = np.arange(len(pillars))
        own = slot[cell]
        order = np.argsort(own, kind="stable")
        counts = occupancy[pillars]
        starts = np.cumsum(counts) - counts
        order = order[: counts.sum()]
        own = own[order].astype(np.int64)
        rank = np.arange(len(own)) - starts[own]
        few = rank < self.most_points
        # A point is moved as one value of 16 bytes: several times as fast as a row of four.
        given = np.ascontiguousarray(points).view(np.complex128)[:, 0]
        slots = out.points.reshape(-1, 4).view(np.complex128)[:, 0]
        slots[(own * self.most_points + rank)[few]] = given[order[few]]
        out.counts[: len(pillars)] = np.minimum(counts, self.most_points)
        out.cells[: len(pillars)] = np.stack(np.divmod(pillars, side), -1)


def pillar_features(pillars: Pillars, grid: PillarGrid, xp: Any = np) -> Any:
    """PointPillars' features (…, P, K, 9), 0 in padding: x, y, z, intensity; x, y, z from the mean
    of the pillar's points; x and y from its middle. ``xp`` is numpy or jax.numpy."""
    mask = taken(pillars, grid, xp)
    count = xp.maximum(pillars.counts, 1).astype(xp.float32)[..., None, None]
    mean = pillars.points[..., :3].sum(-2, keepdims=True) / count
    middle = (pillars.cells.astype(xp.float32) + 0.5) * grid.cell - grid.half
    columns = [
        pillars.points,
        pillars.points[..., :3] - mean,
        pillars.points[..., :2] - middle[..., None, :],
    ]
    features = xp.concatenate(columns, -1)
    return xp.where(mask[..., None], features, xp.zeros_like(features))


def taken(pillars: Pillars, grid: PillarGrid, xp: Any = np) -> Any:
    """Which places of each pillar have a point, as (…, P, K)."""
    slots = xp.arange(grid.most_points).reshape((1,) * pillars.counts.ndim + (-1,))
    return slots < pillars.counts[..., None]
