"""The blind spots of a scored layout, in words: which part of which region is seen least."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from inspe_jax.scene.regions import Region
from inspe_jax.scene.scene import Scene

DIRECTIONS = (
    *("east", "north-east", "north", "north-west", "west", "south-west", "south", "south-east"),
)
"""Eighths of the plan about the centre, counter-clockwise from x."""
MIDDLE = 6.0
"""Nearer to the centre than this is the middle [m]."""
LEAST_AREA = 4.0
"""Parts of regions that are smaller are no spots [m²]."""


@dataclass(frozen=True)
class BlindSpot:
    """A part of a region: one eighth of the plan, or the middle.

    ``name`` is as ``south crosswalk``. ``at`` is the place in it that is nearest to the middle of
    what is unseen [m], ``area`` that of the part [m²]. ``unseen`` is the share of its time and
    height, up to the top of the region of interest, in which no sensor sees it, as it is out of
    view or hidden. ``loss`` is its share of all that is unseen, each region with its weight.
    """

    name: str
    region: str
    direction: str
    at: tuple[float, float]
    area: float
    unseen: float
    loss: float


def blind_spots(scene: Scene, seen_share: Float[np.ndarray, " L"]) -> tuple[BlindSpot, ...]:
    """The parts of all regions, those that lose most first.

    ``seen_share`` is :attr:`~inspe_jax.scoring.evaluate.Scores.seen_share`. Without it, as in a
    saved result, there are none. Inside static bodies nothing is to be seen.
    """
    grid = scene.voxels
    if len(seen_share) != len(grid.columns):
        return ()
    there = scene.voxel_weight.reshape(-1, grid.level_count).sum(1)
    unseen = np.clip(1.0 - np.asarray(seen_share, float), 0.0, 1.0)
    lost = there * unseen
    total = max(float(lost.sum()), 1e-12)
    offset = grid.columns - grid.center[:2]
    angle = np.arctan2(offset[:, 1], offset[:, 0])
    eighth = np.round(angle / (np.pi / 4)).astype(int) % len(DIRECTIONS)
    part = np.where(np.hypot(*offset.T) < MIDDLE, len(DIRECTIONS), eighth)
    found = []
    for region in Region:
        for k, direction in enumerate((*DIRECTIONS, "middle")):
            own = (grid.region == region) & (part == k) & (there > 0)
            area = float(own.sum()) * grid.spacing**2
            if area < LEAST_AREA:
                continue
            share = float(lost[own].sum() / there[own].sum())
            middle = np.average(grid.columns[own], axis=0, weights=lost[own] + 1e-12)
            nearest = np.hypot(*(grid.columns[own] - middle).T).argmin()  # and not in the road
            x, y = grid.columns[own][nearest].tolist()
            name = f"{direction} {region.key}"
            if direction == "middle":
                name = f"{region.key}, in the middle"
            loss = float(lost[own].sum()) / total
            found.append(BlindSpot(name, region.key, direction, (x, y), area, share, loss))
    return tuple(sorted(found, key=lambda spot: -spot.loss))
