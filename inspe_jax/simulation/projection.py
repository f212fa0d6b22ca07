"""Projects the boxes of road users onto a camera's picture."""

from collections.abc import Sequence

import numpy as np
import shapely
from jaxtyping import Float, Int

from inspe_jax.core.geometry import Pinhole, pixels, rotation
from inspe_jax.simulation.frame import RoadUserBox

Corners = Float[np.ndarray, "B 8 3"]
Edges = tuple[Float[np.ndarray, "M 2 2"], Int[np.ndarray, " M"]]

NEAR = 0.1  # edges are cut where they come closer to the plane of the camera than this [m]
TOUCHING = 0.01  # the same for outlines: road users are rendered from this distance on [m]

_SIGNS = np.array([[x, y, z] for z in (-1, 1) for x, y in ((1, 1), (-1, 1), (-1, -1), (1, -1))])
_BOTTOM = [(0, 1), (1, 2), (2, 3), (3, 0)]
EDGES = np.array([*_BOTTOM, *((a + 4, b + 4) for a, b in _BOTTOM), *((k, k + 4) for k in range(4))])
"""The 12 edges of a box, as pairs of its :func:`corners`; (3, 0) is at the front, at the bottom."""


def corners(boxes: Sequence[RoadUserBox]) -> Corners:
    """Corners [m]: front left, rear left, rear right, front right; at the bottom, then the top."""
    found = np.zeros((len(boxes), 8, 3))
    for k, box in enumerate(boxes):
        turn = rotation(np.array([0.0, 0.0, box.yaw]), np)
        found[k] = np.asarray(box.center) + (_SIGNS * np.asarray(box.size) / 2) @ turn.T
    return found


def edge_lines(image: Pinhole, box_corners: Corners, width: int, height: int) -> Edges:
    """The parts of boxes' edges in a picture: (column, row) of their ends, and the box of each."""
    lines, owner = _in_front(image, box_corners, NEAR)
    for axis, most in ((0, width), (1, height)):
        lines, owner = _cut(lines, owner, lines[..., axis])
        lines, owner = _cut(lines, owner, most - lines[..., axis])
    return lines, owner


def outlines(
    image: Pinhole, box_corners: Corners, width: int, height: int, margin: float = 0.0
) -> list[Float[np.ndarray, "N 2"]]:
    """Areas of a picture that boxes with these :func:`corners` cover, ``margin`` pixels wider, as
    polygons of (column, row). A box that is not in it has no polygon."""
    lines, owner = _in_front(image, box_corners, TOUCHING)
    _, own = np.unique(np.repeat(owner, 2), return_inverse=True)
    hulls = shapely.convex_hull(shapely.multipoints(lines.reshape(-1, 2), indices=own))
    cut = shapely.clip_by_rect(shapely.buffer(hulls, margin, quad_segs=1), 0, 0, width, height)
    shapes = [shape for shape in cut if shape.geom_type == "Polygon" and not shape.is_empty]
    return [np.asarray(shape.exterior.coords) for shape in shapes]


def _in_front(image: Pinhole, box_corners: Corners, near: float) -> Edges:
    """The edges of boxes in a picture's plane, cut at ``near`` [m], and the box of each."""
    pose = np.asarray(image.pose, float)
    ends = box_corners[:, EDGES].reshape(-1, 2, 3)
    owner = np.repeat(np.arange(len(box_corners)), len(EDGES))
    depth = (ends - pose[:3]) @ rotation(pose[3:], np)[:, 0]  # (M, 2)
    ends, owner = _cut(ends, owner, depth - near)
    return pixels(image, ends)[..., :2], owner


def _cut(
    ends: Float[np.ndarray, "M 2 D"], owner: Int[np.ndarray, " M"], margin: Float[np.ndarray, "M 2"]
) -> tuple[Float[np.ndarray, "N 2 D"], Int[np.ndarray, " N"]]:
    """The parts of segments where a margin is above 0. It is given at their ends, and linear."""
    kept = (margin > 0).any(1)
    ends, margin = ends[kept], margin[kept]
    (a, b), out = margin.T, (margin < 0)[..., None]  # out (N, 2, 1)
    share = (a / np.where(a == b, 1.0, a - b))[:, None]
    crossing = ends[:, 0] + share * (ends[:, 1] - ends[:, 0])
    return np.where(out, crossing[:, None], ends), owner[kept]
