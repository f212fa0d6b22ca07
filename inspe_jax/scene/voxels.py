"""The voxelised region of interest: columns over a plan grid, each with the same levels."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float, Int

from inspe_jax.core.errors import InspeError
from inspe_jax.core.parallel import check_memory
from inspe_jax.core.pytree import pytree
from inspe_jax.core.records import ByContent, Described, check_values
from inspe_jax.scene.intersection import Intersection
from inspe_jax.scene.regions import PAPER_WEIGHTS, PRECEDENCE, WEIGHT_LIMITS, Region

ROI_HEIGHT = 4.0  # height of the region of interest above the ground [m]
RADIUS_LIMITS = (10.0, 200.0)  # allowed radius of the region of interest, D_inf [m]
VOXEL_LIMITS = (0.05, 2.0)  # allowed edge of a voxel [m]
SPACING_LIMIT = 4.0  # largest spacing of voxels [m]; the smallest is the voxel's edge


@pytree
@dataclass(frozen=True, eq=False, repr=False)
class VoxelGrid(ByContent, Described):
    """Voxels as columns × levels, in world metres.

    ``columns`` are plan centres on a lattice of ``spacing`` [m] that has a corner at ``center``.
    ``ground`` is the height of the ground under each, ``region`` its label. Level k has its centre
    at ground + (k + ½)·spacing. Every voxel is a cube of edge ``size`` [m] in the middle of its
    lattice cell: a sample, if the spacing is wider. Voxel v is column v // Z, level v % Z.
    ``region_weight`` is the weight w of each label.

    >>> grid = scene.voxels
    >>> grid.columns.shape, grid.level_count, grid.count
    ((172, 2), 2, 344)
    """

    columns: Float[np.ndarray, "L 2"]
    ground: Float[np.ndarray, " L"]
    region: Int[np.ndarray, " L"]
    center: Float[np.ndarray, "3"]
    size: float = field(metadata={"static": True})
    radius: float = field(metadata={"static": True})
    level_count: int = field(metadata={"static": True})
    spacing: float = field(metadata={"static": True})
    region_weight: tuple[float, ...] = field(metadata={"static": True}, default=PAPER_WEIGHTS)

    def _facts(self) -> dict[str, Any]:
        return {"radius": f"{self.radius:g} m", "size": self.words, "voxels": self.count}

    def _check(self, prefix: str) -> None:
        check_values(self.region, f"{prefix}region", 0, len(Region) - 1)
        check_values(self.level_count, f"{prefix}level_count", 1)
        check_values(self.region_weight, f"{prefix}region_weight", 0, WEIGHT_LIMITS[1])
        if len(self.region_weight) != len(Region) or not self.column_weight.any():
            raise InspeError(
                f"{prefix}region_weight: no region that is there has weight: {self.region_weight}"
            )
        for name in ("size", "spacing", "radius"):
            check_values(getattr(self, name), prefix + name, VOXEL_LIMITS[0])

    @property
    def words(self) -> str:
        """The size of voxels in words, and their spacing if it is wider."""
        apart = f", one every {self.spacing:g} m" if self.spacing > self.size else ""
        return f"voxel {self.size:g} m{apart}"

    @property
    def levels(self) -> Float[np.ndarray, " Z"]:
        """Height of each level's centre above the ground [m]."""
        return (np.arange(self.level_count) + 0.5) * self.spacing

    @property
    def count(self) -> int:
        """Number of voxels V = L·Z."""
        return len(self.columns) * self.level_count

    @cached_property
    def centers(self) -> Float[np.ndarray, "V 3"]:
        """Voxel centres [m]."""
        z = self.ground[:, None] + self.levels  # (L, Z)
        xy = np.repeat(self.columns, self.level_count, axis=0)
        return np.column_stack([xy, z.ravel()])

    @cached_property
    def column_weight(self) -> Float[np.ndarray, " L"]:
        """Region weight w of each column; 0 in a region that does not count."""
        return np.array(self.region_weight)[self.region]

    @cached_property
    def weight(self) -> Float[np.ndarray, " V"]:
        """Region weight w of each voxel."""
        return np.repeat(self.column_weight, self.level_count)


def build_voxels(
    intersection: Intersection,
    *,
    radius: float = 50.0,
    voxel: float = 0.5,
    spacing: float | None = None,
) -> VoxelGrid:
    """Voxelise an intersection: every column within ``radius`` [m] that lies in some region.

    ``voxel`` is the edge of a voxel [m]. A column has the label of its centre. The levels together
    are as near to 4 m high as whole lattice cells allow. If ``spacing`` [m] is wider than a voxel,
    there is one voxel in each cell of that edge. Raises InspeError if a value is out of range, if
    the grid would not fit in memory, or if no region lies within the radius.
    """
    check_range("radius", radius, RADIUS_LIMITS)
    check_range("voxel", voxel, VOXEL_LIMITS)
    spacing = voxel if spacing is None else spacing
    check_range("spacing", spacing, (voxel, SPACING_LIMIT))
    level_count = max(1, int(ROI_HEIGHT / spacing + 0.5))
    half = int(np.ceil(radius / spacing))
    check_memory(np.pi * (radius / spacing) ** 2 * level_count, 4)

    offset = (np.indices((2 * half,) * 2).reshape(2, -1).T - half + 0.5) * spacing
    offset = offset[np.hypot(offset[:, 0], offset[:, 1]) <= radius]
    columns = offset + intersection.center[:2]

    region = np.full(len(columns), -1, np.int8)
    for label in reversed(PRECEDENCE):
        shape = intersection.regions.get(label)
        if shape is None or shape.is_empty:
            continue
        shapely.prepare(shape)
        # A centre on a border belongs to both sides; precedence decides.
        region[shapely.intersects_xy(shape, columns[:, 0], columns[:, 1])] = label
    inside = region >= 0
    if not inside.any():
        raise InspeError(
            f"{intersection.name}: no driveway, junction, crosswalk, sidewalk or shoulder within "
            f"{radius:g} m of ({intersection.center[0]:.1f}, {intersection.center[1]:.1f})"
        )
    columns = columns[inside]
    return VoxelGrid(
        columns=columns,
        ground=intersection.ground(columns),
        region=region[inside],
        center=np.asarray(intersection.center, float),
        size=float(voxel),
        radius=float(radius),
        level_count=level_count,
        spacing=float(spacing),
    )


def check_range(name: str, value: float, limits: tuple[float, float]) -> None:
    """Raise InspeError if a length [m] is not within limits."""
    if not limits[0] <= value <= limits[1]:
        raise InspeError(
            f"{name} {value:g} m is out of range: between {limits[0]:g} and {limits[1]:g} m"
        )
